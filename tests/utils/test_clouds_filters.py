"""The filters: rules against hand-made cases, brute force and Open3D, laws, degenerate clouds."""

from __future__ import annotations

import builtins
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import (
    DEFAULT_STEPS,
    FILTERS,
    clean_cloud,
    median_neighbor_distance,
    quality_filter,
    radius_outlier,
    range_filter,
    statistical_outlier,
    voxel_downsample,
)

COORDINATES = hnp.arrays(np.float32, st.tuples(st.integers(0, 40), st.just(3)), elements=st.integers(-20, 20))


def _distances(points: np.ndarray) -> np.ndarray:
    points = points.astype(np.float64)
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


def _sor_by_hand(points: np.ndarray, neighbors: int, ratio: float) -> np.ndarray:
    count = len(points)
    means = np.sort(_distances(points), axis=1)[:, : min(neighbors, count)].mean(axis=1)
    positive = means[means > 0]
    center = positive.sum() / count
    spread = np.sqrt(((positive - center) ** 2).sum() / (count - 1))
    return (means > 0) & (means < center + ratio * spread)


@pytest.mark.parametrize("backend", ["scipy", "open3d"])
@pytest.mark.parametrize("count", [2, 19, 20, 21, 400])
@pytest.mark.parametrize("copies", [0, 5, 30])
def test_sor_follows_the_rule(backend: str, count: int, copies: int) -> None:
    if backend == "open3d":
        pytest.importorskip("open3d", exc_type=ImportError)
    rng = np.random.default_rng(count)
    points = rng.standard_t(2, size=(count, 3)).astype(np.float32)
    points = np.vstack([points, np.tile(points[:1], (copies, 1))])
    keep, report = statistical_outlier(PointCloud(points), backend=backend)
    np.testing.assert_array_equal(keep, _sor_by_hand(points, 20, 2.0))
    assert (report.before, report.after) == (len(points), int(keep.sum()))
    assert report.parameters == {"neighbors": 20, "std_ratio": 2.0, "backend": backend}


@pytest.mark.parametrize("backend", ["scipy", "open3d"])
def test_sor_divides_by_one_less_than_the_number_of_points(backend: str) -> None:
    if backend == "open3d":
        pytest.importorskip("open3d", exc_type=ImportError)
    points = np.random.default_rng(9).normal(size=(30, 3)).astype(np.float32)
    means = np.sort(_distances(points), axis=1)[:, :20].mean(axis=1)
    edge = (means.max() - means.mean()) / means.std(ddof=1)  # the ratio at which the farthest point goes
    for ratio, kept in ((edge * (1 - 1e-6), 29), (edge * (1 + 1e-6), 30)):
        assert statistical_outlier(PointCloud(points), std_ratio=ratio, backend=backend)[1].after == kept


def test_sor_drops_the_one_far_point() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(5)] * 3), -1).reshape(-1, 3)
    keep, _ = statistical_outlier(PointCloud(np.vstack([grid, [[30, 30, 30]]])))
    assert keep[:-1].all()
    assert not keep[-1]


@pytest.mark.parametrize("backend", ["scipy", "open3d"])
@pytest.mark.parametrize("radius", [0.2, 0.5, None])
@pytest.mark.parametrize("least", [1, 4, 16, None])
def test_ror_follows_the_rule(backend: str, radius: float | None, least: int | None) -> None:
    if backend == "open3d":
        pytest.importorskip("open3d", exc_type=ImportError)
    points = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    points[:7] = points[7]
    keep, report = radius_outlier(PointCloud(points), radius=radius, min_neighbors=least, backend=backend)
    used = report.parameters["radius"]
    others = (_distances(points) <= used).sum(axis=1) - 1
    wanted = least if least is not None else (4 if radius is None else 16)
    assert report.parameters["min_neighbors"] == wanted
    np.testing.assert_array_equal(keep, others >= wanted)
    if radius is None:
        unique = np.unique(points, axis=0)
        gaps = np.sort(_distances(unique), axis=1)[:, 1]
        assert used == pytest.approx(3 * np.median(gaps), rel=1e-12)


def test_automatic_radius_keeps_a_sampled_plane() -> None:
    """With the 16 neighbours of the fixed radius an automatic one would leave nothing of a surface."""
    plane = np.random.default_rng(1).random((3000, 3)) * [1, 1, 0]
    keep, _ = radius_outlier(PointCloud(plane))
    assert keep.mean() > 0.8
    assert radius_outlier(PointCloud(plane), min_neighbors=16)[0].mean() < 0.01


