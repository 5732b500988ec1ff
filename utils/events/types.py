"""The one in-memory form of events: four columns of equal length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devo.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """Events as columns (struct of arrays), ordered by time.

    Attributes:
        x: (N,) uint16, column of the raw sensor pixel.
        y: (N,) uint16, row of the raw sensor pixel.
        t_us: (N,) int64, microseconds, non-decreasing.
        p: (N,) uint8, 1 = brighter, 0 = darker.

    Raises:
        InputError: the columns differ in length, dtype or are not one-dimensional.
    """

    x: npt.NDArray[np.uint16]
    y: npt.NDArray[np.uint16]
    t_us: npt.NDArray[np.int64]
    p: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        expected = {"x": np.uint16, "y": np.uint16, "t_us": np.int64, "p": np.uint8}
        for name, dtype in expected.items():
            column = getattr(self, name)
            if not isinstance(column, np.ndarray) or column.dtype != dtype or column.shape != (len(self.t_us),):
                raise InputError(f"event column {name} is {getattr(column, 'dtype', type(column).__name__)} "
                                 f"{getattr(column, 'shape', '')}, expected {np.dtype(dtype)} ({len(self.t_us)},); "
                                 "use utils.events.make_events to convert and check arrays")

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, rows: slice) -> Events:
        """Return the given range of events as views."""
        return Events(self.x[rows], self.y[rows], self.t_us[rows], self.p[rows])

    def between(self, start_us: float, stop_us: float) -> Events:
        """Return the events with `start_us <= t_us < stop_us` (views, binary search)."""
        borders = np.array([_whole(start_us), _whole(stop_us)], np.int64)  # floats would make numpy copy all stamps
        first, last = np.searchsorted(self.t_us, borders, side="left")
        return self[int(first):int(last)]

    @classmethod
    def empty(cls) -> Events:
        """Return zero events."""
        return cls(np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.int64), np.empty(0, np.uint8))

    @classmethod
    def concatenate(cls, parts: Sequence[Events]) -> Events:
        """Join pieces in the given order; one piece is returned as it is, none gives zero events."""
        filled = [part for part in parts if len(part)]
        if len(filled) == 1:
            return filled[0]
        if not filled:
            return cls.empty()
        return cls(*(np.concatenate([getattr(part, name) for part in filled]) for name in ("x", "y", "t_us", "p")))


def _whole(border_us: float) -> int:
    """Return the first whole microsecond at or after a border, infinite borders included."""
    return math.ceil(min(max(border_us, -(2.0**62)), 2.0**62))
