"""Drivers: the published tuples, streaming, seeds, interruption, block normalisation, map files."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import utils.eval_utils as drivers
from devo.config import Config
from devo.errors import InputError
from devo.result import TrackingStatus
from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleNetwork, OracleScene, OracleTracker
from utils.clouds.io import read_cloud

SETTINGS = {"PATCHES_PER_FRAME": 12, "REMOVAL_WINDOW": 10, "OPTIMIZATION_WINDOW": 6, "PATCH_LIFETIME": 6,
            "NORM": "none", "MIXED_PRECISION": False, "KEYFRAME_THRESH": 9.0}
FRAMES = 20


@pytest.fixture
def oracle(monkeypatch: pytest.MonkeyPatch) -> tuple[OracleScene, OracleNetwork, Config]:
    monkeypatch.setattr(drivers, "DEVO", OracleTracker)
    scene = OracleScene(FRAMES, 0.12)
    return scene, OracleNetwork(scene), Config(SETTINGS)


FLAGS = [((False, False, False), 3), ((False, True, False), 4), ((True, False, False), 5), ((True, False, True), 6),
         ((True, True, False), 6), ((True, True, True), 7)]


@pytest.mark.parametrize(("flags", "length"), FLAGS)
def test_run_voxel_returns_the_published_tuples(oracle: tuple, flags: tuple[bool, bool, bool], length: int) -> None:
    scene, network, cfg = oracle
    values = drivers.run_voxel("unused", cfg, network, iterator=scene.frames(), return_observables=flags[0],
                               return_frame_observables=flags[1], return_colors=flags[2])
    assert len(values) == length
    poses, tstamps, flowdata = values[:3]
    assert poses.shape == (FRAMES, 7) and tstamps.shape == (FRAMES,) and flowdata is None
    if flags[0]:
        points, depths = values[3:5]
        assert points.dtype == np.float32 and points.shape == (len(depths), 3)
    if flags[2]:
        assert values[5].shape == points.shape
    if flags[1]:
        assert len(values[-1]) > 0


def test_colours_without_observables_are_refused(oracle: tuple) -> None:
    scene, network, cfg = oracle
    with pytest.raises(ValueError, match="return_colors"):
        drivers.run_voxel("unused", cfg, network, iterator=scene.frames(), return_colors=True)


def test_depths_are_z_depths_in_the_host_camera(oracle: tuple) -> None:
    scene, network, cfg = oracle
    result = drivers.track(scene.frames(), cfg, network)
    structure = result.observables
    pose = result.poses[structure.host_frame].astype(np.float64)
    # z axis of the host camera in the world: third column of the rotation
    x, y, z, w = pose[:, 3:].T
    axis = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1)
    depth = ((structure.points - pose[:, :3]) * axis).sum(axis=1)
    np.testing.assert_allclose(depth, structure.depths, rtol=1e-3)


def test_the_stream_is_consumed_one_frame_at_a_time(oracle: tuple) -> None:
    scene, network, cfg = oracle
    produced = []

    def stream() -> Iterator[tuple]:
        for frame in scene.frames():
            produced.append(frame[2])
            yield frame

    ahead = []
    drivers.track(stream(), cfg, network, on_frame=lambda tracker: ahead.append(len(produced) - tracker.counter))
    assert max(ahead) == 0


def test_the_callers_settings_and_random_state_stay_as_they_were(oracle: tuple) -> None:
    scene, network, cfg = oracle
    before = cfg.as_dict()
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    drivers.run_voxel_norm_seq("unused", cfg, network, iterator=scene.frames())
    assert cfg.as_dict() == before
    assert torch.equal(torch.rand(3), expected)


def test_seed_decides_the_result(oracle: tuple) -> None:
    scene, network, cfg = oracle
    runs = [drivers.track(scene.frames(), cfg, network, seed=seed).poses.tobytes() for seed in (3, 3, 4)]
    assert runs[0] == runs[1] != runs[2]


def test_ctrl_c_keeps_what_exists(oracle: tuple) -> None:
    scene, network, cfg = oracle

    def interrupted() -> Iterator[tuple]:
        for i, frame in enumerate(scene.frames()):
            if i == 17:
                raise KeyboardInterrupt
            yield frame

    result = drivers.track(interrupted(), cfg, network, keep_on_interrupt=True)
    assert result.counters["interrupted"] == 1 and len(result.poses) == 17
    with pytest.raises(KeyboardInterrupt):
        drivers.track(interrupted(), cfg, network)


def test_ctrl_c_in_the_middle_of_a_frame_waits_for_its_end(oracle: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real signal while edges are being appended: the frame is finished, the result is whole."""
    scene, network, cfg = oracle
    original, calls = OracleTracker.append_factors, []

    def append(self: OracleTracker, *arguments: torch.Tensor) -> None:
        calls.append(1)
        if len(calls) == 23:
            os.kill(os.getpid(), signal.SIGINT)
        original(self, *arguments)

    monkeypatch.setattr(OracleTracker, "append_factors", append)
    before = signal.getsignal(signal.SIGINT)
    result = drivers.track(scene.frames(), cfg, network, keep_on_interrupt=True)
    assert result.counters["interrupted"] == 1 and 8 < len(result.poses) < FRAMES
    assert result.ok and np.isfinite(result.poses).all()
    assert signal.getsignal(signal.SIGINT) is before


