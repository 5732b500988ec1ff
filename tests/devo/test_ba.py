"""The differentiable bundle adjustment of training: parity with gradients, gradcheck, clips, convergence, bad input."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from devo import fastba
from devo.ba import BA
from devo.errors import InputError
from devo.graph import pair_blocks
from devo.lietorch import SE3
from tests.devo.worlds import World, dense_step, join_worlds, make_world
from tests.tolerances import BA_CLIPS, BA_DENSE_STEP, BA_TRAINING, BA_TRAINING_GRADIENT

Fixture = Callable[[str], dict[str, np.ndarray]]


def step(world: World, poses: Tensor, patches: Tensor, ep: float = 10.0, **options) -> tuple[SE3, Tensor]:
    return BA(
        SE3(poses),
        patches,
        world.intrinsics,
        world.target,
        world.weight,
        1e-4,
        *world.edges,
        world.bounds,
        ep,
        **options,
    )


# --- parity ----------------------------------------------------------------------------------------------------


def reference(fixture_npz: Fixture) -> dict[str, Tensor]:
    return {key: torch.from_numpy(value) for key, value in fixture_npz("geometry").items()}


def reference_step(a: dict[str, Tensor], target: Tensor, weight: Tensor, **options) -> tuple[SE3, Tensor]:
    return BA(
        SE3(a["init"]), a["patches"], a["intrinsics"], target, weight, torch.tensor([1e-4]), a["ii"], a["jj"], a["kk"],
        [-64, -64, 124, 109], 10.0, **options,
    )  # fmt: skip


@pytest.mark.parametrize("case", ["full", "so"])
def test_reference_step(fixture_npz: Fixture, case: str) -> None:
    a = reference(fixture_npz)
    poses, patches = reference_step(a, a["target"], a["weight"], structure_only=case == "so")
    for found, name in ((poses.data, "poses"), (patches, "patches")):
        expected = a[f"pyba_{case}_{name}"]
        torch.testing.assert_close(found, expected, rtol=BA_TRAINING, atol=BA_TRAINING)


def test_reference_gradients(fixture_npz: Fixture) -> None:
    a = reference(fixture_npz)
    target, weight = a["target"].clone().requires_grad_(), a["weight"].clone().requires_grad_()
    poses, patches = reference_step(a, target, weight)
    point = torch.tensor([1.0, 2.0, 3.0])[None, None]
    loss = (poses.inv() * point).sum() + patches[:, :, 2].sum()
    loss.backward()
    assert abs(loss.item() - a["pyba_grad_loss"].item()) <= BA_TRAINING * abs(a["pyba_grad_loss"].item())
    for found, name in ((target.grad, "target"), (weight.grad, "weight")):
        expected = a[f"pyba_grad_{name}"]
        assert (found - expected).abs().max() <= BA_TRAINING_GRADIENT * expected.abs().max()


# --- against independent solutions ---------------------------------------------------------------------------------


@pytest.mark.parametrize("fixedp", [0, 1, 2])
def test_step_equals_dense_solution(fixedp: int) -> None:
    world = make_world(fixedp, per_frame=4, jitter_intrinsics=0.05)
    poses, patches = world.disturbed(0.01, 0.05, 0, 9)
    dx, dz = dense_step(world, poses, patches[0, :, 2, 0, 0], list(range(fixedp, 5)), ep=10.0)
    new_poses, new_patches = step(world, poses, patches, fixedp=fixedp)
    moved = (new_poses * SE3(poses).inv()).log()[0]
    assert torch.equal(new_poses.data[:, :fixedp], poses[:, :fixedp])
    torch.testing.assert_close(moved[fixedp:], dx, rtol=0, atol=BA_DENSE_STEP)
    change = (new_patches - patches)[0, :, 2]
    torch.testing.assert_close(change, dz[:, None, None].expand(-1, 3, 3), rtol=0, atol=BA_DENSE_STEP)


def test_both_solvers_take_the_same_step() -> None:
    world = make_world(3)
    poses, patches = world.disturbed(0.01, 0.05, 1, 3)
    new_poses, new_patches = step(world, poses, patches, ep=1.0)
    fast_poses, fast_patches = poses.clone(), patches.clone()
    fastba.BA(
        fast_poses, fast_patches, world.intrinsics, world.target, world.weight, 1e-4, *world.edges, 1, 5, iterations=1
    )
    torch.testing.assert_close(new_poses.data, fast_poses, rtol=0, atol=1e-10)
    torch.testing.assert_close(new_patches, fast_patches, rtol=0, atol=1e-10)


def test_fifty_scenes_converge() -> None:
    """Fifty problems solved at once, two fixed poses each: truth within 1e-6, the cost never rises."""
    worlds = [make_world(seed, frames=4, per_frame=8) for seed in range(50)]
    states = [world.disturbed(0.01, 0.1, 2, seed) for seed, world in enumerate(worlds)]
    world = join_worlds(worlds)
    poses, patches = (torch.cat(part, 1) for part in zip(*states))
    start = poses.clone()
    blocks = pair_blocks(world.ii, world.jj)
    costs = []
    for _ in range(12):
        moved, patches = step(world, poses, patches, ep=1e-3, fixedp=2, clips=50, blocks=blocks)
        poses = moved.data
        pixels = fastba.reproject(poses, patches, world.intrinsics, *world.edges)[0, :, :, 1, 1]
        errors = (world.weight[0] * (world.target[0] - pixels) ** 2).sum(1)
        costs.append(torch.zeros(50, dtype=torch.float64).index_add(0, world.ii // 4, errors))
    assert all((later <= earlier + 1e-12).all() for earlier, later in zip(costs, costs[1:]))
    error = (SE3(poses) * SE3(world.poses).inv()).log()
    assert error.abs().max() < 1e-6
    torch.testing.assert_close(patches, world.patches, rtol=1e-6, atol=0)
    fixed = torch.arange(200) % 4 < 2
    assert torch.equal(poses[:, fixed], start[:, fixed])


# --- gradients ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("structure_only", [False, True])
@pytest.mark.parametrize("outliers", [False, True])
def test_gradients(structure_only: bool, outliers: bool) -> None:
    world = make_world(1, frames=3, per_frame=2)
    _, patches = world.disturbed(0.0, 0.05, 0, 1)
    target = world.target.clone()
    if outliers:
        target[0, ::5] += 400
        target[0, 3] = torch.nan
    generator = torch.Generator().manual_seed(0)
    tangent = 0.02 * torch.randn(1, 3, 6, dtype=torch.float64, generator=generator)
    good = torch.isfinite(target)

    def outcome(
        tangent: Tensor, depth: Tensor, intrinsics: Tensor, target: Tensor, weight: Tensor
    ) -> tuple[Tensor, Tensor]:
        moved = torch.cat((patches[:, :, :2], depth[:, :, None, None, None].expand(1, 6, 1, 3, 3)), 2)
        target = torch.where(good, target, torch.nan)
        poses, new = BA(
            SE3(world.poses).retr(tangent), moved, intrinsics, target, weight, 1e-4, *world.edges, world.bounds, 0.5,
            structure_only=structure_only,
        )  # fmt: skip
        return poses.log(), new[:, :, 2]

    inputs = (tangent, patches[:, :, 2, 0, 0], world.intrinsics, torch.where(good, target, 0.0), world.weight)
    inputs = tuple(value.clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(outcome, inputs, fast_mode=True)


def test_gradient_ignores_what_is_not_valid() -> None:
    world = make_world(1)
    world.target[0, 4] = torch.nan
    world.target[0, 5] += 1000
    world.target.requires_grad_()
    world.weight.requires_grad_()
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    new_poses, new_patches = step(world, poses, patches)
    (new_poses.log().sum() + new_patches.sum()).backward()
    for grad in (world.target.grad, world.weight.grad):
        assert torch.isfinite(grad).all()
        assert (grad[0, 4:6] == 0).all()
        assert (grad != 0).any(-1).float().mean() > 0.7


def test_failed_factorisation_is_a_step_of_depths_only() -> None:
    """Negative weights: no Cholesky factor in the second clip; the first one is solved as ever."""
    worlds = [make_world(seed) for seed in (0, 1)]
    worlds[1].weight = -0.5 * worlds[1].weight
    world = join_worlds(worlds)
    world.weight.requires_grad_()
    states = [w.disturbed(0.01, 0.05, 1, 3) for w in worlds]
    poses, patches = (torch.cat(part, 1) for part in zip(*states))
    new_poses, new_patches = step(world, poses, patches, clips=2)
    torch.testing.assert_close(new_poses.data[:, 5:], poses[:, 5:], rtol=0, atol=1e-15)
    only_depths = BA(
        SE3(poses), patches, world.intrinsics, world.target, world.weight, 1e-4, *world.edges, world.bounds, 10.0,
        structure_only=True, clips=2,
    )[1]  # fmt: skip
    torch.testing.assert_close(new_patches[:, 30:], only_depths[:, 30:])
    alone_poses, _ = step(worlds[0], *states[0])
    torch.testing.assert_close(new_poses.data[:, :5], alone_poses.data)
    new_poses.log().sum().backward()
    second = world.ii >= 5
    assert (world.weight.grad[0, second] == 0).all()
    assert (world.weight.grad[0, ~second] != 0).any()
    assert torch.isfinite(world.weight.grad).all()


# --- clips -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fixedp", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_clips_equal_separate_calls(dtype: torch.dtype, fixedp: int) -> None:
    worlds = [make_world(seed, dtype=dtype, jitter_intrinsics=0.02) for seed in range(3)]
    # The clips may see different frames: the last one has not grown to its last two frames yet.
    keep = (worlds[2].ii < 3) & (worlds[2].jj < 3)
    for name in ("ii", "jj", "kk"):
        setattr(worlds[2], name, getattr(worlds[2], name)[keep])
    worlds[2].target, worlds[2].weight = worlds[2].target[:, keep], worlds[2].weight[:, keep]
    states = [world.disturbed(0.01, 0.05, 1, seed) for seed, world in enumerate(worlds)]
    world = join_worlds(worlds)
    order = torch.randperm(len(world.kk), generator=torch.Generator().manual_seed(0))
    world.ii, world.jj, world.kk = (label[order] for label in world.edges)
    world.target, world.weight = world.target[:, order].requires_grad_(), world.weight[:, order]
    poses, patches = (torch.cat(part, 1) for part in zip(*states))
    bounds = [-60.0, -60.0, 220.0, 180.0]
    joined, joined_patches = BA(
        SE3(poses), patches, world.intrinsics, world.target, world.weight, 1e-4, *world.edges, bounds, 10.0,
        fixedp=fixedp, clips=3,
    )  # fmt: skip
    (joined.log().sum() + joined_patches.sum()).backward()
    joined_grad = torch.empty_like(world.target)
    joined_grad[:, order] = world.target.grad
    tolerance = BA_CLIPS if dtype == torch.float32 else 1e-11
    first = 0
    for clip, (single, state) in enumerate(zip(worlds, states)):
        single.target.requires_grad_()
        alone, alone_patches = BA(
            SE3(state[0]), state[1], single.intrinsics, single.target, single.weight, 1e-4, *single.edges, bounds, 10.0,
            fixedp=fixedp,
        )  # fmt: skip
        (alone.log().sum() + alone_patches.sum()).backward()
        frames, rows = slice(5 * clip, 5 * clip + 5), slice(30 * clip, 30 * clip + 30)
        torch.testing.assert_close(joined.data[:, frames], alone.data, rtol=0, atol=tolerance)
        torch.testing.assert_close(joined_patches[:, rows], alone_patches, rtol=0, atol=tolerance)
        grad = joined_grad[:, first : first + len(single.kk)]
        assert (grad - single.target.grad).abs().max() <= 10 * tolerance * grad.abs().max()
        first += len(single.kk)


def test_frames_without_edges_stay() -> None:
    world = make_world(0)
    keep = (world.ii < 3) & (world.jj < 3)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    new, _ = BA(
        SE3(poses), patches, world.intrinsics, world.target[:, keep], world.weight[:, keep], 1e-4,
        world.ii[keep], world.jj[keep], world.kk[keep], world.bounds,
    )  # fmt: skip
    assert torch.equal(new.data[:, 3:], poses[:, 3:])
    assert torch.equal(new.data[:, :1], poses[:, :1])
    assert (new.data[:, 1:3] != poses[:, 1:3]).any(-1).all()


@pytest.mark.parametrize(("clips", "message"), [(3, "equal shares"), (0, "equal shares"), (5, "joins two clips")])
def test_wrong_clips_are_refused(clips: int, message: str) -> None:
    world = make_world(0)
    with pytest.raises(InputError, match=message):
        step(world, world.poses, world.patches, clips=clips)


# --- limits and degenerate input -------------------------------------------------------------------------------------


def test_arguments_are_not_changed() -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    before = poses.clone(), patches.clone()
    step(world, poses, patches)
    assert torch.equal(poses, before[0])
    assert torch.equal(patches, before[1])


def test_all_depths_are_limited() -> None:
    world = make_world(0)
    patches = world.patches.clone()
    patches[0, 2, 2], patches[0, 8, 2] = -1.0, 50.0
    world.weight[:, (world.kk == 2) | (world.kk == 8)] = 0
    _, new = step(world, world.poses, patches)
    assert (new[0, 2, 2] == 1e-3).all()
    assert (new[0, 8, 2] == 10.0).all()
    assert torch.equal(new[:, :, :2], patches[:, :, :2])


@pytest.mark.parametrize(("axis", "bound", "sign"), [(0, 0, 1), (1, 1, 1), (0, 2, -1), (1, 3, -1)])
def test_bounds_are_strict(axis: int, bound: int, sign: int) -> None:
    """With a bound just inside the outermost projection, exactly that edge loses its influence."""
    world = make_world(0)
    pixels = fastba.reproject(world.poses, world.patches, world.intrinsics, *world.edges)[0, :, axis, 1, 1]
    world.target = (world.target + 0.3).requires_grad_()
    edge = int((sign * pixels).argmin())
    bounds = [-1000.0, -1000.0, 1000.0, 1000.0]
    seen = []
    for margin in (1e-6, -1e-6):
        bounds[bound] = float(pixels[edge]) - sign * margin
        _, new = BA(
            SE3(world.poses), world.patches, world.intrinsics, world.target, world.weight, 1e-4, *world.edges, bounds
        )
        (grad,) = torch.autograd.grad(new.square().sum(), world.target)
        seen.append(bool((grad[0, edge] != 0).any()))
        others = (world.ii != world.jj) & (torch.arange(len(world.kk)) != edge)
        assert (grad[0, others] != 0).any(-1).all()
    assert seen == [True, False]


def test_no_edges() -> None:
    world = make_world(0)
    none = torch.zeros(0, dtype=torch.int64)
    nothing = torch.zeros(1, 0, 2)
    poses, patches = BA(
        SE3(world.poses), world.patches, world.intrinsics, nothing, nothing, 1e-4, none, none, none, world.bounds
    )
    assert torch.equal(poses.data, world.poses)
    assert torch.equal(patches, world.patches)


@pytest.mark.parametrize("what", ["far targets", "nan targets", "nan weights", "behind", "camera plane"])
def test_nothing_valid_moves_nothing(what: str) -> None:
    world = make_world(0)
    patches = world.patches.clone()
    if what == "far targets":
        world.target = world.target + 251
    elif what == "nan targets":
        world.target = torch.full_like(world.target, torch.nan)
    elif what == "nan weights":
        world.target, world.weight = world.target + 251, torch.full_like(world.weight, torch.nan)
    keep = torch.ones_like(world.kk, dtype=torch.bool)
    if what in ("behind", "camera plane"):
        world.poses[:] = torch.tensor([0.0, 0, 0, 0, 0, 0, 1])
        world.poses[0, :, 2] = torch.arange(5) * (-1.0 if what == "camera plane" else -4.0)
        patches[:, :, 2] = 1.0
        keep = world.jj == world.ii + 1
    world.weight.requires_grad_()
    new_poses, new_patches = BA(
        SE3(world.poses), patches, world.intrinsics, world.target[:, keep], world.weight[:, keep], 1e-4,
        world.ii[keep], world.jj[keep], world.kk[keep], world.bounds, 10.0,
    )  # fmt: skip
    torch.testing.assert_close(new_poses.data, world.poses, rtol=0, atol=1e-15)
    assert torch.equal(new_patches, patches)
    (new_poses.log().sum() + new_patches.sum()).backward()
    assert (world.weight.grad == 0).all()


def test_no_damping_and_no_information() -> None:
    world = make_world(0)
    arguments = (world.intrinsics, world.target, torch.zeros_like(world.weight).requires_grad_(), 0.0, *world.edges)
    poses, patches = BA(SE3(world.poses), world.patches, *arguments, world.bounds)
    assert torch.equal(patches, world.patches)
    patches.sum().backward()
    assert torch.isfinite(arguments[2].grad).all()


def test_only_fixed_frames() -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.0, 0.05, 5, 1)
    new_poses, new_patches = step(world, poses, patches, fixedp=5)
    assert torch.equal(new_poses.data, poses)
    assert (new_patches - world.patches).abs().max() < (patches - world.patches).abs().max()


def test_nothing_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(0)
    step(world, world.poses, world.patches, PRINT=True)
    assert capsys.readouterr().out == ""


def test_autocast_does_not_touch_the_solver() -> None:
    world = make_world(0, dtype=torch.float32)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    expected = step(world, poses, patches)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = step(world, poses, patches)
    assert torch.equal(found[0].data, expected[0].data)
    assert torch.equal(found[1], expected[1])
