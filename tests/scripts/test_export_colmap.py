"""`scripts/export_colmap.py` on a simulated recording, from the recording and from its frames as files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.tolerances import COLMAP_FRAMES
from utils.colmap.model import PIXEL_CENTER
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.simulator.dataset_folder import FolderOptions, write_recording
from utils.simulator.sequence import SequenceSettings

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "export_colmap.py"
SCALE = 10.0  # default of --colmap_scale


def run(*arguments: object) -> str:
    done = subprocess.run([sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("colmap") / "board"
    settings = SequenceSettings(seconds=0.8, scene="board", seed=3, preset="fast", size=(160, 120))
    write_recording(folder, settings, FolderOptions(depth=False, frames=True))
    return folder


def write_frames(recording: Path, folder: Path) -> list[object]:
    """The recording's voxel grids as files and their stamps; returns the arguments that describe the camera."""
    folder.mkdir()
    stamps = []
    frames = list(open_sequence("generic", recording, SequenceOptions()).voxels())
    for number, (voxel, _, t_us) in enumerate(frames):
        with h5py.File(folder / f"{number:03d}.h5", "w") as file:
            file["voxel"] = voxel.numpy()
        stamps.append(t_us)
    np.savetxt(folder.parent / "stamps.txt", stamps, fmt="%.6f")
    voxel, intrinsics, _ = frames[0]
    fx, fy, cx, cy = intrinsics.tolist()
    return ["--fx", fx, "--fy", fy, "--cx", cx, "--cy", cy, "--width", voxel.shape[2], "--height", voxel.shape[1],
            "--timestamps", folder.parent / "stamps.txt"]


def poses(model: Any) -> np.ndarray:
    """Camera centres by image name."""
    return np.array([image.projection_center() for _, image in sorted(
        ((image.name, image) for image in model.images.values()), key=lambda pair: pair[0])])


def test_recording_and_frames_give_the_same_model(recording: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the reader of COLMAP models is not installed")
    run("--datapath", recording, "--colmap_dir", tmp_path / "a", "--format", "binary")
    assert (tmp_path / "a/run/cloud.npy").is_file()  # the export behind it
    camera = write_frames(recording, tmp_path / "frames")
    text = run("--input", tmp_path / "frames", *camera, "--colmap_dir", tmp_path / "b", "--format", "binary")
    first, second = (pycolmap.Reconstruction(str(tmp_path / name)) for name in "ab")
    tracked = np.load(tmp_path / "a/run/cloud_poses.npy")
    assert first.num_images() == second.num_images() == len(tracked) > 20
    assert str(first.num_points3D()) in text and first.num_points3D() == second.num_points3D() > 100
    np.testing.assert_allclose(poses(first), SCALE * tracked[:, :3], atol=1e-5)
    np.testing.assert_allclose(poses(first), poses(second), atol=COLMAP_FRAMES)
    assert first.compute_mean_reprojection_error() == pytest.approx(second.compute_mean_reprojection_error(), rel=1e-4)
    assert 0.0 < first.compute_mean_reprojection_error() < 2.0


def test_images_keep_their_names_and_a_smaller_camera(recording: Path, tmp_path: Path) -> None:
    """Every second image at half its size, read back as text. There are no small weights for images, so the network is
    untrained: its path means nothing, and neither motion nor small errors are asked for."""
    pycolmap = pytest.importorskip("pycolmap", reason="the reader of COLMAP models is not installed")
    (tmp_path / "still.yaml").write_text("PATCHES_PER_FRAME: 8\nPROBE_FLOW: 0.0\nKEYFRAME_THRESH: 0.0\n")
    text = run("--input", recording / "images", "--mode", "rgb", "--timestamps", recording / "images_timestamps_us.txt",
               "--intrinsics-file", recording / "calib.yaml", "--width", 160, "--height", 120, "--stride", 2,
               "--scale", 0.5, "--weights", "random:0:16,16,8:rgb", "--config", tmp_path / "still.yaml",
               "--max-error-px", 1000, "--colmap-dir", tmp_path / "model")
    found = pycolmap.Reconstruction(str(tmp_path / "model"))
    files = sorted(path.name for path in (recording / "images").iterdir())
    assert sorted(image.name for image in found.images.values()) == files[::2]
    camera = found.cameras[1]
    assert (camera.width, camera.height) == (80, 60)
    intrinsics = 0.5 * open_sequence("generic", recording, SequenceOptions()).intrinsics
    np.testing.assert_allclose(camera.params, intrinsics + [0, 0, PIXEL_CENTER, PIXEL_CENTER])
    assert f"{len(files[::2])} images" in text and found.num_points3D() > 0
    assert all(np.ptp(point.color) == 0 for point in found.points3D.values())  # the frames are gray
