"""What the validation takes from a recording: events, true poses, true depth, and a picture of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from evals.validation.settings import ValidationSettings
from utils.datasets.files import read_image_list
from utils.datasets.recognise import GENERIC, preprocessing_command
from utils.datasets.registry import open_sequence
from utils.datasets.sequence import Sequence, read_image
from utils.emvs.geometry import FloatArray
from utils.emvs.mapper import EventCamera
from utils.emvs.views import PoseTrack
from utils.events.reader import MemoryEventReader
from utils.events.types import Events
from utils.trajectory_io import Trajectory, read_tum
from utils.undistort import undistort_image

_READ_EVENTS = 1 << 19
_PICTURE_EVENTS_PER_PIXEL = 0.6  # about as many as draw every edge once


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera saw at some time, to draw points on.

    Attributes:
        kind: `intensity frame` or `accumulated events`.
        image: `(H, W)` or `(H, W, 3)` uint8 (BGR).
        t_us: its time.
        intrinsics: `fx fy cx cy` of the image in pixels.
        event_T_image: `(4, 4)` pose of this camera in the event camera, metres; identity for one and the same.
        edges: `(H, W)` bool edge pixels.
    """

    kind: str
    image: npt.NDArray[np.uint8]
    t_us: float
    intrinsics: FloatArray
    event_T_image: FloatArray
    edges: npt.NDArray[np.bool_]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """True z-depths at some times, `(H, W)` float metres per file.

    Attributes:
        paths: `.npy` files.
        t_us: `(N,)` their stamps.
        intrinsics: `fx fy cx cy` of the depth camera, which is the event camera.
    """

    paths: list[Path]
    t_us: FloatArray
    intrinsics: FloatArray

    def nearest(self, t_us: float) -> int:
        """Number of the depth map nearest in time."""
        return int(np.abs(self.t_us - t_us).argmin())

    def load(self, number: int) -> npt.NDArray[np.floating]:
        """The depth map.

        Raises:
            InputError: the file is damaged or no image.
        """
        try:
            depth = np.load(self.paths[number], allow_pickle=False)
        except (OSError, ValueError) as error:
            raise InputError(f"{self.paths[number]}: cannot be read as a depth map ({error})") from error
        if depth.ndim != 2 or depth.dtype.kind != "f":
            raise InputError(f"{self.paths[number]}: found {depth.dtype} {depth.shape}, expected float depths (H, W)")
        return np.asarray(depth)


