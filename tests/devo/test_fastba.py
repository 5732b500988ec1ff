"""The inference solver: parity, independent dense reference, convergence, options, bad numbers, in-place behaviour."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from devo import fastba, normal_equations
from devo import projective_ops as pops
from devo.errors import InputError
from devo.fastba import BAResult, torch_twin
from devo.graph import adjoint_matrices
from devo.lietorch import SE3
from tests.devo.worlds import World, centre_pixels, dense_step, make_world
from tests.tolerances import (
    BA_ACCURATE,
    BA_DENSE_STEP,
    BA_FREE_SCALE,
    BA_ONE_STEP,
    BA_TWO_STEPS,
    REPROJECTION,
)

Fixture = Callable[[str], dict[str, np.ndarray]]


@pytest.fixture(autouse=True, params=["published order", "accurate"])
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both ways to solve pass all tests; `solve` takes the one of the test that runs."""
    monkeypatch.setitem(_DEFAULTS, "accurate", request.param == "accurate")
    return request.param


_DEFAULTS: dict[str, bool] = {}


def solve(world: World, poses: Tensor, patches: Tensor, t0: int, t1: int, iterations: int = 1, **options) -> BAResult:
    return fastba.BA(
        poses, patches, world.intrinsics, world.target, world.weight, 1e-4, *world.edges, t0, t1, iterations,
        **(_DEFAULTS | options)
    )  # fmt: skip


def tangents(new: Tensor, old: Tensor) -> Tensor:
    """Left perturbation that leads from old to new poses."""
    return (SE3(new.double()) * SE3(old.double()).inv()).log()[0]


# --- parity ----------------------------------------------------------------------------------------------------


def free_scale(inv_depths: Tensor, expected: Tensor) -> float:
    """Best common factor: float32 leaves the scale open by some 1e-4, how much depends on the processor's sums."""
    return float((inv_depths.double() * expected).sum() / inv_depths.double().square().sum())


@pytest.mark.parametrize(("case", "t0", "t1", "iterations"), [("a", 1, 8, 1), ("b", 1, 8, 2), ("c", 4, 8, 2)])
def test_reference_steps(fixture_npz: Fixture, solver: str, case: str, t0: int, t1: int, iterations: int) -> None:
    a = {key: torch.from_numpy(value) for key, value in fixture_npz("geometry").items()}
    poses, patches = a["init"].clone(), a["patches"].clone()
    result = fastba.BA(
        poses, patches, a["intrinsics"], a["target"], a["weight"], torch.tensor([1e-4]), a["ii"], a["jj"], a["kk"],
        t0, t1, iterations, **_DEFAULTS,
    )  # fmt: skip
    assert result.success
    assert result.iterations == iterations
    expected = a[f"fastba_{case}_patches"]
    torch.testing.assert_close(patches[:, :, :2], expected[:, :, :2], rtol=0, atol=0)
    expected_poses = a[f"fastba_{case}_poses"]
    if solver == "published order":
        tolerance = BA_ONE_STEP if iterations == 1 else BA_TWO_STEPS
        torch.testing.assert_close(poses, expected_poses, rtol=0, atol=tolerance)
        scale = free_scale(patches[0, :, 2], expected[0, :, 2])
        assert abs(scale - 1) <= BA_FREE_SCALE
        torch.testing.assert_close(scale * patches[:, :, 2], expected[:, :, 2], rtol=0, atol=tolerance)
    assert (poses - expected_poses).norm() <= BA_ACCURATE * expected_poses.norm()
    assert (patches - expected)[:, :, 2].norm() <= BA_ACCURATE * expected[:, :, 2].norm()
    assert torch.equal(result.patch_ids, torch.unique(a["kk"]))
    assert 0.8 < result.valid.float().mean() < 1  # the outliers of the fixture


def test_reference_reprojection_and_neighbors(fixture_npz: Fixture) -> None:
    a = {key: torch.from_numpy(value) for key, value in fixture_npz("geometry").items()}
    pixels = fastba.reproject(SE3(a["init"]), a["patches"], a["intrinsics"], a["ii"], a["jj"], a["kk"])
    torch.testing.assert_close(pixels, a["reproject"], rtol=REPROJECTION, atol=REPROJECTION)
    previous, following = fastba.neighbors(a["kk"], a["jj"])
    assert torch.equal(previous, a["neighbors_prev"])
    assert torch.equal(following, a["neighbors_next"])


