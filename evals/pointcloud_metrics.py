"""How alike two point clouds are, and how flat one is.

Distances are in the unit of the clouds, which is arbitrary for monocular reconstructions: state thresholds in the
same unit. Every function refuses empty clouds and non-finite rows, because leaving points out would change the
result; `PointCloud.finite_mask` and `select` remove them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devo.errors import InputError
from evals.alignment import Similarity
from utils.clouds.open3d_import import import_open3d

ICP_REMEDY = "install it and the system library it names, ICP needs it"
_BATCH = 2_000_000  # distances per step of the plane search: 16 MB


@dataclass(frozen=True)
class ChamferDistance:
    """Mean nearest-neighbour distances, not squared, in the clouds' unit.

    Attributes:
        source_to_target: mean over source points of the distance to the target.
        target_to_source: mean over target points of the distance to the source.
        symmetric: mean of the two.
    """

    source_to_target: float
    target_to_source: float
    symmetric: float


@dataclass(frozen=True)
class OverlapScore:
    """Shares of points that have a neighbour in the other cloud nearer than `threshold` (strictly).

    With the paper's choice, source = EMVS cloud and target = exported cloud of the odometry.

    Attributes:
        threshold: in the clouds' unit.
        precision: share of *source* points near the target.
        recall: share of *target* points near the source.
        f_score: harmonic mean of the two; 0 where both are 0.
    """

    threshold: float
    precision: float
    recall: float
    f_score: float


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """A plane and how far the points are from it, in the cloud's unit.

    Attributes:
        centroid: `(3,)` point on the plane: mean of its inliers, projected onto it.
        normal: `(3,)` unit normal, its largest component positive.
        rmse: root mean square distance of all points.
        median_distance: median distance of all points.
        inlier_share: share of points within the threshold (1 for the least-squares fit).
        inlier_rmse: root mean square distance of those points.
    """

    centroid: np.ndarray
    normal: np.ndarray
    rmse: float
    median_distance: float
    inlier_share: float
    inlier_rmse: float


@dataclass(frozen=True, eq=False)
class IcpResult:
    """Outcome of an ICP registration.

    Attributes:
        transform: brings the source onto the target.
        fitness: share of source points with a target point within the correspondence limit, at the end.
        inlier_rmse: root mean square distance of those pairs, in the clouds' unit.
        rotation_deg: angle of the rotation.
        translation_norm: length of the translation, in the clouds' unit.
    """

    transform: Similarity
    fitness: float
    inlier_rmse: float
    rotation_deg: float
    translation_norm: float


def nearest_distances(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distance from each source point to the nearest target point.

    Args:
        source: `(N, 3)`, N >= 1.
        target: `(M, 3)`, M >= 1, same frame and unit.

    Returns:
        `(N,)` float64.

    Raises:
        InputError: wrong shape, empty cloud, non-finite rows.
    """
    from scipy.spatial import cKDTree

    source, target = _checked(source, "source"), _checked(target, "target")
    return np.asarray(cKDTree(target).query(source)[0], dtype=np.float64)


def chamfer_distance(source: np.ndarray, target: np.ndarray) -> ChamferDistance:
    """Chamfer distances of two clouds `(N, 3)` and `(M, 3)`; see `nearest_distances` for errors."""
    forward = float(nearest_distances(source, target).mean())
    backward = float(nearest_distances(target, source).mean())
    return ChamferDistance(forward, backward, (forward + backward) / 2)


def overlap_scores(
    source: np.ndarray, target: np.ndarray, thresholds: float | Sequence[float]
) -> list[OverlapScore]:
    """Precision, recall and F-score of two clouds `(N, 3)` and `(M, 3)`, one result per threshold.

    Raises:
        InputError: a threshold that is not positive; otherwise as `nearest_distances`.
    """
    limits = np.atleast_1d(np.asarray(thresholds, dtype=np.float64))
    if not (limits > 0).all():
        raise InputError(f"thresholds must be positive, found {limits.tolist()}")
    forward, backward = nearest_distances(source, target), nearest_distances(target, source)
    scores = []
    for limit in limits.tolist():
        precision, recall = float((forward < limit).mean()), float((backward < limit).mean())
        total = precision + recall
        scores.append(OverlapScore(limit, precision, recall, 2 * precision * recall / total if total > 0 else 0.0))
    return scores


def fit_plane(points: np.ndarray) -> PlaneFit:
    """Total-least-squares plane through all points `(N, 3)`: centroid and direction of least variance.

    Raises:
        InputError: fewer than 3 points, points on one line, wrong shape, non-finite rows.
    """
    points = _checked(points, "points")
    centroid, normal = _least_squares_plane(points)
    return _describe_plane(points, centroid, normal, np.ones(len(points), dtype=bool))


