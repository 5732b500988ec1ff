"""The camera of a bag: `sensor_msgs/CameraInfo` of ROS 1 and 2 as a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from devo.errors import InputError
from utils.calibration import Calibration, DistortionModel
from utils.events.bags import bag_errors, open_bag
from utils.events.streams import choose_stream
from utils.ros_output.messages import CAMERA_INFO

_MODELS: dict[str, tuple[DistortionModel, int]] = {
    "plumb_bob": ("radtan", 5), "rational_polynomial": ("radtan", 5), "equidistant": ("fisheye", 4),
    "fisheye": ("fisheye", 4), "": ("none", 0)}


def read_camera_info(path: Path, topic: str | None = None, event_topic: str | None = None) -> Calibration:
    """Read the first camera info of a topic.

    Args:
        path: bag of ROS 1 or 2.
        topic: of the camera info, or a part of its name; None takes the one beside `event_topic`, else the only one.
        event_topic: topic of the events that the camera belongs to.

    Raises:
        InputError: no such topic, several to choose from, or a camera without calibration.
    """
    bag = open_bag(path)
    try:
        with bag_errors(path):
            names = sorted({item.topic for item in bag.connections if item.msgtype == CAMERA_INFO})
        if not names:
            raise InputError(f"{path}: the bag has no camera info; pass --calib FILE, or --intrinsics and --image_size")
        if topic is None and event_topic is not None:
            beside = event_topic.rsplit("/", 1)[0] + "/camera_info"
            topic = beside if beside in names else None
        chosen = choose_stream(names, topic, str(path))
        with bag_errors(path):
            connections = [item for item in bag.connections if item.topic == chosen]
            connection, _, data = next(iter(bag.messages(connections)))
            message = _deserialize(connection, data)
    finally:
        bag.close()
    try:
        return _calibration(message)
    except InputError as error:
        raise InputError(f"{path}: topic {chosen}: {error}; pass --calib FILE instead") from error


def _deserialize(connection: Any, data: bytes) -> Any:
    from rosbags.typesys import Stores, get_typestore

    if hasattr(connection.ext, "serialization_format"):
        return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, CAMERA_INFO)
    return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1(data, CAMERA_INFO)


def _calibration(message: Any) -> Calibration:
    K = np.asarray(getattr(message, "K", getattr(message, "k", None)), dtype=np.float64)
    D = np.asarray(getattr(message, "D", getattr(message, "d", None)), dtype=np.float64)
    if not K.any():
        raise InputError("the camera is not calibrated (K is zero)")
    if message.distortion_model not in _MODELS:
        raise InputError(f"the distortion model {message.distortion_model!r} is not known, expected "
                         f"{', '.join(name for name in _MODELS if name)}")
    model, count = _MODELS[message.distortion_model]
    if not D.any():
        model, count = "none", 0
    if D[count:].any():
        raise InputError(f"the model {message.distortion_model} has {np.count_nonzero(D)} coefficients, only the first "
                         f"{count} can be used")
    fx, fy, cx, cy = (float(K[index]) for index in (0, 4, 2, 5))
    return Calibration(int(message.width), int(message.height), fx, fy, cx, cy, model, tuple(D[:count].tolist()))