# --- against an independent dense solution -----------------------------------------------------------------------


def dense_difference(t0: int, t1: int, per_frame: bool, seed: int, **options: bool) -> float:
    world = make_world(seed, per_frame=4, jitter_intrinsics=0.05 if per_frame else 0.0)
    poses, patches = world.disturbed(0.01, 0.05, 0, seed + 50)
    dx, dz = dense_step(world, poses, patches[0, :, 2, 0, 0], list(range(t0, t1)), ep=1.0)
    new_poses, new_patches = poses.clone(), patches.clone()
    result = solve(world, new_poses, new_patches, t0, t1, per_frame_intrinsics=per_frame, **options)
    assert result.success
    assert result.valid.all()
    moved = tangents(new_poses, poses)
    assert torch.equal(new_poses[:, :t0], poses[:, :t0])
    assert torch.equal(new_poses[:, t1:], poses[:, t1:])
    depth_error = (new_patches - patches)[0, :, 2, 0, 0] - dz
    return max(float((moved[t0:t1] - dx).abs().max()), float(depth_error.abs().max()))


@pytest.mark.parametrize(("t0", "t1"), [(1, 5), (0, 5), (3, 5), (1, 3)])
@pytest.mark.parametrize("per_frame", [False, True])
def test_step_equals_dense_solution(t0: int, t1: int, per_frame: bool) -> None:
    assert dense_difference(t0, t1, per_frame, seed=t0 + t1) < BA_DENSE_STEP


