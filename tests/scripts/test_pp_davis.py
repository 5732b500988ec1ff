"""From raw files of fpv, rpg, ecd and hku through the script, the reader and the tracker, as a user does it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from devo.config import Config
from tests.tolerances import VOXEL_RECTIFIED
from tests.utils.raw_layouts.recording import IMAGE_INTERVAL_US, RawRecording, simulated, write_generic
from tests.utils.raw_layouts.stereo_bags import write_hku, write_rpg
from tests.utils.raw_layouts.text_folders import write_ecd, write_fpv
from utils import load_utils
from utils.calibration import Calibration
from utils.datasets.registry import Recording, SequenceOptions, open_sequence
from utils.datasets.sequence import Frame
from utils.eval_utils import track
from utils.preprocessing import PREPROCESSORS, hku, rpg
from utils.preprocessing.fpv import fpv_calibration
from utils.preprocessing.poses import times_transform

ROOT = Path(__file__).resolve().parents[2]
EPOCH_US = 1_540_000_000_000_000
ECD_LINE = "199.0923665423112 198.8282855736583 132.192070777 110.712660011 -0.3684 0.15095 -0.000296 -0.00076 0.0"
ECD_CAMERA = Calibration(240, 180, 199.0923665423112, 198.8282855736583, 132.192070777, 110.712660011, "radtan",
                         (-0.3684, 0.15095, -0.000296, -0.00076, 0.0))
FPV_CAMERA, CAM_T_IMU = fpv_calibration(Path("indoor_forward_3_davis_with_gt"))


@dataclass(frozen=True)
class Case:
    """A data set, its camera, and its raw form of the simulated recording; `side` of a stereo recording."""

    camera: Calibration
    write: Callable[[Path, RawRecording], Path]
    folder: str
    products: set[str]
    side: str | None = None
    clock_us: int = EPOCH_US
    """On what clock the raw files are; the products start at 0, those of ecd stay on it."""


def stereo_products(side: str, events: str) -> set[str]:
    return {f"tss_imgs_us_{side}.txt", f"gt_stamped_{side}.txt", f"evs_{side}{events}", f"calib_undist_{side}.txt",
            f"rectify_map_{side}.h5", f"images_undistorted_{side}"}


CASES = {
    "fpv": Case(FPV_CAMERA, lambda root, recording: write_fpv(root, recording, cam_T_imu=CAM_T_IMU),
                "indoor_forward_3_davis_with_gt",
                {"t_offset_us.txt", "images_timestamps_us.txt", "stamped_groundtruth_us.txt",
                 "stamped_groundtruth_us_cam.txt", "calib_undist.txt", "rectify_map.h5", "images_undistorted"}),
    "ecd": Case(ECD_CAMERA, lambda root, recording: write_ecd(root, recording, ECD_LINE), "slider_test",
                {"tss_us.txt", "calib_undist.txt", "rectify_map.h5", "images_undistorted"}, clock_us=0),
    "rpg": Case(rpg.CAMERAS["left"],
                lambda root, recording: write_rpg(root, recording, np.linalg.inv(rpg.MARKER_T_CAM["left"])),
                "desk_test", stereo_products("left", ".txt"), "left"),
    "hku": Case(hku.CAMERAS["right"],
                lambda root, recording: write_hku(root, recording, np.linalg.inv(hku.BODY_T_CAM["left"])),
                "test_walk", stereo_products("right", ".h5"), "right"),
}


@dataclass(frozen=True)
class Prepared:
    """A preprocessed recording, what the script said, and the same recording as one's own."""

    dataset: str
    case: Case
    folder: Path
    recording: RawRecording
    output: str
    sequence: Recording
    own: Recording
    frames: list[Frame]
    own_frames: list[Frame]


