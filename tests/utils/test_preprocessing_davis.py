"""Preprocessing of fpv, rpg, ecd and hku against the recording it came from, and all ways to get raw files wrong."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from devo.errors import InputError
from tests.tolerances import RECTIFIED_INTRINSICS, VOXEL_RECTIFIED
from tests.utils import bag_samples
from tests.utils.raw_layouts import stereo_bags
from tests.utils.raw_layouts.recording import EPOCH_US
from tests.utils.raw_layouts.recording import random_recording as recording
from tests.utils.raw_layouts.text_folders import write_ecd, write_fpv
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.events import Events, open_events
from utils.preprocessing import fpv, hku, preprocess, rpg
from utils.preprocessing.bag_camera import BagCamera
from utils.preprocessing.products import Products
from utils.preprocessing.registry import PreprocessOptions
from utils.trajectory_io import read_tum
from utils.undistort import ImageUndistorter

FPV_NAMES = ("indoor_45_2_davis_with_gt", "indoor_forward_7_davis", "outdoor_forward_1_davis_with_gt")
ECD_LINE = "200 201 120 90 -0.3 0.1 0.001 -0.001 0.01"


def same_rotation(found: np.ndarray, expected: np.ndarray) -> None:
    """Quaternions may differ in sign."""
    signs = np.sign((found * expected).sum(axis=1, keepdims=True))
    assert_allclose(found * signs, expected, atol=3e-6, rtol=0)


# --- fpv and ecd ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FPV_NAMES)
def test_fpv_products(name: str, tmp_path: Path) -> None:
    raw = recording(fpv.SIZE)
    calibration, cam_T_imu = fpv.fpv_calibration(Path(name))
    folder = write_fpv(tmp_path, raw, name, cam_T_imu if name.endswith("_with_gt") else None)
    preprocess("fpv", tmp_path)
    first_us = EPOCH_US + (1000 if name.endswith("_with_gt") else int(raw.events.t_us[0]) - EPOCH_US)
    assert (folder / "t_offset_us.txt").read_text() == f"{first_us:.18e}\n"
    stamps = (folder / "images_timestamps_us.txt").read_text()
    assert stamps == "".join(f"{stamp - first_us}\n" for stamp in raw.stamps_us)
    names = sorted(path.name for path in (folder / "images_undistorted").iterdir())
    assert names == [f"image_0_{number}.png" for number in range(4)]
    intrinsics = np.array([float(word) for word in (folder / "calib_undist.txt").read_text().split()])
    image = cv2.imread(str(folder / "images_undistorted" / "image_0_2.png"), cv2.IMREAD_UNCHANGED)
    assert_array_equal(image, ImageUndistorter(calibration, intrinsics)(raw.images[2]))
    body, camera = folder / "stamped_groundtruth_us.txt", folder / "stamped_groundtruth_us_cam.txt"
    if not name.endswith("_with_gt"):
        assert not body.exists() and not camera.exists()
        return
    lines = body.read_text().splitlines()
    assert lines[0] == "# #timestamp[us] px py pz qx qy qz qw"
    assert re.fullmatch(r"0\.0{18}e\+00( -?\d\.\d{18}e[-+]\d\d){7}", lines[1])
    assert re.fullmatch(r"20000\.0{6}( -?\d\.\d{6}){7}", camera.read_text().splitlines()[1])
    truth = read_tum(camera, time_unit="us")
    assert truth.t_us.tolist() == (raw.poses_us - first_us).tolist()
    assert_allclose(truth.world_T_cam[:, :3], raw.world_T_cam[:, :3], atol=2e-6, rtol=0)
    same_rotation(truth.world_T_cam[:, 3:], raw.world_T_cam[:, 3:])


@pytest.mark.parametrize(("name", "published"), [
    ("indoor_45_", (135.29799493, 135.29295377, 151.01224477, 137.39037438)),
    ("indoor_forward_", (135.45626292, 135.45086260, 151.10589536, 137.37601792)),
    ("outdoor_forward_", (136.12412003, 136.02354565, 152.52961820, 146.20836658))])
def test_fpv_cameras_are_the_published_ones(name: str, published: tuple[float, ...], tmp_path: Path) -> None:
    intrinsics = Products(PreprocessOptions()).pinhole(tmp_path / "c.txt", fpv.fpv_calibration(Path(name + "1"))[0])
    assert_allclose(intrinsics, published, atol=RECTIFIED_INTRINSICS, rtol=0)


@pytest.mark.parametrize(("module", "side", "published"), [
    (rpg, "left", (167.38830677, 179.24263322, 99.94250301, 69.36924166)),
    (rpg, "right", (168.07708463, 181.32196053, 107.71986970, 87.82252030)),
    (hku, "left", (200.82175742, 220.43605967, 176.94063180, 129.84157393)),
    (hku, "right", (211.66952719, 230.76523071, 180.95720372, 137.24648312))])
def test_stereo_cameras_are_the_published_ones(module: object, side: str, published: tuple[float, ...],
                                               tmp_path: Path) -> None:
    intrinsics = Products(PreprocessOptions()).pinhole(tmp_path / "c.txt", module.CAMERAS[side])  # type: ignore
    assert_allclose(intrinsics, published, atol=RECTIFIED_INTRINSICS, rtol=0)


def test_an_existing_offset_stays_the_clock_of_fpv(tmp_path: Path) -> None:
    raw = recording(fpv.SIZE)
    folder = write_fpv(tmp_path, raw, "indoor_forward_7_davis")
    (folder / "t_offset_us.txt").write_text(f"{EPOCH_US:.18e}\n")
    made = preprocess("fpv", folder, images=False)[folder]
    assert {path.name for path in made} == {"images_timestamps_us.txt", "calib_undist.txt", "rectify_map.h5"}
    assert (folder / "images_timestamps_us.txt").read_text().split() == ["5000", "35000", "65000", "95000"]
    assert preprocess("fpv", folder, images=False) == {folder: []}


def test_ecd_products(tmp_path: Path) -> None:
    raw = recording(start_us=0)
    folder = write_ecd(tmp_path, raw, ECD_LINE)
    preprocess("ecd", tmp_path)
    assert (folder / "tss_us.txt").read_text() == "5000.0\n35000.0\n65000.0\n95000.0\n"
    assert sorted(path.name for path in (folder / "images_undistorted").iterdir()) == [
        f"frame_{number:08d}.png" for number in range(4)]
    truth = open_sequence("ecd", folder).ground_truth()
    assert truth is not None and truth[0].tolist() == raw.poses_us.tolist()


def break_name(folder: Path) -> None:
    folder.rename(folder.with_name("outdoor_45_1_davis"))


FPV_WRONG = {
    "unknown calibration": (break_name, "the calibration is found by the name of the sequence, expected one with "
                                        "indoor_45_, indoor_forward_, outdoor_forward_"),
    "no ground truth": (lambda folder: (folder / "groundtruth.txt").unlink(), "groundtruth.txt is missing"),
    "damaged ground truth": (lambda folder: (folder / "groundtruth.txt").write_text("#\n1 2 3\n"), "3 columns"),
    "empty events": (lambda folder: (folder / "events.txt").write_text(""), "events.txt: the file is empty"),
    "event outside": (lambda folder: (folder / "events.txt").write_text("1.0 400 5 1\n"), "x = 400 is outside"),
    "no stamps": (lambda folder: (folder / "images.txt").write_text("# nothing\n"), "no stamps in the file"),
    "an image is gone": (lambda folder: (folder / "img" / "image_0_2.png").unlink(), "1 of 4 images are missing"),
    "an image is damaged": (lambda folder: (folder / "img" / "image_0_2.png").write_bytes(b"x"),
                            "image_0_2.png: the file is missing or damaged"),
    "an image of another size": (
        lambda folder: cv2.imwrite(str(folder / "img" / "image_0_2.png"), np.zeros((4, 4), np.uint8)),
        "image_0_2.png: image of 4x4 pixels, but the calibration is for 346x260"),
    "no names": (lambda folder: (folder / "images.txt").write_text("1.5\n1.6\n"), "holds no names of images"),
    "stamps are words": (lambda folder: (folder / "images.txt").write_text("0 soon img/a.png\n"), "'soon' is not"),
}


@pytest.mark.parametrize("problem", FPV_WRONG)
def test_wrong_fpv_recordings(problem: str, tmp_path: Path) -> None:
    spoil, message = FPV_WRONG[problem]
    folder = write_fpv(tmp_path, recording(fpv.SIZE), FPV_NAMES[0], fpv.fpv_calibration(Path(FPV_NAMES[0]))[1])
    spoil(folder)
    with pytest.raises(InputError, match=message):
        preprocess("fpv", tmp_path)
    assert not list(tmp_path.rglob(".*")), "nothing half-written is left"


@pytest.mark.parametrize(("name", "text", "message"), [
    ("calib.txt", "200 200 120 90", "no distortion coefficients, expected fx fy cx cy k1 k2 p1 p2 k3"),
    ("calib.txt", "200 200 120", "3 numbers"), ("calib.txt", "200 200 500 90 0 0 0 0", "principal point"),
    ("images.txt", "", "no stamps"), ("calib.txt", None, "cannot read calibration"),
    ("events.txt", None, "events.txt is missing")])
def test_wrong_ecd_recordings(name: str, text: str | None, message: str, tmp_path: Path) -> None:
    folder = write_ecd(tmp_path, recording(start_us=0), ECD_LINE)
    if text is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(text)
    with pytest.raises(InputError, match=message):
        preprocess("ecd", folder)


def test_a_real_recording_equals_the_same_files_read_as_ones_own(shared_data: Path, tmp_path: Path) -> None:
    source, folder = shared_data / "slider_depth_chunk", tmp_path / "slider_depth"
    (folder / "images").mkdir(parents=True)
    for name, new in (("events_chunk.txt", "events.txt"), ("images.txt",) * 2, ("calib.txt",) * 2,
                      ("groundtruth.txt",) * 2):
        shutil.copyfile(source / name, folder / new)
    own = open_sequence("generic", folder, SequenceOptions(image_size=(240, 180)))
    expected = list(own.voxels())
    preprocess("ecd", tmp_path, images=False)
    sequence = open_sequence("ecd", folder)
    frames = list(sequence.voxels())
    assert len(expected) == 4 and len(frames) == 5, "the last window is covered by a fifth, which ecd keeps"
    for (voxel, intrinsics, t_us), (own_voxel, own_intrinsics, own_t_us) in zip(frames, expected):
        assert float((voxel - own_voxel).abs().max()) <= VOXEL_RECTIFIED
        assert intrinsics.tolist() == own_intrinsics.tolist()
        assert abs(t_us - own_t_us) < 1.0  # recordings of one's own have whole microseconds
    assert frames[0][2] == 0.5 * 38_766.001


# --- bags ----------------------------------------------------------------------------------------------------


def test_messages_of_the_writer_are_those_of_rosbags() -> None:
    """The packed events of the test bags are what rosbags itself reads and writes."""
    events = recording().events[:40]
    store = bag_samples.typestore("dvs_msgs", 1)
    data = stereo_bags.event_message(events, (240, 180))
    message = store.deserialize_ros1(data, stereo_bags.EVENT_ARRAY)
    assert [event.x for event in message.events] == events.x.tolist()
    assert bytes(store.serialize_ros1(message, stereo_bags.EVENT_ARRAY)) == data


@pytest.mark.parametrize("prefix", ["/davis_{side}", "/davis/{side}"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_rpg_products(prefix: str, side: str, tmp_path: Path) -> None:
    raw = recording()
    view = raw if side == "left" else raw.right()
    stereo_bags.write_rpg(tmp_path, raw, np.linalg.inv(rpg.MARKER_T_CAM["left"]), prefix=prefix, extra_ns=300)
    folder = tmp_path / "desk_test"
    preprocess("rpg", tmp_path, side=side)
    stamps = (folder / f"tss_imgs_us_{side}.txt").read_text()
    assert stamps == "".join(f"{stamp - EPOCH_US - 1000:.12f}\n" for stamp in raw.stamps_us)
    rows = np.loadtxt(folder / f"evs_{side}.txt")
    assert_allclose(rows[:, 0], view.events.t_us - EPOCH_US - 1000 + 0.3, atol=1e-9, rtol=0)
    for column, name in enumerate(("x", "y", "p"), start=1):
        assert_array_equal(rows[:, column], getattr(view.events, name))
    assert re.fullmatch(r"\d+\.3000 \d+ \d+ [01]", (folder / f"evs_{side}.txt").read_text().splitlines()[0])
    truth = read_tum(folder / f"gt_stamped_{side}.txt", time_unit="us")
    assert truth.t_us.tolist() == (raw.poses_us - EPOCH_US - 1000).tolist()
    if side == "left":
        assert_allclose(truth.world_T_cam[:, :3], raw.world_T_cam[:, :3], atol=3e-6, rtol=0)
        same_rotation(truth.world_T_cam[:, 3:], raw.world_T_cam[:, 3:])
    calibration = rpg.CAMERAS[side]
    intrinsics = np.array([float(word) for word in (folder / f"calib_undist_{side}.txt").read_text().split()])
    image = cv2.imread(str(folder / f"images_undistorted_{side}" / f"{1:012d}.png"), cv2.IMREAD_UNCHANGED)
    assert_array_equal(image, ImageUndistorter(calibration, intrinsics)(view.images[1]))
    with h5py.File(folder / f"rectify_map_{side}.h5") as stream:
        assert stream["rectify_map"].shape == (180, 240, 2)


@pytest.mark.parametrize("module", [rpg, hku])
def test_right_cameras_are_on_the_right(module: object) -> None:
    """Both cameras of a rig look the same way, and the right one has positive x in the frame of the left one."""
    transforms = module.MARKER_T_CAM if module is rpg else module.BODY_T_CAM  # type: ignore
    left_T_right = np.linalg.inv(transforms["left"]) @ transforms["right"]
    assert left_T_right[0, 3] == pytest.approx(0.148 if module is rpg else 0.0597, abs=1e-3)
    assert left_T_right[2, 2] > 0.99


def test_the_simulated_rpg_recording(tmp_path: Path) -> None:
    raw = recording((346, 260))
    stereo_bags.write_rpg_simulation(tmp_path, raw, [210.0, 211.0, 170.0, 130.0])
    folder = tmp_path / "simulation_3planes"
    preprocess("rpg", tmp_path)
    assert (folder / "calib_undist_left.txt").read_text() == "210.0 211.0 170.0 130.0"
    assert not (folder / "rectify_map_left.h5").exists()
    image = cv2.imread(str(folder / "images_undistorted_left" / f"{3:012d}.png"), cv2.IMREAD_UNCHANGED)
    assert_array_equal(image, raw.images[3])
    sequence = open_sequence("rpg", folder)
    assert (sequence.width, sequence.height) == (346, 260)
    truth = sequence.ground_truth()
    assert truth is not None
    assert_allclose(truth[1][:, :3], raw.world_T_cam[:, :3], atol=1e-12, rtol=0)
    assert len(list(sequence.voxels())) == 3


def test_hku_products(tmp_path: Path) -> None:
    raw = recording((346, 260))
    stereo_bags.write_hku(tmp_path, raw, np.linalg.inv(hku.BODY_T_CAM["left"]))
    folder = tmp_path / "test_walk"
    preprocess("hku", tmp_path / "test_walk.bag")
    with h5py.File(folder / "evs_left.h5") as stream:
        kinds = {name: stream[name].dtype for name in ("events/x", "events/y", "events/t", "events/p", "ms_to_idx")}
        assert kinds == {"events/x": np.dtype("<u2"), "events/y": np.dtype("<u2"), "events/t": np.dtype("<u4"),
                         "events/p": np.dtype("u1"), "ms_to_idx": np.dtype("<u8")}
        t_us = stream["events/t"][()].astype(np.int64)
        assert_array_equal(t_us, raw.events.t_us - EPOCH_US - 1000)
        assert_array_equal(stream["events/p"][()], raw.events.p)
        milliseconds = np.arange(t_us[-1] // 1000 + 1) * 1000
        assert_array_equal(stream["ms_to_idx"][()], np.searchsorted(t_us, milliseconds))
    truth = open_sequence("hku", folder).ground_truth()
    assert truth is not None
    assert_allclose(truth[1][:, :3], raw.world_T_cam[:, :3], atol=3e-6, rtol=0)


def test_a_bag_is_found_from_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stereo_bags.write_rpg(tmp_path / "a", recording(count=50), np.eye(4), name="walk.synced")
    folder = tmp_path / "a" / "walk"
    for root in (tmp_path, tmp_path / "a", tmp_path / "a" / "walk.synced.bag", folder):
        assert list(preprocess("rpg", root, images=False)) == [folder]
    monkeypatch.chdir(folder)
    assert list(preprocess("rpg", "../../a", images=False)) == [Path("../../a/walk")]
    stereo_bags.write_rpg(tmp_path / "a", recording(count=50), np.eye(4), name="walk.other")
    with pytest.raises(InputError, match=r"found several \(walk.other.bag, walk.synced.bag\)"):
        preprocess("rpg", folder)


def test_interrupted_work_goes_on_where_it_ended(tmp_path: Path) -> None:
    stereo_bags.write_hku(tmp_path, recording((346, 260)), np.eye(4))
    folder = tmp_path / "test_walk"
    everything = preprocess("hku", tmp_path)[folder]
    content = {path.name: path.read_bytes() for path in everything if path.is_file()}
    for gone in ("evs_left.h5", "gt_stamped_left.txt"):
        (folder / gone).unlink()
    (folder / "images_undistorted_left" / f"{0:012d}.png").unlink()
    made = preprocess("hku", tmp_path)[folder]
    assert {path.name for path in made} == {"evs_left.h5", "gt_stamped_left.txt", "images_undistorted_left"}
    assert content == {name: (folder / name).read_bytes() for name in content}
    assert preprocess("hku", tmp_path) == {folder: []}


def test_bags_without_what_is_needed(tmp_path: Path) -> None:
    raw = recording(count=60)

    def bag(name: str, *skip: str) -> Path:
        return stereo_bags.write_rpg(tmp_path, raw, np.eye(4), name=name, skip=skip)

    with pytest.raises(InputError, match=r"no topic /davis_left/events or /davis/left/events in the bag, found "
                                         r".*/davis_right/events \(dvs_msgs/msg/EventArray\)"):
        preprocess("rpg", bag("blind", "/davis_left/events"))
    with pytest.raises(InputError, match="no topic /davis_left/image_raw in the bag"):
        preprocess("rpg", bag("dark", "/davis_left/image_raw"))
    with pytest.raises(InputError, match="no topic /davis_right/events or .*check the data set and the side"):
        preprocess("rpg", bag("mono", "/davis_right/events"), side="right")
    preprocess("rpg", bag("lost", "/optitrack/davis_stereo"), images=False)
    assert open_sequence("rpg", tmp_path / "lost").ground_truth() is None
    empty = stereo_bags.write_bag(tmp_path / "empty.bag", bag_samples.typestore("dvs_msgs", 1), [])
    with pytest.raises(InputError, match="found nothing; check the data set"):
        preprocess("rpg", empty)
    damaged = bag("damaged")
    damaged.write_bytes(damaged.read_bytes()[:5000])
    with pytest.raises(InputError, match="damaged or unreadable bag"):
        preprocess("rpg", damaged)
    (tmp_path / "text.bag").write_text("no bag at all\n")
    with pytest.raises(InputError, match="text.bag: damaged or unreadable bag"):
        preprocess("rpg", tmp_path / "text.bag")


def test_bags_without_the_package_that_reads_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = stereo_bags.write_rpg(tmp_path, recording(count=20), np.eye(4))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(InputError, match="reading bags needs the package rosbags; get it with pip install rosbags"):
        preprocess("rpg", path)


def test_damaged_bags_are_refused_or_read(tmp_path: Path) -> None:
    """Random byte flips and cuts lead to a message or to data, never to another exception."""
    raw, store = recording((32, 24), count=200), bag_samples.typestore("dvs_msgs", 1)
    path = stereo_bags.write_bag(tmp_path / "desk_test.bag", store, [
        *stereo_bags.event_entries("/davis_left/events", raw, 0),
        *stereo_bags.image_entries(store, "/davis_left/image_raw", raw),
        *stereo_bags.pose_entries(store, "/optitrack/davis_stereo", raw, np.eye(4), "geometry_msgs/msg/PoseStamped"),
    ], compression=None)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    outcomes = set()
    for number in range(30):
        damaged = bytearray(whole[:rng.integers(len(whole) // 2, len(whole))] if number % 4 == 0 else whole)
        for place in rng.integers(0, len(damaged), 2).tolist():
            damaged[place] = int(rng.integers(0, 256))
        path.write_bytes(damaged)
        try:
            with BagCamera(path) as bag:
                events, images = bag.first_topic(["/davis_left/events"]), bag.first_topic(["/davis_left/image_raw"])
                first_ns = bag.first_event_ns(events, "error")
                count = sum(len(block.events) for block in bag.event_blocks(events, first_ns, (32, 24), "error"))
                stamps, poses = bag.image_stamps_ns(images), bag.poses("/optitrack/davis_stereo")
                shapes = {image.shape for _, image in bag.images(images)}
            outcomes.add((count, len(stamps), len(poses or ()), len(shapes)))
        except InputError as error:
            assert "desk_test.bag" in str(error)
            outcomes.add(None)
    assert {None, (200, 4, 6, 1)} <= outcomes


def test_bags_of_silent_cameras(tmp_path: Path) -> None:
    raw = recording(count=60)
    nothing = Events.empty()
    store = bag_samples.typestore("dvs_msgs", 1)
    quiet = [(EPOCH_US * 1000, "/davis_left/events", stereo_bags.EVENT_ARRAY,
              stereo_bags.event_message(nothing, raw.size))]
    images = list(stereo_bags.image_entries(store, "/davis_left/image_raw", raw))
    with pytest.raises(InputError, match="topic /davis_left/events holds no events"):
        preprocess("hku", stereo_bags.write_bag(tmp_path / "quiet.bag", store, [*quiet, *images]))
    swapped = [(received, "/davis_left/image_raw", kind, data) for received, _, kind, data in
               stereo_bags.event_entries("x", raw, 0)]
    events = list(stereo_bags.event_entries("/davis_left/events", raw, 0))
    with pytest.raises(InputError, match="image_raw is dvs_msgs/msg/EventArray, expected sensor_msgs"):
        preprocess("hku", stereo_bags.write_bag(tmp_path / "swapped.bag", store, [*events, *swapped]))
    with pytest.raises(InputError, match=r"x = \d+ is outside the sensor of 240x180"):
        wide = recording((346, 260), count=200)
        preprocess("rpg", stereo_bags.write_bag(tmp_path / "wide.bag", store, [
            *stereo_bags.event_entries("/davis_left/events", wide, 0), *images]))
    assert not list((tmp_path / "wide").glob("evs*")) and not list((tmp_path / "wide").glob(".*"))


def test_unsorted_events_are_refused_or_sorted(tmp_path: Path) -> None:
    raw = recording((346, 260), count=400)
    store = bag_samples.typestore("dvs_msgs", 1)
    first, second = raw.events[:200], raw.events[200:]
    entries = [(EPOCH_US * 1000 + number, "/davis_left/events", stereo_bags.EVENT_ARRAY,
                stereo_bags.event_message(part, raw.size)) for number, part in enumerate((second, first))]
    entries += stereo_bags.image_entries(store, "/davis_left/image_raw", raw)
    path = stereo_bags.write_bag(tmp_path / "back.bag", store, entries)
    with pytest.raises(InputError, match="event 200 of /davis_left/events.*not sorted|negative time stamp"):
        preprocess("hku", path)
    preprocess("hku", path, on_unsorted="sort")
    with open_events(tmp_path / "back" / "evs_left.h5") as reader:
        found = Events.concatenate(list(reader.chunks()))
    assert_array_equal(found.t_us - found.t_us[0], raw.events.t_us - raw.events.t_us[0])


@pytest.mark.parametrize(("encoding", "channels"), [("mono8", 1), ("8UC1", 1), ("bgr8", 3), ("rgb8", 3)])
def test_pixels_of_messages(encoding: str, channels: int, tmp_path: Path) -> None:
    store = bag_samples.typestore("dvs_msgs", 1)
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, channels)).astype(np.uint8)

    def entries(encoding: str, height: int) -> Iterator[stereo_bags.Entry]:
        kind = "sensor_msgs/msg/Image"
        message = store.types[kind](stereo_bags.header(store, 5), height, 7, encoding, 0, 7 * channels, pixels.ravel())
        yield 5000, "/image", kind, bytes(store.serialize_ros1(message, kind))

    with BagCamera(stereo_bags.write_bag(tmp_path / "a.bag", store, list(entries(encoding, 5)))) as bag:
        ((stamp_ns, image),) = bag.images("/image")
    assert stamp_ns == 5000
    assert_array_equal(image.reshape(5, 7, channels), pixels[..., ::-1] if encoding == "rgb8" else pixels)
    for wrong, height, message in (("mono16", 5, "are 'mono16', expected 8 bits"), (encoding, 6, "expected 6 rows")):
        path = stereo_bags.write_bag(tmp_path / f"{wrong}{height}.bag", store, list(entries(wrong, height)))
        with BagCamera(path) as bag, pytest.raises(InputError, match=message):
            list(bag.images("/image"))


def test_only_the_wanted_side_is_read(tmp_path: Path) -> None:
    stereo_bags.write_hku(tmp_path, recording((346, 260), count=60), np.eye(4))
    preprocess("hku", tmp_path, side="right", images=False)
    names = {path.name for path in (tmp_path / "test_walk").iterdir()}
    assert names == {"tss_imgs_us_right.txt", "gt_stamped_right.txt", "evs_right.h5", "calib_undist_right.txt",
                     "rectify_map_right.h5"}
    with pytest.raises(InputError, match="evs_left.h5.* missing"):
        open_sequence("hku", tmp_path / "test_walk", SequenceOptions(side="left"))