def test_an_empty_stream_is_a_status(oracle: tuple) -> None:
    _, network, cfg = oracle
    result = drivers.track(iter(()), cfg, network)
    assert result.status is TrackingStatus.EMPTY_STREAM and result.poses.shape == (0, 7)
    values = drivers.run_voxel("unused", cfg, network, iterator=iter(()), return_observables=True, return_colors=True)
    assert values[3].shape == (0, 3) and values[4].shape == (0,) and values[5].shape == (0, 3)


def test_another_frame_size_than_announced_is_refused(oracle: tuple) -> None:
    scene, network, cfg = oracle
    with pytest.raises(InputError, match="480, 640"):
        drivers.run_voxel("unused", cfg, network, iterator=scene.frames(), H=480, W=640)


@pytest.mark.parametrize("count", [1, 14, 15, 16, 31])
def test_block_normalisation_keeps_every_frame(count: int) -> None:
    generator = torch.Generator().manual_seed(0)
    voxels = torch.randn(count, 5, 8, 8, generator=generator)
    frames = [(voxel, INTRINSICS, float(i)) for i, voxel in enumerate(voxels)]
    result = list(drivers.normalized_in_blocks(frames, 15))
    assert [t for _, _, t in result] == [float(i) for i in range(count)]
    for start in range(0, count, 15):
        block = torch.stack([voxel for voxel, _, _ in result[start:start + 15]])
        assert float(block.max()) == pytest.approx(1.0) and float(block.min()) == pytest.approx(-1.0)
    assert torch.equal(voxels, torch.stack([voxel for voxel, _, _ in frames])), "the caller's voxels were changed"


def test_map_files(oracle: tuple, tmp_path: Path) -> None:
    scene, network, cfg = oracle
    foreign = tmp_path / "clouds" / "mine.ply"
    foreign.parent.mkdir()
    foreign.write_text("not yours")
    drivers.run_voxel("unused", cfg, network, iterator=scene.frames(), save_per_frame_cloud=True,
                      save_per_frame_cloud_path=tmp_path / "clouds", full_map_out=tmp_path / "map",
                      full_map_color_out=tmp_path / "colors.npy")
    clouds = sorted((tmp_path / "clouds").glob("cloud_*.ply"))
    assert clouds[-1].name == f"cloud_{FRAMES:05d}.ply" and len(clouds) > 3
    assert len(read_cloud(clouds[-1])) > len(read_cloud(clouds[0])) > 0
    assert len(read_cloud(tmp_path / "clouds" / "combined_map.ply")) > 0
    assert foreign.read_text() == "not yours"
    points, colors = np.load(tmp_path / "map.npy"), np.load(tmp_path / "colors.npy")
    assert points.shape == colors.shape and len(points) >= len(read_cloud(clouds[-1]))


def test_flow_data_on_request(oracle: tuple) -> None:
    scene, network, cfg = oracle
    _, _, flow = drivers.run_voxel("unused", cfg, network, iterator=scene.frames(), viz_flow=True)
    last = flow[max(flow)]
    assert set(last) == {"ii", "jj", "kk", "coords_est", "img", "n"} and last["img"].shape == (HEIGHT, WIDTH, 5)
