"""Read back what an export wrote: the cloud, its poses and the description of the run, by the name of any of them.

Consumers (plots, viewer, COLMAP, ROS) go through here, so the convention of the poses is decided in one place: the
tag in the file or in `<base>_meta.json` wins; untagged files follow the published layout, in which `_poses.npy` and
TUM text are camera to world and the poses of a frame bundle (`_frames.npz`) are world to camera.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.clouds.arrays import load_array, load_arrays
from utils.clouds.cloud import PointCloud
from utils.clouds.io import SUFFIXES, read_cloud
from utils.trajectory_io import Trajectory, inverted, read_tum

if TYPE_CHECKING:
    from utils.frame_bundle import FrameBundle

CONVENTIONS = ("auto", "T_wc", "T_cw")
TIME_UNITS = ("auto", "s", "ms", "us", "ns")
_TAGS = {"T_world_cam": "T_wc", "T_cam_world": "T_cw"}
_PRODUCTS = ("_cleaned", "_focus_edges", "_edges", "_dpviewer", "_poses", "_observations", "_tstamps", "_frames",
             "_meta", "_depths", "_trajectory", "_zdepths")
_LONGEST_SECONDS = 1e5  # a recording of more than a day, or of less than a tenth of a second, is unlikely


@dataclass(frozen=True)
class FinishedRun:
    """The files of one export; `base` is the part of their names that they share."""

    base: Path

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> FinishedRun:
        """The run that a file belongs to, by its name: `results/board_cleaned.ply` belongs to `results/board`."""
        path = Path(path)
        stem = path.stem if path.suffix.lower() in (*SUFFIXES, ".json", ".txt") else path.name
        for ending in _PRODUCTS:
            if stem.endswith(ending) and stem != ending:
                stem = stem.removesuffix(ending)
                break
        return cls(path.with_name(stem))

    def file(self, ending: str) -> Path:
        """`<base><ending>`, whether it exists or not."""
        return self.base.with_name(self.base.name + ending)

    def meta(self) -> dict[str, Any]:
        """The description of the run; empty if there is none.

        Raises:
            InputError: the file exists and is no JSON object.
        """
        path = self.file("_meta.json")
        if not path.is_file():
            return {}
        try:
            meta = json.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as JSON ({error}); export the run again") from error
        if not isinstance(meta, dict):
            raise InputError(f"{path}: expected a JSON object, found {type(meta).__name__}")
        return meta

    def camera(self) -> tuple[npt.NDArray[np.float64], tuple[int, int]] | None:
        """`fx fy cx cy` of the undistorted image and its (width, height) in pixels; None if the run does not say it.

        Raises:
            InputError: values in the description that are no camera.
        """
        meta = self.meta()
        found: list[Any] = [meta.get(key) for key in ("intrinsics_fx_fy_cx_cy", "W", "H")]
        if any(value is None for value in found):
            return None
        try:
            intrinsics, width, height = np.asarray(found[0], dtype=np.float64), int(found[1]), int(found[2])
        except (TypeError, ValueError):
            intrinsics, width, height = np.empty(0), 0, 0
        if intrinsics.shape != (4,) or not np.isfinite(intrinsics).all() or intrinsics[:2].min() <= 0 or min(
                width, height) < 1:
            raise InputError(f"{self.file('_meta.json')}: intrinsics_fx_fy_cx_cy, W and H are {found}, which is no "
                             "camera; export the run again")
        return intrinsics, (width, height)

    def poses_file(self) -> Path | None:
        """The file of the camera poses, None if the run has none."""
        found = [self.file(ending) for ending in ("_poses.npy", "_trajectory.txt") if self.file(ending).is_file()]
        return found[0] if found else None


def pose_convention(path: Path, asked: str = "auto") -> str:
    """`T_wc` or `T_cw`: as asked, else by the tag beside the file, else camera to world.

    Raises:
        InputError: an unknown word here or in the description of the run.
    """
    if asked not in CONVENTIONS:
        raise InputError(f"pose convention must be one of {', '.join(CONVENTIONS)}, found {asked!r}")
    if asked != "auto":
        return asked
    tag = FinishedRun.of(path).meta().get("pose_convention", "T_world_cam")
    if tag not in _TAGS:
        raise InputError(f"{FinishedRun.of(path).file('_meta.json')}: pose_convention is {tag!r}, expected "
                         f"{' or '.join(_TAGS)}")
    return _TAGS[tag]


def read_frames(path: str | os.PathLike[str]) -> FrameBundle:
    """The frame bundle of a run; its poses are world to camera whatever the file holds.

    Raises:
        InputError: see `utils.frame_bundle.read_frame_bundle`.
    """
    from utils.frame_bundle import read_frame_bundle  # late: it needs torch, which takes longer to load than to draw

    return read_frame_bundle(path)


def read_camera_path(path: str | os.PathLike[str], convention: str = "auto") -> npt.NDArray[np.float64]:
    """Poses for looking at: `(T, 7)` float64 camera to world; stamps are not needed.

    Args:
        path: `(T, 7)` `.npy`, a frame bundle `.npz`, or TUM text.
        convention: what the file holds: `T_wc`, `T_cw` or `auto` (see the module).

    Raises:
        InputError: an unreadable file, or poses of which none is finite (a run that was never initialised).
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        return inverted(read_frames(path).cam_T_world)
    if path.suffix.lower() != ".npy":
        return read_trajectory(path, convention=convention).world_T_cam
    poses = load_array(path)
    if poses.ndim != 2 or poses.shape[1] != 7 or poses.dtype.kind not in "iuf":
        raise InputError(f"{path}: poses must be a real array of shape (T, 7), found {poses.dtype} of shape "
                         f"{poses.shape}")
    return _finite(path, _to_world(poses, pose_convention(path, convention)))


