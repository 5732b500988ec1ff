"""Events in ROS bags without ROS: `dvs_msgs` and `prophesee_event_msgs`, in bags of ROS 1 and ROS 2.

An `EventArray` message is a header, height, width and an array of events (x, y, time, polarity). The array is viewed
as packed NumPy records, never as objects: 13 bytes an event in ROS 1; in ROS 2 (CDR) fields are aligned to their size.
"""

from __future__ import annotations

import contextlib
import importlib
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.events.reader import SequentialReader
from utils.events.streams import choose_stream
from utils.events.types import Events
from utils.events.validate import Order, TimeUnit, to_microseconds

EVENT_MESSAGES = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
_EVENTS_PER_BLOCK = 1 << 18
_RECORD_ROS1 = np.dtype({"names": ["x", "y", "sec", "nsec", "p"], "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
                         "offsets": [0, 2, 4, 8, 12], "itemsize": 13})
# What the parsers of bags and of their compression raise on damage; none of it may reach the user as a traceback.
_DAMAGE = (OSError, EOFError, ValueError, KeyError, IndexError, TypeError, AttributeError, AssertionError,
           ArithmeticError, RuntimeError, MemoryError, struct.error, sqlite3.Error)


class EventMessage(NamedTuple):
    """The content of one message: the sensor (0 where not said) and columns as views of the message."""

    width: int
    height: int
    x: npt.NDArray[np.uint16]
    y: npt.NDArray[np.uint16]
    t_ns: npt.NDArray[np.int64]
    p: npt.NDArray[np.uint8]


@contextlib.contextmanager
def bag_errors(path: Path) -> Iterator[None]:
    """Turn what the bag library raises on damaged bags into one `InputError` that names the bag."""
    from ruamel.yaml.error import YAMLError

    damage: tuple[type[Exception], ...] = (*_bag_reader_errors(), YAMLError, *_storage_errors(), *_DAMAGE)
    try:
        yield
    except damage as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        advice = "record or copy it again"
        if "index" in reason.lower():
            advice = "it was probably not closed; repair it with `rosbag reindex`"
        raise InputError(f"{path}: damaged or unreadable bag ({reason}); {advice}") from error


def open_bag(path: Path) -> Any:
    """Open a bag of ROS 1 (`.bag`) or ROS 2 (folder, `.mcap`, `.db3`) for reading; use it with `bag_errors`.

    Returns:
        An open reader of the package rosbags, with `connections` and `messages(connections, start)`.

    Raises:
        InputError: the bag is damaged, or the package rosbags is not installed.
    """
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise InputError(f"{path}: reading bags needs the package rosbags; get it with pip install rosbags") from error
    with bag_errors(path):
        is_ros2 = path.is_dir() or path.suffix in (".mcap", ".db3")
        bag: Any = rosbag2.Reader(path) if is_ros2 else rosbag1.Reader(path)
        bag.open()
    return bag


def parse_event_message(data: bytes, is_cdr: bool) -> EventMessage:
    """View the payload of an `EventArray` message as columns.

    Args:
        data: the serialised message.
        is_cdr: the message comes from ROS 2 (CDR), not from ROS 1.

    Raises:
        ValueError: the payload does not have the length that its counts announce.
    """
    return _parse_cdr(data) if is_cdr else _parse_ros1(data)


def _parse_ros1(data: bytes) -> EventMessage:
    (name_length,) = struct.unpack_from("<I", data, 12)
    height, width, count = struct.unpack_from("<III", data, 16 + name_length)
    start = 28 + name_length
    if len(data) != start + 13 * count:
        raise ValueError(f"an event message of {len(data)} bytes announces {count} events")
    events = np.frombuffer(data, _RECORD_ROS1, count, start) if count else np.empty(0, _RECORD_ROS1)
    t_ns = events["sec"].astype(np.int64) * 1_000_000_000 + events["nsec"]
    return EventMessage(width, height, events["x"], events["y"], t_ns, events["p"])


