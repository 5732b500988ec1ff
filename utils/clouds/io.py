"""Read and write clouds by the suffix of the file name."""

from __future__ import annotations

import os
from pathlib import Path

from devo.errors import InputError
from utils.clouds.arrays import read_npy, read_npz, write_npy, write_npz
from utils.clouds.cloud import PointCloud
from utils.clouds.pcd import read_pcd, write_pcd
from utils.clouds.ply import read_ply, write_ply

_READERS = {".ply": read_ply, ".pcd": read_pcd, ".npy": read_npy, ".npz": read_npz}
_TEXT_WRITERS = {".ply": write_ply, ".pcd": write_pcd}
_ARRAY_WRITERS = {".npy": write_npy, ".npz": write_npz}

SUFFIXES = tuple(_READERS)
"""File name endings (lower case, with the dot) that `read_cloud` and `write_cloud` know."""


def read_cloud(path: str | os.PathLike[str]) -> PointCloud:
    """Read a cloud from a PLY, PCD, NPY or NPZ file.

    Raises:
        InputError: unknown suffix, missing file, or a file that is truncated or malformed.
    """
    return _READERS[_suffix(path)](path)


def write_cloud(
    path: str | os.PathLike[str], cloud: PointCloud, *, text: bool = False, drop_nonfinite: bool = False
) -> int:
    """Write a cloud as PLY, PCD, NPY or NPZ, completely or not at all.

    Args:
        path: the suffix chooses the format; NPY keeps the points alone, the others everything.
        cloud: what to write; byte-equal clouds give byte-equal files.
        text: ASCII instead of binary (PLY and PCD only); every value is recovered exactly.
        drop_nonfinite: leave out points with a coordinate that is NaN or infinite. Off, they are written as they are.

    Returns:
        How many points were left out.

    Raises:
        InputError: unknown suffix, or text asked of NPY or NPZ.
        OutputError: the file cannot be written.
    """
    suffix = _suffix(path)
    kept = cloud.select(cloud.finite_mask()) if drop_nonfinite else cloud
    if suffix in _TEXT_WRITERS:
        _TEXT_WRITERS[suffix](path, kept, text=text)
    elif text:
        raise InputError(f"{os.fspath(path)}: there is no text form of {suffix}; choose .ply or .pcd")
    else:
        _ARRAY_WRITERS[suffix](path, kept)
    return len(cloud) - len(kept)


def _suffix(path: str | os.PathLike[str]) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in _READERS:
        raise InputError(f"{os.fspath(path)}: unknown kind of cloud file; known are {', '.join(SUFFIXES)}")
    return suffix