def read_trajectory(path: str | os.PathLike[str], *, tstamps: str | os.PathLike[str] | None = None,
                    time_unit: str = "auto", convention: str = "auto") -> Trajectory:
    """Poses with their time: camera to world, microseconds.

    Args:
        path: `<base>_poses.npy`, a frame bundle `.npz`, or text `t tx ty tz qx qy qz qw`.
        tstamps: stamps of the `.npy` in microseconds; None takes the sibling `<base>_tstamps.npy`.
        time_unit: of text: `s`, `ms`, `us`, `ns`; `auto` takes stamps that span more than 1e5 as microseconds.
        convention: as for `read_camera_path`.

    Raises:
        InputError: an unreadable file, poses and stamps that do not fit together, or an unknown unit.
    """
    path = Path(path)
    if time_unit not in TIME_UNITS:
        raise InputError(f"time_unit must be one of {', '.join(TIME_UNITS)}, found {time_unit!r}")
    if path.suffix.lower() == ".npz":
        bundle = read_frames(path)
        return _trajectory(path, bundle.t_us, inverted(bundle.cam_T_world))
    if path.suffix.lower() == ".npy":
        poses = read_camera_path(path, convention)
        return _trajectory(path, _stamps(path, tstamps), poses)
    trajectory = read_tum(path, time_unit="us" if time_unit == "auto" else time_unit)
    if time_unit == "auto" and len(trajectory) and np.ptp(trajectory.t_us) <= _LONGEST_SECONDS:
        trajectory = read_tum(path, time_unit="s")
    return Trajectory(trajectory.t_us, _to_world(trajectory.world_T_cam, pose_convention(path, convention)))


def is_frame_bundle(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds structure per frame.

    Raises:
        InputError: an `.npz` file that cannot be read.
    """
    path = Path(path)
    return path.suffix.lower() == ".npz" and {"counts", "offsets", "poses"} <= set(load_arrays(path))


def read_any_cloud(path: str | os.PathLike[str]) -> PointCloud:
    """A cloud from any file that holds points: a cloud file, `(F, N, 3)` arrays, or a frame bundle (all its frames).

    Raises:
        InputError: see `read_cloud`.
    """
    path = Path(path)
    if is_frame_bundle(path):
        bundle = read_frames(path)
        counts = np.diff(bundle.offsets)
        scalars = {"host_frame": np.repeat(bundle.frame_ids, counts), "t_us": np.repeat(bundle.t_us, counts),
                   "inv_depth": bundle.inv_depths}
        return PointCloud(bundle.points, scalars=scalars)
    if path.suffix.lower() == ".npy" and (array := load_array(path)).ndim == 3 and array.shape[2] == 3:
        return PointCloud(array.reshape(-1, 3))
    return read_cloud(path)


def _stamps(poses: Path, tstamps: str | os.PathLike[str] | None) -> npt.NDArray[Any]:
    if tstamps is not None:
        return load_array(tstamps)
    sibling = FinishedRun.of(poses).file("_tstamps.npy")
    if not sibling.is_file():
        raise InputError(f"{poses}: the stamps of the poses are needed, there is no {sibling.name} beside it; name "
                         "the file of the stamps")
    return load_array(sibling)


def _trajectory(path: Path, t_us: npt.NDArray[Any], world_T_cam: npt.NDArray[np.float64]) -> Trajectory:
    try:
        return Trajectory(t_us, world_T_cam)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _to_world(poses: npt.NDArray[Any], convention: str) -> npt.NDArray[np.float64]:
    return inverted(poses) if convention == "T_cw" else np.asarray(poses, dtype=np.float64)


def _finite(path: Path, poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if len(poses) and not np.isfinite(poses).all(axis=1).any():
        raise InputError(f"{path}: none of the {len(poses)} poses is finite; the run was not initialised")
    return poses
