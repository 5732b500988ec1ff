"""Loaders of ground truth under the names that users of DEVO know; all return `(t_us, world_T_cam)`.

Stamps are (N,) microseconds on the clock of the file, poses (N, 7) `tx ty tz qx qy qz qw`. All raise `InputError` for
files that are missing or damaged, or whose stamps run backwards; of poses with the same stamp the first one counts.
"""

from __future__ import annotations

import os
from pathlib import Path

from utils.datasets.mvsec import DATA_SUFFIX, POSES_SUFFIX, read_poses
from utils.datasets.prepared import only_match
from utils.datasets.sequence import GroundTruth
from utils.trajectory_io import read_tum


def load_gt_us(path: str | os.PathLike[str], skiprows: int = 0) -> GroundTruth:
    """Load poses whose stamps are microseconds: fpv (`..._cam.txt`), rpg, hku, vector."""
    return _load(path, "us", skiprows)


def load_eds_traj(path: str | os.PathLike[str]) -> GroundTruth:
    """Load `stamped_groundtruth_us.txt` of EDS: poses of the motion capture body, not of the camera."""
    return _load(path, "us", 1)


def load_tumvie_traj(path: str | os.PathLike[str]) -> GroundTruth:
    """Load `mocap_data.txt` of TUM-VIE: poses of the motion capture body, not of the camera."""
    return _load(path, "us", 1)


def load_ecd_gt(path: str | os.PathLike[str], skiprows: int = 0) -> GroundTruth:
    """Load `groundtruth.txt` of the Event Camera Dataset, whose stamps are seconds."""
    return _load(path, "s", skiprows)


def load_mvsec_traj(scenedir: str | os.PathLike[str], side: str = "left") -> GroundTruth:
    """Load the poses of a sequence folder `{name}_data` of MVSEC."""
    data = only_match(Path(scenedir), f"*{DATA_SUFFIX}", "recording of MVSEC")
    return read_poses(data.with_name(data.name.removesuffix(DATA_SUFFIX) + POSES_SUFFIX), side)


def _load(path: str | os.PathLike[str], time_unit: str, skip_lines: int) -> GroundTruth:
    trajectory = read_tum(path, time_unit=time_unit, skip_lines=skip_lines, skip_repeated=True)
    return trajectory.t_us, trajectory.world_T_cam
