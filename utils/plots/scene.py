"""What a picture shows: the points without far outliers, the camera's path, and a box around both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.plots.coloring import ARBITRARY, Coloring, color_cloud
from utils.trajectory_io import rotation_matrices

FloatArray = npt.NDArray[np.float64]
MOST_POINTS = 80_000
MOST_FRUSTA = 14
FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))
"""Pairs of corners of a camera pyramid: 0 is the centre, 1..4 go around the image from its top left corner."""
_FRUSTUM = np.array([[0, 0, 0], [-2, -1.5, 3], [2, -1.5, 3], [2, 1.5, 3], [-2, 1.5, 3]]) / 3


@dataclass(frozen=True, eq=False)
class Scene:
    """Cloud and path in world coordinates (first camera: x right, y down, z forward), ready to be drawn.

    Attributes:
        cloud: the points that are drawn: finite, inside the box, at most `MOST_POINTS` unless asked otherwise.
        coloring: their values.
        poses: `(T, 7)` float64 camera to world, finite ones only.
        low, high: `(3,)` corners of the box.
        total, outside, nonfinite: points of the whole cloud, beyond the box, and without coordinates.
        unit: what one unit of length is.
        shows_outside: whether the points beyond the box are among those that are drawn.
        frustum: `(5, 3)` corners of a camera pyramid in its own frame, see `camera_pyramid`.
    """

    cloud: PointCloud
    coloring: Coloring
    poses: FloatArray
    low: FloatArray
    high: FloatArray
    total: int
    outside: int
    nonfinite: int
    unit: str
    shows_outside: bool
    frustum: FloatArray

    @staticmethod
    def build(cloud: PointCloud, world_T_cam: npt.ArrayLike, color_by: str = "depth", *, unit: str = ARBITRARY,
              most_points: int = MOST_POINTS, show_outside: bool = False, pyramid: FloatArray | None = None,
              frustum_scale: float | None = None, robust: bool = True) -> Scene:
        """Choose what is shown.

        Args:
            cloud: may be empty.
            world_T_cam: `(T, 7)` camera-to-world poses; T may be 0, poses that are not finite are left out.
            color_by: see `color_cloud`.
            unit: what one unit of length is.
            most_points: points beyond this number are thinned out evenly.
            show_outside: draw the points beyond the box too (they are counted in any case).
            pyramid: shape of the cameras, see `camera_pyramid`; None takes one of 4:3.
            frustum_scale: length of the camera pyramids; None chooses one by the size of the scene.
            robust: leave the far tails of the points out of the box.

        Raises:
            InputError: poses of another shape, an unknown colouring, or a length that is not positive.
        """
        poses = np.asarray(world_T_cam, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] != 7:
            raise InputError(f"world_T_cam must have shape (T, 7), found {poses.shape}")
        poses = poses[np.isfinite(poses).all(axis=1)]
        finite = cloud.select(cloud.finite_mask())
        low, high = box_around(finite.points, poses[:, :3], robust)
        inside: npt.NDArray[np.bool_] = np.all((finite.points >= low) & (finite.points <= high), axis=1)
        drawn = finite if show_outside else finite.select(inside)
        drawn = drawn.select(np.linspace(0, len(drawn) - 1, min(len(drawn), most_points)).astype(np.int64))
        length = _pyramid_length(low, high) if frustum_scale is None else frustum_scale
        if not (0 < length < np.inf):
            raise InputError(f"camera pyramids need a positive length, found {length:g}")
        return Scene(drawn, color_cloud(drawn, color_by, unit), poses, low, high, len(cloud), int((~inside).sum()),
                     len(cloud) - len(finite), unit, show_outside, length * (_FRUSTUM if pyramid is None else pyramid))

    @property
    def points(self) -> FloatArray:
        """`(N, 3)` float64 world points that are drawn."""
        return self.cloud.points.astype(np.float64)

    @property
    def left_out(self) -> int:
        """How many points that could be drawn were thinned out."""
        return self.total - self.nonfinite - (0 if self.shows_outside else self.outside) - len(self.cloud)

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal."""
        return float(np.linalg.norm(self.high - self.low))

    def frusta(self, most: int = MOST_FRUSTA) -> FloatArray:
        """`(F, 5, 3)` world corners of up to `most` camera pyramids, spread evenly over the trajectory."""
        count = min(most, len(self.poses))
        poses = self.poses[np.linspace(0, len(self.poses) - 1, count).astype(np.int64)]
        return place_pyramids(poses, self.frustum)

    def describe(self) -> list[str]:
        """Remarks for the margin of a picture: scale, frame, and what is not shown."""
        notes = ["monocular: arbitrary scale"] if self.unit == ARBITRARY else []
        notes += ["world frame = first camera (x right, y down, z forward)"]
        if self.outside:
            where = "far off" if self.shows_outside else "outside the view"
            notes.append(f"{counted(self.outside, 'point')} {where}")
        if self.nonfinite:
            notes.append(f"{counted(self.nonfinite, 'non-finite point')} left out")
        if self.left_out:
            notes.append(f"{len(self.cloud):,} points drawn")
        return notes

    def summary(self) -> str:
        """Numbers of points and poses and the length of the path."""
        steps = np.linalg.norm(np.diff(self.poses[:, :3], axis=0), axis=1)
        parts = [counted(self.total, "point")]
        if len(self.poses):
            length = f"path length {steps.sum():.3g} {'units' if self.unit == ARBITRARY else self.unit}"
            parts += [counted(len(self.poses), "pose"), length]
        return "    ".join(parts)


