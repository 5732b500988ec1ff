"""Cut a recording into windows: by time, by number of events, or around given stamps.

Windows are half-open `[start, stop)`, so adjacent windows share no event and lose none. All rules stream: memory is
bounded by the events of one window plus a few blocks of the file.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.events.reader import EventReader, RowReader
from utils.events.types import Events


class EventWindow(NamedTuple):
    """Events of one window and its borders in microseconds.

    For windows of time the borders are `[start_us, stop_us)`; for windows of a fixed number of events they are the
    stamps of the first and the last event.
    """

    events: Events
    start_us: float
    stop_us: float

    @property
    def middle_us(self) -> float:
        """Stamp of the frame made from this window: the middle between its borders."""
        return 0.5 * (self.start_us + self.stop_us)


class WindowRule(abc.ABC):
    """A rule that cuts a recording into windows.

    Shared parameter `least_last_fraction`: the last window is dropped if the recording covers less than this share
    of it (0 keeps every window that holds part of the recording).
    """

    @abc.abstractmethod
    def over(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
             every: int = 1) -> Iterator[EventWindow]:
        """Yield the windows of `reader` in time order; windows without events are yielded too.

        Args:
            reader: the recording.
            start_us, stop_us: use only windows inside `[start_us, stop_us)`, on the clock of the recording.
            every: yield only the windows 0, every, 2*every, ...; their length does not change.
        """

    @abc.abstractmethod
    def count(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
              every: int = 1) -> int | None:
        """Return how many windows `over` yields, None if only reading all events could tell."""

    @abc.abstractmethod
    def describe(self) -> dict[str, object]:
        """Return the rule as plain values for reports."""


@dataclass(frozen=True)
class TimeWindows(WindowRule):
    """Windows of fixed length, every `stride_us` from `start_us` or else from the first event.

    Args:
        window_us: length in whole microseconds.
        stride_us: step from window to window; None means adjacent windows.
        least_last_fraction: see `WindowRule`.

    Raises:
        InputError: length or stride below one microsecond.
    """

    window_us: int
    stride_us: int | None = None
    least_last_fraction: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("window", self.window_us), ("stride", self.step_us)):
            if int(value) != value or value < 1:
                raise InputError(f"{name} is {value} us, expected whole microseconds, at least 1")

    @property
    def step_us(self) -> int:
        """Step from window to window in microseconds."""
        return self.window_us if self.stride_us is None else self.stride_us

    def over(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
             every: int = 1) -> Iterator[EventWindow]:
        """Yield `[s, s + window_us)` for `s` = first event (or `start_us`) plus multiples of the stride."""
        first = self._first(reader, start_us)
        for number in range(self.count(reader, start_us, stop_us, every)):
            start = first + number * every * self.step_us
            stop = start + self.window_us
            yield EventWindow(reader.read(start, stop), start, stop)

    def count(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
              every: int = 1) -> int:
        """Return the number of windows, from the time range of the recording alone."""
        first, end = self._first(reader, start_us), reader.time_range_us()[1] + 1
        covered = max(1, math.ceil(self.window_us * self.least_last_fraction))
        last = end - covered  # the latest start of a window that is covered enough
        if stop_us is not None:
            last = min(last, math.floor(stop_us) - self.window_us)
        return 0 if last < first else (last - first) // (self.step_us * every) + 1

    def describe(self) -> dict[str, object]:
        """Return the rule as plain values."""
        return {"rule": "time", "window_us": self.window_us, "stride_us": self.step_us}

    def _first(self, reader: EventReader, start_us: float | None) -> int:
        first = reader.time_range_us()[0]
        if start_us is None:
            return first
        start = math.ceil(start_us)
        # Skip whole strides in front of the recording, so that no empty window is made for them.
        return start if start >= first else start + (first - start) // self.step_us * self.step_us


@dataclass(frozen=True)
class CountWindows(WindowRule):
    """Windows of a fixed number of events, every `stride_events` events.

    Args:
        window_events: events per window.
        stride_events: step in events; None means adjacent windows.
        least_last_fraction: see `WindowRule`, here as share of `window_events`.

    Raises:
        InputError: fewer than one event per window or step.
    """

    window_events: int
    stride_events: int | None = None
    least_last_fraction: float = 0.0

    def __post_init__(self) -> None:
        if self.window_events < 1 or self.step_events < 1:
            raise InputError(f"window of {self.window_events} events every {self.step_events}, expected at least 1")

    @property
    def step_events(self) -> int:
        """Step from window to window in events."""
        return self.window_events if self.stride_events is None else self.stride_events

    def over(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
             every: int = 1) -> Iterator[EventWindow]:
        """Yield windows whose borders are the stamps of their first and last event."""
        pending: list[Events] = []
        held = skip = made = 0
        for chunk in reader.chunks(start_us=start_us, stop_us=stop_us):
            pending.append(chunk)
            held += len(chunk)
            if held - skip < self.window_events:
                continue
            buffer = Events.concatenate(pending)
            while len(buffer) - skip >= self.window_events:
                if made % every == 0:
                    yield _count_window(buffer[skip:skip + self.window_events])
                made += 1
                skip += self.step_events
            drop = min(skip, len(buffer))
            pending, held, skip = [buffer[drop:]], len(buffer) - drop, skip - drop
        rest = Events.concatenate(pending)[skip:]
        if made % every == 0 and self._keeps_rest(len(rest), made):
            yield _count_window(rest)

    def count(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
              every: int = 1) -> int | None:
        """Return the number of windows where the file says how many events it holds, else None."""
        if start_us is not None or stop_us is not None or not isinstance(reader, RowReader):
            return None
        full = max(0, (len(reader) - self.window_events) // self.step_events + 1)
        rest = len(reader) - full * self.step_events
        return -(-(full + self._keeps_rest(rest, full)) // every)

    def _keeps_rest(self, rest: int, full_windows: int) -> bool:
        """Whether the events behind the last full window make a window: enough of them, and some not seen before."""
        already_seen = self.window_events - self.step_events if full_windows else 0
        return rest > already_seen and rest >= max(1.0, self.window_events * self.least_last_fraction)

    def describe(self) -> dict[str, object]:
        """Return the rule as plain values."""
        return {"rule": "count", "window_events": self.window_events, "stride_events": self.step_events}


def _count_window(events: Events) -> EventWindow:
    return EventWindow(events, int(events.t_us[0]), int(events.t_us[-1]))


@dataclass(frozen=True, eq=False)
class StampWindows(WindowRule):
    """Windows that begin at given stamps, for example those of images.

    Args:
        stamps_us: (N,) increasing, microseconds on the clock of the events.
        window_us: length of `[s_i, s_i + window_us)`; None means up to the next stamp, `[s_i, s_{i+1})`, which
            makes N - 1 windows.
        least_last_fraction: see `WindowRule`.

    Raises:
        InputError: stamps that do not increase, too few of them, or a length that is not positive.
    """

    stamps_us: npt.NDArray[np.float64]
    window_us: float | None = None
    least_last_fraction: float = 0.0

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_us, np.float64)
        object.__setattr__(self, "stamps_us", stamps)
        needed = 2 if self.window_us is None else 1
        if stamps.ndim != 1 or len(stamps) < needed:
            raise InputError(f"image stamps have shape {stamps.shape}, expected at least {needed}")
        if not np.all(np.isfinite(stamps)) or np.any(np.diff(stamps) <= 0):
            index = int(np.argmax(~np.isfinite(stamps))) if not np.all(np.isfinite(stamps)) else int(
                np.argmax(np.diff(stamps) <= 0)) + 1
            raise InputError(f"image stamp {index} is {stamps[index]} us and not later than the one before it")
        if self.window_us is not None and not self.window_us > 0:
            raise InputError(f"window is {self.window_us} us, expected a positive length")

    def over(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
             every: int = 1) -> Iterator[EventWindow]:
        """Yield the windows that overlap the recording."""
        for start, stop in zip(*self._borders(reader, start_us, stop_us, every)):
            yield EventWindow(reader.read(start, stop), start, stop)

    def count(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
              every: int = 1) -> int:
        """Return the number of windows, from the stamps and the time range of the recording."""
        return len(self._borders(reader, start_us, stop_us, every)[0])

    def describe(self) -> dict[str, object]:
        """Return the rule as plain values."""
        length = "to the next stamp" if self.window_us is None else float(self.window_us)
        return {"rule": "stamps", "stamps": len(self.stamps_us), "window_us": length}

    def _borders(self, reader: EventReader, start_us: float | None, stop_us: float | None,
                 every: int) -> tuple[list[float], list[float]]:
        starts = self.stamps_us[:-1] if self.window_us is None else self.stamps_us
        stops = self.stamps_us[1:] if self.window_us is None else self.stamps_us + self.window_us
        wanted = np.ones(len(starts), bool)
        if start_us is not None:
            wanted &= starts >= start_us
        if stop_us is not None:
            wanted &= stops <= stop_us
        starts, stops = starts[wanted][::every], stops[wanted][::every]
        first_us, last_us = reader.time_range_us()
        covered = np.minimum(stops, last_us + 1) - starts
        keep = (stops > first_us) & (covered > 0) & (covered >= self.least_last_fraction * (stops - starts))
        return starts[keep].tolist(), stops[keep].tolist()


@dataclass(frozen=True, eq=False)
class RowWindows(WindowRule):
    """Windows between given event numbers: window i holds the events `[e_{i-1}, e_i)`, with `e_{-1} = 0`.

    Args:
        rows: (N,) whole event numbers `e_i`; negative ones count as 0.
        stamps_us: (N,) increasing, microseconds; window i ends at stamp i and begins at the one before it (the first
            one at the first event, if that is earlier).

    Raises:
        InputError: numbers or stamps that run backwards, or lists of different length.
    """

    rows: npt.NDArray[np.int64]
    stamps_us: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        rows, stamps = np.maximum(np.asarray(self.rows), 0), np.asarray(self.stamps_us, np.float64)
        if rows.ndim != 1 or rows.shape != stamps.shape or not len(rows) or rows.dtype.kind not in "iu":
            raise InputError(f"event numbers are {rows.dtype} {rows.shape} for stamps {stamps.shape}, expected as many "
                             "whole numbers as stamps, at least 1")
        for what, values in (("event number", rows), ("stamp", stamps)):
            wrong = np.flatnonzero(~(values[1:] >= values[:-1]))
            if len(wrong):
                raise InputError(f"{what} {wrong[0] + 1} is {values[wrong[0] + 1]} and smaller than the one before it")
        object.__setattr__(self, "rows", rows.astype(np.int64))
        object.__setattr__(self, "stamps_us", stamps)

    def over(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
             every: int = 1) -> Iterator[EventWindow]:
        """Yield the windows of a reader whose events can be addressed by number.

        Raises:
            InputError: the recording has fewer events than the numbers say.
        """
        if not isinstance(reader, RowReader):
            raise InputError(f"{reader.path}: {reader.format_name} files have no event numbers; convert the recording")
        if self.rows[-1] > len(reader):
            raise InputError(f"{reader.path}: {len(reader)} events, but windows go up to event {self.rows[-1]}; the "
                             "file is damaged or belongs to another recording")
        starts_us = self._starts_us(reader)
        for i in self._chosen(reader, start_us, stop_us, every).tolist():
            first = int(self.rows[i - 1]) if i else 0
            yield EventWindow(reader.read_rows(first, int(self.rows[i])), float(starts_us[i]), float(self.stamps_us[i]))

    def count(self, reader: EventReader, start_us: float | None = None, stop_us: float | None = None,
              every: int = 1) -> int:
        """Return the number of windows, from the stamps alone."""
        return len(self._chosen(reader, start_us, stop_us, every))

    def describe(self) -> dict[str, object]:
        """Return the rule as plain values."""
        return {"rule": "event numbers", "stamps": len(self.stamps_us)}

    def _starts_us(self, reader: EventReader) -> npt.NDArray[np.float64]:
        first = min(float(reader.time_range_us()[0]), float(self.stamps_us[0]))
        return np.concatenate([[first], self.stamps_us[:-1]])

    def _chosen(self, reader: EventReader, start_us: float | None, stop_us: float | None,
                every: int) -> npt.NDArray[np.intp]:
        wanted = np.ones(len(self.rows), bool)
        if start_us is not None:
            wanted &= self._starts_us(reader) >= start_us
        if stop_us is not None:
            wanted &= self.stamps_us <= stop_us
        return np.flatnonzero(wanted)[::every]


class EventSlicer:
    """Random access to the events of an HDF5 file by time, with the interface that users of DSEC know.

    Times are absolute, that is with `t_offset` added. Unlike the interface's other implementations this one does
    not read `ms_to_idx`: it searches `t` itself, so a missing or stale index does no harm.

    Args:
        h5f: an open HDF5 file with the events (see `open_events`).

    Raises:
        InputError: the file holds no usable events.
    """

    def __init__(self, h5f: h5py.File) -> None:
        from utils.events.hdf5 import Hdf5EventReader

        self._reader = Hdf5EventReader(h5f, time_unit="us")
        if not len(self._reader):
            raise InputError(f"{self._reader.path}: the file holds no events")

    def get_start_time_us(self) -> int:
        """Return `t_offset` in microseconds."""
        return self._reader.t_offset_us

    def get_final_time_us(self) -> int:
        """Return the stamp of the last event in microseconds."""
        return self._reader.time_range_us()[1]

    def get_events(self, t_start_us: float, t_end_us: float) -> dict[str, np.ndarray] | None:
        """Return the events of `[t_start_us, t_end_us)` as arrays `p x y t` (t int64 microseconds).

        The arrays are empty where nothing happened. None means that the window, rounded up to a millisecond,
        ends after the last complete millisecond of the recording, so that the recording may not cover it.

        Raises:
            InputError: the window does not end after it starts.
        """
        if not t_start_us < t_end_us:
            raise InputError(f"window [{t_start_us}, {t_end_us}) us is empty, the end must be after the start")
        last_ms = (self.get_final_time_us() - self.get_start_time_us()) // 1000
        if math.ceil((t_end_us - self.get_start_time_us()) / 1000) > last_ms:
            return None
        events = self._reader.read(t_start_us, t_end_us)
        return {"p": events.p, "x": events.x, "y": events.y, "t": events.t_us}
