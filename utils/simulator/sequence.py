"""A simulated recording as a stream: events piece by piece, and exact poses and depths at any time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch

from devo.errors import InputError
from utils.calibration import Calibration
from utils.events.types import Events
from utils.simulator.camera import camera_preset, camera_rays
from utils.simulator.events import EventSettings, NoiseSource, PixelArray, TimedEvents, expand, resting_pixels
from utils.simulator.handheld import PRESETS, HandheldPath
from utils.simulator.renderer import Renderer, render_in_chunks
from utils.simulator.textures import build_atlas
from utils.simulator.worlds import WORLDS, World, build_world

NOISE = {
    "none": EventSettings(mismatch=0.0),
    "typical": EventSettings(mismatch=0.035, refractory_us=200.0, leak_hz=0.1, shot_hz=0.2, hot_fraction=5e-5),
    "strong": EventSettings(mismatch=0.08, refractory_us=500.0, leak_hz=0.3, shot_hz=2.0, hot_fraction=5e-4),
}


@dataclasses.dataclass(frozen=True)
class SequenceSettings:
    """What to record.

    Attributes:
        scene: one of `worlds.WORLDS`.
        seconds: length.
        seed: decides geometry, textures, path and noise.
        preset: one of `handheld.PRESETS`.
        size: width and height in pixels.
        distorted: use a barrel-distorted lens.
        background: put a slanted plane behind the board.
        threshold: contrast threshold in log intensity.
        noise: one of `NOISE`.
        step_px: largest image motion between two renderings.
        textures: folder of images that cover the surfaces, as a path in text; empty for procedural textures.

    Raises:
        InputError: a value out of range or an unknown name.
    """

    scene: str = "board"
    seconds: float = 8.0
    seed: int = 0
    preset: str = "normal"
    size: tuple[int, int] = (240, 180)
    distorted: bool = False
    background: bool = False
    threshold: float = 0.22
    noise: str = "typical"
    step_px: float = 0.5
    textures: str = ""

    def __post_init__(self) -> None:
        for what, name, known in (("scene", self.scene, WORLDS), ("preset", self.preset, PRESETS),
                                  ("noise", self.noise, NOISE)):
            if name not in known:
                raise InputError(f"{what} is {name!r}, expected one of {', '.join(known)}")
        if not 0.05 <= self.seconds <= 3600.0:
            raise InputError(f"the recording would last {self.seconds:g} s, expected 0.05 to 3600 seconds")
        if not 0.02 <= self.threshold <= 2.0:
            raise InputError(f"contrast threshold is {self.threshold:g}, expected 0.02 to 2")
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}, expected a whole number from 0")
        if not 0.01 <= self.step_px <= 4.0:
            raise InputError(f"image motion per rendering is {self.step_px:g} px, expected 0.01 to 4")

    @property
    def pixels(self) -> EventSettings:
        """Parameters of the pixel array."""
        return dataclasses.replace(NOISE[self.noise], threshold=self.threshold)


class SimulatedSequence:
    """A world, a path through it and the camera that is carried along.

    Attributes:
        settings: as given.
        camera: calibration of the camera; everything it sees is in its raw, possibly distorted, pixels.
        world: scene in metres.
        path: `path.poses(t_us)` gives world_T_cam.
        duration_us: length in microseconds.
    """

    def __init__(self, settings: SequenceSettings, device: torch.device | str = "cpu") -> None:
        self.settings = settings
        self.camera: Calibration = camera_preset(*settings.size, settings.distorted)
        self.world: World = build_world(settings.scene, self.camera.fx, settings.seed, settings.background,
                                        Path(settings.textures) if settings.textures else None)
        self.duration_us = round(settings.seconds * 1e6)
        rays = camera_rays(self.camera)
        path_rng = np.random.default_rng([settings.seed, 2])
        self.path = HandheldPath(self.world, rays, float(self.duration_us), PRESETS[settings.preset], path_rng)
        self._device = torch.device(device)
        self._renderer = Renderer(self.world.planes.to(device), build_atlas(self.world.draw_tiles().to(device)),
                                  camera_rays(self.camera, device), self.world.empty)

    def log_intensity(self, t_us: np.ndarray) -> torch.Tensor:
        """Log intensity `(N, H, W)` float32 at `(N,)` times."""
        return render_in_chunks(self._renderer, self.path.poses(t_us).float().to(self._device))

    def depth(self, t_us: np.ndarray) -> torch.Tensor:
        """Z-depth in metres `(N, H, W)` float32 at `(N,)` times; 0 where nothing is hit."""
        inverse = self._renderer.inverse_depth(self.path.poses(t_us).float().to(self._device))
        return torch.where(inverse > 0, inverse.reciprocal(), inverse)

    def events(self) -> Iterator[tuple[float, Events]]:
        """Yield (time in microseconds up to which the recording is complete, sorted events since the last piece)."""
        camera, settings = self.camera, self.settings.pixels
        generator = torch.Generator().manual_seed(self.settings.seed)
        array = resting_pixels((camera.height, camera.width), settings, generator, self._device)
        noise = NoiseSource(settings, camera.height * camera.width, generator)
        times = self.path.render_times(self.settings.step_px)
        steps = int(np.clip(4_000_000 // (camera.height * camera.width), 4, 64))
        pieces = [times[first : first + steps + 1] for first in range(0, len(times) - 1, steps)]
        with ThreadPoolExecutor(1) as renderer:  # the next piece is drawn while the pixels look at this one
            upcoming = renderer.submit(self.log_intensity, pieces[0])
            for number, borders in enumerate(pieces):
                log_intensity = upcoming.result()
                if number + 1 < len(pieces):
                    upcoming = renderer.submit(self.log_intensity, pieces[number + 1])
                parts = list_events(log_intensity, borders, array)
                parts.append(noise.draw(float(borders[0]), float(borders[-1] - borders[0])))
                yield float(borders[-1]), sorted_events(parts, camera.width)


def list_events(log_intensity: torch.Tensor, times_us: np.ndarray, array: PixelArray) -> list[TimedEvents]:
    """Events of the pixels between successive renderings, one piece per step.

    Args:
        log_intensity: `(M + 1, H, W)` float32.
        times_us: `(M + 1,)` microseconds.
        array: pixels, advanced in place.
    """
    parts = []
    for change, start, stop in zip(log_intensity[1:] - log_intensity[:-1], times_us[:-1], times_us[1:]):
        crossings = array.step(change, float(stop - start))
        parts.append(expand(crossings, float(start), float(stop - start)))
    return parts


def sorted_events(parts: list[TimedEvents], width: int) -> Events:
    """Join pieces into one list with whole microseconds, sorted by time."""
    t_us, pixel, sign = (torch.cat([getattr(part, name).cpu() for part in parts]).numpy()
                         for name in ("t_us", "pixel", "sign"))
    stamps = np.floor(t_us).astype(np.int64)
    order = np.argsort(stamps, kind="stable")
    pixel = pixel[order]
    return Events((pixel % width).astype(np.uint16), (pixel // width).astype(np.uint16), stamps[order],
                  (sign[order] > 0).astype(np.uint8))