def box_around(points: npt.NDArray[np.floating], centers: FloatArray,
               robust: bool = True) -> tuple[FloatArray, FloatArray]:
    """Corners of the box that is shown: camera centres `(T, 3)`, and points `(N, 3)` (robust: without far tails)."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    if len(points) and not robust:
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    elif len(points):
        p1, p10, p90, p99 = np.percentile(points.astype(np.float64), (1, 10, 90, 99), axis=0)
        reach = 0.4 * (p90 - p10)  # holds 99 % of a normal distribution
        low, high = np.maximum(p1, p10 - reach), np.minimum(p99, p90 + reach)
    if len(centers):
        low, high = np.minimum(low, centers.min(axis=0)), np.maximum(high, centers.max(axis=0))
    if not len(points) and not len(centers):
        low, high = np.full(3, -1.0), np.full(3, 1.0)
    margin = 0.06 * float((high - low).max()) or 1.0
    return low - margin, high + margin


def camera_pyramid(intrinsics: npt.ArrayLike, width: int, height: int) -> FloatArray:
    """`(5, 3)` centre and image corners of a pinhole camera at distance 1, in its own frame.

    Args:
        intrinsics: `fx fy cx cy` in pixels.
        width, height: of the image in pixels.

    Raises:
        InputError: numbers that no camera has.
    """
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0 and width > 0 and height > 0):
        raise InputError(f"no camera has fx={fx:g} fy={fy:g} cx={cx:g} cy={cy:g} and {width}x{height} pixels")
    left, right, top, bottom = -cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy
    return np.array([[0, 0, 0], [left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]])


def place_pyramids(world_T_cam: FloatArray, pyramid: FloatArray) -> FloatArray:
    """`(F, 5, 3)` world corners of a camera pyramid `(5, 3)` at the poses `(F, 7)`; no quaternion means no rotation."""
    norm = np.linalg.norm(world_T_cam[:, 3:], axis=1, keepdims=True)
    unit = np.where(norm > 0, world_T_cam[:, 3:] / np.where(norm > 0, norm, 1.0), [0.0, 0.0, 0.0, 1.0])
    return np.einsum("fij,pj->fpi", rotation_matrices(unit), pyramid) + world_T_cam[:, None, :3]


def _pyramid_length(low: FloatArray, high: FloatArray) -> float:
    """Small against the scene, and smaller in long, narrow ones."""
    extent = high - low
    return 0.045 * float(np.sqrt(np.linalg.norm(extent) * np.median(extent)))


def counted(number: int, noun: str) -> str:
    """`1 point`, `2,500 points`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