@pytest.mark.parametrize("name", ["sor", "ror", "voxel", "range"])
@pytest.mark.parametrize("factor", [2.0**-12, 2.0**9])
def test_the_unit_of_length_does_not_matter(name: str, factor: float) -> None:
    points = np.random.default_rng(2).standard_t(1, size=(600, 3)).astype(np.float32)
    first, _ = FILTERS[name](PointCloud(points))
    second, _ = FILTERS[name](PointCloud(points * np.float32(factor)))
    np.testing.assert_array_equal(first, second)
    assert 0 < first.sum() < 600


def _scored(count: int = 60) -> PointCloud:
    return PointCloud(np.random.default_rng(3).normal(size=(count, 3)), scalars={
        "observations": np.full(count, 5), "parallax_deg": np.full(count, 3.0), "depth": np.full(count, 2.0),
        "host_frame": np.arange(count, dtype=np.int32) % 10, "residual_px": np.full(count, 0.5),
        "inv_depth_sigma": np.full(count, 0.01), "clamped": np.zeros(count, bool)})


@pytest.mark.parametrize(
    ("scalar", "value", "criterion", "arguments"),
    [
        ("observations", 2, "min_observations", {}),
        ("parallax_deg", 0.99, "min_parallax_deg", {}),
        ("parallax_deg", np.nan, "min_parallax_deg", {}),
        ("depth", -1.0, "positive_depth", {}),
        ("depth", 40.0, "max_depth_median_ratio", {}),
        ("host_frame", 9, "drop_last_frames", {}),
        ("clamped", True, "clamped", {}),
        ("residual_px", 1.5, "max_residual_px", {"max_residual_px": 1.0}),
        ("inv_depth_sigma", 0.2, "max_relative_sigma", {"max_relative_sigma": 0.3}),
    ],
)
def test_each_quality_criterion(scalar: str, value: float, criterion: str, arguments: dict[str, float]) -> None:
    cloud = _scored()
    before, _ = quality_filter(cloud, **arguments)
    assert before[10]  # the point that is spoilt below: host frame 0
    cloud.scalars[scalar][10] = value  # type: ignore[index]
    after, report = quality_filter(cloud, **arguments)
    assert not after[10]
    np.testing.assert_array_equal(np.delete(after, 10), np.delete(before, 10))
    assert report.removed[criterion] >= 1
    assert report.after == after.sum()
    assert not report.skipped


def test_quality_limits_are_inclusive_and_can_be_switched_off() -> None:
    cloud = _scored()
    cloud.scalars["observations"][:] = 3  # type: ignore[index]
    cloud.scalars["parallax_deg"][:] = 1.0  # type: ignore[index]
    keep, report = quality_filter(cloud)
    np.testing.assert_array_equal(keep, cloud.scalars["host_frame"] <= 7)
    assert report.removed["drop_last_frames"] == 12
    off = dict.fromkeys(["min_observations", "min_parallax_deg", "max_depth_median_ratio", "drop_last_frames"])
    assert quality_filter(cloud, **off)[0].all()


def test_quality_says_what_it_could_not_judge() -> None:
    keep, report = quality_filter(PointCloud(np.zeros((3, 3)), scalars={"observations": np.array([1, 3, 9])}))
    np.testing.assert_array_equal(keep, [False, True, True])
    named = [reason.split(" ")[0] for reason in report.skipped]
    assert named == ["clamped", "min_parallax_deg", "positive_depth", "max_depth_median_ratio", "drop_last_frames"]
    assert "not judged: clamped (the cloud has no clamped)" in str(report)


@settings(max_examples=80, deadline=None)
@given(points=COORDINATES, size=st.sampled_from([0.5, 1.0, 3.0, 7.5]))
def test_voxels_hold_one_point_each(points: np.ndarray, size: float) -> None:
    cloud = PointCloud(points)
    keep, report = voxel_downsample(cloud, voxel_size=size)
    if not len(points):
        assert report.after == 0
        return
    cells = np.floor((points - points.min(axis=0)) / size).astype(int)
    occupied = {tuple(cell) for cell in cells}
    kept = [tuple(cell) for cell in cells[keep]]
    assert len(kept) == len(set(kept))
    assert set(kept) == occupied
    for cell in occupied:  # the kept point is the nearest one to the mean of its voxel
        members = np.flatnonzero((cells == cell).all(axis=1))
        gaps = np.linalg.norm(points[members] - points[members].astype(np.float64).mean(axis=0), axis=1)
        chosen = members[keep[members]][0]
        assert np.linalg.norm(points[chosen] - points[members].astype(np.float64).mean(axis=0)) <= gaps.min() + 1e-9


def test_voxel_removes_exact_duplicates_that_sor_would_take_whole() -> None:
    points = np.vstack([np.random.default_rng(5).normal(size=(200, 3)), np.zeros((25, 3))])
    assert not statistical_outlier(PointCloud(points))[0][200:].any()
    kept, reports = clean_cloud(PointCloud(points), [("voxel", {"voxel_size": 1e-3}), "sor"])
    assert (kept.points == 0).all(axis=1).sum() == 1
    assert [report.name for report in reports] == ["voxel", "sor"]


