"""Open an event file of any supported format and read it piece by piece."""

from __future__ import annotations

import abc
import bisect
import os
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np

from devo.errors import InputError
from utils.events.types import Events
from utils.events.validate import Column, Order, TimeUnit, check_options, checked_events

_CACHED_BLOCKS = 4
_ROWS_PER_BLOCK = 1 << 18


class EventReader(abc.ABC):
    """A recording that is read in time order; memory stays bounded unless a format forbids it.

    Attributes:
        path: the file the events come from.
        sensor_size: (width, height) in pixels, None where neither the caller nor the file says it.
        format_name: what the file turned out to be, for messages and reports.
        order: "sort" leaves runs of unsorted stamps to the caller (`open_events` sorts them).
    """

    format_name: str = "events"

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, order: Order) -> None:
        self.path = path
        self.sensor_size = sensor_size
        self.order: Order = order
        self._cache: OrderedDict[int, Events] = OrderedDict()
        self._last_us: dict[int, int] = {}
        self._counts: dict[int, int] = {}

    @abc.abstractmethod
    def __len__(self) -> int:
        """Return the number of events; formats without a count read the file once."""

    @abc.abstractmethod
    def time_range_us(self) -> tuple[int, int]:
        """Return the stamps of the first and of the last event in microseconds."""

    @property
    def losses(self) -> dict[str, int]:
        """What was left out of the part read so far: reason -> count; only streams that may be damaged lose events."""
        return {}

    @abc.abstractmethod
    def _decode(self, block: int) -> Events | None:
        """Return the checked events of one block, None behind the last block."""

    @abc.abstractmethod
    def _first_block_reaching(self, start_us: float) -> int:
        """Return a block that lies at or just before the first event with `t_us >= start_us`."""

    def chunks(self, max_events: int = 1_000_000, *, start_us: float | None = None,
               stop_us: float | None = None) -> Iterator[Events]:
        """Yield the events with `start_us <= t_us < stop_us` in order, at most `max_events` at a time.

        Raises:
            InputError: the file turns out to be damaged (see `checked_events`), or `max_events` is below 1.
        """
        if max_events < 1:
            raise InputError(f"max_events is {max_events}, expected at least 1")
        number = 0 if start_us is None else self._first_block_reaching(start_us)
        while (block := self._block(number)) is not None:
            lower = -np.inf if start_us is None else start_us
            upper = np.inf if stop_us is None else stop_us
            part = block if start_us is None and stop_us is None else block.between(lower, upper)
            for first in range(0, len(part), max_events):
                yield part[first:first + max_events]
            if len(block) and block.t_us[-1] >= upper:
                return
            number += 1

    def read(self, start_us: float, stop_us: float) -> Events:
        """Return all events with `start_us <= t_us < stop_us`, possibly none.

        Successive calls with growing times decode each part of the file once.

        Raises:
            InputError: `stop_us < start_us`, or the file turns out to be damaged.
        """
        if not start_us <= stop_us:
            raise InputError(f"{self.path}: cannot read from {start_us} us to {stop_us} us, the end comes first")
        return Events.concatenate(list(self.chunks(1 << 62, start_us=start_us, stop_us=stop_us)))

    def close(self) -> None:
        """Release the file; reading afterwards is an error of the caller."""
        self._cache.clear()

    def __enter__(self) -> EventReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def _block(self, number: int) -> Events | None:
        """Return a block through a small cache; checks that it does not start before its predecessor ends."""
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        block = self._decode(number)
        if block is None:
            return None
        before = self._last_us.get(number - 1, -1)
        self._last_us[number] = int(block.t_us[-1]) if len(block) else before
        self._counts[number] = len(block)
        self._cache[number] = block
        while len(self._cache) > _CACHED_BLOCKS:
            self._cache.popitem(last=False)
        return block

    def _check(self, x: Column, y: Column, t_us: np.ndarray, p: Column, number: int,
               where: Callable[[int], str]) -> Events:
        return checked_events(x, y, t_us, p, where=where, previous_us=self._last_us.get(number - 1),
                              sensor_size=self.sensor_size, order=self.order)


class SequentialReader(EventReader):
    """A format that only reads forwards: block k can be decoded once blocks 0..k-1 were seen."""

    def __len__(self) -> int:
        self._index_until(np.inf)
        return sum(self._counts.values())

    def time_range_us(self) -> tuple[int, int]:
        """Return the stamps of the first and of the last event in microseconds (reads the file once)."""
        first = next(self.chunks())
        self._index_until(np.inf)
        return int(first.t_us[0]), self._last_us[len(self._last_us) - 1]

    def _index_until(self, stop_us: float) -> None:
        """Decode blocks until one ends at or after `stop_us`."""
        number = len(self._last_us)
        while not (number and self._last_us[number - 1] >= stop_us):
            if self._block(number) is None:
                return
            number += 1

    def _first_block_reaching(self, start_us: float) -> int:
        self._index_until(start_us)
        return bisect.bisect_left(range(len(self._last_us)), start_us, key=lambda block: self._last_us[block])

    def _rows_before(self, number: int) -> int:
        return sum(self._counts[block] for block in range(number))


