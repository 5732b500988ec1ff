"""What all data sets share: from event files, stamps and maps to the stream of voxel grids the odometry eats."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from devo.errors import InputError
from utils.calibration import Calibration
from utils.datasets.options import SequenceOptions
from utils.events.reader import EventReader
from utils.events.slicing import EventWindow, WindowRule
from utils.undistort import undistort_image
from utils.voxel_grid import VoxelRectifier, remove_hot_pixels, resize_voxel, scale_intrinsics, to_voxel_grid

Frame = tuple[torch.Tensor, torch.Tensor, float]
GroundTruth = tuple[npt.NDArray[Any], npt.NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """Image files with their stamps.

    Attributes:
        paths: (N,) files.
        stamps_us: (N,) microseconds on the clock of the events.
        intrinsics: (4,) `fx fy cx cy` of the images as they are yielded.
        distorted: the camera, if the files still have to be undistorted to `intrinsics`.
    """

    paths: list[Path]
    stamps_us: npt.NDArray[np.float64]
    intrinsics: npt.NDArray[np.float64]
    distorted: Calibration | None = None

    def __post_init__(self) -> None:
        if len(self.paths) != len(self.stamps_us):
            raise InputError(f"{len(self.paths)} images but {len(self.stamps_us)} image stamps"
                             + (f" (first image {self.paths[0]})" if self.paths else "")
                             + "; each image needs its stamp")


class Recording(abc.ABC):
    """One recording as streams of voxel grids or images, whatever it is stored as.

    Args:
        name: what to call the recording.
        path: its folder or file.
        options: how it is read.
        size: (width, height) of the sensor in pixels.
        intrinsics: (4,) `fx fy cx cy` of the undistorted camera in pixels of the sensor.
        images: image files, or one line that says why there are none.
        voxel_size: (width, height) of the voxel grids, None for the size of the sensor; intrinsics are scaled along.
        read_ground_truth: returns stamps (N,) in microseconds and camera-to-world poses (N, 7); None without any.
        poses_of: whose poses the ground truth is, None for the event camera's.
        files: files in use by role, for reports.

    Attributes:
        height, width: of voxel grids in pixels.
        sensor_size: (width, height) of the sensor in pixels.
        intrinsics: (4,) float64 `fx fy cx cy` of the voxel grids in pixels.
        images: image files, None where there are none.
        expected_length: how many voxel grids there are at most, for a progress bar; None if unknown.
        rectify_map: (H, W, 2) forward map of the events, None where they need no rectification.
    """

    expected_length: int | None = None
    rectify_map: npt.NDArray[np.float32] | None = None

    def __init__(self, name: str, path: Path, options: SequenceOptions, *, size: tuple[int, int],
                 intrinsics: npt.ArrayLike, images: ImageFiles | str | None = None,
                 read_ground_truth: Callable[[], GroundTruth] | None = None, poses_of: str | None = None,
                 files: dict[str, Path] | None = None, voxel_size: tuple[int, int] | None = None) -> None:
        self.name = name
        self.path = path
        self.options = options
        self.sensor_size = size
        self.width, self.height = voxel_size or size
        self.intrinsics = scale_intrinsics(intrinsics, size, (self.width, self.height))
        self.images = images if isinstance(images, ImageFiles) else None
        self._no_images = images if isinstance(images, str) else "the recording has no images"
        self._read_ground_truth = read_ground_truth
        self.poses_of = poses_of
        self._files = files or {}

    @abc.abstractmethod
    def voxels(self) -> Iterator[Frame]:
        """Yield `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)`.

        Raises:
            InputError: a file turns out to be damaged, or there is nothing to yield.
        """

    def voxel_tasks(self) -> Iterator[Callable[[], Frame]]:
        """Yield the frames of `voxels` as calls that make them, which may run in other threads and in any order."""
        for frame in self.voxels():
            yield functools.partial(_as_it_is, frame)

    def open_events(self) -> EventReader:
        """Open the raw events on the clock of the recording; close the reader after use.

        Raises:
            InputError: the recording holds no events, only what was made of them.
        """
        raise InputError(f"{self.path}: the recording holds ready-made voxel grids and no events")

    def frames(self) -> Iterator[Frame]:
        """Yield `(image (3,H,W) uint8 BGR, intrinsics (4,) float64, t_us)` per image, undistorted.

        Raises:
            InputError: the recording has no images, or one cannot be read.
        """
        if self.images is None:
            raise InputError(f"{self.path}: {self._no_images}")
        images = self.images
        lower = -np.inf if self.options.start_us is None else self.options.start_us
        upper = np.inf if self.options.stop_us is None else self.options.stop_us
        wanted = np.flatnonzero((images.stamps_us >= lower) & (images.stamps_us < upper))[::self.options.stride]
        for index in wanted:
            image = read_image(images.paths[index])
            if images.distorted is not None:
                image = undistort_image(image, images.distorted, images.intrinsics)
            tensor = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
            yield tensor, torch.from_numpy(images.intrinsics.copy()), float(images.stamps_us[index])

    def ground_truth(self) -> GroundTruth | None:
        """Return stamps (N,) in microseconds and camera-to-world poses (N, 7), None where there are none.

        Raises:
            InputError: the file of poses is damaged.
        """
        return None if self._read_ground_truth is None else self._read_ground_truth()

    def describe(self) -> dict[str, Any]:
        """Return what is read and how as plain values."""
        return {
            "name": self.name,
            "path": str(self.path),
            "files": {role: str(path) for role, path in self._files.items()},
            "sensor_size": list(self.sensor_size),
            "voxel_size": [self.width, self.height],
            "intrinsics_fx_fy_cx_cy": [float(value) for value in self.intrinsics],
            "images": None if self.images is None else len(self.images.paths),
        }


class Sequence(Recording):
    """A recording of events, cut into windows; a data set gives it its parts and little else.

    Args:
        name, path, options, size, intrinsics: see `Recording`.
        open_reader: opens the events; called anew for each pass.
        windows: the rule that cuts events into windows.
        rectify_map: (H, W, 2) forward map of `utils.undistort`, None for events that need no rectification.
        hot_pixel_stds: threshold of `remove_hot_pixels`, None for no filter.
        images, read_ground_truth, poses_of, files, voxel_size: see `Recording`.

    Attributes:
        expected_length: how many windows there are for a progress bar (empty ones included), None if unknown.
    """

    def __init__(self, name: str, path: Path, options: SequenceOptions, *, size: tuple[int, int],
                 intrinsics: npt.ArrayLike, open_reader: Callable[[], EventReader], windows: WindowRule,
                 rectify_map: npt.NDArray[np.float32] | None = None, hot_pixel_stds: float | None = None,
                 images: ImageFiles | str | None = None, read_ground_truth: Callable[[], GroundTruth] | None = None,
                 poses_of: str | None = None, files: dict[str, Path] | None = None,
                 voxel_size: tuple[int, int] | None = None) -> None:
        super().__init__(name, path, options, size=size, intrinsics=intrinsics, images=images,
                         read_ground_truth=read_ground_truth, poses_of=poses_of, files=files,
                         voxel_size=voxel_size)
        self._open_reader = open_reader
        self.windows = windows
        self.rectify_map = rectify_map
        self._rectifier: VoxelRectifier | None = None
        self._hot_pixel_stds = hot_pixel_stds
        self._counts: dict[str, int] | None = None
        with open_reader() as reader:
            self.expected_length = windows.count(reader, options.start_us, options.stop_us, options.stride)

    def open_events(self) -> EventReader:
        """Open the raw events on the clock of the recording; close the reader after use."""
        return self._open_reader()

    def frame_stamp_us(self, index: int, window: EventWindow) -> float:
        """Return the stamp of the frame made from window `index`; data sets with another convention override it."""
        return float(window.middle_us)

    def voxels(self) -> Iterator[Frame]:
        """Yield `(voxel grid (5,H,W) float32, intrinsics (4,) float64, t_us)` per window that holds events.

        Windows without events are skipped and counted, see `describe`.

        Raises:
            InputError: the event file turns out to be damaged, or no window holds an event.
        """
        for task in self.voxel_tasks():
            yield task()

    def voxel_tasks(self) -> Iterator[Callable[[], Frame]]:
        """Yield the frames of `voxels` as calls: reading happens here, voxelisation in the calls."""
        counts = {"windows": 0, "empty_windows": 0, "events": 0}
        self._counts = counts
        options = self.options
        with self._open_reader() as reader:
            for window in self.windows.over(reader, options.start_us, options.stop_us, options.stride):
                index = counts["windows"]
                counts["windows"] += 1
                counts["events"] += len(window.events)
                if not len(window.events):
                    counts["empty_windows"] += 1
                    continue
                stamp_us = self.frame_stamp_us(index, window)
                yield functools.partial(self._frame, window, stamp_us)
            if counts["windows"] == counts["empty_windows"]:
                first, last = reader.time_range_us()
                raise InputError(f"{self.path}: none of the {counts['windows']} windows holds events, which span "
                                 f"{first} us to {last} us; check start_us, stop_us and the window length")

    def describe(self) -> dict[str, Any]:
        """Return what is read and how as plain values; counts are those of the latest pass over `voxels`."""
        return {
            **super().describe(),
            "events_are_rectified": self.rectify_map is not None,
            "windows": {**self.windows.describe(), "every": self.options.stride, "start_us": self.options.start_us,
                        "stop_us": self.options.stop_us, "expected": self.expected_length},
            "counts": None if self._counts is None else dict(self._counts),
        }

    def _frame(self, window: EventWindow, stamp_us: float) -> Frame:
        return self._voxel(window), torch.from_numpy(self.intrinsics.copy()), stamp_us

    def _voxel(self, window: EventWindow) -> torch.Tensor:
        events = window.events
        if self.rectify_map is None:
            width, height = self.sensor_size
            voxel = to_voxel_grid(events.x, events.y, events.t_us, events.p, height, width)
        else:
            if self._rectifier is None:
                self._rectifier = VoxelRectifier(self.rectify_map)
            voxel = self._rectifier(events)
        voxel = resize_voxel(voxel, self.height, self.width)
        return voxel if self._hot_pixel_stds is None else remove_hot_pixels(voxel, self._hot_pixel_stds)


def _as_it_is(frame: Frame) -> Frame:
    return frame


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """Read an image file as (H, W, 3) uint8 BGR.

    Raises:
        InputError: the file is missing or damaged.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"cannot read image {path}: the file is missing or damaged")
    return image  # type: ignore[return-value]
