"""COLMAP models as text (`cameras.txt images.txt points3D.txt`) or binary (`.bin`), completely or not at all."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.colmap.model import ColmapModel

PINHOLE = 1
"""Number of the pinhole model in binary files."""
FILES = ("cameras", "images", "points3D")
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_TRACK = np.dtype([("image", "<u4"), ("slot", "<u4")])
_SEEN = np.dtype([("xy", "<f8", 2), ("point", "<u8")])


def write_model(folder: str | os.PathLike[str], model: ColmapModel, kind: str = "text") -> list[Path]:
    """Write the three files of a model.

    Args:
        folder: made if it is missing; files of the same names are replaced, those of the other kind removed, because
            COLMAP would read them instead.
        model: what to write; numbers are counted from 1.
        kind: `text` or `binary`.

    Returns:
        The files.

    Raises:
        InputError: an unknown kind.
        OutputError: a file cannot be written.
    """
    kinds: dict[str, tuple[str, tuple[Callable[[ColmapModel], bytes], ...]]] = {
        "text": (".txt", (_cameras_text, _images_text, _points_text)),
        "binary": (".bin", (_cameras_binary, _images_binary, _points_binary))}
    if kind not in kinds:
        raise InputError(f"a COLMAP model is {' or '.join(kinds)}, found {kind!r}")
    suffix, writers = kinds[kind]
    written = [Path(folder) / f"{name}{suffix}" for name in FILES]
    for path, writer in zip(written, writers):
        with atomic_path(path) as temporary:
            temporary.write_bytes(writer(model))
    other = ".bin" if kind == "text" else ".txt"
    for name in (*FILES, "rigs", "frames"):
        (Path(folder) / f"{name}{other}").unlink(missing_ok=True)
    return written


# --- text -----------------------------------------------------------------------------------------------------


def _cameras_text(model: ColmapModel) -> bytes:
    numbers = " ".join(f"{value:.17g}" for value in model.intrinsics.tolist())
    return (f"# CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy; (0, 0) is the corner of the first pixel\n"
            f"1 PINHOLE {model.size[0]} {model.size[1]} {numbers}\n").encode()


def _images_text(model: ColmapModel) -> bytes:
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME (world to camera; scale is arbitrary)",
             "# POINTS2D as X Y POINT3D_ID"]
    for number, (name, rows) in enumerate(zip(model.names, model.of_images()), start=1):
        pose = " ".join(f"{value:.17g}" for value in model.cam_T_world[number - 1, [6, 3, 4, 5, 0, 1, 2]].tolist())
        lines.append(f"{number} {pose} 1 {name}")
        seen = np.column_stack([model.pixel_xy[rows], model.point[rows] + 1])
        lines.append(("%.9g %.9g %d " * len(rows) % tuple(seen.ravel().tolist())).rstrip())
    return ("\n".join(lines) + "\n").encode()


def _points_text(model: ColmapModel) -> bytes:
    head = "%d %.9g %.9g %.9g %d %d %d %.9g"
    lengths = model.track_lengths()
    template = [head + " %d %d" * length + "\n" for length in range(int(lengths.max(initial=0)) + 1)]
    rows = np.column_stack([np.arange(1, len(lengths) + 1), model.points, model.colors, model.errors])
    tracks = np.column_stack([model.image + 1, model.slot]).astype(np.float64)
    starts = np.cumsum(lengths) - lengths
    values = np.empty(rows.size + tracks.size)
    at = 8 * np.arange(len(rows)) + 2 * starts
    values[at[:, None] + np.arange(8)] = rows
    observed = np.repeat(at + 8 - 2 * starts, lengths) + 2 * np.arange(len(tracks))
    values[observed[:, None] + np.arange(2)] = tracks
    text = "".join(map(template.__getitem__, lengths.tolist())) % tuple(values.tolist())
    return ("# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX\n" + text).encode()


# --- binary ---------------------------------------------------------------------------------------------------


def _cameras_binary(model: ColmapModel) -> bytes:
    return struct.pack("<QIiQQ4d", 1, 1, PINHOLE, *model.size, *model.intrinsics.tolist())


def _images_binary(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.names))]
    for number, (name, rows) in enumerate(zip(model.names, model.of_images()), start=1):
        parts.append(struct.pack("<I7dI", number, *model.cam_T_world[number - 1, [6, 3, 4, 5, 0, 1, 2]].tolist(), 1))
        seen = np.empty(len(rows), _SEEN)
        seen["xy"], seen["point"] = model.pixel_xy[rows], model.point[rows] + 1
        parts += [name.encode() + b"\0", struct.pack("<Q", len(rows)), seen.tobytes()]
    return b"".join(parts)


def _points_binary(model: ColmapModel) -> bytes:
    lengths = model.track_lengths()
    heads, tracks = np.empty(len(lengths), _POINT), np.empty(len(model.point), _TRACK)
    heads["id"], heads["xyz"], heads["rgb"] = np.arange(1, len(lengths) + 1), model.points, model.colors
    heads["error"], heads["length"] = model.errors, lengths
    tracks["image"], tracks["slot"] = model.image + 1, model.slot
    starts = np.cumsum(lengths) - lengths
    at = _POINT.itemsize * np.arange(len(heads)) + _TRACK.itemsize * starts
    before = _POINT.itemsize * (np.repeat(np.arange(len(heads)), lengths) + 1)
    content = np.empty(heads.nbytes + tracks.nbytes, np.uint8)
    _place(content, at, heads)
    _place(content, before + _TRACK.itemsize * np.arange(len(tracks)), tracks)
    return struct.pack("<Q", len(heads)) + content.tobytes()


def _place(content: npt.NDArray[np.uint8], at: npt.NDArray[np.int64], records: npt.NDArray[np.void]) -> None:
    """Write packed records at byte positions."""
    size = records.dtype.itemsize
    content[at[:, None] + np.arange(size)] = records.view(np.uint8).reshape(len(records), size)
