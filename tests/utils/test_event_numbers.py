"""Windows by event number, events by row, recordings on another clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from tests.utils.event_samples import random_events, same
from utils.events import Events, StampWindows, open_events, write_events_h5, write_events_text
from utils.events.reader import MemoryEventReader
from utils.events.shifted import ShiftedReader
from utils.events.slicing import RowWindows

EVENTS = random_events(1000, seed=3, start_us=100)


def reader_of(events: Events, rows_per_block: int = 64) -> MemoryEventReader:
    reader = MemoryEventReader(events)
    reader.rows_per_block = rows_per_block
    return reader


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 1000), min_size=2, max_size=2), st.sampled_from([1, 7, 64, 5000]))
def test_events_by_row(limits: list[int], rows_per_block: int) -> None:
    first, last = sorted(limits)
    assert same(reader_of(EVENTS, rows_per_block).read_rows(first, last), EVENTS[first:last])


def test_rows_outside_the_recording() -> None:
    for first, last in ((0, 1001), (-1, 5), (6, 5)):
        with pytest.raises(InputError, match=f"cannot read events {first} to {last} of 1000"):
            reader_of(EVENTS).read_rows(first, last)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 1000), min_size=1, max_size=12), st.integers(1, 3))
def test_windows_share_no_event_and_lose_none(rows: list[int], every: int) -> None:
    rows = sorted(rows)
    rule = RowWindows(np.array(rows), np.arange(len(rows)) * 10.0 + 200)
    found = list(rule.over(reader_of(EVENTS)))
    assert same(Events.concatenate([window.events for window in found]), EVENTS[:rows[-1]])
    some = list(rule.over(reader_of(EVENTS), every=every))
    assert [window.stop_us for window in some] == [window.stop_us for window in found][::every]
    assert rule.count(reader_of(EVENTS), every=every) == len(some)


def test_borders_and_choice_of_windows() -> None:
    rule = RowWindows(np.array([-1, 10, 10, 500]), np.array([50.0, 300.0, 400.0, 500.0]))
    found = list(rule.over(reader_of(EVENTS)))
    assert [(window.start_us, window.stop_us, len(window.events)) for window in found] == [
        (50, 50, 0), (50, 300, 10), (300, 400, 0), (400, 500, 490)]
    later = RowWindows(np.array([10]), np.array([300.0]))
    assert next(later.over(reader_of(EVENTS))).start_us == EVENTS.t_us[0]
    assert [window.stop_us for window in rule.over(reader_of(EVENTS), 50, 450)] == [50, 300, 400]
    assert rule.describe() == {"rule": "event numbers", "stamps": 4}


@pytest.mark.parametrize(("rows", "stamps", "message"), [
    ([1, 2], [1.0], r"event numbers are int64 \(2,\) for stamps \(1,\)"), ([], [], "at least 1"),
    ([1.5], [1.0], "expected as many whole numbers"), ([5, 4], [1.0, 2.0], "event number 1 is 4 and smaller"),
    ([4, 5], [2.0, 1.0], "stamp 1 is 1.0 and smaller"), ([4, 5], [2.0, np.nan], "stamp 1 is nan"),
])
def test_wrong_event_numbers(rows: list[int], stamps: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        RowWindows(np.array(rows), np.array(stamps))


def test_recordings_without_event_numbers(tmp_path: Path) -> None:
    write_events_text(tmp_path / "walk.txt", EVENTS)
    rule = RowWindows(np.array([5]), np.array([1.0]))
    with open_events(tmp_path / "walk.txt") as reader, pytest.raises(InputError, match="have no event numbers"):
        next(rule.over(reader))
    with pytest.raises(InputError, match="1000 events, but windows go up to event 1001"):
        next(RowWindows(np.array([1001]), np.array([1.0])).over(reader_of(EVENTS)))


@pytest.mark.parametrize("kind", ["hdf5", "text"])
@pytest.mark.parametrize("shift_us", [-100, 0, 1_600_000_000_000_000])
def test_another_clock(kind: str, shift_us: int, tmp_path: Path) -> None:
    file = tmp_path / "events"
    (write_events_h5 if kind == "hdf5" else write_events_text)(file, EVENTS)
    moved = Events(EVENTS.x, EVENTS.y, EVENTS.t_us + shift_us, EVENTS.p)
    with ShiftedReader(open_events(file), shift_us) as reader:
        assert (len(reader), reader.time_range_us()) == (1000, (int(moved.t_us[0]), int(moved.t_us[-1])))
        assert same(Events.concatenate(list(reader.chunks(100))), moved)
        rule = StampWindows(np.array([400.0, 800.0, 1600.0]) + shift_us)
        for window in rule.over(reader):
            assert same(window.events, moved.between(window.start_us, window.stop_us))
        assert same(reader.read(-np.inf, np.inf), moved)
