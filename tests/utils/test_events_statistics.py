"""What a recording is like: planted defects are found, and passing in pieces changes nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.utils.event_samples import HEIGHT, WIDTH, random_events
from utils.events import Events
from utils.events.report import describe
from utils.events.statistics import EventStatistics, Gap, HotPixel


def collect(parts: list[Events], **options: object) -> EventStatistics:
    statistics = EventStatistics((WIDTH, HEIGHT), **options)  # type: ignore[arg-type]
    for part in parts:
        statistics.add(part)
    return statistics


def summary(statistics: EventStatistics) -> tuple[object, ...]:
    rate = statistics.rate
    return (statistics.events, statistics.brighter, statistics.first_us, statistics.last_us,
            statistics.backward_steps, statistics.largest_backward_us, statistics.gap_count,
            statistics.longest_gaps, statistics.pixel_counts.tolist(), rate.bin_us, rate.events.tolist(),
            rate.brighter.tolist(), statistics.hot_pixels())


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(1, 400), gap=st.sampled_from([0, 30, 4000, 10**6]),
       borders=st.lists(st.integers(0, 400), max_size=5))
def test_pieces_do_not_matter(seed: int, count: int, gap: int, borders: list[int]) -> None:
    events = random_events(count, seed, longest_gap_us=gap)
    cuts = [0, *sorted(borders), count]
    parts = [events[first:last] for first, last in zip(cuts, cuts[1:])]
    assert summary(collect(parts)) == summary(collect([events]))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(1, 400), gap=st.sampled_from([0, 30, 10**6]))
def test_numbers_are_those_of_a_direct_count(seed: int, count: int, gap: int) -> None:
    events = random_events(count, seed, longest_gap_us=gap)
    statistics = collect([events])
    assert statistics.events == count
    assert statistics.brighter == events.p.sum()
    assert statistics.duration_us == events.t_us[-1] - events.t_us[0]
    assert statistics.pixel_counts.sum() == count
    assert statistics.pixel_counts[events.y[0], events.x[0]] == np.sum((events.x == events.x[0])
                                                                      & (events.y == events.y[0]))
    rate = statistics.rate
    assert rate.events.sum() == count
    assert rate.brighter.sum() == events.p.sum()
    borders = events.t_us[0] + np.arange(len(rate.events) + 1) * rate.bin_us
    np.testing.assert_array_equal(rate.events, np.histogram(events.t_us, borders)[0] if count else [])
    assert (len(rate.events) - 1) * rate.bin_us <= statistics.duration_us < len(rate.events) * rate.bin_us


def test_gaps_are_found_where_they_are() -> None:
    events = random_events(1000, seed=1)
    t_us = events.t_us.copy()
    t_us[400:] += 25_000
    t_us[700:] += 60_000
    statistics = collect([Events(events.x, events.y, t_us, events.p)])
    assert statistics.gap_count == 2
    assert statistics.longest_gaps[0] == Gap(int(t_us[699]), int(t_us[700] - t_us[699]), 700)
    assert statistics.longest_gaps[1] == Gap(int(t_us[399]), int(t_us[400] - t_us[399]), 400)


def test_steps_backwards_are_counted() -> None:
    events = random_events(1000, seed=2)
    t_us = events.t_us.copy()
    t_us[500] -= 3000
    statistics = collect([Events(events.x, events.y, t_us, events.p)])
    assert statistics.backward_steps == 1
    assert statistics.largest_backward_us == int(t_us[499] - t_us[500])


def test_hot_pixels_and_bright_edges() -> None:
    """Two planted pixels are found; a line that fires as often is none."""
    rng = np.random.default_rng(3)
    noise = random_events(3000, seed=3)
    line = np.arange(200 * 30)
    x = np.concatenate([noise.x, np.full(400, 10), np.full(300, 50), np.full(len(line), 30)]).astype(np.uint16)
    y = np.concatenate([noise.y, np.full(400, 20), np.full(300, 5), line % 40]).astype(np.uint16)
    order = rng.permutation(len(x))
    events = Events(x[order], y[order], np.arange(len(x)), np.ones(len(x), np.uint8))
    found = collect([events]).hot_pixels()
    counts = [int(np.sum((x == hot.x) & (y == hot.y))) for hot in found]
    assert found == [HotPixel(10, 20, counts[0]), HotPixel(50, 5, counts[1])]


def test_a_wild_stamp_does_not_cost_memory() -> None:
    events = Events(np.zeros(3, np.uint16), np.zeros(3, np.uint16), np.array([0, 10, 2**60]), np.ones(3, np.uint8))
    assert len(collect([events]).rate.events) <= 4096


def test_unknown_size_grows() -> None:
    statistics = EventStatistics()
    events = random_events(500, seed=4)
    for first in range(0, 500, 50):
        statistics.add(events[first:first + 50])
    assert statistics.size == (int(events.x.max()) + 1, int(events.y.max()) + 1)
    assert statistics.pixel_counts.sum() == 500


@pytest.mark.parametrize("count", [1, 2, 2000])
def test_report_has_every_line(count: int) -> None:
    statistics = collect([random_events(count, seed=5)])
    report = dict(describe(statistics, format_name="text", size_is_known=False, losses={"damaged packets": 3}))
    assert list(report) == ["format", "sensor", "events", "duration", "rate", "polarity", "order", "gaps",
                            "hot pixels", "losses"]
    assert report["sensor"].startswith("64 x 48 pixels (not said by the file")
    assert report["order"] == "sorted by time"
    assert report["losses"] == "3 damaged packets"
