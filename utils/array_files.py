"""Plain arrays as `.npy` and `.npz`, written completely or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path

import numpy as np

from utils.atomic import atomic_path


def save_array(path: str | PathLike[str], values: np.ndarray) -> Path:
    """Save one array as `.npy`; a missing suffix is added, as NumPy does. Returns the name of the file.

    Raises:
        OutputError: the file cannot be written.
    """
    target = _with_suffix(path, ".npy")
    with atomic_path(target) as temporary:
        np.save(temporary, values, allow_pickle=False)
    return target


def save_arrays(path: str | PathLike[str], values: Mapping[str, np.ndarray], *, compressed: bool = False) -> Path:
    """Save named arrays as `.npz` without pickles; a missing suffix is added. Returns the name of the file.

    Raises:
        OutputError: the file cannot be written.
    """
    target = _with_suffix(path, ".npz")
    with atomic_path(target) as temporary:
        (np.savez_compressed if compressed else np.savez)(temporary, **values)  # type: ignore[arg-type]
    return target


def _with_suffix(path: str | PathLike[str], suffix: str) -> Path:
    target = Path(path)
    return target if target.suffix == suffix else target.with_name(target.name + suffix)
