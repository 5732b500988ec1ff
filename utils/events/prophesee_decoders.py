"""Decode the words of Prophesee's EVT2, EVT2.1 and EVT3 streams with whole-array operations.

A stream mixes events with words that set what the following events share (time, row, base column). Each decoder
takes a run of words and the state that the words before left behind, and returns the events and the new state. An
event knows how many events came before a state word, so every shared value is one `np.repeat`.

Cameras and cables drop or flip words. A time word that its neighbours contradict is left out and counted; a stream
that really runs backwards is passed on as it is, for the caller to refuse.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Words = npt.NDArray[Any]
Stamps = npt.NDArray[np.int64]

EARLY = "events before the first time word"
UNKNOWN = "words of unknown type"
CONTRADICTED = "time words that contradict their neighbours"
MISTIMED = "events whose time contradicts their neighbours"

# A time counter that moves back by less than a quarter of its span ran backwards, anything else is a wrap forward.
_BACKWARDS_SHARE = 4
# Successive time words lie this many ticks apart at most where a word between them can be recognised as damaged.
_NEARBY_TICKS = 16


class State(NamedTuple):
    """What the words so far leave behind for the next ones.

    Attributes:
        ticks: the unwrapped coarse time counter, None before the first coarse time word.
        t_us: time of the next event in microseconds (EVT3), or of the last one (EVT2), None before the first.
        y: current row, None before the first.
        base_x: column at which the next vector starts.
        polarity: polarity of vectors.
    """

    ticks: int | None = None
    t_us: int | None = None
    y: int | None = None
    base_x: int = 0
    polarity: int = 0


class Decoded(NamedTuple):
    """Events of a run of words (x, y uint16; t int64 microseconds; p uint8), the state behind it, what was lost."""

    x: npt.NDArray[np.uint16]
    y: npt.NDArray[np.uint16]
    t_us: Stamps
    p: npt.NDArray[np.uint8]
    state: State
    lost: Counter[str]


class Decoder(Protocol):
    """What the reader needs from an encoding."""

    word_dtype: np.dtype[Any]

    def last_coarse_word(self, words: Words) -> int | None:
        """Return where the last word stands that sets the coarse time counter, None if there is none."""

    def decode(self, words: Words, state: State, next_ticks: int | None) -> Decoded:
        """Decode a run of words; `next_ticks` is the raw coarse counter just behind it, where known."""

    def ticks_of(self, word: Words) -> int:
        """Return the raw counter in a coarse time word."""


def _unwrap(raw: Words, bits: int, previous: int | None,
            following: int | None) -> tuple[Stamps, npt.NDArray[np.bool_]]:
    """Unwrap a counter of `bits` bits and mark the readings that are plausible.

    A reading is left out if the counter would go once all the way round between its two neighbours, which lie next to
    each other without it.

    Args:
        raw: (N,) readings.
        previous: unwrapped reading before them, or None.
        following: raw reading behind them, or None.

    Returns:
        (N,) int64 unwrapped readings (those left out repeat their predecessor), (N,) bool which are kept.
    """
    span = 1 << bits
    keep = np.ones(len(raw), bool)
    before = [] if previous is None else [previous % span]
    after = [] if following is None else [following]
    chain = np.concatenate([np.array(before, np.int64), raw.astype(np.int64), np.array(after, np.int64)])
    steps = np.diff(chain) % span
    damaged = (steps[:-1] + steps[1:] >= span) & (steps[:-1] + steps[1:] - span <= _NEARBY_TICKS)
    inner = np.flatnonzero(damaged) + 1 - len(before)
    keep[inner] = False
    if previous is None and len(steps) and steps[0] > span - span // _BACKWARDS_SHARE:
        keep[0] = False  # nothing before it: the next reading decides
    start = previous if previous is not None else (int(raw[keep][0]) if keep.any() else 0)
    readings = np.concatenate([[start % span], raw[keep].astype(np.int64)])
    steps = np.diff(readings) % span
    steps[steps > span - span // _BACKWARDS_SHARE] -= span
    kept = np.concatenate([[start], start + np.cumsum(steps)])
    return kept[np.cumsum(keep)], keep


def _plausible_stamps(t_us: Stamps, previous_us: int | None, tolerance_us: int) -> npt.NDArray[np.bool_] | None:
    """Return which stamps fit into a sorted sequence, None if all do.

    Single stamps that leap ahead of the next one, and stamps at most `tolerance_us` behind an earlier one, do not fit.
    Larger falls are kept: they are no damage to a single word, and the caller must hear of them.
    """
    chain = t_us if previous_us is None else np.concatenate([[previous_us], t_us])
    if not np.any(chain[1:] < chain[:-1]):
        return None
    keep = np.ones(len(chain), bool)
    keep[1:-1] = ~((chain[1:-1] > chain[2:]) & (chain[:-2] <= chain[2:]))
    latest = np.maximum.accumulate(np.where(keep, chain, chain[0]))
    keep &= (chain >= latest) | (latest - chain > tolerance_us)
    return keep[len(chain) - len(t_us):]


def _spread(values: npt.NDArray[Any], events_before: npt.NDArray[Any], start: Any,
            total: int) -> npt.NDArray[Any]:
    """Give each of `total` events the last value set before it, `start` before the first."""
    borders = np.concatenate([[0], events_before, [total]])
    return np.repeat(np.concatenate([np.array([start], values.dtype), values]), np.diff(borders))


class _Specials(NamedTuple):
    """The words of an EVT3 run other than single events, and their types."""

    word: npt.NDArray[np.uint16]
    kind: npt.NDArray[np.uint8]


def _vector_tables() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Tabulate vector words by their lower 13 bits (types 4 and 5 differ in bit 12, and 5 has 8 pixels).

    Returns:
        (8192,) number of set pixels, (8192,) where their offsets begin in the third table, (K,) offsets.
    """
    words = np.arange(1 << 13)
    masks = np.where(words >> 12, words & 0xFF, words & 0xFFF)
    of_word, offsets = np.nonzero(masks[:, None] >> np.arange(12) & 1)
    counts = np.bincount(of_word, minlength=len(words))
    return counts, np.cumsum(counts) - counts, offsets


