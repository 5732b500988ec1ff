"""Recordings of one's own: every layout that is promised, real data from end to end, and every way to get it wrong."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from devo.errors import InputError
from tests.tolerances import VOXEL_RECTIFIED
from tests.utils.event_samples import HEIGHT, WIDTH, WRITERS, random_events, write_as
from utils.calibration import Calibration
from utils.datasets.registry import DATASETS, SequenceOptions, open_sequence, register
from utils.events import Events, EventWindow, StampWindows, open_events, write_events_h5, write_events_text
from utils.load_utils import video_iterator, voxel_iterator
from utils.undistort import rectify_map
from utils.voxel_grid import remove_hot_pixels, to_voxel_grid

PINHOLE = Calibration(WIDTH, HEIGHT, 60.0, 61.0, 31.5, 23.5)
DISTORTED = Calibration(WIDTH, HEIGHT, 60.0, 61.0, 31.5, 23.5, "radtan", (-0.2, 0.05, 0.001, -0.002))


def make_folder(folder: Path, events: Events, calibration: Calibration | None = PINHOLE) -> Path:
    """A folder as the simulator writes it."""
    folder.mkdir(exist_ok=True)
    write_events_h5(folder / "events.h5", events, None)
    if calibration is not None:
        (folder / "calib.yaml").write_text(yaml.safe_dump(calibration.as_dict()))
    return folder


def add_stamps(folder: Path, stamps_us: list[int]) -> None:
    (folder / "images_timestamps_us.txt").write_text("".join(f"{stamp}\n" for stamp in stamps_us))


def test_default_windows_and_voxels(tmp_path: Path) -> None:
    events = random_events(8000, seed=1, start_us=777)  # 200 ms
    sequence = open_sequence("generic", make_folder(tmp_path / "desk", events))
    frames = list(sequence.voxels())
    assert (sequence.name, sequence.width, sequence.height) == ("desk", WIDTH, HEIGHT)
    assert sequence.expected_length == len(frames) == 6
    for number, (voxel, intrinsics, t_us) in enumerate(frames):
        start = 777 + number * 33_333
        part = events.between(start, start + 33_333)
        assert (voxel.dtype, voxel.shape) == (torch.float32, (5, HEIGHT, WIDTH))
        assert torch.equal(voxel, to_voxel_grid(part.x, part.y, part.t_us, part.p, HEIGHT, WIDTH))
        assert (intrinsics.dtype, intrinsics.tolist()) == (torch.float64, [60.0, 61.0, 31.5, 23.5])
        assert t_us == start + 33_333 / 2
    assert sequence.ground_truth() is None


def test_distorted_events_are_rectified(tmp_path: Path) -> None:
    events = random_events(8000, seed=2)
    sequence = open_sequence("generic", make_folder(tmp_path, events, DISTORTED), SequenceOptions(window_ms=50))
    positions, intrinsics = rectify_map(DISTORTED)
    assert np.array_equal(sequence.intrinsics, intrinsics)
    voxel = next(sequence.voxels())[0]
    part = events.between(0, 50_000)
    x, y = positions[part.y, part.x].astype(np.float64).T
    reference = to_voxel_grid(x, y, part.t_us, part.p, HEIGHT, WIDTH)
    assert float((voxel - reference).abs().max()) < VOXEL_RECTIFIED


@pytest.mark.parametrize("kind", WRITERS)
def test_every_event_format_is_found(kind: str, tmp_path: Path) -> None:
    events = random_events(3000, seed=3)
    suffix = WRITERS[kind][0]
    write_as(kind, tmp_path, events).rename(tmp_path / f"walk{suffix}")
    (tmp_path / "calib.yaml").write_text(yaml.safe_dump(PINHOLE.as_dict()))
    (tmp_path / "groundtruth.txt").write_text("0.0 0 0 0 0 0 0 1\n")
    (tmp_path / "motion.txt").write_text("0.5 -1.0 0.1\n")
    np.save(tmp_path / "flow.npy", np.zeros((1, 2, 4, 4)))
    sequence = open_sequence("generic", tmp_path, SequenceOptions(window_events=1000))
    assert sequence.describe()["files"]["events"] == str(tmp_path / f"walk{suffix}")
    assert [t for _, _, t in sequence.voxels()] == [
        (events.t_us[first] + events.t_us[first + 999]) / 2 for first in (0, 1000, 2000)]


def test_windows_between_images_and_their_rules(tmp_path: Path) -> None:
    events = random_events(8000, seed=4)
    folder = make_folder(tmp_path, events)
    stamps = [-5000 + 20_000 * number for number in range(12)]
    add_stamps(folder, stamps)

    def times(**options: object) -> list[float]:
        sequence = open_sequence("generic", folder, SequenceOptions(**options))  # type: ignore[arg-type]
        found = [t for _, _, t in sequence.voxels()]
        assert sequence.expected_length in (len(found), None)
        return found

    inside = [stamp for stamp in stamps[:-1] if stamp + 10_000 <= events.t_us[-1] + 1]
    assert times() == [stamp + 10_000 for stamp in inside]
    assert times(stride=3) == [stamp + 10_000 for stamp in inside[::3]]
    assert times(window_dt_ms=8)[:3] == [stamp + 4000 for stamp in inside[:3]]
    assert times(start_us=15_000, stop_us=75_000) == [25_000, 45_000, 65_000]
    assert times(window_ms=40)[0] == events.t_us[0] + 20_000
    assert len(times(window_events=500)) == 16


@pytest.mark.parametrize(("name", "text"), [
    ("images_timestamps_us.txt", "100000\n120000\n140000\n"),
    ("images_timestamps_us.txt", "# us\n1e5\n120000.0\n140000.0\n"),
    ("images.txt", "0.100000001 images/a.png\n0.12 images/b.png\n0.14 images/c.png\n"),
    ("images.txt", "# id timestamp name\n0 0.1 a.png\n1 0.12 b.png\n2 0.14 c.png\n"),
    ("image_timestamps.txt", "100000\n120000\n140000\n"), ("image_timestamps.txt", "0.1\n0.12\n0.14\n"),
])
def test_spellings_of_image_stamps(name: str, text: str, tmp_path: Path) -> None:
    folder = make_folder(tmp_path, random_events(8000, seed=5))
    (folder / name).write_text(text)
    sequence = open_sequence("generic", folder)
    assert [t for _, _, t in sequence.voxels()] == [110_000, 130_000]


def test_empty_windows_are_skipped_and_counted(tmp_path: Path) -> None:
    early, late = random_events(100, seed=6), random_events(100, seed=7, start_us=94_000)
    both = Events.concatenate([early, late])
    sequence = open_sequence("generic", make_folder(tmp_path, both), SequenceOptions(window_ms=10))
    assert sequence.describe()["counts"] is None
    frames = list(sequence.voxels())
    assert len(frames) == 2
    description = json.loads(json.dumps(sequence.describe()))
    assert description["counts"] == {"windows": 10, "empty_windows": 8, "events": 200}
    assert description["windows"]["expected"] == 10
    assert description["intrinsics_fx_fy_cx_cy"] == [60.0, 61.0, 31.5, 23.5]


def test_two_passes_are_independent(tmp_path: Path) -> None:
    sequence = open_sequence("generic", make_folder(tmp_path, random_events(8000, seed=8)))
    first, second = sequence.voxels(), sequence.voxels()
    assert all(torch.equal(one[0], other[0]) for one, other in zip(first, second, strict=True))


def test_ground_truth_and_images(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, random_events(8000, seed=9), DISTORTED)
    add_stamps(folder, [0, 50_000, 100_000])
    (folder / "groundtruth.txt").write_text("# t[s] tx ty tz qx qy qz qw\n0.1 1 2 3 0 0 0 1\n0.2 4 5 6 0 0 1 0\n")
    (folder / "images").mkdir()
    for number in (0, 1, 10):  # unpadded names sort as numbers
        cv2.imwrite(str(folder / "images" / f"{number}.png"), np.full((HEIGHT, WIDTH), 20 * number + 10, np.uint8))
    sequence = open_sequence("generic", folder)
    stamps_us, world_T_cam = sequence.ground_truth()  # type: ignore[misc]
    assert stamps_us.tolist() == [100_000, 200_000]
    assert world_T_cam.tolist() == [[1, 2, 3, 0, 0, 0, 1], [4, 5, 6, 0, 0, 1, 0]]
    frames = list(sequence.frames())
    assert [t for _, _, t in frames] == [0, 50_000, 100_000]
    assert [int(image[0, HEIGHT // 2, WIDTH // 2]) for image, _, _ in frames] == [10, 30, 210]
    assert (frames[0][0].dtype, frames[0][0].shape) == (torch.uint8, (3, HEIGHT, WIDTH))
    assert frames[0][1].tolist() == sequence.intrinsics.tolist()
    cropped = open_sequence("generic", folder, SequenceOptions(start_us=1, stride=2))
    assert [t for _, _, t in cropped.frames()] == [50_000]


def test_colour_images_come_as_bgr(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, random_events(3000))
    (folder / "images.txt").write_text("0.0 images/a.png\n0.02 images/b.png\n")
    (folder / "images").mkdir()
    for name in "ab":
        cv2.imwrite(str(folder / "images" / f"{name}.png"), np.full((HEIGHT, WIDTH, 3), (1, 2, 3), np.uint8))
    image = next(open_sequence("generic", folder).frames())[0]
    assert image[:, 5, 5].tolist() == [1, 2, 3]


def test_event_file_alone(tmp_path: Path) -> None:
    write_events_text(tmp_path / "walk.txt", random_events(8000, seed=10))
    options = SequenceOptions(intrinsics=(60, 61, 31.5, 23.5), image_size=(WIDTH, HEIGHT))
    sequence = open_sequence("generic", tmp_path / "walk.txt", options)
    assert (sequence.name, sequence.intrinsics.tolist()) == ("walk", [60, 61, 31.5, 23.5])
    assert len(list(sequence.voxels())) == 6
    (tmp_path / "cam.txt").write_text("60 61 31.5 23.5 -0.2 0.05 0.001 -0.002")
    other = open_sequence("generic", tmp_path / "walk.txt",
                          SequenceOptions(calib=tmp_path / "cam.txt", image_size=(WIDTH, HEIGHT)))
    assert other.describe()["events_are_rectified"]
    with pytest.raises(InputError, match="no calibration .*--calib FILE, or --intrinsics"):
        open_sequence("generic", tmp_path / "walk.txt")
    with pytest.raises(InputError, match="sensor size is unknown; with --intrinsics pass also --image_size"):
        open_sequence("generic", tmp_path / "walk.txt", SequenceOptions(intrinsics=(60, 61, 31.5, 23.5)))
    with pytest.raises(InputError, match="cam.txt: .*sensor size is not in the file"):
        open_sequence("generic", tmp_path / "walk.txt", SequenceOptions(calib=tmp_path / "cam.txt"))


def test_sensor_size_from_the_event_file(tmp_path: Path) -> None:
    write_events_h5(tmp_path / "events.h5", random_events(3000), sensor_size=(WIDTH, HEIGHT))
    (tmp_path / "calib.txt").write_text("60 61 31.5 23.5")
    assert open_sequence("generic", tmp_path).width == WIDTH
    (tmp_path / "calib.txt").unlink()
    (tmp_path / "calib.yaml").write_text(yaml.safe_dump({**PINHOLE.as_dict(), "width": 100}))
    with pytest.raises(InputError, match=r"made for 100x48 pixels, but .*events.h5 says a sensor of \(64, 48\)"):
        open_sequence("generic", tmp_path)


def test_wrong_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_sequence("generic", tmp_path / "nowhere")
    with pytest.raises(InputError, match="no event file, expected events.h5"):
        open_sequence("generic", tmp_path)
    (tmp_path / "notes.txt").write_text("hello\n")
    with pytest.raises(InputError, match=r"no event file.*tried: .*notes.txt: line 1"):
        open_sequence("generic", tmp_path)
    make_folder(tmp_path, random_events(3000), None)
    with pytest.raises(InputError, match="no calibration"):
        open_sequence("generic", tmp_path)
    (tmp_path / "calib.txt").write_text("60 61 31.5 23.5")
    (tmp_path / "calib.json").write_text("{}")
    with pytest.raises(InputError, match=r"several calibrations \(calib.json, calib.txt\)"):
        open_sequence("generic", tmp_path)
    write_events_text(tmp_path / "events.txt", random_events(10))
    with pytest.raises(InputError, match=r"several event files \(events.h5, events.txt\)"):
        open_sequence("generic", tmp_path)
    with pytest.raises(InputError, match="a generic recording has one camera"):
        open_sequence("generic", tmp_path, SequenceOptions(side="right"))


def test_parts_that_do_not_fit_together(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, random_events(3000))
    with pytest.raises(InputError, match="window_dt_ms needs image stamps"):
        open_sequence("generic", folder, SequenceOptions(window_dt_ms=5))
    with pytest.raises(InputError, match="the recording has no images"):
        next(open_sequence("generic", folder).frames())
    with pytest.raises(InputError, match="none of the 0 windows holds events, which span 0 us to"):
        next(open_sequence("generic", folder, SequenceOptions(start_us=10**9)).voxels())
    add_stamps(folder, [10**9, 2 * 10**9])
    with pytest.raises(InputError, match="do not overlap, check clocks and units"):
        open_sequence("generic", folder)
    add_stamps(folder, [0, 10, 5])
    with pytest.raises(InputError, match="image stamp 2 is 5.0 us and not later"):
        open_sequence("generic", folder)
    add_stamps(folder, [0, 10_000])
    (folder / "images").mkdir()
    with pytest.raises(InputError, match="0 images but 2 image stamps"):
        open_sequence("generic", folder)
    for name in "ab":
        (folder / "images" / f"{name}.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="cannot read image .*a.png"):
        next(open_sequence("generic", folder).frames())
    write_events_h5(folder / "events.h5", Events(np.full(3, 200, np.uint16), np.full(3, 2, np.uint16),
                                                 np.arange(3), np.zeros(3, np.uint8)))
    with pytest.raises(InputError, match=r"x = 200 is outside the sensor of 64x48 pixels"):
        open_sequence("generic", folder)


@pytest.mark.parametrize(("text", "message"), [
    ("", "no stamps in the file"), ("a b c d\n", "line 1 has 4 columns"), ("1\n2 3\n", "line 2 has 2 columns"),
    ("soon\n", "line 1: 'soon' is not a number"), ("nan\n", "not finite"), ("1e300\n", "out of any range"),
    ("5\n", "expected at least 2"),
])
def test_damaged_stamps(text: str, message: str, tmp_path: Path) -> None:
    folder = make_folder(tmp_path, random_events(300))
    (folder / "images_timestamps_us.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        open_sequence("generic", folder)


@pytest.mark.parametrize("wrong", [
    {"side": "top"}, {"stride": 0}, {"window_ms": 5, "window_events": 9}, {"window_ms": 0}, {"window_events": -1},
    {"window_dt_ms": float("nan")}, {"start_us": 5, "stop_us": 5}, {"intrinsics": (1, 2, 3)}, {"image_size": (0, 5)},
    {"calib": Path("a"), "intrinsics": (1, 1, 1, 1)},
])
def test_options_that_make_no_sense(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError):
        SequenceOptions(**wrong)  # type: ignore[arg-type]


def test_unknown_data_sets_are_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown data set 'kitti', known are: .*generic"):
        open_sequence("kitti", tmp_path)
    with pytest.raises(InputError, match="registered twice"):
        register("generic", "again")(DATASETS["generic"].open)
    assert all(spec.name == name and spec.summary for name, spec in DATASETS.items())


def test_real_recording_from_end_to_end(shared_data: Path) -> None:
    folder = shared_data / "slider_depth_chunk"
    sequence = open_sequence("generic", folder, SequenceOptions(image_size=(240, 180), window_ms=10))
    frames = list(sequence.voxels())
    assert len(frames) == sequence.expected_length == 17
    stamps_us, world_T_cam = sequence.ground_truth()  # type: ignore[misc]
    assert (len(stamps_us), world_T_cam.shape) == (339, (339, 7))
    by_count = open_sequence("generic", folder, SequenceOptions(image_size=(240, 180), window_events=5000))
    assert len(list(by_count.voxels())) == 10
    counts = sequence.describe()["counts"]
    with open_events(folder / "events_chunk.txt") as reader:
        assert counts["events"] == len(reader.read(3811, 3811 + 170_000))
    with pytest.raises(InputError, match=r"calib.txt: .*pass the image size"):
        open_sequence("generic", folder)


def test_custom_stamps_by_overriding_one_method(tmp_path: Path) -> None:
    """What a data set with another convention does: the stamp of a frame is the end of its window."""
    from utils.datasets.sequence import Sequence

    class EndStamps(Sequence):
        def frame_stamp_us(self, index: int, window: EventWindow) -> float:
            return window.stop_us

    folder = make_folder(tmp_path, random_events(3000))
    sequence = EndStamps("own", folder, SequenceOptions(), size=(WIDTH, HEIGHT), intrinsics=[1, 1, 1, 1],
                         open_reader=lambda: open_events(folder / "events.h5"), hot_pixel_stds=3.0,
                         windows=StampWindows(np.array([0, 10_000, 20_000])))
    frames = list(sequence.voxels())
    assert [t for _, _, t in frames] == [10_000, 20_000]
    part = random_events(3000).between(0, 10_000)
    unfiltered = to_voxel_grid(part.x, part.y, part.t_us, part.p, HEIGHT, WIDTH)
    assert torch.equal(frames[0][0], remove_hot_pixels(unfiltered, 3.0))
    assert not torch.equal(frames[0][0], unfiltered)


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    """Ten times the events need no more memory to stream."""
    peaks = []
    for count in (60_000, 600_000):
        folder = make_folder(tmp_path / str(count), random_events(count, seed=11, longest_gap_us=2))
        write_events_text(folder / "events.txt", random_events(count, seed=11, longest_gap_us=2))
        (folder / "events.h5").unlink()
        sequence = open_sequence("generic", folder, SequenceOptions(window_ms=5))
        tracemalloc.start()
        for _ in sequence.voxels():
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


def test_folders_of_images_and_voxels(tmp_path: Path) -> None:
    import h5py

    for number in (2, 10, 1):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((8, 12), number, np.uint8))
        with h5py.File(tmp_path / f"{number:010d}.h5", "w") as stream:
            stream["voxel"] = np.full((5, 8, 12), number, np.float16)
    (tmp_path / "stamps.txt").write_text("100\n200\n300\n")
    images = list(video_iterator(tmp_path, tmp_path / "stamps.txt", intrinsics=[10, 10, 6, 4], scale=0.5))
    assert [(int(image[0, 0, 0]), t) for image, _, t in images] == [(1, 100), (2, 200), (10, 300)]
    assert (images[0][0].shape, images[2][1].tolist()) == ((3, 4, 6), [5, 5, 3, 2])  # scaled once, not per frame
    voxels = list(voxel_iterator(tmp_path, stride=2))
    assert [(float(voxel[0, 0, 0]), t) for voxel, _, t in voxels] == [(1, 0), (10, 2)]
    assert voxels[0][0].dtype == torch.float32
    (tmp_path / "stamps.txt").write_text("100\n200\n")
    with pytest.raises(InputError, match="2 stamps for 3 .png files"):
        next(video_iterator(tmp_path, tmp_path / "stamps.txt"))
    with pytest.raises(InputError, match="no .jpg files"):
        next(video_iterator(tmp_path, ext=".jpg"))
    with pytest.raises(InputError, match="is not a folder"):
        next(voxel_iterator(tmp_path / "nothing"))
