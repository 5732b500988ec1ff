"""From files to an EMVS map and its products: the work behind `scripts/run_emvs.py`."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from devo.device import resolve_device
from devo.errors import DevoError, InputError
from utils.calibration import read_calibration
from utils.clouds.io import read_cloud
from utils.datasets.generic import CALIBRATION_NAMES, find_event_file
from utils.datasets.options import SequenceOptions
from utils.datasets.recognise import GENERIC
from utils.datasets.registry import Sequence, open_sequence
from utils.emvs.convention import ConventionCheck, PacketSample, check_convention
from utils.emvs.mapper import EmvsMap, EventCamera, map_events
from utils.emvs.products import base_path, write_products
from utils.emvs.settings import EmvsSettings
from utils.emvs.views import PoseTrack
from utils.events.reader import EventReader, open_events
from utils.events.types import Events
from utils.trajectory_io import Trajectory, inverted, read_npy, read_tum
from utils.undistort import rectify_map
from utils.voxel_grid import scale_intrinsics

_TUM_UNITS = {"tum_s": "s", "tum_us": "us"}


@dataclass
class EmvsOptions:
    """What `scripts/run_emvs.py` was asked for; the field names are those of its flags."""

    out: str
    datapath: str | None = None
    dataset: str = GENERIC
    side: str = "left"
    events: str | None = None
    poses: str | None = None
    calib: str | None = None
    image_size: list[int] | None = None
    cloud: str | None = None
    pose_format: str = "auto"
    pose_convention: str = "auto"
    start_time_s: float = 0.0
    stop_time_s: float = 1000.0
    device: str = "auto"
    pictures: bool = True
    save_dsi: bool = False
    check_poses: bool = True
    settings: EmvsSettings = dataclasses.field(default_factory=EmvsSettings)

    @property
    def size(self) -> tuple[int, int] | None:
        """Sensor size (width, height), None if it was not given."""
        return (self.image_size[0], self.image_size[1]) if self.image_size else None


@dataclass(frozen=True)
class _Source:
    """Events, camera and poses of one run; `files` and `calibration` describe them."""

    open_events: Callable[[], EventReader]
    event_camera: EventCamera
    trajectory: Trajectory
    files: dict[str, Path]
    calibration: dict[str, Any]


def run_emvs(options: EmvsOptions, sequence: Sequence | None = None) -> EmvsMap:
    """Map a recording and write every product next to `options.out`.

    Args:
        options: what was asked for.
        sequence: where events and camera come from; None opens what the options name.

    Raises:
        InputError: unusable arguments or input.
        DevoError: no pixel has a depth that is believed; the pictures are written nevertheless.
        OutputError: a file could not be written.
    """
    started = time.perf_counter()
    device = resolve_device(options.device)
    source = _from_files(options) if sequence is None and options.dataset == GENERIC else _from_sequence(
        options, sequence)
    trajectory, event_camera = source.trajectory, source.event_camera
    sparse = None if options.cloud is None else _read_sparse(options)
    sample = PacketSample(options.settings.packet_size)
    with source.open_events() as reader:
        start_us, stop_us = _window_us(reader, trajectory, options)
        with tqdm(unit=" events", unit_scale=True, desc="voting", file=sys.stderr, disable=None) as bar:
            def on_events(events: Events) -> None:
                bar.update(len(events))
                sample.add(events)

            result = map_events(reader, trajectory, event_camera, options.settings, start_us=start_us, stop_us=stop_us,
                                sparse_points=sparse, device=device, keep_dsi=options.save_dsi, on_events=on_events)
    check = _check(result, sample, trajectory, event_camera, options, device) if options.check_poses else None
    meta = _describe(result, options, source, check, device)
    meta["total_s"] = round(time.perf_counter() - started, 2)
    written = write_products(base_path(options.out), result, meta, pictures=options.pictures, dsi=options.save_dsi)
    _report(result, check, written)
    return result


def read_poses(path: Path, pose_format: str = "auto", convention: str = "auto") -> Trajectory:
    """Read camera-to-world poses.

    Args:
        path: `<base>_poses.npy` with its `<base>_tstamps.npy`, or TUM text.
        pose_format: `npy`, `tum_s`, `tum_us` (stamps in seconds, microseconds), or `auto`: by the ending of the name,
            text in seconds.
        convention: what the file holds: `T_wc` camera to world, `T_cw` world to camera; `auto` is `T_wc`, which all
            these files hold.

    Raises:
        InputError: an unreadable file.
    """
    if pose_format == "auto":
        pose_format = "npy" if path.suffix.lower() == ".npy" else "tum_s"
    trajectory = read_npy(path) if pose_format == "npy" else read_tum(path, time_unit=_TUM_UNITS[pose_format])
    if convention == "T_cw":
        return Trajectory(trajectory.t_us, inverted(trajectory.world_T_cam))
    return trajectory


def _from_files(options: EmvsOptions) -> _Source:
    """A recording of one's own, or single files."""
    files = _find_files(options)
    trajectory = read_poses(files["poses"], options.pose_format, options.pose_convention)
    calibration = read_calibration(files["calib"], options.size, _size_in(files["events"]))
    camera = EventCamera(*rectify_map(calibration))
    return _Source(lambda: open_events(files["events"], sensor_size=camera.size), camera, trajectory, files,
                   calibration.as_dict())


