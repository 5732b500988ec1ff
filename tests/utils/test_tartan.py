"""TartanAir: conversions, frame graph, clip sampling, and the reader on a miniature of the published folder layout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from devo.data_readers.tartan import INTRINSICS, camera_poses, frame_graph, inverse_depth, walk
from devo.errors import InputError
from devo.lietorch import SE3
from utils.training.settings import TrainSettings
from utils.training.tartan_source import find_scenes, open_scene, read_voxel, tartan_source

FRAMES, HEIGHT, WIDTH = 8, 64, 96
STEP_M = 0.25  # camera motion per frame, sideways


def test_ned_poses_become_camera_poses() -> None:
    # north-east-down: the camera looks north (x), right is east (y), down is z
    rows = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, np.sin(0.2), np.cos(0.2)]])  # turned about the down axis, to the right
    pose = camera_poses(rows)
    assert pose[0, :3].tolist() == pytest.approx([0.4, 0.6, 0.2])
    forward = SE3(torch.from_numpy(pose))[0].act(torch.tensor([0.0, 0.0, 1.0])) - torch.from_numpy(pose[0, :3])
    assert forward.tolist() == pytest.approx([np.sin(0.4), 0.0, np.cos(0.4)], abs=1e-6)
    with pytest.raises(InputError, match=r"\(3, 6\)"):
        camera_poses(np.zeros((3, 6)))


def test_invalid_depths_count_as_one_unit() -> None:
    depth = np.array([[10.0, np.inf], [np.nan, 0.0]])
    assert inverse_depth(depth).tolist() == [[0.5, 1.0], [1.0, 1.0]]


def sideways(frames: int, depth: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    poses = np.zeros((frames, 7))
    poses[:, 0] = np.arange(frames) * step
    poses[:, 6] = 1
    return poses, np.full((frames, 30, 40), 1 / depth)


def test_frame_graph_measures_the_induced_flow() -> None:
    poses, disparity = sideways(12, depth=2.0, step=0.2)
    graph = frame_graph(poses, disparity)
    neighbours, distance = graph[3]
    flow = dict(zip(neighbours.tolist(), distance.tolist()))
    for other, found in flow.items():
        expected = 320 * (0.1 if other == 3 else 0.2 * abs(other - 3)) / 2.0
        assert found == pytest.approx(expected, rel=1e-4)
    assert set(flow) == {i for i in range(12) if 320 * 0.2 * abs(i - 3) / 2 < 256}


def test_frames_that_look_away_are_no_neighbours() -> None:
    poses, disparity = sideways(3, depth=2.0, step=0.1)
    poses[2, 3:] = [0, 1, 0, 0]  # turned round
    graph = frame_graph(poses, disparity)
    assert graph[0][0].tolist() == [0, 1]


def test_walk_prefers_later_frames_inside_the_flow_range() -> None:
    poses, disparity = sideways(40, depth=2.0, step=0.05)  # 8 px per frame
    graph = frame_graph(poses, disparity)
    for seed in range(10):
        chosen = walk(graph, 2, 5, np.random.default_rng(seed), (10.0, 75.0))
        steps = np.diff(chosen) * 8.0
        later = np.array(chosen[:-1]) < 38
        assert np.all((steps > 10) & (steps < 75) | ~later)
    assert walk(graph, 38, 3, np.random.default_rng(0))[1] == 39  # no later one in range: the next frame


@pytest.fixture
def tartan_root(tmp_path: Path) -> Path:
    """One converted trajectory and one that is not converted."""
    rng = np.random.default_rng(0)
    for name in ("P000", "P001"):
        inner = Path("env/env/Easy") / name
        base = tmp_path / "env" / "Easy"
        for kind, leaf in (("evs_left", "h5"), ("depth_left", "depth_left"), ("image_left", ".")):
            (base / kind / inner / leaf).mkdir(parents=True)
        rows = np.zeros((FRAMES + 1, 7))
        rows[:, 1] = np.arange(FRAMES + 1) * STEP_M  # east
        rows[:, 6] = 1
        np.savetxt(base / "image_left" / inner / "pose_left.txt", rows)
        for i in range(FRAMES + 1):
            np.save(
                base / "depth_left" / inner / "depth_left" / f"{i:06d}_left_depth.npy", np.full((HEIGHT, WIDTH), 5.0)
            )
            if i:
                with h5py.File(base / "evs_left" / inner / "h5" / f"{i:010d}.h5", "w") as file:
                    file["voxel"] = rng.normal(size=(5, HEIGHT, WIDTH)).astype(np.float16)
    (tmp_path / "env/Easy/image_left/env/env/Easy/P000/converted.txt").touch()
    return tmp_path


def test_reader_finds_converted_scenes_of_the_split(tartan_root: Path) -> None:
    assert [folder.name for folder in find_scenes(tartan_root)] == ["P000"]
    assert find_scenes(tartan_root, ["env/env/Easy/P000", ""])[0].name == "P000"
    with pytest.raises(InputError, match="--datapath"):
        find_scenes(tartan_root, ["carwelding"])


def test_clip_of_the_reader_is_geometrically_right(tartan_root: Path) -> None:
    scene = open_scene(tartan_root, find_scenes(tartan_root)[0], tartan_root / "cache")
    assert scene.name == "env/env/Easy/P000"
    clip = scene.clip(0, 3, np.random.default_rng(0)).check()
    assert clip.voxels.shape == (1, 3, 5, HEIGHT, WIDTH)
    assert clip.inv_depths.unique().tolist() == [1.0]  # 5 m = 1 unit
    steps = clip.world_T_cam[0, 1:, 0] - clip.world_T_cam[0, :-1, 0]
    assert bool((steps * 5 / STEP_M - (steps * 5 / STEP_M).round()).abs().max() < 1e-5)
    assert clip.intrinsics[0, 0].tolist() == list(INTRINSICS)
    again = open_scene(
        tartan_root, find_scenes(tartan_root)[0], tartan_root / "cache"
    )  # the graph comes from the cache
    for (a, b), (c, d) in zip(scene.graph, again.graph):
        assert np.array_equal(a, c)
        assert np.array_equal(b, d)


def test_source_is_deterministic(tartan_root: Path) -> None:
    settings = TrainSettings.from_preset("tiny", clips=2, frames=3, sizes=((48, 64),), datapath=str(tartan_root))
    settings = replace(settings, augment=replace(settings.augment, reverse=1.0))
    batch, again = tartan_source(settings).batch(5), tartan_source(settings).batch(5)
    assert batch.voxels.shape == (2, 3, 5, 48, 64)
    assert all(torch.equal(a, b) for a, b in zip(batch.tensors(), again.tensors()))


def test_damaged_trajectories_are_named(tartan_root: Path) -> None:
    folder = find_scenes(tartan_root)[0]
    voxel = next((folder / "h5").glob("*.h5"))
    content = voxel.read_bytes()
    voxel.write_bytes(content[:100])
    with pytest.raises(InputError, match=voxel.name):
        read_voxel(voxel)
    voxel.unlink()
    with pytest.raises(InputError, match="7 voxel grids, 8 depth maps and 8 poses"):
        open_scene(tartan_root, folder, tartan_root / "cache")
