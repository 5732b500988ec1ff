"""The tracker against the reference run: an oracle network that answers with the true flow."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from devo.config import Config
from devo.devo import DEVO
from tests.tolerances import TRACKER_ORACLE_POINTS, TRACKER_ORACLE_POSES

CASES = ("slow", "fast")
DEFAULTS = {"speed": 0.06, "M": 24, "kf": 6, "rw": 14, "ow": 7, "pl": 8}


@pytest.fixture(scope="module")
def oracle(fixture_folder: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("oracle_scene", fixture_folder / "oracle_scene.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["oracle_scene"] = module
    spec.loader.exec_module(module)
    return module


def run_case(oracle: ModuleType, reference: dict[str, np.ndarray], case: str, ring_size: int) -> tuple[DEVO, dict]:
    """Run one case frame by frame; returns the tracker and what it looked like after every frame."""
    params = DEFAULTS | ast.literal_eval(str(reference[f"{case}/params"]))
    frames = params["frames"]
    cfg = Config({
        "BUFFER_SIZE": 64, "PATCHES_PER_FRAME": params["M"], "KEYFRAME_THRESH": params["kf"],
        "REMOVAL_WINDOW": params["rw"], "OPTIMIZATION_WINDOW": params["ow"], "PATCH_LIFETIME": params["pl"],
        "NORM": "none", "MIXED_PRECISION": False, "RING_SIZE": ring_size, "INITIAL_INV_DEPTH": 0.5,
        "STILL_FRAMES": "hold", "MIRROR_TEST": False})
    intrinsics = torch.tensor([110.0, 108.0, 80.0, 60.0])
    network = oracle.OracleNetwork(oracle.BoardScene(frames, params["speed"]), intrinsics, params["M"], 120, 160)
    tracker = DEVO(cfg, network, evs=True, ht=120, wd=160)
    network.tracker = tracker
    history = {}
    for i in range(frames):
        tracker(1000.0 * i, torch.ones(5, 120, 160), intrinsics)
        n = tracker.n
        history[i] = {
            "n": n, "m": tracker.m, "counter": tracker.counter, "edges": len(tracker.kk),
            "init": tracker.is_initialized,
            "stamps": tracker.tstamps_[:n].numpy().copy(), "keyframe_poses": tracker.poses_[:n].numpy().copy(),
            "disp": tracker.patches_[:n, :, 2, 1, 1].numpy().copy(),
            "ii": tracker.ii.numpy().copy(), "jj": tracker.jj.numpy().copy(), "kk": tracker.kk.numpy().copy()}
    tracker.refine()
    return tracker, history


@pytest.fixture(scope="module", params=CASES)
def run(request: pytest.FixtureRequest, oracle: ModuleType, fixture_npz: Callable) -> tuple:
    reference = fixture_npz("tracker_oracle")
    tracker, history = run_case(oracle, reference, request.param, 32)
    return request.param, tracker, history, reference


def test_bookkeeping_is_equal_after_every_frame(run: tuple) -> None:
    case, _, history, reference = run
    for i, state in history.items():
        for name in ("n", "m", "counter", "edges", "init"):
            assert state[name] == reference[f"{case}/f{i}/{name}"], f"{case} frame {i}: {name}"
        np.testing.assert_array_equal(state["stamps"], reference[f"{case}/f{i}/stamps"])


def test_edge_lists_are_equal(run: tuple) -> None:
    case, _, history, reference = run
    compared = [i for i in history if f"{case}/f{i}/kk" in reference]
    assert len(compared) >= 3
    for i in compared:
        for name in ("ii", "jj", "kk"):
            np.testing.assert_array_equal(history[i][name], reference[f"{case}/f{i}/{name}"])


def test_poses_follow_the_reference(run: tuple) -> None:
    case, tracker, history, reference = run
    for i, state in history.items():
        error = np.abs(state["keyframe_poses"] - reference[f"{case}/f{i}/keyframe_poses"]).max()
        assert error <= TRACKER_ORACLE_POSES, f"{case} frame {i}: {error}"
    result = tracker.result(observables=True)
    assert np.abs(result.poses - reference[f"{case}/poses"]).max() <= TRACKER_ORACLE_POSES
    np.testing.assert_array_equal(result.tstamps, reference[f"{case}/tstamps"])


def test_points_follow_the_reference(run: tuple) -> None:
    case, tracker, _, reference = run
    expected = reference[f"{case}/points"]
    structure = tracker.result(observables=True).observables
    assert structure is not None and structure.points.shape == expected.shape
    error = np.linalg.norm(structure.points - expected, axis=1) / structure.depths
    assert error.max() <= TRACKER_ORACLE_POINTS
