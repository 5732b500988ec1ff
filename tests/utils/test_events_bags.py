"""Events in bags of ROS 1 and ROS 2: equal to what the bag library's own serialisation wrote, and damage."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="bags need the optional package rosbags")

from devo.errors import InputError
from tests.utils.bag_samples import message, pieces, typestore, write_bag
from tests.utils.event_samples import random_events, same
from utils.events import Events, bags, open_events
from utils.events.bags import BagEventReader, parse_event_message

EPOCH_US = 1_600_000_000_000_000
PACKAGES = ["dvs_msgs", "prophesee_event_msgs"]


def read_all(path: Path, **options: object) -> Events:
    with open_events(path, **options) as reader:  # type: ignore[arg-type]
        events = Events.concatenate(list(reader.chunks()))
        assert len(reader) == len(events)
        assert reader.time_range_us() == (events.t_us[0], events.t_us[-1])
        return events


@pytest.mark.parametrize("package", PACKAGES)
@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 17])
@pytest.mark.parametrize("frame", ["", "a", "ab", "cam0", "camera"])
def test_payload_as_the_library_writes_it(package: str, ros: int, count: int, frame: str) -> None:
    """Every alignment of the first event and every end of the last."""
    events = random_events(count, seed=count, start_us=EPOCH_US, longest_gap_us=10**6)
    data, _ = message(typestore(package, ros), package, ros, events, frame, (640, 480))
    found = parse_event_message(data, is_cdr=ros == 2)
    assert (found.width, found.height) == (640, 480)
    assert found.x.tolist() == events.x.tolist()
    assert found.y.tolist() == events.y.tolist()
    assert found.t_ns.tolist() == (events.t_us * 1000).tolist()
    assert found.p.tolist() == events.p.tolist()


@pytest.mark.parametrize("ros", [1, 2])
def test_payload_of_another_length_is_refused(ros: int) -> None:
    data, _ = message(typestore("dvs_msgs", ros), "dvs_msgs", ros, random_events(9), "cam", (64, 48))
    for length in (len(data) - 13, len(data) - 30):
        with pytest.raises(ValueError, match="announces 9 events"):
            parse_event_message(data[:length], is_cdr=ros == 2)


@pytest.mark.parametrize(("name", "options"), [
    ("e.bag", {}), ("e.bag", {"compression": "lz4"}), ("e.bag", {"compression": "bz2"}),
    ("e.bag", {"package": "prophesee_event_msgs"}),
    ("folder", {"ros": 2}), ("folder", {"ros": 2, "compression": "zstd"}),
    ("folder", {"ros": 2, "storage": "mcap", "package": "prophesee_event_msgs"}),
])
def test_bags_come_back(name: str, options: dict[str, object], tmp_path: Path,
                        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bags, "_EVENTS_PER_BLOCK", 150)
    events = random_events(1200, seed=1, start_us=EPOCH_US)
    path = write_bag(tmp_path / name, {"/dvs/events": pieces(events, 20)}, other_topics=["/note"], **options)  # type: ignore[arg-type]
    assert same(read_all(path), events)
    with open_events(path) as reader:
        assert reader.sensor_size == (64, 48)
        assert reader.format_name == f"ROS {options.get('ros', 1)} bag, topic /dvs/events"
        first = int(events.t_us[0])
        for start, stop in ((9000, 12_000), (0, 500), (4000, 4001), (20_000, 10**9)):  # forwards and back
            assert same(reader.read(first + start, first + stop), events.between(first + start, first + stop))


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_files_of_ros2_without_their_folder(storage: str, tmp_path: Path) -> None:
    events = random_events(100, seed=2)
    folder = write_bag(tmp_path / "bag", {"/e": [events]}, ros=2, storage=storage)
    (file,) = [path for path in folder.iterdir() if path.suffix in (".db3", ".mcap")]
    assert same(read_all(file.rename(tmp_path / f"alone{file.suffix}")), events)


def test_one_of_several_topics(tmp_path: Path) -> None:
    left, right = random_events(80, seed=3), random_events(90, seed=4)
    path = write_bag(tmp_path / "e.bag", {"/davis/left/events": pieces(left, 3), "/davis/right/events": [right]})
    with pytest.raises(InputError, match=r"several event streams \(/davis/left/events, /davis/right/events\)"):
        open_events(path)
    assert same(read_all(path, stream="left"), left)
    assert same(read_all(path, stream="/davis/right/events"), right)
    with pytest.raises(InputError, match="no event stream is called 'top'"):
        open_events(path, stream="top")
    with pytest.raises(InputError, match="more than one event stream fits 'davis'"):
        open_events(path, stream="davis")


def test_bags_without_events(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no topic with events .* found /note \(std_msgs/msg/String\)"):
        open_events(write_bag(tmp_path / "a.bag", {}, other_topics=["/note"]))
    with pytest.raises(InputError, match="holds no events"):
        open_events(write_bag(tmp_path / "b.bag", {"/e": [Events.empty()]}))
    with pytest.raises(InputError, match="fixed unit"):
        open_events(write_bag(tmp_path / "c.bag", {"/e": [random_events(4)]}), time_unit="s")


def test_unsorted_messages(tmp_path: Path) -> None:
    early, late = random_events(50, seed=5), random_events(50, seed=6, start_us=5000)
    joined = Events.concatenate([late, early])
    path = write_bag(tmp_path / "e.bag", {"/e": [joined]})
    with pytest.raises(InputError, match=r"event 50 of /e: time stamps are not sorted"):
        open_events(path)
    assert same(read_all(path, on_unsorted="sort"), Events.concatenate([early, late]))


def test_nanoseconds_are_rounded_to_the_nearest_microsecond(tmp_path: Path) -> None:
    data, kind = message(typestore("dvs_msgs", 1), "dvs_msgs", 1, random_events(2, longest_gap_us=0), "cam", (64, 48))
    shifted = bytearray(data)
    shifted[-5:-1] = (1499).to_bytes(4, "little")
    shifted[-18:-14] = (499).to_bytes(4, "little")
    from rosbags import rosbag1

    with rosbag1.Writer(tmp_path / "e.bag") as writer:
        writer.write(writer.add_connection("/e", kind, typestore=typestore("dvs_msgs", 1)), 5, bytes(shifted))
    assert read_all(tmp_path / "e.bag").t_us.tolist() == [0, 1]


def test_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "e.bag", {"/e": [random_events(4)]})
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(InputError, match="pip install rosbags"):
        open_events(path)


def test_a_bag_that_was_not_closed(tmp_path: Path) -> None:
    whole = write_bag(tmp_path / "e.bag", {"/e": [random_events(300)]}).read_bytes()
    header = whole.index(b"index_pos=") + len(b"index_pos=")
    (tmp_path / "e.bag.active").write_bytes(whole[:header] + bytes(8) + whole[header + 8:])
    with pytest.raises(InputError, match="rosbag reindex"):
        open_events(tmp_path / "e.bag.active")


def outcome(path: Path, events: Events) -> str:
    """What reading a damaged bag comes to; anything but an `InputError` or events is a failure of the test."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = read_all(path)
    except InputError as error:
        assert "\n" not in str(error)
        return "error"
    return "same" if same(found, events) else "other"


