"""Poses at any time of a trajectory, and the choice of reference views along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from devo.poses import invert_poses_numpy, matrix_to_pose
from utils.emvs.settings import EmvsSettings
from utils.trajectory_io import Trajectory

FloatArray = npt.NDArray[np.float64]
_LEAST_COVERAGE = 1e-3  # of the events' time; seconds read as microseconds cover 1e-6


class PoseTrack:
    """A trajectory that can be asked at any time between its first and last pose.

    Positions are interpolated linearly and rotations along the shortest arc (slerp), each on its own.

    Args:
        trajectory: camera to world.

    Raises:
        InputError: fewer than two poses.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        if len(trajectory) < 2:
            raise InputError(f"the trajectory has {len(trajectory)} pose(s), expected at least 2 to interpolate")
        from scipy.spatial.transform import Rotation, Slerp

        self.trajectory = trajectory
        self.t_us = trajectory.t_us.astype(np.float64)
        self._rotation = Slerp(self.t_us - self.t_us[0], Rotation.from_quat(trajectory.world_T_cam[:, 3:]))

    def __call__(self, t_us: npt.ArrayLike) -> FloatArray:
        """`(N, 4, 4)` float64 camera-to-world matrices at `(N,)` microseconds.

        Raises:
            InputError: a time before the first or after the last pose; nothing is extrapolated.
        """
        times = np.atleast_1d(np.asarray(t_us, np.float64))
        outside = ~((times >= self.t_us[0]) & (times <= self.t_us[-1]))
        if outside.any():
            raise InputError(f"no pose at {times[outside][0]:.0f} us: the trajectory spans {self.t_us[0]:.0f} us to "
                             f"{self.t_us[-1]:.0f} us and is not extrapolated")
        matrices = np.tile(np.eye(4), (len(times), 1, 1))
        if len(times):
            matrices[:, :3, :3] = self._rotation(times - self.t_us[0]).as_matrix()
            for axis in range(3):
                matrices[:, axis, 3] = np.interp(times, self.t_us, self.trajectory.world_T_cam[:, axis])
        return matrices

    def inverted(self) -> PoseTrack:
        """The track that results if the poses are mistaken for their inverses."""
        return PoseTrack(Trajectory(self.trajectory.t_us, invert_poses_numpy(self.trajectory.world_T_cam)))

    def knots_between(self, start_us: float, stop_us: float) -> FloatArray:
        """Times of the poses strictly inside a span, and the two ends of the span itself."""
        inside = self.t_us[(self.t_us > start_us) & (self.t_us < stop_us)]
        return np.concatenate([[start_us], inside, [stop_us]])


@dataclass(frozen=True)
class Span:
    """The events of one reference view.

    Attributes:
        start_us, stop_us: events with `start_us <= t < stop_us`.
        reference_us: time whose pose is the reference view.
    """

    start_us: float
    stop_us: float
    reference_us: float


def common_span(track: PoseTrack, first_us: float, last_us: float) -> tuple[float, float]:
    """First and last time that events and poses share.

    Args:
        track: poses.
        first_us, last_us: stamps of the first and last event of the window.

    Raises:
        InputError: they share no time, or so little that the stamps must be in different units.
    """
    start, stop = max(first_us, track.t_us[0]), min(last_us, track.t_us[-1])
    if not start < stop:
        raise InputError(f"poses span {track.t_us[0]:.0f} us to {track.t_us[-1]:.0f} us, events {first_us:.0f} us to "
                         f"{last_us:.0f} us: they do not overlap; check the unit of the pose stamps (--pose_format), "
                         "the clocks and --start_time_s / --stop_time_s")
    if stop - start < _LEAST_COVERAGE * (last_us - first_us):
        raise InputError(f"poses span {track.t_us[0]:.6g} us to {track.t_us[-1]:.6g} us, only "
                         f"{100 * (stop - start) / (last_us - first_us):.5f} % of the time of the events; check the "
                         "unit of the pose stamps (--pose_format)")
    return float(start), float(stop)


