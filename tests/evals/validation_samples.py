"""A small simulated board and made-up results of the odometry whose quality is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from evals.alignment import Similarity
from evals.validation.odometry import Trial
from evals.validation.settings import ValidationSettings
from evals.validation.source import Source
from utils.clouds.cloud import PointCloud
from utils.emvs.settings import EmvsSettings
from utils.emvs.views import PoseTrack
from utils.simulator.dataset_folder import FolderOptions, write_recording
from utils.simulator.sequence import SequenceSettings
from utils.trajectory_io import Trajectory, quaternions

UNITS_PER_M = 2.0
DEVO_T_METRIC = Similarity(UNITS_PER_M, Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([1.0, -2.0, 0.5]))
"""From the frame of the ground truth to that of the made-up odometry."""


def write_board(folder: Path, frames: bool = False) -> Path:
    """A second and a bit of a board seen by 160 x 120 pixels, without noise."""
    settings = SequenceSettings("board", seconds=1.2, seed=2, size=(160, 120), threshold=0.5, noise="none")
    write_recording(folder, settings, FolderOptions(frames=frames))
    return folder


def quick_settings(sequence: Path, out: Path, **options: object) -> ValidationSettings:
    """Settings that make small maps."""
    given = {"trials": 1, "emvs_events": 150_000, "view_scale": 1.2, "emvs": EmvsSettings(
        dimZ=40, adaptive_threshold_c=10.0, median_filter_size=15, packet_size=256), **options}
    return ValidationSettings(sequence, out, **given)  # type: ignore[arg-type]


def made_up_trial(source: Source, depth_factor: float = 1.0, noise_m: float = 0.0, seed: int = 0) -> Trial:
    """The true trajectory at 30 Hz in another frame and scale, and points on the events' own rays.

    Args:
        source: the recording.
        depth_factor: how far off every depth is; 1 = where the depth maps say.
        noise_m: standard deviation of a jitter of the camera centres.
        seed: of the jitter, and the number of the trial.
    """
    assert source.depth is not None
    rng = np.random.default_rng(seed)
    track = PoseTrack(source.truth)
    stamps = source.depth.t_us[(source.depth.t_us >= track.t_us[0]) & (source.depth.t_us <= track.t_us[-1])]
    true = track(stamps)
    centers = DEVO_T_METRIC.apply(true[:, :3, 3] + noise_m * rng.normal(size=(len(stamps), 3)))
    trajectory = Trajectory(stamps, np.concatenate(
        [centers, quaternions(DEVO_T_METRIC.rotation @ true[:, :3, :3])], axis=1))
    points, hosts = [], []
    with source.sequence.open_events() as reader:
        for number, stamp in enumerate(stamps[1:-1], start=1):
            events = reader.read(stamp - 1500, stamp + 1500)
            x, y = np.unique(np.stack([events.x, events.y], axis=1), axis=0)[::2].T.astype(np.int64)
            z = depth_factor * source.depth.load(number)[y, x].astype(np.float64)
            fx, fy, cx, cy = source.depth.intrinsics
            seen = np.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], axis=1)[z > 0]
            points.append(DEVO_T_METRIC.apply(seen @ true[number, :3, :3].T + true[number, :3, 3]))
            hosts.append(np.full(len(seen), number))
    host = np.concatenate(hosts)
    cloud = PointCloud(np.concatenate(points), scalars={"t_us": stamps[host], "host_frame": host})
    return Trial(seed, trajectory, cloud, {"seconds": 1.5, "message": "made up"})
