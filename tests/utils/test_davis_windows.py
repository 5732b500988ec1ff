"""Which events a frame of fpv, rpg, ecd and hku holds and what its stamp is: the published table, row by row."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from devo.errors import InputError
from tests.utils.event_samples import random_events
from utils.datasets import fpv, hku
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.datasets.sequence import Sequence
from utils.events import Events, write_events_h5, write_events_text
from utils.load_utils import ecd_evs_iterator, fpv_evs_iterator, hku_evs_iterator, rpg_evs_iterator
from utils.undistort import write_rectify_map

OFFSET_US = 1_000_000
SIZES = {"fpv": (346, 260), "rpg": (240, 180), "ecd": (240, 180), "hku": (346, 260)}
# Irregular image stamps, from 5 ms after the first event to 30 ms before the last one.
GAPS_MS = np.array([30, 36, 31, 29, 34, 40, 28, 33.5, 30.5, 35, 27, 36, 33, 29])
STAMPS_US = 5_000 + np.concatenate([[0], np.cumsum(GAPS_MS * 1000)]).astype(np.int64)
MEAN_US = GAPS_MS.mean() * 1000
END_US = int(STAMPS_US[-1]) + 30_000


def make_folder(folder: Path, dataset: str, stamps_us: np.ndarray = STAMPS_US, events: Events | None = None) -> Path:
    """A preprocessed folder with a few thousand events in the corner of the sensor; fpv has its clock offset."""
    folder.mkdir()
    if events is None:
        events = random_events(3000, seed=1, longest_gap_us=int(2 * END_US / 3000))
        events = events.between(0, END_US)
    rows, columns = np.mgrid[:SIZES[dataset][1], :SIZES[dataset][0]]
    side = "_left" if dataset in ("rpg", "hku") else ""
    if dataset == "fpv":
        shifted = Events(events.x, events.y, events.t_us + OFFSET_US, events.p)
        write_events_text(folder / "events.txt", shifted)
        (folder / "t_offset_us.txt").write_text(f"{OFFSET_US:.18e}\n")
    elif dataset == "ecd":
        write_events_text(folder / "events.txt", events)
    elif dataset == "rpg":
        np.savetxt(folder / "evs_left.txt", np.column_stack([events.t_us, events.x, events.y, events.p]),
                   fmt=["%.4f", "%d", "%d", "%d"])
    else:
        write_events_h5(folder / "evs_left.h5", events)
    name = {"fpv": "images_timestamps_us.txt", "ecd": "tss_us.txt"}.get(dataset, "tss_imgs_us_left.txt")
    np.savetxt(folder / name, stamps_us, fmt="%d" if dataset == "fpv" else "%.12f")
    (folder / f"calib_undist{side}.txt").write_text("200.0 200.0 120.0 90.0")
    write_rectify_map(folder / f"rectify_map{side}.h5", np.stack([columns, rows], axis=-1))
    return folder


def frames_of(sequence: Sequence) -> list[tuple[float, float, float]]:
    """Start, stop and stamp of each window."""
    options = sequence.options
    with sequence.open_events() as reader:
        windows = list(sequence.windows.over(reader, options.start_us, options.stop_us, options.stride))
    return [(window.start_us, window.stop_us, sequence.frame_stamp_us(i, window)) for i, window in enumerate(windows)]


def published(stamps_us: np.ndarray, length_us: float | None, bounded: bool) -> list[tuple[float, float, float]]:
    """The table: windows at all stamps but the last (`bounded`: never later than the next stamp in use)."""
    frames = []
    for start, following in zip(stamps_us[:-1].astype(float), stamps_us[1:].astype(float)):
        stop = following if length_us is None else start + length_us
        middle = 0.5 * (start + stop)
        frames.append((start, stop, min(middle, following) if bounded else middle))
    return frames


def close(found: list[tuple[float, float, float]], expected: list[tuple[float, float, float]]) -> None:
    np.testing.assert_allclose(np.array(found), np.array(expected), rtol=0, atol=1e-6)


ROWS = {
    # data set: (image stamps of which all but the last begin a window, length, stamp is bounded by the next image)
    "fpv": (STAMPS_US[:-1], MEAN_US, True),
    "rpg": (STAMPS_US, MEAN_US, True),
    "ecd": (STAMPS_US, None, True),
    "hku": (STAMPS_US, MEAN_US, False),
}


@pytest.mark.parametrize("dataset", ROWS)
def test_windows_and_stamps_by_default(dataset: str, tmp_path: Path) -> None:
    stamps, length_us, bounded = ROWS[dataset]
    sequence = open_sequence(dataset, make_folder(tmp_path / "walk", dataset))
    assert isinstance(sequence, Sequence)
    frames = frames_of(sequence)
    close(frames, published(stamps, length_us, bounded))
    assert [stamp for _, _, stamp in frames] == [t_us for _, _, t_us in sequence.voxels()]


@pytest.mark.parametrize("dataset", ROWS)
@pytest.mark.parametrize("length_ms", [10.0, 80.0])
def test_windows_of_a_given_length(dataset: str, length_ms: float, tmp_path: Path) -> None:
    """Long windows overlap; where the next image bounds the stamp, the bound shows."""
    stamps, _, bounded = ROWS[dataset]
    folder = make_folder(tmp_path / "walk", dataset)
    sequence = open_sequence(dataset, folder, SequenceOptions(window_dt_ms=length_ms))
    assert isinstance(sequence, Sequence)
    expected = published(stamps, length_ms * 1000, bounded)
    if dataset == "hku":  # windows less than half covered by the recording are left out
        expected = [frame for frame in expected if END_US - frame[0] >= 0.5 * length_ms * 1000]
    close(frames_of(sequence), expected)
    iterator: Callable = {"fpv": fpv_evs_iterator, "rpg": rpg_evs_iterator, "ecd": ecd_evs_iterator,
                          "hku": hku_evs_iterator}[dataset]
    named = {"DELTA_MS" if dataset == "ecd" else "dT_ms": length_ms}
    np.testing.assert_allclose([t_us for _, _, t_us in iterator(folder, **named)],
                               [stamp for _, _, stamp in expected], rtol=0, atol=1e-6)


@pytest.mark.parametrize("dataset", ROWS)
@pytest.mark.parametrize("stride", [2, 3, 4])
def test_stride_thins_out_images_and_never_lengthens_windows(dataset: str, stride: int, tmp_path: Path) -> None:
    stamps, length_us, bounded = ROWS[dataset]
    sequence = open_sequence(dataset, make_folder(tmp_path / "walk", dataset), SequenceOptions(stride=stride))
    assert isinstance(sequence, Sequence)
    if dataset == "hku":
        expected = published(stamps, length_us, bounded)[::stride]
    else:  # the last of the stamps in use gets no window
        expected = []
        used = stamps[::stride].astype(float)
        for start, following in zip(used[:-1], used[1:]):
            stop = start + length_us if length_us is not None else float(stamps[np.searchsorted(stamps, start) + 1])
            expected.append((start, stop, min(0.5 * (start + stop), following)))
    close(frames_of(sequence), expected)


def test_events_of_a_window_are_those_of_its_half_open_interval(tmp_path: Path) -> None:
    """Events exactly at the borders tell: the first belongs to the window, the last to the next one."""
    stamps = np.array([1000, 21_000, 41_000, 61_000])
    t_us = np.array([999, 1000, 10_000, 20_999, 21_000, 40_999, 41_000, 61_000])
    events = Events(np.arange(8, dtype=np.uint16) + 50, np.full(8, 60, np.uint16), t_us, np.ones(8, np.uint8))
    for dataset in ROWS:
        sequence = open_sequence(dataset, make_folder(tmp_path / dataset, dataset, stamps, events))
        assert isinstance(sequence, Sequence)
        with sequence.open_events() as reader:
            found = [window.events.t_us.tolist() for window in sequence.windows.over(reader)]
        assert found[:2] == [[1000, 10_000, 20_999], [21_000, 40_999]], dataset


def test_cutting_in_time_keeps_windows_inside(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "walk", "rpg")
    start_us, stop_us = float(STAMPS_US[3]), float(STAMPS_US[9]) + 10
    sequence = open_sequence("rpg", folder, SequenceOptions(start_us=start_us, stop_us=stop_us))
    assert isinstance(sequence, Sequence)
    inside = [frame for frame in published(STAMPS_US[3:10], MEAN_US, True) if frame[1] <= stop_us]
    assert len(inside) == 5
    close(frames_of(sequence), inside)
    for rule in (SequenceOptions(window_ms=20), SequenceOptions(window_events=300)):
        assert sum(1 for _ in open_sequence("rpg", folder, rule).voxels()) >= 5


@pytest.mark.parametrize(("dataset", "gap_ms", "works"), [
    ("fpv", 3.0, False), ("fpv", 3.1, True), ("fpv", 199, True), ("fpv", 200, False),
    ("rpg", 3.0, False), ("rpg", 3.1, True), ("rpg", 999, True), ("rpg", 1000, False),
    ("ecd", 2.0, True), ("ecd", 2000, True), ("hku", 2.0, True), ("hku", 1500, True)])
def test_implausible_image_intervals(dataset: str, gap_ms: float, works: bool, tmp_path: Path) -> None:
    stamps = (np.arange(6) * gap_ms * 1000).astype(np.int64) + 1000
    folder = make_folder(tmp_path / "walk", dataset, stamps)
    if works:
        open_sequence(dataset, folder)
        return
    with pytest.raises(InputError, match=f"windows would last {gap_ms:g} ms, expected between 3 and"):
        open_sequence(dataset, folder)


@pytest.mark.parametrize(("length_ms", "works"), [(5, False), (5.5, True), (999, True), (1000, False)])
def test_implausible_window_lengths_of_ecd(length_ms: float, works: bool, tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "walk", "ecd")
    if works:
        assert ecd_evs_iterator(folder, length_ms) is not None
        return
    with pytest.raises(InputError, match="expected between 5 and 1000 ms"):
        ecd_evs_iterator(folder, length_ms)


SECOND = 1_000_000


@pytest.mark.parametrize(("gt_seconds", "first", "last"), [
    (None, 0, 98),  # no ground truth: all images but the last
    ((20.0, 60.0), 21, 58),  # first image after its start, up to the last before its end, exclusively
    ((19.9, 60.1), 20, 59),
    ((4.0, 60.0), 0, 98),  # starts less than 5 s after the images
    ((20.0, 115.5), 0, 98),  # images are less than 5 s longer
    ((20.0, 300.0), 0, 98),
])
def test_crop_of_fpv_to_ground_truth(gt_seconds: tuple[float, float] | None, first: int, last: int) -> None:
    stamps = np.arange(100) * float(SECOND)
    gt_us = None if gt_seconds is None else np.linspace(*gt_seconds, 50) * SECOND
    used = fpv.stamps_in_use(stamps, gt_us)
    assert (used[0] / SECOND, used[-1] / SECOND) == (first, last)


def test_crop_of_fpv_that_leaves_nothing() -> None:
    with pytest.raises(InputError, match="0 of 100 image stamps are in use"):
        fpv.stamps_in_use(np.arange(100.0) * SECOND, np.array([20.2, 20.4]) * SECOND)


def test_fpv_iterator_takes_ground_truth(tmp_path: Path) -> None:
    stamps = np.arange(150) * 100_000
    events = random_events(3000, seed=1, longest_gap_us=10_000)
    folder = make_folder(tmp_path / "walk", "fpv", stamps, events)
    times = [t_us for _, _, t_us in fpv_evs_iterator(folder, tss_gt_us=np.linspace(6.05e6, 7.05e6, 30))]
    assert times == [100_000.0 * i + 50_000 for i in range(61, 69)]


HKU_ROWS = [  # name, first and last image in use of 5000, deleted ones
    ("HKU_hdr_tran_rota", 135, 3229, ()),
    ("HKU_HDR_slow", 240, 4154, range(3238, 3243)),  # five images are taken away before the 4150 are counted
    ("HKU_HDR_circle", 155, 2120, range(1349, 1355)),
    ("HKU_hdr_agg", 145, 3599, ()),
    ("HKU_dark_normal", 150, 2804, ()),
    ("HKU_aggressive_walk", 150, 2384, ()),
    ("HKU_aggressive_translation", 165, 1794, ()),
    ("hku_agg_translation", 165, 1794, ()),
    ("HKU_aggressive_small_flip", 150, 1584, ()),
    ("hku_agg_flip", 150, 1584, ()),
    ("HKU_aggressive_rotation", 157, 1659, ()),
    ("hku_hdr_circle", 155, 2120, range(1349, 1355)),
    ("some_other_walk", 0, 4998, ()),
]


@pytest.mark.parametrize(("name", "first", "last", "gone"), HKU_ROWS)
def test_images_in_use_of_hku(name: str, first: int, last: int, gone: range) -> None:
    used = hku.stamps_in_use(np.arange(5000.0), hku.image_range(Path("/data/stereo") / name / "sub"))
    assert used.tolist() == [i for i in range(first, last + 1) if i not in gone]


def test_the_innermost_name_decides() -> None:
    assert hku.image_range(Path("/data/hdr_agg/HKU_dark_normal")) == hku.IMAGE_RANGES["dark_normal"]


def test_images_in_use_of_a_shortened_hku_recording(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "HKU_hdr_agg", "hku")
    with pytest.raises(InputError, match=r"the images 145 to 3600 of this sequence are used, but there are only 15"):
        open_sequence("hku", folder)


def test_fractions_of_a_microsecond_do_not_move_borders(tmp_path: Path) -> None:
    """Stamps that were made by multiplying seconds with 1e6 miss whole microseconds by a hair."""
    seconds = (STAMPS_US / 1e6)
    crooked = np.array([s * 1e6 for s in seconds])
    crooked[crooked == np.rint(crooked)] += 4e-9  # as 0.003811 * 1e6 = 3811.0000000000005 does
    folder = make_folder(tmp_path / "walk", "ecd")
    (folder / "tss_us.txt").write_text("".join(f"{stamp!r}\n" for stamp in crooked.tolist()))
    sequence = open_sequence("ecd", folder)
    assert isinstance(sequence, Sequence)
    assert [start for start, _, _ in frames_of(sequence)] == STAMPS_US[:-1].astype(float).tolist()


def test_missing_files_are_listed_with_the_command_that_makes_them(tmp_path: Path) -> None:
    for dataset, missing in (("fpv", "rectify_map.h5"), ("rpg", "evs_left.txt"), ("ecd", "tss_us.txt"),
                             ("hku", "calib_undist_left.txt")):
        folder = make_folder(tmp_path / dataset, dataset)
        (folder / missing).unlink()
        opener = {"fpv": fpv_evs_iterator, "rpg": rpg_evs_iterator, "ecd": ecd_evs_iterator, "hku": hku_evs_iterator}
        with pytest.raises(InputError, match=f"{missing} missing; make it with .*pp_{dataset}.py {folder}"):
            opener[dataset](folder)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    for dataset in ROWS:
        folder = make_folder(tmp_path / dataset, dataset)
        with pytest.raises(InputError, match="calib cannot be used with data set"):
            open_sequence(dataset, folder, SequenceOptions(calib=Path("c.yaml")))
    with pytest.raises(InputError, match="side cannot be used with data set fpv: its recordings have one camera"):
        fpv.open_fpv(tmp_path / "fpv", SequenceOptions(side="right"))
    with pytest.raises(InputError, match=r"H=180, W=240 were given, but .* is of a sensor with H=260, W=346"):
        hku_evs_iterator(tmp_path / "hku", H=180, W=240)
    with pytest.raises(InputError, match="evs_right.txt"):
        rpg_evs_iterator(tmp_path / "rpg", side="right")
    (tmp_path / "fpv" / "t_offset_us.txt").write_text("soon\n")
    with pytest.raises(InputError, match="expected one number, the offset of the clock"):
        fpv_evs_iterator(tmp_path / "fpv")
    (tmp_path / "ecd" / "calib_undist.txt").write_text("1 2 3")
    with pytest.raises(InputError, match="3 numbers, expected 4"):
        ecd_evs_iterator(tmp_path / "ecd")
    write_rectify_map(tmp_path / "rpg" / "rectify_map_left.h5", np.zeros((10, 20, 2)))
    with pytest.raises(InputError, match="the map is for 20x10 pixels"):
        rpg_evs_iterator(tmp_path / "rpg")
