"""How a sequence is read, independent of the data set."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from devo.errors import InputError
from utils.events.validate import Order, TimeUnit


@dataclass(frozen=True)
class SequenceOptions:
    """How a sequence is read; every data set uses what applies to it and refuses what does not.

    Attributes:
        side: camera of a stereo recording, "left" or "right".
        stride: use every n-th window or image; the length of the windows does not change.
        start_us, stop_us: use only windows inside `[start_us, stop_us)`, microseconds on the recording's clock.
        window_ms: cut events into adjacent windows of this length in milliseconds.
        window_events: cut events into adjacent windows of this many events.
        window_dt_ms: length in milliseconds of the windows that begin at the image stamps, instead of up to
            the next stamp.
        calib: calibration file that replaces the one of the recording.
        image_size: (width, height) of the sensor in pixels.
        intrinsics: `fx fy cx cy` of a camera without distortion, instead of a calibration file.
        time_unit: unit of the stamps in the event file, where it cannot be told from the file.
        on_unsorted: what to do about unsorted stamps: "error" or "sort" (loads the whole file).
        stream: which event stream of a file with several (a topic, or a part of its name); generic recordings only.

    Raises:
        InputError: values that contradict each other or make no sense.
    """

    side: str = "left"
    stride: int = 1
    start_us: float | None = None
    stop_us: float | None = None
    window_ms: float | None = None
    window_events: int | None = None
    window_dt_ms: float | None = None
    calib: Path | None = None
    image_size: tuple[int, int] | None = None
    intrinsics: tuple[float, ...] | None = None
    time_unit: TimeUnit | None = None
    on_unsorted: Order = "error"
    stream: str | None = None

    def __post_init__(self) -> None:
        if self.side not in ("left", "right"):
            raise InputError(f"side is {self.side!r}, expected left or right")
        if self.stride < 1:
            raise InputError(f"stride is {self.stride}, expected at least 1")
        given = {name: getattr(self, name) for name in ("window_ms", "window_events", "window_dt_ms")
                 if getattr(self, name) is not None}
        if len(given) > 1:
            raise InputError(f"{' and '.join(given)} were given together, expected only one rule for the windows")
        for name, value in given.items():
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}, expected a positive number")
        if self.start_us is not None and self.stop_us is not None and not self.start_us < self.stop_us:
            raise InputError(f"start_us {self.start_us} is not before stop_us {self.stop_us}")
        if self.calib is not None and self.intrinsics is not None:
            raise InputError("calib and intrinsics were given together, expected only one of them")
        if self.intrinsics is not None and len(self.intrinsics) != 4:
            raise InputError(f"intrinsics are {self.intrinsics}, expected 4 numbers fx fy cx cy")
        if self.image_size is not None and (len(self.image_size) != 2 or min(self.image_size) < 1):
            raise InputError(f"image_size is {self.image_size}, expected width and height in pixels")
