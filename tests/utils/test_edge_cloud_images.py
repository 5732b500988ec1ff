"""Event images, edge pixels, pixel grids and borrowed depths against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from devo.errors import InputError
from utils.edge_clouds.images import (
    edge_pixels,
    event_image,
    full_resolution,
    interpolate_inv_depths,
    normalised,
    pooled_to_qres,
    ridge_pixels,
)
from utils.edge_clouds.settings import EdgeSettings, FocusSettings


def test_event_image_is_the_mean_of_absolute_values() -> None:
    voxel = torch.randn(5, 24, 32, generator=torch.Generator().manual_seed(0))
    image = event_image(voxel, 4)
    expected = voxel.abs().sum(dim=0).numpy().reshape(6, 4, 8, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(image.numpy(), expected, rtol=1e-5)


def test_event_image_is_cropped_like_the_tracker_crops() -> None:
    """346 columns: one column is cut on the left, one on the right; an event at full column 1 is then the first."""
    voxel = torch.zeros(5, 260, 346)
    voxel[0, 0, 0] = voxel[0, 0, 345] = 7.0
    assert float(event_image(voxel, 4).sum()) == 0.0
    voxel[2, 0, 1] = 16.0
    image = event_image(voxel, 4)
    assert image.shape == (65, 86) and float(image[0, 0]) == 1.0


@pytest.mark.parametrize("downsample", [1, 2, 4, 8])
def test_a_pooled_pixel_lies_where_its_full_pixels_lie(downsample: int) -> None:
    """The centre of mass of the full-resolution pixels under a pooled pixel, for every pooling."""
    chosen = EdgeSettings(downsample=downsample)
    pixels = torch.tensor([[0, 0], [3, 2]])
    covered = torch.arange(downsample).float().mean()
    middle = pixels * downsample + covered
    np.testing.assert_allclose(full_resolution(pooled_to_qres(pixels, chosen), (0, 1)),
                               middle.numpy() + np.array([1, 0]), atol=1e-6)
    legacy = EdgeSettings(downsample=downsample, legacy_pixels=True)
    np.testing.assert_allclose(pooled_to_qres(pixels, legacy).numpy(), pixels.numpy() * downsample / 4)


@given(st.integers(0, 2**31 - 1), st.integers(1, 400), st.integers(0, 9))
@settings(max_examples=30, deadline=None)
def test_edge_pixels_are_the_strongest_sobel_responses(seed: int, topk: int, border: int) -> None:
    image = torch.rand(14, 17, generator=torch.Generator().manual_seed(seed))
    array = image.numpy().astype(np.float64)
    strength = np.hypot(ndimage.sobel(array, 0, mode="constant"), ndimage.sobel(array, 1, mode="constant"))
    inside = np.zeros_like(strength, dtype=bool)
    inside[border:14 - border, border:17 - border] = border < 7
    expected = np.sort(strength[inside])[::-1][:topk]
    pixels = edge_pixels(image, topk, border).numpy()
    found = strength[pixels[:, 1], pixels[:, 0]]
    assert len(pixels) == min(topk, inside.sum()) and inside[pixels[:, 1], pixels[:, 0]].all()
    np.testing.assert_allclose(np.sort(found)[::-1], expected, rtol=1e-5)
    order = pixels[:, 1] * 17 + pixels[:, 0]
    assert (np.diff(order) > 0).all()


def test_ridges_are_where_the_edge_is_and_gradients_beside_it() -> None:
    """A straight blurred edge: the ridge is found on the line, the Sobel edges one pixel off on both sides."""
    rows, columns = torch.meshgrid(torch.arange(20.0), torch.arange(24.0), indexing="ij")
    image = torch.exp(-0.5 * (columns - 11.0 - 0.0 * rows) ** 2)
    ridge = ridge_pixels(image, 16, 2)
    assert ridge[:, 0].tolist() == [11] * 16 and ridge[:, 1].tolist() == list(range(2, 18))
    assert set(edge_pixels(image, 32, 2)[:, 0].tolist()) == {10, 12}
    slanted = torch.exp(-0.5 * (columns - rows - 2.0) ** 2)
    found = ridge_pixels(slanted, 14, 2)
    assert bool((found[:, 0] - found[:, 1] == 2).all()) and len(found) == 14
    plateau = torch.zeros(8, 8)
    plateau[:, 3:5] = 1.0  # a ridge that falls between two columns
    assert set(ridge_pixels(plateau, 64, 1)[:, 0].tolist()) <= {3, 4}
    assert len(ridge_pixels(torch.ones(9, 9), 50, 2)) == 0


def test_a_flat_or_broken_image_has_no_edges() -> None:
    assert len(edge_pixels(torch.full((10, 10), 3.0), 50, 1)) == 0
    broken = torch.zeros(10, 10)
    broken[5, 5] = float("nan")
    assert len(edge_pixels(broken, 50, 1)) == 0


@given(st.integers(0, 2**31 - 1), st.integers(1, 6), st.floats(0.5, 20.0))
@settings(max_examples=30, deadline=None)
def test_depths_are_those_of_the_nearest_patches(seed: int, knn: int, max_dist: float) -> None:
    """Against a plain loop over the pixels."""
    generator = np.random.default_rng(seed)
    centers = generator.uniform(0, 30, (8, 2)).astype(np.float32)
    inv_depths = generator.uniform(0.1, 2.0, 8).astype(np.float32)
    centers[0], inv_depths[1], inv_depths[2] = np.nan, np.nan, 1e-4  # do not vote
    xy = generator.uniform(0, 30, (20, 2)).astype(np.float32)
    chosen = EdgeSettings(knn=knn, max_dist=max_dist)
    rows, values = interpolate_inv_depths(torch.from_numpy(xy), torch.from_numpy(centers),
                                          torch.from_numpy(inv_depths), chosen)
    expected = {}
    for row, point in enumerate(xy):
        distance = np.linalg.norm(centers[3:] - point, axis=1)
        nearest = np.argsort(distance)[:knn]
        if knn <= 5 and distance[nearest].max() <= max_dist:
            weight = 1.0 / np.maximum(distance[nearest], 1e-3)
            expected[row] = (weight * inv_depths[3:][nearest]).sum() / weight.sum()
    assert rows.tolist() == list(expected)
    np.testing.assert_allclose(values.numpy(), list(expected.values()), rtol=1e-4)


def test_normalisation_forgets_how_many_events_there_were() -> None:
    image = torch.rand(20, 30, generator=torch.Generator().manual_seed(1)) * (torch.rand(20, 30) < 0.3)
    np.testing.assert_allclose(normalised(5.0 * image).numpy(), normalised(image).numpy(), rtol=1e-5)
    assert float(normalised(torch.zeros(4, 4)).abs().sum()) == 0.0


@pytest.mark.parametrize(("kind", "values", "word"), [
    (EdgeSettings, {"downsample": 0}, "edge_downsample"), (EdgeSettings, {"knn": 0}, "edge_knn"),
    (EdgeSettings, {"topk": 0}, "edge_topk"), (EdgeSettings, {"border": -1}, "edge_border"),
    (EdgeSettings, {"max_dist": float("nan")}, "edge_max_dist"), (FocusSettings, {"support": 0}, "focus_support"),
    (FocusSettings, {"rho_samples": 5}, "focus_guard"), (FocusSettings, {"rho_rel": 1.0}, "focus_rho_rel"),
    (FocusSettings, {"rho_abs": 0.0}, "focus_rho_abs"), (FocusSettings, {"max_keyframes": -1}, "focus_max_keyframes"),
    (FocusSettings, {"edges": "canny"}, "focus_edges"), (FocusSettings, {"min_score": float("inf")}, "focus_min_score"),
])
def test_settings_that_make_no_sense_are_refused(kind: type, values: dict, word: str) -> None:
    with pytest.raises(InputError, match=word):
        kind(**values)
