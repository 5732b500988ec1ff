"""TUM-VIE: two event cameras of 1280x720 pixels beside two frame cameras, all behind fisheye lenses."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration, read_mapping
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import (
    check_window_length,
    find_images,
    mean_interval_us,
    only_match,
    pinhole_of,
    poses_reader,
    read_stamps,
    refuse_own_camera,
    require_files,
    stamp_windows,
)
from utils.datasets.recognise import preprocessing_command
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, Sequence
from utils.events.reader import EventReader, open_events
from utils.undistort import read_rectify_map, undistorted_intrinsics

EVENT_SIZE = (1280, 720)
HOT_PIXEL_STDS = 6.0
CALIBRATION_FILE = "calib_undist.json"
EVENT_BALANCE, FRAME_BALANCE = 0.5, 0.0
"""How much of the fisheye view is kept: of the events, and of the undistorted images on disk."""

CAMERAS = {"left": 2, "right": 3}
"""Number of the event camera of each side; 0 and 1 are the frame cameras."""


def event_pattern(side: str) -> str:
    """Return the pattern of the event file's name."""
    return f"*events_{side}.h5"


def frame_camera(side: str) -> int:
    """Return the number of the frame camera of a side: 0 left, 1 right; event cameras are 2 and 3."""
    return CAMERAS[side] - 2


@register("tumvie", "TUM-VIE: stereo event cameras 1280x720, preprocessed by scripts/pp_tumvie.py")
def open_tumvie(path: Path, options: SequenceOptions, voxel_size: tuple[int, int] | None = None) -> Sequence:
    """Open a sequence folder with `*events_{side}.h5` and the files that `pp_tumvie.py` makes.

    Windows: `[s_i, s_i + L)` at the stamps of the frame camera of the same side, with L = the mean image interval (the
    published evaluation takes 25 ms). A frame has the stamp of the middle of its window. Cells of a voxel grid beyond
    6 standard deviations are set to zero. The ground truth is that of the motion capture body, not of the camera.

    Args:
        path: the sequence folder.
        options: see `SequenceOptions`.
        voxel_size: (width, height) of the voxel grids, None for the sensor's 1280x720.

    Raises:
        InputError: files are missing or damaged, or do not belong together.
    """
    refuse_own_camera(options, "tumvie")
    side = options.side
    events = only_match(path, event_pattern(side), f"event file of the {side} camera of TUM-VIE")
    command = preprocessing_command("tumvie", path, side)
    images = path / f"{side}_images_undistorted"
    files = {"events": events, "image stamps": images / f"image_timestamps_{side}.txt",
             "intrinsics": path / CALIBRATION_FILE, "rectify map": path / f"rectify_map_{side}.h5"}
    require_files(path, [str(file.relative_to(path)) for file in files.values()], command)

    stamps = read_stamps(files["image stamps"])
    length_us = mean_interval_us(stamps, files["image stamps"])
    windows, bounded = stamp_windows(stamps, options, length_us)
    if options.window_dt_ms is None:
        check_window_length(length_us, 3, 100, files["image stamps"])
    poses = path / "mocap_data.txt"
    if poses.is_file():
        files["ground truth"] = poses

    def open_reader() -> EventReader:
        return open_events(events, sensor_size=EVENT_SIZE, time_unit="us", on_unsorted=options.on_unsorted)

    def frame_intrinsics() -> npt.NDArray[np.float64]:
        # the published file holds another balance for the frame cameras than their images were undistorted with
        return undistorted_intrinsics(read_camera(path / CALIBRATION_FILE, frame_camera(side)), balance=FRAME_BALANCE)

    return Sequence(
        path.resolve().name, path, bounded, size=EVENT_SIZE,
        intrinsics=read_undistorted(path / CALIBRATION_FILE, CAMERAS[side]), open_reader=open_reader, windows=windows,
        rectify_map=read_rectify_map(files["rectify map"], EVENT_SIZE), hot_pixel_stds=HOT_PIXEL_STDS,
        images=find_images(images, stamps, frame_intrinsics, command),
        read_ground_truth=poses_reader(poses, skip_lines=1), poses_of="motion capture body", files=files,
        voxel_size=voxel_size)


def read_camera(path: Path, camera: int) -> Calibration:
    """Return camera 0..3 of `camera-calibration{A,B}.json` or one of its copies: 0, 1 frames, 2, 3 events.

    Raises:
        InputError: the file is missing or damaged, or lacks that camera.
    """
    value = read_mapping(path).get("value0")
    try:
        fields = value["intrinsics"][camera]["intrinsics"]  # type: ignore[index]
        width, height = value["resolution"][camera]  # type: ignore[index]
        fx, fy, cx, cy = (float(fields[name]) for name in ("fx", "fy", "cx", "cy"))
        coefficients = tuple(float(fields[name]) for name in ("k1", "k2", "k3", "k4"))
        return Calibration(int(width), int(height), fx, fy, cx, cy, "fisheye", coefficients)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path}: no camera {camera} in value0.intrinsics and value0.resolution ({error!r}), expected "
                         "fx fy cx cy k1..k4 and [width, height] for each of the 4 cameras of TUM-VIE") from None


def read_undistorted(path: Path, camera: int) -> npt.NDArray[np.float64]:
    """Return `fx fy cx cy` (4,) of an undistorted camera from `calib_undist.json`.

    Raises:
        InputError: the file is missing or damaged, or lacks that camera.
    """
    value = read_mapping(path).get("value0")
    try:
        fields = value["intrinsics_undistorted"][camera]  # type: ignore[index]
        return pinhole_of(fields)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path}: no camera {camera} in value0.intrinsics_undistorted ({error!r}); make the file "
                         "again with scripts/pp_tumvie.py --overwrite") from None


def tumvie_evs_iterator(scenedir: str | os.PathLike[str], camID: int = 2, stride: int = 1,  # noqa: N803
                        rectify_map: object = None, H: int = 720, W: int = 1280, dT_ms: float | None = None,
                        timing: bool = False, parallel: bool = False, cors: int = 16) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of a sequence of TUM-VIE.

    Args:
        scenedir: sequence folder.
        camID: 2 for the left event camera, 3 for the right one.
        stride: use every stride-th image.
        rectify_map, timing, parallel, cors: accepted, without effect.
        H, W: size of the voxel grids in pixels; intrinsics are scaled along.
        dT_ms: length of the windows in milliseconds, None for the mean image interval.

    Raises:
        InputError: see `open_tumvie`, or another camera.
    """
    side = {camera: side for side, camera in CAMERAS.items()}.get(camID)
    if side is None:
        raise InputError(f"camID is {camID}, expected 2 or 3: the left or the right event camera")
    options = SequenceOptions(side=side, stride=stride, window_dt_ms=dT_ms)
    return open_tumvie(Path(scenedir), options, (W, H)).voxels()
