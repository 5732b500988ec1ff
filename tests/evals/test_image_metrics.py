"""Projection, depth errors and edge agreement against closed forms; what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from evals.image_metrics import (
    canny_edges,
    edge_agreement,
    project,
    relative_depth_errors,
    summarise_depth_errors,
)

INTRINSICS = (100.0, 110.0, 40.0, 30.0)
SIZE = (80, 60)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_projection_undoes_back_projection(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    pixel, depth = rng.uniform([-0.4, -0.4], [79.4, 59.4], (20, 2)), rng.uniform(0.1, 9, 20)
    fx, fy, cx, cy = INTRINSICS
    seen = np.stack([(pixel[:, 0] - cx) / fx * depth, (pixel[:, 1] - cy) / fy * depth, depth], axis=1)
    found = project(seen @ pose[:3, :3].T + pose[:3, 3], pose, INTRINSICS, SIZE)
    np.testing.assert_allclose(found.pixel_xy, pixel, atol=1e-8)
    np.testing.assert_allclose(found.depth, depth, rtol=1e-10)
    assert found.inside.all()


def test_points_behind_and_beside_are_outside() -> None:
    found = project([[0, 0, -1], [5, 0, 1], [0, 0, 1], [0, 0, 0]], np.eye(4), INTRINSICS, SIZE)
    assert found.inside.tolist() == [False, False, True, False]
    assert np.isnan(found.depth[[0, 3]]).all() and np.isfinite(found.pixel_xy[1]).all()
    assert len(project(np.zeros((0, 3)), np.eye(4), INTRINSICS, SIZE).inside) == 0
    with pytest.raises(InputError, match="1 values that are not finite"):
        project([[0, np.nan, 1]], np.eye(4), INTRINSICS, SIZE)
    with pytest.raises(InputError, match="shape"):
        project([[0, 1]], np.eye(4), INTRINSICS, SIZE)


def test_depth_errors_of_points_before_and_behind_a_wall() -> None:
    """Points 3 % behind, 1 % before and on a wall 2 m away; one sees no depth, one is beside the image."""
    truth = np.full((60, 80), 2.0, np.float32)
    truth[:, 70:] = 0.0
    points = np.array([[0, 0, 2.06], [0, 0, 1.98], [0.1, 0.1, 2.0], [0.76, 0, 2.0], [9, 0, 2.0]])
    errors = relative_depth_errors(points, np.eye(4), INTRINSICS, truth)
    np.testing.assert_allclose(errors[:3], [0.03, -0.01, 0.0], atol=1e-7)
    assert np.isnan(errors[3:]).all()
    figures = summarise_depth_errors(errors)
    assert (figures.judged, figures.total) == (3, 5)
    assert (figures.median, figures.bias) == pytest.approx((0.01, 0.0), abs=1e-7)
    assert figures.within_2_percent == pytest.approx(2 / 3)
    nothing = summarise_depth_errors(errors[3:])
    assert nothing.judged == 0 and np.isnan([nothing.median, nothing.within_2_percent, nothing.bias]).all()


def test_points_beside_a_line() -> None:
    edges = np.zeros((60, 80), bool)
    edges[:, 40] = True
    rows = np.arange(60)
    beside = edge_agreement(np.stack([np.full(60, 43), rows], axis=1), edges)
    assert beside.mean_distance_px == pytest.approx(3.0)
    assert (beside.on_edge, beside.coverage) == (0.0, 0.0)
    on_half = edge_agreement(np.stack([np.full(30, 40), rows[:30]], axis=1), edges, radius_px=1.0)
    assert (on_half.mean_distance_px, on_half.on_edge) == (0.0, 1.0)
    assert on_half.coverage == pytest.approx(31 / 60)  # the row next to the last point counts too
    assert on_half.random_distance_px == pytest.approx(np.abs(np.arange(80) - 40).mean(), rel=1e-3)


@pytest.mark.parametrize(("pixel", "edges", "message"), [
    (np.zeros((0, 2)), np.ones((6, 8), bool), "0 projected points"),
    (np.zeros((3, 2)), np.zeros((6, 8), bool), "0 edge pixels"),
    (np.array([[8, 0]]), np.ones((6, 8), bool), "outside the image of 8x6"),
])
def test_what_cannot_be_compared(pixel: np.ndarray, edges: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        edge_agreement(pixel, edges)


def test_edges_of_a_square() -> None:
    image = np.full((60, 80), 230, np.uint8)
    image[20:40, 30:50] = 40
    edges = canny_edges(image)
    rows, columns = np.nonzero(edges)
    assert 60 < len(rows) < 100
    assert (rows.min(), rows.max()) == pytest.approx((20, 40), abs=1)
    assert (columns.min(), columns.max()) == pytest.approx((30, 50), abs=1)
    np.testing.assert_array_equal(canny_edges(np.repeat(image[..., None], 3, axis=2)), edges)
