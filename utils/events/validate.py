"""Turn raw event columns into `Events`, or say in one line which event is wrong and why."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.events.types import Events

TimeUnit = Literal["s", "ms", "us", "ns"]
Order = Literal["error", "sort"]
Column = npt.NDArray[Any]
Locator = Callable[[int], str]

_MICROSECONDS_PER: dict[str, int] = {"s": 1_000_000, "ms": 1_000, "us": 1}
# Slower than this over a thousand events means the unit was guessed wrongly: no event camera is that quiet.
_LEAST_EVENTS_PER_SECOND = 10.0


def make_events(x: npt.ArrayLike, y: npt.ArrayLike, t_us: npt.ArrayLike, p: npt.ArrayLike, *,
                sensor_size: tuple[int, int] | None = None, source: str = "events") -> Events:
    """Convert four array-likes to checked `Events`.

    Args:
        x, y: (N,) whole sensor pixels of any numeric dtype.
        t_us: (N,) microseconds, non-decreasing, not negative.
        p: (N,) bool, 0/1 or -1/+1.
        sensor_size: (width, height) in pixels that bounds the coordinates.
        source: what to call these events in error messages.

    Raises:
        InputError: see `checked_events`.
    """
    columns = [np.asarray(column) for column in (x, y, t_us, p)]
    check_lengths(dict(zip("xytp", columns)), source)
    return checked_events(columns[0], columns[1], to_microseconds(columns[2], "us", lambda i: f"{source}: event {i}"),
                          columns[3], where=lambda i: f"{source}: event {i}", sensor_size=sensor_size)


def check_lengths(columns: dict[str, Column], source: str) -> int:
    """Return the common length of one-dimensional columns.

    Raises:
        InputError: a column is not one-dimensional or the lengths differ.
    """
    for name, column in columns.items():
        if column.ndim != 1:
            raise InputError(f"{source}: column {name} has shape {tuple(column.shape)}, expected one dimension")
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        listing = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"{source}: the event columns differ in length ({listing}); the file is damaged or "
                         "was not written to its end")
    return next(iter(lengths.values()))


def check_options(time_unit: str | None, on_unsorted: str, sensor_size: tuple[int, int] | None) -> None:
    """Check the options that every reader shares.

    Raises:
        InputError: an option has a value that does not exist.
    """
    if time_unit is not None and time_unit not in get_args(TimeUnit):
        raise InputError(f"time unit is {time_unit!r}, expected one of {', '.join(get_args(TimeUnit))}")
    if on_unsorted not in get_args(Order):
        raise InputError(f"on_unsorted is {on_unsorted!r}, expected one of {', '.join(get_args(Order))}")
    if sensor_size is not None and (len(sensor_size) != 2 or min(sensor_size) < 1 or max(sensor_size) > 65536):
        raise InputError(f"sensor size is {tuple(sensor_size)}, expected (width, height), each 1 to 65536 pixels")


def guess_time_unit(stamps: Column) -> TimeUnit:
    """Guess the unit of numeric stamps: whole numbers are microseconds, fractions are seconds."""
    if stamps.dtype.kind in "iu":
        return "us"
    finite = stamps[np.isfinite(stamps)]
    return "us" if len(finite) > 1 and finite[-1] > finite[0] and bool(np.all(finite == np.floor(finite))) else "s"


def check_guessed_unit(t_us: npt.NDArray[np.int64], unit: TimeUnit, source: str) -> None:
    """Refuse a guessed unit that leads to an impossible event rate.

    Raises:
        InputError: more than a thousand events at fewer than ten per second.
    """
    if len(t_us) < 1000:
        return
    seconds = max(int(t_us[-1]) - int(t_us[0]), 1) * 1e-6
    if len(t_us) / seconds < _LEAST_EVENTS_PER_SECOND:
        raise InputError(f"{source}: read as {unit!r} the first {len(t_us)} events would span {seconds:.0f} s, but no "
                         "event camera is that quiet; pass the unit of the stamps, for example time_unit=\"us\"")


def to_microseconds(stamps: Column, unit: TimeUnit, where: Locator) -> npt.NDArray[np.int64]:
    """Convert numeric stamps to whole microseconds, rounded to nearest.

    Args:
        stamps: (N,) of any numeric dtype, in `unit`.
        where: names event i in messages.

    Raises:
        InputError: a stamp is NaN, infinite or does not fit 64 bits, or the column is not numeric.
    """
    if stamps.dtype.kind == "f":
        values = stamps.astype(np.float64)
        bad = ~np.isfinite(values)
        if bad.any():
            raise InputError(f"{where(_first(bad))}: time stamp is {values[_first(bad)]}, expected a finite number")
        bad = np.abs(values) >= 2.0**62 / _MICROSECONDS_PER.get(unit, 1)
        if bad.any():
            raise InputError(f"{where(_first(bad))}: time stamp {stamps[_first(bad)]} {unit} is out of any range")
        return np.rint(values / 1000.0 if unit == "ns" else values * _MICROSECONDS_PER[unit]).astype(np.int64)
    if stamps.dtype.kind not in "iub":
        raise InputError(f"{where(0)}: time stamps have dtype {stamps.dtype}, expected numbers")
    limit = 2**62 // _MICROSECONDS_PER.get(unit, 1)
    bad = (stamps > limit) | (stamps < -limit) if stamps.dtype.itemsize == 8 else np.zeros(0, bool)
    if bad.any():
        raise InputError(f"{where(_first(bad))}: time stamp {stamps[_first(bad)]} {unit} is out of any range")
    whole = stamps.astype(np.int64)
    return (whole + 500) // 1000 if unit == "ns" else whole * _MICROSECONDS_PER[unit]


def checked_events(x: Column, y: Column, t_us: npt.NDArray[np.int64], p: Column, *, where: Locator,
                   previous_us: int | None = None, sensor_size: tuple[int, int] | None = None,
                   order: Order = "error") -> Events:
    """Check raw columns of equal length and convert them to `Events`.

    Args:
        x, y: (N,) whole sensor pixels.
        t_us: (N,) int64 microseconds.
        p: (N,) bool, 0/1 or -1/+1.
        where: names event i of these columns in messages, for example "events.txt: event 7 (line 8)".
        previous_us: stamp of the event just before these columns.
        sensor_size: (width, height) in pixels; unknown size checks only the range of uint16.
        order: "sort" leaves unsorted stamps alone, because the caller sorts later.

    Raises:
        InputError: stamps that are negative, wrapped or (with order="error") run backwards; coordinates that
            are fractional or outside the sensor; polarity other than 0, 1, -1.
    """
    _check_stamps(t_us, previous_us, where, order)
    width, height = sensor_size if sensor_size is not None else (65536, 65536)
    return Events(_pixels(x, "x", width, where, sensor_size), _pixels(y, "y", height, where, sensor_size),
                  t_us, _polarity(p, where))


def _first(bad: npt.NDArray[np.bool_]) -> int:
    return int(np.argmax(bad))


def _check_stamps(t_us: npt.NDArray[np.int64], previous_us: int | None, where: Locator, order: Order) -> None:
    if not len(t_us):
        return
    backwards = t_us[1:] < t_us[:-1]
    at_start = previous_us is not None and int(t_us[0]) < previous_us
    if at_start or backwards.any():
        _explain_jump(t_us, previous_us if at_start else None, backwards, where, order)
    # After an explained wrap of a signed counter, what is still negative was negative from the start.
    if int(t_us[0]) < 0 or int(t_us.min()) < 0:
        index = _first(t_us < 0)
        raise InputError(f"{where(index)}: negative time stamp {t_us[index]} us; stamps must start at or after 0, "
                         "shift the recording first")


def _explain_jump(t_us: npt.NDArray[np.int64], previous_us: int | None, backwards: npt.NDArray[np.bool_],
                  where: Locator, order: Order) -> None:
    """Raise for the first stamp that runs backwards, or for the first wrap when the caller sorts anyway."""
    jumps = [] if previous_us is None else [(0, previous_us, int(t_us[0]))]
    indices = np.flatnonzero(backwards) + 1
    jumps += [(int(i), int(t_us[i - 1]), int(t_us[i])) for i in indices[:1]]
    if len(indices):  # the largest jump decides whether a counter wrapped
        biggest = int(indices[np.argmax(t_us[indices - 1] - t_us[indices])])
        jumps.append((biggest, int(t_us[biggest - 1]), int(t_us[biggest])))
    for index, before, after in jumps:
        for bits in (32, 31):
            if before - after > 0.9 * 2**bits and 0.9 * 2**bits < before <= 2**bits:
                raise InputError(f"{where(index)}: the time stamp falls from {before} us to {after} us: a 32-bit "
                                 "microsecond counter wrapped; unwrap the stamps (add 2**32 after each fall) first")
    if order == "error":
        index, before, after = jumps[0]
        raise InputError(f"{where(index)}: time stamps are not sorted, {after} us follows {before} us; sort the "
                         "events by time first or read with on_unsorted=\"sort\"")


def _pixels(values: Column, axis: str, limit: int, where: Locator,
            sensor_size: tuple[int, int] | None) -> npt.NDArray[np.uint16]:
    if values.dtype == np.uint16 and limit == 65536:
        return np.ascontiguousarray(values)
    if values.dtype.kind == "f":
        bad = ~np.isfinite(values) | (values != np.floor(values))
        if bad.any():
            raise InputError(f"{where(_first(bad))}: {axis} is {values[_first(bad)]}, expected a whole sensor pixel "
                             "(events that were undistorted before cannot be read)")
    elif values.dtype.kind not in "iub":
        raise InputError(f"{where(0)}: column {axis} has dtype {values.dtype}, expected numbers")
    if len(values) and (values.max() >= limit or values.min() < 0):
        index = _first((values >= limit) | (values < 0))
        of_sensor = f"the sensor of {sensor_size[0]}x{sensor_size[1]} pixels" if sensor_size else "any known sensor"
        raise InputError(f"{where(index)}: {axis} = {values[index]} is outside {of_sensor}; check the sensor size "
                         "and the order of the columns")
    return np.ascontiguousarray(values, dtype=np.uint16)


def _polarity(values: Column, where: Locator) -> npt.NDArray[np.uint8]:
    if values.dtype == np.bool_:
        return values.astype(np.uint8)
    if values.dtype.kind not in "iuf":
        raise InputError(f"{where(0)}: column p has dtype {values.dtype}, expected numbers")
    if values.dtype == np.uint8 and (not len(values) or values.max() <= 1):
        return np.ascontiguousarray(values)
    positive = values == 1
    bad = ~(positive | (values == 0) | (values == -1))
    if bad.any():
        raise InputError(f"{where(_first(bad))}: polarity is {values[_first(bad)]}, expected 0/1 or -1/+1")
    return positive.astype(np.uint8)
