"""Evaluation on simulated sequences: the protocol, its figures, and the command."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from devo.errors import InputError
from devo.observables import Observables
from evals.eval_simulated import (
    SCENES,
    SIZES,
    Report,
    Score,
    depth_errors,
    sequences,
    summarise,
    trajectory_share,
)

ROOT = Path(__file__).resolve().parents[2]


def test_splits_hold_twenty_different_sequences_of_all_scenes_and_sizes() -> None:
    splits = {split: list(sequences(split)) for split in ("val", "test")}
    for entries in splits.values():
        assert len(entries) == 20 and len({name for name, _ in entries}) == 20
        assert {settings["scene"] for _, settings in entries} == set(SCENES)
        assert {settings["size"] for _, settings in entries} == set(SIZES)
        assert {settings["preset"] for _, settings in entries} == {"slow", "normal", "fast"}
    seeds = [{settings["seed"] for _, settings in entries} for entries in splits.values()]
    assert not seeds[0] & seeds[1]


def score(ate: float, status: str = "tracked", sequence: str = "a") -> Score:
    return Score(sequence, "trained", 0, status, ate, 0.05, 0.03, 100, 40, 10, 1.0, 2.0)


def test_lost_runs_count_against_the_median() -> None:
    scores = [score(0.01), score(0.02, sequence="b"), score(0.5, sequence="c"),
              score(math.nan, "not initialized", "d"), score(math.nan, "not initialized", "d")]
    assert [entry.lost for entry in scores] == [False, False, True, True, True]
    row = summarise(scores, "trained")
    assert (row["runs"], row["lost runs"], row["lost sequences"]) == (5, 3, 2)
    assert row["ate_percent"] == math.inf and row["ate_percent_tracked"] == pytest.approx(1.5)
    assert math.isnan(summarise([score(math.nan, "lost")], "trained")["depth_percent"])


def test_trajectory_share_is_free_of_frame_and_scale() -> None:
    stamps = np.arange(0, 1_000_001, 10_000.0)
    angle = 3.0 * stamps * 1e-6
    truth = np.zeros((len(stamps), 7))
    truth[:, :3] = np.stack([np.sin(angle), 0.5 * np.cos(angle), 0.1 * angle], axis=1)
    seen = np.arange(50_000, 900_000, 33_333.0)
    poses = np.zeros((len(seen), 7))
    poses[:, :3] = 0.2 * np.stack([np.interp(seen, stamps, truth[:, axis]) for axis in (1, 2, 0)], axis=1) + 4.0
    share, scale = trajectory_share(seen, poses, stamps, truth)
    assert share < 1e-6 and scale == pytest.approx(5.0)
    poses[:, 0] += 0.2 * 0.01 * (-1.0) ** np.arange(len(seen))
    way = np.stack([np.interp(seen, stamps, truth[:, axis]) for axis in range(3)], axis=1)
    path = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert trajectory_share(seen, poses, stamps, truth)[0] == pytest.approx(0.01 / path, rel=0.01)


class Wall:
    """A sequence that sees a wall at 2 m in its upper half and nothing below."""

    def depth(self, t_us: np.ndarray) -> torch.Tensor:
        depth = torch.zeros(len(t_us), 60, 80)
        depth[:, :30] = 2.0
        return depth


def observables(depths: np.ndarray, sigma: np.ndarray, rows: np.ndarray) -> Observables:
    count = len(depths)
    pixel_xy = np.stack([np.linspace(0, 79, count), rows], axis=1).astype(np.float32)
    points = np.stack([pixel_xy[:, 0] / 80 * depths, pixel_xy[:, 1] / 80 * depths, depths], axis=1)
    host = np.arange(count) // 10
    values = {"points": points, "pixel_xy": pixel_xy, "depths": depths, "inv_depths": 1 / depths, "host_frame": host,
              "t_us": host * 1000, "observations": np.full(count, 9), "parallax_deg": np.full(count, 8.0),
              "mean_weight": np.full(count, 0.5), "residual_px": np.full(count, 0.1), "inv_depth_sigma": sigma,
              "clamped": np.zeros(count, bool)}
    return Observables(**{"colors": None, **values})


def test_depth_errors_of_all_good_points_and_of_the_cleaned_cloud() -> None:
    count = 400
    order = np.arange(count)
    certain = order % 2 == 0
    depths = np.where(certain, 0.202, 0.22)  # true is 0.2 at this scale: 1 and 10 % off
    sigma = np.where(certain, 0.01, 0.5) / depths
    rows = np.where(order % 4 < 2, order % 30, 45)  # half of the points look past the wall
    (good, cleaned), size = depth_errors(observables(depths, sigma, rows), 10.0, Wall())
    assert good == pytest.approx(0.055) and cleaned == pytest.approx(0.01)
    assert 0.4 * count < size <= 0.5 * count
    (good, cleaned), size = depth_errors(observables(depths, sigma, np.full(count, 45)), 10.0, Wall())
    assert math.isnan(good) and math.isnan(cleaned) and size > 0


def run(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "evals/eval_simulated.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def test_command_simulates_tracks_and_tabulates(tmp_path: Path) -> None:
    done = run("--split", "val", "--scenes", "board", "--every", 5, "--seconds", 0.3, "--trials", 1, "--variants",
               "untrained", "--cache", tmp_path / "cache", "--json", tmp_path / "scores.json")
    assert done.returncode == 0, done.stderr
    assert "| board_slow_240x180_7000 | untrained | 0 | not initialized |" in done.stdout
    report = json.loads((tmp_path / "scores.json").read_text())
    assert report["summary"][0]["lost runs"] == 1 and len(report["scores"]) == 1
    assert (tmp_path / "cache/board_slow_240x180_7000_0.3s/events.h5").is_file()


def test_report_grows_with_every_run_and_goes_on_only_with_the_same_settings(tmp_path: Path) -> None:
    path, about = tmp_path / "new" / "scores.json", {"split": "val", "weights": "abc"}
    report = Report(path, about)
    report.add(score(0.01))
    report.add(score(math.nan, "not initialized", "b"))
    again = Report(path, about)
    assert [entry.sequence for entry in again.scores] == ["a", "b"] and again.scores[0] == report.scores[0]
    assert again.summary()[0]["runs"] == 2
    with pytest.raises(InputError, match="made with other weights"):
        Report(path, {**about, "weights": "xyz"})
    path.write_text("[]")
    with pytest.raises(InputError, match="no report"):
        Report(path, about)


def test_command_refuses_what_it_does_not_know() -> None:
    for arguments in (("--scenes", "moon"), ("--weights", "none.pth", "--seconds", 0.1)):
        done = run(*arguments)
        assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
