"""From raw files of vector, tumvie, eds and mvsec through the script, the reader and the tracker, as a user does it."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from devo.config import Config
from tests.tolerances import VOXEL_RECTIFIED
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
from tests.utils.raw_layouts.recording import IMAGE_INTERVAL_US, RawRecording, simulated, write_generic
from utils import load_utils
from utils.calibration import Calibration
from utils.datasets.eds import CAMERAS as EDS_CAMERAS
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.datasets.sequence import Frame, Recording
from utils.eval_utils import track
from utils.preprocessing import PREPROCESSORS, preprocess
from utils.undistort import rectify_map, undistorted_intrinsics
from utils.voxel_grid import remove_hot_pixels, resize_voxel, to_voxel_grid

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 9
TUMVIE_WINDOW_MS = 66
"""Windows of the iterator for TUM-VIE; the other tests use its default."""


@dataclass(frozen=True)
class Case:
    """A data set, its camera, and how its raw form and its windows differ from those of the simulated recording."""

    camera: Calibration
    side: str
    write: Callable[[Path, RawRecording], Path]
    products: set[str]
    small: tuple[int, int]
    window_ms: float | None
    frame_camera: Calibration
    clock_us: int = 0
    balance: float = 0.0
    hot_pixel_stds: float | None = None
    arguments: tuple[str, ...] = ()
    iterator_arguments: tuple[tuple[str, object], ...] = ()


INTERVAL_MS = IMAGE_INTERVAL_US / 1000
CASES = {
    "vector": Case(
        VECTOR_EVENT_CAMERA, "right", lambda root, recording: write_vector(root, recording, "right"),
        {"tss_imgs_us_right.txt", "poses_evs_right.txt", "poses_gray_right.txt", "calib_undist_evs_right.txt",
         "calib_undist_regular_right.txt", "rectify_map_right.h5", "images_undistorted_right"},
        (160, 120), 2 * INTERVAL_MS, Calibration(1224, 1024, 886.2, 886.6, 610.6, 514.6, "radtan",
                                                 (-0.315, 0.104, 0.0004, -0.0006, 0.0)),
        UNIX_US, arguments=("--side", "right"), iterator_arguments=(("side", "right"),)),
    "tumvie": Case(
        TUMVIE_CAMERAS[3], "right", lambda root, recording: write_tumvie(root, recording, "right"),
        {"calibration.json", "calib_undist.json", "rectify_map_right.h5", "right_images_undistorted",
         "image_timestamps_right.txt", "image_exposures_right.txt"},
        (256, 144), INTERVAL_MS, TUMVIE_CAMERAS[1], balance=0.5, hot_pixel_stds=6.0,
        arguments=("--camId", "1"), iterator_arguments=(("camID", 3), ("dT_ms", TUMVIE_WINDOW_MS))),
    "eds": Case(
        EDS_CAMERAS["calib0"]["evs"], "left", write_eds,
        {"t_offset_us.txt", "images_timestamps_us.txt", "stamped_groundtruth_us.txt", "images_undistorted_calib0",
         "calib_undist_calib0.json", "rectify_map_calib0.h5", "calib_undist_calib1.json", "rectify_map_calib1.h5"},
        (160, 120), INTERVAL_MS / 2, EDS_CAMERAS["calib0"]["rgb"], hot_pixel_stds=10.0),
    "mvsec": Case(
        MVSEC_CAMERAS["right"], "right",
        lambda root, recording: write_mvsec(root, {"left": recording, "right": recording}),
        {"indoor_flying1_data.hdf5", "indoor_flying1_gt.hdf5", "tss_imgs_us_right.txt", "calib_undist_right.txt",
         "rectify_map_right.h5", "images_undistorted_right"},
        (172, 128), None, MVSEC_CAMERAS["right"], UNIX_US,
        arguments=("--side", "right"), iterator_arguments=(("side", "right"),)),
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


@pytest.fixture(scope="module", params=CASES)
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    dataset, case = request.param, CASES[request.param]
    root = tmp_path_factory.mktemp(dataset) / "nested" / "raw"
    root.mkdir(parents=True)
    written = case.write(root, simulated())
    # From another folder, with a trailing slash, as users do.
    command = [sys.executable, str(ROOT / "scripts" / f"pp_{dataset}.py"), "--indir", f"{root.parent.name}/"]
    done = subprocess.run([*command, *case.arguments], cwd=root.parents[1], timeout=300, check=False,
                          capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    assert f"preprocessing {dataset}: 100%" in done.stderr
    recording = simulated().on_sensor((case.camera.width, case.camera.height)).later(case.clock_us)
    if dataset == "eds":  # its products count from the first stamp of all
        recording = recording.later(-int(min(recording.events.t_us[0], recording.stamps_us[0], recording.poses_us[0])))
    sequence = open_sequence(dataset, f"{written}/", SequenceOptions(side=case.side))
    own = open_sequence("generic", write_generic(root / "own", recording, case.camera),
                        SequenceOptions(window_dt_ms=case.window_ms))
    return Prepared(dataset, case, written, recording, done.stdout, sequence, own)


def own_voxel(prepared: Prepared, frame: Frame, size: tuple[int, int] | None = None) -> torch.Tensor:
    """The voxel grid of a recording of one's own, with what the data set does to it besides."""
    voxel = frame[0] if size is None else resize_voxel(frame[0], size[1], size[0])
    stds = prepared.case.hot_pixel_stds
    return voxel if stds is None else remove_hot_pixels(voxel, stds)


