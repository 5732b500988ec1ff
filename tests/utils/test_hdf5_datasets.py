"""Readers of vector, tumvie, eds and mvsec: each row of the window table, each crop, each way to get a folder wrong."""

from __future__ import annotations

import itertools
import json
import resource
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from devo.errors import InputError
from tests.utils.event_samples import same
from tests.utils.prepared_folders import (
    image_stamps,
    prepared_eds,
    prepared_mvsec,
    prepared_tumvie,
    prepared_vector,
    steady_events,
)
from utils import load_utils
from utils.datasets.eds import EVENTS_UNCHANGED
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.datasets.sequence import Sequence
from utils.events import Events, write_events_h5
from utils.voxel_grid import remove_hot_pixels, resize_voxel, to_voxel_grid

UNIX_US = 1_642_661_808_000_000
MEAN_US = 40_000
STAMPS = image_stamps()
EVENTS = steady_events(int(STAMPS[-1]) + 100_000)


def windows(sequence: Any) -> list[tuple[float, float]]:
    options = sequence.options
    with sequence.open_events() as reader:
        found = list(sequence.windows.over(reader, options.start_us, options.stop_us, options.stride))
    assert len(found) == sequence.expected_length
    for window in found:  # half-open: an event on the first border belongs to it, one on the second does not
        assert window.events.t_us[0] >= window.start_us and window.events.t_us[-1] < window.stop_us
    return [(window.start_us, window.stop_us) for window in found]


@pytest.fixture
def stamps_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], list[float]]:
    """Stamps of all frames, without making the voxel grids."""
    monkeypatch.setattr(Sequence, "_voxel", lambda self, window: torch.zeros(1))
    return lambda sequence: [t_us for _, _, t_us in sequence.voxels()]


@pytest.mark.parametrize(("name", "length_us"), [("corridors_walk", 2 * MEAN_US), ("garden_fast", MEAN_US / 2)])
def test_windows_of_vector(name: str, length_us: float, tmp_path: Path,
                           stamps_of: Callable[[Any], list[float]]) -> None:
    """`[s_i, s_i + L)`, L from the mean interval; stamp in the middle; the last image is left out; absolute clock."""
    later = Events(EVENTS.x, EVENTS.y, EVENTS.t_us + UNIX_US, EVENTS.p)
    sequence = open_sequence("vector", prepared_vector(tmp_path, STAMPS + UNIX_US, later, name))
    starts = (STAMPS[:-1] + UNIX_US).tolist()
    assert windows(sequence) == [(start, start + length_us) for start in starts]
    assert stamps_of(sequence) == [start + length_us / 2 for start in starts]
    strided = open_sequence("vector", tmp_path, SequenceOptions(stride=2))
    assert windows(strided) == [(start, start + length_us) for start in starts[::2]]
    fixed = open_sequence("vector", tmp_path, SequenceOptions(window_dt_ms=7))
    assert windows(fixed) == [(start, start + 7000) for start in starts]
    iterator = load_utils.vector_evs_iterator(tmp_path, dT_ms=10)  # the published factor applies to this one too
    assert next(iterator)[2] == starts[0] + 5000 * length_us / MEAN_US


def test_windows_of_tumvie(tmp_path: Path, stamps_of: Callable[[Any], list[float]]) -> None:
    """`[s_i, s_i + mean interval)`, or `dT_ms`; stamp in the middle; no image is left out."""
    sequence = open_sequence("tumvie", prepared_tumvie(tmp_path, STAMPS, EVENTS))
    assert windows(sequence) == [(start, start + MEAN_US) for start in STAMPS.tolist()]
    assert stamps_of(sequence) == [start + MEAN_US / 2 for start in STAMPS.tolist()]
    stamps = [t_us for _, _, t_us in load_utils.tumvie_evs_iterator(tmp_path, camID=2, dT_ms=25, stride=3)]
    assert stamps == [start + 12_500 for start in STAMPS[::3].tolist()]
    assert sequence.intrinsics.tolist() == [902.0, 901.0, 640.0, 360.0]


