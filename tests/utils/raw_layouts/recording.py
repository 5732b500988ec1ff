"""The simulated recording that all raw layouts are written from, and its twin as a recording of one's own."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from utils.calibration import Calibration
from utils.events import Events, write_events_h5
from utils.simulator.sequence import SequenceSettings, SimulatedSequence

SECONDS = 0.45
IMAGE_INTERVAL_US = 33_000
EPOCH_US = 1_600_000_000_000_000
"""Where a clock of Unix microseconds stands."""
_SMALL = (120, 90)
_SCALE = 2


@dataclass(frozen=True)
class RawRecording:
    """Events, 8-bit gray images and camera poses of a camera with `size` (width, height) pixels, on one clock."""

    size: tuple[int, int]
    events: Events
    stamps_us: np.ndarray
    images: list[np.ndarray]
    poses_us: np.ndarray
    world_T_cam: np.ndarray

    def later(self, shift_us: int) -> RawRecording:
        """The same on a clock that shows `shift_us` more."""
        events = Events(self.events.x, self.events.y, self.events.t_us + shift_us, self.events.p)
        return replace(self, events=events, stamps_us=self.stamps_us + shift_us, poses_us=self.poses_us + shift_us)

    def right(self) -> RawRecording:
        """Another camera that sees the scene four pixels further left."""
        seen = self.events.x >= 4
        columns = [getattr(self.events, name)[seen] for name in ("x", "y", "t_us", "p")]
        return replace(self, events=Events(columns[0] - np.uint16(4), *columns[1:]),
                       images=[np.roll(image, -4, axis=1) for image in self.images])

    def on_sensor(self, size: tuple[int, int]) -> RawRecording:
        """The recording in the middle of a larger sensor that sees nothing around it."""
        right, down = (size[0] - self.size[0]) // 2, (size[1] - self.size[1]) // 2
        rest = (size[1] - self.size[1] - down, size[0] - self.size[0] - right)
        events = Events(self.events.x + np.uint16(right), self.events.y + np.uint16(down), self.events.t_us,
                        self.events.p)
        images = [np.pad(image, ((down, rest[0]), (right, rest[1])), mode="edge") for image in self.images]
        return replace(self, size=size, events=events, images=images)


@functools.lru_cache(maxsize=1)
def simulated() -> RawRecording:
    """0.45 s of the board on 240x180 pixels from 0 us: events of a smaller sensor, spread over blocks of 2x2 pixels."""
    settings = SequenceSettings("board", SECONDS, seed=1, size=_SMALL, step_px=1.0, noise="none")
    sequence = SimulatedSequence(settings)
    events = Events.concatenate([part for _, part in sequence.events()])
    jitter = np.random.default_rng(5).integers(0, _SCALE, (2, len(events))).astype(np.uint16)
    events = Events(events.x * np.uint16(_SCALE) + jitter[0], events.y * np.uint16(_SCALE) + jitter[1], events.t_us,
                    events.p)
    stamps_us = np.arange(2_000, sequence.duration_us - IMAGE_INTERVAL_US // 2, IMAGE_INTERVAL_US)
    light = sequence.log_intensity(stamps_us.astype(np.float64)).exp()
    small = (light / light.max() * 255.0).round().byte().numpy()
    poses_us = np.arange(1_000, sequence.duration_us, 10_000)
    return RawRecording((_SMALL[0] * _SCALE, _SMALL[1] * _SCALE), events, stamps_us,
                        [np.kron(image, np.ones((_SCALE, _SCALE), np.uint8)) for image in small], poses_us,
                        sequence.path.poses(poses_us).numpy())


def random_recording(size: tuple[int, int] = (240, 180), start_us: int = EPOCH_US,
                     count: int = 900) -> RawRecording:
    """A small recording of random events with four images and six poses, all on a clock of Unix microseconds."""
    rng = np.random.default_rng(2)
    t_us = start_us + 2000 + np.sort(rng.integers(0, 120_000, count))
    x, y, p = (rng.integers(0, limit, count) for limit in (*size, 2))
    events = Events(x.astype(np.uint16), y.astype(np.uint16), t_us, p.astype(np.uint8))
    images = [rng.integers(0, 256, (size[1], size[0])).astype(np.uint8) for _ in range(4)]
    turn = rng.normal(size=(6, 4))
    poses = np.hstack([rng.normal(size=(6, 3)), turn / np.linalg.norm(turn, axis=1, keepdims=True)])
    return RawRecording(size, events, start_us + 5000 + 30_000 * np.arange(4), images,
                        start_us + 1000 + 20_000 * np.arange(6), poses)


def write_generic(folder: Path, recording: RawRecording, calibration: Calibration) -> Path:
    """Write the recording as one's own, for `--dataset generic`; the camera's distortion is in the calibration."""
    folder.mkdir(parents=True)
    write_events_h5(folder / "events.h5", recording.events, None)
    (folder / "calib.yaml").write_text(yaml.safe_dump(calibration.as_dict()))
    np.savetxt(folder / "images_timestamps_us.txt", recording.stamps_us, fmt="%d")
    return folder
