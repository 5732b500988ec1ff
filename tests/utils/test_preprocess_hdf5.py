"""Preprocessing of vector, tumvie, eds and mvsec: published numbers, folders made elsewhere, raw files gone wrong."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import yaml

from devo.errors import InputError
from tests.tolerances import RECTIFIED_INTRINSICS, RECTIFY_MAP_SAMPLES
from tests.utils.prepared_folders import steady_events
from tests.utils.raw_layouts.hdf5_folders import (
    MVSEC_CAMERAS,
    TUMVIE_CAMERAS,
    UNIX_US,
    VECTOR_CAM0_T,
    shift_eds_in_place,
    write_eds,
    write_mvsec,
    write_tumvie,
    write_vector,
)
from tests.utils.raw_layouts.recording import RawRecording
from utils.calibration import read_calibration
from utils.datasets.eds import CAMERAS as EDS_CAMERAS
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.preprocessing import preprocess
from utils.preprocessing.poses import times_transform
from utils.preprocessing.tumvie import find_calibration
from utils.trajectory_io import read_tum
from utils.undistort import read_rectify_map, rectify_map, undistorted_intrinsics

OFF = False  # images are undistorted in tests/scripts/test_pp_hdf5.py


@pytest.fixture(scope="module")
def recording() -> RawRecording:
    """Eight gray images and an event every half millisecond, without a simulator."""
    rng = np.random.default_rng(2)
    stamps_us = 2000 + 33_000 * np.arange(8)
    poses_us = np.arange(1000, 250_000, 10_000)
    quaternions = rng.normal(0, 0.1, (len(poses_us), 4)) + [0, 0, 0, 1]
    poses = np.concatenate([rng.normal(0, 1, (len(poses_us), 3)),
                            quaternions / np.linalg.norm(quaternions, axis=1)[:, None]], axis=1)
    images = [rng.integers(0, 255, (48, 64)).astype(np.uint8) for _ in stamps_us]
    return RawRecording((64, 48), steady_events(280_000), stamps_us, images, poses_us, poses)


def test_cameras_of_eds_are_the_published_ones() -> None:
    """Numbers of OpenCV 4.8.1 and later; older ones are covered by the table of `tests/utils/test_undistort.py`."""
    expected = {
        ("calib0", "rgb"): (714.96414354, 739.21174683, 288.82334884, 227.48578477),
        ("calib0", "evs"): (563.65523732, 564.69866054, 310.98424167, 216.02888940),
        ("calib1", "evs"): (549.49982300, 552.12587515, 311.42540100, 218.55328315),
    }
    for (calibration, camera), values in expected.items():
        found = undistorted_intrinsics(EDS_CAMERAS[calibration][camera])
        np.testing.assert_allclose(found, values, atol=RECTIFIED_INTRINSICS, rtol=0)
    older = [562.94122314, 563.57000732, 310.53467429, 215.59711647]
    positions, _ = rectify_map(EDS_CAMERAS["calib0"]["evs"], intrinsics=older)
    samples = [positions[0, 0], positions[479, 639], positions[240, 320]]
    np.testing.assert_allclose(samples, [[-0.1564, -0.0005], [638.1347, 479.3723], [317.5623, 238.4072]],
                               atol=RECTIFY_MAP_SAMPLES, rtol=0)


@pytest.mark.parametrize("beside", [True, False])
def test_poses_of_both_cameras_of_vector(beside: bool, recording: RawRecording, tmp_path: Path) -> None:
    """The calibrations may lie beside the sequence or in it; both sides go into one folder."""
    for side, gray in (("left", None), ("right", "cam1")):
        folder = write_vector(tmp_path, recording, side, frames=False, beside=beside)
        made = preprocess("vector", folder, side=side, images=OFF)[folder]
        assert {file.name for file in made} == {
            f"tss_imgs_us_{side}.txt", f"poses_evs_{side}.txt", f"poses_gray_{side}.txt",
            f"calib_undist_evs_{side}.txt", f"rectify_map_{side}.h5"}
        assert np.loadtxt(folder / f"tss_imgs_us_{side}.txt").tolist() == (recording.stamps_us + UNIX_US).tolist()
        event = read_tum(folder / f"poses_evs_{side}.txt", time_unit="us")
        assert event.t_us.tolist() == (recording.poses_us + UNIX_US).tolist()
        np.testing.assert_allclose(event.world_T_cam, recording.world_T_cam, atol=1e-9)
        event_T_cam0 = np.linalg.inv(VECTOR_CAM0_T["cam2" if side == "left" else "cam3"])
        to_gray = event_T_cam0 if gray is None else event_T_cam0 @ VECTOR_CAM0_T[gray]
        found = read_tum(folder / f"poses_gray_{side}.txt", time_unit="us").world_T_cam
        np.testing.assert_allclose(found, times_transform(recording.world_T_cam, to_gray), atol=1e-9)
    assert open_sequence("vector", folder, SequenceOptions(side="left")).ground_truth() is not None


def test_calibrations_of_tumvie(recording: RawRecording, tmp_path: Path) -> None:
    """A or B by name; the file describes events with balance 0.5 and the images as they are made, with balance 0."""
    for name, fx_shift in (("mocap-desk2", -40.0), ("mocap-6dof", 0.0)):
        folder = write_tumvie(tmp_path, recording, name=name, frames=False)
        preprocess("tumvie", folder, images=OFF)
        assert (folder / "calibration.json").is_file()
        content = json.loads((folder / "calib_undist.json").read_text())["value0"]
        assert [entry["intrinsics"]["fx"] - camera.fx
                for entry, camera in zip(content["intrinsics"], TUMVIE_CAMERAS)] == pytest.approx([fx_shift] * 4)
    for number, (entry, camera) in enumerate(zip(content["intrinsics_undistorted"], TUMVIE_CAMERAS)):
        expected = undistorted_intrinsics(camera, balance=0.0 if number < 2 else 0.5)
        assert list(entry.values()) == pytest.approx(expected.tolist())
    positions, intrinsics = rectify_map(TUMVIE_CAMERAS[2], balance=0.5)
    assert np.array_equal(read_rectify_map(folder / "rectify_map_left.h5"), positions)
    assert open_sequence("tumvie", folder).intrinsics.tolist() == pytest.approx(intrinsics.tolist())
    # the copies of an earlier run suffice
    (tmp_path / "alone").mkdir()
    shutil.copytree(folder, tmp_path / "alone" / name)
    (tmp_path / "alone" / name / "calib_undist.json").unlink()
    preprocess("tumvie", tmp_path / "alone", images=OFF)


def test_events_of_eds_stay_as_they_are(recording: RawRecording, tmp_path: Path) -> None:
    ours, theirs = (write_eds(tmp_path / name, recording, frames=False) for name in ("ours", "theirs"))
    before = (ours / "events.h5").read_bytes()
    preprocess("eds", tmp_path / "ours", images=OFF)
    assert (ours / "events.h5").read_bytes() == before
    assert np.loadtxt(ours / "t_offset_us.txt") == UNIX_US  # the published reader of this file reads it, too
    assert np.loadtxt(ours / "images_timestamps_us.txt").tolist() == recording.stamps_us.tolist()
    poses = np.loadtxt(ours / "stamped_groundtruth_us.txt")
    np.testing.assert_allclose(poses[:, 1:], recording.world_T_cam, atol=1e-15)
    assert poses[:, 0].tolist() == recording.poses_us.tolist()
    shift_eds_in_place(theirs)
    for overwrite in (False, True):  # the offset tells what was done to the events, so it is never computed again
        made = preprocess("eds", theirs, overwrite=overwrite, images=OFF)[theirs]
        assert "t_offset_us.txt" not in {file.name for file in made} and len(made) >= 2
        pairs = zip(open_sequence("eds", ours).voxels(), open_sequence("eds", theirs).voxels())
        for one, other in itertools.islice(pairs, 2):
            assert torch.equal(one[0], other[0]) and one[2] == other[2]
    (theirs / "t_offset_us.txt").unlink()  # shifted, but interrupted before the offset was written
    with pytest.raises(InputError, match="was interrupted, download the event file again"):
        preprocess("eds", theirs, images=OFF)


def test_existing_maps_and_cameras_are_kept_together(recording: RawRecording, tmp_path: Path) -> None:
    """A map without the file of its camera was made with the published numbers; a new camera would not fit it."""
    folder = write_eds(tmp_path, recording, frames=False)
    preprocess("eds", folder, images=OFF)
    (folder / "calib_undist_calib0.json").unlink()
    assert preprocess("eds", folder, images=OFF) == {folder: []}
    assert open_sequence("eds", folder).intrinsics[0] == 562.9412231445312
    made = preprocess("eds", folder, overwrite=True, images=OFF)[folder]
    assert {"calib_undist_calib0.json", "rectify_map_calib0.h5"} <= {file.name for file in made}


@pytest.mark.parametrize("start", ["root", "file", "folder to be made", "two levels up"])
def test_where_mvsec_may_be_started(start: str, recording: RawRecording, tmp_path: Path,
                                    monkeypatch: pytest.MonkeyPatch) -> None:
    """Dots in the path do no harm; the two files are linked, not copied."""
    root = tmp_path / "some.where" / "mvsec.v1"
    root.mkdir(parents=True)
    folder = write_mvsec(root, {"left": recording, "right": recording})
    monkeypatch.chdir(root)
    given = {"root": Path("./"), "file": Path("indoor_flying1_data.hdf5"), "folder to be made": folder,
             "two levels up": tmp_path}[start]
    for side in ("left", "right"):
        made = preprocess("mvsec", given, side=side, images=OFF)
        assert [path.resolve() for path in made] == [folder]
        camera = read_calibration(folder / f"calib_undist_{side}.txt", (346, 260))
        np.testing.assert_allclose(camera.intrinsics, undistorted_intrinsics(MVSEC_CAMERAS[side]), atol=1e-9)
    data = folder / "indoor_flying1_data.hdf5"
    assert data.samefile(root / data.name)
    assert list(preprocess("mvsec", folder, images=OFF).values()) == [[]]
    truth = open_sequence("mvsec", f"{folder}/").ground_truth()
    assert truth is not None
    np.testing.assert_allclose(np.abs(truth[1]), np.abs(recording.world_T_cam), atol=1e-9)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 3])


def change_yaml(file: Path, change: Callable[[dict], object]) -> None:
    content = yaml.safe_load(file.read_text())
    change(content)
    file.write_text(yaml.safe_dump(content))


def without_data(file: Path, name: str) -> None:
    with h5py.File(file, "r+") as stream:
        del stream[name]


BAD_RAW_FILES: list[tuple[str, str, Callable[[Path], object], str]] = [
    ("vector", "0_calib/left_event_camera_intrinsic_results.yaml", Path.unlink, "cannot read calibration"),
    ("vector", "0_calib/camera_mocap_extrinsic_results1.yaml", Path.unlink, "cannot read calibration"),
    ("vector", "0_calib", shutil.rmtree, "no calibrations; put the folder 0_calib of VECtor beside the sequence"),
    ("vector", "0_calib/small_scale_joint_camera_extrinsic_results.yaml",
     lambda file: change_yaml(file, lambda content: content.pop("cam2")), "no T_cam0_cam2 in cam2"),
    ("vector", "0_calib/camera_mocap_extrinsic_results1.yaml",
     lambda file: change_yaml(file, lambda content: content["cam0"].update(T_cam_body=[1.0] * 16)), "no rigid motion"),
    ("vector", "0_calib/camera_mocap_extrinsic_results1.yaml",
     lambda file: change_yaml(file, lambda content: content["cam0"].update(T_cam_body=[1.0] * 9)), "has 9 numbers"),
    ("vector", "corridors_walk/corridors_walk1.synced.left_event.hdf5", Path.unlink, "no *1.synced.left_event.hdf5"),
    ("vector", "corridors_walk/corridors_walk1.synced.left_camera/timestamp.txt", Path.unlink, "cannot read"),
    ("vector", "corridors_walk/corridors_walk1.synced.left_camera/timestamp.txt",
     lambda file: file.write_text("a\nb\n1.0 1.1\n1.1 1.2\n"), "images are 100.0 ms apart, expected 33.3"),
    ("vector", "corridors_walk/corridors_walk1.synced.left_camera/timestamp.txt",
     lambda file: file.write_text("a\nb\n1.0 now\n"), "expected begin and end of an exposure"),
    ("vector", "corridors_walk/corridors_walk1.synced.left_camera/timestamp.txt",
     lambda file: file.write_text("a\nb\n1.0 nan\n"), "stamp 0 is not finite"),
    ("vector", "corridors_walk/corridors_walk1.synced.gt.txt", lambda file: file.write_text("#\n#\n1 2 3\n"),
     "line 3 has 3 columns"),
    ("tumvie", "camera-calibrationB.json", Path.unlink, "no calibration; put camera-calibrationB.json"),
    ("tumvie", "camera-calibrationB.json", lambda file: file.write_text('{"value0": 5}'), "no camera 0"),
    ("tumvie", "mocap-1d-trans/mocap-1d-trans-events_left.h5", Path.unlink, "no *events_left.h5"),
    ("tumvie", "mocap-1d-trans/left_images/image_timestamps_left.txt", Path.unlink, "cannot read"),
    ("eds", "00_peanuts_dark/events.h5", Path.unlink, "no events.h5"),
    ("eds", "00_peanuts_dark/events.h5", cut, "damaged or unreadable HDF5 file"),
    ("eds", "00_peanuts_dark/stamped_groundtruth.txt", lambda file: file.write_text("#\n1 2\n"), "has 2 columns"),
    ("mvsec", "indoor_flying_calib/camchain-imucam-indoor_flying.yaml", Path.unlink, "cannot read calibration"),
    ("mvsec", "indoor_flying_calib/camchain-imucam-indoor_flying.yaml",
     lambda file: change_yaml(file, lambda content: content.pop("cam0")), "no intrinsics"),
    ("mvsec", "indoor_flying1_data.hdf5", cut, "damaged or unreadable HDF5 file"),
    ("mvsec", "indoor_flying1_data.hdf5", lambda file: without_data(file, "davis/left/image_raw_ts"),
     "dataset davis/left/image_raw_ts missing"),
]


@pytest.mark.parametrize(("dataset", "name", "damage", "message"), BAD_RAW_FILES)
def test_raw_files_gone_wrong(dataset: str, name: str, damage: Callable[[Path], object], message: str,
                              recording: RawRecording, tmp_path: Path) -> None:
    write_raw(dataset, tmp_path, recording)
    damage(tmp_path / name)
    with pytest.raises(InputError) as caught:
        preprocess(dataset, tmp_path, images=OFF)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def write_raw(dataset: str, root: Path, recording: RawRecording) -> None:
    if dataset == "mvsec":
        write_mvsec(root, {"left": recording})
    else:
        {"vector": write_vector, "tumvie": write_tumvie, "eds": write_eds}[dataset](root, recording, frames=False)


@pytest.mark.parametrize(("dataset", "message"), [
    ("vector", "no recording of vector found, expected folders with"), ("tumvie", "no recording of tumvie found"),
    ("eds", "recordings of eds have one camera"), ("mvsec", "dataset davis/right/image_raw_ts missing"),
])
def test_the_other_side_is_not_there(dataset: str, message: str, recording: RawRecording, tmp_path: Path) -> None:
    write_raw(dataset, tmp_path, recording)
    with pytest.raises(InputError, match=message):
        preprocess(dataset, tmp_path, side="right", images=OFF)


@pytest.mark.parametrize("dataset", ["vector", "tumvie", "eds"])
def test_images_that_do_not_fit_their_stamps(dataset: str, recording: RawRecording, tmp_path: Path) -> None:
    write_raw(dataset, tmp_path, recording)
    with pytest.raises(InputError, match="0 images for 8 stamps; unpack the recording again, or leave images out"):
        preprocess(dataset, tmp_path)


def test_only_the_names_of_a_sequence_choose_its_calibration(tmp_path: Path, recording: RawRecording) -> None:
    """Names of the folder, of a link to it, or of its event file; not those of the folders around it."""
    root = tmp_path / "mocap-desk-and-others"
    root.mkdir()
    for name, letter in (("mocap-6dof", "B"), ("skate-easy", "A")):
        folder = write_tumvie(root, recording, name=name, frames=False)
        event_file = next(folder.glob("*events_left.h5")).name
        assert find_calibration(folder, event_file).name == f"camera-calibration{letter}.json"
    (root / "loop-floor1").symlink_to(root / "mocap-6dof")
    assert find_calibration(root / "loop-floor1", "events_left.h5").name == "camera-calibrationA.json"
    assert find_calibration(root / "mocap-6dof", "mocap-desk2-events_left.h5").name == "camera-calibrationA.json"


@pytest.mark.parametrize("linked", ["sequence", "calibrations"])
def test_links(linked: str, recording: RawRecording, tmp_path: Path) -> None:
    """A sequence may be a link to another disk, with the calibrations beside the link or beside its target."""
    store, here = tmp_path / "store", tmp_path / "here"
    here.mkdir()
    folder = write_vector(store, recording, frames=False)
    (here / folder.name).symlink_to(folder)
    if linked == "calibrations":
        (store / "0_calib").rename(here / "0_calib")
    assert preprocess("vector", here, images=OFF)[here / folder.name]
    assert open_sequence("vector", here / folder.name).ground_truth() is not None
