"""Bags with events, written with the package rosbags and its own serialisation, one Python object per event."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from utils.events import Events

TIME_FIELDS = "uint16 x\nuint16 y\n{time} ts\nbool polarity\n"
ARRAY_FIELDS = "std_msgs/Header header\nuint32 height\nuint32 width\n{package}/Event[] events\n"


def typestore(package: str, ros: int) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    time = "time" if ros == 1 else "builtin_interfaces/Time"
    types = get_types_from_msg(TIME_FIELDS.format(time=time), f"{package}/msg/Event")
    types.update(get_types_from_msg(ARRAY_FIELDS.format(package=package), f"{package}/msg/EventArray"))
    store.register(types)
    return store


def message(store: Any, package: str, ros: int, events: Events, frame: str, size: tuple[int, int]) -> tuple[bytes, str]:
    """One serialised EventArray and its type."""
    types = store.types
    time = types["builtin_interfaces/msg/Time"]
    stamp = time(*divmod(int(events.t_us[0]) * 1000 if len(events) else 0, 10**9))
    header: dict[str, Any] = {"stamp": stamp, "frame_id": frame} | ({"seq": 7} if ros == 1 else {})
    rows = [types[f"{package}/msg/Event"](x, y, time(*divmod(t * 1000, 10**9)), bool(p))
            for x, y, t, p in zip(*(getattr(events, name).tolist() for name in ("x", "y", "t_us", "p")))]
    kind = f"{package}/msg/EventArray"
    array = types[kind](types["std_msgs/msg/Header"](**header), size[1], size[0], rows)
    return bytes(store.serialize_ros1(array, kind) if ros == 1 else store.serialize_cdr(array, kind)), kind


def write_bag(path: Path, topics: dict[str, Sequence[Events]], *, ros: int = 1, package: str = "dvs_msgs",
              frame: str = "cam", size: tuple[int, int] = (64, 48), compression: str | None = None,
              storage: str = "sqlite3", other_topics: Sequence[str] = ()) -> Path:
    """Write the messages of each topic; each is received 1 ms after the last of its events."""
    store = typestore(package, ros)
    with open_writer(path, ros, compression, storage) as writer:
        entries: list[tuple[int, Any, bytes]] = []
        for topic, parts in topics.items():
            connection = writer.add_connection(topic, f"{package}/msg/EventArray", typestore=store)
            for part in parts:
                received = (int(part.t_us[-1]) + 1000) * 1000 if len(part) else 10**6
                entries.append((received, connection, message(store, package, ros, part, frame, size)[0]))
        for topic in other_topics:
            connection = writer.add_connection(topic, "std_msgs/msg/String", typestore=store)
            text = store.types["std_msgs/msg/String"]("hello")
            data = (store.serialize_ros1 if ros == 1 else store.serialize_cdr)(text, "std_msgs/msg/String")
            entries.append((10**6, connection, bytes(data)))
        for received, connection, data in sorted(entries, key=lambda entry: entry[0]):
            writer.write(connection, received, data)
    return path


def open_writer(path: Path, ros: int, compression: str | None, storage: str) -> Any:
    from rosbags import rosbag1, rosbag2

    if ros == 1:
        bag1 = rosbag1.Writer(path)
        if compression:
            bag1.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        return bag1
    bag2 = rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin[storage.upper()])
    if compression:
        bag2.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    return bag2


def pieces(events: Events, count: int) -> list[Events]:
    """Cut into `count` messages of different length, some of them empty."""
    rng = np.random.default_rng(count)
    borders = [0, *np.sort(rng.integers(0, len(events) + 1, count - 1)).tolist(), len(events)]
    return [events[first:last] for first, last in zip(borders, borders[1:])]
