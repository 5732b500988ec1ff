"""Write events as HDF5 (DSEC layout, also piece by piece), NPZ and text; files appear complete or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.events.hdf5_output import create_hdf5
from utils.events.text import format_events
from utils.events.types import Events
from utils.events.validate import make_events

Compression = Literal["blosc", "gzip", "none"]
_CHUNK_EVENTS = 1 << 16
_LONGEST_SPAN_US = 30 * 86_400 * 1_000_000
_UINT32_END = 1 << 32


def compute_ms_to_idx(tss_ns: npt.ArrayLike, ms_start: int = 0) -> npt.NDArray[np.uint64]:
    """Index events by millisecond: entry k counts the events before `1e6 * (ms_start + k)` nanoseconds.

    Args:
        tss_ns: (N,) sorted stamps in nanoseconds, not negative.
        ms_start: first millisecond of the index.

    Returns:
        (M,) uint64 for the milliseconds from `ms_start` to that of the last event.

    Raises:
        InputError: no stamps, or they are unsorted or negative.
    """
    stamps = np.asarray(tss_ns)
    if stamps.ndim != 1 or not len(stamps):
        raise InputError(f"stamps have shape {stamps.shape}, expected (N,) with at least one event")
    if stamps[0] < 0 or np.any(stamps[1:] < stamps[:-1]):
        raise InputError("stamps must be sorted and not negative to be indexed by millisecond")
    last_ms = int(stamps[-1]) // 1_000_000
    borders = np.arange(ms_start, last_ms + 1, dtype=np.int64) * 1_000_000
    return np.searchsorted(stamps, borders, side="left").astype(np.uint64)


class EventH5Writer:
    """Write a long recording piece by piece into one HDF5 file of the DSEC layout.

    Datasets: `events/x`, `events/y` uint16; `events/t` uint32 microseconds after `t_offset` (uint64 once the
    recording outgrows 71 minutes); `events/p` uint8; `ms_to_idx` uint64; scalar `t_offset` int64. Chunks carry
    checksums. The file appears under its name when the `with` block ends without an error.

    Args:
        path: the file to write.
        t_offset_us: subtracted from all stamps and stored; None takes the stamp of the first event.
        sensor_size: (width, height) in pixels, stored as root attributes and used to check coordinates.
        compression: "blosc" (zstd, needs hdf5plugin to read), "gzip" or "none".

    Raises:
        InputError: events run backwards, start before `t_offset_us`, or end more than 30 days after it.
        OutputError: the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], *, t_offset_us: int | None = 0,
                 sensor_size: tuple[int, int] | None = None, compression: Compression = "blosc") -> None:
        self.path = Path(path)
        self._offset_us = t_offset_us
        self._sensor_size = sensor_size
        self._filter = _filter_options(compression)
        self._stack = contextlib.ExitStack()
        self._rows = 0
        self._last_us = 0
        self._index: list[npt.NDArray[np.uint64]] = []
        self._indexed_ms = 0

    def __enter__(self) -> EventH5Writer:
        self._output = self._stack.enter_context(create_hdf5(self.path))
        self._file = self._output.file
        try:
            group = self._file.create_group("events")
            for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.uint32), ("p", np.uint8)):
                self._create(group, name, dtype)
        except BaseException as error:
            if not self._stack.__exit__(type(error), error, error.__traceback__):
                raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        with self._stack:  # unwinds even if finishing fails
            if error is None:
                self._finish()
            else:
                self._stack.__exit__(kind, error, trace)

    def write(self, events: Events) -> None:
        """Append events that start at or after the last one written."""
        if not len(events):
            return
        if self._sensor_size is not None:
            for axis, column, limit in zip("xy", (events.x, events.y), self._sensor_size):
                if int(column.max()) >= limit:
                    raise InputError(f"cannot write {self.path}: {axis} = {int(column.max())} is outside the sensor of "
                                     f"{self._sensor_size[0]}x{self._sensor_size[1]} pixels")
        first_us, last_us = int(events.t_us[0]), int(events.t_us[-1])
        if self._offset_us is None:
            self._offset_us = first_us
        if first_us < max(self._last_us, self._offset_us) or np.any(events.t_us[1:] < events.t_us[:-1]):
            raise InputError(f"cannot append to {self.path}: events must be sorted and start at or after "
                             f"{max(self._last_us, self._offset_us)} us, found {first_us} us")
        if last_us - self._offset_us > _LONGEST_SPAN_US:
            raise InputError(f"cannot write {self.path}: the last event is {(last_us - self._offset_us) / 1e6:.0f} s "
                             "after t_offset_us; pass t_offset_us=None to count from the first event")
        t_us = events.t_us - self._offset_us
        if int(t_us[-1]) >= _UINT32_END and self._file["events/t"].dtype == np.uint32:
            self._widen_time()
        columns: dict[str, npt.NDArray[Any]] = {"x": events.x, "y": events.y, "t": t_us, "p": events.p}
        for name, column in columns.items():
            dataset = self._file["events"][name]
            dataset.resize(self._rows + len(events), axis=0)
            dataset[self._rows:] = column
        self._extend_index(t_us)
        self._rows += len(events)
        self._last_us = last_us
        self._output.check()

    def _create(self, group: h5py.Group, name: str, dtype: npt.DTypeLike) -> Any:
        return group.create_dataset(name, (0,), maxshape=(None,), chunks=(_CHUNK_EVENTS,), dtype=dtype, fletcher32=True,
                                    **self._filter)

    def _widen_time(self) -> None:
        group = self._file["events"]
        group.move("t", "t32")
        wide = self._create(group, "t", np.uint64)
        wide.resize(self._rows, axis=0)
        for first in range(0, self._rows, _CHUNK_EVENTS):
            wide[first:first + _CHUNK_EVENTS] = group["t32"][first:first + _CHUNK_EVENTS]
        del group["t32"]

    def _extend_index(self, t_us: npt.NDArray[np.int64]) -> None:
        last_ms = int(t_us[-1]) // 1000
        borders = np.arange(self._indexed_ms, last_ms + 1, dtype=np.int64) * 1000
        self._index.append((np.searchsorted(t_us, borders, side="left") + self._rows).astype(np.uint64))
        self._indexed_ms = max(self._indexed_ms, last_ms + 1)

    def _finish(self) -> None:
        if not self._rows:
            raise InputError(f"cannot write {self.path}: there are no events")
        index = np.concatenate(self._index)
        self._file.create_dataset("ms_to_idx", data=index, chunks=(min(len(index), _CHUNK_EVENTS),), fletcher32=True,
                                  **self._filter)
        self._write_offset(self._offset_us or 0)
        if self._sensor_size is not None:
            self._file.attrs["width"], self._file.attrs["height"] = self._sensor_size


    def _write_offset(self, offset_us: int) -> None:
        """Store the scalar inside the metadata, whose checksum then covers it too."""
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_obj_track_times(False)  # equal events make equal files
        layout.set_layout(h5py.h5d.COMPACT)
        scalar = h5py.h5s.create(h5py.h5s.SCALAR)
        h5py.h5d.create(self._file.id, b"t_offset", h5py.h5t.STD_I64LE, scalar, dcpl=layout)
        self._file["t_offset"][()] = np.int64(offset_us)


