"""MVSEC indoor flying: a stereo pair of DAVIS346 cameras in one HDF5 file, whose windows go from image to image."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import (
    find_images,
    only_match,
    read_pinhole,
    read_stamps,
    refuse_options,
    refuse_own_camera,
    require_files,
)
from utils.datasets.recognise import preprocessing_command
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, GroundTruth, Sequence
from utils.events.hdf5 import hdf5_errors, open_hdf5
from utils.events.reader import EventReader, open_events
from utils.events.slicing import EventWindow, RowWindows
from utils.trajectory_io import Trajectory, quaternions
from utils.undistort import read_rectify_map

SIZE = (346, 260)
DATA_SUFFIX, POSES_SUFFIX = "_data.hdf5", "_gt.hdf5"


class MvsecSequence(Sequence):
    """A sequence whose frames carry the stamp of the image that closes their window."""

    def frame_stamp_us(self, index: int, window: EventWindow) -> float:
        """Return the end of the window."""
        return window.stop_us


@register("mvsec", "MVSEC indoor flying: stereo DAVIS346, preprocessed by scripts/pp_mvsec.py")
def open_mvsec(path: Path, options: SequenceOptions, voxel_size: tuple[int, int] | None = None) -> Sequence:
    """Open a folder `{name}_data` with `{name}_data.hdf5`, `{name}_gt.hdf5` and the files that `pp_mvsec.py` makes.

    Windows: the events between an image and the one before it, by the event numbers stored beside the images; a frame
    has the stamp of the later image, in absolute microseconds. Windows without events are skipped. The ground truth
    is that of the left camera.

    Args:
        path: the sequence folder.
        options: see `SequenceOptions`; windows of another kind are refused.
        voxel_size: (width, height) of the voxel grids, None for the sensor's 346x260.

    Raises:
        InputError: files are missing or damaged, or do not belong together.
    """
    refuse_own_camera(options, "mvsec")
    refuse_options(options, "mvsec", "window_ms", "window_events", "window_dt_ms",
                   because="its windows go from image to image by stored event numbers; use --dataset generic")
    if options.on_unsorted != "error":
        refuse_options(options, "mvsec", "on_unsorted", because="its windows count events in the order of the file")
    side = options.side
    data = only_match(path, f"*{DATA_SUFFIX}", "recording of MVSEC; pass the folder that pp_mvsec.py makes")
    command = preprocessing_command("mvsec", path.absolute().parent, side)
    files = {"events": data, "image stamps": path / f"tss_imgs_us_{side}.txt",
             "intrinsics": path / f"calib_undist_{side}.txt", "rectify map": path / f"rectify_map_{side}.h5"}
    require_files(path, [file.name for file in files.values()], command)
    stamps = read_stamps(files["image stamps"])
    rows = read_array(data, f"davis/{side}/image_raw_event_inds").reshape(-1)
    if len(rows) != len(stamps):
        raise InputError(f"{files['image stamps']}: {len(stamps)} stamps, but {data.name} numbers the events of "
                         f"{len(rows)} images; run `{command} --overwrite`")
    poses = data.with_name(data.name.removesuffix(DATA_SUFFIX) + POSES_SUFFIX)
    if poses.is_file():
        files["ground truth"] = poses

    def open_reader() -> EventReader:
        return open_events(data, sensor_size=SIZE, time_unit="s", stream=f"davis/{side}/events")

    return MvsecSequence(
        data.name.removesuffix(".hdf5"), path, options, size=SIZE,
        intrinsics=read_pinhole(files["intrinsics"], SIZE), open_reader=open_reader,
        windows=RowWindows(rows, stamps), rectify_map=read_rectify_map(files["rectify map"], SIZE),
        images=find_images(path / f"images_undistorted_{side}", stamps,
                           lambda: read_pinhole(files["intrinsics"], SIZE), command),
        read_ground_truth=(lambda: read_poses(poses)) if poses.is_file() else None,
        poses_of="left camera" if side == "right" else None, files=files, voxel_size=voxel_size)


def read_array(path: Path, name: str) -> npt.NDArray[Any]:
    """Read one dataset of an HDF5 file as a whole.

    Raises:
        InputError: the file is missing or damaged, or has no such dataset.
    """
    with open_hdf5(path) as file, hdf5_errors(path):
        if name not in file:
            raise InputError(f"{path}: dataset {name} missing, found {', '.join(sorted(file)) or 'nothing'}")
        return np.asarray(file[name][()])


def read_poses(path: Path, side: str = "left") -> GroundTruth:
    """Read camera-to-world poses of `{name}_gt.hdf5`; repeated stamps count once.

    Returns:
        Stamps (N,) in absolute microseconds and poses (N, 7) `tx ty tz qx qy qz qw`.

    Raises:
        InputError: the file is damaged or holds no poses.
    """
    matrices = read_array(path, f"davis/{side}/pose").astype(np.float64)
    stamps_us = read_array(path, f"davis/{side}/pose_ts").astype(np.float64).reshape(-1) * 1e6
    if matrices.shape != (len(stamps_us), 4, 4) or not np.isfinite(matrices).all():
        raise InputError(f"{path}: poses have shape {matrices.shape} for {len(stamps_us)} stamps, expected "
                         f"finite matrices ({len(stamps_us)}, 4, 4)")
    first = np.concatenate([[True], stamps_us[1:] != stamps_us[:-1]]) if len(stamps_us) else np.empty(0, bool)
    poses = np.concatenate([matrices[first, :3, 3], quaternions(matrices[first, :3, :3])], axis=1)
    trajectory = Trajectory(stamps_us[first], poses)
    return trajectory.t_us, trajectory.world_T_cam


def mvsec_evs_iterator(scenedir: str | os.PathLike[str], side: str = "left", stride: int = 1,
                       dT_ms: float | None = None, timing: bool = False, H: int = 260, W: int = 346) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of a sequence of MVSEC.

    Args:
        scenedir: sequence folder `{name}_data`.
        side: "left" or "right".
        stride: use every stride-th window.
        dT_ms: must be None, windows go from image to image.
        timing: accepted, without effect.
        H, W: size of the voxel grids in pixels.

    Raises:
        InputError: see `open_mvsec`.
    """
    options = SequenceOptions(side=side, stride=stride, window_dt_ms=dT_ms)
    return open_mvsec(Path(scenedir), options, (W, H)).voxels()
