"""Small text files that data sets share: stamps, lists of images, poses."""

from __future__ import annotations

import re
from decimal import ROUND_HALF_UP, Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.events.validate import TimeUnit

_MICROSECONDS_PER: dict[str, Decimal] = {"s": Decimal(10**6), "ms": Decimal(10**3), "us": Decimal(1),
                                         "ns": Decimal("0.001")}
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
EVENT_SUFFIXES = (".h5", ".hdf5", ".raw", ".bag", ".mcap", ".db3", ".aedat4", ".txt", ".csv", ".npz", ".npy")
CALIBRATION_NAMES = ("calib.yaml", "calib.yml", "calib.json", "calib.txt")
STAMP_NAMES = ("images_timestamps_us.txt", "image_timestamps.txt", "images.txt")
NOT_EVENT_NAMES = frozenset((*CALIBRATION_NAMES, *STAMP_NAMES, "groundtruth.txt"))
"""Text files of a recording of one's own that hold no events, whatever their ending."""


class ImageList(NamedTuple):
    """Stamps (N,) in microseconds and, where the file has them, the names of the images."""

    stamps_us: npt.NDArray[np.float64]
    names: list[str] | None


def read_image_list(path: Path, time_unit: TimeUnit | None = None, *, whole: bool = True) -> ImageList:
    """Read lines `t`, `t name` or `id t name`; `#` starts a comment.

    Args:
        path: the file.
        time_unit: unit of t; None means microseconds for whole numbers and seconds for decimals.
        whole: round stamps to whole microseconds, like those of events, so that borders of windows fall equally.

    Raises:
        InputError: the file is missing, empty, has other columns or numbers that are none.
    """
    rows = [(number, line.split()) for number, line in enumerate(_read_lines(path), start=1)
            if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        raise InputError(f"{path}: no stamps in the file")
    columns = len(rows[0][1])
    for number, words in rows:
        if len(words) != columns or columns not in (1, 2, 3):
            raise InputError(f"{path}: line {number} has {len(words)} columns, expected `t`, `t name` or `id t name`, "
                             "the same on every line")
    at = 1 if columns == 3 else 0
    stamps = [_decimal(path, number, words[at]) for number, words in rows]
    unit = time_unit or ("s" if any(re.search(r"[.eE]", words[at]) for _, words in rows) else "us")
    scaled = [stamp * _MICROSECONDS_PER[unit] for stamp in stamps]
    if whole:
        scaled = [stamp.to_integral_value(ROUND_HALF_UP) for stamp in scaled]
    return ImageList(np.array(scaled, np.float64), None if columns == 1 else [words[-1] for _, words in rows])


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Return a sorting key that compares numbers in a file name as numbers."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", path.name)]


def natural_order(folder: Path) -> list[Path]:
    """Return the image files of a folder with numbers in their names compared as numbers.

    Raises:
        InputError: the folder is missing.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder, expected images")
    return sorted((path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES), key=natural_key)


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text("utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file, expected stamps") from None


def _decimal(path: Path, number: int, word: str) -> Decimal:
    try:
        value = Decimal(word)
    except InvalidOperation:
        raise InputError(f"{path}: line {number}: {word[:40]!r} is not a number") from None
    if not value.is_finite() or abs(value) > 10**18:
        raise InputError(f"{path}: line {number}: stamp {word[:40]} is not finite or out of any range")
    return value
