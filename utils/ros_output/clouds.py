"""Clouds and trajectories as bags: the work behind `scripts/pointcloud_to_rosbag.py`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.calibration import Calibration
from utils.clouds.arrays import load_array
from utils.clouds.cloud import PointCloud
from utils.clouds.io import read_cloud
from utils.events.types import Events
from utils.finished_run import is_frame_bundle, read_frames, read_trajectory
from utils.ros_output.messages import CAMERA_INFO, CLOUD, EVENT_ARRAY, POSE, RosMessages, new_bag, stamps_ns

TIMESTAMP_UNITS = ("auto", "us", "s")
_US_IF_LONGER = 1e5
_FRAME_US = 1e6  # between clouds without stamps
CLOUD_TOPIC, POSE_TOPIC = "/devo/pointcloud", "/devo/pose"
EMVS_TOPICS = {"events": "/dvs/events", "camera": "/dvs/camera_info", "poses": "/pose"}


@dataclass(frozen=True)
class BagOptions:
    """What `scripts/pointcloud_to_rosbag.py` was asked for; the field names are those of its flags."""

    input: str
    output_bag: str
    topic: str | None = None
    frame_id: str = "world"
    timestamp_unit: str = "auto"
    timestamps_npy: str | None = None
    include_empty: bool = False
    emvs_style: bool = False
    H: int = 480
    W: int = 640
    overwrite: bool = False


def write_input_as_bag(options: BagOptions) -> str:
    """Write the input as a bag whose first stamp is one second.

    A cloud becomes one `PointCloud2`; `(F, N, 3)` arrays and frame bundles become F of them, poses one `PoseStamped`
    each. The default topic says what it holds: `/devo/pointcloud`, or `/devo/pose` for poses.

    Returns:
        One line that says what was written.

    Raises:
        InputError: unusable input or options, or the bag exists and may not be replaced.
        OutputError: the bag cannot be written.
    """
    path = Path(options.input)
    if not path.is_file():
        raise InputError(f"{path}: cannot be read; check the path")
    if _holds_poses(path):
        return _write_poses(path, options)
    if options.emvs_style:
        raise InputError(f"{path}: --emvs_style needs a trajectory (.txt or _poses.npy), found a cloud")
    clouds, t_us = _read_clouds(path, options)
    return _write_clouds(clouds, t_us, options)


def _holds_poses(path: Path) -> bool:
    if path.suffix.lower() == ".txt":
        return True
    if path.suffix.lower() != ".npy":
        return False
    shape = load_array(path).shape
    return len(shape) == 2 and shape[1] == 7


def _write_poses(path: Path, options: BagOptions) -> str:
    trajectory = read_trajectory(path, tstamps=options.timestamps_npy, time_unit=options.timestamp_unit)
    if not len(trajectory):
        raise InputError(f"{path}: there is no pose in the file")
    topic = options.topic or (EMVS_TOPICS["poses"] if options.emvs_style else POSE_TOPIC)
    messages = RosMessages()
    t_ns = stamps_ns(trajectory.t_us, float(trajectory.t_us[0]))
    with new_bag(options.output_bag, options.overwrite) as bag:
        if options.emvs_style:
            _write_dummies(bag, messages, int(t_ns[0]))
        connection = bag.add_connection(topic, POSE, typestore=messages.store)
        for stamp, pose in zip(t_ns.tolist(), trajectory.world_T_cam):
            bag.write(connection, stamp, messages.pose(stamp, pose, options.frame_id))
    return f"{options.output_bag}: {len(trajectory)} poses on {topic}, {(t_ns[-1] - t_ns[0]) / 1e9:.3f} s"


def _write_dummies(bag: object, messages: RosMessages, t_ns: int) -> None:
    """One empty event array and a camera of one pixel: topics that EMVS expects beside the poses."""
    pixel = Calibration(1, 1, 1.0, 1.0, 0.0, 0.0)
    for topic, kind, data in (
            (EMVS_TOPICS["events"], EVENT_ARRAY, messages.event_array(
                Events.empty(), np.empty(0, np.int64), (1, 1), "dvs", 0)),
            (EMVS_TOPICS["camera"], CAMERA_INFO, messages.camera_info(t_ns, pixel, "dvs"))):
        connection = bag.add_connection(topic, kind, typestore=messages.store)  # type: ignore[attr-defined]
        bag.write(connection, t_ns, data)  # type: ignore[attr-defined]


def _read_clouds(path: Path, options: BagOptions) -> tuple[list[PointCloud], npt.NDArray[np.float64]]:
    """The clouds with their stamps in microseconds."""
    given = None if options.timestamps_npy is None else _given_stamps(options.timestamps_npy, options.timestamp_unit)
    if is_frame_bundle(path):
        bundle = read_frames(path)
        clouds = [PointCloud(points) for points in np.split(bundle.points, bundle.offsets[1:-1])]
        return _matched(path, clouds[:len(bundle)], bundle.t_us if given is None else given)
    if path.suffix.lower() == ".npy" and (array := load_array(path)).ndim == 3:
        clouds = [PointCloud(points) for points in array]
        return _matched(path, clouds, _FRAME_US * np.arange(len(clouds), dtype=np.float64) if given is None else given)
    return _matched(path, [read_cloud(path)], np.zeros(1) if given is None else given)


def _given_stamps(path: str, unit: str) -> npt.NDArray[np.float64]:
    stamps = load_array(path)
    if stamps.ndim != 1 or stamps.dtype.kind not in "iuf" or not np.isfinite(stamps).all():
        raise InputError(f"{path}: stamps must be one row of finite numbers, found {stamps.dtype} of shape "
                         f"{stamps.shape}")
    if unit == "auto":
        unit = "us" if stamps.size and float(np.ptp(stamps)) > _US_IF_LONGER else "s"
    return stamps.astype(np.float64) * (1.0 if unit == "us" else 1e6)


def _matched(path: Path, clouds: list[PointCloud], t_us: npt.NDArray[np.float64]) -> tuple[
        list[PointCloud], npt.NDArray[np.float64]]:
    if len(clouds) != len(t_us):
        raise InputError(f"{path}: {len(clouds)} clouds but {len(t_us)} stamps")
    if not clouds:
        raise InputError(f"{path}: there is no frame in the file")
    return clouds, t_us


def _write_clouds(clouds: list[PointCloud], t_us: npt.NDArray[np.float64], options: BagOptions) -> str:
    topic = options.topic or CLOUD_TOPIC
    wanted = [options.include_empty or bool(cloud.finite_mask().any()) for cloud in clouds]
    if not any(wanted):
        raise InputError(f"{options.input}: no cloud has a finite point; --include_empty writes empty ones")
    messages = RosMessages()
    t_ns = stamps_ns(t_us, float(t_us.min()))
    points = 0
    with new_bag(options.output_bag, options.overwrite) as bag:
        connection = bag.add_connection(topic, CLOUD, typestore=messages.store)
        for stamp, cloud, use in zip(t_ns.tolist(), clouds, wanted):
            if use:
                bag.write(connection, stamp, messages.cloud(stamp, cloud, options.frame_id))
                points += int(cloud.finite_mask().sum())
    left_out = sum(len(cloud) for cloud in clouds) - points
    return (f"{options.output_bag}: {sum(wanted)} clouds with {points} points on {topic}"
            + (f", {left_out} non-finite points left out" if left_out else "")
            + (f", {len(wanted) - sum(wanted)} empty clouds left out" if not all(wanted) else ""))