FAULTS = {
    "source pose block": lambda G: -adjoint_matrices(G),
    "no adjoint": lambda G: torch.eye(6, dtype=G.dtype).expand(len(G), 6, 6),
    "inverse adjoint": lambda G: torch.linalg.inv(adjoint_matrices(G)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_source_jacobian_is_noticed(monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    monkeypatch.setattr(normal_equations, "adjoint_matrices", FAULTS[fault])
    assert dense_difference(1, 5, False, seed=6, accurate=True) > 100 * BA_DENSE_STEP


@pytest.mark.parametrize("row", [0, 1, 2, 3, 4, 5])
def test_faulty_target_jacobian_is_noticed(monkeypatch: pytest.MonkeyPatch, row: int) -> None:
    original = normal_equations._target_jacobian

    def flipped(observed: normal_equations.Observed) -> Tensor:
        J = original(observed)
        J[:, row] *= -1
        return J

    monkeypatch.setattr(normal_equations, "_target_jacobian", flipped)
    assert dense_difference(1, 5, False, seed=6, accurate=True) > 100 * BA_DENSE_STEP


def test_other_image_size_is_the_only_difference() -> None:
    world = make_world(4)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    limit = float(world.target[0, :, 0].median()) - 64  # half of the projections lie outside this width
    narrow = solve(world, poses.clone(), patches.clone(), 1, 5, image_size=(120, limit))
    same = solve(world, poses.clone(), patches.clone(), 1, 5, image_size=(120.0, 160.0))
    default = solve(world, poses.clone(), patches.clone(), 1, 5)
    seen = centre_pixels(poses, patches[0, :, 2, 1, 1], world)
    assert torch.equal(narrow.valid, seen[:, 0] < limit + 64)
    assert torch.equal(same.residual, default.residual)
    assert default.valid.all()


# --- convergence -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_exact_measurements_lead_to_the_truth(seed: int) -> None:
    world = make_world(seed, frames=6, per_frame=16)
    poses, patches = world.disturbed(0.01, 0.1, 2, seed + 100)
    costs = []
    for _ in range(12):
        result = solve(world, poses, patches, 2, 6)
        assert result.success
        assert result.valid.all()
        costs.append(float((world.weight[0] * result.residual**2).sum()))
    assert all(later <= earlier for earlier, later in zip(costs[:6], costs[1:6]))
    assert tangents(poses, world.poses).abs().max() < 1e-6
    torch.testing.assert_close(patches[:, :, 2], world.patches[:, :, 2], rtol=1e-6, atol=0)
    assert torch.equal(poses[:, :2], world.poses[:, :2])  # the gauge does not move at all


def test_depth_information_predicts_the_error() -> None:
    sigma = 0.5
    world = make_world(1, frames=6, per_frame=100)
    generator = torch.Generator().manual_seed(0)
    world.target = world.target + sigma * torch.randn(world.target.shape, generator=generator, dtype=torch.float64)
    world.weight = torch.full_like(world.weight, sigma**-2)
    poses, patches = world.disturbed(0.0, 0.02, 6, 7)
    result = solve(world, poses, patches, 6, 6, iterations=6)
    error = patches[0, :, 2, 0, 0] - world.patches[0, :, 2, 0, 0]
    assert torch.equal(poses, world.poses)
    assert 0.85 < float((error**2 * result.depth_information).mean()) < 1.15


def test_float32_state_matches_float64() -> None:
    world = make_world(3)
    poses, patches = world.disturbed(0.01, 0.05, 2, 3)
    poses32, patches32 = poses.float(), patches.float()
    solve(world, poses, patches, 2, 5)
    single = make_world(3, dtype=torch.float32)
    result = solve(single, poses32, patches32, 2, 5)
    torch.testing.assert_close(poses32.double(), poses, rtol=0, atol=2e-6)
    torch.testing.assert_close(patches32.double(), patches, rtol=0, atol=2e-5)
    assert result.residual.dtype == torch.float32
    assert result.depth_information.dtype == torch.float64


def test_quaternions_stay_normalised() -> None:
    world = make_world(2, dtype=torch.float32)
    poses, patches = world.disturbed(0.01, 0.05, 1, 3)
    poses[:, :, 3:] *= 1.01
    solve(world, poses, patches, 1, 5, iterations=3)
    lengths = poses[0, :, 3:].norm(dim=1)
    torch.testing.assert_close(lengths[1:], torch.ones(4))
    assert lengths[0] > 1.005  # a fixed pose is not touched


def test_same_input_gives_the_same_bytes() -> None:
    world = make_world(5, dtype=torch.float32)
    runs = []
    for _ in range(2):
        poses, patches = world.disturbed(0.01, 0.05, 1, 3)
        solve(world, poses, patches, 1, 5, iterations=2)
        runs.append((poses, patches))
    assert torch.equal(runs[0][0], runs[1][0])
    assert torch.equal(runs[0][1], runs[1][1])


# --- depths ------------------------------------------------------------------------------------------------------


def test_depth_limits() -> None:
    world = make_world(0, frames=3, per_frame=4)
    patches = world.patches.clone()
    patches[0, 0, 2] = 25.0  # wild, all edges are outliers: stays above the limit and is reset
    patches[0, 1, 2] = -3.0
    world.weight[0, world.kk <= 1] = 0  # no information: no step
    solve(world, world.poses.clone(), patches, 3, 3)
    assert (patches[0, 0, 2] == 1.0).all()
    assert (patches[0, 1, 2] == 1e-4).all()
    torch.testing.assert_close(patches[0, 2:, 2], world.patches[0, 2:, 2])


def test_depth_is_read_from_the_first_and_written_to_all_pixels() -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.0, 0.1, 5, 1)
    tilted = patches.clone()
    tilted[:, :, 2, 0, 0] += 0.125
    solve(world, poses, patches, 5, 5)
    solve(world, poses, tilted, 5, 5)
    torch.testing.assert_close(tilted[:, :, 2], patches[:, :, 2] + 0.125)
    assert (patches[:, :, 2] == patches[:, :, 2, :1, :1]).all()


def test_patches_without_edges_are_left_alone() -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.1, 1, 1)
    patches[0, 7, 2] = 50.0
    keep = world.kk != 7
    before = patches.clone()
    result = fastba.BA(
        poses, patches, world.intrinsics, world.target[:, keep], world.weight[:, keep], 1e-4,
        world.ii[keep], world.jj[keep], world.kk[keep], 1, 5,
    )  # fmt: skip
    assert 7 not in result.patch_ids
    assert torch.equal(patches[0, 7], before[0, 7])
    assert (patches[0, :7, 2] != before[0, :7, 2]).all()


# --- buffers -----------------------------------------------------------------------------------------------------


def test_views_of_larger_buffers_change_in_place() -> None:
    world = make_world(0, dtype=torch.float32)
    poses, patches = world.disturbed(0.01, 0.1, 1, 1)
    expected_poses, expected_patches = poses.clone(), patches.clone()
    solve(world, expected_poses, expected_patches, 1, 5)

    pose_buffer = torch.full((12, 9), 7.0)
    pose_buffer[2:7, 1:8] = poses[0]
    patch_buffer = torch.full((8, 6, 3, 3, 3), 7.0)
    patch_buffer[:5] = patches.view(5, 6, 3, 3, 3)
    group = SE3(pose_buffer[None, 2:7, 1:8])
    solve(world, group, patch_buffer.view(1, 48, 3, 3, 3), 1, 5)
    assert torch.equal(pose_buffer[None, 2:7, 1:8], expected_poses)
    assert torch.equal(patch_buffer[:5].view(1, 30, 3, 3, 3), expected_patches)
    assert (pose_buffer[:2] == 7).all()
    assert (pose_buffer[:, 0] == 7).all()
    assert (patch_buffer[5:] == 7).all()


def test_no_gradient_is_recorded() -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.1, 1, 1)
    patches.requires_grad_()
    result = solve(world, poses, patches, 1, 5)
    assert patches.grad_fn is None
    assert not result.residual.requires_grad


