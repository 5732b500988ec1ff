"""DAVIS recordings with events as text: windows at image stamps, no frame later than the image that follows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import (
    Stamps,
    check_window_length,
    find_images,
    mean_interval_us,
    poses_reader,
    read_pinhole,
    read_stamps,
    refuse_own_camera,
    require_files,
    stamp_windows,
)
from utils.datasets.sequence import Sequence
from utils.events.reader import EventReader, open_events
from utils.events.shifted import ShiftedReader
from utils.events.slicing import EventWindow, StampWindows, WindowRule
from utils.events.validate import TimeUnit
from utils.undistort import read_rectify_map


class NextStampWindows(StampWindows):
    """Windows that begin at image stamps; the last of the stamps in use only says when the frame before it ends.

    The stamps in use are every `every`-th of those in `[start_us, stop_us)`. A window is kept as soon as it can hold
    events. Arguments as in `StampWindows`.
    """

    def stamps_in_use(self, start_us: float | None, stop_us: float | None, every: int) -> Stamps:
        """Return the stamps (N,) in microseconds; the first N - 1 begin windows."""
        lower = -np.inf if start_us is None else start_us
        upper = np.inf if stop_us is None else stop_us
        return self.stamps_us[(self.stamps_us >= lower) & (self.stamps_us < upper)][::every]

    def _borders(self, reader: EventReader, start_us: float | None, stop_us: float | None,
                 every: int) -> tuple[list[float], list[float]]:
        used = self.stamps_in_use(start_us, stop_us, every)
        if not len(used):
            return [], []
        starts, stops = super()._borders(reader, start_us, stop_us, every)
        count = int(np.searchsorted(starts, used[-1]))
        return starts[:count], stops[:count]


class NextStampSequence(Sequence):
    """A sequence whose frames have the stamp of the middle of their window, but at most that of the next image."""

    windows: WindowRule

    def frame_stamp_us(self, index: int, window: EventWindow) -> float:
        """Return `min(middle, s_{i+1})`; windows that do not begin at images have the stamp of their middle."""
        if not isinstance(self.windows, NextStampWindows):
            return float(window.middle_us)
        stamps = self.windows.stamps_in_use(self.options.start_us, self.options.stop_us, self.options.stride)
        return float(min(window.middle_us, stamps[np.searchsorted(stamps, window.start_us, "right")]))


@dataclass(frozen=True)
class TextLayout:
    """Names of the files of a preprocessed folder, and what is particular about the data set.

    Attributes:
        dataset: its name.
        command: makes missing files.
        size: (width, height) of the sensor in pixels.
        events, stamps, pinhole, images, poses: names in the folder.
        rectify_map: name in the folder, None for events of a camera without distortion.
        events_unit, poses_unit: units of the stamps in those files.
        window_ms: the window length must lie between these two, exclusively.
        up_to_next: windows end at the next image instead of lasting the mean image interval.
    """

    dataset: str
    command: str
    size: tuple[int, int]
    events: str
    stamps: str
    pinhole: str
    images: str
    poses: str
    rectify_map: str | None
    events_unit: TimeUnit
    window_ms: tuple[float, float]
    poses_unit: str = "us"
    up_to_next: bool = False


def open_text_sequence(path: Path, options: SequenceOptions, layout: TextLayout, *,
                       choose: Callable[[Stamps], Stamps] = lambda stamps: stamps, offset_us: int = 0) -> Sequence:
    """Open a preprocessed folder.

    Args:
        path: the folder.
        options: see `SequenceOptions`.
        layout: what is in the folder.
        choose: chooses the image stamps in use from all of them.
        offset_us: subtracted from the stamps of the events, which gives the clock of the images.

    Raises:
        InputError: files are missing or damaged or do not fit together, or options that the data set refuses.
    """
    refuse_own_camera(options, layout.dataset)
    files = {"events": layout.events, "image stamps": layout.stamps, "intrinsics": layout.pinhole}
    if layout.rectify_map is not None:
        files["rectify map"] = layout.rectify_map
    require_files(path, files.values(), layout.command)
    paths = {role: path / name for role, name in files.items()}
    if (path / layout.poses).is_file():
        paths["ground truth"] = path / layout.poses

    stamps = np.round(read_stamps(paths["image stamps"]), 3)  # seconds times 1e6 miss whole microseconds by a hair
    length_us = None if layout.up_to_next else mean_interval_us(stamps, paths["image stamps"])
    if options.window_dt_ms is not None:
        length_us = options.window_dt_ms * 1000
    windows: WindowRule
    if options.window_ms is not None or options.window_events is not None:
        windows, options = stamp_windows(choose(stamps), options, length_us)
    else:
        if length_us is not None:
            check_window_length(length_us, *layout.window_ms, paths["image stamps"])
        windows = NextStampWindows(choose(stamps), length_us)

    def open_reader() -> EventReader:
        reader = open_events(paths["events"], sensor_size=layout.size, time_unit=layout.events_unit,
                             on_unsorted=options.on_unsorted)
        return ShiftedReader(reader, -offset_us) if offset_us else reader

    intrinsics = read_pinhole(paths["intrinsics"], layout.size)
    positions = None if layout.rectify_map is None else read_rectify_map(paths["rectify map"], layout.size)
    return NextStampSequence(
        path.resolve().name, path, options, size=layout.size, intrinsics=intrinsics, open_reader=open_reader,
        windows=windows, rectify_map=positions,
        images=find_images(path / layout.images, stamps, lambda: intrinsics, layout.command),
        read_ground_truth=poses_reader(path / layout.poses, time_unit=layout.poses_unit), files=paths)
