"""Decode the words of Prophesee's EVT2, EVT2.1 and EVT3 streams with whole-array operations.

A stream mixes events with words that set what the following events share (time, row, base column). Each decoder
takes a run of words and the state that the words before left behind, and returns the events and the new state. An
event knows how many events came before a state word, so every shared value is one `np.repeat`.

Cameras and cables drop or flip words. A time word that its neighbours contradict is left out and counted; a stream
that really runs backwards is passed on as it is, for the caller to refuse.
"""

from __future__ import annotations

from collections import Counter
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

    def coarse_time_words(self, words: Words) -> npt.NDArray[np.intp]:
        """Return where the words stand that set the coarse time counter."""

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
    steps = np.diff(raw[keep].astype(np.int64), prepend=start % span) % span
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


class Evt3Decoder:
    """EVT3: 16-bit words, the upper 4 bits are the type.

    0 row; 2 single event (column, polarity); 3 base column and polarity of vectors; 4 / 5 vector of 12 / 8 pixels;
    6 / 8 lower / upper 12 bits of the time in microseconds; 7, 15 continued; 10 trigger; 14 other.
    """

    word_dtype = np.dtype("<u2")
    _TICK_BITS = 12
    _KNOWN = np.isin(np.arange(16), (0, 2, 3, 4, 5, 6, 7, 8, 10, 14, 15))
    _ONES = np.array([bin(mask).count("1") for mask in range(1 << 12)], np.int64)

    def coarse_time_words(self, words: Words) -> npt.NDArray[np.intp]:
        """Return where the TIME_HIGH words stand."""
        return np.flatnonzero(words.view(np.uint8)[1::2] >> 4 == 8)

    def ticks_of(self, word: Words) -> int:
        """Return the 12-bit counter of a TIME_HIGH word."""
        return int(word) & 0xFFF

    def decode(self, words: Words, state: State, next_ticks: int | None) -> Decoded:
        """Decode a run of words; see `Decoder`."""
        kind = words.view(np.uint8)[1::2] >> 4
        lost: Counter[str] = Counter()
        is_row, is_single = kind == 0, kind == 2
        is_vector = (kind == 4) | (kind == 5)
        is_event = is_single | is_vector
        at = np.flatnonzero(is_event)
        events_before = np.cumsum(is_event, dtype=np.int32)
        vectors = np.flatnonzero(is_vector[at])
        x, p = self._columns(words[at])
        outputs_before: npt.NDArray[Any] | None = None
        total = len(at)
        if len(vectors):
            x, p, outputs_before = self._expand(words, kind, at, x, p, vectors, state)
            total = int(outputs_before[-1])

        def before(positions: npt.NDArray[np.intp]) -> npt.NDArray[Any]:
            counts = events_before[positions]
            return counts if outputs_before is None else outputs_before[counts]

        rows = np.flatnonzero(is_row)
        rows_before, row_values = before(rows), words[rows] & np.uint16(0x7FF)
        y = _spread(row_values, rows_before, state.y or 0, total)
        time_at, stamps, ticks = self._times(words, kind, state, next_ticks, lost)
        stamps_before = before(time_at)
        t_us = _spread(stamps, stamps_before, state.t_us or 0, total)
        start = max(0 if state.y is not None else int(rows_before[0]) if len(rows) else total,
                    0 if state.t_us is not None else int(stamps_before[0]) if len(stamps) else total)
        lost[EARLY] += start
        if len(unknown := np.bincount(kind, minlength=16)[~self._KNOWN]) and unknown.any():
            lost[UNKNOWN] += int(unknown.sum())
        base_x, polarity = self._base_behind(words, kind, state)
        behind = State(ticks, int(stamps[-1]) if len(stamps) else state.t_us,
                       int(row_values[-1]) if len(rows) else state.y, base_x, polarity)
        return Decoded(x[start:], y[start:], t_us[start:], p[start:], behind, +lost)

    @staticmethod
    def _columns(words: Words) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8]]:
        return words & np.uint16(0x7FF), (words.view(np.uint8)[1::2] >> 3) & np.uint8(1)

    def _times(self, words: Words, kind: npt.NDArray[np.uint8], state: State, next_ticks: int | None,
               lost: Counter[str]) -> tuple[npt.NDArray[np.intp], Stamps, int | None]:
        """Return where the time changes and to what, and the unwrapped coarse counter behind the words."""
        is_coarse = kind == 8
        at = np.flatnonzero(is_coarse | (kind == 6))
        coarse = np.flatnonzero(is_coarse[at])
        ticks, keep = _unwrap(words[at[coarse]] & np.uint16(0xFFF), self._TICK_BITS, state.ticks, next_ticks)
        lost[CONTRADICTED] += len(keep) - int(np.count_nonzero(keep))
        first = 0 if state.ticks is not None else int(coarse[keep][0]) if keep.any() else len(at)
        fine = (words[at] & np.uint16(0xFFF)).astype(np.int64)
        stamps = (_spread(ticks, coarse, state.ticks or 0, len(at)) << self._TICK_BITS) + fine
        # A coarse word that repeats the counter says nothing; one that changes it starts at fine time 0.
        changed = np.diff(ticks, prepend=-1 if state.ticks is None else state.ticks) != 0
        stamps[coarse] = ticks << self._TICK_BITS
        says = np.ones(len(at), bool)
        says[coarse] = changed & keep
        says[:first] = False
        at, stamps = at[says], stamps[says]
        plausible = _plausible_stamps(stamps, state.t_us, 1 << self._TICK_BITS)
        if plausible is not None:
            lost[CONTRADICTED] += len(plausible) - int(np.count_nonzero(plausible))
            at, stamps = at[plausible], stamps[plausible]
        return at, stamps, int(ticks[-1]) if keep.any() else state.ticks

    def _expand(self, words: Words, kind: npt.NDArray[np.uint8], at: npt.NDArray[np.intp], x: npt.NDArray[np.uint16],
                p: npt.NDArray[np.uint8], vectors: npt.NDArray[np.intp], state: State,
                ) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
        """Turn each vector word into the events of its set bits; also return the events before each event word."""
        group = np.flatnonzero((kind >= 3) & (kind <= 5))
        advance = np.array([0, 12, 8], np.int64)[kind[group] - 3]
        advanced = np.cumsum(advance) - advance  # by the vectors before, since the start of the run
        is_base = kind[group] == 3
        base_x, base_p = self._columns(words[group[is_base]])
        where_base = np.flatnonzero(is_base)
        start = _spread(base_x - advanced[is_base], where_base, state.base_x, len(group))
        polarity = _spread(base_p, where_base, state.polarity, len(group))
        x[vectors] = (start + advanced)[~is_base]
        p[vectors] = polarity[~is_base]

        masks = words[at[vectors]] & np.uint16(0xFFF)
        masks[kind[at[vectors]] == 5] &= np.uint16(0xFF)
        counts = np.ones(len(at), np.int64)
        counts[vectors] = self._ONES[masks]
        offsets = np.flatnonzero(np.unpackbits(masks.view(np.uint8), bitorder="little")) & 15
        x, p = np.repeat(x, counts), np.repeat(p, counts)
        from_vector = np.zeros(len(at), bool)
        from_vector[vectors] = True
        x[np.repeat(from_vector, counts)] += offsets.astype(np.uint16)
        return x, p, np.concatenate([[0], np.cumsum(counts)])

    def _base_behind(self, words: Words, kind: npt.NDArray[np.uint8], state: State) -> tuple[int, int]:
        """Return column and polarity with which a vector behind these words would start."""
        bases = np.flatnonzero(kind == 3)
        base_x, polarity, tail = state.base_x, state.polarity, kind
        if len(bases):
            word = int(words[bases[-1]])
            base_x, polarity, tail = word & 0x7FF, (word >> 11) & 1, kind[bases[-1]:]
        moved = 12 * int(np.count_nonzero(tail == 4)) + 8 * int(np.count_nonzero(tail == 5))
        return (base_x + moved) & 0xFFFF, polarity


class Evt2Decoder:
    """EVT2: 32-bit words, the upper 4 bits are the type; 0 / 1 event darker / brighter, 8 coarse time, 10, 14, 15 other.

    An event holds the lower 6 bits of the time in microseconds, 11 bits column and 11 bits row; a coarse time word
    the upper 28 bits of the time.
    """

    word_dtype = np.dtype("<u4")
    _TICK_BITS = 28
    _FINE_BITS = 6
    _KNOWN = np.isin(np.arange(16), (0, 1, 8, 10, 14, 15))

    def _split(self, words: Words) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32] | None]:
        """Return the 32 bits with type, time, column and row, and the mask of the pixels to the right, if any."""
        return words, None

    def coarse_time_words(self, words: Words) -> npt.NDArray[np.intp]:
        """Return where the TIME_HIGH words stand."""
        return np.flatnonzero(self._split(words)[0] >> 28 == 8)

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

    word_dtype = np.dtype("<u8")

    def __init__(self, legacy: bool) -> None:
        self._head = 0 if legacy else 1

    def _split(self, words: Words) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32] | None]:
        halves = np.ascontiguousarray(words).view("<u4").reshape(-1, 2)
        return halves[:, self._head], halves[:, 1 - self._head]