_EVENTS_IN_VECTOR, _FIRST_BIT_OF_VECTOR, _BITS_OF_VECTOR = _vector_tables()
_FAR_RIGHT = 0xFFF  # outside every sensor: vectors without a new base run out of the 11 bits of a column
_ADVANCE = np.array([0, 0, 0, 0, 12, 8], np.int32)
_UNKNOWN_EVT3 = (1, 9, 11, 12, 13)


class Evt3Decoder:
    """EVT3: 16-bit words, the upper 4 bits are the type.

    0 row; 2 single event (column, polarity); 3 base column and polarity of vectors; 4 / 5 vector of 12 / 8 pixels;
    6 / 8 lower / upper 12 bits of the time in microseconds; 7, 15 continued; 10 trigger; 14 other.
    """

    word_dtype: np.dtype[Any] = np.dtype("<u2")
    _TICK_BITS = 12

    def last_coarse_word(self, words: Words) -> int | None:
        """Return where the last TIME_HIGH word stands."""
        return _last(words, lambda part: part >> 12 == 8)

    def ticks_of(self, word: Words) -> int:
        """Return the 12-bit counter of a TIME_HIGH word."""
        return int(word) & 0xFFF

    def decode(self, words: Words, state: State, next_ticks: int | None) -> Decoded:
        """Decode a run of words; see `Decoder`."""
        kind = words.view(np.uint8)[1::2] >> np.uint8(4)
        is_single = kind == 2
        single = words[np.flatnonzero(is_single)]
        at = np.flatnonzero(~is_single)  # everything below works on these words, a minority
        special = _Specials(words[at], kind[at])
        events_before = at - np.arange(len(at))
        events, base_x, polarity = self._with_vectors(single, special, events_before, state)
        x, p = events & np.uint16(0xFFF), (events >> np.uint16(15)).astype(np.uint8)

        lost: Counter[str] = Counter()
        rows = np.flatnonzero(special.kind == 0)
        row_values = special.word[rows] & np.uint16(0x7FF)
        y = _spread(row_values, events_before[rows], state.y or 0, len(x))
        says, stamps, ticks = self._times(special, events_before, len(x), state, next_ticks, lost)
        t_us = _spread(stamps, events_before[says], state.t_us or 0, len(x))
        start = max(0 if state.y is not None else int(events_before[rows[0]]) if len(rows) else len(x),
                    0 if state.t_us is not None else int(events_before[says[0]]) if len(says) else len(x))
        lost[EARLY] += start
        lost[UNKNOWN] += sum(int(np.count_nonzero(special.kind == unknown)) for unknown in _UNKNOWN_EVT3)
        behind = State(ticks, int(stamps[-1]) if len(stamps) else state.t_us,
                       int(row_values[-1]) if len(rows) else state.y, base_x, polarity)
        return Decoded(x[start:], y[start:], t_us[start:], p[start:], behind, +lost)

    def _times(self, special: _Specials, events_before: npt.NDArray[np.int64], total: int, state: State,
               next_ticks: int | None, lost: Counter[str]) -> tuple[npt.NDArray[np.intp], Stamps, int | None]:
        """Return which special words change the time and to what, and the unwrapped coarse counter behind them."""
        at = np.flatnonzero((special.kind == 8) | (special.kind == 6))
        value = special.word[at] & np.uint16(0xFFF)
        coarse = np.flatnonzero(special.kind[at] == 8)
        ticks, keep = _unwrap(value[coarse], self._TICK_BITS, state.ticks, next_ticks)
        lost[CONTRADICTED] += len(keep) - int(np.count_nonzero(keep))
        first = 0 if state.ticks is not None else int(coarse[keep][0]) if keep.any() else len(at)
        stamps = (_spread(ticks, coarse, state.ticks or 0, len(at)) << self._TICK_BITS) + value
        # A coarse word that repeats the counter says nothing; one that changes it starts at fine time 0.
        stamps[coarse] = ticks << self._TICK_BITS
        says = np.ones(len(at), bool)
        says[coarse] = (np.diff(ticks, prepend=-1 if state.ticks is None else state.ticks) != 0) & keep
        says[:first] = False
        at, stamps = at[says], stamps[says]
        plausible = _plausible_stamps(stamps, state.t_us, 1 << self._TICK_BITS)
        if plausible is not None:
            # Healthy cameras write stray fine time words too; they cost nothing where no event follows them.
            events_behind = np.diff(events_before[at], append=total)
            lost[CONTRADICTED] += int(np.count_nonzero(~plausible & (events_behind > 0)))
            at, stamps = at[plausible], stamps[plausible]
        return at, stamps, int(ticks[-1]) if keep.any() else state.ticks

    @staticmethod
    def _with_vectors(single: Words, special: _Specials, events_before: npt.NDArray[np.int64],
                      state: State) -> tuple[npt.NDArray[np.uint16], int, int]:
        """Return all events as `column | polarity << 15`, and base column and polarity behind them.

        Adds the events of vectors to `events_before`, which counts single events when it comes in.
        """
        events = (single & np.uint16(0x7FF)) | (single & np.uint16(0x800)) << np.uint16(4)
        group = np.flatnonzero((special.kind >= 3) & (special.kind <= 5))
        if not len(group):
            return events, state.base_x, state.polarity
        word, kind = special.word[group], special.kind[group]
        bases = np.flatnonzero(kind == 3)
        advance = _ADVANCE[kind]
        moved = np.cumsum(advance, dtype=np.int32)  # by the vectors up to here
        base = word[bases].astype(np.int32)
        # Column before all moves and polarity, in one number so that they are spread together.
        origin = ((base & 0x7FF) - moved[bases]) * 2 + (base >> 11 & 1)
        origin = _spread(origin, bases, 2 * state.base_x + state.polarity, len(group))
        behind = min(int(origin[-1] >> 1) + int(moved[-1]), _FAR_RIGHT), int(origin[-1] & 1)

        filled = np.flatnonzero((kind != 3) & ((word & 0xFFF) != 0))
        code = word[filled] & 0x1FFF
        counts = _EVENTS_IN_VECTOR[code]
        source = np.repeat(np.arange(len(filled)), counts)
        firsts = np.cumsum(counts) - counts
        column = (origin[filled] >> 1) + moved[filled] - advance[filled]
        number = np.arange(len(source))
        column = column[source] + _BITS_OF_VECTOR[(_FIRST_BIT_OF_VECTOR[code] - firsts)[source] + number]
        in_vectors = np.zeros(len(events_before), np.int64)
        in_vectors[group[filled]] = counts
        events_before += np.cumsum(in_vectors) - in_vectors
        place = (events_before[group[filled]] - firsts)[source] + number
        merged = np.empty(len(events) + len(place), np.uint16)
        is_free = np.ones(len(merged), bool)
        is_free[place] = False
        merged[np.flatnonzero(is_free)] = events
        merged[place] = np.minimum(column, _FAR_RIGHT) | (origin[filled] & 1)[source] << 15
        return merged, *behind


