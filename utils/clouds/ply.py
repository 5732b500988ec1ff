"""PLY, the Stanford polygon file format: writer, and a strict reader of the vertex element."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud
from utils.clouds.comments import metadata_from_comments, metadata_to_comments
from utils.clouds.table import (
    cloud_columns,
    cloud_from_columns,
    format_rows,
    parse_rows,
    read_file,
    reject,
    to_rows,
)

_TYPES: Mapping[str, str] = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}
_TYPE_NAMES = {code: name for name, code in list(_TYPES.items())[:8]}  # the classic names: all readers know them
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20


def write_ply(path: str | os.PathLike[str], cloud: PointCloud, *, text: bool = False) -> None:
    """Write a cloud as PLY, binary little-endian unless `text`.

    The vertex element holds float x, y, z, then uchar red, green, blue where the cloud has colours, then one
    property per scalar in its own type (64-bit integers: see `table.portable`). Metadata becomes comments.

    Raises:
        OutputError: the file cannot be written, or a scalar fits no PLY type.
    """
    rows = to_rows(cloud_columns(cloud))
    lines = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0"]
    lines += [f"comment {line}" for line in metadata_to_comments(cloud.metadata)]
    lines += [f"element vertex {len(rows)}"]
    lines += [f"property {_TYPE_NAMES[rows.dtype[name].str[1:]]} {name}" for name in rows.dtype.names or ()]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header)
        file.write(format_rows(rows) if text else rows.tobytes())


def read_ply(path: str | os.PathLike[str]) -> PointCloud:
    """Read the vertices of a PLY file: ASCII or binary of either byte order, any property types.

    Other elements and their lists are skipped, comments become metadata, and properties other than coordinates and
    colours become scalars.

    Raises:
        InputError: the file is missing, truncated, longer than its header says, or otherwise malformed.
    """
    data = read_file(path)
    header = _parse_header(path, data)
    if "vertex" not in [element.name for element in header.elements]:
        reject(path, "no vertex element")
    rows = _read_text(path, data, header) if header.byte_order == "" else _read_binary(path, data, header)
    columns = {name: rows[name] for name in rows.dtype.names or ()}
    return cloud_from_columns(path, columns, metadata_from_comments(header.comments))


@dataclass
class _Element:
    """One element of the header: `properties` maps a name to its type, or to (count type, item type) for a list."""

    name: str
    count: int
    properties: dict[str, str | tuple[str, str]] = field(default_factory=dict)

    def row_type(self, byte_order: str, list_lengths: tuple[int, ...] = ()) -> np.dtype:
        """Type of one row whose lists, in order, have the given lengths."""
        lengths = iter(list_lengths)
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for name, kind in self.properties.items():
            if isinstance(kind, tuple):
                fields += [(f"{name} length", byte_order + kind[0]), (name, byte_order + kind[1], (next(lengths),))]
            else:
                fields.append((name, byte_order + kind))
        return np.dtype(fields)

    @property
    def lists(self) -> list[str]:
        """Names of the list properties."""
        return [name for name, kind in self.properties.items() if isinstance(kind, tuple)]


@dataclass
class _Header:
    byte_order: str
    elements: list[_Element]
    comments: list[str]
    size: int


def _parse_header(path: str | os.PathLike[str], data: bytes) -> _Header:
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        reject(path, f"is no PLY file, it begins with {data[:16]!r}")
    end = data.find(b"\nend_header", 0, _LONGEST_HEADER) + 1
    close = data.find(b"\n", end) + 1
    if end == 0 or close == 0 or data[end + len(b"end_header") : close].strip():
        reject(path, "the header has no end_header line, the file is truncated or damaged")
    header = _Header("?", [], [], close)
    for line in data[:end].decode("latin-1").replace("\r\n", "\n").split("\n")[1:]:
        _parse_header_line(path, line, header)
    if header.byte_order == "?":
        reject(path, "the header has no format line")
    return header


def _parse_header_line(path: str | os.PathLike[str], line: str, header: _Header) -> None:
    match line.split():
        case []:
            pass
        case ["comment" | "obj_info" as word, *_]:
            header.comments.append(line.lstrip()[len(word) + 1 :])
        case ["format", name, "1.0"] if name in _FORMATS and header.byte_order == "?":
            header.byte_order = _FORMATS[name]
        case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
            if name in [element.name for element in header.elements]:
                reject(path, f"element {name} occurs twice")
            header.elements.append(_Element(name, int(count)))
        case ["property", *kind, name] if header.elements and name not in header.elements[-1].properties:
            header.elements[-1].properties[name] = _property_type(path, line, kind)
        case _:
            reject(path, f"header line {line[:80]!r} cannot be understood")


def _property_type(path: str | os.PathLike[str], line: str, words: list[str]) -> str | tuple[str, str]:
    codes = [_TYPES.get(word, "") for word in words[-2:]]
    is_list = len(words) == 3 and words[0] == "list" and codes[0][:1] in ("i", "u")
    if "" in codes or not (is_list or len(words) == 1):
        reject(path, f"header line {line[:80]!r} names no type this format has")
    return (codes[0], codes[1]) if is_list else codes[0]


def _vertex_type(path: str | os.PathLike[str], vertex: _Element, byte_order: str) -> np.dtype:
    if vertex.lists:
        reject(path, f"vertices with lists ({', '.join(vertex.lists)}) are not supported; remove that property")
    if not vertex.properties:
        reject(path, "the vertex element has no properties")
    return vertex.row_type(byte_order)


def _read_text(path: str | os.PathLike[str], data: bytes, header: _Header) -> np.ndarray:
    lines = [line for line in data[header.size :].decode("latin-1").split("\n") if line.strip()]
    promised = sum(element.count for element in header.elements)
    if len(lines) != promised:
        reject(path, f"the header promises {promised} lines of data, found {len(lines)}")
    start = 0
    for element in header.elements:
        if element.name == "vertex":
            break
        start += element.count
    return parse_rows(path, lines[start : start + element.count], _vertex_type(path, element, "<"))


def _read_binary(path: str | os.PathLike[str], data: bytes, header: _Header) -> np.ndarray:
    at, rows = header.size, None
    for element in header.elements:
        if element.name == "vertex":
            row_type = _vertex_type(path, element, header.byte_order)
            _require(path, data, at, element.count * row_type.itemsize, element)
            rows = np.frombuffer(data, row_type, element.count, at)
        at = _end_of_element(path, data, at, element, header.byte_order)
    if at != len(data):
        reject(path, f"{len(data) - at} bytes more than the header promises")
    assert rows is not None  # read_ply saw a vertex element
    return rows


def _require(path: str | os.PathLike[str], data: bytes, at: int, size: int, element: _Element) -> None:
    if at + size > len(data):
        reject(path, f"truncated: {element.count} rows of {element.name} need {size} bytes, "
                     f"found {max(0, len(data) - at)}")


def _end_of_element(path: str | os.PathLike[str], data: bytes, at: int, element: _Element, byte_order: str) -> int:
    """Offset behind an element's rows; rows with lists of one common length (triangles) are passed in one step."""
    if element.count == 0 or not element.properties:
        return at
    if not element.lists:
        size = element.count * element.row_type(byte_order).itemsize
        _require(path, data, at, size, element)
        return at + size
    lengths = _list_lengths(path, data, at, element, byte_order)
    row_type = element.row_type(byte_order, lengths)
    if at + element.count * row_type.itemsize <= len(data):
        rows = np.frombuffer(data, row_type, element.count, at)
        if all((rows[f"{name} length"] == length).all() for name, length in zip(element.lists, lengths)):
            return at + element.count * row_type.itemsize
    for _ in range(element.count):
        lengths = _list_lengths(path, data, at, element, byte_order)
        at += element.row_type(byte_order, lengths).itemsize
    _require(path, data, at, 0, element)
    return at


def _list_lengths(
    path: str | os.PathLike[str], data: bytes, at: int, element: _Element, byte_order: str
) -> tuple[int, ...]:
    """Lengths of the lists in the row that begins at `at`."""
    lengths: list[int] = []
    for kind in element.properties.values():
        item = np.dtype(byte_order + (kind[0] if isinstance(kind, tuple) else kind))
        _require(path, data, at, item.itemsize, element)
        if isinstance(kind, tuple):
            length = int(np.frombuffer(data, item, 1, at)[0])
            if not 0 <= length * np.dtype(kind[1]).itemsize <= len(data):
                reject(path, f"truncated or damaged: a list of {element.name} claims {length} items")
            lengths.append(length)
            at += length * np.dtype(kind[1]).itemsize
        at += item.itemsize
    return tuple(lengths)
