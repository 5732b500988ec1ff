"""Windows: nothing lost, nothing twice, half-open borders, and the interface that users of DSEC know."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from tests.utils.event_samples import random_events, same, write_flat_h5
from utils.events import (
    CountWindows,
    Events,
    EventSlicer,
    MemoryEventReader,
    StampWindows,
    TimeWindows,
    make_events,
    write_events_h5,
)
from utils.events.reader import EventReader


class FewEventsPerBlock(MemoryEventReader):
    """Memory reader with tiny blocks, so that windows span several of them."""

    rows_per_block = 13


def reader_of(stamps: list[int]) -> EventReader:
    return FewEventsPerBlock(make_events(np.arange(len(stamps)) % 1000, np.zeros(len(stamps)), stamps,
                                         np.zeros(len(stamps))))


STAMPS = st.lists(st.integers(0, 3000), min_size=1, max_size=120).map(sorted)


def test_a_thousand_random_cuts_lose_and_repeat_nothing() -> None:
    events = random_events(4000, seed=1, longest_gap_us=4)
    reader = FewEventsPerBlock(events)
    rng = np.random.default_rng(2)
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    for fractional in (False, True):
        borders = np.sort(rng.uniform(first, last, 999))
        borders = borders if fractional else np.unique(np.floor(borders))
        borders = np.concatenate([[first], borders[borders > first], [last + 1]])
        pieces = [reader.read(start, stop) for start, stop in zip(borders[:-1], borders[1:])]
        assert same(Events.concatenate(pieces), events)
        assert sum(map(len, pieces)) == len(events)


@settings(max_examples=100, deadline=None)
@given(stamps=STAMPS, window_us=st.integers(1, 700))
def test_adjacent_time_windows_are_the_recording(stamps: list[int], window_us: int) -> None:
    reader = reader_of(stamps)
    rule = TimeWindows(window_us)
    windows = list(rule.over(reader))
    assert len(windows) == rule.count(reader)
    assert same(Events.concatenate([window.events for window in windows]), reader.read(0, 10**6))
    for window in windows:
        assert window.stop_us - window.start_us == window_us
        assert window.middle_us == window.start_us + window_us / 2
        assert all(window.start_us <= t < window.stop_us for t in window.events.t_us)


@settings(max_examples=100, deadline=None)
@given(stamps=STAMPS, size=st.integers(1, 40))
def test_adjacent_count_windows_are_the_recording(stamps: list[int], size: int) -> None:
    reader = reader_of(stamps)
    rule = CountWindows(size)
    windows = list(rule.over(reader))
    assert len(windows) == rule.count(reader)
    assert [len(window.events) for window in windows[:-1]] == [size] * (len(windows) - 1)
    assert same(Events.concatenate([window.events for window in windows]), reader.read(0, 10**6))
    for window in windows:
        assert (window.start_us, window.stop_us) == (window.events.t_us[0], window.events.t_us[-1])


@settings(max_examples=150, deadline=None)
@given(stamps=STAMPS, size=st.integers(1, 30), step=st.integers(1, 60), every=st.integers(1, 3),
       least=st.sampled_from([0.0, 0.5, 1.0]))
def test_count_windows_with_steps_equal_slices(stamps: list[int], size: int, step: int, every: int,
                                               least: float) -> None:
    reader = reader_of(stamps)
    rule = CountWindows(size, step, least)
    expected = []
    for number, first in enumerate(range(0, len(stamps), step)):
        part = stamps[first:first + size]
        unseen = len(part) == size or number == 0 or first + len(part) > (number - 1) * step + size
        if unseen and len(part) >= max(1, least * size) and number % every == 0:
            expected.append(part)
        if len(part) < size:
            break
    found = [window.events.t_us.tolist() for window in rule.over(reader, every=every)]
    assert found == expected
    assert rule.count(reader, every=every) == len(expected)


@settings(max_examples=150, deadline=None)
@given(stamps=STAMPS, window_us=st.integers(1, 400), stride_us=st.integers(1, 600), every=st.integers(1, 3),
       crop=st.one_of(st.none(), st.tuples(st.integers(-500, 2000), st.integers(1, 3000))))
def test_time_windows_with_strides_equal_masks(stamps: list[int], window_us: int, stride_us: int, every: int,
                                               crop: tuple[int, int] | None) -> None:
    reader = reader_of(stamps)
    rule = TimeWindows(window_us, stride_us)
    start, stop = (None, None) if crop is None else (crop[0], crop[0] + crop[1])
    windows = list(rule.over(reader, start, stop, every))
    assert len(windows) == rule.count(reader, start, stop, every)
    table = np.array(stamps)
    for window in windows:
        assert window.events.t_us.tolist() == table[(table >= window.start_us) & (table < window.stop_us)].tolist()
        assert crop is None or (window.start_us >= start and window.stop_us <= stop)
    starts = [window.start_us for window in windows]
    assert all(later - earlier == stride_us * every for earlier, later in zip(starts, starts[1:]))
    if crop is None:
        assert starts[0] == stamps[0]
        assert starts[-1] <= stamps[-1] < starts[-1] + stride_us * every


@settings(max_examples=100, deadline=None)
@given(stamps=STAMPS, images=st.lists(st.floats(-100, 3500), min_size=2, max_size=20, unique=True).map(sorted),
       length=st.one_of(st.none(), st.floats(1, 500)), every=st.integers(1, 3))
def test_windows_at_image_stamps_equal_masks(stamps: list[int], images: list[float], length: float | None,
                                             every: int) -> None:
    reader = reader_of(stamps)
    rule = StampWindows(np.array(images), length)
    windows = list(rule.over(reader, every=every))
    assert len(windows) == rule.count(reader, every=every)
    table = np.array(stamps)
    expected = {}
    stops = images[1:] if length is None else [image + length for image in images]
    for start, stop in list(zip(images, stops))[::every]:
        if stop > stamps[0] and start < stamps[-1] + 1:
            expected[start] = table[(table >= start) & (table < stop)].tolist()
    assert {window.start_us: window.events.t_us.tolist() for window in windows} == expected


def test_stamp_windows_share_their_borders_without_sharing_events() -> None:
    reader = reader_of([5, 10, 10, 15, 20])
    windows = list(StampWindows(np.array([0, 10, 20])).over(reader))
    assert [window.events.t_us.tolist() for window in windows] == [[5], [10, 10, 15]]
    assert [window.middle_us for window in windows] == [5, 15]


@pytest.mark.parametrize(("end", "count"), [(149, 1), (150, 2), (199, 2), (200, 2)])
def test_last_window_needs_the_asked_share(end: int, count: int) -> None:
    """Windows of 100 us from 0: the second is covered up to the last event, whose microsecond counts."""
    reader = reader_of([0, end - 1])
    assert TimeWindows(100, least_last_fraction=0.5).count(reader) == count
    assert StampWindows(np.array([0, 100, 200]), least_last_fraction=0.5).count(reader) == count


def test_gap_without_events_gives_empty_windows() -> None:
    windows = list(TimeWindows(10).over(reader_of([0, 35])))
    assert [len(window.events) for window in windows] == [1, 0, 0, 1]


@pytest.mark.parametrize("make", [
    lambda: TimeWindows(0), lambda: TimeWindows(5, 0), lambda: TimeWindows(1.5), lambda: CountWindows(0),
    lambda: CountWindows(3, 0), lambda: StampWindows(np.array([1.0])), lambda: StampWindows(np.array([1.0, 1.0])),
    lambda: StampWindows(np.array([1.0, np.nan])), lambda: StampWindows(np.array([1.0, 2.0]), 0.0),
])
def test_rules_that_make_no_sense(make: object) -> None:
    with pytest.raises(InputError):
        make()  # type: ignore[operator]


def test_rules_describe_themselves() -> None:
    assert TimeWindows(10).describe() == {"rule": "time", "window_us": 10, "stride_us": 10}
    assert CountWindows(10, 5).describe() == {"rule": "count", "window_events": 10, "stride_events": 5}
    assert StampWindows(np.array([1.0, 2.0])).describe()["window_us"] == "to the next stamp"


@pytest.mark.parametrize("offset", [0, 1_600_000_000_000_000])
def test_slicer_reads_absolute_half_open_windows(offset: int, tmp_path: Path) -> None:
    events = random_events(5000, seed=3, start_us=offset, longest_gap_us=20)
    write_events_h5(tmp_path / "e.h5", events, offset)
    with h5py.File(tmp_path / "e.h5") as stream:
        slicer = EventSlicer(stream)
        assert slicer.get_start_time_us() == offset
        assert slicer.get_final_time_us() == events.t_us[-1]
        for start, stop in ((offset, offset + 3000), (offset + 1000.5, offset + 30_000.5)):
            found = slicer.get_events(start, stop)
            mask = (events.t_us >= start) & (events.t_us < stop)
            assert found is not None
            assert {name: column.tolist() for name, column in found.items()} == {
                "p": events.p[mask].tolist(), "x": events.x[mask].tolist(), "y": events.y[mask].tolist(),
                "t": events.t_us[mask].tolist()}
        assert stream.id.valid  # the caller's file stays open


def test_slicer_at_gaps_and_ends(tmp_path: Path) -> None:
    write_flat_h5(tmp_path / "e.h5", make_events([1, 1, 1], [2, 2, 2], [100, 50_400, 52_300], [1, 1, 0]))
    with h5py.File(tmp_path / "e.h5") as stream:
        slicer = EventSlicer(stream)
        gap = slicer.get_events(10_000, 20_000)
        assert gap is not None
        assert gap["t"].shape == (0,)
        assert slicer.get_events(50_000, 52_000)["t"].tolist() == [50_400]  # type: ignore[index]
        assert slicer.get_events(50_000, 52_001) is None  # the millisecond from 52 ms on is not complete
        assert slicer.get_events(60_000, 61_000) is None
        for start, stop in ((10, 10), (10, 5), (float("nan"), 5)):
            with pytest.raises(InputError, match="the end must be after the start"):
                slicer.get_events(start, stop)
