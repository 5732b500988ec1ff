"""Named filters that clean a cloud, each with a report of what it removed.

Every filter takes a cloud and returns a mask of the points to keep and a `FilterReport`; nothing is moved or
averaged, so every kept point keeps its colour and its provenance. Points with a non-finite coordinate are removed by
all of them. The scale of a monocular cloud is arbitrary, so lengths default to multiples of the cloud's own median
nearest-neighbour distance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.clouds.open3d_import import import_open3d

Value = float | int | str | None


@dataclass(frozen=True)
class FilterReport:
    """What one filter did.

    Attributes:
        name: name of the filter.
        before: number of points it was given.
        after: number of points it kept.
        parameters: the values in effect, automatic ones resolved; lengths in the cloud's own unit.
        removed: criterion -> number of points that fail it (a point can fail several).
        skipped: criteria that could not be judged, each with the reason.
    """

    name: str
    before: int
    after: int
    parameters: dict[str, Value]
    removed: dict[str, int] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()

    def __str__(self) -> str:
        values = ", ".join(f"{key}={value:.4g}" if isinstance(value, float) else f"{key}={value}"
                           for key, value in self.parameters.items() if value is not None)
        text = f"{self.name}({values}): kept {self.after} of {self.before} points"
        if any(self.removed.values()):
            text += "; removed by " + ", ".join(f"{name} {count}" for name, count in self.removed.items() if count)
        return text + ("; not judged: " + ", ".join(self.skipped) if self.skipped else "")


def median_neighbor_distance(points: np.ndarray) -> float | None:
    """Median distance of a point to its nearest neighbour elsewhere: the natural unit of length of a cloud.

    Exact duplicates are counted once. Returns None where fewer than two distinct finite points exist.

    Args:
        points: `(N, 3)`, any unit; non-finite rows are ignored.
    """
    distinct = np.unique(points[np.isfinite(points).all(axis=1)], axis=0)
    if len(distinct) < 2:
        return None
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(distinct).query(distinct, k=2)[0][:, 1]))


def quality_filter(
    cloud: PointCloud,
    *,
    min_observations: int | None = 3,
    min_parallax_deg: float | None = 1.0,
    max_depth_median_ratio: float | None = 20.0,
    drop_last_frames: int | None = 2,
    max_residual_px: float | None = None,
    max_relative_sigma: float | None = None,
) -> tuple[np.ndarray, FilterReport]:
    """Keep the points that the odometry itself has reason to trust, judged by the cloud's scalars.

    Criteria, each off when None: `observations >= min_observations`; `parallax_deg >= min_parallax_deg` (degrees);
    `0 < depth < max_depth_median_ratio * median depth` (ratio None: only `depth > 0`); `host_frame` older than the
    last `drop_last_frames` frames that host points; `residual_px <= max_residual_px` (pixels);
    `inv_depth_sigma * depth <= max_relative_sigma`, the relative error of the inverse depth; and, always, not
    `clamped`. NaN fails a criterion. A criterion whose scalar the cloud lacks is skipped and reported.

    Returns:
        `(N,)` bool, True = keep; the report.
    """
    checks: list[tuple[str, tuple[str, ...], Callable[..., np.ndarray], Value]] = [
        ("clamped", ("clamped",), lambda clamped: clamped == 0, 0),
        ("min_observations", ("observations",), lambda seen: seen >= min_observations, min_observations),
        ("min_parallax_deg", ("parallax_deg",), lambda angle: angle >= min_parallax_deg, min_parallax_deg),
        ("positive_depth", ("depth",), lambda depth: depth > 0, 0),
        ("max_depth_median_ratio", ("depth",),
         lambda depth: depth < (max_depth_median_ratio or 0) * _median_depth(depth), max_depth_median_ratio),
        ("drop_last_frames", ("host_frame",), lambda host: host <= host.max(initial=0) - drop_last_frames,
         drop_last_frames),
        ("max_residual_px", ("residual_px",), lambda residual: residual <= max_residual_px, max_residual_px),
        ("max_relative_sigma", ("inv_depth_sigma", "depth"), lambda sigma, depth: sigma * depth <= max_relative_sigma,
         max_relative_sigma),
    ]
    keep = cloud.finite_mask()
    removed = {"non-finite": int((~keep).sum())}
    skipped = []
    for name, needed, passes, limit in checks:
        missing = [scalar for scalar in needed if scalar not in cloud.scalars]
        if limit is None:
            continue
        if missing:
            skipped.append(f"{name} (the cloud has no {' and no '.join(missing)})")
            continue
        passed = passes(*(cloud.scalars[scalar] for scalar in needed))
        removed[name] = int((~passed).sum())
        keep &= passed
    parameters = {name: limit for name, _, _, limit in checks if name not in ("clamped", "positive_depth")}
    return keep, FilterReport("quality", len(cloud), int(keep.sum()), parameters, removed, tuple(skipped))


def statistical_outlier(
    cloud: PointCloud, *, neighbors: int = 20, std_ratio: float = 2.0, backend: str = "auto"
) -> tuple[np.ndarray, FilterReport]:
    """Statistical outlier removal (SOR): drop points whose mean distance to their neighbours is unusually large.

    With `m_i` the mean distance of point i to its `neighbors` nearest points, itself included, a point is kept iff
    `0 < m_i < mean + std_ratio * std`, where mean and standard deviation run over the positive `m_i` but divide by
    all N and N - 1 points. Consequence, as in Open3D: a point with at least `neighbors - 1` exact duplicates has
    `m_i = 0` and is removed with them all; drop duplicates first (`voxel_downsample`) to avoid that.

    Args:
        cloud: any unit.
        neighbors: at least 2; smaller clouds use all their points.
        std_ratio: positive.
        backend: `open3d`, `scipy` (the same rule), or `auto`: Open3D where it can be imported. The report names it.

    Returns:
        `(N,)` bool, True = keep; the report.

    Raises:
        InputError: a parameter out of range, or Open3D asked for and not importable.
    """
    if neighbors < 2 or not std_ratio > 0:
        raise InputError("SOR needs neighbors >= 2 (the point itself counts) and std_ratio > 0, "
                         f"found {neighbors} and {std_ratio}")
    chosen = _backend(backend)
    finite = cloud.finite_mask()
    points = cloud.points[finite].astype(np.float64)
    kept = np.zeros(len(points), dtype=bool)
    if chosen == "open3d" and len(points):
        kept[_open3d_cloud(points).remove_statistical_outlier(neighbors, std_ratio)[1]] = True
    elif len(points):
        means = _neighbor_distances(points, min(neighbors, len(points))).mean(axis=1)
        valid = means > 0
        center = means[valid].sum() / len(points)
        spread = np.sqrt(((means[valid] - center) ** 2).sum() / max(len(points) - 1, 1))
        kept = valid & (means < center + std_ratio * spread)
    parameters: dict[str, Value] = {"neighbors": neighbors, "std_ratio": std_ratio, "backend": chosen}
    return _spread_over(cloud, "sor", finite, kept, parameters)


def radius_outlier(
    cloud: PointCloud,
    *,
    radius: float | None = None,
    min_neighbors: int | None = None,
    radius_multiple: float = 3.0,
    backend: str = "auto",
) -> tuple[np.ndarray, FilterReport]:
    """Radius outlier removal (ROR): drop points with too few others around them.

    A point is kept iff at least `min_neighbors` other points lie within `radius` of it; exact duplicates count as
    others.

    Args:
        cloud: any unit.
        radius: in the cloud's unit; None takes `radius_multiple` times the median nearest-neighbour distance.
        min_neighbors: None takes 16 with a given radius and 4 with an automatic one (a surface that is sampled at
            random has about 6 others within three median distances).
        radius_multiple: positive; used when `radius` is None.
        backend: as for `statistical_outlier`.

    Returns:
        `(N,)` bool, True = keep; the report. A cloud without two distinct points has no automatic radius: its finite
        points are kept and the report says so.

    Raises:
        InputError: a parameter out of range, or Open3D asked for and not importable.
    """
    least = (4 if radius is None else 16) if min_neighbors is None else min_neighbors
    if least < 1 or (radius is not None and not radius > 0) or not radius_multiple > 0:
        raise InputError(f"ROR needs min_neighbors >= 1, radius > 0 and radius_multiple > 0, found {least}, {radius} "
                         f"and {radius_multiple}")
    chosen = _backend(backend)
    finite = cloud.finite_mask()
    points = cloud.points[finite].astype(np.float64)
    if radius is None:
        unit = median_neighbor_distance(cloud.points)
        radius = None if unit is None else radius_multiple * unit
    parameters: dict[str, Value] = {"radius": radius, "min_neighbors": least, "backend": chosen}
    if radius is None:
        reason = ("radius (no automatic one without two distinct points)",)
        return _spread_over(cloud, "ror", finite, np.ones(len(points), dtype=bool), parameters, reason)
    kept = np.zeros(len(points), dtype=bool)
    if chosen == "open3d" and len(points):
        kept[_open3d_cloud(points).remove_radius_outlier(least, radius)[1]] = True
    elif len(points):
        from scipy.spatial import cKDTree

        kept = cKDTree(points).query_ball_point(points, radius, return_length=True) > least
    return _spread_over(cloud, "ror", finite, kept, parameters)


def voxel_downsample(
    cloud: PointCloud, *, voxel_size: float | None = None, size_multiple: float = 2.0
) -> tuple[np.ndarray, FilterReport]:
    """Keep one point per voxel: the one nearest to the mean of the voxel's points, the first one on a tie.

    Exact duplicates fall into one voxel, so one of them stays.

    Args:
        cloud: any unit.
        voxel_size: edge length in the cloud's unit; None takes `size_multiple` times the median nearest-neighbour
            distance. The grid begins at the smallest coordinates.
        size_multiple: positive; used when `voxel_size` is None.

    Returns:
        `(N,)` bool, True = keep; the report. Without two distinct points an automatic size keeps one point.

    Raises:
        InputError: a size that is not positive, or so small that the grid has more than 2**62 cells along an axis.
    """
    if (voxel_size is not None and not voxel_size > 0) or not size_multiple > 0:
        raise InputError(f"voxels need a positive size, found {voxel_size} and multiple {size_multiple}")
    if voxel_size is None:
        unit = median_neighbor_distance(cloud.points)
        voxel_size = 1.0 if unit is None else size_multiple * unit
    finite = cloud.finite_mask()
    points = cloud.points[finite].astype(np.float64)
    cells = np.floor((points - points.min(axis=0, initial=np.inf)) / voxel_size)
    if cells.size and cells.max() > 2**62:
        raise InputError(f"voxel size {voxel_size:g} is too small for a cloud of extent {np.ptp(points):g}")
    _, voxel = np.unique(cells.astype(np.int64), axis=0, return_inverse=True)
    voxel = voxel.reshape(-1)
    count = np.bincount(voxel)
    mean = np.stack([np.bincount(voxel, points[:, axis]) / count for axis in range(3)], axis=1)
    order = np.lexsort((np.arange(len(points)), ((points - mean[voxel]) ** 2).sum(axis=1), voxel))
    first = np.ones(len(order), dtype=bool)
    first[1:] = voxel[order][1:] != voxel[order][:-1]
    kept = np.zeros(len(points), dtype=bool)
    kept[order[first]] = True
    return _spread_over(cloud, "voxel", finite, kept, {"voxel_size": voxel_size})


def range_filter(
    cloud: PointCloud,
    *,
    max_range: float | None = None,
    min_range: float = 0.0,
    center: Sequence[float] = (0.0, 0.0, 0.0),
    median_multiple: float = 20.0,
) -> tuple[np.ndarray, FilterReport]:
    """Keep the points whose distance from `center` lies within `[min_range, max_range]`.

    Args:
        cloud: any unit.
        max_range: in the cloud's unit; None takes `median_multiple` times the median distance from `center`.
        min_range: in the cloud's unit.
        center: xyz in the cloud's frame; the origin is the first camera.
        median_multiple: positive; used when `max_range` is None.

    Returns:
        `(N,)` bool, True = keep; the report.

    Raises:
        InputError: `max_range` below `min_range`, or `median_multiple` not positive.
    """
    if not median_multiple > 0:
        raise InputError(f"median_multiple must be positive, found {median_multiple}")
    finite = cloud.finite_mask()
    distance = np.linalg.norm(cloud.points[finite] - np.asarray(center, dtype=np.float64), axis=1)
    if max_range is None:
        max_range = max(min_range, median_multiple * float(np.median(distance)) if len(distance) else np.inf)
    if not max_range >= min_range:
        raise InputError(f"the range filter needs max_range >= min_range, found {max_range} and {min_range}")
    kept = (distance >= min_range) & (distance <= max_range)
    return _spread_over(cloud, "range", finite, kept, {"min_range": min_range, "max_range": max_range})


FILTERS: Mapping[str, Callable[..., tuple[np.ndarray, FilterReport]]] = {
    "quality": quality_filter,
    "sor": statistical_outlier,
    "ror": radius_outlier,
    "voxel": voxel_downsample,
    "range": range_filter,
}
"""The filters by the names that `clean_cloud` and the command lines use."""

DEFAULT_STEPS: tuple[str, ...] = ("quality", "sor")


def clean_cloud(
    cloud: PointCloud, steps: Sequence[str | tuple[str, Mapping[str, Any]]] = DEFAULT_STEPS
) -> tuple[PointCloud, list[FilterReport]]:
    """Apply filters one after the other.

    Args:
        cloud: stays as it is.
        steps: names out of `FILTERS`, or pairs of a name and the filter's keyword arguments.

    Returns:
        The cloud of the points that passed all filters, in their order; one report per step.

    Raises:
        InputError: an unknown name, or whatever the filter raises.
    """
    reports = []
    for step in steps:
        name, arguments = (step, {}) if isinstance(step, str) else step
        if name not in FILTERS:
            raise InputError(f"there is no filter {name!r}; choose from {', '.join(FILTERS)}")
        keep, report = FILTERS[name](cloud, **arguments)
        cloud = cloud.select(keep)
        reports.append(report)
    return cloud, reports


def _spread_over(
    cloud: PointCloud, name: str, finite: np.ndarray, kept: np.ndarray, parameters: dict[str, Value],
    skipped: tuple[str, ...] = (),
) -> tuple[np.ndarray, FilterReport]:
    """The mask over all points from the mask over the finite ones, with its report."""
    mask = np.zeros(len(cloud), dtype=bool)
    mask[finite] = kept
    removed = {"non-finite": int((~finite).sum()), name: int((~kept).sum())}
    return mask, FilterReport(name, len(cloud), int(mask.sum()), parameters, removed, skipped)


def _median_depth(depth: np.ndarray) -> float:
    positive = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(positive)) if len(positive) else 0.0


def _neighbor_distances(points: np.ndarray, count: int) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(points).query(points, k=count)[0].reshape(len(points), count)


def _backend(wanted: str) -> str:
    if wanted not in ("auto", "open3d", "scipy"):
        raise InputError(f"backend must be auto, open3d or scipy, found {wanted!r}")
    if wanted == "scipy":
        return wanted
    try:
        import_open3d("install it and the system library it names, or choose the scipy backend, which follows the same "
                      "rule")
    except InputError:
        if wanted == "open3d":
            raise
        return "scipy"
    return "open3d"


def _open3d_cloud(points: np.ndarray) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
