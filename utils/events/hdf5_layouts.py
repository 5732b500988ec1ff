"""Where the events are in an HDF5 file: DSEC / TUM-VIE / VECtor, columns at the root, M3ED, MVSEC."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from devo.errors import InputError
from utils.events.streams import choose_stream


class TableColumn:
    """One column of a table (N, C), with as much of a dataset's interface as the reader uses."""

    ndim = 1

    def __init__(self, dataset: h5py.Dataset, column: int) -> None:
        self.dataset = dataset
        self._column = column
        self.dtype = dataset.dtype
        self.shape = dataset.shape[:1]
        self.chunks = dataset.chunks

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.dataset[rows, self._column]


class Layout(NamedTuple):
    """The columns x, y, t, p of one event stream.

    Attributes:
        columns: "x", "y", "t", "p" -> dataset or `TableColumn`.
        sensor_size: (width, height) in pixels where the file tells it beside the events.
    """

    columns: dict[str, Any]
    sensor_size: tuple[int, int] | None


def find_layout(file: h5py.File, path: Path, stream: str | None) -> Layout:
    """Find the events of one camera.

    `events/{x,y,t,p}` or `{x,y,t,p}` at the root hold one camera. Otherwise every group with these four datasets
    (M3ED: `prophesee/left`) and every table `events` (N,4) with the columns x y t p (MVSEC: `davis/left/events`) is
    one, and `stream` picks it by its path or a part of it.

    Raises:
        InputError: datasets are missing, or several cameras and no choice.
    """
    group: Any = file
    if isinstance(file.get("events"), h5py.Group) and "x" not in file:
        group = file["events"]
    missing = [name for name in "xytp" if not isinstance(group.get(name), h5py.Dataset)]
    if not missing:
        if stream is not None:
            choose_stream([group.name], stream, str(path))
        return Layout({name: group[name] for name in "xytp"}, None)
    found = _find_cameras(file)
    if not found:
        listing = ", ".join(sorted(group.keys())) or "nothing"
        raise InputError(f"{path}: dataset{'s' * (len(missing) > 1)} {', '.join(missing)} missing in "
                         f"{group.name!r}, found {listing}; expected events/x, y, t, p or x, y, t, p at the root")
    camera = file[choose_stream(found, stream, str(path))]
    if isinstance(camera, h5py.Dataset):
        return Layout({name: TableColumn(camera, column) for column, name in enumerate("xytp")},
                      _size_of_images(camera.parent))
    return Layout({name: camera[name] for name in "xytp"}, _size_of_calibration(camera))


def is_complete(dataset: Any) -> bool:
    """Return whether all of a dataset was written; HDF5 would invent zeros for the rest."""
    if isinstance(dataset, TableColumn):
        dataset = dataset.dataset
    if dataset.chunks is None:
        return bool(dataset.id.get_storage_size() >= dataset.size * dataset.dtype.itemsize)
    expected = math.prod(-(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks))
    return bool(dataset.id.get_num_chunks() >= expected)


def _find_cameras(file: h5py.File) -> list[str]:
    found: list[str] = []

    def look(name: str, item: Any) -> None:
        if isinstance(item, h5py.Group):
            if all(isinstance(item.get(column), h5py.Dataset) for column in "xytp"):
                found.append(name)
        elif name.rpartition("/")[2] == "events" and item.ndim == 2 and item.shape[1] == 4:
            found.append(name)

    file.visititems(look)
    return found


def _size_of_images(group: Any) -> tuple[int, int] | None:
    """Return the size of the frames that a DAVIS recorded beside the events, (N, height, width)."""
    images = group.get("image_raw")
    if isinstance(images, h5py.Dataset) and images.ndim == 3:
        return int(images.shape[2]), int(images.shape[1])
    return None


def _size_of_calibration(group: Any) -> tuple[int, int] | None:
    """Return the resolution (width, height) of the calibration beside the events."""
    resolution = group.get("calib/resolution")
    if isinstance(resolution, h5py.Dataset) and resolution.shape == (2,) and resolution.dtype.kind in "iu":
        width, height = map(int, resolution[:])
        if 0 < width <= 65536 and 0 < height <= 65536:
            return width, height
    return None
