"""What preprocessed folders of all data sets share: files that must be there, stamps, windows, images, poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import read_calibration
from utils.datasets.files import natural_order, read_image_list
from utils.datasets.options import SequenceOptions
from utils.datasets.sequence import GroundTruth, ImageFiles, Recording
from utils.events.slicing import CountWindows, StampWindows, TimeWindows, WindowRule
from utils.trajectory_io import read_tum

Stamps = npt.NDArray[np.float64]

LEAST_LAST_FRACTION = 0.5
"""The last window is dropped if less than this share of it is covered, as for recordings of your own."""


def require_files(folder: Path, names: Iterable[str], make_them: str) -> None:
    """Check that all files are there.

    Args:
        folder: the sequence.
        names: paths relative to it.
        make_them: command that makes the missing ones.

    Raises:
        InputError: files are missing; the message lists them and says how to make them.
    """
    missing = [name for name in names if not (folder / name).exists()]
    if missing:
        raise InputError(f"{folder}: {', '.join(missing)} missing; make {'it' if len(missing) == 1 else 'them'} with "
                         f"`{make_them}`")


def only_match(folder: Path, pattern: str, what: str) -> Path:
    """Return the one file of a folder that fits a pattern.

    Raises:
        InputError: the folder is none, or no or several files fit.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder, expected a sequence with {pattern}")
    found = sorted(path for path in folder.glob(pattern) if path.is_file())
    if not found:
        raise InputError(f"{folder}: no {pattern} ({what})")
    if len(found) > 1:
        raise InputError(f"{folder}: several {pattern} ({', '.join(path.name for path in found)}), expected one {what}")
    return found[0]


def refuse_options(options: SequenceOptions, dataset: str, *names: str, because: str) -> None:
    """Refuse options that a data set has no use for.

    Raises:
        InputError: one of the named options differs from its default.
    """
    defaults = SequenceOptions()
    given = [name for name in names if getattr(options, name) != getattr(defaults, name)]
    if given:
        raise InputError(f"{' and '.join(given)} cannot be used with data set {dataset}: {because}")


def refuse_own_camera(options: SequenceOptions, dataset: str) -> None:
    """Refuse the options that replace camera or clock, which a known data set brings along.

    Raises:
        InputError: one of them was given.
    """
    refuse_options(options, dataset, "calib", "image_size", "intrinsics", "time_unit",
                   because="it brings its own camera and clock; use --dataset generic for other ones")


def read_stamps(path: Path) -> Stamps:
    """Read stamps (N,) in microseconds, one a line, fractions kept; they must increase.

    Raises:
        InputError: see `read_image_list`, or stamps that do not increase.
    """
    return require_increasing(read_image_list(path, "us", whole=False).stamps_us, path)


def require_increasing(stamps_us: Stamps, path: Path) -> Stamps:
    """Return the stamps of a file.

    Raises:
        InputError: they do not increase.
    """
    wrong = np.flatnonzero(np.diff(stamps_us) <= 0)
    if len(wrong):
        raise InputError(f"{path}: stamp {wrong[0] + 1} is {stamps_us[wrong[0] + 1]} us and not later than the one "
                         "before it")
    return stamps_us


