"""All formats give the same events, in pieces or by time; real recordings; detection by content."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

import utils.events.numpy_files as numpy_files
import utils.events.reader as reader_module
import utils.events.text as text_module
from devo.errors import InputError
from tests.utils.event_samples import HEIGHT, WIDTH, WRITERS, random_events, same, write_as, write_flat_h5
from utils.events import Events, MemoryEventReader, make_events, open_events, write_events_h5, write_events_text

EPOCH_US = 1_600_000_000_000_000


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a few thousand events fill many blocks of every reader."""
    monkeypatch.setattr(text_module, "_BLOCK_BYTES", 1000)
    monkeypatch.setattr(numpy_files, "_ROWS_PER_BLOCK", 97)
    monkeypatch.setattr(reader_module.RowReader, "rows_per_block", 97)


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("max_events", [1, 50, 1_000_000])
@pytest.mark.usefixtures("small_blocks")
def test_chunks_give_the_whole_recording(kind: str, max_events: int, tmp_path: Path) -> None:
    events = random_events(700, seed=1)
    with open_events(write_as(kind, tmp_path, events), sensor_size=(WIDTH, HEIGHT)) as reader:
        chunks = list(reader.chunks(max_events))
        assert same(Events.concatenate(chunks), events)
        assert max(map(len, chunks)) <= max_events
        assert len(reader) == 700
        assert reader.time_range_us() == (events.t_us[0], events.t_us[-1])
        assert reader.sensor_size == (WIDTH, HEIGHT)


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.usefixtures("small_blocks")
def test_reading_by_time_equals_a_mask(kind: str, tmp_path: Path) -> None:
    events = random_events(1500, seed=2, longest_gap_us=3)  # many equal stamps, also across blocks
    rng = np.random.default_rng(3)
    with open_events(write_as(kind, tmp_path, events)) as reader:
        for _ in range(60):  # forwards, backwards, before, behind, empty, fractional
            start, stop = np.sort(rng.uniform(-200, events.t_us[-1] + 200, 2))
            if rng.random() < 0.5:
                start, stop = np.floor(start), np.floor(stop)
            mask = (events.t_us >= start) & (events.t_us < stop)
            found = reader.read(start, stop)
            assert np.array_equal(found.t_us, events.t_us[mask])
            assert np.array_equal(found.x, events.x[mask])
        assert len(reader.read(5, 5)) == 0
        with pytest.raises(InputError, match="the end comes first"):
            reader.read(10, 5)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind != "hdf5 dsec"])
def test_epoch_stamps_stay_exact(kind: str, tmp_path: Path) -> None:
    events = random_events(2000, seed=4, start_us=EPOCH_US)
    with open_events(write_as(kind, tmp_path, events)) as reader:
        assert np.array_equal(Events.concatenate(list(reader.chunks())).t_us, events.t_us)


@pytest.mark.parametrize("offset", [EPOCH_US, None])
def test_epoch_stamps_in_dsec_files_use_the_offset(offset: int | None, tmp_path: Path) -> None:
    events = random_events(2000, seed=4, start_us=EPOCH_US + 7)
    write_events_h5(tmp_path / "e.h5", events, offset)
    with h5py.File(tmp_path / "e.h5") as stream:
        assert stream["events/t"].dtype == np.uint32
        assert stream["t_offset"][()] == (EPOCH_US + 7 if offset is None else offset)
    with open_events(tmp_path / "e.h5") as reader:
        assert same(reader.read(0, 2**62), events)


@pytest.mark.parametrize("kind", WRITERS)
def test_one_event_is_a_recording(kind: str, tmp_path: Path) -> None:
    event = make_events([3], [4], [1500], [1])
    with open_events(write_as(kind, tmp_path, event)) as reader:
        assert same(reader.read(0, 2000), event)
        assert reader.time_range_us() == (1500, 1500)


def test_text_agrees_with_numpy_on_real_recordings(shared_data: Path) -> None:
    for name in ("slider_depth_chunk/events_chunk.txt", "davis_rotation_chunks/poster_rotation/events.txt",
                 "davis_rotation_chunks/boxes_rotation/events.txt"):
        table = np.loadtxt(shared_data / name)
        with open_events(shared_data / name, sensor_size=(240, 180)) as reader:
            events = reader.read(0, 2**60)
        # Half a microsecond more than rounding: the text has nine decimals, and halves round up here, to even there.
        assert np.abs(events.t_us - table[:, 0] * 1e6).max() <= 0.5 + 1e-6
        assert np.array_equal(np.column_stack([events.x, events.y, events.p]), table[:, 1:])


def test_slider_recording_has_the_documented_counts(shared_data: Path) -> None:
    with open_events(shared_data / "slider_depth_chunk" / "events_chunk.txt") as reader:
        events = reader.read(0, 2**60)
        assert (len(reader), int(events.p.sum())) == (50_000, 21_147)
        assert reader.time_range_us() == (3811, 174156)


