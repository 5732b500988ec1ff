"""The CUDA kernels of bundle adjustment and reprojection against their torch twins."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from devo import fastba
from devo.fastba import BAResult
from tests.devo.cuda_backends import Kernels, assert_close
from tests.devo.worlds import World, make_world
from tests.tolerances import CUDA_BA, CUDA_BA_FLOAT32, CUDA_REPROJECT


def moved_world(kernels: Kernels, seed: int, dtype: torch.dtype = torch.float64, **options: Any) -> World:
    world = make_world(seed, dtype=dtype, **options)
    return World(**{name: value.to(kernels.device) for name, value in vars(world).items()})


def compare_ba(kernels: Kernels, world: World, poses: Tensor, patch_rows: Tensor, t0: int, t1: int,
               iterations: int = 2, tolerance: float = CUDA_BA, lmbda: float = 1e-4, **options: Any) -> BAResult:
    """State and verdict after both implementations; returns the result of the kernels."""
    found = []
    for run in (kernels.ours, kernels.twin):
        state = poses.to(kernels.device, copy=True), patch_rows.to(kernels.device, copy=True)
        damping = torch.tensor([lmbda], device=kernels.device)
        result = run(fastba.BA, state[0], state[1], world.intrinsics, world.target, world.weight, damping,
                     *world.edges, t0, t1, iterations, accurate=True, **options)
        found.append((*state, result))
    (ours_poses, ours_patches, ours), (poses, patch_rows, twin) = found
    assert_close(ours_poses, poses, tolerance)
    assert_close(ours_patches, patch_rows, tolerance)
    assert (ours.success, ours.iterations) == (twin.success, twin.iterations)
    assert torch.equal(ours.patch_ids, twin.patch_ids) and torch.equal(ours.valid, twin.valid)
    assert_close(ours.depth_information, twin.depth_information, tolerance)
    assert_close(ours.residual, twin.residual, tolerance)
    return ours


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize(("t0", "t1"), [(1, 5), (0, 5), (3, 9), (2, 2), (-3, 4)])
@pytest.mark.parametrize("size", [None, (120, 160), (40.3, 50.7)])
def test_ba(kernels: Kernels, t0: int, t1: int, per_frame: bool, size: tuple[float, float] | None) -> None:
    world = moved_world(kernels, 1, jitter_intrinsics=0.05)
    options = {"image_size": size, "per_frame_intrinsics": per_frame}
    result = compare_ba(kernels, world, *make_disturbed(world), t0, t1, 3, **options)
    assert result.success and result.iterations == 3 and result.valid.any()


def make_disturbed(world: World, pose_noise: float = 0.02, depth_noise: float = 0.1) -> tuple[Tensor, Tensor]:
    on_cpu = World(**{name: value.cpu() for name, value in vars(world).items()})
    return on_cpu.disturbed(pose_noise, depth_noise, 1, 7)


@pytest.mark.parametrize("frames", [3, 12])
def test_ba_in_float32(kernels: Kernels, frames: int) -> None:
    world = moved_world(kernels, 2, torch.float32, frames=frames)
    compare_ba(kernels, world, *make_disturbed(world), 1, frames, tolerance=CUDA_BA_FLOAT32)


def test_ba_with_outliers_and_broken_numbers(kernels: Kernels) -> None:
    world = moved_world(kernels, 3)
    poses, patch_rows = make_disturbed(world)
    world.target[0, ::7] += 200
    world.target[0, 1::11] = float("nan")
    world.weight[0, 2] = float("inf")
    world.weight[0, 5:9] = 0
    patch_rows[0, 3, 2] = float("nan")
    patch_rows[0, 4, 0, 1, 1] = float("inf")
    patch_rows[0, 5, 2] = -3  # behind the cameras
    poses[0, 4, 3:] = 0
    world.jj[::13] = world.ii[::13]
    result = compare_ba(kernels, world, poses, patch_rows, 1, 5, tolerance=1e-6)
    assert 0 < int(result.valid.sum()) < len(world.kk)


def test_ba_limits_of_depths_and_of_the_image(kernels: Kernels) -> None:
    """Inverse depths above 20 start again at 1, small ones stop at 1e-4; images span twice the principal point."""
    world = moved_world(kernels, 11, intrinsics=(85.0, 80.0, 30.3, 20.7))
    poses, patch_rows = make_disturbed(world)
    world.weight[:, world.kk % 6 < 2] = 0
    patch_rows[0, ::6, 2], patch_rows[0, 1::6, 2] = 25, 1e-6
    state = poses.to(kernels.device), patch_rows.to(kernels.device)
    result = compare_ba(kernels, world, *state, 1, 5, 1)
    assert 0.1 < result.valid.double().mean() < 0.9
    kernels.ours(fastba.BA, *state, world.intrinsics, world.target, world.weight, 1e-4, *world.edges, 1, 5, 1)
    assert state[1][0, ::6, 2].eq(1).all() and state[1][0, 1::6, 2].eq(1e-4).all()


def test_ba_without_edges_or_iterations(kernels: Kernels) -> None:
    world = moved_world(kernels, 4)
    state = make_disturbed(world)
    assert compare_ba(kernels, world, *state, 1, 5, 0).iterations == 0
    for name in ("ii", "jj", "kk"):
        setattr(world, name, getattr(world, name)[:0])
    world.target, world.weight = world.target[:, :0], world.weight[:, :0]
    assert compare_ba(kernels, world, *state, 1, 5).success


def test_ba_that_cannot_be_solved_changes_nothing(kernels: Kernels) -> None:
    world = moved_world(kernels, 5)
    world.weight.neg_()  # the reduced system is not positive definite
    poses, patch_rows = make_disturbed(world)
    result = compare_ba(kernels, world, poses, patch_rows, 1, 5, 3)
    assert not result.success and result.iterations == 0


def test_ba_moves_the_state_of_the_caller(kernels: Kernels) -> None:
    """Also where it is a view with gaps."""
    world = moved_world(kernels, 6)
    wide_poses, wide_patches = (rows.to(kernels.device).repeat_interleave(2, dim=1) for rows in make_disturbed(world))
    poses, patch_rows = wide_poses[:, ::2], wide_patches[:, ::2]
    rest = wide_poses[:, 1::2].clone()
    expected = poses.clone(), patch_rows.clone()
    arguments = (world.intrinsics, world.target, world.weight, 1e-4, *world.edges, 1, 5)
    kernels.twin(fastba.BA, *expected, *arguments, accurate=True)
    kernels.ours(fastba.BA, poses, patch_rows, *arguments)
    assert_close(poses, expected[0], CUDA_BA)
    assert_close(patch_rows, expected[1], CUDA_BA)
    assert torch.equal(wide_poses[:, 1::2], rest) and not torch.equal(poses, rest)


def test_ba_ignores_edges_that_do_not_exist(kernels: Kernels) -> None:
    world = moved_world(kernels, 7)
    world.jj[0], world.ii[1], world.kk[2], world.kk[3] = 99, -1, 1 << 20, -5
    poses, patch_rows = (rows.to(kernels.device) for rows in make_disturbed(world))
    arguments = (world.intrinsics, world.target, world.weight, 1e-4, *world.edges, 1, 5)
    result = kernels.ours(fastba.BA, poses, patch_rows, *arguments)
    assert not result.valid[:4].any() and result.valid[4:].all() and poses.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_reproject(kernels: Kernels, dtype: torch.dtype) -> None:
    world = moved_world(kernels, 8, dtype)
    world.patches[0, 2, 2] = float("nan")
    world.poses[0, 1, 3:] *= 2  # no unit quaternion
    world.poses[0, 3, 4] = float("nan")
    state = world.poses, world.patches, world.intrinsics
    both = [run(fastba.reproject, *state, *world.edges) for run in (kernels.ours, kernels.twin)]
    assert_close(*both, CUDA_REPROJECT[dtype])
    none = [index[:0] for index in world.edges]
    assert kernels.ours(fastba.reproject, *state, *none).shape == (1, 0, 2, 3, 3)


def test_half_state_is_left_to_the_twin(kernels: Kernels) -> None:
    world = moved_world(kernels, 9, torch.float32)
    state = world.poses, world.patches.half(), world.intrinsics
    both = [run(fastba.reproject, *state, *world.edges) for run in (kernels.ours, kernels.twin)]
    assert torch.equal(*both)


def test_neighbors(kernels: Kernels) -> None:
    world = moved_world(kernels, 10)
    both = [run(fastba.neighbors, world.kk, world.jj) for run in (kernels.ours, kernels.twin)]
    assert all(torch.equal(ours, twin) for ours, twin in zip(*both))