def choose_spans(track: PoseTrack, start_us: float, stop_us: float, settings: EmvsSettings,
                 mean_depth: float) -> tuple[list[Span], int]:
    """Divide a stretch of the trajectory among reference views.

    "fixed" gives one view, at the middle of the stretch. "baseline" starts a new one whenever the camera has moved by
    `view_baseline * mean_depth` or turned by `view_angle_deg` since the last began; the reference pose is the one at
    the middle of each span. Spans in which the camera moves less than `min_view_baseline * mean_depth` are left out.

    Args:
        track: poses.
        start_us, stop_us: see `common_span`.
        settings: which rule.
        mean_depth: typical depth of the scene in the unit of the poses.

    Returns:
        The spans, and how many were left out.

    Raises:
        InputError: the camera hardly moves, so that depth cannot be seen.
    """
    times = track.knots_between(start_us, stop_us)
    poses = track(times)
    borders = [0, len(times) - 1] if settings.reference == "fixed" else _borders(poses, settings, mean_depth)
    spans, still = [], 0
    for first, last in zip(borders[:-1], borders[1:]):
        centers = poses[first:last + 1, :3, 3]
        moved = float(np.linalg.norm(centers - centers[0], axis=1).max())
        if moved <= settings.min_view_baseline * mean_depth:
            still += 1
            continue
        begin, end = float(times[first]), float(times[last])
        # the event on the last stamp of all belongs to the last span
        spans.append(Span(begin, end + 1 if last == len(times) - 1 else end, (begin + end) / 2))
    if not spans:
        extent = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
        raise InputError(f"the camera moves by {extent:.3g} only, at a scene depth of about {mean_depth:.3g}: without "
                         "parallax there is no depth; use a longer window (or a smaller --min_view_baseline)")
    return spans, still


def _borders(poses: FloatArray, settings: EmvsSettings, mean_depth: float) -> list[int]:
    """Indices of the poses at which views begin and end."""
    borders = [0]
    while borders[-1] < len(poses) - 1:
        start = poses[borders[-1]]
        rest = poses[borders[-1] + 1:]
        moved = np.linalg.norm(rest[:, :3, 3] - start[:3, 3], axis=1) >= settings.view_baseline * mean_depth
        cosine = (np.einsum("ij,nij->n", start[:3, :3], rest[:, :3, :3]) - 1) / 2
        turned = np.arccos(np.clip(cosine, -1, 1)) >= np.radians(settings.view_angle_deg)
        ends = np.flatnonzero(moved | turned)
        borders.append(borders[-1] + 1 + int(ends[0]) if len(ends) else len(poses) - 1)
    return borders


def pose_vector(world_T_view: FloatArray) -> FloatArray:
    """`(7,)` `tx ty tz qx qy qz qw` of a (4, 4) matrix."""
    return matrix_to_pose(world_T_view)


def depth_range_from_points(points: npt.ArrayLike, world_T_view: FloatArray, camera_focal: float,
                            size: tuple[int, int]) -> tuple[float, float]:
    """Depth range of a sparse cloud in a view: 0.8 times the 5th to 1.2 times the 95th percentile of its depths.

    Args:
        points: `(N, 3)` world points in the unit of the poses; rows that are not finite are left out.
        world_T_view: `(4, 4)` reference view.
        camera_focal: focal length of the reference view in pixels.
        size: (width, height) of the reference view; only points that project into it count.

    Raises:
        InputError: no point lies in the view.
    """
    world = np.asarray(points, np.float64)
    world = world[np.isfinite(world).all(axis=1)]
    seen = (world - world_T_view[:3, 3]) @ world_T_view[:3, :3]
    z = seen[:, 2]
    limit = np.array(size) / (2 * camera_focal)
    inside = (z > 0) & (np.abs(seen[:, :2]) <= limit * z[:, None]).all(axis=1)
    if not inside.any():
        raise InputError(f"none of the {len(world)} finite points of the cloud lies in the reference view, so they "
                         "give no depth range; check that cloud and poses share a frame, or give --min_depth and "
                         "--max_depth")
    low, high = np.percentile(z[inside], (5, 95))
    return 0.8 * float(low), 1.2 * float(high)
