"""Messages of ROS 1 as bytes; events are packed NumPy records, never one object per event."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.calibration import Calibration
from utils.clouds.cloud import PointCloud
from utils.events.types import Events
from utils.undistort import undistorted_intrinsics

NS_PER_S = 1_000_000_000
FIRST_STAMP_NS = NS_PER_S
"""Bags begin at one second, because a stamp of zero counts as unset in ROS."""
_LAST_STAMP_NS = (2**32 - 1) * NS_PER_S

EVENT_ARRAY, POSE, CAMERA_INFO, CLOUD = (
    "dvs_msgs/msg/EventArray", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/PointCloud2")
_FLOAT32 = 7  # of sensor_msgs/PointField


@dataclass(frozen=True)
class EventSchema:
    """One of the two layouts of `dvs_msgs/EventArray` in use, by the beginning of its MD5 sum.

    Attributes:
        event, array: the message definitions.
        record: one event as a packed record of 13 bytes.
        size_first: whether height and width come before the events.
    """

    event: str
    array: str
    record: np.dtype[Any]
    size_first: bool


_SIZE = "uint32 height\nuint32 width\n"
EVENT_SCHEMAS = {
    "5e8": EventSchema("uint16 x\nuint16 y\ntime ts\nbool polarity\n",
                       f"std_msgs/Header header\n{_SIZE}dvs_msgs/Event[] events\n",
                       np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")]), True),
    "732": EventSchema("time ts\nuint16 x\nuint16 y\nbool polarity\n",
                       f"std_msgs/Header header\ndvs_msgs/Event[] events\n{_SIZE}",
                       np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")]), False),
}


class RosMessages:
    """Serialises the messages that this project writes.

    Args:
        schema: layout of the event messages, a key of `EVENT_SCHEMAS`.

    Raises:
        InputError: the package rosbags is not installed, or there is no such layout.
    """

    def __init__(self, schema: str = "5e8") -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as error:
            raise InputError("writing bags needs the package rosbags; get it with pip install rosbags") from error
        if schema not in EVENT_SCHEMAS:
            raise InputError(f"event array schema must be one of {', '.join(EVENT_SCHEMAS)}, found {schema!r}")
        self.schema = EVENT_SCHEMAS[schema]
        self.store = get_typestore(Stores.ROS1_NOETIC)
        self.store.register({**get_types_from_msg(self.schema.event, "dvs_msgs/msg/Event"),
                             **get_types_from_msg(self.schema.array, EVENT_ARRAY)})

    def event_array(self, events: Events, t_ns: npt.NDArray[np.int64], size: tuple[int, int], frame_id: str,
                    seq: int) -> bytes:
        """An event array stamped with its first event.

        Args:
            events: at least none; `t_us` is not used.
            t_ns: `(N,)` stamps in nanoseconds.
            size: (width, height) in pixels.
            frame_id: name of the camera's frame.
            seq: running number.
        """
        rows = np.empty(len(events), self.schema.record)
        rows["x"], rows["y"], rows["p"] = events.x, events.y, events.p
        rows["sec"], rows["nsec"] = np.divmod(t_ns, NS_PER_S)
        name = frame_id.encode()
        seconds, nanoseconds = divmod(int(t_ns[0]) if len(t_ns) else 0, NS_PER_S)
        header = struct.pack("<IIII", seq, seconds, nanoseconds, len(name)) + name
        body, extent = struct.pack("<I", len(rows)) + rows.tobytes(), struct.pack("<II", size[1], size[0])
        return header + (extent + body if self.schema.size_first else body + extent)

    def pose(self, t_ns: int, world_T_cam: npt.NDArray[np.float64], frame_id: str) -> bytes:
        """A camera-to-world pose `tx ty tz qx qy qz qw`."""
        types = self.store.types
        tx, ty, tz, qx, qy, qz, qw = world_T_cam.tolist()
        pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](tx, ty, tz),
                                               types["geometry_msgs/msg/Quaternion"](qx, qy, qz, qw))
        return self._serialize(types[POSE](self._header(t_ns, frame_id), pose), POSE)

    def camera_info(self, t_ns: int, camera: Calibration, frame_id: str) -> bytes:
        """Camera matrix, distortion, and the projection matrix of the undistorted camera; no rectifying rotation."""
        model = {"none": "plumb_bob", "radtan": "plumb_bob", "fisheye": "equidistant"}[camera.distortion_model]
        D = np.array(camera.coefficients, dtype=np.float64)
        if model == "plumb_bob":
            D = np.concatenate([D, np.zeros(5 - len(D))])
        fx, fy, cx, cy = undistorted_intrinsics(camera).tolist()
        P = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], dtype=np.float64)
        region = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        message = self.store.types[CAMERA_INFO](
            self._header(t_ns, frame_id), camera.height, camera.width, model, D, camera.camera_matrix.reshape(-1),
            np.eye(3).reshape(-1), P, 0, 0, region)
        return self._serialize(message, CAMERA_INFO)

    def cloud(self, t_ns: int, cloud: PointCloud, frame_id: str) -> bytes:
        """The finite points as float32 x, y, z at the offsets 0, 4, 8; 12 bytes a point."""
        types = self.store.types
        points = np.ascontiguousarray(cloud.points[cloud.finite_mask()], "<f4")
        fields = [types["sensor_msgs/msg/PointField"](axis, 4 * i, _FLOAT32, 1) for i, axis in enumerate("xyz")]
        message = types[CLOUD](self._header(t_ns, frame_id), 1, len(points), fields, False, 12, 12 * len(points),
                               points.view(np.uint8).reshape(-1), True)
        return self._serialize(message, CLOUD)

    def _header(self, t_ns: int, frame_id: str) -> Any:
        stamp = self.store.types["builtin_interfaces/msg/Time"](*divmod(int(t_ns), NS_PER_S))
        return self.store.types["std_msgs/msg/Header"](0, stamp, frame_id)

    def _serialize(self, message: Any, kind: str) -> bytes:
        return bytes(self.store.serialize_ros1(message, kind))


def stamps_ns(t_us: npt.ArrayLike, zero_us: float) -> npt.NDArray[np.int64]:
    """Nanoseconds of a bag in which `zero_us` is one second.

    Raises:
        InputError: stamps before zero or later than the 136 years that a stamp of ROS can hold.
    """
    shifted = np.rint((np.asarray(t_us, dtype=np.float64) - zero_us) * 1000) + FIRST_STAMP_NS
    if shifted.size and not (shifted.min() > 0 and shifted.max() < _LAST_STAMP_NS):
        raise InputError(f"stamps span {(shifted.max() - shifted.min()) / NS_PER_S:.6g} s, which a bag cannot hold; "
                         "check their unit")
    return shifted.astype(np.int64)


@contextlib.contextmanager
def new_bag(path: str | os.PathLike[str], overwrite: bool) -> Iterator[Any]:
    """Yield a writer of the package rosbags; the bag appears under its name when the block ends without an error.

    Raises:
        InputError: the bag exists and may not be replaced, or its name does not end in `.bag`.
        OutputError: it cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() != ".bag":
        raise InputError(f"{target}: a bag of ROS 1 ends in .bag")
    if target.exists() and not overwrite:
        raise InputError(f"{target} exists; pass --overwrite to replace it")
    from rosbags.rosbag1 import Writer

    with atomic_path(target) as temporary:
        temporary.unlink()  # the writer only makes new files
        with Writer(temporary) as bag:
            yield bag
