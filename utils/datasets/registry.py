"""Find the reader of a data set by name: one file per data set, one table row each."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from devo.errors import InputError
from utils.datasets.options import SequenceOptions
from utils.datasets.sequence import Sequence

__all__ = ["DATASETS", "DatasetSpec", "Sequence", "SequenceOptions", "open_sequence", "register"]

Opener = Callable[[Path, SequenceOptions], Sequence]


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


def register(name: str, summary: str) -> Callable[[Opener], Opener]:
    """Enter a class or function `(path, options) -> Sequence` in the table of data sets.

    Raises:
        InputError: the name is taken.
    """
    def enter(opener: Opener) -> Opener:
        if name in DATASETS:
            raise InputError(f"data set {name!r} is registered twice")
        DATASETS[name] = DatasetSpec(name, summary, opener)
        return opener

    return enter


def open_sequence(name: str, path: str | os.PathLike[str], options: SequenceOptions | None = None) -> Sequence:
    """Open one sequence of a data set.

    Args:
        name: data set, a key of `DATASETS`; "generic" reads recordings of your own.
        path: folder (or, for generic, event file) of the sequence.
        options: how to read it; None means the defaults.

    Raises:
        InputError: unknown data set, missing path, or a recording that cannot be used.
    """
    spec = DATASETS.get(name)
    if spec is None:
        raise InputError(f"unknown data set {name!r}, known are: {', '.join(sorted(DATASETS))}")
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist, expected a sequence of data set {name!r}")
    return spec.open(path, options if options is not None else SequenceOptions())
