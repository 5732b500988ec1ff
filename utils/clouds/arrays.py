"""Clouds as NumPy files: NPY for the bare points, NPZ for everything; never with pickle."""

from __future__ import annotations

import io
import json
import os
import tokenize
import zipfile
import zlib

import numpy as np

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud
from utils.clouds.table import read_file, reject

_METADATA = "metadata_json"
_DAMAGED = (ValueError, TypeError, SyntaxError, EOFError, OSError, KeyError, MemoryError, OverflowError,
            NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError)
"""What NumPy and zipfile raise on damaged files."""


def write_npy(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Write the points alone, `(N, 3)` float32; colours, scalars and metadata have no place in this format.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array(file, cloud.points, allow_pickle=False)


def read_npy(path: str | os.PathLike[str]) -> PointCloud:
    """Read points from an `(N, 3)` array of any real type.

    Raises:
        InputError: missing, malformed, pickled, truncated or too long file, or another shape.
    """
    array = load_array(path)
    try:
        return PointCloud(array)
    except InputError as error:
        reject(path, str(error))


def load_array(path: str | os.PathLike[str]) -> np.ndarray:
    """The array of an `.npy` file, without pickle.

    Raises:
        InputError: missing, malformed, pickled, truncated or too long file.
    """
    return _parse_array(path, read_file(path))


def write_npz(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Write everything: `points`, `colors` (if any), one array per scalar in its own type, `metadata_json` (text).

    Raises:
        OutputError: the file cannot be written.
    """
    arrays = {"points": cloud.points, **cloud.scalars}
    if cloud.colors is not None:
        arrays["colors"] = cloud.colors
    arrays[_METADATA] = np.array(json.dumps(dict(cloud.metadata)))
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            # ZipInfo without a date keeps the file equal from run to run
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def read_npz(path: str | os.PathLike[str]) -> PointCloud:
    """Read what `write_npz` wrote; any archive with `points` and otherwise one-dimensional arrays will do.

    Raises:
        InputError: missing, malformed, pickled or truncated file, or arrays that do not fit together.
    """
    arrays = load_arrays(path)
    metadata = _parse_metadata(path, arrays.pop(_METADATA, np.array("{}")))
    if "points" not in arrays:
        reject(path, f"has no array named points, found {', '.join(sorted(arrays)) or 'nothing'}")
    try:
        return PointCloud(arrays.pop("points"), arrays.pop("colors", None), arrays, metadata)
    except InputError as error:
        reject(path, str(error))


def load_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file by name, without pickle.

    Raises:
        InputError: missing, malformed, pickled or truncated file.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_file(path))) as archive:
            members = {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}
    except _DAMAGED as error:
        reject(path, f"is no NPZ archive or a damaged one ({error})")
    return {name: _parse_array(path, content) for name, content in members.items()}


def _parse_array(path: str | os.PathLike[str], content: bytes) -> np.ndarray:
    """Like `np.load` without pickle, but sizes are compared before anything is allocated."""
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in read_header:
            reject(path, f"NPY format version {version} is not supported")
        shape, fortran_order, kind = read_header[version](stream)
    except _DAMAGED as error:
        reject(path, f"is no NPY array or a damaged one ({error})")
    if kind.hasobject:
        reject(path, "holds pickled Python objects, which are not loaded for safety; save it as a numeric array")
    count = 1
    for length in shape:
        count *= length
    left = len(content) - stream.tell()
    if min(shape, default=0) < 0 or count * kind.itemsize != left:
        reject(path, f"an array of shape {shape} and type {kind} needs {count * kind.itemsize} bytes, found {left}")
    try:
        return np.frombuffer(content, kind, count, stream.tell()).reshape(shape, order="F" if fortran_order else "C")
    except ValueError as error:
        reject(path, f"is no NPY array or a damaged one ({error})")


def _parse_metadata(path: str | os.PathLike[str], text: np.ndarray) -> dict[str, str]:
    try:
        metadata = json.loads(str(text)) if text.dtype.kind == "U" and text.ndim == 0 else None
    except ValueError:
        metadata = None
    if not isinstance(metadata, dict):
        reject(path, f"{_METADATA} is no JSON object")
    return metadata
