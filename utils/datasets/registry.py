"""Find the reader of a data set by name: one file per data set, one table row each."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from devo.errors import InputError
from utils.datasets.options import SequenceOptions
from utils.datasets.recognise import AUTO, AmbiguousError, Recognised, recognise
from utils.datasets.sequence import Recording, Sequence

__all__ = ["DATASETS", "DatasetSpec", "Recording", "Sequence", "SequenceOptions", "locate_sequence", "open_sequence",
           "register"]

Opener = Callable[[Path, SequenceOptions], Recording]
OpenerT = TypeVar("OpenerT", bound=Opener)


@dataclass(frozen=True)
class DatasetSpec:
    """One row of the table of data sets.

    Attributes:
        name: what the user types.
        summary: one line for listings.
        open: makes the sequence from its path and the options.
    """

    name: str
    summary: str
    open: Opener


DATASETS: dict[str, DatasetSpec] = {}
"""All known data sets by name; filled while the package `utils.datasets` is imported, constant from then on."""


def register(name: str, summary: str) -> Callable[[OpenerT], OpenerT]:
    """Enter a class or function `(path, options) -> Recording` in the table of data sets.

    Raises:
        InputError: the name is taken.
    """
    def enter(opener: OpenerT) -> OpenerT:
        if name in DATASETS:
            raise InputError(f"data set {name!r} is registered twice")
        DATASETS[name] = DatasetSpec(name, summary, opener)
        return opener

    return enter


def locate_sequence(name: str, path: str | os.PathLike[str], options: SequenceOptions | None = None) -> Recognised:
    """Find the sequence that a data set and a path mean, without opening it.

    Args:
        name: data set, a key of `DATASETS`, or "auto" to recognise it by its files.
        path: folder of the sequence or one around it, ROS bag, or event file.
        options: as for `open_sequence`; the side and whether a calibration is given matter here.

    Raises:
        InputError: unknown data set, missing path, or nothing fits (see `recognise`).
    """
    options = options if options is not None else SequenceOptions()
    if name != AUTO and name not in DATASETS:
        raise InputError(f"unknown data set {name!r}, known are: {AUTO}, {', '.join(sorted(DATASETS))}")
    calibrated = options.calib is not None or options.intrinsics is not None
    return recognise(path, options.side, name, calibrated)


def open_sequence(name: str, path: str | os.PathLike[str], options: SequenceOptions | None = None) -> Recording:
    """Open one sequence of a data set.

    Args:
        name: data set, a key of `DATASETS`; "generic" reads recordings of your own; "auto" recognises the data set by
            its files (`locate_sequence` says what it found).
        path: folder (or, for generic, event file) of the sequence; the folder around it will do, too.
        options: how to read it; None means the defaults.

    Raises:
        InputError: unknown data set, missing path, or a recording that cannot be used. For a raw sequence the message
            says which command preprocesses it.
    """
    options = options if options is not None else SequenceOptions()
    if name == AUTO:
        found = locate_sequence(name, path, options).require_ready()
        return DATASETS[found.dataset].open(found.path, options)
    spec = DATASETS.get(name)
    if spec is None:
        raise InputError(f"unknown data set {name!r}, known are: {AUTO}, {', '.join(sorted(DATASETS))}")
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist, expected a sequence of data set {name!r}")
    try:
        found = locate_sequence(name, path, options)
    except AmbiguousError:
        raise
    except InputError:  # the reader knows better what it is missing
        return spec.open(path, options)
    return spec.open(found.path if found.ready else path, options)