def own_frames(prepared: Prepared, window_us: int = IMAGE_INTERVAL_US) -> Iterator[Frame]:
    """Frames of the recording of one's own at the windows of the data set, rectified as the data set demands."""
    if not prepared.case.balance:
        for voxel, intrinsics, t_us in prepared.own.voxels():  # frames of mvsec have the stamp of their windows' end
            yield voxel, intrinsics, t_us + (IMAGE_INTERVAL_US / 2 if prepared.dataset == "mvsec" else 0)
        return
    camera = prepared.case.camera
    positions, intrinsics = rectify_map(camera, balance=prepared.case.balance)
    with prepared.own.open_events() as reader:
        for start_us in prepared.recording.stamps_us.tolist():
            part = reader.read(start_us, start_us + window_us)
            x, y = positions[part.y, part.x].astype(np.float64).T
            voxel = to_voxel_grid(x, y, part.t_us, part.p, camera.height, camera.width)
            yield voxel, torch.from_numpy(intrinsics), start_us + window_us / 2


def test_products_are_listed_and_complete(prepared: Prepared) -> None:
    names = set(prepared.output.strip().partition(": ")[2].split(", "))
    assert names == prepared.case.products
    needed = PREPROCESSORS[prepared.dataset].outputs(prepared.folder, prepared.case.side)
    assert all(path.exists() for path in needed)
    images = next(prepared.folder / name for name in names if "images_undistorted" in name)
    assert len([file for file in images.iterdir() if file.suffix in (".png", ".jpg")]) == len(simulated().images)


def test_voxels_equal_those_of_a_recording_of_ones_own(prepared: Prepared) -> None:
    stamps_us, stream = prepared.recording.stamps_us, prepared.sequence.voxels()
    if prepared.dataset == "mvsec":  # the first window ends at the first image, so it has none before it
        assert next(stream)[2] == stamps_us[0]
    # vector and eds leave out the last image; the recording ends half an interval behind it
    assert prepared.sequence.expected_length == len(stamps_us) - (prepared.dataset in ("vector", "eds"))
    for (voxel, intrinsics, t_us), other in itertools.islice(zip(stream, own_frames(prepared)), 2):
        assert (voxel.dtype, intrinsics.dtype) == (torch.float32, torch.float64)
        assert voxel.abs().sum() > 100
        assert float((voxel - own_voxel(prepared, other)).abs().max()) <= VOXEL_RECTIFIED
        assert torch.allclose(intrinsics, other[1], atol=1e-9, rtol=0)
        assert t_us == pytest.approx(other[2], abs=0.3)


@pytest.mark.filterwarnings("ignore:random.*untrained network")
def test_published_iterator_and_trajectory(prepared: Prepared, monkeypatch: pytest.MonkeyPatch) -> None:
    """The iterator makes smaller voxel grids for the tracker; the trajectory is that of a recording of one's own."""
    monkeypatch.setattr("devo.devo.PROBE_FLOW", 0.0)  # an untrained network sees no motion, so none is asked for
    monkeypatch.setattr("devo.devo.MIN_EVENT_SHARE", 0.0)  # the recording fills a small part of a large sensor
    width, height = prepared.case.small
    iterator = getattr(load_utils, f"{prepared.dataset}_evs_iterator")
    stream = iterator(f"{prepared.folder}/", H=height, W=width, **dict(prepared.case.iterator_arguments))
    if prepared.dataset == "mvsec":
        next(stream)
    frames = list(itertools.islice(stream, FRAMES))
    full = (prepared.case.camera.width, prepared.case.camera.height)
    scale = torch.tensor([width / full[0], height / full[1]] * 2, dtype=torch.float64)
    compared = FRAMES if prepared.dataset == "mvsec" else 2  # large sensors take their time
    own = [(own_voxel(prepared, frame, (width, height)), frame[1] * scale, frame[2])
           for frame in itertools.islice(own_frames(prepared, TUMVIE_WINDOW_MS * 1000), compared)]
    assert len(frames) == FRAMES and len(own) == compared
    for (voxel, intrinsics, _), other in zip(frames, own):
        assert voxel.shape == (5, height, width)
        assert float((voxel - other[0]).abs().max()) <= VOXEL_RECTIFIED
        assert torch.allclose(intrinsics, other[1], atol=1e-9, rtol=0)
    config = Config({"PATCHES_PER_FRAME": 8, "MIXED_PRECISION": False})
    result = track(iter(frames), config, "random:0:16,16,8", seed=0)
    assert result.poses.shape == (FRAMES, 7)
    assert np.ptp(result.poses[:, :3], axis=0).max() > 0
    assert result.tstamps.tolist() == [t_us for _, _, t_us in frames]
    if compared == FRAMES:
        other = track(iter(own), config, "random:0:16,16,8", seed=0)
        np.testing.assert_allclose(result.poses, other.poses, atol=1e-4, rtol=0)


def test_ground_truth(prepared: Prepared) -> None:
    """For vector the pose of the event camera, for mvsec that of the left camera; tumvie and eds publish a body's."""
    truth = prepared.sequence.ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth[0], prepared.recording.poses_us, atol=0.3, rtol=0)
    np.testing.assert_allclose(truth[1] * np.sign(truth[1][:, 6:]), prepared.recording.world_T_cam
                               * np.sign(prepared.recording.world_T_cam[:, 6:]), atol=1e-9, rtol=0)


def test_images(prepared: Prepared) -> None:
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


def test_a_second_run_makes_only_what_is_missing(prepared: Prepared) -> None:
    root, case = prepared.folder.parent, prepared.case
    assert list(preprocess(prepared.dataset, root, side=case.side).values()) == [[]]
    lost = next(file for file in PREPROCESSORS[prepared.dataset].outputs(prepared.folder, case.side)
                if file.name.startswith("rectify_map"))
    before = lost.read_bytes()
    lost.unlink()
    assert list(preprocess(prepared.dataset, prepared.folder, side=case.side).values()) == [[lost]]
    assert lost.read_bytes() == before
