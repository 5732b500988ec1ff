"""Write everything a run produced: arrays, clouds, trajectory, preview and the description of the run."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from devo import __version__
from devo.errors import InputError, OutputError
from devo.observables import Observables
from devo.result import TrackingResult
from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import FilterReport, clean_cloud
from utils.clouds.io import SUFFIXES, write_cloud
from utils.clouds.preview import save_preview
from utils.map_recorder import save_array
from utils.trajectory_io import Trajectory, write_tum

SCHEMA_VERSION = 1
CONVENTIONS = {
    "schema_version": SCHEMA_VERSION,
    "pose_convention": "T_world_cam",
    "pose_layout": "tx ty tz qx qy qz qw",
    "world_frame": "first accepted camera, OpenCV axes (x right, y down, z forward)",
    "depths_convention": "z-depth in the host camera, trajectory units",
    "scale": "arbitrary",
    "time_unit": "us",
}


@dataclass
class Products:
    """Names of the files of one export; `base` is `--out` without its suffix."""

    base: Path
    suffix: str = ".npy"
    written: list[Path] = field(default_factory=list)

    @classmethod
    def of(cls, out: str | PathLike[str]) -> Products:
        """Split `--out` into base and format; a path without suffix means `.npy`.

        Raises:
            InputError: an unknown suffix, or the folder cannot be written.
        """
        path = Path(out)
        if path.suffix and path.suffix.lower() not in SUFFIXES:
            raise InputError(f"--out {path} ends in {path.suffix!r}; expected {', '.join(SUFFIXES)} or none")
        products = cls(path.with_suffix(""), path.suffix.lower() or ".npy")
        try:
            with atomic_path(products.path("_meta.json")) as probe:
                probe.write_text("{}")
                raise _WritableError
        except _WritableError:
            return products
        except OutputError as error:
            raise InputError(f"--out {path}: {error}") from error

    def path(self, ending: str) -> Path:
        """`<base><ending>`, for example `_depths.npy`."""
        return self.base.with_name(self.base.name + ending)

    def array(self, ending: str, values: np.ndarray) -> None:
        """Write one array as `<base><ending>`."""
        self.written.append(save_array(self.path(ending), values))


class _WritableError(Exception):
    """Ends the probe write without leaving a file."""


def observables_to_cloud(observables: Observables, metadata: dict[str, str] | None = None) -> PointCloud:
    """The raw cloud with provenance and quality as named scalars; colours in 0..255."""
    colors = None if observables.colors is None else np.rint(observables.colors * 255.0).astype(np.uint8)
    return PointCloud(observables.points, colors, observables.scalars(), metadata or {})


def frames_to_arrays(frame_data: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """The arrays of a frame bundle: poses are `cam_T_world`, `depths` are z-depths, centres NaN-padded per frame."""
    counts = np.array([len(frame["depths"]) for frame in frame_data], dtype=np.int32)
    width = int(counts.max()) if len(counts) else 0
    centers = np.full((len(frame_data), width, 2), np.nan, dtype=np.float32)
    for row, frame in zip(centers, frame_data, strict=True):
        row[:len(frame["centers"])] = frame["centers"]

    def stacked(key: str, columns: int) -> np.ndarray:
        return np.array([frame[key] for frame in frame_data], dtype=np.float32).reshape(-1, columns)

    def joined(key: str, shape: tuple[int, ...]) -> np.ndarray:
        parts = [np.zeros((0, *shape), np.float32), *(frame[key] for frame in frame_data)]
        return np.concatenate(parts).astype(np.float32)

    return {
        "frame_ids": np.array([frame["frame_id"] for frame in frame_data], dtype=np.int64),
        "timestamps": np.array([frame["timestamp"] for frame in frame_data], dtype=np.float64),
        "poses": stacked("pose", 7), "intrinsics": stacked("intrinsics", 4), "counts": counts,
        "offsets": (np.cumsum(counts) - counts).astype(np.int64), "points": joined("points", (3,)),
        "depths": joined("depths", ()), "inv_depths": joined("inv_depths", ()), "centers": centers,
        "pose_convention": np.array("T_cam_world"), "depths_convention": np.array("z-depth"),
    }


def save_frame_bundle(path: str | PathLike[str], frame_data: Sequence[dict[str, Any]]) -> Path:
    """Write the frame bundle as `.npz` without pickles."""
    target = Path(path)
    if target.suffix != ".npz":
        target = target.with_name(target.name + ".npz")
    with atomic_path(target) as temporary:
        np.savez(temporary, **frames_to_arrays(frame_data))  # type: ignore[arg-type]
    return target


def save_json(path: Path, values: dict[str, Any]) -> Path:
    """Write a JSON file with indent 2; NumPy numbers and paths are converted."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(values, indent=2, default=_jsonable) + "\n", encoding="utf-8")
    return path


def _jsonable(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} is not JSON")


def run_environment() -> dict[str, Any]:
    """Versions and command line, so that a result explains itself."""
    versions = {package: importlib.metadata.version(package) for package in ("torch", "numpy", "open3d")}
    return {"devo_version": __version__, "python": platform.python_version(), "machine": platform.machine(),
            "versions": versions, "command": sys.argv}


def write_tracking(products: Products, result: TrackingResult) -> None:
    """Write cloud, depths, poses and time stamps of a run, and the trajectory in TUM text."""
    observables = result.observables
    if observables is not None:
        cloud = observables_to_cloud(observables, {key: str(value) for key, value in CONVENTIONS.items()})
        raw = products.path(products.suffix)
        write_cloud(raw, cloud)
        products.written.append(raw)
        for suffix in (".npy", ".ply", ".npz"):
            if suffix != products.suffix:
                write_cloud(products.path(suffix), cloud)
                products.written.append(products.path(suffix))
        products.array("_depths.npy", observables.depths)
    products.array("_poses.npy", result.poses)
    products.array("_tstamps.npy", result.tstamps)
    if len(result.poses) and np.isfinite(result.poses).all():
        trajectory = products.path("_trajectory.txt")
        write_tum(trajectory, Trajectory(result.tstamps, result.poses.astype(np.float64)))
        products.written.append(trajectory)


def write_cleaned(products: Products, cloud: PointCloud, steps: Sequence[str | tuple[str, Mapping[str, Any]]]) -> tuple[
        PointCloud, list[FilterReport]]:
    """Filter the raw cloud and write `<base>_cleaned.ply`; every filter says what it removed."""
    cleaned, reports = clean_cloud(cloud, steps)
    write_cloud(products.path("_cleaned.ply"), cleaned)
    products.written.append(products.path("_cleaned.ply"))
    return cleaned, reports


def write_preview(products: Products, cloud: PointCloud, poses: np.ndarray, title: str) -> None:
    """Write `<base>_preview.png`: top, side and perspective view of cloud and trajectory."""
    save_preview(products.path("_preview.png"), cloud, poses, title=title)
    products.written.append(products.path("_preview.png"))