def test_range_filter() -> None:
    points = np.array([[0, 0, d] for d in (0.5, 1, 2, 3, 100)], float)
    np.testing.assert_array_equal(range_filter(PointCloud(points), min_range=1, max_range=3)[0], [0, 1, 1, 1, 0])
    keep, report = range_filter(PointCloud(points))
    assert report.parameters["max_range"] == 40.0  # 20 times the median
    np.testing.assert_array_equal(keep, [1, 1, 1, 1, 0])
    np.testing.assert_array_equal(range_filter(PointCloud(points), center=(0, 0, 100), max_range=1)[0], [0, 0, 0, 0, 1])


@pytest.mark.parametrize("name", list(FILTERS))
def test_empty_and_broken_clouds(name: str) -> None:
    keep, report = FILTERS[name](PointCloud(np.empty((0, 3))))
    assert keep.shape == (0,)
    assert keep.dtype == bool
    assert (report.before, report.after) == (0, 0)
    keep, report = FILTERS[name](PointCloud(np.full((4, 3), np.nan)))
    assert not keep.any()
    assert report.removed["non-finite"] == 4
    assert str(report).startswith(name)


def test_identical_points() -> None:
    """As documented: SOR takes them all, an automatic radius does not exist, one stays per voxel."""
    same = PointCloud(np.ones((30, 3)))
    assert median_neighbor_distance(same.points) is None
    assert not statistical_outlier(same)[0].any()
    keep, report = radius_outlier(same)
    assert keep.all()
    assert "no automatic one" in report.skipped[0]
    assert radius_outlier(same, radius=0.1)[0].all()
    np.testing.assert_array_equal(voxel_downsample(same)[0], np.arange(30) == 0)


def test_nonfinite_rows_are_removed_by_all_and_disturb_nothing() -> None:
    points = np.random.default_rng(6).normal(size=(300, 3))
    spoilt = np.insert(points, [0, 100, 300], np.nan, axis=0)
    finite = np.isfinite(spoilt).all(axis=1)
    for name in ("sor", "ror", "voxel", "range"):
        clean, _ = FILTERS[name](PointCloud(points))
        keep, report = FILTERS[name](PointCloud(spoilt))
        np.testing.assert_array_equal(keep[finite], clean)
        assert not keep[~finite].any()
        assert report.removed["non-finite"] == 3


def test_clean_cloud_chains_and_keeps_provenance() -> None:
    cloud = _scored(200)
    cleaned, reports = clean_cloud(cloud)
    assert [report.name for report in reports] == list(DEFAULT_STEPS)
    assert reports[0].before == 200
    assert reports[1].before == reports[0].after
    assert len(cleaned) == reports[1].after < 200
    rows = [int(np.flatnonzero((cloud.points == point).all(axis=1))[0]) for point in cleaned.points]
    np.testing.assert_array_equal(cleaned.scalars["host_frame"], cloud.scalars["host_frame"][rows])
    assert rows == sorted(rows)
    same, none = clean_cloud(cloud, [])
    assert len(same) == 200
    assert none == []


@pytest.mark.parametrize(
    "call",
    [
        lambda c: statistical_outlier(c, neighbors=1), lambda c: statistical_outlier(c, std_ratio=0),
        lambda c: statistical_outlier(c, backend="pcl"), lambda c: radius_outlier(c, radius=0),
        lambda c: radius_outlier(c, min_neighbors=0), lambda c: radius_outlier(c, radius_multiple=-1),
        lambda c: voxel_downsample(c, voxel_size=0), lambda c: voxel_downsample(c, voxel_size=1e-300),
        lambda c: range_filter(c, min_range=2, max_range=1), lambda c: range_filter(c, median_multiple=0),
        lambda c: clean_cloud(c, ["polish"]),
    ],
)
def test_parameters_out_of_range(call: Callable[[PointCloud], Any]) -> None:
    with pytest.raises(InputError):
        call(_scored())


def test_without_open3d_the_same_points_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = PointCloud(np.random.default_rng(7).standard_t(2, size=(300, 3)))
    expected, _ = statistical_outlier(cloud)
    real = builtins.__import__

    def without_open3d(name: str, *rest: Any) -> Any:
        if name.split(".")[0] == "open3d":
            raise ImportError("libusb-1.0.so.0: cannot open shared object file")
        return real(name, *rest)

    monkeypatch.setattr("utils.clouds.open3d_import.importlib.import_module", without_open3d)
    keep, report = statistical_outlier(cloud)
    np.testing.assert_array_equal(keep, expected)
    assert report.parameters["backend"] == "scipy"
    with pytest.raises(InputError, match="libusb"):
        radius_outlier(cloud, backend="open3d")