def read_pinhole(path: Path, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Read the line `fx fy cx cy` (4,) of the undistorted camera with images of `size` (width, height).

    Raises:
        InputError: the file is missing or holds something else.
    """
    calibration = read_calibration(path, image_size=size)
    if calibration.is_distorted:
        raise InputError(f"{path}: holds distortion coefficients, expected the undistorted camera `fx fy cx cy`")
    return calibration.intrinsics


def pinhole_of(fields: dict[str, Any]) -> npt.NDArray[np.float64]:
    """Return `fx fy cx cy` (4,) of a JSON object with these keys.

    Raises:
        KeyError, TypeError, ValueError: it has other keys, or values that are no finite positive numbers.
    """
    numbers = np.array([float(fields[name]) for name in ("fx", "fy", "cx", "cy")])
    if not np.isfinite(numbers).all() or numbers[:2].min() <= 0:
        raise ValueError(f"fx fy cx cy are {numbers.tolist()}")
    return numbers


def mean_interval_us(stamps_us: Stamps, path: Path) -> float:
    """Return the mean distance of stamps in microseconds.

    Raises:
        InputError: fewer than two stamps.
    """
    if len(stamps_us) < 2:
        raise InputError(f"{path}: {len(stamps_us)} image stamps, expected at least 2")
    return float(stamps_us[-1] - stamps_us[0]) / (len(stamps_us) - 1)


def stamp_windows(stamps_us: Stamps, options: SequenceOptions, length_us: float | None,
                  ) -> tuple[WindowRule, SequenceOptions]:
    """Choose how events are cut, and bound the options to what the stamps span.

    Args:
        stamps_us: (N,) image stamps in use, microseconds.
        options: `window_dt_ms` replaces `length_us`; `window_ms` and `window_events` replace the rule altogether.
        length_us: windows are `[s_i, s_i + length_us)`; None means up to the next stamp.

    Raises:
        InputError: too few stamps or an impossible length.
    """
    if options.window_ms is None and options.window_events is None:
        if options.window_dt_ms is not None:
            length_us = options.window_dt_ms * 1000
        return StampWindows(stamps_us, length_us, least_last_fraction=LEAST_LAST_FRACTION), options
    first, last = float(stamps_us[0]), float(stamps_us[-1])
    bounded = dataclasses.replace(options, start_us=first if options.start_us is None else max(first, options.start_us),
                                  stop_us=last if options.stop_us is None else min(last, options.stop_us))
    if options.window_events is not None:
        return CountWindows(options.window_events, least_last_fraction=LEAST_LAST_FRACTION), bounded
    assert options.window_ms is not None
    return TimeWindows(round(options.window_ms * 1000), least_last_fraction=LEAST_LAST_FRACTION), bounded


def check_window_length(length_us: float, shortest_ms: float, longest_ms: float, path: Path) -> None:
    """Refuse windows that come from wrong stamps.

    Raises:
        InputError: the length is not inside the range of the data set (both ends excluded).
    """
    if not shortest_ms < length_us / 1000 < longest_ms:
        raise InputError(f"{path}: windows would last {length_us / 1000:g} ms, expected between {shortest_ms:g} and "
                         f"{longest_ms:g} ms; check unit and order of the image stamps")


def find_images(folder: Path, stamps_us: Stamps, read_intrinsics: Callable[[], npt.NDArray[np.float64]],
                make_them: str) -> ImageFiles | str:
    """Return the undistorted images of a folder in natural order, or why there are none; an event run needs none.

    Args:
        folder: where they are.
        stamps_us: (N,) stamps of all images.
        read_intrinsics: returns (4,) `fx fy cx cy` of the images.
        make_them: command that makes them.
    """
    if not folder.is_dir():
        return f"there are no undistorted images in {folder.name}; make them with `{make_them}`"
    paths = natural_order(folder)
    if len(paths) != len(stamps_us):
        return (f"{folder.name} holds {len(paths)} images for {len(stamps_us)} stamps; complete them with "
                f"`{make_them}`")
    try:
        return ImageFiles(paths, stamps_us, read_intrinsics())
    except InputError as error:
        return str(error)


def poses_reader(path: Path, *, time_unit: str = "us", skip_lines: int = 0) -> Callable[[], GroundTruth] | None:
    """Return a function that reads poses `t tx ty tz qx qy qz qw`, camera to world; None if there is no file."""
    if not path.is_file():
        return None

    def read() -> GroundTruth:
        trajectory = read_tum(path, time_unit=time_unit, skip_lines=skip_lines, skip_repeated=True)
        return trajectory.t_us, trajectory.world_T_cam

    return read


def require_size(sequence: Recording, H: int, W: int) -> None:
    """Check that voxel grids were asked for in the size of the sensor.

    Raises:
        InputError: H or W differ.
    """
    if (sequence.width, sequence.height) != (W, H):
        raise InputError(f"H={H}, W={W} were given, but {sequence.path} is of a sensor with H={sequence.height}, "
                         f"W={sequence.width}")
