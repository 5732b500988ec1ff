"""One camera of a stereo bag (ROS 1): events, images and tracked poses as plain arrays, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.events.bags import EVENT_MESSAGES, bag_errors, open_bag, parse_event_message
from utils.events.types import Events
from utils.events.validate import Order, checked_events
from utils.trajectory_io import Trajectory

Image = npt.NDArray[np.uint8]
_IMAGES = ("sensor_msgs/msg/Image",)
_POSES = ("geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")
_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3}
_EVENTS_PER_BLOCK = 1 << 18


class Topics(NamedTuple):
    """Names of the topics of one camera; poses and camera info are None where there are none."""

    events: str
    images: str
    poses: str | None = None
    camera_info: str | None = None


class EventBlock(NamedTuple):
    """Events with stamps in whole microseconds, rounded down, and what is left of each stamp in nanoseconds."""

    events: Events
    remainder_ns: npt.NDArray[np.int64]


class BagCamera:
    """Read one camera of a bag; use it as a context manager.

    Args:
        path: the bag.

    Raises:
        InputError: the bag is damaged, or the package rosbags is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._bag = open_bag(path)
        from rosbags.typesys import Stores, get_typestore  # after open_bag, which says what to do if it is missing

        self._store = get_typestore(Stores.ROS1_NOETIC)
        self.topics = {connection.topic: connection.msgtype for connection in self._bag.connections}

    def __enter__(self) -> BagCamera:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._bag.close()

    def first_topic(self, candidates: list[str]) -> str:
        """Return the first of these topics that the bag has.

        Raises:
            InputError: it has none of them.
        """
        for topic in candidates:
            if topic in self.topics:
                return topic
        found = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self.topics.items()))
        raise InputError(f"{self.path}: no topic {' or '.join(candidates)} in the bag, found {found or 'nothing'}; "
                         "check the data set and the side")

    def count(self, topic: str) -> int:
        """Return how many messages a topic has."""
        return sum(connection.msgcount for connection in self._connections(topic))

    def images(self, topic: str) -> Iterator[tuple[int, Image]]:
        """Yield stamps in nanoseconds and 8-bit images, (H, W) gray or (H, W, 3) BGR.

        Raises:
            InputError: another kind of message or of pixel, or a damaged bag.
        """
        for message in self._messages(topic, _IMAGES):
            yield _stamp_ns(message), self._image(message, topic)

    def image_stamps_ns(self, topic: str) -> npt.NDArray[np.int64]:
        """Return the stamps (N,) of all images.

        Raises:
            InputError: there are none.
        """
        stamps = np.array([_stamp_ns(message) for message in self._messages(topic, _IMAGES)], np.int64)
        if not len(stamps):
            raise InputError(f"{self.path}: topic {topic} holds no images")
        return stamps

    def poses(self, topic: str) -> Trajectory | None:
        """Return tracked poses `world_T_body`; repeated stamps are left out; None if the topic holds no message.

        The stamps of the result are whole NANOseconds, because the differences of clocks need them.
        """
        rows = []
        for message in self._messages(topic, _POSES):
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            position, rotation = pose.position, pose.orientation
            rows.append((_stamp_ns(message), [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z,
                                              rotation.w]))
        if not rows:
            return None
        stamps = np.array([stamp for stamp, _ in rows], np.int64)
        kept = np.concatenate([[True], stamps[1:] != stamps[:-1]])
        try:
            return Trajectory(stamps[kept], np.array([row for _, row in rows], np.float64)[kept])
        except InputError as error:
            raise InputError(f"{self.path}: topic {topic}: {str(error).replace(' us', ' ns')}") from None

    def first_event_ns(self, topic: str, order: Order) -> int:
        """Return the stamp of the first event; "sort" looks through all events for the earliest.

        Raises:
            InputError: there are no events.
        """
        stamps = (message.t_ns for message in self._event_messages(topic) if len(message.t_ns))
        first = next(stamps, None)
        if first is None:
            raise InputError(f"{self.path}: topic {topic} holds no events")
        if order == "error":
            return int(first[0])
        return min(int(first.min()), *(int(t_ns.min()) for t_ns in stamps), int(first[0]))

    def event_blocks(self, topic: str, zero_ns: int, sensor_size: tuple[int, int],
                     order: Order) -> Iterator[EventBlock]:
        """Yield all events in order of time, with stamps counted from `zero_ns`.

        Args:
            topic: where the events are.
            zero_ns: subtracted from all stamps.
            sensor_size: (width, height) in pixels.
            order: "sort" loads all events and sorts them (stable), "error" refuses events that run backwards.

        Raises:
            InputError: see `utils.events.validate.checked_events`, or a damaged bag.
        """
        rows = previous_us = 0
        for x, y, t_ns, p in self._event_columns(topic, order):
            t_us, remainder_ns = np.divmod(t_ns - zero_ns, 1000)
            first = rows
            events = checked_events(x, y, t_us, p, where=lambda i: f"{self.path}: event {first + i} of {topic}",  # noqa: B023
                                    previous_us=previous_us, sensor_size=sensor_size)
            rows, previous_us = rows + len(events), int(t_us[-1])
            yield EventBlock(events, remainder_ns)

    def _event_columns(self, topic: str, order: Order) -> Iterator[tuple[Any, ...]]:
        parts: list[Any] = []
        held = 0
        limit = _EVENTS_PER_BLOCK if order == "error" else float("inf")
        for message in self._event_messages(topic):
            parts.append(message)
            held += len(message.x)
            if held >= limit:
                yield _joined(parts)
                parts, held = [], 0
        if held:
            columns = _joined(parts)
            if order == "sort":
                rows = np.argsort(columns[2], kind="stable")
                columns = tuple(column[rows] for column in columns)
            yield columns

    def _event_messages(self, topic: str) -> Iterator[Any]:
        connections = self._connections(topic)
        self._check_kind(topic, EVENT_MESSAGES)
        with bag_errors(self.path):
            for _, _, data in self._bag.messages(connections):
                yield parse_event_message(data, is_cdr=False)

    def _messages(self, topic: str, kinds: tuple[str, ...]) -> Iterator[Any]:
        self._check_kind(topic, kinds)
        with bag_errors(self.path):
            for connection, _, data in self._bag.messages(self._connections(topic)):
                yield self._store.deserialize_ros1(data, connection.msgtype)

    def _connections(self, topic: str) -> list[Any]:
        return [connection for connection in self._bag.connections if connection.topic == topic]

    def _check_kind(self, topic: str, kinds: tuple[str, ...]) -> None:
        kind = self.topics.get(topic)
        if kind not in kinds:
            raise InputError(f"{self.path}: topic {topic} is {kind or 'missing'}, expected {' or '.join(kinds)}")

    def _image(self, message: Any, topic: str) -> Image:
        channels = _CHANNELS.get(message.encoding)
        if channels is None:
            raise InputError(f"{self.path}: images of {topic} are {message.encoding!r}, expected 8 bits: "
                             f"{', '.join(_CHANNELS)}")
        height, width, step = int(message.height), int(message.width), int(message.step)
        data = np.frombuffer(message.data, np.uint8)
        if step < width * channels or len(data) < height * step:
            raise InputError(f"{self.path}: an image of {topic} has {len(data)} bytes, expected {height} rows of "
                             f"{max(step, width * channels)}")
        image = data[:height * step].reshape(height, step)[:, :width * channels].reshape(height, width, channels)
        if message.encoding == "rgb8":
            image = image[..., ::-1]
        return np.ascontiguousarray(image[..., 0] if channels == 1 else image)


def _joined(parts: list[Any]) -> tuple[Any, ...]:
    return tuple(np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "y", "t_ns", "p"))


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)