def _filter_options(compression: Compression) -> dict[str, Any]:
    if compression == "blosc":
        import hdf5plugin
        return dict(hdf5plugin.Blosc(cname="zstd", clevel=4, shuffle=hdf5plugin.Blosc.SHUFFLE))
    if compression == "gzip":
        return {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    if compression == "none":
        return {}
    raise InputError(f"compression is {compression!r}, expected blosc, gzip or none")


def write_events_h5(path: str | os.PathLike[str], events: Events | Iterable[Events], t_offset_us: int | None = 0, *,
                    sensor_size: tuple[int, int] | None = None, compression: Compression = "blosc") -> None:
    """Write events, whole or as a stream of pieces, in the DSEC layout (see `EventH5Writer`).

    Raises:
        InputError: there are no events, or see `EventH5Writer`.
        OutputError: the file cannot be written.
    """
    with EventH5Writer(path, t_offset_us=t_offset_us, sensor_size=sensor_size, compression=compression) as writer:
        for piece in [events] if isinstance(events, Events) else events:
            writer.write(piece)


def write_events_npz(path: str | os.PathLike[str], events: Events) -> None:
    """Write the arrays `x y t p` (t in microseconds) as a compressed NPZ file.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, x=events.x, y=events.y, t=events.t_us, p=events.p)


def write_events_text(path: str | os.PathLike[str], events: Events | Iterable[Events]) -> None:
    """Write lines `t[s] x y p`, exact to the microsecond.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as stream:
        stream.write("# t[s] x y p\n")
        for piece in [events] if isinstance(events, Events) else events:
            for first in range(0, len(piece), _CHUNK_EVENTS):
                stream.write(format_events(piece[first:first + _CHUNK_EVENTS]))


def write_evs_arr_to_h5(evs: npt.ArrayLike, h5outfile: str | os.PathLike[str]) -> None:
    """Write a table (N, 4) with the columns x, y, t [us, truncated toward zero], p as HDF5 with `ms_to_idx`.

    Raises:
        InputError: the table has another shape or holds no valid events.
        OutputError: the file cannot be written.
    """
    table = np.asarray(evs)
    if table.ndim != 2 or table.shape[1] != 4:
        raise InputError(f"events have shape {table.shape}, expected (N, 4) with the columns x, y, t [us], p")
    events = make_events(table[:, 0], table[:, 1], np.trunc(table[:, 2]), table[:, 3], source="event table")
    write_events_h5(h5outfile, events)
