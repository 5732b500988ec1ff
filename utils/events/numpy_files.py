"""Events in NumPy files: NPZ with one array per column, NPY as records or as an (N,4) table."""

from __future__ import annotations

import contextlib
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.lib.format as npy_format

from devo.errors import InputError
from utils.events.reader import RowReader, SequentialReader
from utils.events.types import Events
from utils.events.validate import Column, Order, TimeUnit, check_guessed_unit, guess_time_unit, to_microseconds

_ROWS_PER_BLOCK = 1 << 18
_ALIASES: dict[str, tuple[str, ...]] = {
    "x": ("x", "xs"), "y": ("y", "ys"), "t": ("t", "ts", "t_us", "timestamp", "timestamps", "time"),
    "p": ("p", "ps", "pol", "polarity", "polarities"),
}
# Everything that NumPy and zipfile raise on damaged input; none of it may reach the user as a traceback.
_DAMAGE = (OSError, EOFError, ValueError, SyntaxError, TypeError, AttributeError, LookupError, ArithmeticError,
           MemoryError, RuntimeError, tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error)


def find_columns(names: list[str], path: Path) -> dict[str, str]:
    """Map x, y, t, p to the names they have in a file.

    Raises:
        InputError: a column is missing.
    """
    found = {column: next((name for name in names if name.lower() in aliases), None)
             for column, aliases in _ALIASES.items()}
    missing = [column for column, name in found.items() if name is None]
    if missing:
        raise InputError(f"{path}: column{'s' * (len(missing) > 1)} {', '.join(missing)} missing, found "
                         f"{', '.join(names) or 'nothing'}; expected x, y, t, p")
    return {column: name for column, name in found.items() if name is not None}


@contextlib.contextmanager
def _damage_is_input_error(path: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: damaged or truncated {kind} file ({reason}); copy or write it again") from error


class _ArrayStream:
    """One NPY array inside a zip archive, read forwards in pieces."""

    def __init__(self, archive: zipfile.ZipFile, member: str) -> None:
        self._stream: IO[bytes] = archive.open(member)
        version = npy_format.read_magic(self._stream)
        read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
        self.shape, _, self.dtype = read(self._stream)
        if self.dtype.hasobject:
            raise ValueError(f"array {member} holds Python objects, which are not loaded")

    def take(self, rows: int) -> np.ndarray:
        """Return the next rows; at the end of the member its checksum is verified."""
        wanted = rows * self.dtype.itemsize
        data = self._stream.read(wanted)
        if len(data) != wanted:
            raise EOFError("an array ends early")
        return np.frombuffer(data, self.dtype)

    def finish(self) -> None:
        """Read to the end of the member, which verifies its checksum."""
        if self._stream.read(1):
            raise ValueError("an array is longer than its header says")
        self._stream.close()


class NpzEventReader(SequentialReader):
    """Events in an NPZ archive with the arrays `x y t p`, read in pieces also when compressed.

    Arguments as in `open_events`.

    Raises:
        InputError: arrays are missing, of unequal length or damaged; see also `checked_events`.
    """

    format_name = "npz"

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, time_unit: TimeUnit | None,
                 order: Order) -> None:
        super().__init__(path, sensor_size, order)
        with _damage_is_input_error(path, "npz"):
            self._archive = zipfile.ZipFile(path)
        try:
            names = [name[:-4] for name in self._archive.namelist() if name.endswith(".npy")]
            self._members = find_columns(names, path)
            self._unit = time_unit
            self._unit_is_guessed = time_unit is None
            self._streams = self._open_streams()
            self.rows = self._check_shapes()
        except BaseException:
            self._archive.close()
            raise
        self._next_block = 0

    def __len__(self) -> int:
        return self.rows

    def close(self) -> None:
        """Close the archive."""
        super().close()
        self._archive.close()

    def _open_streams(self) -> dict[str, _ArrayStream]:
        with _damage_is_input_error(self.path, "npz"):
            return {column: _ArrayStream(self._archive, f"{name}.npy") for column, name in self._members.items()}

    def _check_shapes(self) -> int:
        shapes = {column: stream.shape for column, stream in self._streams.items()}
        listing = ", ".join(f"{column} {shape}" for column, shape in shapes.items())
        if any(len(shape) != 1 for shape in shapes.values()):
            raise InputError(f"{self.path}: the event columns must be one-dimensional, found {listing}")
        if len(set(shapes.values())) > 1:
            raise InputError(f"{self.path}: the event columns differ in length ({listing}); the file is damaged")
        return int(shapes["t"][0])

    def _decode(self, block: int) -> Events | None:
        first = block * _ROWS_PER_BLOCK
        if first >= self.rows:
            return None
        if block < self._next_block:  # the archive only reads forwards: start over
            self._streams, self._next_block = self._open_streams(), 0
        while self._next_block < block:
            self._take_block()
        columns = self._take_block()
        stamps = columns["t"]
        if self._unit is None:
            self._unit = guess_time_unit(stamps)
        where = lambda i: f"{self.path}: event {first + i}"  # noqa: E731
        t_us = to_microseconds(stamps, self._unit, where)
        if block == 0 and self._unit_is_guessed:
            check_guessed_unit(t_us, self._unit, str(self.path))
        return self._check(columns["x"], columns["y"], t_us, columns["p"], block, where)

    def _take_block(self) -> dict[str, Column]:
        rows = min(_ROWS_PER_BLOCK, self.rows - self._next_block * _ROWS_PER_BLOCK)
        self._next_block += 1
        with _damage_is_input_error(self.path, "npz"):
            columns = {column: stream.take(rows) for column, stream in self._streams.items()}
            if self._next_block * _ROWS_PER_BLOCK >= self.rows:
                for stream in self._streams.values():
                    stream.finish()
        return columns


