"""Events of any data set with the camera that a ROS program needs to undistort them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devo.errors import InputError
from utils.calibration import Calibration, read_calibration
from utils.datasets.options import SequenceOptions
from utils.datasets.registry import locate_sequence, open_sequence
from utils.datasets.sequence import Sequence
from utils.datasets.vector import EVENT_SIZE
from utils.events.reader import EventReader, open_events
from utils.events.types import Events
from utils.preprocessing.vector import find_calibrations
from utils.undistort import RectifyMap


@dataclass(frozen=True, eq=False)
class RosRecording:
    """Raw events and the camera that belongs to them.

    Attributes:
        open_reader: opens the events.
        camera: of the pixels that `events` yields.
        name: of the sequence.
        rectify_map: `(H, W, 2)` forward map; not None where the lens is known by its map only. Events are then written
            at their undistorted position, rounded to whole pixels, and `camera` has no distortion.
    """

    open_reader: Callable[[], EventReader]
    camera: Calibration
    name: str
    rectify_map: RectifyMap | None = None

    def events(self, reader: EventReader, start_us: float, stop_us: float, most: int) -> Iterator[Events]:
        """Yield the events with `start_us <= t <= stop_us` as `camera` sees them, at most `most` at a time."""
        for part in reader.chunks(most, start_us=start_us, stop_us=stop_us + 1):
            yield part if self.rectify_map is None else self._rectified(part, self.rectify_map)

    def _rectified(self, events: Events, positions: RectifyMap) -> Events:
        moved = np.rint(positions[events.y, events.x])
        with np.errstate(invalid="ignore"):
            inside = ((moved >= 0) & (moved < [self.camera.width, self.camera.height])).all(axis=1)
        x, y = moved[inside].astype(np.uint16).T
        return Events(x, y, events.t_us[inside], events.p[inside])


def open_recording(path: Path, dataset: str = "auto", side: str = "left", events: Path | None = None,
                   calib: Path | None = None, image_size: tuple[int, int] | None = None) -> RosRecording:
    """Open a recording for a ROS program.

    Where a calibration of the lens is at hand (generic recordings; VECtor with its `0_calib`), events keep their raw
    pixels and the camera has the real distortion. Elsewhere the rectification map is applied, see `RosRecording`.

    Args:
        path: folder of the sequence (not looked at if both `events` and `calib` are given).
        dataset: as for `open_sequence`; `auto` looks at the files.
        side: camera of a stereo data set.
        events, calib: files that replace those of the folder.
        image_size: (width, height), if no file says it.

    Raises:
        InputError: a recording that cannot be used.
    """
    if events is not None and calib is not None:
        with open_events(events) as reader:
            camera = read_calibration(calib, image_size, reader.sensor_size)
        size = (camera.width, camera.height)
        return RosRecording(lambda: open_events(events, sensor_size=size), camera, events.stem)
    if events is not None:
        path, dataset = events, "generic"
    options = SequenceOptions(side=side, calib=calib, image_size=image_size)
    found = locate_sequence(dataset, path, options).require_ready()
    sequence = open_sequence(found.dataset, found.path, options)
    if not isinstance(sequence, Sequence):
        raise InputError(f"{path}: the data set {found.dataset} holds ready-made voxel grids, no events to write")
    lens = _lens(sequence, found.dataset, side)
    if lens is not None or sequence.rectify_map is None:
        return RosRecording(sequence.open_events, lens or _pinhole(sequence), sequence.name)
    return RosRecording(sequence.open_events, _pinhole(sequence), sequence.name, sequence.rectify_map)


def _lens(sequence: Sequence, dataset: str, side: str) -> Calibration | None:
    """The calibration of the raw pixels, None where there is no such file."""
    files = sequence.describe()["files"]
    if dataset == "generic" and "calibration" in files:
        return read_calibration(files["calibration"], sequence.options.image_size, sequence.sensor_size)
    if dataset == "vector":
        try:
            folder = find_calibrations(sequence.path)
        except InputError:  # preprocessed folders may come without it; their rectification map does as well
            return None
        return read_calibration(folder / f"{side}_event_camera_intrinsic_results.yaml", EVENT_SIZE,
                                default_model="radtan")
    return None


def _pinhole(sequence: Sequence) -> Calibration:
    """The undistorted camera at the size of the sensor."""
    width, height = sequence.sensor_size
    fx, fy, cx, cy = sequence.intrinsics * np.tile([width / sequence.width, height / sequence.height], 2)
    return Calibration(width, height, float(fx), float(fy), float(cx), float(cy))