@dataclass(frozen=True, eq=False)
class Source:
    """One recording with ground truth.

    Attributes:
        sequence: the recording.
        truth: camera to world, metres.
        camera: where the pixels of the event camera look.
        depth: true depth maps, None where there are none.
        notes: what could not be used, one sentence each.
    """

    sequence: Sequence
    truth: Trajectory
    camera: EventCamera
    depth: DepthMaps | None
    notes: tuple[str, ...] = ()

    def thinned_events(self, start_us: float, stop_us: float, most: int) -> tuple[MemoryEventReader, int]:
        """Every n-th event of a span, so that about `most` remain; the reader and n."""
        with self.sequence.open_events() as reader:
            first, last = reader.time_range_us()
            share = (min(stop_us, last) - max(start_us, first)) / max(last - first, 1)
            stride = max(1, -(-int(len(reader) * share) // most))
            parts, skip = [], 0
            for events in reader.chunks(_READ_EVENTS, start_us=start_us, stop_us=stop_us):
                kept = events[skip::stride]
                skip = (skip - len(events)) % stride
                parts.append(Events(kept.x.copy(), kept.y.copy(), kept.t_us.copy(), kept.p.copy()))
        return MemoryEventReader(Events.concatenate(parts), reader.path, self.camera.size), stride

    def picture(self, t_us: float) -> Picture:
        """The intensity frame nearest to a time, or the events around it where there are no frames."""
        if self.sequence.images is None:
            return self._event_picture(t_us)
        from evals.image_metrics import canny_edges

        images = self.sequence.images
        number = int(np.abs(images.stamps_us - t_us).argmin())
        image = read_image(images.paths[number])
        if images.distorted is not None:
            image = undistort_image(image, images.distorted, images.intrinsics)
        return Picture("intensity frame", image, float(images.stamps_us[number]),
                       np.asarray(images.intrinsics, np.float64), self._event_T_image(t_us), canny_edges(image))

    def _event_picture(self, t_us: float) -> Picture:
        width, height = self.camera.size
        wanted = int(_PICTURE_EVENTS_PER_PIXEL * width * height)
        with self.sequence.open_events() as reader:
            first, last = reader.time_range_us()
            half_us = max(1.0, 0.5 * wanted * (last - first) / max(len(reader), 1))
            events = reader.read(max(t_us - half_us, first), min(t_us + half_us, last + 1))
        position = np.rint(self.camera.rectify_map[events.y, events.x]).astype(np.int64)
        inside = ((position >= 0) & (position < [width, height])).all(axis=1)
        cells = position[inside] @ [1, width]
        count = np.bincount(cells, minlength=width * height).reshape(height, width)
        limit = max(3.0, float(np.percentile(count[count > 0], 95)) if count.any() else 1.0)
        image = (255 - 200 * np.clip(count / limit, 0, 1)).astype(np.uint8)
        return Picture("accumulated events", image, t_us, self.camera.intrinsics, np.eye(4), count >= 2)

    def _event_T_image(self, t_us: float) -> FloatArray:  # noqa: N802 - frames as in all names of poses
        """Pose of a separate frame camera, from the pose files of both that the preprocessing of VECtor writes."""
        poses = self.sequence.path / f"poses_gray_{self.sequence.options.side}.txt"
        if not poses.is_file():
            return np.eye(4)
        gray, event = PoseTrack(read_tum(poses, time_unit="us")), PoseTrack(self.truth)
        # at a stamp of both files: between two of them each camera is taken to move straight, so the rig would bend
        stamp_us = self.truth.t_us[np.abs(self.truth.t_us - t_us).argmin()]
        return np.linalg.inv(event(stamp_us)[0]) @ gray(stamp_us)[0]


def open_source(settings: ValidationSettings) -> Source:
    """Open the recording of a validation.

    Raises:
        InputError: it cannot be read, or has no ground truth of its event camera or fewer than two poses.
    """
    settings = settings.resolved()  # the errors depend on the data set
    sequence = open_sequence(settings.dataset, settings.sequence, settings.sequence_options())
    if not isinstance(sequence, Sequence):
        raise InputError(f"{settings.sequence}: the recording holds ready-made voxel grids, but EMVS needs its events")
    truth = _true_poses(settings, sequence)
    width, height = sequence.sensor_size
    positions = sequence.rectify_map
    notes: list[str] = []
    if positions is None:
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        positions = np.stack([x, y], axis=-1)
        depth = _find_depth(settings.sequence, sequence.intrinsics)
    else:
        depth = None
        if (settings.sequence / "depth").is_dir():
            notes.append("The depth maps show the distorted camera and are not used.")
    return Source(sequence, truth, EventCamera(positions, sequence.intrinsics), depth, tuple(notes))


def _true_poses(settings: ValidationSettings, sequence: Sequence) -> Trajectory:
    """Ground truth of the event camera.

    Raises:
        InputError: there is none, or it is that of another body.
    """
    folder, dataset = settings.sequence, settings.dataset
    if sequence.poses_of is not None:
        raise InputError(f"{folder}: the ground truth of {dataset} is that of the {sequence.poses_of}, but maps made "
                         f"with true poses need those of the {settings.side} event camera; convert them and read the "
                         f"events as a recording of your own (--dataset {GENERIC}, groundtruth.txt)")
    found = sequence.ground_truth()
    if found is None:
        way = ("groundtruth.txt (TUM text, camera to world, metres)" if dataset == GENERIC else
               f"the poses that come with {dataset}: put their file beside the events and run "
               f"`{preprocessing_command(dataset, folder, settings.side)}`")
        raise InputError(f"{folder}: no ground truth; the validation compares maps made with true poses, so it needs "
                         f"{way}")
    truth = Trajectory(*found)
    if len(truth) < 2:
        raise InputError(f"{folder}: the ground truth has {len(truth)} pose(s), expected at least 2")
    return truth


def _find_depth(folder: Path, intrinsics: FloatArray) -> DepthMaps | None:
    """Depth maps as the simulator writes them: `depth/%06d.npy` at the stamps of `images_timestamps_us.txt`."""
    stamps = folder / "images_timestamps_us.txt"
    paths = sorted((folder / "depth").glob("*.npy"))
    if not paths or not stamps.is_file():
        return None
    t_us = read_image_list(stamps, "us").stamps_us
    if len(t_us) != len(paths):
        raise InputError(f"{folder}: {len(paths)} depth maps but {len(t_us)} stamps in {stamps.name}; each needs one")
    return DepthMaps(paths, t_us, intrinsics)
