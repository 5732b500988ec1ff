"""Clouds as tables with one typed column per property: what PLY and PCD have in common."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from devo.errors import InputError, OutputError
from utils.clouds.cloud import RESERVED_NAMES, PointCloud

COLOR_NAMES = ("red", "green", "blue")
_EXACT_IN_FLOAT64 = 2**53


def reject(path: str | os.PathLike[str], problem: str) -> NoReturn:
    """Raise an `InputError` that names the file."""
    raise InputError(f"{os.fspath(path)}: {problem}")


def read_file(path: str | os.PathLike[str]) -> bytes:
    """The whole content of a file; `InputError` if there is none to read."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        reject(path, f"cannot be read ({error.strerror or error}); check the path")


def portable(name: str, values: np.ndarray) -> np.ndarray:
    """A column in a type that PLY and PCD readers know: int8..int32, uint8..uint32, float32 or float64.

    Booleans become uint8, half floats float32, 64-bit integers int32 where they fit and float64 (exact up to
    2**53, which holds microseconds since 1970) elsewhere.

    Raises:
        OutputError: a 64-bit integer that no such type holds exactly.
    """
    if values.dtype == bool:
        return values.astype(np.uint8)
    if values.dtype.kind == "f":
        return values.astype(np.float32 if values.dtype.itemsize <= 4 else np.float64)
    if values.dtype.itemsize <= 4:
        return values.astype(values.dtype.newbyteorder("="))
    lowest, highest = (int(values.min()), int(values.max())) if len(values) else (0, 0)
    if lowest >= -(2**31) and highest < 2**31:
        return values.astype(np.int32)
    if lowest >= -_EXACT_IN_FLOAT64 and highest <= _EXACT_IN_FLOAT64:
        return values.astype(np.float64)
    raise OutputError(f"{name} holds integers up to {max(abs(lowest), abs(highest))}, which this file format cannot "
                      "store exactly; write .npz instead")


def cloud_columns(cloud: PointCloud) -> dict[str, np.ndarray]:
    """Columns x, y, z, then red, green, blue where there are colours, then the scalars in portable types."""
    columns = {axis: cloud.points[:, number] for number, axis in enumerate("xyz")}
    if cloud.colors is not None:
        columns.update({name: cloud.colors[:, number] for number, name in enumerate(COLOR_NAMES)})
    columns.update({name: portable(name, values) for name, values in cloud.scalars.items()})
    return columns


def to_rows(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """A packed little-endian structured array with one field per column."""
    count = len(next(iter(columns.values())))
    rows = np.empty(count, dtype=[(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows


def format_rows(rows: np.ndarray) -> bytes:
    """The rows as text, one line each, with as many digits as give every value back exactly."""
    digits = {"f4": "%.9g", "f8": "%.17g"}
    names = rows.dtype.names or ()
    template = " ".join(digits.get(rows.dtype[name].str[1:], "%d") for name in names) + "\n"
    return "".join(template % row for row in rows.tolist()).encode("ascii")


def parse_rows(path: str | os.PathLike[str], lines: Sequence[str], row_type: np.dtype) -> np.ndarray:
    """The values of text lines as a structured array of `row_type`.

    Raises:
        InputError: a line has another number of values, a value is no number, or it does not fit its column's type.
    """
    names = row_type.names or ()
    rows = np.zeros(len(lines), dtype=row_type)
    if not lines:
        return rows
    try:
        table = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None)
    except ValueError as error:
        reject(path, f"the point table is damaged: {error}")
    if table.shape != (len(lines), len(names)):
        reject(path, f"expected {len(lines)} lines of {len(names)} values, found {table.shape[0]} of {table.shape[1]}")
    for number, name in enumerate(names):
        column, field_type = table[:, number], row_type[name]
        if field_type.kind != "f":
            limits = np.iinfo(field_type)
            fits = (column == np.rint(column)) & (column >= limits.min) & (column <= limits.max)
            if not fits.all():
                reject(path, f"{name} holds {column[~fits][0]:g}, which is no {field_type.name}")
        with np.errstate(over="ignore"):
            rows[name] = column.astype(field_type)
    return rows


def cloud_from_columns(
    path: str | os.PathLike[str], columns: Mapping[str, np.ndarray], metadata: Mapping[str, str]
) -> PointCloud:
    """The cloud of a file's columns, coordinates and colours recognised by their names.

    Float colours are taken as 0..1. A column whose name a scalar may not have is kept under the nearest name that
    it may have: other characters than letters, digits, `_`, `.` and `-` become `_`, reserved names get a trailing `_`.
    """
    left = dict(columns)
    missing = [axis for axis in "xyz" if axis not in left]
    if missing:
        reject(path, f"points need x, y and z, found {', '.join(left) or 'nothing'}")
    points = np.stack([_as_float32(left.pop(axis)) for axis in "xyz"], axis=1)
    colors = None
    if all(name in left for name in COLOR_NAMES):
        colors = np.stack([_color_channel(path, name, left.pop(name)) for name in COLOR_NAMES], axis=1)
    scalars = {}
    for name, values in left.items():
        kept = _scalar_name(name)
        while kept in scalars:
            kept += "_"
        scalars[kept] = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))
    try:
        return PointCloud(points, colors, scalars, metadata)
    except InputError as error:
        reject(path, str(error))


def _scalar_name(name: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
    if not name[:1].isalpha():
        name = f"_{name}"
    return f"{name}_" if name.lower() in RESERVED_NAMES else name


def _as_float32(values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _color_channel(path: str | os.PathLike[str], name: str, values: np.ndarray) -> np.ndarray:
    if values.dtype == np.uint8:
        return values
    if values.dtype.kind == "f" and bool(((values >= 0) & (values <= 1)).all()):
        return np.rint(values * 255).astype(np.uint8)
    reject(path, f"{name} must be uchar, or a float within 0..1, found {values.dtype.name}")
