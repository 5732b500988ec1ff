"""VECtor: two event cameras of 640x480 pixels beside two frame cameras, all on the clock of Unix microseconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from devo.errors import InputError
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import (
    check_window_length,
    find_images,
    mean_interval_us,
    only_match,
    poses_reader,
    read_pinhole,
    read_stamps,
    refuse_own_camera,
    require_files,
    stamp_windows,
)
from utils.datasets.recognise import preprocessing_command
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, Sequence
from utils.events.reader import EventReader, open_events
from utils.undistort import read_rectify_map

EVENT_SIZE = (640, 480)
FRAME_SIZE = (1224, 1024)

IMAGE_RANGES: dict[str, tuple[int, int]] = {
    "corner_slow": (30, 1180),
    "robot_normal": (40, -1),
    "robot_fast": (30, 901),
    "desk_normal": (65, -1),
    "desk_fast": (25, 1380),
    "sofa_normal": (120, 2700),
    "sofa_fast": (50, 1200),
    "mountain_normal": (40, -1),
    "mountain_fast": (15, 1290),
    "hdr_normal": (30, -1),
    "hdr_fast": (35, -1),
    "corridors_dolly": (115, -1),
    "school_dolly": (80, 3160),
    "school_scooter": (20, 1290),
    "units_dolly": (20, 5750),
    "units_scooter": (10, 2790),
}
"""Images `[start:stop]` in use, by part of the sequence's name; the ends show hands, boxes or no ground truth."""

_OTHER_RANGE = (0, -1)
_FAST_FACTOR, _NORMAL_FACTOR = 0.5, 2.0


def event_file_suffix(side: str) -> str:
    """Return what follows the sequence's name in the name of its event file."""
    return f"1.synced.{side}_event.hdf5"


def sequence_name(event_file: Path, side: str) -> str:
    """Return the name of the sequence, which only the name of its event file tells for certain."""
    return event_file.name.removesuffix(event_file_suffix(side))


def image_range(name: str) -> tuple[int, int]:
    """Return the first image in use and the one behind the last; -1 leaves out the last image."""
    return next((limits for part, limits in IMAGE_RANGES.items() if part in name), _OTHER_RANGE)


def window_factor(name: str) -> float:
    """Return by what the mean image interval is multiplied to give the length of the windows."""
    return _FAST_FACTOR if "fast" in name else _NORMAL_FACTOR


@register("vector", "VECtor: stereo event cameras 640x480, preprocessed by scripts/pp_vector.py")
def open_vector(path: Path, options: SequenceOptions, voxel_size: tuple[int, int] | None = None) -> Sequence:
    """Open a sequence folder with `{name}1.synced.{side}_event.hdf5` and the files that `pp_vector.py` makes.

    Windows: `[s_i, s_i + L)` at the image stamps of `IMAGE_RANGES`, with L = half the mean image interval for
    sequences with "fast" in their name and twice that interval for others. A frame has the stamp of the middle of its
    window. `start_us` and `stop_us` (absolute microseconds) choose among these windows.

    Args:
        path: the sequence folder.
        options: see `SequenceOptions`; `window_dt_ms` is used as it is.
        voxel_size: (width, height) of the voxel grids, None for the sensor's 640x480.

    Raises:
        InputError: files are missing or damaged, or do not belong together.
    """
    refuse_own_camera(options, "vector")
    side = options.side
    event_file = only_match(path, f"*{event_file_suffix(side)}", f"event file of the {side} camera of VECtor")
    name = sequence_name(event_file, side)
    command = preprocessing_command("vector", path, side)
    files = {"events": event_file, "image stamps": path / f"tss_imgs_us_{side}.txt",
             "intrinsics": path / f"calib_undist_evs_{side}.txt", "rectify map": path / f"rectify_map_{side}.h5"}
    require_files(path, [file.name for file in files.values()], command)

    all_stamps = read_stamps(files["image stamps"])
    interval_us = mean_interval_us(all_stamps, files["image stamps"])
    first, last = image_range(name)
    stamps = all_stamps[first:last]
    if not len(stamps):
        raise InputError(f"{path}: sequence {name} uses the images {first} to {last}, but there are only "
                         f"{len(all_stamps)} stamps; download it again, or rename a shortened copy")
    windows, options = stamp_windows(stamps, options, window_factor(name) * interval_us)
    check_window_length(window_factor(name) * interval_us, 0, 1000, files["image stamps"])
    if (poses := path / f"poses_evs_{side}.txt").is_file():
        files["ground truth"] = poses

    def open_reader() -> EventReader:
        return open_events(event_file, sensor_size=EVENT_SIZE, time_unit="us", on_unsorted=options.on_unsorted)

    return Sequence(
        name, path, options, size=EVENT_SIZE, intrinsics=read_pinhole(files["intrinsics"], EVENT_SIZE),
        open_reader=open_reader, windows=windows, rectify_map=read_rectify_map(files["rectify map"], EVENT_SIZE),
        images=find_images(path / f"images_undistorted_{side}", all_stamps,
                           lambda: read_pinhole(path / f"calib_undist_regular_{side}.txt", FRAME_SIZE), command),
        read_ground_truth=poses_reader(poses), files=files, voxel_size=voxel_size)


def vector_evs_iterator(indir: str | os.PathLike[str], side: str = "left", stride: int = 1, dT_ms: float | None = None,
                        timing: bool = False, H: int = 480, W: int = 640, cors: int = 4) -> Iterator[Frame]:
    """Return the stream of `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` of a sequence of VECtor.

    Args:
        indir: sequence folder.
        side: "left" or "right".
        stride: use every stride-th image.
        dT_ms: takes the place of the mean image interval in milliseconds; windows last half of it for fast sequences,
            twice as long for others, see `open_vector`.
        timing, cors: accepted, without effect.
        H, W: size of the voxel grids in pixels.

    Raises:
        InputError: see `open_vector`.
    """
    path = Path(indir)
    if dT_ms is not None:
        dT_ms *= window_factor(sequence_name(only_match(path, f"*{event_file_suffix(side)}", "event file"), side))
    options = SequenceOptions(side=side, stride=stride, window_dt_ms=dT_ms)
    return open_vector(path, options, (W, H)).voxels()