# --- bad numbers and degenerate input ------------------------------------------------------------------------------


def test_no_edges_is_a_no_op() -> None:
    world = make_world(0)
    none = torch.zeros(0, dtype=torch.int64)
    poses, patches = world.poses.clone(), world.patches.clone()
    nothing = torch.zeros(1, 0, 2)
    result = fastba.BA(poses, patches, world.intrinsics, nothing, nothing, 1e-4, none, none, none, 1, 5)
    assert result.success
    assert result.iterations == 0
    assert [len(field) for field in result[2:]] == [0, 0, 0, 0]
    assert torch.equal(poses, world.poses)
    assert torch.equal(patches, world.patches)
    assert fastba.reproject(poses, patches, world.intrinsics, none, none, none).shape == (1, 0, 2, 3, 3)


def test_only_invalid_edges_move_nothing() -> None:
    world = make_world(0)
    world.target = world.target + 1000
    poses, patches = world.poses.clone(), world.patches.clone()
    result = solve(world, poses, patches, 1, 5, iterations=2)
    assert result.success
    assert not result.valid.any()
    assert (result.residual == 0).all()
    assert (result.depth_information == 0).all()
    torch.testing.assert_close(poses, world.poses, rtol=0, atol=1e-15)
    assert torch.equal(patches, world.patches)


BAD = ["target", "weight", "target inf", "pose", "depth", "pixel", "camera plane", "behind", "zero quaternion"]


@pytest.mark.parametrize("what", BAD)
def test_bad_numbers_do_not_spread(what: str) -> None:
    """Edges that touch a bad number are left out; the rest of the problem is solved as if they were not there."""
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    bad = world.kk == 3
    if what == "target":
        world.target[0, bad, 1] = torch.nan
    elif what == "target inf":
        world.target[0, bad] = torch.inf
    elif what == "weight":
        world.weight[0, bad, 0] = torch.nan
    elif what == "pose":
        poses[0, 4, 1] = torch.nan
    elif what == "zero quaternion":
        poses[0, 4, 3:] = 0
    elif what == "depth":
        patches[0, 3, 2] = torch.nan
    elif what == "pixel":
        patches[0, 3, 0] = torch.nan
    elif what == "camera plane":  # camera 4 is so far ahead of camera 0 that the patch of that one has Z = 0
        poses[0, 4] = torch.tensor([0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0])
        patches[0, 3, 2] = 1.0
    elif what == "behind":
        patches[0, 3, 2] = -8.0
    if what in ("pose", "zero quaternion"):
        bad = (world.ii == 4) | (world.jj == 4)
    if what == "camera plane":
        bad = (world.kk == 3) & (world.jj == 4)
    new_poses, new_patches = poses.clone(), patches.clone()
    iterations = 1 if what == "camera plane" else 2  # it moves away from there
    result = solve(world, new_poses, new_patches, 1, 5, iterations)
    assert result.success
    if what != "behind":
        assert not result.valid[bad].any()
        assert (result.residual[bad] == 0).all()
    assert torch.isfinite(result.depth_information).all()

    clean_poses, clean_patches = poses.clone(), patches.clone()
    keep = ~bad
    fastba.BA(
        clean_poses, clean_patches, world.intrinsics, world.target[:, keep], world.weight[:, keep], 1e-4,
        world.ii[keep], world.jj[keep], world.kk[keep], 1, 5, iterations, **_DEFAULTS,
    )  # fmt: skip
    if what != "behind":
        torch.testing.assert_close(new_poses, clean_poses, rtol=0, atol=1e-12, equal_nan=True)
    others = torch.arange(30) != 3
    if what == "depth":
        assert new_patches[0, 3, 2].isnan().all()  # not silently turned into a far point
    assert torch.isfinite(new_patches[0, others]).all()
    assert torch.isfinite(new_poses[0, :4]).all()