def _from_sequence(options: EmvsOptions, sequence: Sequence | None) -> _Source:
    """A sequence of a data set, as its reader opens it."""
    if sequence is None:
        if options.datapath is None or options.events or options.calib:
            raise InputError(f"--dataset {options.dataset} needs --datapath FOLDER, without --events and --calib")
        opened = open_sequence(options.dataset, options.datapath, SequenceOptions(side=options.side))
        if not isinstance(opened, Sequence):
            raise InputError(f"{options.datapath}: {options.dataset} holds voxel grids, but EMVS needs events")
        sequence = opened
    files = {role: Path(path) for role, path in sequence.describe()["files"].items()}
    truth = sequence.ground_truth() if options.poses is None else None
    if options.poses is not None:
        files["poses"] = Path(options.poses)
        trajectory = read_poses(files["poses"], options.pose_format, options.pose_convention)
    elif truth is not None:
        trajectory = Trajectory(*truth)
    else:
        raise InputError(f"{sequence.path}: there is no ground truth, so --poses is needed")
    width, height = sequence.sensor_size
    positions = sequence.rectify_map
    if positions is None:  # the events are undistorted already
        positions = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    intrinsics = scale_intrinsics(sequence.intrinsics, (sequence.width, sequence.height), sequence.sensor_size)
    return _Source(sequence.open_events, EventCamera(positions, intrinsics), trajectory, files,
                   {"width": width, "height": height, "intrinsics_fx_fy_cx_cy": intrinsics.tolist()})


def _find_files(options: EmvsOptions) -> dict[str, Path]:
    """Events, poses and calibration: as given, the rest from the folder of a generic recording."""
    given = {name: Path(value) for name in ("events", "poses", "calib") if (value := getattr(options, name))}
    if options.datapath is not None:
        given = _files_of_folder(Path(options.datapath), given) | given
    missing = [f"--{name}" for name in ("events", "poses", "calib") if name not in given]
    if missing:
        where = f"{options.datapath} has no such file" if options.datapath else "or give --datapath FOLDER"
        raise InputError(f"{' and '.join(missing)} needed: {where}")
    return given


def _files_of_folder(folder: Path, given: dict[str, Path]) -> dict[str, Path]:
    if not folder.is_dir():
        raise InputError(f"--datapath {folder} is no folder; expected one with events.*, calib.* and groundtruth.txt")
    found = {}
    if "events" not in given:
        found["events"] = find_event_file(folder, SequenceOptions())
    calibrations = [folder / name for name in CALIBRATION_NAMES if (folder / name).is_file()]
    if len(calibrations) > 1 and "calib" not in given:
        raise InputError(f"{folder}: several calibrations ({', '.join(file.name for file in calibrations)}); pass the "
                         "one to use with --calib")
    if calibrations:
        found["calib"] = calibrations[0]
    if (folder / "groundtruth.txt").is_file():
        found["poses"] = folder / "groundtruth.txt"
    return found


