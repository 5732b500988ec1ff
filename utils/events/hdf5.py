"""Events in HDF5, in the layouts of DSEC (also TUM-VIE, VECtor), M3ED, MVSEC or with the columns at the root."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from devo.errors import InputError
from utils.events.hdf5_layouts import find_layout, is_complete
from utils.events.reader import RowReader
from utils.events.validate import (
    Column,
    Order,
    TimeUnit,
    check_guessed_unit,
    check_lengths,
    guess_time_unit,
    to_microseconds,
)

_DAMAGE = (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, OverflowError, MemoryError,
           UnicodeDecodeError)
_CHUNK_CACHE_BYTES = 16 << 20


@contextlib.contextmanager
def hdf5_errors(path: Path) -> Iterator[None]:
    """Turn what h5py raises on damaged or compressed files into one `InputError` that names the file."""
    try:
        yield
    except _DAMAGE as error:
        reason = " ".join(str(error).split()).strip("'\"")[:140] or type(error).__name__
        advice = "copy or write the file again"
        if "filter" in reason.lower() and "register" in reason.lower() or "can't open directory" in reason.lower():
            advice = "the compression filter is missing, reinstall hdf5plugin (pip install hdf5plugin)"
        raise InputError(f"{path}: damaged or unreadable HDF5 file ({reason}); {advice}") from error


def open_hdf5(path: Path) -> h5py.File:
    """Open an HDF5 file for reading with the Blosc filters registered.

    Raises:
        InputError: the file is missing, truncated or no HDF5 file.
    """
    import hdf5plugin  # noqa: F401  importing it is what registers the filters

    with hdf5_errors(path):
        return h5py.File(path, "r", rdcc_nbytes=_CHUNK_CACHE_BYTES)


class Hdf5EventReader(RowReader):
    """Events in an HDF5 file, found by binary search over `t`; `ms_to_idx` is not needed and not trusted.

    Arguments as in `open_events`; `path` may be an open `h5py.File`, which then stays open on `close`.
    The scalar `t_offset` (microseconds), where present, is added to all stamps. The sensor size comes from the
    root attributes `width` and `height` or from what lies beside the events if the caller gives none. `stream`
    picks one of several cameras (see `find_layout`).

    Raises:
        InputError: datasets are missing, of unequal length, not written to their end or damaged; see also
            `checked_events`.
    """

    format_name = "HDF5"

    def __init__(self, path: Path | h5py.File, sensor_size: tuple[int, int] | None = None,
                 time_unit: TimeUnit | None = None, order: Order = "error", stream: str | None = None) -> None:
        given_file = path if isinstance(path, h5py.File) else None
        super().__init__(Path(given_file.filename if given_file else path), sensor_size, order)  # type: ignore[arg-type]
        self._owns_file = given_file is None
        self._file = given_file if given_file is not None else open_hdf5(self.path)
        try:
            with hdf5_errors(self.path):
                layout = find_layout(self._file, self.path, stream)
                self._datasets = layout.columns
                self.rows = self._check_datasets()
                self.t_offset_us = self._read_offset()
                self.sensor_size = sensor_size or self._read_sensor_size() or layout.sensor_size
                self._unit: TimeUnit = time_unit or guess_time_unit(self._datasets["t"][:4096])
                self._align_blocks()
            if time_unit is None and self.rows:
                check_guessed_unit(self._stamps(0, min(self.rows, 4096)), self._unit, str(self.path))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file unless the caller opened it."""
        super().close()
        if self._owns_file:
            self._file.close()

    def _check_datasets(self) -> int:
        rows = check_lengths(self._datasets, str(self.path))
        for name, dataset in self._datasets.items():
            if dataset.dtype.kind not in "iufb":
                raise InputError(f"{self.path}: dataset {name} has dtype {dataset.dtype}, expected numbers")
            if not is_complete(dataset):
                raise InputError(f"{self.path}: dataset {name} announces {rows} events but parts of it were never "
                                 "written; the recording or conversion was interrupted, repeat it")
        return rows

    def _read_offset(self) -> int:
        if "t_offset" not in self._file:
            return 0
        value = np.asarray(self._file["t_offset"][()]).reshape(-1)
        if value.size != 1 or value.dtype.kind not in "iuf" or not np.isfinite(value[0]):
            raise InputError(f"{self.path}: t_offset is {value.tolist()}, expected one number of microseconds")
        if abs(float(value[0])) > 2.0**61:
            raise InputError(f"{self.path}: t_offset is {value[0]} us, which is out of any range")
        return int(value[0])

    def _read_sensor_size(self) -> tuple[int, int] | None:
        attributes = self._file.attrs
        if "width" not in attributes or "height" not in attributes:
            return None
        width, height = int(attributes["width"]), int(attributes["height"])
        if not (1 <= width <= 65536 and 1 <= height <= 65536):
            raise InputError(f"{self.path}: the attributes say a sensor of {width}x{height} pixels")
        return width, height

    def _align_blocks(self) -> None:
        """Let blocks end where compressed chunks end, so that no chunk is decompressed twice."""
        chunk = self._datasets["t"].chunks
        if chunk is not None and 0 < chunk[0] <= 4 * self.rows_per_block:
            self.rows_per_block = -(-self.rows_per_block // chunk[0]) * chunk[0]

    def _stamps(self, first: int, last: int) -> np.ndarray:
        with hdf5_errors(self.path):
            stamps = self._datasets["t"][first:last]
        t_us = to_microseconds(stamps, self._unit, lambda i: f"{self.path}: event {first + i}")
        return t_us + self.t_offset_us if self.t_offset_us else t_us

    def _columns(self, first: int, last: int) -> tuple[Column, Column, np.ndarray, Column]:
        with hdf5_errors(self.path):
            x, y, p = (self._datasets[name][first:last] for name in "xyp")
        return x, y, self._stamps(first, last), p

    def _block_start_us(self, block: int) -> int:
        row = block * self.rows_per_block
        return int(self._stamps(row, row + 1)[0])

    def time_range_us(self) -> tuple[int, int]:
        """Return the stamps of the first and of the last event in microseconds."""
        return int(self._stamps(0, 1)[0]), int(self._stamps(self.rows - 1, self.rows)[0])
