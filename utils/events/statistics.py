"""What a recording is like: size, duration, rate, polarity, gaps, hot pixels, order of the stamps; in one pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage

from utils.events.types import Events

_MOST_BINS = 1024
_LONGEST_GAPS = 5
# A hot pixel fires this many times as often as all but one of the pixels around it, and far more than the average
# pixel. All but one, because hot pixels come in pairs too, and lines, with their ends, have more bright pixels.
_HOT_FACTOR = 8.0
_HOT_STANDARD_DEVIATIONS = 3.0
_HOT_LEAST_EVENTS = 10


class Gap(NamedTuple):
    """A pause: when it begins (microseconds), how long it lasts, and after how many events."""

    start_us: int
    length_us: int
    event: int


class HotPixel(NamedTuple):
    """A pixel that fires far more often than its neighbours."""

    x: int
    y: int
    events: int


class Rate(NamedTuple):
    """Events over time, in equal bins from the first stamp on.

    Attributes:
        bin_us: width of a bin in microseconds.
        events: (B,) events per bin.
        brighter: (B,) those of polarity 1.
    """

    bin_us: int
    events: npt.NDArray[np.int64]
    brighter: npt.NDArray[np.int64]


class EventStatistics:
    """Statistics of a recording that is passed in piece by piece; memory does not grow with its length.

    Args:
        sensor_size: (width, height) in pixels; None takes the largest coordinates seen.
        gap_us: pauses of at least this length are counted.

    Attributes:
        events, brighter: how many events, and how many of polarity 1.
        first_us, last_us: smallest and largest stamp.
        backward_steps: how many stamps are smaller than the one before.
        largest_backward_us: by how much at most.
        gap_count: pauses of at least `gap_us`.
    """

    def __init__(self, sensor_size: tuple[int, int] | None = None, gap_us: int = 10_000) -> None:
        self.sensor_size = sensor_size
        self.gap_us = gap_us
        self.events = self.brighter = 0
        self.first_us = self.last_us = 0
        self.backward_steps = self.largest_backward_us = 0
        self.gap_count = 0
        self._gaps: list[Gap] = []
        width, height = sensor_size or (0, 0)
        self._counts = np.zeros((height, width), np.int64)
        self._bin_us = 100
        self._bins = np.zeros((2, _MOST_BINS), np.int64)
        self._origin_us = self._previous_us = 0

    def add(self, events: Events) -> None:
        """Take the next events of the recording."""
        if not len(events):
            return
        if not self.events:
            self._origin_us = self._previous_us = self.first_us = int(events.t_us[0])
        self._add_order(events.t_us)
        self._add_pixels(events)
        self._add_rate(events)
        self.events += len(events)
        self.brighter += int(np.count_nonzero(events.p))

    @property
    def duration_us(self) -> int:
        """From the smallest to the largest stamp."""
        return self.last_us - self.first_us

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels: that of the sensor, or of the smallest sensor that holds all events."""
        return self._counts.shape[1], self._counts.shape[0]

    @property
    def pixel_counts(self) -> npt.NDArray[np.int64]:
        """(H, W) events of each pixel."""
        return self._counts

    @property
    def longest_gaps(self) -> list[Gap]:
        """The longest pauses, longest first."""
        return self._gaps

    @property
    def rate(self) -> Rate:
        """Events over time, at most a few thousand bins."""
        used = int(np.max(np.flatnonzero(self._bins.any(axis=0)), initial=-1)) + 1
        return Rate(self._bin_us, self._bins.sum(axis=0)[:used], self._bins[1, :used])

    def hot_pixels(self) -> list[HotPixel]:
        """Pixels that fire 8 times as often as all but one of the 5x5 around them and 3 sigma above the mean."""
        if not self._counts.size:
            return []
        around = scipy.ndimage.rank_filter(self._counts, -3, size=5, mode="constant", cval=0)
        least = max(self._counts.mean() + _HOT_STANDARD_DEVIATIONS * self._counts.std(), _HOT_LEAST_EVENTS)
        rows, columns = np.nonzero((self._counts > _HOT_FACTOR * around) & (self._counts >= least))
        found = [HotPixel(int(x), int(y), int(self._counts[y, x])) for x, y in zip(columns, rows)]
        return sorted(found, key=lambda pixel: -pixel.events)

    def _add_order(self, t_us: npt.NDArray[np.int64]) -> None:
        self.first_us = min(self.first_us, int(t_us.min()))
        self.last_us = max(self.last_us, int(t_us.max()))
        steps = np.diff(t_us, prepend=self._previous_us)
        if (smallest := int(steps.min())) < 0:
            self.backward_steps += int(np.count_nonzero(steps < 0))
            self.largest_backward_us = max(self.largest_backward_us, -smallest)
        self.gap_count += int(np.count_nonzero(steps >= self.gap_us))
        least = max(int(np.partition(steps, -_LONGEST_GAPS)[-_LONGEST_GAPS]), 1) if len(steps) > _LONGEST_GAPS else 1
        candidates = [*np.flatnonzero(steps > least), *np.flatnonzero(steps == least)[:_LONGEST_GAPS]]
        gaps = [Gap(int(t_us[i] - steps[i]), int(steps[i]), self.events + int(i)) for i in candidates]
        self._gaps = sorted(self._gaps + gaps, key=lambda gap: (-gap.length_us, gap.event))[:_LONGEST_GAPS]
        self._previous_us = int(t_us[-1])

    def _add_pixels(self, events: Events) -> None:
        height, width = self._counts.shape
        seen = int(events.y.max()) + 1, int(events.x.max()) + 1
        if seen[0] > height or seen[1] > width:
            self._counts = np.pad(self._counts, ((0, max(seen[0] - height, 0)), (0, max(seen[1] - width, 0))))
            height, width = self._counts.shape
        pixel = events.y.astype(np.int64) * width + events.x
        self._counts += np.bincount(pixel, minlength=height * width).reshape(height, width)

    def _add_rate(self, events: Events) -> None:
        """Count events per bin; when they no longer fit, two neighbouring bins become one."""
        since = np.maximum(events.t_us - self._origin_us, 0)
        while int(since.max()) >= self._bin_us * _MOST_BINS:
            pairs = self._bins.reshape(2, -1, 2).sum(axis=2)
            self._bins = np.concatenate([pairs, np.zeros_like(pairs)], axis=1)
            self._bin_us *= 2
        number = since // self._bin_us + _MOST_BINS * events.p.astype(np.int64)
        self._bins += np.bincount(number, minlength=2 * _MOST_BINS).reshape(2, _MOST_BINS)