class NpyEventReader(RowReader):
    """Events in an NPY file, memory-mapped: records with the fields x y t p, or a table (N,4) t x y p.

    Arguments as in `open_events`.

    Raises:
        InputError: the array has another form or is damaged; see also `checked_events`.
    """

    format_name = "npy"

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, time_unit: TimeUnit | None,
                 order: Order) -> None:
        super().__init__(path, sensor_size, order)
        with _damage_is_input_error(path, "npy"):
            self._array: Any = np.load(path, mmap_mode="r", allow_pickle=False)
        dtype = self._array.dtype
        if dtype.names is not None and self._array.ndim == 1 and all(dtype[name].shape == () for name in dtype.names):
            self._fields = find_columns(list(dtype.names), path)
        elif dtype.names is None and self._array.ndim == 2 and self._array.shape[1] == 4:
            self._fields = {}
        else:
            raise InputError(f"{path}: array of dtype {dtype} and shape {self._array.shape}, expected "
                             "records with the fields x, y, t, p or a table (N, 4) with the columns t x y p")
        self.rows = len(self._array)
        self._unit = time_unit or guess_time_unit(self._column("t", 0, min(self.rows, _ROWS_PER_BLOCK)))
        if time_unit is None and self.rows:
            head = self._column("t", 0, min(self.rows, 4096))
            check_guessed_unit(to_microseconds(head, self._unit, lambda i: f"{path}: event {i}"), self._unit, str(path))

    def close(self) -> None:
        """Release the memory map."""
        super().close()
        self._array = None

    def _column(self, name: str, first: int, last: int) -> Column:
        rows = self._array[first:last]
        column = rows[self._fields[name]] if self._fields else rows[:, "txyp".index(name)]
        return np.array(column, dtype=column.dtype.newbyteorder("="))

    def _columns(self, first: int, last: int) -> tuple[Column, Column, np.ndarray, Column]:
        t_us = to_microseconds(self._column("t", first, last), self._unit, lambda i: f"{self.path}: event {first + i}")
        return self._column("x", first, last), self._column("y", first, last), t_us, self._column("p", first, last)
