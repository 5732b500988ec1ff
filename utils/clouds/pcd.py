"""PCD v0.7, the point cloud format of PCL and ROS: writer, and a strict reader."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud
from utils.clouds.comments import metadata_from_comments, metadata_to_comments
from utils.clouds.table import (
    COLOR_NAMES,
    cloud_columns,
    cloud_from_columns,
    format_rows,
    parse_rows,
    read_file,
    reject,
    to_rows,
)

_SIZES: Mapping[str, tuple[int, ...]] = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}
_ENTRIES = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_LONGEST_HEADER = 1 << 20


def write_pcd(path: str | os.PathLike[str], cloud: PointCloud, *, text: bool = False) -> None:
    """Write a cloud as PCD v0.7, binary unless `text`.

    Fields are x, y, z, then `rgb` (the bytes 0, red, green, blue as one float, as PCL packs them) where the cloud
    has colours, then one field per scalar (64-bit integers: see `table.portable`). Metadata becomes comments.

    Raises:
        OutputError: the file cannot be written, or a scalar fits no PCD type.
    """
    columns = cloud_columns(cloud)
    if cloud.colors is not None:
        packed = _pack_colors(cloud.colors)
        columns = {name: values for name, values in columns.items() if name not in COLOR_NAMES}
        columns = {**{axis: columns.pop(axis) for axis in "xyz"}, "rgb": packed, **columns}
    rows = to_rows(columns)
    types = [rows.dtype[name] for name in columns]
    header = "\n".join([
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {line}" for line in metadata_to_comments(cloud.metadata)),
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in types)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in types)}",
        f"COUNT {' '.join('1' for _ in types)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        f"DATA {'ascii' if text else 'binary'}",
        "",
    ]).encode("ascii")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header)
        file.write(format_rows(rows) if text else rows.tobytes())


def read_pcd(path: str | os.PathLike[str]) -> PointCloud:
    """Read a PCD file, ASCII or binary, with any fields; `rgb` or `rgba` becomes colours (alpha is dropped).

    A field with a COUNT above one becomes one scalar per number (`name_0`, `name_1`, ...); padding (`_`) is
    skipped. An organised cloud is flattened row by row.

    Raises:
        InputError: the file is missing, truncated, longer than its header says, compressed or otherwise malformed.
    """
    data = read_file(path)
    header, comments, start = _parse_header(path, data)
    row_type = _row_type(path, header)
    width, height, points = (_number(path, header, entry) for entry in ("WIDTH", "HEIGHT", "POINTS"))
    if width * height != points:
        reject(path, f"WIDTH {width} x HEIGHT {height} is not POINTS {points}")
    if header["DATA"] == ["ascii"]:
        lines = [line for line in data[start:].decode("latin-1").split("\n") if line.strip()]
        if len(lines) != points:
            reject(path, f"POINTS is {points}, found {len(lines)} lines of data")
        rows = parse_rows(path, lines, row_type)
    elif header["DATA"] == ["binary"]:
        if len(data) - start != points * row_type.itemsize:
            reject(path, f"{points} points need {points * row_type.itemsize} bytes, found {len(data) - start}")
        rows = np.frombuffer(data, row_type, points, start)
    else:
        reject(path, f"DATA {' '.join(header['DATA'])} is not supported, only ascii and binary; "
                     "convert it with pcl_convert_pcd_ascii_binary")
    columns = {name: rows[name] for name in row_type.names or () if not name.startswith("_ ")}
    for name in ("rgb", "rgba"):
        if name in columns:
            columns.update(_unpack_colors(path, columns.pop(name)))
    return cloud_from_columns(path, columns, metadata_from_comments(comments))


def _pack_colors(colors: np.ndarray) -> np.ndarray:
    words = colors.astype(np.uint32)
    return ((words[:, 0] << 16) | (words[:, 1] << 8) | words[:, 2]).view(np.float32)


def _unpack_colors(path: str | os.PathLike[str], packed: np.ndarray) -> dict[str, np.ndarray]:
    if packed.dtype.itemsize != 4:
        reject(path, f"packed colours must have SIZE 4, found {packed.dtype.itemsize}")
    words = np.ascontiguousarray(packed).view(np.uint32)
    return {name: ((words >> shift) & 255).astype(np.uint8) for name, shift in zip(COLOR_NAMES, (16, 8, 0))}


def _parse_header(path: str | os.PathLike[str], data: bytes) -> tuple[dict[str, list[str]], list[str], int]:
    """The entries by name, the comments, and the offset of the data."""
    header: dict[str, list[str]] = {}
    comments: list[str] = []
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at, _LONGEST_HEADER)
        if end < 0:
            reject(path, "the header has no DATA line; the file is no PCD, truncated or damaged")
        line = data[at:end].decode("latin-1").rstrip("\r")
        at = end + 1
        words = line.split()
        if line.startswith("#"):
            comments.append(line[2:])
        elif words:
            if words[0] not in _ENTRIES or words[0] in header:
                reject(path, f"header line {line[:80]!r} cannot be understood")
            header[words[0]] = words[1:]
    if comments and comments[0].startswith(".PCD"):
        comments.pop(0)
    return header, comments, at


def _row_type(path: str | os.PathLike[str], header: dict[str, list[str]]) -> np.dtype:
    """Type of one point; each number of a field that has several is a field of its own, padding begins with `_ `."""
    for entry in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS"):
        if entry not in header:
            reject(path, f"the header has no {entry} line")
    fields = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(fields))
    if not len(fields) == len(header["SIZE"]) == len(header["TYPE"]) == len(counts):
        reject(path, f"FIELDS, SIZE, TYPE and COUNT have {len(fields)}, {len(header['SIZE'])}, "
                     f"{len(header['TYPE'])} and {len(counts)} entries")
    types: list[tuple[str, str]] = []
    for name, size, kind, count in zip(fields, header["SIZE"], header["TYPE"], counts):
        if size not in map(str, _SIZES.get(kind, ())) or not _is_number(count) or not 0 < int(count) <= 4096:
            reject(path, f"field {name} has type {kind}, size {size} and count {count}, which PCD does not know")
        code = f"<{kind.lower()}{size}"
        if name == "_":
            types += [(f"_ {len(types) + number}", code) for number in range(int(count))]
        else:
            types += [(name if count == "1" else f"{name}_{number}", code) for number in range(int(count))]
    names = [name for name, _ in types]
    if len(set(names)) != len(names):
        reject(path, f"FIELDS {' '.join(fields)} repeat a name")
    return np.dtype(types)


def _number(path: str | os.PathLike[str], header: dict[str, list[str]], entry: str) -> int:
    words = header[entry]
    if len(words) != 1 or not _is_number(words[0]):
        reject(path, f"{entry} must be one whole number, found {' '.join(words)[:80]!r}")
    return int(words[0])


def _is_number(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) < 16  # str.isdigit alone accepts superscripts