def _size_in(events: Path) -> tuple[int, int] | None:
    with open_events(events) as reader:
        return reader.sensor_size


def _read_sparse(options: EmvsOptions) -> np.ndarray:
    cloud = read_cloud(str(options.cloud))
    if not cloud.finite_mask().any():
        raise InputError(f"{options.cloud}: the cloud has {len(cloud)} points and none is finite; it gives no depth "
                         "range, pass --min_depth and --max_depth")
    return cloud.points


def _window_us(reader: EventReader, trajectory: Trajectory, options: EmvsOptions) -> tuple[float, float]:
    """Times count from the first stamp of all, be it of an event or of a pose."""
    if not 0 <= options.start_time_s < options.stop_time_s:
        raise InputError(f"the window from {options.start_time_s:g} s to {options.stop_time_s:g} s is empty, expected "
                         "0 <= --start_time_s < --stop_time_s")
    origin = min(float(reader.time_range_us()[0]), float(trajectory.t_us[0]))
    return origin + 1e6 * options.start_time_s, origin + 1e6 * options.stop_time_s


def _check(result: EmvsMap, sample: PacketSample, trajectory: Trajectory, event_camera: EventCamera,
           options: EmvsOptions, device: torch.device) -> ConventionCheck | None:
    fullest = max(result.views, key=lambda view: view.counts["events"])
    return check_convention(fullest, sample.events, PoseTrack(trajectory), event_camera, options.settings, device)


def _describe(result: EmvsMap, options: EmvsOptions, source: _Source, check: ConventionCheck | None,
              device: torch.device) -> dict[str, Any]:
    from devo import __version__

    asked = dataclasses.asdict(options)
    return {
        "method": "EMVS, Rebecq et al. 2018 (see utils/emvs/__init__.py, patent application WO/2018/037079)",
        "pose_convention": "T_world_cam", "pose_order": "tx ty tz qx qy qz qw", "unit": "that of the poses",
        "settings": asked.pop("settings"), "options": asked,
        "input": {name: str(path) for name, path in source.files.items()}, "calibration": source.calibration,
        "undistorted_fx_fy_cx_cy": source.event_camera.intrinsics.tolist(), "points": len(result.cloud),
        "views": [view.describe() for view in result.views], **result.counts,
        "convention_check": None if check is None else {**dataclasses.asdict(check), "suspicious": check.suspicious},
        "device": str(device), "torch": torch.__version__, "version": __version__,
    }


def _report(result: EmvsMap, check: ConventionCheck | None, written: list[Path]) -> None:
    events = sum(view.counts["events"] for view in result.views)
    seconds = sum(view.counts["read_and_vote_s"] for view in result.views)
    late = {name: us for name, us in result.counts.items() if name.startswith("us_") and us}
    tqdm.write(f"{len(result.cloud)} points from {events:.0f} events in {len(result.views)} view(s), "
               f"{events / 1e6 / max(seconds, 1e-3):.2f} million events/s; "
               f"wrote {', '.join(path.name for path in written[:2])} and {len(written) - 2} more to "
               f"{written[0].parent}", file=sys.stderr)
    for name, us in late.items():
        tqdm.write(f"note: {us / 1e6:.3f} s of events {name.removeprefix('us_').replace('_', ' ')} were not used",
                   file=sys.stderr)
    if check is not None and check.suspicious:
        tqdm.write(f"WARNING: the inverse poses give a sharper result ({check.inverted:.2f} against {check.given:.2f} "
                   "coinciding votes): the poses seem to be world to camera; try --pose_convention T_cw",
                   file=sys.stderr)
    if not len(result.cloud):
        raise DevoError("no pixel has a depth that is believed: lower --adaptive_threshold_c, check the depth range "
                        f"and the radius filter; look at the files in {written[-1].parent}")
