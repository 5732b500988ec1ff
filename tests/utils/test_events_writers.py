"""What we write can be read again, by us and by plain h5py/numpy, and never appears half-written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from devo.errors import InputError, OutputError
from tests.utils.event_samples import HEIGHT, WIDTH, random_events, same
from utils.events import (
    EventH5Writer,
    Events,
    compute_ms_to_idx,
    make_events,
    open_events,
    write_events_h5,
    write_events_npz,
    write_events_text,
    write_evs_arr_to_h5,
)


def read_all(path: Path) -> Events:
    with open_events(path) as reader:
        return Events.concatenate(list(reader.chunks()))


def test_index_of_the_documented_example() -> None:
    stamps_us = np.array([0, 500, 2100, 5000, 5000, 7100, 7200, 7200, 8100, 9000])
    assert compute_ms_to_idx(stamps_us * 1000).tolist() == [0, 2, 2, 3, 3, 3, 5, 5, 8, 9]
    assert compute_ms_to_idx(stamps_us * 1000, ms_start=5).tolist() == [3, 5, 5, 8, 9]


@pytest.mark.parametrize("bad", [[], [5, 3], [-1, 3], [[1, 2]]])
def test_index_needs_sorted_stamps(bad: list[int]) -> None:
    with pytest.raises(InputError):
        compute_ms_to_idx(np.array(bad, np.int64))


@pytest.mark.parametrize("compression", ["blosc", "gzip", "none"])
@pytest.mark.parametrize("pieces", [1, 7])
def test_dsec_layout_by_plain_h5py(compression: str, pieces: int, tmp_path: Path) -> None:
    events = random_events(5000, seed=1, start_us=1234, longest_gap_us=900)
    parts = [events[i * 5000 // pieces:(i + 1) * 5000 // pieces] for i in range(pieces)]
    write_events_h5(tmp_path / "e.h5", iter(parts), 1000, sensor_size=(WIDTH, HEIGHT),
                    compression=compression)  # type: ignore[arg-type]
    with h5py.File(tmp_path / "e.h5") as stream:
        assert {name: stream[f"events/{name}"].dtype.str for name in "xytp"} == {
            "x": "<u2", "y": "<u2", "t": "<u4", "p": "|u1"}
        assert stream["ms_to_idx"].dtype == np.uint64
        assert stream["t_offset"][()] == 1000
        stored = stream["events/t"][:].astype(np.int64)
        index = stream["ms_to_idx"][:]
        assert np.array_equal(stored + 1000, events.t_us)
        assert len(index) == stored[-1] // 1000 + 1
        assert np.array_equal(index, compute_ms_to_idx(stored * 1000))
        for ms, first in enumerate(index.tolist()):  # the law of the format, event by event
            assert stored[first] >= 1000 * ms
            assert first == 0 or stored[first - 1] < 1000 * ms
    assert same(read_all(tmp_path / "e.h5"), events)


def test_text_and_npz_round_trips(tmp_path: Path) -> None:
    events = random_events(70_000, seed=2, start_us=1_600_000_000_000_000)
    write_events_npz(tmp_path / "e.npz", events)
    write_events_text(tmp_path / "e.txt", [events[:10], events[10:]])
    assert same(read_all(tmp_path / "e.npz"), events)
    assert same(read_all(tmp_path / "e.txt"), events)
    table = np.loadtxt(tmp_path / "e.txt")[:100]
    assert np.array_equal(table[:, 1:], np.column_stack([events.x, events.y, events.p])[:100])


def test_recordings_longer_than_32_bits_get_wider_stamps(tmp_path: Path) -> None:
    with EventH5Writer(tmp_path / "e.h5") as writer:
        writer.write(make_events([1, 2], [1, 2], [5, 2**32 - 1], [0, 1]))
        writer.write(make_events([3], [3], [2**32 + 10], [1]))
    with h5py.File(tmp_path / "e.h5") as stream:
        assert stream["events/t"].dtype == np.uint64
        assert list(stream["events"]) == ["p", "t", "x", "y"]
    assert read_all(tmp_path / "e.h5").t_us.tolist() == [5, 2**32 - 1, 2**32 + 10]


@pytest.mark.parametrize(("batches", "message"), [
    ([[10, 20], [19]], "must be sorted and start at or after 20 us, found 19 us"),
    ([[3]], "at or after 5 us"),
    ([[10, 5 + 31 * 86_400 * 10**6]], "pass t_offset_us=None"),
])
def test_streams_that_cannot_be_written(batches: list[list[int]], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message), EventH5Writer(tmp_path / "e.h5", t_offset_us=5) as writer:
        for stamps in batches:
            writer.write(make_events([1] * len(stamps), [1] * len(stamps), stamps, [1] * len(stamps)))
    assert list(tmp_path.iterdir()) == []


def test_coordinates_are_checked_against_the_announced_sensor(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="y = 9 is outside the sensor of 10x9"):
        write_events_h5(tmp_path / "e.h5", make_events([9], [9], [0], [1]), sensor_size=(10, 9))
    with pytest.raises(InputError, match="compression is 'zip'"):
        write_events_h5(tmp_path / "e.h5", make_events([9], [9], [0], [1]), compression="zip")  # type: ignore[arg-type]


def test_failure_keeps_the_file_that_was_there(tmp_path: Path) -> None:
    target = tmp_path / "e.h5"
    target.write_text("precious")
    with pytest.raises(RuntimeError, match="stop"), EventH5Writer(target) as writer:
        writer.write(random_events(10))
        raise RuntimeError("stop")
    assert target.read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["e.h5"]


@pytest.mark.parametrize("write", [write_events_h5, write_events_npz, write_events_text])
def test_unwritable_folder_is_one_error(write: object, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write(tmp_path / "file" / "e.h5", random_events(10))  # type: ignore[operator]


def test_full_disk_is_one_error_and_leaves_nothing(tmp_path: Path) -> None:
    """A limit on the file size makes the kernel refuse to write, as a full disk does."""
    code = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).resolve().parents[2])!r})
import numpy as np
from devo.errors import OutputError
from tests.utils.event_samples import random_events
from utils.events import write_events_h5, write_events_npz, write_events_text
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
events = random_events(200_000)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
for name, write in (("e.h5", write_events_h5), ("e.npz", write_events_npz), ("e.txt", write_events_text)):
    try:
        write({str(tmp_path)!r} + "/" + name, events)
    except OutputError as error:
        print("OutputError", str(error).count(chr(10)))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert result.stdout.split("\n")[:3] == ["OutputError 0"] * 3, result.stdout + result.stderr
    assert list(tmp_path.iterdir()) == []


def test_event_table_is_written_as_published(tmp_path: Path) -> None:
    table = np.array([[1, 2, 10.9, 0], [3, 4, 5000.2, 1]])
    write_evs_arr_to_h5(table, tmp_path / "e.h5")
    with h5py.File(tmp_path / "e.h5") as stream:
        assert stream["events/t"][:].tolist() == [10, 5000]  # truncated toward zero
        assert stream["ms_to_idx"][:].tolist() == [0, 1, 1, 1, 1, 1]
    with pytest.raises(InputError, match=r"expected \(N, 4\)"):
        write_evs_arr_to_h5(table[:, :3], tmp_path / "f.h5")
