"""Agreement of two clouds, planarity, and errors against true depth; all lengths in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from evals.image_metrics import DepthErrors, relative_depth_errors, summarise_depth_errors
from evals.pointcloud_metrics import (
    ChamferDistance,
    IcpResult,
    OverlapScore,
    PlaneFit,
    chamfer_distance,
    fit_plane,
    fit_plane_robust,
    icp,
    nearest_distances,
    overlap_scores,
)
from evals.validation.source import DepthMaps
from utils.emvs.geometry import FloatArray
from utils.emvs.views import PoseTrack

_LEAST_POINTS = 3
PLANE_SHARE = 0.01
"""Distance from the robust plane, relative to that of the scene, up to which a point counts as on it."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """An EMVS map (source) against the exported cloud (target), before and after rigid ICP.

    The paper calls the share of *source* points near the target precision and the share of *target* points near the
    source recall. Read the other way round, as a judgement on the exported cloud, recall is its accuracy and precision
    its completeness; both are reported.

    Attributes:
        name: which two clouds.
        chamfer, scores: by stage, `before ICP` and `after ICP`; scores by threshold in metres.
        distances: by stage, nearest-neighbour distances from source to target and from target to source.
        icp: its outcome; None where no points are near enough to start it.
    """

    name: str
    chamfer: dict[str, ChamferDistance]
    scores: dict[str, list[OverlapScore]]
    distances: dict[str, tuple[FloatArray, FloatArray]]
    icp: IcpResult | None

    def score(self, stage: str, threshold_m: float) -> OverlapScore:
        """The scores at one of the thresholds."""
        return next(score for score in self.scores[stage] if np.isclose(score.threshold, threshold_m))


@dataclass(frozen=True, eq=False)
class Planarity:
    """How flat a cloud is: a least-squares plane through everything, and one through most of it.

    Attributes:
        name: of the cloud.
        least_squares, robust: the two fits, metres.
        threshold_m: distance up to which a point counts as an inlier of the robust plane.
    """

    name: str
    least_squares: PlaneFit
    robust: PlaneFit
    threshold_m: float


def compare(name: str, source: FloatArray, target: FloatArray, thresholds_m: Sequence[float],
            icp_limit_m: float) -> Agreement:
    """Measure source against target before and after ICP (rigid, from the identity, 50 iterations at most).

    Raises:
        InputError: a cloud with fewer than three points, or points that are not finite.
    """
    for label, cloud in (("first", source), ("second", target)):
        if len(cloud) < _LEAST_POINTS:
            raise InputError(f"{name}: the {label} cloud has {len(cloud)} points, at least {_LEAST_POINTS} are needed; "
                             "see the maps in the report folder and lower --emvs_threshold")
    stages = {"before ICP": source}
    found = None
    if (nearest_distances(source, target) <= icp_limit_m).sum() >= _LEAST_POINTS:
        found = icp(source, target, icp_limit_m)
        stages["after ICP"] = found.transform.apply(source)
    return Agreement(
        name, {stage: chamfer_distance(cloud, target) for stage, cloud in stages.items()},
        {stage: overlap_scores(cloud, target, sorted(thresholds_m)) for stage, cloud in stages.items()},
        {stage: (nearest_distances(cloud, target), nearest_distances(target, cloud))
         for stage, cloud in stages.items()}, found)


def planarity(name: str, points: FloatArray, distance_m: float) -> Planarity:
    """Fit planes to a cloud.

    Args:
        name: what to call the cloud.
        points: `(N, 3)` metres.
        distance_m: distance of the scene; inliers of the robust plane lie within a hundredth of it.

    Raises:
        InputError: the points determine no plane.
    """
    threshold = PLANE_SHARE * distance_m
    return Planarity(name, fit_plane(points), fit_plane_robust(points, threshold), threshold)


def plane_distances(points: FloatArray, plane: PlaneFit) -> FloatArray:
    """`(N,)` signed distances of points from a plane."""
    return np.asarray((points - plane.centroid) @ plane.normal, np.float64)


def true_plane(depth: DepthMaps, track: PoseTrack, t_us: float, threshold_m: float) -> PlaneFit:
    """The plane that most of a true depth map lies on, in the frame of the ground truth."""
    points = surface_points(depth, track, depth.nearest(t_us))
    return fit_plane_robust(points, threshold_m)


def surface_points(depth: DepthMaps, track: PoseTrack, number: int, most: int = 4000) -> FloatArray:
    """Up to `most` evenly chosen points `(N, 3)` of a true depth map, in the frame of the ground truth.

    Raises:
        InputError: the map has no depth.
    """
    image = depth.load(number)
    row, column = np.nonzero(np.isfinite(image) & (image > 0))
    if not len(row):
        raise InputError(f"{depth.paths[number]}: no pixel has a depth")
    chosen = np.linspace(0, len(row) - 1, min(most, len(row))).astype(np.int64)
    row, column = row[chosen], column[chosen]
    fx, fy, cx, cy = depth.intrinsics
    z = image[row, column].astype(np.float64)
    seen = np.stack([(column - cx) / fx * z, (row - cy) / fy * z, z], axis=1)
    world_T_cam = track(_inside(track, depth.t_us[number]))[0]
    return np.asarray(seen @ world_T_cam[:3, :3].T + world_T_cam[:3, 3], np.float64)


@dataclass(frozen=True, eq=False)
class DepthJudgement:
    """Points against the true depth map nearest in time to the view that each point comes from.

    Attributes:
        errors: `(N,)` signed relative depth errors, NaN where the depth map cannot judge.
        corrected: `(M, 3)` the judged points, moved along their rays to the true depth.
        summary: figures of the errors.
    """

    errors: FloatArray
    corrected: FloatArray
    summary: DepthErrors


def judge_depth(points: FloatArray, t_us: npt.ArrayLike, depth: DepthMaps, track: PoseTrack) -> DepthJudgement:
    """Compare points with true depth.

    Args:
        points: `(N, 3)` metres in the frame of the ground truth.
        t_us: `(N,)` or one time: when the camera that made the point saw it.
        depth: true depth.
        track: true poses.
    """
    stamps = np.broadcast_to(np.asarray(t_us, np.float64), (len(points),))
    numbers = np.array([depth.nearest(stamp) for stamp in np.unique(stamps)], np.int64)
    per_point = numbers[np.searchsorted(np.unique(stamps), stamps)]
    errors, centers = np.full(len(points), np.nan), np.zeros((len(points), 3))
    for number in np.unique(per_point):  # one depth map after the other
        mine = per_point == number
        world_T_cam = track(_inside(track, depth.t_us[number]))[0]
        errors[mine] = relative_depth_errors(points[mine], world_T_cam, depth.intrinsics, depth.load(int(number)))
        centers[mine] = world_T_cam[:3, 3]
    known = np.isfinite(errors)
    corrected = centers[known] + (points[known] - centers[known]) / (1 + errors[known, None])
    return DepthJudgement(errors, corrected, summarise_depth_errors(errors))


def _inside(track: PoseTrack, t_us: float) -> float:
    return float(np.clip(t_us, track.t_us[0], track.t_us[-1]))