def fit_plane_robust(points: np.ndarray, threshold: float, *, iterations: int = 1000, seed: int = 0) -> PlaneFit:
    """The plane with most points within `threshold`, found by RANSAC and refined by least squares on these points.

    Args:
        points: `(N, 3)`.
        threshold: largest distance of an inlier, in the points' unit (the paper's validation: 0.01).
        iterations: number of random triples.
        seed: same seed, same result.

    Raises:
        InputError: as `fit_plane`; or threshold or iterations not positive.
    """
    points = _checked(points, "points")
    if not threshold > 0 or iterations < 1:
        raise InputError(f"threshold and iterations must be positive, found {threshold} and {iterations}")
    centroid, normal = _least_squares_plane(points)  # also refuses what has no plane
    planes = np.concatenate([np.append(normal, normal @ centroid)[None], _random_planes(points, iterations, seed)])
    step = max(1, _BATCH // len(points))
    counts = np.concatenate([
        (np.abs(points @ part[:, :3].T - part[:, 3]) <= threshold).sum(axis=0)
        for part in np.split(planes, range(step, len(planes), step))
    ])
    best = planes[int(counts.argmax())]
    normal, offset = best[:3], best[3]
    inliers = np.abs(points @ normal - offset) <= threshold
    for _ in range(10):  # of all planes through the inliers the least-squares one is wanted, not the most inclusive
        if not _spans_plane(points[inliers]):
            break
        centroid, normal = _least_squares_plane(points[inliers])
        offset = normal @ centroid
        near = np.abs(points @ normal - offset) <= threshold
        if (near == inliers).all():
            break
        inliers = near
    middle = points[inliers].mean(axis=0) if inliers.any() else points.mean(axis=0)
    return _describe_plane(points, middle - (middle @ normal - offset) * normal, normal, inliers)


def icp(
    source: np.ndarray,
    target: np.ndarray,
    max_distance: float,
    *,
    with_scale: bool = False,
    max_iterations: int = 50,
    relative_change: float = 1e-6,
) -> IcpResult:
    """Point-to-point ICP from the identity, with Open3D (Besl and McKay 1992).

    Args:
        source: `(N, 3)`, N >= 3.
        target: `(M, 3)`, M >= 3, same unit.
        max_distance: correspondence limit in the clouds' unit (the paper's validation: 0.05).
        with_scale: estimate the scale too.
        max_iterations: upper limit.
        relative_change: stop when fitness and inlier error change by less.

    Raises:
        InputError: fewer than 3 points, non-finite rows, a limit that is not positive, or no correspondence within it;
            also where Open3D cannot be imported.
    """
    source, target = _checked(source, "source", least=3), _checked(target, "target", least=3)
    if not max_distance > 0 or max_iterations < 1:
        raise InputError(f"max_distance and max_iterations must be positive, found {max_distance}, {max_iterations}")
    if not (nearest_distances(source, target) <= max_distance).any():
        raise InputError(f"no source point has a target point within {max_distance:g}; align the clouds roughly first "
                         "or raise the limit")
    open3d = import_open3d(ICP_REMEDY)
    registration = open3d.pipelines.registration
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target)]
    outcome = registration.registration_icp(
        *clouds, max_distance, np.eye(4),
        registration.TransformationEstimationPointToPoint(with_scale),
        registration.ICPConvergenceCriteria(relative_change, relative_change, max_iterations),
    )
    block = np.array(outcome.transformation[:3, :3])
    scale = float(np.cbrt(np.linalg.det(block)))
    transform = Similarity(scale, block / scale, np.array(outcome.transformation[:3, 3]))
    return IcpResult(transform, float(outcome.fitness), float(outcome.inlier_rmse), transform.angle_deg(),
                     float(np.linalg.norm(transform.translation)))


def _checked(points: np.ndarray, name: str, least: int = 1) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} must have shape (N, 3), found {points.shape}")
    if len(points) < least:
        raise InputError(f"{name} has {len(points)} points, at least {least} are needed")
    broken = int((~np.isfinite(points).all(axis=1)).sum())
    if broken:
        raise InputError(f"{name} has {broken} non-finite rows; remove them first")
    return points


def _random_planes(points: np.ndarray, count: int, seed: int) -> np.ndarray:
    """`(K, 4)` unit normals and offsets of planes through random triples; triples on one line are left out."""
    rows = np.random.default_rng(seed).integers(0, len(points), (count, 3))
    first, second, third = (points[rows[:, k]] for k in range(3))
    normals = np.cross(second - first, third - first)
    area = np.linalg.norm(normals, axis=1)
    normals, anchors = normals[area > 0] / area[area > 0, None], first[area > 0]
    return np.concatenate([normals, (normals * anchors).sum(axis=1, keepdims=True)], axis=1)


def _spans_plane(points: np.ndarray) -> bool:
    if len(points) < 3:
        return False
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(singular[1] > 1e-9 * singular[0])


def _least_squares_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid and unit normal."""
    if not _spans_plane(points):
        raise InputError(f"{len(points)} points that lie on one line, or fewer than 3, determine no plane")
    centroid = points.mean(axis=0)
    normal = np.linalg.svd(points - centroid, full_matrices=False)[2][2]
    return centroid, normal


def _describe_plane(points: np.ndarray, centroid: np.ndarray, normal: np.ndarray, inliers: np.ndarray) -> PlaneFit:
    distance = np.abs((points - centroid) @ normal)
    return PlaneFit(
        centroid=centroid,
        normal=normal * np.sign(normal[np.abs(normal).argmax()]),
        rmse=float(np.sqrt((distance**2).mean())),
        median_distance=float(np.median(distance)),
        inlier_share=float(inliers.mean()),
        inlier_rmse=float(np.sqrt((distance[inliers] ** 2).mean())) if inliers.any() else float("nan"),
    )
