"""From raw files of vector, tumvie, eds and mvsec through the script, the reader and the tracker, as a user does it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch

from tests.scripts.prepared_recordings import (
    Case,
    Prepared,
    assert_same_frames,
    assert_same_trajectory,
    check_products,
    prepare,
)
from tests.utils.raw_layouts.hdf5_folders import (
    MVSEC_CAMERAS,
    TUMVIE_CAMERAS,
    UNIX_US,
    VECTOR_EVENT_CAMERA,
    write_eds,
    write_mvsec,
    write_tumvie,
    write_vector,
)
from tests.utils.raw_layouts.recording import IMAGE_INTERVAL_US, simulated
from utils import load_utils
from utils.calibration import Calibration
from utils.datasets.eds import CAMERAS as EDS_CAMERAS
from utils.datasets.sequence import Frame
from utils.preprocessing import PREPROCESSORS, preprocess
from utils.undistort import rectify_map, undistorted_intrinsics
from utils.voxel_grid import remove_hot_pixels, resize_voxel, to_voxel_grid

FRAMES = 9
TUMVIE_WINDOW_MS = 66
"""Windows of the iterator for TUM-VIE; the other tests use its default."""


STAMP_US = 0.3
"""How exact a stamp on the clock of Unix microseconds is in float64."""


@dataclass(frozen=True, kw_only=True)
class Hdf5Case(Case):
    """Further: the size (width, height) of smaller voxel grids, the frame camera, what is done to events and voxels."""

    small: tuple[int, int]
    frame_camera: Calibration
    balance: float = 0.0
    hot_pixel_stds: float | None = None


INTERVAL_MS = IMAGE_INTERVAL_US / 1000
CASES = {
    "vector": Hdf5Case(
        camera=VECTOR_EVENT_CAMERA, side="right", window_ms=2 * INTERVAL_MS, clock_us=UNIX_US, small=(160, 120),
        write=lambda root, recording: write_vector(root, recording, "right"),
        products={"tss_imgs_us_right.txt", "poses_evs_right.txt", "poses_gray_right.txt", "calib_undist_evs_right.txt",
                  "calib_undist_regular_right.txt", "rectify_map_right.h5", "images_undistorted_right"},
        frame_camera=Calibration(1224, 1024, 886.2, 886.6, 610.6, 514.6, "radtan",
                                 (-0.315, 0.104, 0.0004, -0.0006, 0.0)),
        arguments=("--side", "right"), iterator_arguments=(("side", "right"),)),
    "tumvie": Hdf5Case(
        camera=TUMVIE_CAMERAS[3], side="right", window_ms=INTERVAL_MS, clock_us=0, small=(256, 144),
        write=lambda root, recording: write_tumvie(root, recording, "right"),
        products={"calibration.json", "calib_undist.json", "rectify_map_right.h5", "right_images_undistorted",
                  "image_timestamps_right.txt", "image_exposures_right.txt"},
        frame_camera=TUMVIE_CAMERAS[1], balance=0.5, hot_pixel_stds=6.0,
        arguments=("--camId", "1"), iterator_arguments=(("camID", 3), ("dT_ms", TUMVIE_WINDOW_MS))),
    "eds": Hdf5Case(
        camera=EDS_CAMERAS["calib0"]["evs"], window_ms=INTERVAL_MS / 2, small=(160, 120), write=write_eds,
        products={"t_offset_us.txt", "images_timestamps_us.txt", "stamped_groundtruth_us.txt",
                  "images_undistorted_calib0", "calib_undist_calib0.json", "rectify_map_calib0.h5",
                  "calib_undist_calib1.json", "rectify_map_calib1.h5"},
        frame_camera=EDS_CAMERAS["calib0"]["rgb"], hot_pixel_stds=10.0),
    "mvsec": Hdf5Case(
        camera=MVSEC_CAMERAS["right"], side="right", window_ms=None, clock_us=UNIX_US, small=(172, 128),
        write=lambda root, recording: write_mvsec(root, {"left": recording, "right": recording}),
        products={"indoor_flying1_data.hdf5", "indoor_flying1_gt.hdf5", "tss_imgs_us_right.txt",
                  "calib_undist_right.txt", "rectify_map_right.h5", "images_undistorted_right"},
        frame_camera=MVSEC_CAMERAS["right"],
        arguments=("--side", "right"), iterator_arguments=(("side", "right"),)),
}


@pytest.fixture(scope="module", params=CASES)
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Prepared[Hdf5Case]:
    return prepare(request.param, CASES[request.param], tmp_path_factory.mktemp(request.param))


def rectified_frames(prepared: Prepared[Hdf5Case], window_us: int) -> Iterator[Frame]:
    """Frames of the recording of one's own at the windows of the data set, rectified as the data set demands."""
    if not prepared.case.balance:
        for voxel, intrinsics, t_us in prepared.own.voxels():  # frames of mvsec have the stamp of their windows' end
            yield voxel, intrinsics, t_us + (IMAGE_INTERVAL_US / 2 if prepared.dataset == "mvsec" else 0)
        return
    camera = prepared.case.camera
    positions, undistorted = rectify_map(camera, balance=prepared.case.balance)
    with prepared.own.open_events() as reader:
        for start_us in prepared.recording.stamps_us.tolist():
            part = reader.read(start_us, start_us + window_us)
            x, y = positions[part.y, part.x].astype(np.float64).T
            voxel = to_voxel_grid(x, y, part.t_us, part.p, camera.height, camera.width)
            yield voxel, torch.from_numpy(undistorted), start_us + window_us / 2


