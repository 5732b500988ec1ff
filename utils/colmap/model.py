"""The model: what COLMAP knows of a reconstruction, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.colmap.observations import Observations
from utils.trajectory_io import inverted, rotation_matrices

FloatArray = npt.NDArray[np.float64]
PIXEL_CENTER = 0.5
"""COLMAP puts (0, 0) at the corner of the first pixel, this project at its centre."""


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """One pinhole camera, images with poses, points with tracks. Pixels are those of COLMAP.

    Attributes:
        size: (width, height) in pixels.
        intrinsics: `fx fy cx cy`.
        names: file name of each of the F images.
        cam_T_world: `(F, 7)` float64 world to camera `tx ty tz qx qy qz qw`.
        points: `(N, 3)` float64 world points.
        colors: `(N, 3)` uint8 red, green, blue.
        errors: `(N,)` float64 mean reprojection error over the track in pixels.
        point: `(E,)` int64 point of each observation; sorted, every point has at least one.
        image: `(E,)` int64 image of each observation.
        pixel_xy: `(E, 2)` float64 measured position.
        slot: `(E,)` int64 number of the observation within its image.
    """

    size: tuple[int, int]
    intrinsics: FloatArray
    names: Sequence[str]
    cam_T_world: FloatArray  # noqa: N815 - the frame notation of the project
    points: FloatArray
    colors: npt.NDArray[np.uint8]
    errors: FloatArray
    point: npt.NDArray[np.int64]
    image: npt.NDArray[np.int64]
    pixel_xy: FloatArray
    slot: npt.NDArray[np.int64]

    def track_lengths(self) -> npt.NDArray[np.int64]:
        """`(N,)` observations of each point."""
        return np.bincount(self.point, minlength=len(self.points))

    def of_images(self) -> list[npt.NDArray[np.int64]]:
        """Rows of the observations of each image, in the order of `slot`."""
        order = np.argsort(self.image, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.image, minlength=len(self.names)))[:-1])


@dataclass(frozen=True)
class TrackRules:
    """Which observations and points go into the model.

    Attributes:
        max_error_px: observations farther from the reprojected point are left out.
        min_length: points with fewer observations are left out.
        scale: factor on translations and points.
    """

    max_error_px: float = 4.0
    min_length: int = 2
    scale: float = 10.0

    def __post_init__(self) -> None:
        if not self.max_error_px > 0 or self.min_length < 1 or not 0 < self.scale < np.inf:
            raise InputError("tracks need max_error_px > 0, min_length >= 1 and scale > 0, found "
                             f"{self.max_error_px:g}, {self.min_length} and {self.scale:g}")


def build_model(cloud: PointCloud, observations: Observations, world_T_cam: npt.ArrayLike, names: Sequence[str],
                intrinsics: npt.ArrayLike, size: tuple[int, int], rules: TrackRules | None = None) -> ColmapModel:
    """Make the model of a run.

    Args:
        cloud: the raw cloud that `observations` counts by.
        observations: where its points were measured.
        world_T_cam: `(F, 7)` camera-to-world poses of all frames.
        names: `(F,)` names of the images.
        intrinsics: `fx fy cx cy` of the undistorted image; (0, 0) is the centre of the first pixel.
        size: (width, height) of that image.
        rules: what is left out; None takes the defaults.

    Raises:
        InputError: cloud, observations, poses and names do not fit together, or no point is left.
    """
    rules = rules or TrackRules()
    poses = inverted(np.asarray(world_T_cam, dtype=np.float64))
    _check_fit(cloud, observations, poses, names)
    camera = np.asarray(intrinsics, dtype=np.float64)
    error = reprojection_errors(cloud.points.astype(np.float64), poses, camera, observations)
    good = error <= rules.max_error_px  # false for points behind a camera
    lengths = np.bincount(observations.point[good], minlength=len(cloud))
    kept = (lengths >= rules.min_length) & cloud.finite_mask()
    if not kept.any():
        raise InputError(f"none of the {len(cloud)} points has {rules.min_length} observations within "
                         f"{rules.max_error_px:g} px; lower --min_track or raise --max_error_px")
    used = good & kept[observations.point]
    number = np.cumsum(kept) - 1
    point = number[observations.point[used]]
    colors = cloud.colors if cloud.colors is not None else np.full((len(cloud), 3), 128, np.uint8)
    poses[:, :3] *= rules.scale
    image = observations.frame[used]
    return ColmapModel(
        size, camera + [0.0, 0.0, PIXEL_CENTER, PIXEL_CENTER], list(names), poses,
        cloud.points[kept].astype(np.float64) * rules.scale, colors[kept],
        np.bincount(point, error[used]) / np.bincount(point), point, image,
        observations.pixel_xy[used].astype(np.float64) + PIXEL_CENTER, _numbers_within(image))


def reprojection_errors(points: FloatArray, cam_T_world: FloatArray, intrinsics: FloatArray,
                        observations: Observations) -> FloatArray:
    """`(E,)` distance in pixels between measured and reprojected position; infinite behind the camera."""
    rotations = rotation_matrices(cam_T_world[:, 3:])[observations.frame]
    seen = np.einsum("eij,ej->ei", rotations, points[observations.point]) + cam_T_world[observations.frame, :3]
    fx, fy, cx, cy = intrinsics
    front = seen[:, 2] > 0
    depth = np.where(front, seen[:, 2], 1.0)
    predicted = seen[:, :2] / depth[:, None] * [fx, fy] + [cx, cy]
    return np.where(front, np.linalg.norm(predicted - observations.pixel_xy, axis=1), np.inf)


def _numbers_within(labels: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Running number of each entry among the entries of the same label."""
    order = np.argsort(labels, kind="stable")
    counts = np.bincount(labels)
    result = np.empty(len(labels), np.int64)
    result[order] = np.arange(len(labels)) - np.repeat(np.cumsum(counts) - counts, counts)
    return result


def _check_fit(cloud: PointCloud, observations: Observations, poses: FloatArray, names: Sequence[str]) -> None:
    if observations.points != len(cloud):
        raise InputError(f"the observations are of a cloud of {observations.points} points, found {len(cloud)}; use "
                         "the raw cloud of the same run")
    frames = int(observations.frame.max(initial=-1)) + 1
    if len(poses) != len(names) or frames > len(poses):
        raise InputError(f"{len(names)} image names and observations in {frames} frames for {len(poses)} poses")
    if not np.isfinite(poses).all():
        raise InputError("some poses are not finite; the run was not initialised")
    bad = [name for name in names if not name or any(c.isspace() for c in name)]
    if bad or len(set(names)) != len(names):
        raise InputError(f"image names must differ and hold no blanks, found {(bad or ['a name twice'])[0]!r}")
