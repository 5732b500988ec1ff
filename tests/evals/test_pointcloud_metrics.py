"""Cloud metrics against closed forms, brute force and Open3D; what they refuse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from evals.pointcloud_metrics import (
    chamfer_distance,
    fit_plane,
    fit_plane_robust,
    icp,
    nearest_distances,
    overlap_scores,
)

POINTS = hnp.arrays(np.float64, st.tuples(st.integers(1, 25), st.just(3)), elements=st.integers(-9, 9))


def _grid(side: int = 6) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(float(side))] * 3), -1).reshape(-1, 3)


# --- distances ----------------------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(source=POINTS, target=POINTS)
def test_distances_equal_brute_force(source: np.ndarray, target: np.ndarray) -> None:
    table = np.linalg.norm(source[:, None] - target[None], axis=-1)
    np.testing.assert_allclose(nearest_distances(source, target), table.min(axis=1), atol=1e-12)
    result = chamfer_distance(source, target)
    assert result.source_to_target == pytest.approx(table.min(axis=1).mean(), abs=1e-12)
    assert result.target_to_source == pytest.approx(table.min(axis=0).mean(), abs=1e-12)
    assert result.symmetric == pytest.approx((result.source_to_target + result.target_to_source) / 2)
    swapped = chamfer_distance(target, source)
    assert (swapped.source_to_target, swapped.target_to_source) == (result.target_to_source, result.source_to_target)
    for score in overlap_scores(source, target, [1.0, 3.5]):
        precision, recall = (table.min(axis=1) < score.threshold).mean(), (table.min(axis=0) < score.threshold).mean()
        assert (score.precision, score.recall) == (precision, recall)
        mean = 0 if precision + recall == 0 else 2 * precision * recall / (precision + recall)
        assert score.f_score == pytest.approx(mean)


def test_identical_and_shifted_clouds() -> None:
    grid = _grid()
    same = chamfer_distance(grid, grid)
    assert (same.source_to_target, same.target_to_source, same.symmetric) == (0, 0, 0)
    assert overlap_scores(grid, grid, 1e-9)[0].f_score == 1
    shifted = grid + [0.25, 0, 0]  # less than half the spacing: every neighbour is the own copy
    assert chamfer_distance(grid, shifted).symmetric == pytest.approx(0.25)
    below, above = overlap_scores(grid, shifted, [0.25, 0.2500001])
    assert below.f_score == 0  # d < threshold is strict
    assert above.f_score == 1


def test_which_cloud_precision_and_recall_belong_to() -> None:
    """Source = a part of the target: everything of it is found, but it covers a quarter of the target only."""
    target = _grid(4)
    source = target[target[:, 2] == 0]
    score = overlap_scores(source, target, 0.5)[0]
    assert (score.precision, score.recall) == (1.0, 0.25)
    assert score.f_score == pytest.approx(0.4)
    reverse = overlap_scores(target, source, 0.5)[0]
    assert (reverse.precision, reverse.recall) == (0.25, 1.0)


def test_the_papers_figures_are_consistent() -> None:
    """A source of which 98.4 % lie near a target of which 31.7 % lie near it gives F = 0.479."""
    target = np.c_[np.arange(1000.0), np.zeros((1000, 2))] * 10
    near, far = target[:317], target[:317].repeat(2, axis=0)[:5] + [0, 500, 0]
    source = np.concatenate([near, near[:1].repeat(1000 - 317 - 16, axis=0), far.repeat(4, axis=0)[:16]])
    score = overlap_scores(source, target, 0.05)[0]
    assert (score.precision, score.recall) == pytest.approx((0.984, 0.317))
    assert f"{score.f_score:.3f}" == "0.480"  # the paper's 0.479 rests on shares before rounding


# --- planes -------------------------------------------------------------------------------------------------


def _plane(count: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on a tilted plane with Gaussian noise along its normal; the normal; the offset vector."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    flat = np.c_[rng.uniform(-1, 1, (count, 2)), noise * rng.normal(size=count)]
    return flat @ rotation.T + [1, 2, 3], rotation[:, 2], np.array([1.0, 2, 3])


def test_plane_of_exact_and_noisy_points() -> None:
    points, normal, offset = _plane(5000, 0.0)
    fit = fit_plane(points)
    assert abs(fit.normal @ normal) == pytest.approx(1, abs=1e-12)
    assert (fit.centroid - offset) @ normal == pytest.approx(0, abs=1e-12)
    assert fit.rmse == pytest.approx(0, abs=1e-12)
    points, _, _ = _plane(5000, 0.02)
    fit = fit_plane(points)
    centered = points - points.mean(axis=0)
    assert fit.rmse == pytest.approx(np.linalg.svd(centered, compute_uv=False)[2] / np.sqrt(5000), rel=1e-12)
    assert fit.rmse == pytest.approx(0.02, rel=0.05)
    assert fit.median_distance == pytest.approx(0.6745 * 0.02, rel=0.05)  # of a normal distribution
    assert fit.inlier_share == 1
    assert fit.normal[np.abs(fit.normal).argmax()] > 0


def test_four_points_by_hand() -> None:
    fit = fit_plane(np.array([[1, 0, 0.1], [-1, 0, 0.1], [0, 1, -0.1], [0, -1, -0.1]]))
    np.testing.assert_allclose(fit.normal, [0, 0, 1], atol=1e-12)
    assert fit.rmse == pytest.approx(0.1)


@pytest.mark.parametrize("seed", range(4))
def test_the_robust_plane_ignores_a_third_of_clutter(seed: int) -> None:
    points, normal, offset = _plane(1000, 0.005, seed)
    clutter = np.random.default_rng(seed).uniform(-3, 3, (500, 3)) + offset + 2 * normal
    both = np.concatenate([points, clutter])
    fit = fit_plane_robust(both, 0.02, seed=seed)
    assert np.degrees(np.arccos(min(1, abs(fit.normal @ normal)))) < 0.2
    assert fit.inlier_share == pytest.approx(1000 / 1500, abs=0.02)
    assert fit.inlier_rmse == pytest.approx(0.005, rel=0.1)
    assert fit.rmse > 0.5
    assert fit_plane(both).inlier_rmse > 10 * fit.inlier_rmse
    again = fit_plane_robust(both, 0.02, seed=seed)
    assert again.normal.tobytes() == fit.normal.tobytes()
    inliers = np.abs((both - fit.centroid) @ fit.normal) <= 0.02
    assert inliers.mean() == fit.inlier_share


def test_robust_equals_least_squares_without_outliers() -> None:
    points, _, _ = _plane(400, 0.01)
    robust, plain = fit_plane_robust(points, 1.0), fit_plane(points)
    np.testing.assert_allclose(robust.normal, plain.normal, atol=1e-12)
    assert robust.rmse == pytest.approx(plain.rmse)
    three = np.array([[0, 0, 0], [1, 0, 0], [0, 1.0, 0]])
    np.testing.assert_allclose(fit_plane_robust(three, 0.1, iterations=5).normal, [0, 0, 1], atol=1e-12)


# --- ICP ----------------------------------------------------------------------------------------------------


def _bumpy(count: int = 1500) -> np.ndarray:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 1, (count, 2))
    return np.c_[xy, 0.3 * np.sin(3 * xy[:, 0]) + 0.2 * np.cos(4 * xy[:, 1])]


@pytest.mark.parametrize("scale", [1.0, 1.03])
def test_icp_finds_a_small_motion(scale: float) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    source = _bumpy()
    rotation = Rotation.from_rotvec(np.radians([1.0, -0.5, 0.8])).as_matrix()
    target = scale * source @ rotation.T + [0.01, -0.02, 0.015]
    result = icp(source, target, 0.1, with_scale=scale != 1.0, max_iterations=200, relative_change=1e-12)
    np.testing.assert_allclose(result.transform.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(result.transform.translation, [0.01, -0.02, 0.015], atol=1e-6)
    assert result.transform.scale == pytest.approx(scale, abs=1e-6)
    assert result.rotation_deg == pytest.approx(np.degrees(np.linalg.norm(np.radians([1.0, -0.5, 0.8]))), abs=1e-4)
    assert result.translation_norm == pytest.approx(np.linalg.norm([0.01, -0.02, 0.015]), abs=1e-6)
    assert result.fitness == 1
    assert result.inlier_rmse == pytest.approx(0, abs=1e-6)
    moved = result.transform.apply(source)
    assert chamfer_distance(moved, target).symmetric < 1e-6 < chamfer_distance(source, target).symmetric


def test_rigid_icp_keeps_the_scale() -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    result = icp(_bumpy(), 1.02 * _bumpy(), 0.2)
    assert result.transform.scale == pytest.approx(1, abs=1e-9)
    same = icp(_bumpy(), _bumpy(), 0.05)
    np.testing.assert_allclose(same.transform.matrix(), np.eye(4), atol=1e-12)


# --- refusals -----------------------------------------------------------------------------------------------

EMPTY, BROKEN = np.empty((0, 3)), np.array([[0, 0, 0], [1, np.nan, 0], [0, 1, 0.0]])
LINE, SQUARE = np.arange(9.0)[:, None] * [1, 2, 3], np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1.0, 1, 0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: nearest_distances(EMPTY, SQUARE), "source has 0 points, at least 1"),
        (lambda: nearest_distances(SQUARE, EMPTY), "target has 0 points"),
        (lambda: chamfer_distance(BROKEN, SQUARE), "source has 1 non-finite rows"),
        (lambda: overlap_scores(SQUARE, BROKEN, 0.1), "target has 1 non-finite rows"),
        (lambda: overlap_scores(SQUARE, SQUARE, [0.1, 0.0]), "thresholds must be positive"),
        (lambda: overlap_scores(SQUARE, SQUARE, float("nan")), "thresholds must be positive"),
        (lambda: nearest_distances(SQUARE[:, :2], SQUARE), r"source must have shape \(N, 3\)"),
        (lambda: fit_plane(SQUARE[:2]), "fewer than 3"),
        (lambda: fit_plane(EMPTY), "at least 1"),
        (lambda: fit_plane(LINE), "one line"),
        (lambda: fit_plane(np.ones((5, 3))), "one line"),
        (lambda: fit_plane(BROKEN), "non-finite"),
        (lambda: fit_plane_robust(LINE, 0.1), "one line"),
        (lambda: fit_plane_robust(SQUARE, 0), "threshold and iterations"),
        (lambda: icp(SQUARE[:2], SQUARE, 0.1), "source has 2 points, at least 3"),
        (lambda: icp(SQUARE, SQUARE, 0), "max_distance"),
        (lambda: icp(SQUARE, SQUARE + 10, 0.1), "no source point has a target point within 0.1"),
    ],
)
def test_refusals(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