def _last(words: Words, condition: Callable[[Words], npt.NDArray[np.bool_]]) -> int | None:
    """Return the index of the last word that meets a condition; looks at the end first, where it usually is."""
    for start in (max(len(words) - 4096, 0), 0):
        found = np.flatnonzero(condition(words[start:]))
        if len(found):
            return start + int(found[-1])
    return None


class Evt2Decoder:
    """EVT2: 32-bit words, the upper 4 bits are the type.

    0 / 1 event darker / brighter; 8 coarse time; 10 trigger; 14, 15 other.
    An event holds the lower 6 bits of the time in microseconds, 11 bits column and 11 bits row; a coarse time word
    the upper 28 bits of the time.
    """

    word_dtype: np.dtype[Any] = np.dtype("<u4")
    _TICK_BITS = 28
    _FINE_BITS = 6
    _KNOWN = np.isin(np.arange(16), (0, 1, 8, 10, 14, 15))

    def _split(self, words: Words) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32] | None]:
        """Return the 32 bits with type, time, column and row, and the mask of the pixels to the right, if any."""
        return words, None

    def last_coarse_word(self, words: Words) -> int | None:
        """Return where the last TIME_HIGH word stands."""
        return _last(words, lambda part: self._split(part)[0] >> 28 == 8)

    def ticks_of(self, word: Words) -> int:
        """Return the 28-bit counter of a TIME_HIGH word."""
        return int(self._split(np.atleast_1d(word))[0][0]) & 0xFFFFFFF

    def decode(self, words: Words, state: State, next_ticks: int | None) -> Decoded:
        """Decode a run of words; see `Decoder`."""
        heads, masks = self._split(words)
        kind = (heads >> np.uint32(28)).astype(np.uint8)
        lost: Counter[str] = Counter()
        is_event = kind <= 1
        at = np.flatnonzero(is_event)
        coarse = np.flatnonzero(kind == 8)
        ticks, keep = _unwrap(heads[coarse] & np.uint32(0xFFFFFFF), self._TICK_BITS, state.ticks, next_ticks)
        lost[CONTRADICTED] += len(keep) - int(np.count_nonzero(keep))
        coarse_before = np.searchsorted(at, coarse)
        start = 0 if state.ticks is not None else int(coarse_before[keep][0]) if keep.any() else len(at)
        lost[EARLY] += start
        event = heads[at[start:]]
        t_us = _spread(ticks, coarse_before, state.ticks or 0, len(at))[start:] << self._FINE_BITS
        t_us += (event >> np.uint32(22)) & np.uint32(0x3F)
        if (unknown := np.bincount(kind, minlength=16)[~self._KNOWN]).any():
            lost[UNKNOWN] += int(unknown.sum())
        bits = None if masks is None else masks[at[start:]]
        plausible = _plausible_stamps(t_us, state.t_us, 1 << self._FINE_BITS)
        if plausible is not None:
            lost[MISTIMED] += len(plausible) - int(np.count_nonzero(plausible))
            event, t_us = event[plausible], t_us[plausible]
            bits = None if bits is None else bits[plausible]
        x, y = ((event >> np.uint32(11)) & np.uint32(0x7FF)).astype(np.uint16), (event & 0x7FF).astype(np.uint16)
        p = (event >> np.uint32(28)).astype(np.uint8)
        behind = State(int(ticks[-1]) if keep.any() else state.ticks, int(t_us[-1]) if len(t_us) else state.t_us)
        if bits is not None:
            pixels = np.flatnonzero(np.unpackbits(bits.astype("<u4").view(np.uint8), bitorder="little"))
            rows = pixels >> 5
            x, y, t_us, p = x[rows] + (pixels & 31).astype(np.uint16), y[rows], t_us[rows], p[rows]
        return Decoded(x, y, t_us, p, behind, +lost)


class Evt21Decoder(Evt2Decoder):
    """EVT2.1: 64-bit words; one half as in EVT2, the other a mask of the 32 pixels from its column to the right.

    Args:
        legacy: the half as in EVT2 comes first in the file (`endianness=legacy`), not second.
    """

    word_dtype: np.dtype[Any] = np.dtype("<u8")

    def __init__(self, legacy: bool) -> None:
        self._head = 0 if legacy else 1

    def _split(self, words: Words) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32] | None]:
        halves = np.ascontiguousarray(words).view("<u4").reshape(-1, 2)
        return halves[:, self._head], halves[:, 1 - self._head]
