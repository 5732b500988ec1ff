"""Decode lines `t x y p` with whole-array arithmetic instead of a loop over lines.

A block of text is viewed as bytes. The separators give the ends of all tokens; each number of up to
eight digits is then fetched as one 64-bit word and converted by three multiplications that work on all its
digits at once. Blocks that are not plain enough are cleaned first and, if that does not help, parsed line by
line, which also finds the line to blame.
"""

from __future__ import annotations

import re
from decimal import ROUND_HALF_UP, Decimal, InvalidOperation
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from utils.events.validate import TimeUnit

Ints = npt.NDArray[np.int64]
Words = npt.NDArray[np.uint64]

# (microseconds per unit, 10**-8 units per microsecond); nanoseconds are rounded from their whole part
_SCALES: dict[str, tuple[int, int]] = {"s": (1_000_000, 100), "ms": (1_000, 100_000), "us": (1, 100_000_000)}
_SPACE, _TAB, _NEWLINE, _DOT, _MINUS, _ZERO = b" \t\n.-0"
_FRONT = 24  # padding that lets a number at the very start be fetched as three words
_BACK = 8
_U = np.uint64


class RawColumns(NamedTuple):
    """Columns as found in the text, stamps already in microseconds."""

    t_us: Ints
    x: Ints
    y: Ints
    p: Ints


class BadLineError(ValueError):
    """A line that is no event; `line` counts from 0 inside the block."""

    def __init__(self, line: int, reason: str) -> None:
        super().__init__(reason)
        self.line = line
        self.reason = reason


def parse_block(block: bytes, unit: TimeUnit) -> RawColumns:
    """Parse whole lines `t x y p` (separated by blanks, tabs or commas; `#` starts a comment line).

    Args:
        block: text whose last line is complete.
        unit: unit of the stamps; digits behind the microsecond are rounded half up.

    Returns:
        Columns t_us, x, y, p as int64, one row per event line.

    Raises:
        BadLineError: a line does not consist of four numbers.
    """
    if b"\r" in block:
        block = block.replace(b"\r\n", b"\n")
    if b"," in block:
        block = block.translate(_COMMA_TO_SPACE)
    if not block.endswith(b"\n"):
        block += b"\n"
    columns = _parse_plain(block, unit)
    if columns is None:
        columns = _parse_plain(_clean(block), unit)
    return columns if columns is not None else _parse_lines(block, unit)


_COMMA_TO_SPACE = bytes.maketrans(b",", b" ")
_COMMENT = re.compile(rb"^[ \t]*#[^\n]*\n", re.MULTILINE)
_BLANKS = re.compile(rb"[ \t]{2,}")
_EDGES = re.compile(rb"^[ \t]+|[ \t]+$", re.MULTILINE)
_EMPTY = re.compile(rb"^\n+|(?<=\n)\n+")


def _clean(block: bytes) -> bytes:
    for pattern, replacement in ((_COMMENT, b""), (_BLANKS, b" "), (_EDGES, b""), (_EMPTY, b"")):
        block = pattern.sub(replacement, block)
    return block


def _parse_plain(block: bytes, unit: TimeUnit) -> RawColumns | None:
    """Parse lines of exactly four plain numbers with single separators; None if anything is unusual."""
    if not block:
        return RawColumns(*(np.empty(0, np.int64) for _ in range(4)))
    text = np.frombuffer(b"0" * _FRONT + block + b"0" * _BACK, np.uint8)
    ends = np.flatnonzero(text <= _SPACE)
    lines = len(ends) // 4
    counts = {byte: int(np.count_nonzero(text == byte)) for byte in (_SPACE, _TAB, _NEWLINE, _DOT)}
    digits = int(np.count_nonzero((text - np.uint8(_ZERO)) <= 9)) - _FRONT - _BACK
    minuses = len(block) - digits - sum(counts.values())
    if (len(ends) != 4 * lines or counts[_NEWLINE] != lines or counts[_SPACE] + counts[_TAB] != 3 * lines
            or counts[_DOT] not in (0, lines)):
        return None
    end_t, end_x, end_y, end_p = np.ascontiguousarray(ends.reshape(lines, 4).T)
    if np.any(text[end_p] != _NEWLINE):
        return None
    words = np.ndarray((len(text) - 7,), np.dtype("<u8"), text, strides=(1,))
    start_t = np.empty_like(end_p)
    start_t[0] = _FRONT
    start_t[1:] = end_p[:-1] + 1
    p = _parse_polarity(text, end_y, end_p, minuses)
    x = _parse_whole(words, end_x, end_x - end_t - 1)
    y = _parse_whole(words, end_y, end_y - end_x - 1)
    t = _parse_stamps(text, words, start_t, end_t, counts[_DOT] > 0, unit)
    return None if p is None or x is None or y is None or t is None else RawColumns(t, x, y, p)


def _digits_value(words: Words) -> Ints:
    """Return the number that each word of eight digits spells; zero bytes count as the digit 0."""
    words &= _U(0x0F0F0F0F0F0F0F0F)
    words = (words * _U(10) + (words >> _U(8))) & _U(0x00FF00FF00FF00FF)
    words = (words * _U(100) + (words >> _U(16))) & _U(0x0000FFFF0000FFFF)
    words = (words * _U(10000) + (words >> _U(32))) & _U(0xFFFFFFFF)  # overflow of the upper half is cut off
    return words.view(np.int64)


