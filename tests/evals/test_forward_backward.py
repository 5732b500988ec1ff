"""The check without ground truth: reversing a stream, comparing two runs, and the command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from evals.forward_backward import compare, reversed_frames
from utils.events.types import Events
from utils.voxel_grid import to_voxel_grid

ROOT = Path(__file__).resolve().parents[2]


def test_reversed_frames_are_the_voxel_grids_of_reversed_events() -> None:
    rng = np.random.default_rng(0)
    t_us = np.sort(rng.integers(0, 30_000, 500))
    events = Events(rng.integers(0, 40, 500).astype(np.uint16), rng.integers(0, 32, 500).astype(np.uint16), t_us,
                    rng.integers(0, 2, 500).astype(np.uint8))
    voxel = to_voxel_grid(events.x, events.y, events.t_us, events.p, 32, 40)
    back = slice(None, None, -1)
    mirrored = to_voxel_grid(events.x[back].copy(), events.y[back].copy(), 30_000 - events.t_us[back],
                             1 - events.p[back], 32, 40)
    intrinsics = torch.tensor([40.0, 40, 20, 16])
    (grid, _, stamp), (_, _, second) = reversed_frames([(voxel * 0, intrinsics, 10.0), (voxel, intrinsics, 30.0)])
    torch.testing.assert_close(grid, mirrored, atol=1e-5, rtol=0)
    assert (stamp, second) == (0.0, 20.0)


def path(count: int) -> np.ndarray:
    angle = np.linspace(0, 1.5, count)
    position = np.stack([np.sin(angle), 0.3 * np.cos(2 * angle), 0.2 * angle], axis=1)
    return np.concatenate([position, Rotation.from_euler("y", angle[:, None]).as_quat()], axis=1)


def moved(poses: np.ndarray, scale: float) -> np.ndarray:
    """The same path in another frame and scale."""
    turn = Rotation.from_euler("xyz", [0.4, -0.2, 1.0])
    position = scale * turn.apply(poses[:, :3]) + [1.0, 2.0, 3.0]
    return np.concatenate([position, (turn * Rotation.from_quat(poses[:, 3:])).as_quat()], axis=1)


def test_mirrored_runs_agree_exactly_and_differences_are_measured() -> None:
    forth = path(20)
    t_us = 1000.0 * np.arange(20)
    back = moved(forth, 0.25)[::-1]
    result = compare(t_us, forth, t_us, back, t_us[-1])
    assert result.frames == 20 and result.position_share < 1e-9 and result.rotation_deg < 1e-5
    assert result.scale == pytest.approx(4.0)
    wrong = compare(t_us, forth, t_us, moved(forth, 0.25), t_us[-1])
    assert wrong.position_share > 0.05, "a run that was not mirrored must not pass"
    disturbed = forth.copy()
    disturbed[:, 1] += 0.01 * (-1.0) ** np.arange(20)
    small = compare(t_us, forth, t_us, disturbed[::-1], t_us[-1])
    assert small.position_share == pytest.approx(0.01 / small.path_length, rel=0.05)


def test_only_common_windows_are_compared() -> None:
    forth, t_us = path(20), 1000.0 * np.arange(20)
    back = forth[::-1]
    result = compare(t_us[3:], forth[3:], t_us[2:], back[2:], t_us[-1])
    assert result.frames == 15 and result.position_share < 1e-9
    with pytest.raises(InputError, match="2 windows"):
        compare(t_us[:2], forth[:2], t_us, back, t_us[-1])


def run(*arguments: object, timeout: float = 60) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "evals/forward_backward.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


def test_command_rejects_what_it_cannot_read(tmp_path: Path) -> None:
    done = run("--datapath", tmp_path / "none.npz")
    assert done.returncode == 2 and "none.npz" in done.stderr and done.stderr.count("\n") == 1


def test_command_reports_runs_that_never_started(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    count = 4000
    np.savez(tmp_path / "noise.npz", x=rng.integers(0, 64, count).astype(np.uint16),
             y=rng.integers(0, 64, count).astype(np.uint16), t=np.sort(rng.integers(0, 100_000, count)),
             p=rng.integers(0, 2, count).astype(np.uint8))
    done = run("--datapath", tmp_path / "noise.npz", "--intrinsics", 60, 60, 32, 32, "--image_size", 64, 64,
               "--window_events", 1000, "--json", tmp_path / "out.json")
    assert done.returncode == 1, done.stderr
    assert "| 0 | not initialized | not initialized | 0 |" in done.stdout
    assert json.loads((tmp_path / "out.json").read_text())["results"][0]["frames"] == 0


@pytest.mark.slow
def test_a_real_recording_agrees_with_its_reverse(shared_data: Path) -> None:
    """Shared data: a hand-held DVS128; the issue asks for 10 % of the path."""
    done = run("--datapath", shared_data / "dvs128_handheld/garfield.npz", "--intrinsics", 115, 115, 63.5, 63.5,
               "--image_size", 128, 128, "--window_events", 4000, timeout=600)
    assert done.returncode == 0, done.stderr
    share = float(done.stdout.splitlines()[-1].split("|")[5])
    assert share < 10.0