def test_windows_of_eds(tmp_path: Path, stamps_of: Callable[[Any], list[float]]) -> None:
    """`[s_i, s_i + half the mean interval)`; stamp in the middle; the last image is left out."""
    sequence = open_sequence("eds", prepared_eds(tmp_path, STAMPS, EVENTS))
    assert windows(sequence) == [(start, start + MEAN_US / 2) for start in STAMPS[:-1].tolist()]
    assert stamps_of(sequence) == [start + MEAN_US / 4 for start in STAMPS[:-1].tolist()]
    assert [t_us for _, _, t_us in load_utils.eds_evs_iterator(tmp_path, stride=4)] == [
        start + MEAN_US / 4 for start in STAMPS[:-1:4].tolist()]


def test_windows_of_mvsec(tmp_path: Path, stamps_of: Callable[[Any], list[float]]) -> None:
    """Events between an image and the one before it; the stamp is that of the later one; empty windows are skipped."""
    closing = np.searchsorted(EVENTS.t_us, STAMPS)
    closing[0], closing[4] = -1, closing[3]  # no event before the first image, none between the fourth and fifth
    sequence = open_sequence("mvsec", prepared_mvsec(tmp_path / "walk_data", STAMPS, EVENTS, closing))
    with sequence.open_events() as reader:
        found = list(sequence.windows.over(reader))  # type: ignore[attr-defined]
    borders = [0, *np.maximum(closing, 0).tolist()]
    assert all(same(window.events, EVENTS[first:last])
               for window, (first, last) in zip(found, itertools.pairwise(borders), strict=True))
    used = np.delete(STAMPS, [0, 4])
    assert stamps_of(sequence) == used.tolist()
    assert sequence.describe()["counts"] == {"windows": 10, "empty_windows": 2, "events": int(closing[-1])}
    later = open_sequence("mvsec", tmp_path / "walk_data", SequenceOptions(start_us=float(STAMPS[2]), stride=2))
    assert stamps_of(later) == STAMPS[3::2].tolist()
    assert [t_us for _, _, t_us in load_utils.mvsec_evs_iterator(tmp_path / "walk_data")] == used.tolist()


@pytest.mark.parametrize(("name", "start", "stop"), [
    ("corner_slow", 30, 1180), ("robot_normal", 40, -1), ("robot_fast", 30, 901), ("desk_normal", 65, -1),
    ("desk_fast", 25, 1380), ("sofa_normal", 120, 2700), ("sofa_fast", 50, 1200), ("mountain_normal", 40, -1),
    ("mountain_fast", 15, 1290), ("hdr_normal", 30, -1), ("hdr_fast", 35, -1), ("corridors_dolly", 115, -1),
    ("school_dolly", 80, 3160), ("school_scooter", 20, 1290), ("units_dolly", 20, 5750), ("units_scooter", 10, 2790),
    ("corridors_walk", 0, -1),
])
def test_image_ranges_of_vector(name: str, start: int, stop: int, long_vector: Path) -> None:
    event_file = next(long_vector.glob("*_event.hdf5"))
    event_file.rename(long_vector / f"{name}1.synced.left_event.hdf5")
    sequence: Any = open_sequence("vector", f"{long_vector}/")
    stamps_us = np.arange(6000) * 33_000.0
    assert sequence.name == name
    assert sequence.windows.stamps_us.tolist() == stamps_us[start:stop].tolist()
    assert sequence.windows.window_us == (16_500 if "fast" in name else 66_000)
    # start and stop choose among the windows of the range
    cropped: Any = open_sequence("vector", long_vector, SequenceOptions(start_us=33_000.0 * start + 1))
    assert windows_begin(cropped) == 33_000.0 * (start + 1)


def windows_begin(sequence: Any) -> float:
    with sequence.open_events() as reader:
        return float(next(sequence.windows.over(reader, sequence.options.start_us, sequence.options.stop_us)).start_us)


@pytest.fixture(scope="module")
def long_vector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """6000 images; the folders around have names that say nothing about the sequence."""
    folder = tmp_path_factory.mktemp("desk_fast") / "robot_fast"
    return prepared_vector(folder, np.arange(6000) * 33_000, steady_events(6000 * 33_000, step_us=20_000))


