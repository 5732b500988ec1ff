"""HDF5 as the datasets publish it: TUM-VIE, VECtor, M3ED, MVSEC; several cameras in one file."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from devo.errors import InputError
from tests.utils.event_samples import random_events, same
from utils.events import Events, compute_ms_to_idx, open_events

EPOCH_US = 1_600_000_000_000_000


def read_all(path: Path, **options: object) -> Events:
    with open_events(path, **options) as reader:  # type: ignore[arg-type]
        events = Events.concatenate(list(reader.chunks()))
        assert len(reader) == len(events)
        assert reader.time_range_us() == (events.t_us[0], events.t_us[-1])
        first = int(events.t_us[0])
        assert same(reader.read(first + 300, first + 900), events.between(first + 300, first + 900))
        return events


def moved(events: Events, by_us: int) -> Events:
    return Events(events.x, events.y, events.t_us + by_us, events.p)


def write_columns(file: h5py.File, group: str, events: Events, p_dtype: str, t_dtype: str) -> None:
    for name, column in (("x", events.x), ("y", events.y), ("t", events.t_us.astype(t_dtype)),
                         ("p", events.p.astype(p_dtype))):
        file.create_dataset(f"{group}/{name}", data=column, chunks=(16,), compression="gzip")


def write_mvsec(path: Path, sides: dict[str, Events], start_us: int, images: bool = True) -> None:
    """One float64 table a side: x y t[s] p, polarity -1/+1."""
    with h5py.File(path, "w") as file:
        for side, events in sides.items():
            table = np.column_stack([events.x, events.y, (events.t_us + start_us) / 1e6, 2.0 * events.p - 1])
            file.create_dataset(f"davis/{side}/events", data=table, chunks=(16, 3))
            if images:
                file.create_dataset(f"davis/{side}/image_raw", (2, 260, 346), "u1")
                file[f"davis/{side}/image_raw_ts"] = np.arange(2.0)


def test_tum_vie(tmp_path: Path) -> None:
    """Columns under events/, int64 microseconds, ms_to_idx, no offset."""
    events = random_events(900, seed=1, start_us=1_234_567)
    with h5py.File(tmp_path / "mocap-events_left.h5", "w") as file:
        write_columns(file, "events", events, "bool", "i8")
        file["ms_to_idx"] = compute_ms_to_idx(events.t_us * 1000)
    assert same(read_all(tmp_path / "mocap-events_left.h5"), events)


def test_vector(tmp_path: Path) -> None:
    """Columns under events/ as uint32 behind an absolute offset in microseconds."""
    events = random_events(900, seed=2)
    with h5py.File(tmp_path / "desk1.synced.left_event.hdf5", "w") as file:
        write_columns(file, "events", events, "u1", "u4")
        file["t_offset"] = np.int64(EPOCH_US)
        file["ms_to_idx"] = compute_ms_to_idx(events.t_us * 1000)
    assert same(read_all(tmp_path / "desk1.synced.left_event.hdf5"), moved(events, EPOCH_US))


@pytest.mark.parametrize(("stream", "index"), [("left", 0), ("prophesee/right", 1)])
def test_m3ed(stream: str, index: int, tmp_path: Path) -> None:
    sides = [random_events(900, seed=3), random_events(700, seed=4)]
    with h5py.File(tmp_path / "falcon_data.h5", "w") as file:
        for side, events in zip(("left", "right"), sides):
            write_columns(file, f"prophesee/{side}", events, "i1", "i8")
            file[f"prophesee/{side}/ms_map_idx"] = compute_ms_to_idx(events.t_us * 1000)
            file[f"prophesee/{side}/calib/resolution"] = np.array([1280, 720])
        file["ouster/data"] = np.zeros(4)
    assert same(read_all(tmp_path / "falcon_data.h5", stream=stream), sides[index])
    with open_events(tmp_path / "falcon_data.h5", stream=stream) as reader:
        assert reader.sensor_size == (1280, 720)


@pytest.mark.parametrize(("start_us", "side"), [(0, "left"), (EPOCH_US, "left"), (EPOCH_US, "right")])
def test_mvsec(start_us: int, side: str, tmp_path: Path) -> None:
    """Stamps in float64 seconds since the epoch still give whole microseconds."""
    sides = {"left": random_events(900, seed=5), "right": random_events(800, seed=6)}
    write_mvsec(tmp_path / "indoor_flying1_data.hdf5", sides, start_us)
    found = read_all(tmp_path / "indoor_flying1_data.hdf5", stream=side)
    assert same(found, moved(sides[side], start_us))
    with open_events(tmp_path / "indoor_flying1_data.hdf5", stream=side) as reader:
        assert reader.sensor_size == (346, 260)
    with open_events(tmp_path / "indoor_flying1_data.hdf5", stream=side, sensor_size=(640, 480)) as reader:
        assert reader.sensor_size == (640, 480)


def test_the_only_camera_needs_no_choice(tmp_path: Path) -> None:
    events = random_events(900, seed=7)
    write_mvsec(tmp_path / "e.h5", {"left": events}, 0, images=False)
    assert same(read_all(tmp_path / "e.h5"), events)
    with open_events(tmp_path / "e.h5") as reader:
        assert reader.sensor_size is None


def test_choices_that_do_not_fit(tmp_path: Path) -> None:
    events = random_events(20, seed=8)
    write_mvsec(tmp_path / "two.h5", {"left": events, "right": events}, 0)
    with pytest.raises(InputError, match=r"several event streams \(davis/left/events, davis/right/events\)"):
        open_events(tmp_path / "two.h5")
    with pytest.raises(InputError, match="more than one event stream fits 'davis'"):
        open_events(tmp_path / "two.h5", stream="davis")
    with h5py.File(tmp_path / "one.h5", "w") as file:
        write_columns(file, "events", events, "u1", "u4")
    with pytest.raises(InputError, match="no event stream is called 'left'; there are /events"):
        open_events(tmp_path / "one.h5", stream="left")


def test_tables_of_another_form_are_not_taken_for_events(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file["davis/left/events"] = np.zeros((5, 3))
        file["davis/right/events"] = np.zeros(5)
    with pytest.raises(InputError, match="datasets x, y, t, p missing"):
        open_events(tmp_path / "e.h5")


def test_an_interrupted_table_is_noticed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "e.h5", "w") as file:
        table = file.create_dataset("davis/left/events", (1000, 4), chunks=(100, 2), dtype="f8")
        table[:500] = np.column_stack([np.zeros(500), np.zeros(500), np.arange(500) / 1e3 + 0.5, np.ones(500)])
    with pytest.raises(InputError, match="announces 1000 events but parts of it were never written"):
        open_events(tmp_path / "e.h5")


@pytest.mark.parametrize(("column", "value", "message"), [
    (0, 0.5, "x is 0.5, expected a whole sensor pixel"), (2, np.nan, "time stamp is nan"), (3, 0.5, "polarity is 0.5"),
    (2, 0.0, "time stamps are not sorted"), (1, 300.0, "y = 300.0 is outside the sensor of 346x260")])
def test_damaged_tables(column: int, value: float, message: str, tmp_path: Path) -> None:
    write_mvsec(tmp_path / "e.h5", {"left": random_events(50, seed=9, start_us=10)}, 0)
    with h5py.File(tmp_path / "e.h5", "r+") as file:
        file["davis/left/events"][30, column] = value
    with pytest.raises(InputError, match=f"event 30: {message}"):
        read_all(tmp_path / "e.h5")


def test_500_flipped_bytes_of_a_table(tmp_path: Path) -> None:
    events = random_events(100, seed=10)
    path = tmp_path / "e.h5"
    write_mvsec(path, {"left": events}, 0, images=False)
    whole = path.read_bytes()
    rng = np.random.default_rng(11)
    for position, value in zip(rng.integers(0, len(whole), 500), rng.integers(1, 256, 500)):
        damaged = bytearray(whole)
        damaged[position] ^= int(value)
        path.write_bytes(damaged)
        try:
            read_all(path)
        except InputError as error:
            assert "\n" not in str(error)
            assert "e.h5" in str(error)
