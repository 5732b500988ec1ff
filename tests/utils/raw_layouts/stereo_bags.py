"""RPG and HKU: one bag of ROS 1 per recording with events and images of two cameras and poses of a tracked body."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.utils import bag_samples
from tests.utils.raw_layouts.recording import RawRecording
from utils.events import Events
from utils.preprocessing.poses import times_transform

EVENT_ARRAY = "dvs_msgs/msg/EventArray"
_MESSAGE_US = 10_000
_RECORD = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")])

Entry = tuple[int, str, str, bytes]
"""Receive stamp [ns], topic, type of message, payload."""


def event_message(events: Events, size: tuple[int, int], extra_ns: int = 0) -> bytes:
    """The payload of an EventArray, stamps `extra_ns` later than those of the events."""
    t_ns = events.t_us * 1000 + extra_ns
    records = np.empty(len(events), _RECORD)
    records["x"], records["y"], records["p"] = events.x, events.y, events.p
    records["sec"], records["nsec"] = np.divmod(t_ns, 10**9)
    stamp = divmod(int(t_ns[0]) if len(events) else 0, 10**9)
    return struct.pack("<III", 7, *stamp) + struct.pack("<I3s", 3, b"cam") + struct.pack(
        "<III", size[1], size[0], len(events)) + records.tobytes()


def event_entries(topic: str, recording: RawRecording, extra_ns: int) -> Iterator[Entry]:
    events = recording.events
    for start in range(int(events.t_us[0]), int(events.t_us[-1]) + 1, _MESSAGE_US):
        part = events.between(start, start + _MESSAGE_US)
        yield (start + _MESSAGE_US) * 1000, topic, EVENT_ARRAY, event_message(part, recording.size, extra_ns)


def image_entries(store: Any, topic: str, recording: RawRecording) -> Iterator[Entry]:
    """Images whose rows are three bytes longer than their pixels."""
    types, kind = store.types, "sensor_msgs/msg/Image"
    for t_us, image in zip(recording.stamps_us.tolist(), recording.images):
        padded = np.pad(image, ((0, 0), (0, 3)))
        message = types[kind](header(store, t_us), image.shape[0], image.shape[1], "mono8", 0, padded.shape[1],
                              padded.ravel())
        yield t_us * 1000 + 500, topic, kind, bytes(store.serialize_ros1(message, kind))


def pose_entries(store: Any, topic: str, recording: RawRecording, cam_T_body: np.ndarray, kind: str) -> Iterator[Entry]:
    types = store.types
    for t_us, row in zip(recording.poses_us.tolist(), times_transform(recording.world_T_cam, cam_T_body).tolist()):
        pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*row[:3]),
                                               types["geometry_msgs/msg/Quaternion"](*row[3:]))
        if kind.endswith("PoseStamped"):
            message = types[kind](header(store, t_us), pose)
        else:
            zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
            message = types[kind](header(store, t_us), "body",
                                  types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
                                  types["geometry_msgs/msg/TwistWithCovariance"](
                                      types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)))
        yield t_us * 1000 + 700, topic, kind, bytes(store.serialize_ros1(message, kind))


def info_entry(store: Any, topic: str, recording: RawRecording, K: list[float]) -> Entry:
    """Camera info with `K` = fx fy cx cy."""
    types, kind = store.types, "sensor_msgs/msg/CameraInfo"
    matrix = np.array([K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1.0])
    message = types[kind](header(store, int(recording.stamps_us[0])), recording.size[1], recording.size[0],
                          "plumb_bob", np.zeros(5), matrix, np.eye(3).ravel(), np.zeros(12), 1, 1,
                          types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False))
    return int(recording.stamps_us[0]) * 1000, topic, kind, bytes(store.serialize_ros1(message, kind))


def header(store: Any, t_us: int) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(t_us * 1000, 10**9))
    return types["std_msgs/msg/Header"](seq=1, stamp=stamp, frame_id="cam")


def write_bag(path: Path, store: Any, entries: list[Entry], compression: str | None = "lz4") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with bag_samples.open_writer(path, 1, compression, "") as writer:
        connections: dict[str, Any] = {}
        for received, topic, kind, data in sorted(entries, key=lambda entry: entry[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, data)
    return path


def write_rpg(root: Path, recording: RawRecording, cam_T_body: np.ndarray, name: str = "desk_test",
              prefix: str = "/davis_{side}", extra_ns: int = 0, skip: tuple[str, ...] = ()) -> Path:
    """Write `<name>.bag`; `cam_T_body` (4, 4) belongs to the left camera; topics in `skip` are left out."""
    store = bag_samples.typestore("dvs_msgs", 1)
    entries: list[Entry] = []
    for side, view in (("left", recording), ("right", recording.right())):
        base = prefix.format(side=side)
        entries += event_entries(f"{base}/events", view, extra_ns)
        entries += image_entries(store, f"{base}/image_raw", view)
    entries += pose_entries(store, "/optitrack/davis_stereo", recording, cam_T_body, "geometry_msgs/msg/PoseStamped")
    return write_bag(root / f"{name}.bag", store, [entry for entry in entries if entry[1] not in skip])


def write_rpg_simulation(root: Path, recording: RawRecording, K: list[float]) -> Path:
    """Write the one simulated recording, which brings its camera in the bag."""
    store = bag_samples.typestore("dvs_msgs", 1)
    entries = [*event_entries("/davis/left/events", recording, 0),
               *image_entries(store, "/davis/left/image_raw", recording),
               info_entry(store, "/davis/left/camera_info", recording, K),
               *pose_entries(store, "/davis/left/pose", recording, np.eye(4), "geometry_msgs/msg/PoseStamped")]
    return write_bag(root / "simulation_3planes.bag", store, entries)


def write_hku(root: Path, recording: RawRecording, cam_T_body: np.ndarray, name: str = "test_walk") -> Path:
    """Write `<name>.bag`; `cam_T_body` (4, 4) belongs to the left camera."""
    store = bag_samples.typestore("dvs_msgs", 1)
    entries: list[Entry] = []
    for side, view in (("left", recording), ("right", recording.right())):
        entries += event_entries(f"/davis_{side}/events", view, 0)
        entries += image_entries(store, f"/davis_{side}/image_raw", view)
    entries += pose_entries(store, "/cpy_uav/viconros/odometry", recording, cam_T_body, "nav_msgs/msg/Odometry")
    return write_bag(root / f"{name}.bag", store, entries)
