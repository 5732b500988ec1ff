"""Events as text: one event per line, `t x y p`, `#` starts a comment (the form of the Event Camera Dataset)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devo.errors import InputError
from utils.events.reader import SequentialReader
from utils.events.text_parser import BadLineError, RawColumns, parse_block
from utils.events.types import Events
from utils.events.validate import Order, TimeUnit, check_guessed_unit

_BLOCK_BYTES = 1 << 19  # half a megabyte: the work arrays of one block stay in the processor's cache
_LONGEST_LINE = 1 << 16
_COLUMN_NAMES = {"t": "t", "ts": "t", "time": "t", "timestamp": "t", "timestamps": "t", "stamp": "t",
                 "x": "x", "y": "y", "p": "p", "pol": "p", "polarity": "p"}
_UNIT_NAMES: tuple[tuple[str, TimeUnit], ...] = (
    (r"\b(ns|nsec|nanosec\w*|t_ns|ts_ns)\b", "ns"),
    (r"\b(us|usec|µs|microsec\w*|t_us|ts_us)\b", "us"),
    (r"\b(ms|msec|millisec\w*|t_ms|ts_ms)\b", "ms"),
    (r"[\[(]s[\])]|\b(sec|secs|seconds?|t_s|ts_s)\b", "s"),
)


class _Header(NamedTuple):
    """What stands before the first event."""

    data_offset: int
    time_unit: TimeUnit | None
    sensor_size: tuple[int, int] | None
    first_stamp: bytes


class TextEventReader(SequentialReader):
    """Stream of events in a text file.

    A block of lines is decoded at a time; where each block starts is remembered, so that reading back in time
    does not start from the top. Arguments as in `open_events`.

    Raises:
        InputError: a line is no event (the message names it), or see `checked_events`.
    """

    format_name = "text t x y p"

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, time_unit: TimeUnit | None,
                 order: Order) -> None:
        super().__init__(path, sensor_size, order)
        self._file = path.open("rb")
        try:
            header = self._read_header()
        except BaseException:
            self._file.close()
            raise
        self.sensor_size = sensor_size if sensor_size is not None else header.sensor_size
        guessed: TimeUnit = "s" if re.search(rb"[.eE]", header.first_stamp) else "us"
        self.time_unit: TimeUnit = time_unit or header.time_unit or guessed
        self._unit_is_guessed = time_unit is None and header.time_unit is None
        self._offsets = [header.data_offset]
        self._end_us: int | None = None

    def close(self) -> None:
        """Close the file."""
        super().close()
        self._file.close()

    def time_range_us(self) -> tuple[int, int]:
        """Return the stamps of the first and of the last event in microseconds; reads only the two ends."""
        first = int(next(self.chunks()).t_us[0])
        if self._end_us is None:
            size = self.path.stat().st_size
            start = max(size - (1 << 16), self._offsets[0])
            self._file.seek(start)
            tail = self._file.read()
            if start > self._offsets[0]:
                tail = tail[tail.find(b"\n") + 1:]
            columns = self._parse(tail, size - len(tail))
            # Only comments in the tail: fall back to the full pass of the base class.
            self._end_us = int(columns.t_us[-1]) if len(columns.t_us) else super().time_range_us()[1]
        return first, self._end_us

    def _decode(self, block: int) -> Events | None:
        start = self._offsets[block]
        self._file.seek(start)
        text = self._file.read(_BLOCK_BYTES)
        if not text:
            return None
        if len(text) == _BLOCK_BYTES:  # extend to the end of the line
            text += self._file.readline(_LONGEST_LINE)
        columns = self._parse(text, start)
        if block + 1 == len(self._offsets):
            self._offsets.append(start + len(text))
        if block == 0 and self._unit_is_guessed:
            check_guessed_unit(columns.t_us, self.time_unit, str(self.path))
        return self._check(columns.x, columns.y, columns.t_us, columns.p, block,
                           lambda i: self._locate(text, start, block, i))

    def _parse(self, text: bytes, offset: int) -> RawColumns:
        try:
            return parse_block(text, self.time_unit)
        except BadLineError as error:
            at_end = offset + len(text) >= self.path.stat().st_size and error.line == text.count(b"\n")
            hint = "; the file seems to be cut off there" if at_end else ""
            line = self._lines_before(offset) + error.line + 1
            raise InputError(f"{self.path}: line {line}: {error.reason}{hint}") from None

    def _locate(self, text: bytes, offset: int, block: int, index: int) -> str:
        """Name event `index` of a block; costs a pass over the file, hence only for messages."""
        data_lines = [number for number, line in enumerate(text.split(b"\n"))
                      if line.strip() and not line.lstrip().startswith(b"#")]
        event = self._rows_before(block) + index
        return f"{self.path}: event {event} (line {self._lines_before(offset) + data_lines[index] + 1})"

    def _lines_before(self, offset: int) -> int:
        self._file.seek(0)
        count = 0
        while offset > 0:
            piece = self._file.read(min(offset, 1 << 20))
            if not piece:
                break
            count += piece.count(b"\n")
            offset -= len(piece)
        return count

    def _read_header(self) -> _Header:
        """Read comments, a line of column names or a first line `width height`; stop before the first event."""
        unit: TimeUnit | None = None
        size: tuple[int, int] | None = None
        while True:
            offset = self._file.tell()
            line = self._file.readline(_LONGEST_LINE)
            if not line:
                raise InputError(f"{self.path}: the file holds no events, only comments or blank lines")
            tokens = line.replace(b",", b" ").split()
            if not tokens:
                continue
            named, columns = self._columns_of_header(line)
            if columns or tokens[0].startswith(b"#"):
                unit = named or unit
                continue
            if len(tokens) == 2 and size is None and all(token.isdigit() for token in tokens):
                size = (int(tokens[0]), int(tokens[1]))
                continue
            return _Header(offset, unit, size, tokens[0])

    def _columns_of_header(self, line: bytes) -> tuple[TimeUnit | None, bool]:
        """Return the unit that a header line names and whether the line names all four columns at all.

        Raises:
            InputError: the columns stand in another order than t x y p.
        """
        words = line.decode("utf-8", "replace").lower()
        tokens = re.sub(r"_(ns|us|ms|s)\b", "", words)
        columns = [_COLUMN_NAMES[word] for word in re.findall(r"[a-z]+", tokens) if word in _COLUMN_NAMES]
        if sorted(columns) != sorted("txyp"):
            return None, False
        if columns != list("txyp"):
            raise InputError(f"{self.path}: the header names the columns {' '.join(columns)}, expected t x y p; "
                             "reorder the columns first")
        return next((unit for pattern, unit in _UNIT_NAMES if re.search(pattern, words)), None), True


def format_events(events: Events) -> str:
    """Return lines `t[s] x y p` with six decimals, exact to the microsecond."""
    table = np.empty((len(events), 5), np.int64)
    table[:, 0], table[:, 1] = np.divmod(events.t_us, 1_000_000)
    table[:, 2], table[:, 3], table[:, 4] = events.x, events.y, events.p
    return "%d.%06d %d %d %d\n" * len(events) % tuple(table.ravel().tolist())