def own_frames(prepared: Prepared[Hdf5Case], count: int, window_us: int = IMAGE_INTERVAL_US,
               size: tuple[int, int] | None = None) -> list[Frame]:
    """The first frames of the recording of one's own, treated as those of the data set; resized to `size`."""
    camera, stds = prepared.case.camera, prepared.case.hot_pixel_stds
    width, height = size or (camera.width, camera.height)
    scale = torch.tensor([width / camera.width, height / camera.height] * 2, dtype=torch.float64)
    frames: list[Frame] = []
    for voxel, intrinsics, t_us in itertools.islice(rectified_frames(prepared, window_us), count):
        resized = voxel if size is None else resize_voxel(voxel, height, width)
        frames.append((resized if stds is None else remove_hot_pixels(resized, stds), intrinsics * scale, t_us))
    return frames


def test_products_are_listed_and_complete(prepared: Prepared[Hdf5Case]) -> None:
    images = check_products(prepared)
    assert len([file for file in images.iterdir() if file.suffix in (".png", ".jpg")]) == len(simulated().images)


def test_voxels_equal_those_of_a_recording_of_ones_own(prepared: Prepared[Hdf5Case]) -> None:
    stamps_us, stream = prepared.recording.stamps_us, prepared.sequence.voxels()
    if prepared.dataset == "mvsec":  # the first window ends at the first image, so it has none before it
        assert next(stream)[2] == stamps_us[0]
    # vector and eds leave out the last image; the recording ends half an interval behind it
    assert prepared.sequence.expected_length == len(stamps_us) - (prepared.dataset in ("vector", "eds"))
    frames = list(itertools.islice(stream, 2))
    assert all(voxel.abs().sum() > 100 for voxel, _, _ in frames)
    assert_same_frames(frames, own_frames(prepared, 2), STAMP_US)


@pytest.mark.filterwarnings("ignore:random.*untrained network")
def test_published_iterator_and_trajectory(prepared: Prepared[Hdf5Case], monkeypatch: pytest.MonkeyPatch) -> None:
    """The iterator makes smaller voxel grids for the tracker; the trajectory is that of a recording of one's own."""
    monkeypatch.setattr("devo.devo.MIN_EVENT_SHARE", 0.0)  # the recording fills a small part of a large sensor
    width, height = prepared.case.small
    iterator = getattr(load_utils, f"{prepared.dataset}_evs_iterator")
    stream = iterator(f"{prepared.folder}/", H=height, W=width, **dict(prepared.case.iterator_arguments))
    if prepared.dataset == "mvsec":
        next(stream)
    frames = list(itertools.islice(stream, FRAMES))
    own = own_frames(prepared, FRAMES, TUMVIE_WINDOW_MS * 1000, prepared.case.small)
    assert len(frames) == FRAMES and frames[0][0].shape == (5, height, width)
    assert_same_frames(frames, own, STAMP_US)
    assert_same_trajectory(frames, own, STAMP_US)


def test_ground_truth(prepared: Prepared[Hdf5Case]) -> None:
    """For vector the pose of the event camera, for mvsec that of the left camera; tumvie and eds publish a body's."""
    truth = prepared.sequence.ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth[0], prepared.recording.poses_us, atol=0.3, rtol=0)
    np.testing.assert_allclose(truth[1] * np.sign(truth[1][:, 6:]), prepared.recording.world_T_cam
                               * np.sign(prepared.recording.world_T_cam[:, 6:]), atol=1e-9, rtol=0)


def test_images(prepared: Prepared[Hdf5Case]) -> None:
    frames = list(prepared.sequence.frames())
    camera = prepared.case.frame_camera
    np.testing.assert_allclose([t for _, _, t in frames], prepared.recording.stamps_us, atol=0.3, rtol=0)
    image, intrinsics, _ = frames[4]
    assert image.shape == (3, camera.height, camera.width)
    np.testing.assert_allclose(intrinsics.numpy(), undistorted_intrinsics(camera), atol=1e-9, rtol=0)
    K, D = camera.camera_matrix, np.array(camera.coefficients)
    fx, fy, cx, cy = intrinsics.tolist()
    new = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    raw = simulated().on_sensor((camera.width, camera.height)).images[4]
    if camera.distortion_model == "fisheye":
        expected = cv2.fisheye.undistortImage(raw, K, D, Knew=new, new_size=(camera.width, camera.height))
    else:
        expected = cv2.undistort(raw, K, D, newCameraMatrix=new)
    off = np.abs(image[0].numpy().astype(int) - expected.astype(int))
    # fixed-point positions here, besides bicubic images of vector and mvsec and JPEG files of tumvie
    assert np.mean(off[expected > 0]) < (0.1 if prepared.dataset == "eds" else 2.0)
    assert np.ptp(expected[expected > 0]) > 100


def test_a_second_run_makes_only_what_is_missing(prepared: Prepared[Hdf5Case]) -> None:
    root, case = prepared.folder.parent, prepared.case
    assert list(preprocess(prepared.dataset, root, side=case.side).values()) == [[]]
    lost = next(file for file in PREPROCESSORS[prepared.dataset].outputs(prepared.folder, case.side)
                if file.name.startswith("rectify_map"))
    before = lost.read_bytes()
    lost.unlink()
    assert list(preprocess(prepared.dataset, prepared.folder, side=case.side).values()) == [[lost]]
    assert lost.read_bytes() == before