def _parse_cdr(data: bytes) -> EventMessage:
    if not data[1] & 1:
        raise ValueError("an event message is big-endian, which is not read")
    body = memoryview(data)[4:]  # alignment counts from behind the encapsulation header
    (name_length,) = struct.unpack_from("<I", body, 8)
    start = -(-(12 + name_length) // 4) * 4
    height, width, count = struct.unpack_from("<III", body, start)
    start += 12
    if len(body) - start - (16 * count - 3 if count else 0) not in range(4):
        raise ValueError(f"an event message of {len(data)} bytes announces {count} events")
    # The first event starts aligned, the others two bytes before: x and y of event k lie at 16 k - 2 and 16 k.
    padded = np.frombuffer(bytes(2) + bytes(body[start:start + 16 * count]) + bytes(16), np.uint8)
    early, late = padded[:16 * count].reshape(count, 16), padded[2:2 + 16 * count].reshape(count, 16)
    x, y = early[:, 0:2].copy().view("<u2")[:, 0], early[:, 2:4].copy().view("<u2")[:, 0]
    if count:
        x[0], y[0] = late[0, 0:4].copy().view("<u2")
    stamps = late[:, 4:12].copy().view("<i4")
    t_ns = stamps[:, 0].astype(np.int64) * 1_000_000_000 + stamps[:, 1].view(np.uint32)
    return EventMessage(width, height, x, y, t_ns, late[:, 12].copy())


class BagEventReader(SequentialReader):
    """Stream of the events of one topic of a bag.

    Stamps are those of the events, in microseconds since the epoch of the recording's clock. Arguments as in
    `open_events`; `stream` picks the topic where a bag has several.

    Raises:
        InputError: no topic with events, several and no choice, or a damaged bag; see also `checked_events`.
    """

    format_name = "ROS bag"

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, time_unit: TimeUnit | None, order: Order,
                 stream: str | None = None) -> None:
        if time_unit is not None:
            raise InputError(f"{path}: stamps in bags have a fixed unit, time_unit={time_unit!r} makes no sense")
        super().__init__(path, sensor_size, order)
        self._bag = open_bag(path)
        try:
            with bag_errors(path):
                self.topic, self._connections = self._choose_topic(stream)
                self._is_cdr = hasattr(self._connections[0].ext, "serialization_format")
                self.format_name = f"ROS {2 if self._is_cdr else 1} bag, topic {self.topic}"
                # Where each block starts: receive stamp [ns] and how many messages of that stamp come before.
                self._starts: list[tuple[int | None, int]] = [(None, 0)]
                self._next_block = 0
                self._messages = self._messages_from(0)
                self.sensor_size = sensor_size if sensor_size is not None else self._read_sensor_size()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the bag."""
        super().close()
        with contextlib.suppress(*_bag_reader_errors()):
            self._bag.close()

    def _choose_topic(self, stream: str | None) -> tuple[str, list[Any]]:
        found: dict[str, list[Any]] = {}
        for connection in self._bag.connections:
            if connection.msgtype in EVENT_MESSAGES:
                found.setdefault(connection.topic, []).append(connection)
        if not found:
            topics = sorted({f"{item.topic} ({item.msgtype})" for item in self._bag.connections})
            raise InputError(f"{self.path}: the bag has no topic with events (dvs_msgs or prophesee_event_msgs "
                             f"EventArray), found {', '.join(topics) or 'nothing'}")
        topic = choose_stream(list(found), stream, str(self.path))
        return topic, found[topic]

    def _read_sensor_size(self) -> tuple[int, int] | None:
        for _, _, data in self._bag.messages(self._connections):
            message = parse_event_message(data, self._is_cdr)
            return (message.width, message.height) if message.width and message.height else None
        return None

    def _messages_from(self, block: int) -> Iterator[tuple[Any, int, bytes]]:
        stamp, passed = self._starts[block]
        messages = self._bag.messages(self._connections, start=stamp)
        for _ in range(passed):
            next(messages)
        return messages

    def _decode(self, block: int) -> Events | None:
        with bag_errors(self.path):
            if block != self._next_block:
                self._messages = self._messages_from(block)
            parts, count = [], 0
            stamp, passed = self._starts[block]
            for _, received, data in self._messages:
                passed = passed + 1 if received == stamp else 1
                stamp = received
                parts.append(parse_event_message(data, self._is_cdr))
                count += len(parts[-1].x)
                if count >= _EVENTS_PER_BLOCK:
                    break
        self._next_block = block + 1
        if not parts:
            return None
        if block + 1 == len(self._starts):
            self._starts.append((stamp, passed))
        where = lambda i: f"{self.path}: event {self._rows_before(block) + i} of {self.topic}"  # noqa: E731
        x, y, t_ns, p = (np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "y", "t_ns", "p"))
        return self._check(x, y, to_microseconds(t_ns, "ns", where), p, block, where)


def _bag_reader_errors() -> tuple[type[Exception], ...]:
    from rosbags import rosbag1, rosbag2
    from rosbags.serde import SerdeError

    return rosbag1.ReaderError, rosbag2.ReaderError, SerdeError


def _storage_errors() -> tuple[type[Exception], ...]:
    """Return the errors of the packages below rosbags, which depend on its version."""
    found: list[type[Exception]] = []
    for module_name, error_name in (("backports.zstd", "ZstdError"), ("compression.zstd", "ZstdError"),
                                    ("apsw", "Error")):
        with contextlib.suppress(ImportError):
            found.append(getattr(importlib.import_module(module_name), error_name))
    return tuple(found)
