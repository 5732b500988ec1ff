"""From a finished export or a folder of frames to a COLMAP model: the work behind `scripts/export_colmap.py`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devo.errors import InputError, TrackingError
from utils.clouds.cloud import PointCloud
from utils.clouds.io import read_cloud
from utils.colmap.files import write_model
from utils.colmap.model import ColmapModel, TrackRules, build_model
from utils.colmap.observations import Observations, observations_of, read_observations
from utils.finished_run import FinishedRun, read_camera_path

_CLOUDS = (".npz", ".ply", ".pcd")  # those that keep host frame and pixel
Camera = tuple[npt.NDArray[np.float64], tuple[int, int]]


@dataclass(frozen=True)
class FolderInput:
    """A folder of ready-made frames, as `--input` names it.

    Attributes:
        folder: images (`rgb`) or voxel grids in `.h5` files (`evs`).
        mode: `rgb` or `evs`.
        intrinsics: `fx fy cx cy` of the files in pixels.
        size: (width, height) of the files in pixels.
        timestamps: file with one stamp per frame in microseconds, None numbers the frames.
        stride, scale: use every n-th frame, resized by this factor.
        config, weights, device, seed: of the odometry, as for `export_pointcloud.py`.
    """

    folder: Path
    mode: str
    intrinsics: tuple[float, ...]
    size: tuple[int, int]
    timestamps: Path | None = None
    stride: int = 1
    scale: float = 1.0
    config: str | None = None
    weights: str | None = None
    device: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 8:
            raise InputError(f"--scale is {self.scale:g}, expected a positive factor up to 8")
        if len(self.intrinsics) != 4 or min(self.size) < 1:
            raise InputError(f"a camera needs fx fy cx cy and a size, found {self.intrinsics} and {self.size}")


def model_of_run(path: str, rules: TrackRules) -> ColmapModel:
    """The model of a finished export.

    With `<base>_observations.npz` (export with `--save_observations`) tracks hold all measurements; without it each
    point is seen in its host frame only, so `rules.min_length` must be 1.

    Raises:
        InputError: files are missing or do not fit together.
    """
    run = FinishedRun.of(path)
    camera, poses_file = run.camera(), run.poses_file()
    if poses_file is None or camera is None:
        raise InputError(f"{run.base}: no finished export there; expected {run.base.name}_meta.json and "
                         f"{run.base.name}_poses.npy of scripts/export_pointcloud.py")
    cloud = _raw_cloud(run)
    poses = read_camera_path(poses_file)
    observations = _observations(run, cloud, rules)
    return build_model(cloud, observations, poses, frame_names(len(poses)), *camera, rules)


def model_of_folder(source: FolderInput, rules: TrackRules) -> ColmapModel:
    """Run the odometry over a folder of frames and make its model.

    Raises:
        InputError: unusable frames or arguments.
        TrackingError: the run was not initialised or got lost.
    """
    from devo.checkpoint import load_network
    from devo.config import Config
    from devo.device import resolve_device
    from utils.eval_utils import track
    from utils.export_products import observables_to_cloud
    from utils.export_run import find_config, find_weights

    weights, device = find_weights(source.weights), resolve_device(source.device)
    cfg = Config().merge_from_file(find_config(source.config, "generic", weights))
    events = source.mode == "evs"
    selector = "random" if not events and cfg.PATCH_SELECTOR == "scorer" else cfg.PATCH_SELECTOR
    network = load_network(weights, patch_selector=selector, device=device)
    frames = _Frames(source)
    found: list[Observations] = []
    result = track(frames, cfg, network, events=events, scale=source.scale, seed=source.seed, colors=True,
                   device=device, progress=True, on_end=lambda tracker: found.append(observations_of(tracker)))
    if not result.ok or result.observables is None:
        raise TrackingError(f"{source.folder}: {result.message}; no model was written")
    names = [frames.names[stamp] for stamp in result.tstamps.tolist()]
    return build_model(observables_to_cloud(result.observables), found[0], result.poses, names, *frames.camera(), rules)


class _Frames:
    """The frames of a folder; remembers the name of the file and the camera of what was yielded."""

    def __init__(self, source: FolderInput) -> None:
        self.source = source
        self.names: dict[float, str] = {}
        self._camera: Camera | None = None

    def __iter__(self) -> Iterator[Any]:
        for number, (tensor, intrinsics, t_us) in enumerate(self._stream()):
            if self._camera is None:
                self._camera = np.asarray(intrinsics, dtype=np.float64), (tensor.shape[2], tensor.shape[1])
                expected = tuple(int(side * self.source.scale) for side in self.source.size)
                if self._camera[1] != expected:
                    raise InputError(f"{self.source.folder}: frames are {tensor.shape[2]}x{tensor.shape[1]} px, "
                                     f"expected {expected[0]}x{expected[1]} from --width, --height and --scale")
            self.names[float(t_us)] = self._name(number)
            yield tensor, intrinsics, t_us

    def camera(self) -> Camera:
        """Intrinsics and size of the frames that were yielded."""
        if self._camera is None:
            raise InputError(f"{self.source.folder}: no frame was read")
        return self._camera

    def _stream(self) -> Iterable[Any]:
        from utils.datasets.folders import video_iterator, voxel_iterator

        source = self.source
        if source.mode == "evs":
            return voxel_iterator(source.folder, source.timestamps, intrinsics=source.intrinsics, stride=source.stride,
                                  scale=source.scale)
        suffixes = {path.suffix for path in self._images()}
        if len(suffixes) != 1:
            raise InputError(f"{source.folder}: expected images with one ending, found {sorted(suffixes) or 'none'}")
        return video_iterator(source.folder, source.timestamps, suffixes.pop(), source.intrinsics, source.stride,
                              source.scale)

    def _images(self) -> list[Path]:
        from utils.datasets.files import natural_order

        return natural_order(self.source.folder)

    def _name(self, number: int) -> str:
        if self.source.mode == "evs":
            return frame_names(number + 1)[number]
        return self._images()[number * self.source.stride].name


def frame_names(count: int) -> list[str]:
    """Names of images that have none: `frame_000000.png`, ..., by the row of the poses."""
    return [f"frame_{number:06d}.png" for number in range(count)]


def write_and_describe(folder: str, model: ColmapModel, kind: str) -> str:
    """Write a model; returns one line about it."""
    write_model(folder, model, kind)
    lengths = model.track_lengths()
    return (f"{folder}: {len(model.names)} images, {len(model.points)} points, {len(model.point)} observations "
            f"(mean track {lengths.mean():.1f}, mean reprojection error {model.errors.mean():.2f} px), {kind}")


def _raw_cloud(run: FinishedRun) -> PointCloud:
    for suffix in _CLOUDS:
        if run.file(suffix).is_file():
            cloud = read_cloud(run.file(suffix))
            if {"host_frame", "pixel_x", "pixel_y"} <= set(cloud.scalars):
                return cloud
    raise InputError(f"{run.base}: no raw cloud with host frames and pixels ({', '.join(_CLOUDS)}); export it again")


def _observations(run: FinishedRun, cloud: PointCloud, rules: TrackRules) -> Observations:
    path = run.file("_observations.npz")
    if path.is_file():
        return read_observations(path)
    if rules.min_length > 1:
        raise InputError(f"{path.name} is missing, so points are known in their host frame only; export with "
                         "--save_observations, or pass --min_track 1 for a model without real tracks")
    pixels = np.stack([cloud.scalars["pixel_x"], cloud.scalars["pixel_y"]], axis=1)
    return Observations.of_hosts(cloud.scalars["host_frame"], pixels)
