"""From votes to depth, each step against a loop, a third party, or numbers worked out by hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from devo.errors import InputError
from utils.emvs.depth_map import adaptive_threshold, extract_depth, masked_median, to_bytes
from utils.emvs.geometry import DepthPlanes
from utils.emvs.settings import EmvsSettings


def smooth_image(rng: np.random.Generator) -> np.ndarray:
    return cv2.GaussianBlur(rng.integers(0, 256, (60, 80)).astype(np.uint8), (5, 5), 0)


@pytest.mark.parametrize("size", [11, 15, 21])
@pytest.mark.parametrize("margin", [2.0, 5.0, 7.5])
def test_threshold_is_that_of_opencv_for_large_windows(size: int, margin: float) -> None:
    """OpenCV takes the same kernel from 11 pixels on; for smaller ones it has tables that depend on its version."""
    image = smooth_image(np.random.default_rng(size))
    expected = cv2.adaptiveThreshold(image, 1, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, cv2.THRESH_BINARY, size, -margin)
    found = adaptive_threshold(image, size, margin)
    assert 50 < found.sum() < 2400
    assert (found != expected.astype(bool)).sum() <= 2  # means that end in .5 within float32 rounding


def test_threshold_by_hand() -> None:
    """One pixel of 100 on 0: its Gaussian mean for 5 pixels, sigma 1.1, is 100 k0^2 = 13.7, rounded 14."""
    kernel = np.exp(-0.5 * (np.arange(-2, 3) / 1.1) ** 2)
    k0 = kernel[2] / kernel.sum()
    assert round(100 * k0 * k0) == 14
    image = np.zeros((7, 9), np.uint8)
    image[3, 4] = 100
    for margin, passes in ((85.0, True), (86.0, False)):
        expected = np.zeros((7, 9), bool)
        expected[3, 4] = passes
        np.testing.assert_array_equal(adaptive_threshold(image, 5, margin), expected)


@pytest.mark.parametrize("size", [1, 3, 5])
def test_masked_median_is_that_of_a_loop(size: int) -> None:
    rng = np.random.default_rng(size)
    plane, mask = rng.integers(0, 100, (13, 17)).astype(np.int16), rng.random((13, 17)) < 0.3
    expected = np.zeros((13, 17))
    half = size // 2
    for y in range(13):
        for x in range(17):
            window = np.s_[max(y - half, 0):y + half + 1, max(x - half, 0):x + half + 1]
            values = np.sort(plane[window][mask[window]])
            if len(values):
                expected[y, x] = values[(len(values) + 1) // 2 - 1]  # the lower one of an even number
    assert (expected == 0).any() or size == 5
    np.testing.assert_array_equal(masked_median(plane, mask, size), expected)


def test_masked_median_of_a_large_image_goes_by_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    plane, mask = rng.integers(0, 50, (40, 30)).astype(np.int16), rng.random((40, 30)) < 0.5
    whole = masked_median(plane, mask, 5)
    monkeypatch.setattr("utils.emvs.depth_map._MEDIAN_CELLS", 30 * 25 * 3)
    np.testing.assert_array_equal(masked_median(plane, mask, 5), whole)


def test_to_bytes() -> None:
    np.testing.assert_array_equal(to_bytes(np.array([[2.0, 3.0, 4.0]], np.float32)), [[0, 128, 255]])
    np.testing.assert_array_equal(to_bytes(np.full((2, 2), 7.0, np.float32)), np.zeros((2, 2)))


def dsi_with_dots(planes: int = 10, row: int = 1, column: int = 1) -> torch.Tensor:
    """Dots of 9 votes in every third row and column, all in plane 6, on a 20 x 16 image."""
    dsi = torch.zeros(planes, 16, 20)
    dsi[6, row::3, column::3] = 9.0
    return dsi


def test_depth_map_by_hand() -> None:
    planes = DepthPlanes(1.0, 3.0, 10)
    found = extract_depth(dsi_with_dots(), planes, EmvsSettings())
    y, x = np.nonzero(found.mask)
    # the border: up to 2 at the left and top, from 18 (14) on at the right and bottom
    assert set(x) == {4, 7, 10, 13, 16} and set(y) == {4, 7, 10, 13}
    np.testing.assert_array_equal(found.plane[found.mask], 6)
    np.testing.assert_allclose(found.depth[found.mask], 1 / (1 / 3 + 0.6 * 2 / 3), rtol=1e-6)
    np.testing.assert_array_equal(found.confidence[found.mask], 9)
    assert found.depth.dtype == found.confidence.dtype == np.float32


def test_border() -> None:
    """Up to 2 at the low ends, from 2 before the end at the high ones; each pixel is a dot once."""
    believed = np.zeros((16, 20), bool)
    for row in range(3):
        for column in range(3):
            dsi = dsi_with_dots(row=row, column=column)
            believed |= extract_depth(dsi, DepthPlanes(1.0, 3.0, 10), EmvsSettings()).mask
    expected = np.zeros((16, 20), bool)
    expected[3:14, 3:18] = True
    np.testing.assert_array_equal(believed, expected)


def test_the_first_plane_wins_a_tie_and_no_votes_give_no_depth() -> None:
    dsi = dsi_with_dots()
    dsi[3] = dsi[6]
    found = extract_depth(dsi, DepthPlanes(1.0, 3.0, 10), EmvsSettings())
    np.testing.assert_array_equal(found.plane[found.mask], 3)
    empty = extract_depth(torch.zeros(10, 16, 20), DepthPlanes(1.0, 3.0, 10), EmvsSettings())
    assert not empty.mask.any() and not empty.plane.any()


@pytest.mark.parametrize("offset", [-0.4, 0.0, 0.25])
def test_subplane_finds_the_top_of_a_parabola(offset: float) -> None:
    planes = DepthPlanes(1.0, 3.0, 10)
    dsi = torch.zeros(10, 16, 20)
    for plane in range(10):
        dsi[plane, 1::3, 1::3] = max(9.0 - (plane - 6 - offset) ** 2, 0.0)
    found = extract_depth(dsi, planes, EmvsSettings(subplane=True))
    assert found.mask.any()
    np.testing.assert_allclose(found.depth[found.mask], planes.at(6 + offset), rtol=1e-5)
    coarse = extract_depth(dsi, planes, EmvsSettings())
    np.testing.assert_allclose(coarse.depth[found.mask], planes.at(6), rtol=1e-6)


def test_subplane_leaves_the_ends_alone() -> None:
    for plane in (0, 9):
        dsi = torch.zeros(10, 16, 20)
        dsi[plane, 1::3, 1::3] = 9.0
        found = extract_depth(dsi, DepthPlanes(1.0, 3.0, 10), EmvsSettings(subplane=True))
        np.testing.assert_allclose(found.depth[found.mask], DepthPlanes(1.0, 3.0, 10).at(plane), rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"dimX": -1}, "dimX is -1"), ({"dimZ": 1}, "dimZ is 1, expected 2 to"), ({"fov_deg": 180}, "fov_deg is 180"),
     ({"adaptive_threshold_kernel_size": 4}, "expected an odd number"), ({"median_filter_size": 0}, "odd number"),
     ({"radius_search": 0.0}, "radius_search is 0.0, expected a positive"), ({"vote": "cubic"}, "bilinear or nearest"),
     ({"min_num_neighbors": -1}, "at least 0"), ({"packet_size": 0}, "packet_size is 0"),
     ({"event_stride": 0}, "event_stride is 0"), ({"reference": "all"}, "fixed or baseline"),
     ({"min_depth": -1.0}, "min_depth is -1.0"), ({"max_depth": float("nan")}, "max_depth is nan"),
     ({"min_depth": 2.0, "max_depth": 1.0}, "min_depth 2 is not below max_depth 1"),
     ({"adaptive_threshold_c": float("inf")}, "finite"), ({"view_baseline": 0.0}, "view_baseline is 0.0"),
     ({"depth_spacing": "log"}, "inverse or linear"), ({"min_view_baseline": 0.5}, "below view_baseline")],
)
def test_settings_that_make_no_sense(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        EmvsSettings(**options)  # type: ignore[arg-type]
