"""Damaged files of every format: one line that names the file and the cause, never a traceback or invented events."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from devo.errors import InputError
from tests.utils.event_samples import WRITERS, random_events, same, write_as, write_flat_h5
from utils.events import Events, make_events, open_events, write_events_h5

COUNT = 150


def read_all(path: Path, **options: object) -> Events:
    with open_events(path, **options) as reader:  # type: ignore[arg-type]
        events = Events.concatenate(list(reader.chunks()))
        assert len(reader) == len(events)
        assert reader.time_range_us() == (events.t_us[0], events.t_us[-1])
    return events


def assert_one_line(error: InputError, path: Path) -> None:
    assert "\n" not in str(error)
    assert path.name in str(error)


@pytest.mark.parametrize(("content", "message"), [
    (b"", "empty"),
    (bytes(range(256)) * 20, "binary content of unknown format"),
    (b"\x00" * 100, "binary content"),
    (b"PK\x03\x04 but not a zip archive", "damaged or truncated npz"),
    (b"\x93NUMPY\x01\x00", "damaged or truncated npy"),
    (b"\x89HDF\r\n\x1a\n and nothing else", "damaged or unreadable HDF5"),
    (b"#ROSBAG V2.0\n", "damaged or unreadable bag"),
    (b"% evt 3.0\n", "holds no events"),
    (b"#!AER-DAT3.1\n", "AEDAT version '3.1'"),
    (b"hello world\n", "line 1: 2 columns"),
])
def test_files_that_are_no_events(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "events.bin"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        open_events(path)
    assert_one_line(caught.value, path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read event file.*No such file"):
        open_events(tmp_path / "nothing.h5")
    with pytest.raises(InputError, match="is a folder"):
        open_events(tmp_path)


def test_options_that_do_not_exist(tmp_path: Path) -> None:
    path = write_as("text", tmp_path, random_events(3))
    with pytest.raises(InputError, match="time unit is 'minutes'"):
        open_events(path, time_unit="minutes")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="on_unsorted is 'ignore'"):
        open_events(path, on_unsorted="ignore")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="sensor size is"):
        open_events(path, sensor_size=(0, 5))
    with pytest.raises(InputError, match="max_events is 0"), open_events(path) as reader:
        next(reader.chunks(0))


@pytest.mark.parametrize("kind", WRITERS)
def test_truncation_anywhere_is_noticed(kind: str, tmp_path: Path) -> None:
    """Cut at every 64th byte: never the full recording, never a crash; text may end cleanly between two events."""
    events = random_events(COUNT, seed=1)
    whole = write_as(kind, tmp_path, events).read_bytes()
    path = tmp_path / "cut.bin"
    for length in range(0, len(whole) - 1, 64):
        path.write_bytes(whole[:length])
        try:
            found = read_all(path)
        except InputError as error:
            assert_one_line(error, path)
        else:
            assert kind == "text"
            assert len(found) < COUNT
            assert same(found, events[:len(found)])


@pytest.mark.parametrize("kind", WRITERS)
def test_flipped_bytes_never_crash(kind: str, tmp_path: Path) -> None:
    """500 random byte flips: the original events, changed values that pass all checks, or one clear error."""
    events = random_events(COUNT, seed=2)
    whole = bytearray(write_as(kind, tmp_path, events).read_bytes())
    path = tmp_path / "flipped.bin"
    rng = np.random.default_rng(3)
    silent = 0
    for position, value in zip(rng.integers(0, len(whole), 500), rng.integers(1, 256, 500)):
        damaged = whole.copy()
        damaged[position] ^= int(value)
        path.write_bytes(damaged)
        try:
            found = read_all(path)
        except InputError as error:
            assert_one_line(error, path)
        else:
            silent += not same(found, events)
    if kind in ("npz", "hdf5 dsec"):  # formats with checksums: damage never passes as data
        assert silent == 0


def columns(**replaced: object) -> dict[str, np.ndarray]:
    base = {"x": np.arange(5), "y": np.arange(5), "t": np.arange(5) * 10, "p": np.array([0, 1, 0, 1, 1])}
    return {name: np.asarray(value) for name, value in {**base, **replaced}.items() if value is not None}


def save_npz(path: Path, values: dict[str, np.ndarray]) -> None:
    with path.open("wb") as stream:
        np.savez(stream, **values)


def save_h5(path: Path, values: dict[str, np.ndarray]) -> None:
    with h5py.File(path, "w") as stream:
        for name, value in values.items():
            stream[f"events/{name}"] = value


@pytest.mark.parametrize("save", [save_npz, save_h5])
@pytest.mark.parametrize(("replaced", "message"), [
    ({"x": None}, "x missing"),
    ({"t": None, "p": None}, "t, p missing"),
    ({"x": np.arange(4)}, "differ in length"),
    ({"x": np.zeros((5, 2))}, "one.dimension"),
    ({"t": [0, 10, 5, 20, 30]}, r"event 2: time stamps are not sorted, 5 us follows 10 us"),
    ({"t": [-5, 10, 15, 20, 30]}, r"event 0: negative time stamp -5 us"),
    ({"t": [0.0, 0.1, np.nan, 0.3, 0.4]}, r"event 2: time stamp is nan"),
    ({"t": [0.0, 0.1, np.inf, 0.3, 0.4]}, r"event 2: time stamp is inf"),
    ({"t": [2**32 - 20, 2**32 - 10, 2**32 - 1, 3, 9]}, r"event 3: .*32-bit microsecond counter wrapped"),
    ({"t": [2**31 - 20, 2**31 - 10, 2**31 - 1, -2**31, -2**31 + 9]}, r"event 3: .*counter wrapped"),
    ({"t": np.array([0, 1, 2, 3, 2**63], np.uint64)}, r"event 4: time stamp 9223372036854775808 us is out of"),
    ({"x": [0, 1, 2, 3, 64]}, r"event 4: x = 64 is outside the sensor of 64x48 pixels"),
    ({"y": [0, -1, 2, 3, 4]}, r"event 1: y = -1 is outside"),
    ({"x": [0, 1, 2.5, 3, 4]}, r"event 2: x is 2.5, expected a whole sensor pixel"),
    ({"x": [0, 1, np.nan, 3, 4]}, r"event 2: x is nan"),
    ({"p": [0, 1, 3, 1, 1]}, r"event 2: polarity is 3, expected 0/1 or -1/\+1"),
    ({"p": [0, 1, np.nan, 1, 1]}, r"event 2: polarity is nan"),
    ({"p": [0, 1, -2, 1, 1]}, r"event 2: polarity is -2"),
    ({name: np.zeros(0) for name in "xytp"}, "no events"),
])
def test_bad_columns(save: Callable[[Path, dict[str, np.ndarray]], None], replaced: dict[str, object], message: str,
                     tmp_path: Path) -> None:
    path = tmp_path / "events.bin"
    save(path, columns(**replaced))
    with pytest.raises(InputError, match=message) as caught:
        read_all(path, sensor_size=(64, 48))
    assert_one_line(caught.value, path)


def test_wrap_is_refused_even_when_sorting(tmp_path: Path) -> None:
    path = tmp_path / "events.bin"
    save_npz(path, columns(t=[2**32 - 20, 2**32 - 10, 2**32 - 1, 3, 9]))
    with pytest.raises(InputError, match="counter wrapped"):
        open_events(path, on_unsorted="sort")


@pytest.mark.parametrize("polarity", [np.array([0, 1, 0, 1, 1], bool), np.array([0, 1, 0, 1, 1], np.uint8),
                                      np.array([-1, 1, -1, 1, 1], np.int8), np.array([-1.0, 1, -1, 1, 1]),
                                      np.array([0, 1, -1, 1, 1], np.int64)])
def test_spellings_of_polarity(polarity: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "events.bin"
    save_npz(path, columns(p=polarity))
    assert read_all(path).p.tolist() == [0, 1, 0, 1, 1]


def test_python_objects_are_never_loaded(tmp_path: Path) -> None:
    np.save(tmp_path / "evil.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="npy"):
        open_events(tmp_path / "evil.npy")
    with (tmp_path / "evil.npz").open("wb") as stream:
        np.savez(stream, **columns(t=np.array([None] * 5, dtype=object)), allow_pickle=True)
    with pytest.raises(InputError, match="Python objects"):
        open_events(tmp_path / "evil.npz")


@pytest.mark.parametrize("array", [np.zeros((5, 3)), np.zeros(5), np.zeros((2, 4, 2)),
                                   np.zeros(3, dtype=[("x", "u2"), ("y", "u2"), ("t", "i8")]),
                                   np.zeros(3, dtype=[("x", "u2", 2), ("y", "u2"), ("t", "i8"), ("p", "u1")])])
def test_npy_of_another_form(array: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "e.npy", array)
    with pytest.raises(InputError, match="expected"):
        open_events(tmp_path / "e.npy")


def test_interrupted_hdf5_conversion_is_noticed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "e.h5", "w") as stream:
        for name in "xytp":
            dataset = stream.create_dataset(f"events/{name}", (100_000,), chunks=(1000,), dtype="u4")
            dataset[:50_000] = 0
    with pytest.raises(InputError, match="announces 100000 events but parts of it were never written"):
        open_events(tmp_path / "e.h5")


@pytest.mark.parametrize(("offset", "message"), [(np.array([1, 2]), "one number"), (np.nan, "one number"),
                                                 (b"late", "one number"), (2**62, "out of any range"),
                                                 (-10**9, "negative time stamp")])
def test_bad_offset(offset: object, message: str, tmp_path: Path) -> None:
    write_flat_h5(tmp_path / "e.h5", random_events(5), t_offset=offset)
    with pytest.raises(InputError, match=message):
        open_events(tmp_path / "e.h5")


def test_unsorted_across_blocks_is_noticed(tmp_path: Path) -> None:
    first, second = random_events(300_000, seed=1, longest_gap_us=1), random_events(300_000, seed=2, longest_gap_us=1)
    joined = [np.concatenate([getattr(part, name) for part in (first, second)]) for name in ("x", "y", "t_us", "p")]
    with (tmp_path / "e.npz").open("wb") as stream:
        np.savez(stream, x=joined[0], y=joined[1], t=joined[2], p=joined[3])
    with pytest.raises(InputError, match=r"event 300000: time stamps are not sorted, 0 us follows"):
        read_all(tmp_path / "e.npz")


def test_make_events_checks_and_converts() -> None:
    events = make_events([1.0, 2.0], [3, 4], [10.4, 11.6], [-1, 1])
    assert (events.t_us.tolist(), events.p.tolist(), events.x.dtype) == ([10, 12], [0, 1], np.uint16)
    with pytest.raises(InputError, match="my array: event 1: polarity"):
        make_events([1, 2], [3, 4], [1, 2], [0, 7], source="my array")
    with pytest.raises(InputError, match="use utils.events.make_events"):
        Events(np.zeros(2, np.int64), np.zeros(2, np.uint16), np.zeros(2, np.int64), np.zeros(2, np.uint8))  # type: ignore[arg-type]


def test_writers_refuse_what_readers_would(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no events"):
        write_events_h5(tmp_path / "e.h5", Events.empty())
    assert list(tmp_path.iterdir()) == []