def test_failed_factorisation_keeps_the_previous_state(monkeypatch: pytest.MonkeyPatch) -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    once_poses, once_patches = poses.clone(), patches.clone()
    solve(world, once_poses, once_patches, 1, 5, iterations=1)
    original, calls = torch.linalg.cholesky_ex, []

    def second_fails(matrix: Tensor) -> tuple[Tensor, Tensor]:
        calls.append(1)
        factor, info = original(matrix)
        return factor, info + (len(calls) > 1)

    monkeypatch.setattr(torch.linalg, "cholesky_ex", second_fails)
    result = solve(world, poses, patches, 1, 5, iterations=4)
    assert not result.success
    assert result.iterations == 1
    assert len(calls) == 2
    assert torch.equal(poses, once_poses)
    assert torch.equal(patches, once_patches)


def test_indefinite_system_is_reported() -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    before = poses.clone(), patches.clone()
    world.weight = -1e3 * world.weight
    result = solve(world, poses, patches, 1, 5, iterations=2)
    assert not result.success
    assert result.iterations == 0
    assert torch.equal(poses, before[0])
    assert torch.equal(patches, before[1])


def test_no_damping_and_no_information() -> None:
    world = make_world(0)
    world.weight = torch.zeros_like(world.weight)
    poses, patches = world.poses.clone(), world.patches.clone()
    result = fastba.BA(poses, patches, world.intrinsics, world.target, world.weight, 0.0, *world.edges, 1, 5)
    assert result.success
    assert torch.equal(patches, world.patches)


def test_free_poses_without_edges_stay() -> None:
    world = make_world(0)
    keep = (world.ii < 2) & (world.jj < 2)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    before = poses.clone()
    arguments = (world.target[:, keep], world.weight[:, keep], 1e-4, world.ii[keep], world.jj[keep], world.kk[keep])
    assert fastba.BA(poses, patches, world.intrinsics, *arguments, 1, 5).success
    torch.testing.assert_close(poses[0, 2:], before[0, 2:], rtol=0, atol=1e-15)
    assert (poses[0, 1] != before[0, 1]).any()
    poses = before.clone()
    assert fastba.BA(poses, patches, world.intrinsics, *arguments, 3, 5).success  # no free pose in any edge
    torch.testing.assert_close(poses, before, rtol=0, atol=1e-15)


