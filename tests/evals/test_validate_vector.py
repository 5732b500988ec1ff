"""The validation on a VECtor folder: what it reads from one, and the whole run on a simulated BOARD SLOW."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from devo.errors import InputError
from devo.poses import matrix_to_pose
from evals import validate_pointcloud
from evals.validation.source import Source, open_source
from tests.evals.validation_samples import quick_settings
from tests.utils.raw_layouts.hdf5_folders import (
    UNIX_US,
    VECTOR_CAM0_T,
    VECTOR_EVENT_CAMERA,
    VECTOR_FRAME_CAMERA,
    VGA,
    write_eds,
    write_mvsec,
    write_tumvie,
    write_vector,
)
from tests.utils.raw_layouts.recording import RawRecording, simulated
from utils.clouds import read_cloud
from utils.events import Events
from utils.preprocessing import preprocess
from utils.simulator import sequence as simulator
from utils.simulator.camera import camera_rays
from utils.simulator.renderer import Renderer, render_in_chunks
from utils.simulator.sequence import SequenceSettings, SimulatedSequence
from utils.simulator.textures import build_atlas
from utils.trajectory_io import Trajectory
from utils.undistort import rectify_map, undistorted_intrinsics

EVENT_T_GRAY = np.linalg.inv(VECTOR_CAM0_T["cam2"])  # the left gray camera is cam0
MIDDLE_US = UNIX_US + 230_000
FRAME_INTERVAL_US = 33_300
POSE_INTERVAL_US = 8_333


# --- what is read from a folder -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A preprocessed sequence, the only one in its data set."""
    root = tmp_path_factory.mktemp("vector")
    written = write_vector(root, simulated(), name="board_slow")
    preprocess("vector", root, side="left")
    return written


@pytest.fixture(scope="module")
def source(folder: Path) -> Source:
    return open_source(quick_settings(folder.parent, folder.parent / "out"))


def test_it_is_recognised_in_its_data_set(folder: Path) -> None:
    found = quick_settings(folder.parent, folder.parent / "out").resolved()
    assert (found.dataset, found.sequence) == ("vector", folder)


def test_ground_truth_is_that_of_the_event_camera(source: Source) -> None:
    np.testing.assert_allclose(source.truth.t_us, UNIX_US + simulated().poses_us, atol=0.3, rtol=0)
    poses = simulated().world_T_cam
    np.testing.assert_allclose(source.truth.world_T_cam * np.sign(source.truth.world_T_cam[:, 6:]),
                               poses * np.sign(poses[:, 6:]), atol=1e-9, rtol=0)
    assert source.depth is None and source.notes == ()


def test_events_are_undistorted_by_its_calibration(source: Source) -> None:
    positions, intrinsics = rectify_map(VECTOR_EVENT_CAMERA)
    assert source.camera.size == VGA
    np.testing.assert_array_equal(source.camera.rectify_map, positions)
    np.testing.assert_allclose(source.camera.intrinsics, intrinsics, atol=1e-9)


