"""Write everything a run produced: arrays, clouds, trajectory, preview and the description of the run."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import subprocess
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
from devo.poses import invert_poses_numpy
from devo.result import TrackingResult
from utils.array_files import save_array
from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import FilterReport, clean_cloud
from utils.clouds.io import SUFFIXES, write_cloud
from utils.clouds.preview import save_preview
from utils.frame_bundle import FrameBundle
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
        path = cloud_file(out, "--out")
        products = cls(path.with_suffix(""), path.suffix.lower())
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


def cloud_file(name: str | PathLike[str], flag: str) -> Path:
    """The file of a cloud as a flag names it; without a suffix it becomes `.npy`.

    Raises:
        InputError: a suffix that no writer knows.
    """
    path = Path(name)
    if path.suffix and path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{flag} {path} ends in {path.suffix!r}; expected {', '.join(SUFFIXES)} or none")
    return path if path.suffix else path.with_name(path.name + ".npy")


class _WritableError(Exception):
    """Ends the probe write without leaving a file."""


def observables_to_cloud(observables: Observables, metadata: dict[str, str] | None = None) -> PointCloud:
    """The raw cloud with provenance and quality as named scalars; colours in 0..255."""
    colors = None if observables.colors is None else np.rint(observables.colors * 255.0).astype(np.uint8)
    return PointCloud(observables.points, colors, observables.scalars(), metadata or {})


def write_edge_cloud(products: Products, target: Path, cloud: PointCloud, outlier_step: tuple[str, Mapping[str, Any]]
                     | None) -> list[FilterReport]:
    """Write an edge cloud in the format of its suffix, as PLY with all per-point values, and cleaned.

    Args:
        target: file of the cloud; `<target without suffix>.ply` and `_cleaned.ply` go beside it.
        outlier_step: the filter for the cleaned one; None for no cleaned cloud.
    """
    ply = target.with_suffix(".ply")
    for path in dict.fromkeys((target, ply)):
        write_cloud(path, cloud)
        products.written.append(path)
    if outlier_step is None:
        return []
    cleaned, reports = clean_cloud(cloud, [outlier_step])
    products.written.append(target.with_name(f"{target.stem}_cleaned.ply"))
    write_cloud(products.written[-1], cleaned)
    return reports


FRAME_TABLE = ("frame_id", "t_us", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "keyframe", "points", "median_depth")


def write_frame_table(path: Path, bundle: FrameBundle) -> None:
    """Write one line of text per recorded frame: pose camera to world, whether it is a keyframe, its points.

    The columns are those of `FRAME_TABLE`; times in microseconds, lengths in trajectory units.
    """
    poses = invert_poses_numpy(bundle.cam_T_world)
    lines = [",".join(FRAME_TABLE)]
    for i in range(len(bundle)):
        inv_depths = bundle.inv_depths[bundle.rows(i)]
        depth = 1.0 / float(np.median(inv_depths)) if len(inv_depths) else float("nan")
        pose = ",".join(f"{value:.9g}" for value in poses[i])
        lines.append(f"{bundle.frame_ids[i]},{bundle.t_us[i]:.3f},{pose},{int(bundle.keyframe[i])},{len(inv_depths)},"
                     f"{depth:.6g}")
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


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
    return {"devo_version": __version__, "git_revision": git_revision(), "python": platform.python_version(),
            "machine": platform.machine(), "versions": versions, "command": sys.argv}


def git_revision() -> str | None:
    """The commit of this checkout, with `+` where files differ from it; None outside of a repository."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10,
                              check=True)
        return done.stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None  # no git program, or a repository of somebody else


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