@pytest.fixture(scope="module", params=CASES)
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    dataset, case = request.param, CASES[request.param]
    root = tmp_path_factory.mktemp(dataset) / "nested" / "raw"
    root.mkdir(parents=True)
    recording = simulated().on_sensor((case.camera.width, case.camera.height))
    case.write(root, recording.later(case.clock_us))
    # From another folder, with a trailing slash, as users do.
    command = [sys.executable, str(ROOT / "scripts" / f"pp_{dataset}.py"), "--indir", f"{root.parent.name}/"]
    done = subprocess.run(command + (["--side", case.side] if case.side else []), cwd=root.parents[1], timeout=300,
                          capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False)
    assert done.returncode == 0, done.stderr
    assert f"preprocessing {dataset}: 100%" in done.stderr
    view = recording.right() if case.side == "right" else recording
    first_us = min(view.events.t_us[0], view.stamps_us[0], view.poses_us[0]) if case.clock_us else 0
    view = view.later(-int(first_us))
    sequence = open_sequence(dataset, root / case.folder, SequenceOptions(side=case.side or "left"))
    own = open_sequence("generic", write_generic(root / "own", view, case.camera), SequenceOptions(
        window_dt_ms=None if dataset == "ecd" else IMAGE_INTERVAL_US / 1000))
    return Prepared(dataset, case, root / case.folder, view, done.stdout, sequence, own, list(sequence.voxels()),
                    list(own.voxels()))


def test_products_are_listed_and_complete(prepared: Prepared) -> None:
    names = set(prepared.output.strip().partition(": ")[2].split(", "))
    assert names == prepared.case.products
    assert all((prepared.folder / name).exists() for name in names)
    side = prepared.case.side or "left"
    needed = PREPROCESSORS[prepared.dataset].outputs(prepared.folder, side)
    assert all(path.exists() for path in needed)
    images = next(name for name in names if name.startswith("images_undistorted"))
    assert len(list((prepared.folder / images).iterdir())) == len(prepared.recording.images)


def test_voxels_equal_those_of_a_recording_of_ones_own(prepared: Prepared) -> None:
    np.testing.assert_allclose(prepared.sequence.intrinsics, prepared.own.intrinsics, atol=1e-9, rtol=0)
    # The last image begins no window; fpv leaves out the one before it too.
    expected = len(prepared.recording.stamps_us) - (2 if prepared.dataset == "fpv" else 1)
    assert len(prepared.frames) == prepared.sequence.expected_length == expected
    for (voxel, intrinsics, t_us), (own_voxel, own_intrinsics, own_t_us) in zip(prepared.frames, prepared.own_frames):
        assert (voxel.dtype, intrinsics.dtype) == (torch.float32, torch.float64)
        assert voxel.abs().sum() > 100
        assert float((voxel - own_voxel).abs().max()) <= VOXEL_RECTIFIED
        assert torch.allclose(intrinsics, own_intrinsics, atol=1e-9, rtol=0)
        assert t_us == pytest.approx(own_t_us, abs=1e-6)


@pytest.mark.filterwarnings("ignore:random.*untrained network")
def test_trajectory_equals_that_of_a_recording_of_ones_own(prepared: Prepared,
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("devo.devo.PROBE_FLOW", 0.0)  # an untrained network sees no motion, so none is asked for
    config = Config({"PATCHES_PER_FRAME": 8, "MIXED_PRECISION": False})
    results = [track(iter(frames[:10]), config, "random:0:16,16,8", seed=0)
               for frames in (prepared.frames, prepared.own_frames)]
    assert results[0].poses.shape == (10, 7)
    assert np.ptp(results[0].poses[:, :3], axis=0).max() > 0
    np.testing.assert_array_equal(results[0].poses, results[1].poses)
    np.testing.assert_allclose(results[0].tstamps, results[1].tstamps, atol=1e-6, rtol=0)


def test_ground_truth_is_that_of_the_camera(prepared: Prepared) -> None:
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


def test_published_iterator_and_images(prepared: Prepared) -> None:
    iterator = getattr(load_utils, f"{prepared.dataset}_evs_iterator")
    side = {"side": prepared.case.side} if prepared.case.side else {}
    sequence = prepared.sequence
    for given, other in zip(iterator(prepared.folder, **side), prepared.frames, strict=True):
        assert torch.equal(given[0], other[0]) and given[2] == other[2]
    frames = list(sequence.frames())
    np.testing.assert_allclose([t for _, _, t in frames], prepared.recording.stamps_us, atol=1e-6, rtol=0)
    assert frames[0][0].shape == (3, sequence.height, sequence.width)
    assert frames[0][1].tolist() == sequence.intrinsics.tolist()
    centre = (slice(sequence.height // 2 - 20, sequence.height // 2 + 20), slice(sequence.width // 2 - 20, None))
    spread = [float(image[0][centre].float().std()) for image, _, _ in frames]
    assert min(spread) > 3, "the images show something"
