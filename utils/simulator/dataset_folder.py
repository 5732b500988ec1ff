"""Write a simulated recording as a folder of the `generic` dataset, completely or not at all.

| file | content |
|---|---|
| `events.h5` | events in the DSEC layout, microseconds from 0 |
| `calib.yaml` | camera of the raw pixels |
| `groundtruth.txt` | TUM text: seconds, camera to world, quaternion scalar last; metres |
| `images_timestamps_us.txt` | one stamp per line, of `images/` and `depth/` |
| `images/%06d.png` | 8-bit intensity frames (optional) |
| `depth/%06d.npy` | `(H, W)` float32 z-depth in metres, 0 where nothing is hit (optional) |
| `scene.json` | settings, camera, plane equations in the world frame, counts |
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml

from devo.errors import InputError, OutputError
from utils.atomic import atomic_folder
from utils.events.writers import EventH5Writer
from utils.simulator.scenes import UNBOUNDED
from utils.simulator.sequence import SequenceSettings, SimulatedSequence
from utils.trajectory_io import Trajectory, write_tum

GROUND_TRUTH_HZ = 500
SCENE_FILE = "scene.json"
FORMAT_VERSION = 1


@dataclasses.dataclass(frozen=True)
class RecordingSummary:
    """What was written: folder, number of events, seconds, path length in metres, mean image motion in px/s."""

    folder: Path
    events: int
    seconds: float
    path_length_m: float
    mean_flow_px_s: float
    frames: int

    @property
    def events_per_s(self) -> float:
        """Mean event rate."""
        return self.events / self.seconds


@dataclasses.dataclass(frozen=True)
class FolderOptions:
    """Which products: image stamps per second, intensity frames, depth maps, replacing an older simulation."""

    fps: float = 30.0
    frames: bool = False
    depth: bool = True
    overwrite: bool = False
    progress: bool = False

    def __post_init__(self) -> None:
        if not 0.1 <= self.fps <= 1000:
            raise InputError(f"{self.fps:g} images per second requested, expected 0.1 to 1000")


def write_recording(out: str | os.PathLike[str], settings: SequenceSettings, options: FolderOptions | None = None,
                    device: torch.device | str = "cpu") -> RecordingSummary:
    """Simulate a recording and write it as a dataset folder.

    Args:
        out: folder to create.
        settings: what to record.
        options: which products.
        device: where to render.

    Raises:
        InputError: the folder exists and may not be replaced, or the settings are unusable.
        OutputError: the folder cannot be written.
    """
    options = options or FolderOptions()
    target = Path(out)
    _check_target(target, options.overwrite)
    sequence = SimulatedSequence(settings, device)
    with atomic_folder(target) as folder:
        count = _write_events(folder / "events.h5", sequence, options.progress)
        stamps = image_stamps(sequence.duration_us, options.fps)
        _write_images(folder, sequence, stamps, options)
        trajectory = ground_truth(sequence, stamps)
        write_tum(folder / "groundtruth.txt", trajectory, comments=["simulated; unit of length: metre"])
        (folder / "calib.yaml").write_text(yaml.safe_dump(sequence.camera.as_dict(), sort_keys=False), "utf-8")
        np.savetxt(folder / "images_timestamps_us.txt", stamps, fmt="%d")
        summary = RecordingSummary(target, count, settings.seconds, trajectory.path_length(),
                                   sequence.path.mean_flow_px_s(), len(stamps))
        text = json.dumps(describe(sequence, options, summary), indent=1) + "\n"
        (folder / SCENE_FILE).write_text(text, "utf-8")
    return summary


def image_stamps(duration_us: int, fps: float) -> np.ndarray:
    """Image stamps `(N,)` int64 microseconds from 0 to at most the end."""
    count = int(np.floor(duration_us * fps * 1e-6)) + 1
    return np.round(np.arange(count) * 1e6 / fps).astype(np.int64).clip(max=duration_us)


def ground_truth(sequence: SimulatedSequence, stamps: np.ndarray) -> Trajectory:
    """Poses at a fixed high rate and at all image stamps."""
    regular = np.arange(0, sequence.duration_us + 1, round(1e6 / GROUND_TRUTH_HZ))
    t_us = np.unique(np.concatenate([regular, stamps, [sequence.duration_us]]))
    return Trajectory(t_us, sequence.path.poses(t_us).numpy())


def describe(sequence: SimulatedSequence, options: FolderOptions, summary: RecordingSummary) -> dict[str, Any]:
    """Everything that defines the recording, with its plane pieces in the world frame, as JSON-ready values."""
    planes = sequence.world.planes
    pieces = []
    for index, name in enumerate(sequence.world.names):
        normal, origin = planes.normal[0, index].double(), planes.origin[0, index].double()
        half = [None if value >= UNBOUNDED else value for value in planes.half_extent[0, index].tolist()]
        pieces.append({"name": name, "normal": normal.tolist(), "offset": -float(normal @ origin),
                       "origin": origin.tolist(), "axis_u": planes.axis_u[0, index].tolist(),
                       "axis_v": planes.axis_v[0, index].tolist(), "half_extent": half})
    return {
        "format": FORMAT_VERSION,
        "about": "simulated event camera; world frame: x right, y down, z forward, metres; plane pieces: "
                 "normal . x + offset = 0, |axis . (x - origin)| <= half_extent (null: endless)",
        "settings": dataclasses.asdict(sequence.settings),
        "pixels": dataclasses.asdict(sequence.settings.pixels),
        "camera": sequence.camera.as_dict(),
        "fps": options.fps,
        "planes": pieces,
        "events": summary.events,
        "events_per_s": summary.events_per_s,
        "path_length_m": summary.path_length_m,
        "mean_image_motion_px_s": summary.mean_flow_px_s,
    }


def _write_events(path: Path, sequence: SimulatedSequence, progress: bool) -> int:
    from tqdm import tqdm

    size = (sequence.camera.width, sequence.camera.height)
    count = 0
    bar = tqdm(total=sequence.settings.seconds, unit="s", disable=not progress, desc="simulating",
               bar_format="{desc}: {n:.2f}/{total:.2f} s |{bar}| {elapsed}<{remaining} {postfix}")
    with bar, EventH5Writer(path, sensor_size=size) as writer:
        for complete_us, events in sequence.events():
            writer.write(events)
            count += len(events)
            bar.update(complete_us * 1e-6 - bar.n)
            bar.set_postfix_str(f"{count / 1e6:.2f} M events")
    return count


def _write_images(folder: Path, sequence: SimulatedSequence, stamps: np.ndarray, options: FolderOptions) -> None:
    if options.frames:
        (folder / "images").mkdir()
    if options.depth:
        (folder / "depth").mkdir()
    exposure = 0.0
    for number, stamp in enumerate(stamps):
        if options.frames:
            log_intensity = sequence.log_intensity(stamp[None])[0]
            exposure = exposure or 0.9 / float(torch.quantile(log_intensity[::2, ::2], 0.98).exp())
            image = (log_intensity.exp() * exposure).clamp(0, 1).pow(1 / 2.2) * 255.0
            name = folder / "images" / f"{number:06d}.png"
            if not cv2.imwrite(str(name), image.round().byte().cpu().numpy()):
                raise OutputError(f"cannot write {name}; check the free disk space")
        if options.depth:
            np.save(folder / "depth" / f"{number:06d}.npy", sequence.depth(stamp[None])[0].cpu().numpy())


def _check_target(target: Path, overwrite: bool) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError(f"{target} is a file, expected a folder name that is free; choose another --out")
    if not any(target.iterdir()):
        return
    if not overwrite:
        raise InputError(f"{target} exists already; choose another --out or replace it with --overwrite")
    if not (target / SCENE_FILE).is_file():
        raise InputError(f"{target} holds something else than a simulated recording (no {SCENE_FILE}), so it is not "
                         "overwritten; choose another --out")