class RowReader(EventReader):
    """A format whose events can be addressed by row, so any time is found by binary search.

    Subclasses provide `_columns(first, last)` with the raw columns `x, y, t_us, p` and set `rows`.
    """

    rows: int = 0
    rows_per_block: int = _ROWS_PER_BLOCK

    @abc.abstractmethod
    def _columns(self, first: int, last: int) -> tuple[Column, Column, np.ndarray, Column]:
        """Return rows [first, last) as raw columns x, y, t (int64 microseconds), p."""

    def __len__(self) -> int:
        return self.rows

    def time_range_us(self) -> tuple[int, int]:
        """Return the stamps of the first and of the last event in microseconds."""
        ends = [self._columns(row, row + 1)[2] for row in (0, self.rows - 1)]
        return int(ends[0][0]), int(ends[1][0])

    def read_rows(self, first: int, last: int) -> Events:
        """Return the events numbered `first` to `last - 1`, counted from 0.

        Successive calls with growing numbers decode each part of the file once.

        Raises:
            InputError: numbers outside the recording, or the file turns out to be damaged.
        """
        if not 0 <= first <= last <= self.rows:
            raise InputError(f"{self.path}: cannot read events {first} to {last} of {self.rows}")
        parts = []
        while first < last:
            number, offset = divmod(first, self.rows_per_block)
            block = self._block(number)
            assert block is not None
            parts.append(block[offset:offset + last - first])
            first += len(parts[-1])
        return Events.concatenate(parts)

    def _decode(self, block: int) -> Events | None:
        first = block * self.rows_per_block
        if first >= self.rows:
            return None
        columns = self._columns(first, min(first + self.rows_per_block, self.rows))
        return self._check(*columns, block, lambda i: f"{self.path}: event {first + i}")

    def _first_block_reaching(self, start_us: float) -> int:
        blocks = range(-(-self.rows // self.rows_per_block))
        # Events equal to start_us may begin in the block before the first one that starts at or after it.
        return max(bisect.bisect_left(blocks, start_us, key=self._block_start_us) - 1, 0)

    def _block_start_us(self, block: int) -> int:
        row = block * self.rows_per_block
        return int(self._columns(row, row + 1)[2][0])


class MemoryEventReader(RowReader):
    """Events that are already in memory, behind the interface of a file.

    Args:
        events: checked, sorted events.
        path: what to call them in messages.
        sensor_size: (width, height) in pixels or None.
        losses: what the reader that the events come from left out.
    """

    format_name = "memory"

    def __init__(self, events: Events, path: str | os.PathLike[str] = "memory",
                 sensor_size: tuple[int, int] | None = None, losses: dict[str, int] | None = None) -> None:
        super().__init__(Path(path), sensor_size, "error")
        if not len(events):
            raise InputError(f"{path}: there are no events")
        self.events = events
        self.rows = len(events)
        self._losses = losses or {}

    @property
    def losses(self) -> dict[str, int]:
        """What was left out when the events were read."""
        return self._losses

    def _columns(self, first: int, last: int) -> tuple[Column, Column, np.ndarray, Column]:
        part = self.events[first:last]
        return part.x, part.y, part.t_us, part.p


class _Opening(NamedTuple):
    """What a format needs to open a file."""

    path: Path
    sensor_size: tuple[int, int] | None
    time_unit: TimeUnit | None
    order: Order
    stream: str | None

    def single(self) -> tuple[Path, tuple[int, int] | None, TimeUnit | None, Order]:
        """Return the arguments of a format that holds one stream; refuse the wish for another."""
        if self.stream is not None:
            raise InputError(f"{self.path}: the file holds one event stream, stream={self.stream!r} makes no sense")
        return self.path, self.sensor_size, self.time_unit, self.order


def _open_hdf5(opening: _Opening) -> EventReader:
    from utils.events.hdf5 import Hdf5EventReader
    return Hdf5EventReader(*opening)


def _open_npz(opening: _Opening) -> EventReader:
    from utils.events.numpy_files import NpzEventReader
    return NpzEventReader(*opening.single())


def _open_npy(opening: _Opening) -> EventReader:
    from utils.events.numpy_files import NpyEventReader
    return NpyEventReader(*opening.single())


def _open_text(opening: _Opening) -> EventReader:
    from utils.events.text import TextEventReader
    return TextEventReader(*opening.single())


def _open_prophesee(opening: _Opening) -> EventReader:
    from utils.events.prophesee import RawEventReader
    return RawEventReader(*opening.single())


def _open_aedat4(opening: _Opening) -> EventReader:
    from utils.events.aedat4 import Aedat4EventReader
    return Aedat4EventReader(*opening)


def _open_bag(opening: _Opening) -> EventReader:
    from utils.events.bags import BagEventReader
    return BagEventReader(*opening)


_FORMATS: tuple[tuple[bytes, Callable[[_Opening], EventReader]], ...] = (
    (b"\x89HDF\r\n\x1a\n", _open_hdf5),
    (b"PK\x03\x04", _open_npz),
    (b"\x93NUMPY", _open_npy),
    (b"% ", _open_prophesee),
    (b"#!AER-DAT", _open_aedat4),
    (b"#ROSBAG", _open_bag),
    (b"\x89MCAP0\r\n", _open_bag),
    (b"SQLite format 3\0", _open_bag),
)
_FOREIGN: tuple[tuple[bytes, str], ...] = (
    (b"\x89PNG", "a PNG image"),
)


def open_events(path: str | os.PathLike[str], *, sensor_size: tuple[int, int] | None = None,
                time_unit: TimeUnit | None = None, on_unsorted: Order = "error",
                stream: str | None = None) -> EventReader:
    """Open an event recording; the format is found by content, not by the name.

    Formats: text `t x y p` (the Event Camera Dataset form); NPZ with `x y t p`; NPY (structured or (N,4) with
    columns t x y p); HDF5 as in DSEC, TUM-VIE, VECtor (`events/{x,y,t,p}`), M3ED, MVSEC or with `{x,y,t,p}` at the
    root (Blosc included); Prophesee RAW (EVT2, EVT2.1, EVT3); AEDAT4; bags of ROS 1 and 2 with `dvs_msgs` or
    `prophesee_event_msgs` (a bag of ROS 2 may be a folder).

    Args:
        path: the file.
        sensor_size: (width, height) in pixels; coordinates outside are an error. None: what the file says.
        time_unit: unit of the stamps in the file: "s", "ms", "us" or "ns". None: what the header says, else whole
            numbers are microseconds and fractions are seconds.
        on_unsorted: "error", or "sort" to load everything into memory and sort it by time (stable).
        stream: which camera of a file with several: a topic or group, or a part of its name such as "left".

    Raises:
        InputError: the file is missing, empty, of an unknown format or damaged; damage that appears
            only later in the file is raised while reading.
    """
    path = Path(path)
    check_options(time_unit, on_unsorted, sensor_size)
    reader = _opener(path)(_Opening(path, sensor_size, time_unit, on_unsorted, stream))
    try:
        if on_unsorted == "sort":
            return _sorted_in_memory(reader)
        next(reader.chunks())  # the first block decides most mistakes, so they surface here and not minutes later
    except StopIteration:
        reader.close()
        raise InputError(f"{path}: the file holds no events") from None
    except BaseException:
        reader.close()
        raise
    return reader


def open_events_as_stored(path: str | os.PathLike[str], *, sensor_size: tuple[int, int] | None = None,
                          time_unit: TimeUnit | None = None, stream: str | None = None) -> EventReader:
    """Open a recording to inspect it: `chunks()` passes unsorted stamps on instead of refusing or sorting them.

    Arguments as in `open_events`. Only `chunks()` without borders is meaningful if the stamps turn out unsorted.

    Raises:
        InputError: see `open_events`; unsorted stamps are no error here.
    """
    path = Path(path)
    check_options(time_unit, "sort", sensor_size)
    return _opener(path)(_Opening(path, sensor_size, time_unit, "sort", stream))


def _opener(path: Path) -> Callable[[_Opening], EventReader]:
    """Find the format of a file by its first bytes."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        return _open_bag
    head = _first_bytes(path)
    opener = next((function for magic, function in _FORMATS if head.startswith(magic)), None)
    if opener is None:
        _refuse_foreign(path, head)
        opener = _open_text
    return opener


def _first_bytes(path: Path) -> bytes:
    if path.is_dir():
        raise InputError(f"{path} is a folder, expected an event file")
    try:
        with path.open("rb") as stream:
            head = stream.read(4096)
    except OSError as error:
        raise InputError(f"cannot read event file {path}: {error.strerror or error}") from error
    if not head:
        raise InputError(f"{path}: the file is empty (0 bytes), expected events")
    return head


def _refuse_foreign(path: Path, head: bytes) -> None:
    supported = "supported are text (t x y p), npz, npy, HDF5, Prophesee RAW, AEDAT4 and ROS bags"
    for magic, name in _FOREIGN:
        if head.startswith(magic):
            raise InputError(f"{path} is {name}, which is not read directly; {supported}, convert it first")
    printable = sum(byte in b"\t\n\r" or 32 <= byte < 127 or byte >= 0xC2 for byte in head)
    if b"\0" in head or printable < 0.95 * len(head):
        raise InputError(f"{path}: not an event file (binary content of unknown format); {supported}")


def _sorted_in_memory(reader: EventReader) -> EventReader:
    with reader:
        events = Events.concatenate(list(reader.chunks()))
    if not len(events):
        raise InputError(f"{reader.path}: the file holds no events")
    if np.any(events.t_us[1:] < events.t_us[:-1]):
        rows = np.argsort(events.t_us, kind="stable")
        events = Events(events.x[rows], events.y[rows], events.t_us[rows], events.p[rows])
    result = MemoryEventReader(events, reader.path, reader.sensor_size, reader.losses)
    result.format_name = f"{reader.format_name} (sorted)"
    return result