def _parse_whole(words: Words, ends: Ints, lengths: Ints) -> Ints | None:
    """Parse unsigned whole numbers given the position behind their last digit; None beyond 18 digits."""
    longest = int(lengths.max())
    if int(lengths.min()) < 1 or longest > 18:
        return None
    value = np.zeros(len(ends), np.int64)
    for group in range(-(-longest // 8)):
        drop = 8 * (8 - np.clip(lengths - 8 * group, 0, 8))  # bits that belong to other tokens
        shift = np.minimum(drop, 63).astype(np.uint64)
        part = words[ends - 8 * (group + 1)] >> shift << shift
        if group:
            part[drop == 64] = 0
        value += _digits_value(part) * 10 ** (8 * group) if group else _digits_value(part)
    return value


def _parse_polarity(text: npt.NDArray[np.uint8], end_y: Ints, end_p: Ints, minuses: int) -> Ints | None:
    """Parse one digit with an optional minus; None if a minus (or any other byte) stands elsewhere."""
    lengths = end_p - end_y - 1
    if minuses == 0:
        if int(lengths.max()) != 1 or int(lengths.min()) != 1:
            return None
        return text[end_p - 1].astype(np.int64) - _ZERO
    negative = (lengths == 2) & (text[end_y + 1] == _MINUS)
    if int(np.count_nonzero(negative)) != minuses or np.any((lengths != 1) & ~negative):
        return None
    value = text[end_p - 1].astype(np.int64) - _ZERO
    return np.where(negative, -value, value)


def _parse_stamps(text: npt.NDArray[np.uint8], words: Words, starts: Ints, ends: Ints, decimal: bool,
                  unit: TimeUnit) -> Ints | None:
    """Parse stamps with or without decimals into microseconds, rounding half up."""
    whole_ends = _dot_positions(text, starts, ends) if decimal else ends
    whole = _parse_whole(words, whole_ends, whole_ends - starts)
    if whole is None or (decimal and np.any(whole_ends >= ends)):
        return None
    if unit == "ns":
        return (whole + 500) // 1000
    per_unit, divisor = _SCALES[unit]
    if int(whole.max()) > 2**62 // per_unit:
        return None
    whole *= per_unit
    if decimal:
        lengths = ends - whole_ends - 1
        shortest = int(lengths.min())
        if shortest < 1:
            return None
        fraction = words[whole_ends + 1]
        if shortest < 8:
            shift = (64 - 8 * np.minimum(lengths, 8)).astype(np.uint64)
            fraction = fraction << shift >> shift
        value = _digits_value(fraction)
        value += divisor // 2
        whole += value // divisor
    return whole


def _dot_positions(text: npt.NDArray[np.uint8], starts: Ints, ends: Ints) -> Ints:
    """Find the dots, one per stamp; quick when all stamps have as many decimals as the first one."""
    first_dot = int(np.argmax(text[starts[0]:] == _DOT)) + int(starts[0])
    same_width = ends - (int(ends[0]) - first_dot)
    # Where every stamp has a dot at its place, these are all dots: their number equals the number of lines.
    return same_width if np.all(text[same_width] == _DOT) else np.flatnonzero(text == _DOT)


def _parse_lines(block: bytes, unit: TimeUnit) -> RawColumns:
    """Parse line by line with exact decimals: exponents, signs, `1.0` as a pixel, and the line to blame."""
    rows: list[tuple[int, int, int, int]] = []
    for number, line in enumerate(block.split(b"\n")):
        tokens = line.split()
        if not tokens or tokens[0].startswith(b"#"):
            continue
        if len(tokens) != 4:
            raise BadLineError(number, f"{len(tokens)} column{'s' * (len(tokens) != 1)} instead of 4 (t x y p): "
                                       f"{_quote(line)}")
        stamp, *pixel_and_polarity = (_decimal(token, line, number) for token in tokens)
        if any(value != value.to_integral_value() for value in pixel_and_polarity):
            raise BadLineError(number, f"x, y and p must be whole numbers: {_quote(line)}")
        x, y, p = (int(value) for value in pixel_and_polarity)
        microseconds = int((stamp * Decimal(_SCALES[unit][0]) if unit != "ns" else stamp / 1000).to_integral_value(
            ROUND_HALF_UP))
        if max(abs(microseconds), abs(x), abs(y), abs(p)) > 2**62:
            raise BadLineError(number, f"a number is out of any range: {_quote(line)}")
        rows.append((microseconds, x, y, p))
    table = np.array(rows, np.int64).reshape(len(rows), 4)
    return RawColumns(*(np.ascontiguousarray(column) for column in table.T))


def _decimal(token: bytes, line: bytes, number: int) -> Decimal:
    try:
        value = Decimal("x" if b"_" in token else token.decode("ascii"))  # Decimal would take 1_000
    except (InvalidOperation, UnicodeDecodeError):
        raise BadLineError(number, f"{_quote(token)} is not a number: {_quote(line)}") from None
    if not value.is_finite():
        raise BadLineError(number, f"{_quote(token)} is not a finite number: {_quote(line)}")
    if value and value.adjusted() > 40:
        raise BadLineError(number, f"a number is out of any range: {_quote(line)}")
    return value


def _quote(text: bytes) -> str:
    shown = text[:60].decode("ascii", "backslashreplace")
    return f"\"{shown}{'...' if len(text) > 60 else ''}\""
