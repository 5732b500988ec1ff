"""From raw files of fpv, rpg, ecd and hku through the script, the reader and the tracker, as a user does it."""

from __future__ import annotations

from pathlib import Path

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
from tests.utils.raw_layouts.recording import IMAGE_INTERVAL_US, RawRecording
from tests.utils.raw_layouts.stereo_bags import write_hku, write_rpg
from tests.utils.raw_layouts.text_folders import write_ecd, write_fpv
from utils import load_utils
from utils.calibration import Calibration
from utils.datasets.sequence import Frame
from utils.preprocessing import hku, rpg
from utils.preprocessing.fpv import fpv_calibration
from utils.preprocessing.poses import times_transform

EPOCH_US = 1_540_000_000_000_000
INTERVAL_MS = IMAGE_INTERVAL_US / 1000
ECD_LINE = "199.0923665423112 198.8282855736583 132.192070777 110.712660011 -0.3684 0.15095 -0.000296 -0.00076 0.0"
ECD_CAMERA = Calibration(240, 180, 199.0923665423112, 198.8282855736583, 132.192070777, 110.712660011, "radtan",
                         (-0.3684, 0.15095, -0.000296, -0.00076, 0.0))
FPV_CAMERA, CAM_T_IMU = fpv_calibration(Path("indoor_forward_3_davis_with_gt"))


def absolute(recording: RawRecording, camera: Calibration) -> RawRecording:
    """The recording on the sensor of the camera, on the clock of most raw files."""
    return recording.on_sensor((camera.width, camera.height)).later(EPOCH_US)


def stereo_products(side: str, events: str) -> set[str]:
    return {f"tss_imgs_us_{side}.txt", f"gt_stamped_{side}.txt", f"evs_{side}{events}", f"calib_undist_{side}.txt",
            f"rectify_map_{side}.h5", f"images_undistorted_{side}"}


CASES = {
    "fpv": Case(
        camera=FPV_CAMERA, window_ms=INTERVAL_MS,
        write=lambda root, recording: write_fpv(root, absolute(recording, FPV_CAMERA), cam_T_imu=CAM_T_IMU),
        products={"t_offset_us.txt", "images_timestamps_us.txt", "stamped_groundtruth_us.txt",
                  "stamped_groundtruth_us_cam.txt", "calib_undist.txt", "rectify_map.h5", "images_undistorted"}),
    "ecd": Case(
        camera=ECD_CAMERA, window_ms=None, clock_us=0,
        write=lambda root, recording: write_ecd(root, recording, ECD_LINE),
        products={"tss_us.txt", "calib_undist.txt", "rectify_map.h5", "images_undistorted"}),
    "rpg": Case(
        camera=rpg.CAMERAS["left"], window_ms=INTERVAL_MS,
        write=lambda root, recording: write_rpg(root, absolute(recording, rpg.CAMERAS["left"]),
                                                np.linalg.inv(rpg.MARKER_T_CAM["left"])).with_suffix(""),
        products=stereo_products("left", ".txt"), arguments=("--side", "left"),
        iterator_arguments=(("side", "left"),)),
    "hku": Case(
        camera=hku.CAMERAS["right"], window_ms=INTERVAL_MS, side="right", seen=RawRecording.right,
        write=lambda root, recording: write_hku(root, absolute(recording, hku.CAMERAS["right"]),
                                                np.linalg.inv(hku.BODY_T_CAM["left"])).with_suffix(""),
        products=stereo_products("right", ".h5"), arguments=("--side", "right"),
        iterator_arguments=(("side", "right"),)),
}


@pytest.fixture(scope="module", params=CASES)
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Prepared[Case]:
    return prepare(request.param, CASES[request.param], tmp_path_factory.mktemp(request.param))


@pytest.fixture(scope="module")
def frames(prepared: Prepared[Case]) -> list[Frame]:
    return list(prepared.sequence.voxels())


@pytest.fixture(scope="module")
def own_frames(prepared: Prepared[Case]) -> list[Frame]:
    return list(prepared.own.voxels())


def test_products_are_listed_and_complete(prepared: Prepared[Case]) -> None:
    images = check_products(prepared)
    assert all((prepared.folder / name).exists() for name in prepared.case.products)
    assert len(list(images.iterdir())) == len(prepared.recording.images)


def test_voxels_equal_those_of_a_recording_of_ones_own(prepared: Prepared[Case], frames: list[Frame],
                                                       own_frames: list[Frame]) -> None:
    np.testing.assert_allclose(prepared.sequence.intrinsics, prepared.own.intrinsics, atol=1e-9, rtol=0)
    # The last image begins no window; fpv leaves out the one before it too.
    expected = len(prepared.recording.stamps_us) - (2 if prepared.dataset == "fpv" else 1)
    assert len(frames) == prepared.sequence.expected_length == expected
    assert all(voxel.abs().sum() > 100 for voxel, _, _ in frames)
    assert_same_frames(frames, own_frames[:expected], within_us=1e-6)


@pytest.mark.filterwarnings("ignore:random.*untrained network")
def test_trajectory_equals_that_of_a_recording_of_ones_own(frames: list[Frame], own_frames: list[Frame]) -> None:
    assert len(frames[:10]) == 10
    assert_same_trajectory(frames[:10], own_frames[:10], within_us=1e-6)


def test_ground_truth_is_that_of_the_camera(prepared: Prepared[Case]) -> None:
    truth = prepared.sequence.ground_truth()
    assert truth is not None
    stamps_us, world_T_cam = truth
    np.testing.assert_allclose(stamps_us, prepared.recording.poses_us, atol=1e-3, rtol=0)
    expected = prepared.recording.world_T_cam
    if prepared.case.side == "right":  # the recording knows where the left camera is
        left_T_right = np.linalg.inv(hku.BODY_T_CAM["left"]) @ hku.BODY_T_CAM["right"]
        assert left_T_right[0, 3] == pytest.approx(0.0597, abs=1e-3), "the right camera is to the right"
        expected = times_transform(expected, left_T_right)
    # Published transforms are orthonormal up to 1e-6 only, and fpv writes six decimals.
    np.testing.assert_allclose(world_T_cam, expected, atol=5e-6, rtol=0)


def test_published_iterator_and_images(prepared: Prepared[Case], frames: list[Frame]) -> None:
    iterator = getattr(load_utils, f"{prepared.dataset}_evs_iterator")
    sequence = prepared.sequence
    stream = iterator(prepared.folder, **dict(prepared.case.iterator_arguments))
    for given, other in zip(stream, frames, strict=True):
        assert torch.equal(given[0], other[0]) and given[2] == other[2]
    images = list(sequence.frames())
    np.testing.assert_allclose([t for _, _, t in images], prepared.recording.stamps_us, atol=1e-6, rtol=0)
    assert images[0][0].shape == (3, sequence.height, sequence.width)
    assert images[0][1].tolist() == sequence.intrinsics.tolist()
    centre = (slice(sequence.height // 2 - 20, sequence.height // 2 + 20), slice(sequence.width // 2 - 20, None))
    spread = [float(image[0][centre].float().std()) for image, _, _ in images]
    assert min(spread) > 3, "the images show something"