def test_npz_of_a_real_sensor(shared_data: Path) -> None:
    path = shared_data / "dvs128_handheld" / "building.npz"
    with np.load(path) as arrays, open_events(path, sensor_size=(128, 128)) as reader:
        events = reader.read(0, 2**60)
        assert np.array_equal(events.t_us, arrays["t"])
        assert np.array_equal(events.x, arrays["x"])
        assert len(reader) == 115_839


def test_npy_records_of_a_prophesee_decoder(shared_data: Path) -> None:
    path = shared_data / "prophesee_raw" / "evt3_sample.npy"
    reference = np.load(path)
    with open_events(path, sensor_size=(1280, 720)) as reader:
        assert reader.time_range_us() == (11_718_656, 11_772_513)
        assert np.array_equal(Events.concatenate(list(reader.chunks())).t_us, reference["t"])


def test_sensor_size_of_the_file_is_used_and_checked(tmp_path: Path) -> None:
    write_events_h5(tmp_path / "e.h5", make_events([5, 6], [1, 1], [0, 1], [0, 1]), sensor_size=(7, 3))
    with open_events(tmp_path / "e.h5") as reader:
        assert reader.sensor_size == (7, 3)
    with pytest.raises(InputError, match=r"x = 6 is outside the sensor of 6x3 pixels"):
        open_events(tmp_path / "e.h5", sensor_size=(6, 3))


@pytest.mark.parametrize(("unit", "factor"), [("s", 1e-6), ("ms", 1e-3), ("us", 1), ("ns", 1000)])
def test_time_units_of_numeric_formats(unit: str, factor: float, tmp_path: Path) -> None:
    stamps = np.array([0, 1, 999, 1_000_001, 90_000_000])
    in_unit = stamps * factor if factor < 1 else stamps * int(factor)
    columns = {"x": np.arange(5), "y": np.arange(5), "t": in_unit, "p": np.ones(5, bool)}
    np.savez(tmp_path / "e.npz", **columns)
    with open_events(tmp_path / "e.npz", time_unit=unit) as reader:  # type: ignore[arg-type]
        assert reader.read(0, 2**60).t_us.tolist() == stamps.tolist()
    with h5py.File(tmp_path / "e.h5", "w") as stream:
        for name, column in columns.items():
            stream[name] = column
    with open_events(tmp_path / "e.h5", time_unit=unit) as reader:  # type: ignore[arg-type]
        assert reader.read(0, 2**60).t_us.tolist() == stamps.tolist()


def test_a_guessed_unit_that_cannot_be_is_refused(tmp_path: Path) -> None:
    lines = "".join(f"{100 * i}.2500 1 2 1\n" for i in range(1500))  # microseconds with decimals, as in the RPG data
    (tmp_path / "e.txt").write_text(lines)
    with pytest.raises(InputError, match="pass the unit of the stamps"):
        open_events(tmp_path / "e.txt")
    with open_events(tmp_path / "e.txt", time_unit="us") as reader:
        assert reader.time_range_us() == (0, 149_900)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind != "hdf5 dsec"])  # that writer refuses them
def test_unsorted_events_can_be_sorted(kind: str, tmp_path: Path) -> None:
    events = random_events(500, seed=5)
    order = np.random.default_rng(6).permutation(500)
    shuffled = Events(events.x[order], events.y[order], events.t_us[order], events.p[order])
    path = write_as(kind, tmp_path, shuffled)
    with pytest.raises(InputError, match=r"event \d+.*not sorted"), open_events(path) as reader:
        reader.read(0, 2**60)
    stable = np.argsort(shuffled.t_us, kind="stable")
    with open_events(path, on_unsorted="sort") as reader:
        assert np.array_equal(reader.read(0, 2**60).x, shuffled.x[stable])


def test_memory_reader_behaves_like_a_file() -> None:
    events = random_events(300)
    reader = MemoryEventReader(events, sensor_size=(WIDTH, HEIGHT))
    assert same(Events.concatenate(list(reader.chunks(7))), events)
    with pytest.raises(InputError, match="no events"):
        MemoryEventReader(Events.empty())


def test_stale_index_of_the_file_does_no_harm(tmp_path: Path) -> None:
    events = random_events(3000, seed=8)
    write_flat_h5(tmp_path / "e.h5", events, ms_to_idx=np.zeros(3, np.uint64))
    with open_events(tmp_path / "e.h5") as reader:
        assert same(reader.read(20_000, 40_000), events.between(20_000, 40_000))


def test_text_reader_goes_back_without_starting_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text_module, "_BLOCK_BYTES", 2000)
    events = random_events(5000, seed=9)
    write_events_text(tmp_path / "e.txt", events)
    with open_events(tmp_path / "e.txt") as reader:
        len(reader)  # builds the index
        decoded: list[int] = []
        decode = reader._decode

        def spy(block: int) -> Events | None:
            decoded.append(block)
            return decode(block)

        monkeypatch.setattr(reader, "_decode", spy)
        middle = int(events.t_us[2500])
        assert same(reader.read(middle, middle + 100), events.between(middle, middle + 100))
        assert len(decoded) <= 3
