"""Slow, literal encoders and decoders of Prophesee streams, one word at a time, as the format description reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from utils.events import Events

HEADER_EVT3 = b"% Date 2024-01-01 00:00:00\n% evt 3.0\n% geometry 64x48\n"
HEADER_EVT2 = b"% evt 2.0\n% geometry 64x48\n"


def encode_evt3(events: Events, *, repeat_time_high: int = 0, vectors: bool = False) -> bytes:
    """EVT3 words; TIME_HIGH when it changes and every `repeat_time_high` microseconds; rows of pixels as vectors."""
    words: list[int] = []
    high = low = row = -1
    said_us = -(10**9)
    i = 0
    while i < len(events):
        t, x, y, p = (int(column[i]) for column in (events.t_us, events.x, events.y, events.p))
        if t >> 12 != high or (repeat_time_high and t - said_us >= repeat_time_high):
            if t >> 12 != high:
                low = 0 if t & 0xFFF == 0 else -1
            high, said_us = t >> 12, t
            words.append(0x8000 | high & 0xFFF)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(0x6000 | low)
        if y != row:
            row = y
            words.append(y)
        run = 1
        while vectors and i + run < len(events) and (
                (int(events.t_us[i + run]), int(events.y[i + run]), int(events.p[i + run])) == (t, y, p)
                and int(events.x[i + run]) > int(events.x[i + run - 1]) and int(events.x[i + run]) - x < 32):
            run += 1
        if run == 1:
            words.append(0x2000 | p << 11 | x)
        else:
            mask = sum(1 << int(events.x[j]) - x for j in range(i, i + run))
            words += [0x3000 | p << 11 | x, 0x4000 | mask & 0xFFF, 0x4000 | mask >> 12 & 0xFFF, 0x5000 | mask >> 24]
        i += run
    return np.array(words, "<u2").tobytes()


def decode_evt3(data: bytes) -> Events:
    """EVT3 words of an undamaged stream whose counter never stands still for a whole turn."""
    time_high = time_low = turns = row = base = polarity = 0
    seen_time = seen_row = False
    found: list[tuple[int, int, int, int]] = []
    for word in np.frombuffer(data[:len(data) // 2 * 2], "<u2").tolist():
        kind, value = word >> 12, word & 0xFFF
        if kind == 0:
            row, seen_row = value & 0x7FF, True
        elif kind == 3:
            base, polarity = value & 0x7FF, value >> 11
        elif kind == 6:
            time_low = value
        elif kind == 8:
            turns += seen_time and value < time_high
            time_low = time_low if seen_time and value == time_high else 0
            time_high, seen_time = value, True
        t = (turns << 24) + (time_high << 12) + time_low
        if kind == 2 and seen_time and seen_row:
            found.append((value & 0x7FF, row, t, value >> 11))
        elif kind in (4, 5):
            width = 12 if kind == 4 else 8
            if seen_time and seen_row:
                found += [(base + bit, row, t, polarity) for bit in range(width) if value >> bit & 1]
            base += width
    return as_events(found)


def encode_evt2(events: Events, *, repeat_time_high: int = 0) -> bytes:
    """EVT2 words; TIME_HIGH when it changes and every `repeat_time_high` microseconds."""
    words: list[int] = []
    high, said_us = -1, -(10**9)
    for x, y, t, p in zip(*(column.tolist() for column in (events.x, events.y, events.t_us, events.p))):
        if t >> 6 != high or (repeat_time_high and t - said_us >= repeat_time_high):
            high, said_us = t >> 6, t
            words.append(0x80000000 | high & 0xFFFFFFF)
        words.append(p << 28 | (t & 63) << 22 | x << 11 | y)
    return np.array(words, "<u4").tobytes()


def encode_evt21(events: Events, *, legacy: bool) -> bytes:
    """EVT2.1 words; successive events of one time, row and polarity within 32 pixels share a word."""
    heads: list[int] = []
    masks: list[int] = []
    high, key = -1, None
    for x, y, t, p in zip(*(column.tolist() for column in (events.x, events.y, events.t_us, events.p))):
        if t >> 6 != high:
            high, key = t >> 6, None
            heads.append(0x80000000 | high & 0xFFFFFFF)
            masks.append(0)
        start = x // 32 * 32
        if key == (start, y, t, p) and masks[-1] < 1 << x - start:
            masks[-1] |= 1 << x - start
            continue
        key = (start, y, t, p)
        heads.append(p << 28 | (t & 63) << 22 | start << 11 | y)
        masks.append(1 << x - start)
    halves = (heads, masks) if legacy else (masks, heads)
    return np.array(halves, "<u4").T.tobytes()


def as_events(rows: list[tuple[int, int, int, int]]) -> Events:
    """Events from (x, y, t_us, p)."""
    table = np.array(rows, np.int64).reshape(-1, 4)
    return Events(table[:, 0].astype(np.uint16), table[:, 1].astype(np.uint16), table[:, 2].copy(),
                  table[:, 3].astype(np.uint8))


def write_raw(path: Path, header: bytes, data: bytes) -> Path:
    """Write a RAW file."""
    path.write_bytes(header + data)
    return path