def test_uneven_pairs_and_duplicate_edges() -> None:
    """A pair with many edges is split into blocks; an edge that appears twice counts twice."""
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    crowd = torch.nonzero((world.ii == 1) & (world.jj == 3)).squeeze(1).repeat(60)
    chosen = torch.cat((torch.arange(len(world.kk)), crowd))
    heavy = world.weight.clone()
    heavy[0, crowd[: len(crowd) // 60]] *= 61
    results = []
    for index, weight in ((chosen, world.weight[:, chosen]), (torch.arange(len(world.kk)), heavy)):
        state = poses.clone(), patches.clone()
        edges = [label[index] for label in world.edges]
        fastba.BA(*state, world.intrinsics, world.target[:, index], weight, 1e-4, *edges, 1, 5)
        results.append(state)
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-10)
    torch.testing.assert_close(results[0][1], results[1][1], rtol=0, atol=1e-10)


def test_unfitting_shapes_are_named() -> None:
    world = make_world(0)
    with pytest.raises(InputError, match="expected target and weight"):
        fastba.BA(
            world.poses, world.patches, world.intrinsics, world.target[:, 1:], world.weight, 1e-4, *world.edges, 1, 5
        )
    with pytest.raises(InputError, match="poses has shape"):
        solve(world, world.poses[0, 0], world.patches, 1, 5)


def test_reprojection_is_raw() -> None:
    world = make_world(0)
    pixels = fastba.reproject(world.poses, world.patches, world.intrinsics, *world.edges)
    expected = pops.transform(SE3(world.poses), world.patches, world.intrinsics, *world.edges)
    torch.testing.assert_close(pixels, expected.permute(0, 1, 4, 2, 3))
    behind = world.patches.clone()
    behind[0, :, 2] = -8
    assert not torch.allclose(
        fastba.reproject(world.poses, behind, world.intrinsics, *world.edges),
        pops.transform(SE3(world.poses), behind, world.intrinsics, *world.edges).permute(0, 1, 4, 2, 3),
    )


# --- choice of the implementation ----------------------------------------------------------------------------------


def test_an_extension_gets_the_same_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is an extension, it is called like the torch twin, and its result has the same names."""
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)
    expected = poses.clone(), patches.clone()
    solve(world, *expected, 1, 5, iterations=2, per_frame_intrinsics=True)
    extension = SimpleNamespace(
        ba=lambda *arguments, **options: tuple(torch_twin.ba(*arguments, **options)),
        neighbors=lambda kk, jj: (kk, jj),
        reproject=torch_twin.reproject,
    )
    asked = []
    monkeypatch.setattr(fastba, "cuda_kernel", lambda name, *tensors: asked.append(name) or extension)
    result = solve(world, SE3(poses), patches, 1, 5, iterations=2, per_frame_intrinsics=True)
    assert isinstance(result, BAResult)
    assert torch.equal(poses, expected[0])
    assert torch.equal(patches, expected[1])
    assert fastba.neighbors(world.kk, world.jj) == (world.kk, world.jj)
    assert fastba.reproject(SE3(poses), patches, world.intrinsics, *world.edges).shape[-2:] == (3, 3)
    assert asked == ["fastba"] * 3


def test_forced_cuda_is_refused_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVO_KERNELS", "cuda")
    with pytest.raises(InputError, match="DEVO_KERNELS=cuda"):
        fastba.neighbors(torch.zeros(2, dtype=torch.int64), torch.zeros(2, dtype=torch.int64))


# --- neighbours --------------------------------------------------------------------------------------------------


def slow_neighbors(kk: list[int], jj: list[int]) -> tuple[list[int], list[int]]:
    previous, following = [-1] * len(kk), [-1] * len(kk)
    for patch in set(kk):
        edges = sorted((jj[e], e) for e in range(len(kk)) if kk[e] == patch)
        for (_, before), (_, after) in zip(edges, edges[1:]):
            previous[after], following[before] = before, after
    return previous, following


@settings(deadline=None, max_examples=80)
@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 4)), max_size=40), st.integers(0, 10**9))
def test_neighbors_equal_brute_force(edges: list[tuple[int, int]], offset: int) -> None:
    kk, jj = [k + offset for k, _ in edges], [j for _, j in edges]
    found = fastba.neighbors(torch.tensor(kk, dtype=torch.int64), torch.tensor(jj, dtype=torch.int64))
    expected = slow_neighbors(kk, jj)
    assert found[0].tolist() == expected[0]
    assert found[1].tolist() == expected[1]
    assert found[0].dtype == torch.int64


@settings(deadline=None, max_examples=30)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=30))
def test_neighbors_are_inverse_to_each_other(edges: list[tuple[int, int]]) -> None:
    kk, jj = (torch.tensor(column, dtype=torch.int64) for column in zip(*edges))
    previous, following = fastba.neighbors(kk, jj)
    has_next = following >= 0
    assert torch.equal(previous[following[has_next]], torch.nonzero(has_next).squeeze(1))
    assert int((previous < 0).sum()) == len(set(kk.tolist()))