def test_events_are_thinned_on_the_clock_of_the_poses(source: Source) -> None:
    start_us, stop_us = UNIX_US + 100_000, UNIX_US + 300_000
    with source.sequence.open_events() as reader:
        every = reader.read(start_us, stop_us)
    thinned, stride = source.thinned_events(start_us, stop_us, len(every) // 4)
    with thinned as reader:
        first, last = reader.time_range_us()
        assert start_us <= first < last < stop_us and stride > 1
        assert len(reader) == -(-len(every) // stride)


def test_the_picture_is_the_frame_of_the_other_camera(source: Source) -> None:
    picture = source.picture(MIDDLE_US)
    assert picture.kind == "intensity frame" and picture.size == (1224, 1024) and picture.edges.any()
    assert abs(picture.t_us - MIDDLE_US) <= FRAME_INTERVAL_US / 2
    np.testing.assert_allclose(picture.intrinsics, undistorted_intrinsics(VECTOR_FRAME_CAMERA), atol=1e-9)
    np.testing.assert_allclose(picture.event_T_image, EVENT_T_GRAY, atol=1e-8)


def _without(folder: Path, copy: Path, *names: str) -> Path:
    shutil.copytree(folder, copy / folder.name, symlinks=True)
    for name in names:
        target = copy / folder.name / name
        shutil.rmtree(target) if target.is_dir() else target.unlink()
    return copy / folder.name


def test_without_frames_the_undistorted_events_are_the_picture(folder: Path, tmp_path: Path) -> None:
    eventful = open_source(quick_settings(_without(folder, tmp_path, "images_undistorted_left"), tmp_path / "out"))
    picture = eventful.picture(MIDDLE_US)
    assert picture.kind == "accumulated events" and picture.size == VGA and picture.edges.any()
    np.testing.assert_array_equal(picture.event_T_image, np.eye(4))


# --- folders that cannot work ---------------------------------------------------------------------------------------


def test_a_folder_that_is_not_preprocessed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw = write_vector(tmp_path, simulated(), frames=False)
    assert validate_pointcloud.main(["--sequence", str(raw), "--out", str(tmp_path / "out")]) == 2
    assert f"python scripts/pp_vector.py --indir {raw}" in capsys.readouterr().err


def test_a_folder_without_poses_says_where_they_come_from(folder: Path, tmp_path: Path) -> None:
    blind = _without(folder, tmp_path, "poses_evs_left.txt")
    with pytest.raises(InputError, match=r"no ground truth.* come with vector.*pp_vector\.py --indir"):
        open_source(quick_settings(blind, tmp_path / "out"))


@pytest.mark.parametrize(("dataset", "side", "owner"), [
    ("tumvie", "left", "motion capture body"), ("eds", "left", "motion capture body"),
    ("mvsec", "right", "left camera")])
def test_poses_of_something_else_are_refused(tmp_path: Path, dataset: str, side: str, owner: str) -> None:
    """Maps made with them would be blurred, and the exported cloud would be blamed."""
    written = {"tumvie": lambda: write_tumvie(tmp_path, simulated(), frames=False),
               "eds": lambda: write_eds(tmp_path, simulated(), frames=False),
               "mvsec": lambda: write_mvsec(tmp_path, {"left": simulated(), "right": simulated()})}[dataset]()
    preprocess(dataset, tmp_path, side=side, images=False)
    with pytest.raises(InputError, match=f"ground truth of {dataset} is that of the {owner}"):
        open_source(quick_settings(written, tmp_path / "out", side=side))


# --- the whole run --------------------------------------------------------------------------------------------------


def _simulated_rig(seconds: float) -> tuple[SimulatedSequence, RawRecording, np.ndarray]:
    """The board as event camera and gray camera of VECtor see it: the recording, and `(N, 1024, 1224)` gray frames."""
    settings = SequenceSettings("board", seconds, seed=1, preset="slow", size=VGA, threshold=0.4, noise="none",
                                step_px=1.0)
    with pytest.MonkeyPatch.context() as patch:  # the preset of this size has another lens
        patch.setattr(simulator, "camera_preset", lambda *_: VECTOR_EVENT_CAMERA)
        sequence = SimulatedSequence(settings)
    events = Events.concatenate([part for _, part in sequence.events()])
    stamps_us = np.arange(2_000, sequence.duration_us, FRAME_INTERVAL_US)
    poses_us = np.arange(1_000, sequence.duration_us, POSE_INTERVAL_US)
    world_T_gray = Trajectory(stamps_us, sequence.path.poses(stamps_us).numpy()).matrices() @ EVENT_T_GRAY
    renderer = Renderer(sequence.world.planes, build_atlas(sequence.world.draw_tiles()),
                        camera_rays(VECTOR_FRAME_CAMERA), sequence.world.empty)
    light = render_in_chunks(renderer, torch.from_numpy(matrix_to_pose(world_T_gray)).float()).exp()
    recording = RawRecording(VGA, events, stamps_us, [], poses_us, sequence.path.poses(poses_us).numpy())
    return sequence, recording, (255 * light / light.max()).round().byte().numpy()


def _run(repository: Path, script: str, *words: object) -> str:
    done = subprocess.run([sys.executable, repository / script, *map(str, words)], capture_output=True, text=True,
                          timeout=900, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_a_whole_run_on_a_raw_recording(repository: Path, tmp_path: Path) -> None:
    sequence, recording, frames = _simulated_rig(1.2)
    folder = write_vector(tmp_path / "vector", recording, name="board_slow", frames=False)
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / "board_slow1.synced.left_camera" / f"{number:06d}.png"), frame)
    _run(repository, "scripts/pp_vector.py", "--indir", tmp_path / "vector")
    out = tmp_path / "report"
    text = _run(repository, "evals/validate_pointcloud.py", "--sequence", folder, "--out", out, "--trials", 1,
                "--emvs_events", 400_000, "--emvs_planes", 50, "--view_scale", 1.0)
    assert "requirements are met" in text
    values = json.loads((out / "validation.json").read_text("utf-8"))
    assert values["settings"]["validation"]["dataset"] == "vector" and values["sequence"] == "board_slow"
    assert values["depth"] == {} and values["notes"] == []
    assert values["trajectory"]["ate_rmse_m"] < 0.02 * values["trajectory"]["path_length_m"]
    for first, second in (("gt", "gt_scaled"), ("devo", "devo_descaled")):
        assert values["maps"][first]["points"] == pytest.approx(values["maps"][second]["points"], rel=0.01)
    for name, edge in values["image"].items():  # wrong calibration or poses of the gray camera would show here
        assert edge["mean_distance_px"] < 0.15 * edge["random_distance_px"], name
    board, planes = sequence.world.names.index("board"), sequence.world.planes
    normal, origin = planes.normal[0, board].numpy(), planes.origin[0, board].numpy()
    for name, share in (("emvs_true_poses", 0.01), ("devo_cloud", 0.05)):
        off = np.abs((read_cloud(out / "clouds" / f"{name}.ply").points - origin) @ normal)
        assert np.median(off) < share * values["distance_m"], name
    pictures = sorted((out / "figures").iterdir())
    assert len(pictures) == 7
    assert all(np.ptp(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) == 255 for path in pictures)
