"""Recordings of your own: a folder with an event file and a calibration, or the event file itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration, read_calibration
from utils.datasets.files import (
    CALIBRATION_NAMES,
    EVENT_SUFFIXES,
    NOT_EVENT_NAMES,
    STAMP_NAMES,
    ImageList,
    natural_order,
    read_image_list,
)
from utils.datasets.registry import SequenceOptions, register
from utils.datasets.sequence import GroundTruth, ImageFiles, Sequence
from utils.events.reader import EventReader, open_events
from utils.events.slicing import CountWindows, StampWindows, TimeWindows, WindowRule
from utils.trajectory_io import read_tum
from utils.undistort import rectify_map

DEFAULT_WINDOW_US = 33_333
_LEAST_LAST_FRACTION = 0.5


@register("generic", "your own recording: a folder with events.* and calib.*, or an event file")
def open_generic(path: Path, options: SequenceOptions) -> Sequence:
    """Open a recording that follows no data set's own layout.

    A folder holds an event file (`events.{h5,hdf5,raw,bag,mcap,db3,aedat4,txt,csv,npz,npy}`, or the only file that
    `open_events` accepts) and usually `calib.{yaml,json,txt}`; optional are `groundtruth.txt` (TUM, seconds, camera to
    world), image stamps (`images_timestamps_us.txt`, `image_timestamps.txt` or `images.txt`) and `images/`. If `path`
    is the event file itself, only a calibration beside it is used.

    Windows: `window_ms` or `window_events` of the options; else from image stamp to image stamp (or `window_dt_ms`
    long), if there are stamps; else 33.333 ms. The last window is dropped if less than half of it is covered.

    Args:
        path: folder or event file.
        options: see `SequenceOptions`.

    Raises:
        InputError: no or several event files, no calibration or sensor size, or files that do not fit together.
    """
    if options.side != "left":
        raise InputError(f"side {options.side!r} was given, but a generic recording has one camera; pass its folder")
    is_folder = path.is_dir()
    event_file = find_event_file(path, options) if is_folder else path
    files = {"events": event_file}
    calibration = _find_calibration(event_file, options, files)
    stamps = _find_stamps(path, files) if is_folder else None
    size = (calibration.width, calibration.height)

    def open_reader() -> EventReader:
        return open_events(event_file, sensor_size=size, time_unit=options.time_unit, on_unsorted=options.on_unsorted,
                           stream=options.stream)

    positions: npt.NDArray[np.float32] | None = None
    intrinsics = calibration.intrinsics
    if calibration.is_distorted:
        positions, intrinsics = rectify_map(calibration)
    if stamps is not None:
        with open_reader() as reader:
            _check_overlap(files["image stamps"], stamps, reader)
    poses = path / "groundtruth.txt"
    has_poses = is_folder and poses.is_file()
    if has_poses:
        files["ground truth"] = poses
    return Sequence(
        path.resolve().name if is_folder else path.stem, path, options, size=size, intrinsics=intrinsics,
        open_reader=open_reader, windows=_window_rule(path, options, stamps), rectify_map=positions,
        images=_find_images(path, stamps, calibration, intrinsics),
        read_ground_truth=(lambda: _read_poses(poses)) if has_poses else None, files=files)


def find_event_file(folder: Path, options: SequenceOptions) -> Path:
    """Return the event file of a folder: `events.*`, else the only file that can be opened as events.

    Raises:
        InputError: there is none, or more than one.
    """
    candidates = [folder / f"events{suffix}" for suffix in EVENT_SUFFIXES if (folder / f"events{suffix}").is_file()]
    reasons: list[str] = []
    if not candidates:
        candidates, reasons = _files_with_events(folder, options)
    if len(candidates) > 1:
        raise InputError(f"{folder}: several event files ({', '.join(file.name for file in candidates)}); pass the "
                         "one to use as path together with --calib")
    if not candidates:
        tried = f"; tried: {' | '.join(reasons[:3])}" if reasons else ""
        raise InputError(f"{folder}: no event file, expected events{', '.join(EVENT_SUFFIXES)}{tried}")
    return candidates[0]


def _files_with_events(folder: Path, options: SequenceOptions) -> tuple[list[Path], list[str]]:
    """Return the files that can be opened as events, and why others cannot."""
    accepted, reasons = [], []
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in EVENT_SUFFIXES or file.name in NOT_EVENT_NAMES or not file.is_file():
            continue
        try:
            open_events(file, time_unit=options.time_unit, on_unsorted=options.on_unsorted,
                        stream=options.stream).close()
            accepted.append(file)
        except InputError as error:
            reasons.append(str(error))
    return accepted, reasons


def _find_calibration(event_file: Path, options: SequenceOptions, files: dict[str, Path]) -> Calibration:
    with open_events(event_file, time_unit=options.time_unit, on_unsorted=options.on_unsorted,
                     stream=options.stream) as reader:
        size_in_events = reader.sensor_size
    if options.intrinsics is not None:
        size = options.image_size or size_in_events
        if size is None:
            raise InputError(f"{event_file}: the sensor size is unknown; with --intrinsics pass also "
                             "--image_size WIDTH HEIGHT")
        fx, fy, cx, cy = options.intrinsics
        return Calibration(int(size[0]), int(size[1]), fx, fy, cx, cy)
    found = [event_file.parent / name for name in CALIBRATION_NAMES if (event_file.parent / name).is_file()]
    if options.calib is None and len(found) > 1:
        raise InputError(f"{event_file.parent}: several calibrations ({', '.join(file.name for file in found)}); pass "
                         "the one to use with --calib")
    if options.calib is None and not found:
        raise InputError(f"{event_file.parent}: no calibration (calib.yaml, calib.json or calib.txt); add one, or pass "
                         "--calib FILE, or --intrinsics FX FY CX CY with --image_size WIDTH HEIGHT")
    files["calibration"] = Path(options.calib) if options.calib is not None else found[0]
    calibration = read_calibration(files["calibration"], options.image_size, size_in_events)
    size = (calibration.width, calibration.height)
    if size_in_events not in (None, size):
        raise InputError(f"{files['calibration']}: made for {size[0]}x{size[1]} pixels, but {event_file} says a sensor "
                         f"of {size_in_events}; the calibration belongs to another camera")
    return calibration


def _find_stamps(folder: Path, files: dict[str, Path]) -> ImageList | None:
    for name in STAMP_NAMES:
        if (folder / name).is_file():
            files["image stamps"] = folder / name
            return read_image_list(folder / name, "us" if name.endswith("_us.txt") else None)
    return None


def _check_overlap(file: Path, stamps: ImageList, reader: EventReader) -> None:
    first_us, last_us = reader.time_range_us()
    if stamps.stamps_us[-1] < first_us or stamps.stamps_us[0] > last_us:
        raise InputError(f"{file}: image stamps go from {stamps.stamps_us[0]:.0f} us to {stamps.stamps_us[-1]:.0f} us, "
                         f"events from {first_us} us to {last_us} us; they do not overlap, check clocks and units")


def _find_images(folder: Path, stamps: ImageList | None, calibration: Calibration,
                 intrinsics: npt.NDArray[np.float64]) -> ImageFiles | None:
    if stamps is None or not (folder / "images").is_dir():
        return None
    if stamps.names is None:
        paths = natural_order(folder / "images")
    else:  # names are given relative to the folder or to its images/
        paths = [folder / name if "/" in name else folder / "images" / name for name in stamps.names]
    return ImageFiles(paths, stamps.stamps_us, intrinsics, calibration if calibration.is_distorted else None)


def _window_rule(path: Path, options: SequenceOptions, stamps: ImageList | None) -> WindowRule:
    if options.window_events is not None:
        return CountWindows(options.window_events, least_last_fraction=_LEAST_LAST_FRACTION)
    if options.window_ms is not None:
        return TimeWindows(round(options.window_ms * 1000), least_last_fraction=_LEAST_LAST_FRACTION)
    if stamps is not None:
        window_us = None if options.window_dt_ms is None else options.window_dt_ms * 1000
        return StampWindows(stamps.stamps_us, window_us, least_last_fraction=_LEAST_LAST_FRACTION)
    if options.window_dt_ms is not None:
        raise InputError(f"{path}: window_dt_ms needs image stamps, but there are none; use window_ms")
    return TimeWindows(DEFAULT_WINDOW_US, least_last_fraction=_LEAST_LAST_FRACTION)


def _read_poses(file: Path) -> GroundTruth:
    trajectory = read_tum(file)
    return trajectory.t_us, trajectory.world_T_cam
