"""Bag and flag file for EMVS programs of ROS: the work behind `scripts/prepare_emvs_bag.py`.

EMVS wants camera-to-world poses. `_poses.npy` and TUM text hold exactly those, so nothing is inverted here unless the
tag of the file or the user says that they are world to camera.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.events.reader import EventReader
from utils.finished_run import is_frame_bundle, read_any_cloud, read_trajectory
from utils.ros_output.messages import CAMERA_INFO, EVENT_ARRAY, FIRST_STAMP_NS, POSE, RosMessages, new_bag, stamps_ns
from utils.ros_output.recordings import RosRecording, open_recording
from utils.trajectory_io import Trajectory

DEFAULT_DEPTHS = (0.3, 5.0)


@dataclass(frozen=True)
class EmvsBagOptions:
    """What `scripts/prepare_emvs_bag.py` was asked for; the field names are those of its flags."""

    poses: str
    out_bag: str
    datapath: str | None = None
    dataset: str = "auto"
    events: str | None = None
    calib: str | None = None
    image_size: list[int] | None = None
    side: str = "left"
    tstamps: str | None = None
    pose_convention: str = "auto"
    time_unit: str = "auto"
    out_conf: str | None = None
    frames_npz: str | None = None
    cloud: str | None = None
    event_topic: str = "/dvs/events"
    camera_info_topic: str = "/dvs/camera_info"
    pose_topic: str = "/pose"
    min_depth: float | None = None
    max_depth: float | None = None
    dimZ: int = 100
    t_margin_s: float = 0.5
    max_events_per_msg: int = 20_000
    eventarray_schema: str = "5e8"
    overwrite: bool = False

    def check(self) -> None:
        """Refuse what cannot work before anything is read.

        Raises:
            InputError: numbers out of range.
        """
        if not 1 <= self.max_events_per_msg <= 10_000_000:
            raise InputError(f"--max_events_per_msg is {self.max_events_per_msg}, expected 1 to 10000000")
        if not 2 <= self.dimZ <= 256:
            raise InputError(f"--dimZ is {self.dimZ}, expected 2 to 256 planes (EMVS numbers them with 8 bits)")
        if not 0 <= self.t_margin_s < 1e6:
            raise InputError(f"--t_margin_s is {self.t_margin_s:g}, expected seconds, not negative")
        if self.events is None and self.datapath is None:
            raise InputError("name the recording: --seq_dir or --datapath FOLDER, or --events FILE with --calib FILE")
        if self.out_conf is not None and Path(self.out_conf).resolve() == Path(self.out_bag).resolve():
            raise InputError(f"--out_conf and --out_bag are both {self.out_bag}")


def prepare_emvs_bag(options: EmvsBagOptions) -> dict[str, Any]:
    """Write the bag (camera info, events, poses) and the flag file beside it.

    Events from `t_margin_s` before the first to after the last pose are written. Stamps are shifted so that the earlier
    of first event and first pose is one second; the flag file covers the whole span.

    Returns:
        What was written: `bag`, `conf`, `events`, `messages`, `poses`, `span_s`, `min_depth`, `max_depth`,
        `rectified`.

    Raises:
        InputError: unusable options or input, or the bag exists and may not be replaced.
        OutputError: a file cannot be written.
    """
    options.check()
    messages = RosMessages(options.eventarray_schema)
    trajectory = read_trajectory(options.poses, tstamps=options.tstamps, time_unit=options.time_unit,
                                 convention=options.pose_convention)
    if not len(trajectory):
        raise InputError(f"{options.poses}: there is no pose in the file")
    depths = depth_range(options)
    size = None if options.image_size is None else (options.image_size[0], options.image_size[1])
    recording = open_recording(
        Path(options.datapath or ""), options.dataset, options.side, _path(options.events), _path(options.calib), size)
    with recording.open_reader() as reader:
        window = _window(reader, trajectory, options)
        counts = _write_bag(messages, recording, reader, trajectory, window, options)
    conf = Path(options.out_conf) if options.out_conf else Path(options.out_bag).with_suffix(".conf")
    summary: dict[str, Any] = {"bag": options.out_bag, "conf": str(conf), "poses": len(trajectory), **counts,
                               "min_depth": depths[0], "max_depth": depths[1],
                               "rectified": recording.rectify_map is not None}
    _write_conf(conf, summary, options)
    return summary


def depth_range(options: EmvsBagOptions) -> tuple[float, float]:
    """Depth bounds: as given; a missing one from the structure of the run, else 0.3 and 5.

    The structure gives 0.8 times the 5th and 1.2 times the 95th percentile of its depths.

    Raises:
        InputError: no usable depth in the file, or bounds that contradict each other.
    """
    near, far = DEFAULT_DEPTHS
    source = options.frames_npz or options.cloud
    if source is not None and (options.min_depth is None or options.max_depth is None):
        depth = _depths(source)
        near = max(1e-3, 0.8 * float(np.percentile(depth, 5)))
        far = 1.2 * float(np.percentile(depth, 95))
        far = far if far > near else near + 1
    near = near if options.min_depth is None else options.min_depth
    far = far if options.max_depth is None else options.max_depth
    if not 0 < near < far < np.inf:
        raise InputError(f"the depth range {near:g} to {far:g} is empty, expected 0 < --min_depth < --max_depth")
    return near, far


def _depths(source: str) -> npt.NDArray[np.float64]:
    """Positive z-depths of the points in their host cameras."""
    cloud = read_any_cloud(source)
    if "depth" in cloud.scalars:
        depth = cloud.scalars["depth"].astype(np.float64)
    elif "inv_depth" in cloud.scalars or is_frame_bundle(source):
        with np.errstate(divide="ignore"):
            depth = 1.0 / cloud.scalars["inv_depth"].astype(np.float64)
    else:
        raise InputError(f"{source}: the points have no depth; name the .ply or .npz of an export, or its frame bundle")
    depth = depth[np.isfinite(depth) & (depth > 0)]
    if not len(depth):
        raise InputError(f"{source}: no point has a positive depth; give --min_depth and --max_depth")
    return depth


def _window(reader: EventReader, trajectory: Trajectory, options: EmvsBagOptions) -> tuple[float, float]:
    margin = 1e6 * options.t_margin_s
    start, stop = float(trajectory.t_us[0]) - margin, float(trajectory.t_us[-1]) + margin
    first, last = reader.time_range_us()
    if last < start or first > stop:
        raise InputError(f"{options.poses}: poses span {trajectory.t_us[0]:.0f} us to {trajectory.t_us[-1]:.0f} us, "
                         f"events {first} us to {last} us; they do not overlap, check clocks and units")
    return start, stop


def _write_bag(messages: RosMessages, recording: RosRecording, reader: EventReader, trajectory: Trajectory,
               window: tuple[float, float], options: EmvsBagOptions) -> dict[str, Any]:
    zero_us = min(max(float(reader.time_range_us()[0]), window[0]), float(trajectory.t_us[0]))
    frame, camera = f"{options.side}_event_camera", recording.camera
    events, number, last_ns = 0, 0, FIRST_STAMP_NS
    with new_bag(options.out_bag, options.overwrite) as bag, tqdm(
            unit=" events", unit_scale=True, desc="bag", file=sys.stderr, disable=None) as bar:
        info = bag.add_connection(options.camera_info_topic, CAMERA_INFO, typestore=messages.store)
        bag.write(info, FIRST_STAMP_NS, messages.camera_info(FIRST_STAMP_NS, camera, frame))
        arrays = bag.add_connection(options.event_topic, EVENT_ARRAY, typestore=messages.store)
        for part in recording.events(reader, *window, options.max_events_per_msg):
            bar.update(len(part))
            if not len(part):
                continue
            t_ns = stamps_ns(part.t_us, zero_us)
            data = messages.event_array(part, t_ns, (camera.width, camera.height), frame, number)
            bag.write(arrays, int(t_ns[0]), data)
            events, number, last_ns = events + len(part), number + 1, int(t_ns[-1])
        poses = bag.add_connection(options.pose_topic, POSE, typestore=messages.store)
        pose_ns = stamps_ns(trajectory.t_us, zero_us)
        for stamp, pose in zip(pose_ns.tolist(), trajectory.world_T_cam):
            bag.write(poses, stamp, messages.pose(stamp, pose, "world"))
        if not events:
            raise InputError(f"no event lies within {options.t_margin_s:g} s of the poses; check clocks and units")
    return {"events": events, "messages": number, "span_s": (max(last_ns, int(pose_ns[-1])) - FIRST_STAMP_NS) / 1e9}


def _write_conf(path: Path, summary: dict[str, Any], options: EmvsBagOptions) -> None:
    flags = {
        "bag_filename": options.out_bag, "event_topic": options.event_topic,
        "camera_info_topic": options.camera_info_topic, "pose_topic": options.pose_topic, "start_time_s": 0.0,
        "stop_time_s": summary["span_s"], "min_depth": summary["min_depth"], "max_depth": summary["max_depth"],
        "dimZ": options.dimZ,
    }
    with atomic_path(path) as temporary:
        temporary.write_text("".join(f"--{name}={value}\n" for name, value in flags.items()), encoding="utf-8")


def _path(name: str | None) -> Path | None:
    return None if name is None else Path(name)
