"""Comparing a run with the truth: a run that is the truth under another similarity, and what is said of bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from evals.compare_run import compare_run, surface_distances
from utils.clouds.cloud import PointCloud
from utils.clouds.io import write_cloud
from utils.trajectory_io import Trajectory, write_npy, write_tum

ROOT = Path(__file__).resolve().parents[2]
PLANE = {"name": "board", "normal": [0, 0, 1], "origin": [0, 0, 2], "axis_u": [1, 0, 0], "axis_v": [0, 1, 0],
         "half_extent": [0.5, 0.4]}
SCALE, TURN, SHIFT = 0.25, Rotation.from_rotvec([0.3, -0.2, 0.1]), np.array([5.0, -1.0, 2.0])


def seen(points: np.ndarray) -> np.ndarray:
    """Points of the scene as an estimate has them: other scale, other frame."""
    return SCALE * TURN.apply(points) + SHIFT


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A recording with ground truth and planes, and a perfect run whose points lie 2 cm in front of the board."""
    recording = tmp_path / "recording"
    recording.mkdir()
    t_us = np.arange(0, 1_000_001, 10_000)
    turn = Rotation.from_rotvec(np.outer(np.linspace(0, 0.2, 101), [0, 1, 0]))
    centers = np.stack([np.linspace(0, 1, 101), 0.1 * np.sin(np.linspace(0, 9, 101)), np.zeros(101)], axis=1)
    write_tum(recording / "groundtruth.txt", Trajectory(t_us, np.hstack([centers, turn.as_quat()])))
    np.savez(recording / "events.npz", x=np.zeros(9, np.uint16), y=np.zeros(9, np.uint16), t=np.arange(9) * 100_000,
             p=np.zeros(9, np.uint8))
    (recording / "calib.yaml").write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 32\ncy: 24\n"
                                          "distortion_model: none\n")
    (recording / "scene.json").write_text(json.dumps({"planes": [PLANE]}))
    poses = np.hstack([seen(centers), (TURN * turn).as_quat()])[::5]
    write_npy(tmp_path / "run" / "cloud", Trajectory(t_us[::5] + 1000, poses))
    generator = np.random.default_rng(0)
    points = np.column_stack([generator.uniform(-0.4, 0.4, (50, 2)), np.full(50, 1.98)])
    cloud = PointCloud(seen(points), scalars={"depth": np.full(50, 1.98 * SCALE)})
    write_cloud(tmp_path / "run" / "cloud_cleaned.ply", cloud)
    return tmp_path / "run" / "cloud.npy"


def test_a_run_that_is_the_truth_in_another_frame(run: Path) -> None:
    found = compare_run(str(run), str(run.parents[1] / "recording"))
    assert found.trajectory.ate_rmse_cm < 1e-4 and found.trajectory.matches == 21
    assert found.trajectory.scale == pytest.approx(1 / SCALE, rel=1e-6)
    assert found.points == 50
    assert found.surface_median == pytest.approx(0.02 / 1.98, rel=1e-3) == found.surface_p90
    text = "\n".join(found.lines())
    assert "ATE 0.00 cm" in text and "one trajectory unit is 4.000 m" in text and "50 points lie 1.0%" in text


def test_distance_to_rectangles() -> None:
    points = np.array([[0, 0, 2], [0, 0, 1], [0.8, 0, 2], [0.8, 0.8, 2], [9, 9, 4]], float)
    np.testing.assert_allclose(surface_distances(points, [PLANE])[:4], [0, 1, 0.3, 0.5])
    endless = {**PLANE, "origin": [0, 0, 5], "half_extent": [None, None]}
    np.testing.assert_allclose(surface_distances(points, [PLANE, endless])[[1, 4]], [1, 1])


@pytest.mark.parametrize(("gone", "expected"), [
    ("recording/groundtruth.txt", "no ground truth"), ("run/cloud_poses.npy", "cloud_poses.npy"),
    ("run/cloud_tstamps.npy", "stamps")])
def test_what_is_missing_is_named(gone: str, expected: str, run: Path) -> None:
    root = run.parents[1]
    (root / gone).unlink()
    with pytest.raises(InputError, match=expected):
        compare_run(str(run), str(root / "recording"))


def test_without_surfaces_only_the_path_is_compared(run: Path) -> None:
    (run.parents[1] / "recording" / "scene.json").unlink()
    found = compare_run(str(run), str(run.parents[1] / "recording"))
    assert found.points == 0 and len(found.lines()) == 1


def test_as_a_process(run: Path) -> None:
    script = str(ROOT / "evals" / "compare_run.py")
    done = subprocess.run([sys.executable, script, str(run), "--datapath", str(run.parents[1] / "recording")],
                          capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "path: ATE" in done.stdout, done.stderr
    wrong = subprocess.run([sys.executable, script, str(run), "--datapath", str(run)], capture_output=True, text=True)
    assert wrong.returncode == 2 and len(wrong.stderr.strip().splitlines()) == 1