def test_adjacent_windows_stay_inside_the_range(tmp_path: Path, stamps_of: Callable[[Any], list[float]]) -> None:
    folder = prepared_vector(tmp_path, STAMPS, EVENTS)
    last = STAMPS[-2]  # the last image is left out
    adjacent = [STAMPS[0] + 10_000 * number + 5000.0 for number in range(int(last - STAMPS[0]) // 10_000)]
    assert stamps_of(open_sequence("vector", folder, SequenceOptions(window_ms=10))) == adjacent
    count = len(EVENTS.between(STAMPS[0], last))
    assert len(stamps_of(open_sequence("vector", folder, SequenceOptions(window_events=100)))) == round(count / 100)


def test_a_last_window_that_is_half_empty_is_dropped(tmp_path: Path) -> None:
    """The published reader drops a window whose end is not followed by a full millisecond; this one asks for half."""
    for end, used in ((STAMPS[-1] + 15_000, 9), (STAMPS[-1] + 25_000, 10)):
        folder = tmp_path / str(end)
        sequence = open_sequence("tumvie", prepared_tumvie(folder, STAMPS, steady_events(int(end))))
        assert sequence.expected_length == used


def test_hot_pixels_and_size(tmp_path: Path) -> None:
    """Resized first, filtered then; intrinsics follow the size."""
    rng = np.random.default_rng(0)
    pixels = np.concatenate([rng.integers(0, 60, (3000, 2)), np.full((300, 2), 32)]).astype(np.uint16)
    t_us = np.sort(rng.integers(STAMPS[0], STAMPS[0] + 20_000, len(pixels)))
    events = Events(pixels[:, 0], pixels[:, 1], t_us, np.ones(len(pixels), np.uint8))
    folder = prepared_eds(tmp_path, STAMPS, events)
    voxel, intrinsics, _ = next(load_utils.eds_evs_iterator(folder, H=240, W=320))
    raw = to_voxel_grid(events.x, events.y, events.t_us, events.p, 480, 640)
    small = resize_voxel(raw, 240, 320)
    expected = remove_hot_pixels(small, 10.0)
    assert int((expected != small).sum()) > 0, "the hot pixel is found"
    assert torch.equal(voxel, expected)
    published = [562.9412231445312, 563.5700073242188, 310.53467429134616, 215.59711647292897]
    assert intrinsics.tolist() == [value / 2 for value in published]
    native = next(open_sequence("eds", folder).voxels())
    assert torch.equal(native[0], remove_hot_pixels(raw, 10.0)) and native[1].tolist() == published


def test_intrinsics_of_eds_come_from_the_folder(tmp_path: Path) -> None:
    folder = prepared_eds(tmp_path, STAMPS, EVENTS, "calib1")
    assert open_sequence("eds", folder).intrinsics[0] == 548.6773071289062  # only the second calibration is there
    entries = [{"fx": 700.0, "fy": 701.0, "cx": 320.0, "cy": 240.0},
               {"fx": 550.0, "fy": 551.0, "cx": 310.0, "cy": 220.0}]
    (folder / "calib_undist_calib1.json").write_text(json.dumps({"intrinsics_undistorted": entries}))
    assert open_sequence("eds", folder).intrinsics.tolist() == [550.0, 551.0, 310.0, 220.0]
    assert next(load_utils.eds_evs_iterator(folder, calib1=True))[1].tolist() == [550.0, 551.0, 310.0, 220.0]
    with pytest.raises(InputError, match=r"rectify_map_calib0.h5 missing; make it with `python scripts/pp_eds.py"):
        load_utils.eds_evs_iterator(folder)


def test_eds_events_that_were_not_shifted(tmp_path: Path) -> None:
    """Absolute stamps are recognised by the offset; a file that says so is believed where both would be possible."""
    absolute = Events(EVENTS.x, EVENTS.y, EVENTS.t_us + 1_600_000_000_000_000, EVENTS.p)
    shifted = open_sequence("eds", prepared_eds(tmp_path / "shifted", STAMPS, EVENTS))
    raw = open_sequence("eds", prepared_eds(tmp_path / "raw", STAMPS, absolute))
    for one, other in itertools.islice(zip(shifted.voxels(), raw.voxels()), 3):
        assert torch.equal(one[0], other[0]) and one[2] == other[2]
    early = prepared_eds(tmp_path / "early", STAMPS, EVENTS)
    (early / "t_offset_us.txt").write_text(f"3.0e+03\n{EVENTS_UNCHANGED}\n")
    with open_sequence("eds", early).open_events() as reader:
        assert reader.time_range_us()[0] == EVENTS.t_us[0] - 3000


def broken(change: Callable[[Path], object], dataset: str, tmp_path: Path, **options: Any) -> str:
    """The message for a good folder that was changed."""
    make = {"vector": prepared_vector, "tumvie": prepared_tumvie, "eds": prepared_eds}.get(dataset)
    folder = tmp_path / "walk_data"
    if make is None:
        prepared_mvsec(folder, STAMPS, EVENTS, np.searchsorted(EVENTS.t_us, STAMPS))
    else:
        make(folder, STAMPS, EVENTS)
    change(folder)
    with pytest.raises(InputError) as caught:
        list(itertools.islice(open_sequence(dataset, folder, SequenceOptions(**options)).voxels(), 2))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def remove(name: str) -> Callable[[Path], object]:
    return lambda folder: next(folder.glob(name)).unlink()


def write(name: str, text: str) -> Callable[[Path], object]:
    return lambda folder: next(folder.glob(name)).write_text(text)


def cut(name: str) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        file = next(folder.glob(name))
        file.write_bytes(file.read_bytes()[:file.stat().st_size // 3])
    return change


@pytest.mark.parametrize(("dataset", "change", "message"), [
    ("vector", remove("*_event.hdf5"), "no *1.synced.left_event.hdf5 (event file of the left camera of VECtor)"),
    ("vector", remove("tss_imgs*"), "tss_imgs_us_left.txt missing; make it with `python scripts/pp_vector.py --indir"),
    ("vector", remove("rectify*"), "rectify_map_left.h5 missing"),
    ("vector", cut("*_event.hdf5"), "damaged or unreadable HDF5 file"),
    ("vector", cut("rectify*"), "damaged or unreadable HDF5 file"),
    ("vector", write("calib*", "1 2 3"), "3 numbers, expected 4"),
    ("vector", write("calib*", "500 500 320 240 0.1 0 0 0"), "expected the undistorted camera"),
    ("vector", write("tss*", "5\n4\n"), "stamp 1 is 4.0 us and not later"),
    ("vector", write("tss*", "5\n"), "1 image stamps, expected at least 2"),
    ("vector", write("tss*", "0\n1000000\n2000000\n"), "windows would last 2000 ms, expected between 0 and 1000"),
    ("tumvie", remove("*events_left.h5"), "no *events_left.h5"),
    ("tumvie", remove("calib_undist.json"), "calib_undist.json missing; make it with `python scripts/pp_tumvie.py"),
    ("tumvie", write("calib_undist.json", "{"), "not valid json"),
    ("tumvie", write("calib_undist.json", "{}"), "no camera 2 in value0.intrinsics_undistorted"),
    ("tumvie", write("calib_undist.json", '{"value0": {"intrinsics_undistorted": [0, 1, {"fx": 0, "fy": 1}]}}'),
     "no camera 2"),
    ("tumvie", write("left_images_undistorted/*.txt", "1\n2\n3\n"), "windows would last 0.001 ms"),
    ("tumvie", cut("*events_left.h5"), "damaged or unreadable HDF5 file"),
    ("eds", remove("events.h5"), "no events.h5"),
    ("eds", remove("images_timestamps_us.txt"), "images_timestamps_us.txt missing"),
    ("eds", write("t_offset_us.txt", "soon"), "expected one number, the offset"),
    ("eds", write("t_offset_us.txt", "1\n2\n"), "2 numbers, expected one"),
    ("eds", cut("events.h5"), "damaged or unreadable HDF5 file"),
    ("mvsec", remove("*_data.hdf5"), "no *_data.hdf5"),
    ("mvsec", remove("calib_undist_left.txt"), "calib_undist_left.txt missing; make it with `python scripts/pp_mvsec"),
    ("mvsec", write("tss*", "1\n2\n"), "2 stamps, but walk_data.hdf5 numbers the events of 10 images"),
    ("mvsec", cut("*_data.hdf5"), "damaged or unreadable HDF5 file"),
])
def test_damaged_folders(dataset: str, change: Callable[[Path], object], message: str, tmp_path: Path) -> None:
    assert message in broken(change, dataset, tmp_path)


def test_event_numbers_beyond_the_file(tmp_path: Path) -> None:
    def change(folder: Path) -> None:
        with h5py.File(folder / "walk_data.hdf5", "r+") as file:
            file["davis/left/image_raw_event_inds"][-1] = len(EVENTS) + 1
    assert f"{len(EVENTS)} events, but windows go up to event {len(EVENTS) + 1}" in broken(change, "mvsec", tmp_path)


@pytest.mark.parametrize(("dataset", "options", "message"), [
    ("vector", {"side": "right"}, "no *1.synced.right_event.hdf5"),
    ("tumvie", {"side": "right"}, "no *events_right.h5"),
    ("eds", {"side": "right"}, "side cannot be used with data set eds: it has one event camera"),
    ("mvsec", {"side": "right"}, "tss_imgs_us_right.txt, calib_undist_right.txt, rectify_map_right.h5 missing"),
    ("mvsec", {"window_ms": 5}, "window_ms cannot be used with data set mvsec"),
    ("vector", {"intrinsics": (1, 1, 1, 1)}, "intrinsics cannot be used with data set vector"),
    ("tumvie", {"time_unit": "us"}, "time_unit cannot be used"),
    ("eds", {"calib": Path("c.yaml"), "image_size": (640, 480)}, "calib and image_size cannot be used"),
])
def test_options_that_do_not_apply(dataset: str, options: dict[str, Any], message: str, tmp_path: Path) -> None:
    assert message in broken(lambda folder: None, dataset, tmp_path, **options)


def test_further_wrong_calls(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="camID is 0, expected 2 or 3"):
        load_utils.tumvie_evs_iterator(tmp_path, camID=0)
    with pytest.raises(InputError, match="is not a folder, expected a sequence"):
        load_utils.vector_evs_iterator(tmp_path / "nothing")
    prepared_vector(tmp_path, STAMPS, EVENTS, "desk_normal")
    with pytest.raises(InputError, match="desk_normal uses the images 65 to -1, but there are only 10 stamps"):
        open_sequence("vector", tmp_path)
    write_events_h5(tmp_path / "other1.synced.left_event.hdf5", EVENTS)
    with pytest.raises(InputError, match=r"several \*1.synced.left_event.hdf5"):
        open_sequence("vector", tmp_path)


def test_images_that_are_not_there_do_not_stop_event_runs(tmp_path: Path) -> None:
    folder = prepared_vector(tmp_path, STAMPS, EVENTS)
    assert open_sequence("vector", folder).images is None
    with pytest.raises(InputError, match="there are no undistorted images in images_undistorted_left; make them with"):
        next(open_sequence("vector", folder).frames())
    (folder / "images_undistorted_left").mkdir()
    (folder / "images_undistorted_left" / "000000.png").write_bytes(b"")
    with pytest.raises(InputError, match="images_undistorted_left holds 1 images for 10 stamps; complete them"):
        next(open_sequence("vector", folder).frames())


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    """Streaming 60 voxel grids of 640x480 pixels needs no more memory than streaming 10."""
    stamps_us = np.arange(62) * 33_000
    prepared_vector(tmp_path, stamps_us, steady_events(62 * 33_000, step_us=20))
    stream = open_sequence("vector", tmp_path).voxels()
    tracemalloc.start()
    try:
        peaks = []
        for count in (10, 50):
            for _ in itertools.islice(stream, count):
                pass
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.reset_peak()
    finally:
        tracemalloc.stop()
    voxel_bytes = 5 * 480 * 640 * 4
    assert peaks[1] < peaks[0] + voxel_bytes
    assert peaks[0] < 30 * voxel_bytes, "about one voxel grid in float64, a few copies and the map"


@pytest.mark.slow
def test_resident_memory_of_a_long_recording(tmp_path: Path) -> None:
    """800 voxel grids, 5 GB in all: the process stays below 1.5 GB and grows by less than 1 MB per 100 frames."""
    stamps_us = np.arange(801) * 33_000
    prepared_vector(tmp_path, stamps_us, steady_events(801 * 33_000, step_us=20))
    resident_mb = []
    for number, _ in enumerate(open_sequence("vector", tmp_path).voxels()):
        if number % 100 == 99:
            resident_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    assert len(resident_mb) == 8
    assert resident_mb[-1] < 1500
    assert (resident_mb[-1] - resident_mb[1]) / 6 < 1.0
