"""What a preprocessor of a data set is, and the table of all of them: one file per data set, one row each."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from devo.errors import InputError
from utils.events.validate import Order

SIDES = ("left", "right")


@dataclass(frozen=True)
class PreprocessOptions:
    """How a sequence is preprocessed.

    Attributes:
        side: camera of a stereo recording, "left" or "right".
        overwrite: make every product anew; otherwise complete products are kept.
        images: undistort the intensity images too; only image odometry needs them.
        progress: progress bars on stderr.
        on_unsorted: what to do about events that run backwards in a bag: "error" or "sort" (loads all events).

    Raises:
        InputError: no such side.
    """

    side: str = "left"
    overwrite: bool = False
    images: bool = True
    progress: bool = False
    on_unsorted: Order = "error"

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise InputError(f"side is {self.side!r}, expected left or right")


FindSequences = Callable[[Path, str], list[Path]]
Run = Callable[[Path, PreprocessOptions], list[Path]]
Outputs = Callable[[Path, str], list[Path]]


@dataclass(frozen=True)
class Preprocessor:
    """One row of the table: how the raw files of a data set become what its reader needs.

    Attributes:
        name: the data set.
        layout: one line that says which raw files are expected, for messages and help.
        find_sequences: `(root, side) -> folders` of the sequences below root (root itself included) whose raw
            files are there; sorted; the folders are those that `open_sequence` takes and may not exist yet.
        run: `(folder, options) -> files made`, empty if all were there.
        outputs: `(folder, side) -> files` that an event run needs from `run`, whether they exist or not.
        sides: cameras the data set has.
    """

    name: str
    layout: str
    find_sequences: FindSequences
    run: Run
    outputs: Outputs
    sides: tuple[str, ...] = SIDES


PREPROCESSORS: dict[str, Preprocessor] = {}
"""All preprocessors by data set; filled while `utils.preprocessing` is imported, constant from then on."""


def register(preprocessor: Preprocessor) -> Preprocessor:
    """Enter a row in the table.

    Raises:
        InputError: the data set has one already.
    """
    if preprocessor.name in PREPROCESSORS:
        raise InputError(f"preprocessor of data set {preprocessor.name!r} is registered twice")
    PREPROCESSORS[preprocessor.name] = preprocessor
    return preprocessor


def walk_folders(root: Path, is_sequence: Callable[[Path], bool]) -> list[Path]:
    """Return the folders at or below `root` that satisfy `is_sequence`, sorted; sequences are not searched further.

    Hidden folders are left out, links are followed once; there is nothing below what is no folder.
    """
    return sorted(_walk(root, is_sequence, set())) if root.is_dir() else []


def folders_around(folder: Path) -> list[Path]:
    """Return the folder that holds `folder` as it was named and, if that is another one, as links lead to it."""
    named = Path(os.path.abspath(folder)).parent  # noqa: PTH100 - normalises `..` without following links
    return list(dict.fromkeys((named, folder.resolve().parent)))


def _walk(folder: Path, is_sequence: Callable[[Path], bool], seen: set[str]) -> Iterator[Path]:
    real = os.path.realpath(folder)
    if real in seen:
        return
    seen.add(real)
    if is_sequence(folder):
        yield folder
        return
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(f"cannot search {folder} for recordings: {error.strerror or error}") from error
    for entry in entries:
        if entry.is_dir() and not entry.name.startswith("."):
            yield from _walk(entry, is_sequence, seen)
