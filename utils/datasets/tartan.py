"""TartanAir with simulated events: one voxel grid per file and frame, made when the events were simulated."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from devo.data_readers.tartan import DEPTH_SCALE, INTRINSICS, camera_poses
from devo.errors import InputError
from utils.datasets.files import natural_order
from utils.datasets.folders import read_voxel
from utils.datasets.options import SequenceOptions
from utils.datasets.prepared import refuse_options, refuse_own_camera
from utils.datasets.registry import register
from utils.datasets.sequence import Frame, GroundTruth, ImageFiles, Recording

_EVENTS, _IMAGES, _POSES = "evs_left", "image_left", "pose_left.txt"


@register("tartan", "TartanAir with simulated events: ready-made voxel grids 640x480")
class TartanRecording(Recording):
    """A folder of voxel grids `h5/%010d.h5`; the number in the name is the frame, which serves as its stamp.

    Args:
        path: `<root>/<env>/<level>/evs_left/<env>/<env>/<level>/<P>`, or the folder `h5` in it.
        options: `start_us` and `stop_us` count frames.

    Raises:
        InputError: no voxel grids, or options that make no sense for them.
    """

    def __init__(self, path: Path, options: SequenceOptions) -> None:
        refuse_own_camera(options, "tartan")
        refuse_options(options, "tartan", "side", "window_ms", "window_events", "window_dt_ms", "on_unsorted",
                       because="its voxel grids of the left camera are ready-made")
        folder = path if path.name == "h5" else path / "h5"
        self._numbers = sorted((int(file.stem), file) for file in folder.glob("*.h5") if file.stem.isdecimal())
        if not self._numbers:
            raise InputError(f"{path}: no voxel grids h5/<frame number>.h5; pass a folder "
                             f"<root>/<env>/<level>/{_EVENTS}/<env>/<env>/<level>/<P> of simulated TartanAir events")
        lower = -np.inf if options.start_us is None else options.start_us
        upper = np.inf if options.stop_us is None else options.stop_us
        self._used = [(number, file) for number, file in self._numbers if lower <= number < upper][::options.stride]
        self.expected_length = len(self._used)
        _, height, width = read_voxel(self._numbers[0][1]).shape
        beside = _counterpart(folder.parent.absolute())
        poses = beside / _POSES if beside is not None else None
        super().__init__(
            "/".join(folder.parent.absolute().parts[-4:]), path, options, size=(width, height), intrinsics=INTRINSICS,
            images=_images(beside), files={"voxel grids": folder, **({"ground truth": poses} if poses else {})},
            read_ground_truth=(lambda: _read_poses(poses)) if poses is not None and poses.is_file() else None)

    def voxels(self) -> Iterator[Frame]:
        """Yield `(voxel grid (5,H,W) float32, intrinsics (4,) float64, frame number)` per file.

        Raises:
            InputError: a file is damaged or of another size, or no frame was chosen.
        """
        if not self._used:
            raise InputError(f"{self.path}: no frame inside start_us and stop_us, which count frames here; there are "
                             f"{self._numbers[0][0]} to {self._numbers[-1][0]}")
        for number, file in self._used:
            voxel = read_voxel(file)
            if voxel.shape[1:] != (self.height, self.width):
                raise InputError(f"{file}: voxel grid of {voxel.shape[2]}x{voxel.shape[1]} pixels, expected "
                                 f"{self.width}x{self.height} as in the first file")
            yield voxel, torch.from_numpy(self.intrinsics.copy()), float(number)

    def describe(self) -> dict[str, Any]:
        """Return what is read and how as plain values."""
        return {**super().describe(), "events_are_rectified": False,
                "windows": {"rule": "ready-made voxel grids, stamps are frame numbers", "every": self.options.stride,
                            "start_us": self.options.start_us, "stop_us": self.options.stop_us,
                            "expected": self.expected_length}}


def _counterpart(events: Path) -> Path | None:
    """Return the folder of the images and poses that belongs to one of events, if there is one."""
    parts = list(events.parts)
    if _EVENTS not in parts:
        return None
    at = len(parts) - 1 - parts[::-1].index(_EVENTS)
    beside = Path(*parts[:at], _IMAGES, *parts[at + 1:])
    return beside if beside.is_dir() else None


def _images(folder: Path | None) -> ImageFiles | str:
    if folder is None or not (folder / "imgs").is_dir():
        return f"there is no folder {_IMAGES}/.../imgs beside {_EVENTS}"
    paths = natural_order(folder / "imgs")
    return ImageFiles(paths, np.arange(len(paths), dtype=np.float64), np.array(INTRINSICS))


def _read_poses(path: Path) -> GroundTruth:
    """Return frame numbers (N,) and camera-to-world poses (N, 7) in metres and OpenCV axes."""
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path} ({error}), expected rows `tx ty tz qx qy qz qw`") from error
    poses = camera_poses(rows).astype(np.float64)
    poses[:, :3] *= DEPTH_SCALE
    return np.arange(len(poses)), poses