@pytest.mark.parametrize(("name", "options"), [("e.bag", {}), ("e.bag", {"compression": "lz4"}),
                                               ("folder", {"ros": 2}), ("folder", {"ros": 2, "storage": "mcap"})])
def test_flipped_bytes_never_crash(name: str, options: dict[str, object], tmp_path: Path) -> None:
    """1000 flips in all: an error, the events, or values that passed all checks (bags carry no checksums)."""
    events = random_events(150, seed=7)
    path = write_bag(tmp_path / name, {"/e": pieces(events, 4)}, **options)  # type: ignore[arg-type]
    file = path if path.is_file() else next(item for item in path.iterdir() if item.suffix in (".db3", ".mcap"))
    whole = file.read_bytes()
    rng = np.random.default_rng(8)
    outcomes = set()
    for position, value in zip(rng.integers(0, len(whole), 250), rng.integers(1, 256, 250)):
        damaged = bytearray(whole)
        damaged[position] ^= int(value)
        file.write_bytes(damaged)
        outcomes.add(outcome(path, events))
    assert outcomes >= {"error", "same"}


@pytest.mark.parametrize(("name", "options"), [("e.bag", {}), ("folder", {"ros": 2}),
                                               ("folder", {"ros": 2, "storage": "mcap"})])
def test_truncation_is_noticed(name: str, options: dict[str, object], tmp_path: Path) -> None:
    events = random_events(150, seed=9)
    path = write_bag(tmp_path / name, {"/e": pieces(events, 4)}, **options)  # type: ignore[arg-type]
    file = path if path.is_file() else next(item for item in path.iterdir() if item.suffix in (".db3", ".mcap"))
    whole = file.read_bytes()
    for length in range(0, len(whole) - 8, max(len(whole) // 60, 64)):
        file.write_bytes(whole[:length])
        assert outcome(path, events) != "other"


def test_reader_closes_twice(tmp_path: Path) -> None:
    reader = open_events(write_bag(tmp_path / "e.bag", {"/e": [random_events(4)]}))
    assert isinstance(reader, BagEventReader)
    reader.close()
    reader.close()
