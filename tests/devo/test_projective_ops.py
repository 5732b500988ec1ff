"""Pinhole geometry: parity, closed cases, Jacobians against differences, gradients, the fast reprojection."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from devo import projective_ops as pops
from devo.errors import InputError
from devo.graph import frame_pairs, group_sum, pair_blocks, unique_with_inverse
from devo.lietorch import SE3
from tests.devo.worlds import World, centre_pixels, make_world
from tests.tolerances import REPROJECT_EDGES, TRANSFORM

Fixture = Callable[[str], dict[str, np.ndarray]]


def arguments(world: World) -> tuple[Tensor, ...]:
    return (world.patches, world.intrinsics, *world.edges)


def planes(pixels: Tensor) -> Tensor:
    return pixels.permute(0, 1, 4, 2, 3)


# --- parity ----------------------------------------------------------------------------------------------------


def test_reference_values(fixture_npz: Fixture) -> None:
    a = {key: torch.from_numpy(value) for key, value in fixture_npz("geometry").items()}
    poses = SE3(a["init"])
    edges = (a["patches"], a["intrinsics"], a["ii"], a["jj"], a["kk"])
    pixels, valid, (Ji, Jj, Jz) = pops.transform(poses, *edges, jacobian=True)
    found = {
        "transform": pixels,
        "valid": valid,
        "Ji": Ji,
        "Jj": Jj,
        "Jz": Jz,
        "transform_depth": pops.transform(poses, *edges, depth=True),
        "transform_tonly": pops.transform(poses, *edges, tonly=True),
        "point_cloud": pops.point_cloud(poses, a["patches"], a["intrinsics"], a["ix"]),
        "flow_mag": pops.flow_mag(poses, *edges, beta=0.5),
    }
    for name, value in found.items():
        assert value.shape == a[name].shape, name
        assert value.dtype == a[name].dtype, name
        assert (value - a[name]).abs().max() <= TRANSFORM * a[name].abs().max(), name
    fast = pops.reproject_edges(a["init"], *edges)
    assert (fast - planes(a["transform"])).abs().max() <= REPROJECT_EDGES * a["transform"].abs().max()


# --- closed cases ------------------------------------------------------------------------------------------------


def test_projection_undoes_back_projection() -> None:
    world = make_world(0)
    points = pops.iproj(world.patches, world.intrinsics[:, :1].expand(1, 30, 4))
    assert points.shape == (1, 30, 3, 3, 4)
    assert (points[..., 2] == 1).all()
    assert torch.equal(points[..., 3], world.patches[:, :, 2])
    pixels = pops.proj(points, world.intrinsics[:, :1].expand(1, 30, 4), depth=True)
    torch.testing.assert_close(planes(pixels)[:, :, :2], world.patches[:, :, :2])
    assert (pixels[..., 2] == 1).all()


def test_known_motion() -> None:
    """One metre forward: a point at depth 4 moves away from the principal point by 4 / 3."""
    poses = torch.tensor([[[0.0, 0, 0, 0, 0, 0, 1], [0.0, 0, -1, 0, 0, 0, 1]]])
    camera = torch.tensor([[[100.0, 50, 40, 30]] * 2])
    patches = torch.zeros(1, 1, 3, 1, 1)
    patches[0, 0, :, 0, 0] = torch.tensor([52.0, 36, 0.25])
    edge = torch.tensor([0]), torch.tensor([1]), torch.tensor([0])
    pixel, valid = pops.transform(poses, patches, camera, *edge, valid=True)
    torch.testing.assert_close(pixel.flatten(), torch.tensor([40 + 12 * 4 / 3, 30 + 6 * 4 / 3]))
    assert valid.tolist() == [[1.0]]
    with_depth = pops.transform(poses, patches, camera, *edge, depth=True)
    torch.testing.assert_close(with_depth[..., 2].flatten(), torch.tensor([4 / 3]))  # 1 / Z, where Z was 1 before
    cloud = pops.point_cloud(poses, patches, camera, torch.tensor([1]))
    torch.testing.assert_close((cloud[..., :3] / cloud[..., 3:]).flatten(), torch.tensor([4 * 0.12, 4 * 0.12, 4 + 1.0]))


@pytest.mark.parametrize(
    ("inv_depth", "depth", "is_valid"), [(0.5, 0.5, 1), (0.81, 0.19, 0), (0.95, 0.1, 0), (3, 0.1, 0)]
)
def test_depth_limits(inv_depth: float, depth: float, is_valid: int) -> None:
    poses = torch.tensor([[[0.0, 0, 0, 0, 0, 0, 1], [0.0, 0, -1, 0, 0, 0, 1]]], dtype=torch.float64)
    camera = torch.tensor([[[100.0, 50, 40, 30]] * 2], dtype=torch.float64)
    patches = torch.zeros(1, 1, 3, 3, 3, dtype=torch.float64)
    patches[0, 0, 0], patches[0, 0, 1], patches[0, 0, 2] = 50.0, 35.0, inv_depth
    edge = torch.tensor([0]), torch.tensor([1]), torch.tensor([0])
    pixel, valid, jacobians = pops.transform(poses, patches, camera, *edge, jacobian=True)
    torch.testing.assert_close(pixel[0, 0, 1, 1], torch.tensor([40 + 10 / depth, 30 + 5 / depth], dtype=torch.float64))
    assert valid.item() == is_valid
    far = abs(1 - inv_depth) > 0.2
    assert all(bool((J != 0).any()) == far for J in jacobians)
    torch.testing.assert_close(pops.reproject_edges(poses, patches, camera, *edge), planes(pixel))


def test_flow_of_pure_rotation_and_translation() -> None:
    world = make_world(1)
    frames = world.poses.shape[1]
    turned = torch.zeros(1, frames, 6, dtype=torch.float64)
    turned[0, :, 4] = torch.arange(frames) * 0.02
    rotation = SE3.exp(turned)
    full = pops.flow_mag(rotation, *arguments(world), beta=1.0)
    start = world.patches[:, world.kk, :2].permute(0, 1, 3, 4, 2)
    moved = pops.transform(rotation, *arguments(world)) - start
    torch.testing.assert_close(full, moved.norm(dim=-1))
    assert pops.flow_mag(rotation, *arguments(world), beta=0.0).abs().max() < 1e-9
    shifted = torch.zeros(1, frames, 6, dtype=torch.float64)
    shifted[0, :, 0] = torch.arange(frames) * 0.1
    translation = SE3.exp(shifted)
    torch.testing.assert_close(
        pops.flow_mag(translation, *arguments(world), beta=0.0), pops.flow_mag(translation, *arguments(world), beta=1.0)
    )
    assert pops.flow_mag(world.poses, *arguments(world)).shape == (1, len(world.kk), 3, 3)


def test_flow_is_made_of_transforms() -> None:
    world = make_world(1, jitter_intrinsics=0.03)
    poses = SE3(world.poses)
    start = pops.transform(poses, world.patches, world.intrinsics, world.ii, world.ii, world.kk)
    full = pops.transform(poses, *arguments(world)) - start
    translational = pops.transform(poses, *arguments(world), tonly=True) - start
    expected = 0.3 * full.norm(dim=-1) + 0.7 * translational.norm(dim=-1)
    torch.testing.assert_close(pops.flow_mag(poses, *arguments(world)), expected)


def test_point_cloud_is_the_same_from_every_frame() -> None:
    """Patches moved to another frame by `transform` with their depth there are the same world points."""
    world = make_world(2)
    keep = world.jj == 3
    edges = [label[keep] for label in world.edges]
    pixels = pops.transform(world.poses, world.patches, world.intrinsics, *edges, depth=True)
    moved = torch.cat((pixels[..., :2], pixels[..., 2:] * world.patches[:, edges[2], 2][..., None]), -1)
    there = pops.point_cloud(world.poses, planes(moved), world.intrinsics, edges[1])
    here = pops.point_cloud(world.poses, world.patches[:, edges[2]], world.intrinsics, edges[0])
    torch.testing.assert_close(there[..., :3] / there[..., 3:], here[..., :3] / here[..., 3:])


# --- Jacobians and gradients ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_jacobians_equal_finite_differences(jitter: float) -> None:
    world = make_world(3, jitter_intrinsics=jitter)
    inv_depth = world.patches[0, :, 2, 1, 1]
    _, _, (Ji, Jj, Jz) = pops.transform(world.poses, *arguments(world), jacobian=True)
    step = 1e-6

    def pixels(frames: Tensor | None, tangent: int, sign: float) -> Tensor:
        """All edges with the pose of one end moved: one pose buffer, the moved poses behind the others."""
        noise = torch.zeros(1, 5, 6, dtype=torch.float64)
        noise[..., tangent] = sign * step
        buffer = torch.cat((world.poses, SE3(world.poses).retr(noise).data), 1)
        cameras = torch.cat((world.intrinsics, world.intrinsics), 1)
        ii = world.ii + 5 * (frames is world.ii)
        jj = world.jj + 5 * (frames is world.jj)
        moved = World(buffer, world.patches, cameras, ii, jj, world.kk, world.target, world.weight)
        return centre_pixels(buffer, inv_depth, moved)

    for J, frames in ((Ji, world.ii), (Jj, world.jj)):
        numeric = torch.stack([(pixels(frames, c, 1) - pixels(frames, c, -1)) / (2 * step) for c in range(6)], -1)
        torch.testing.assert_close(J[0], numeric, rtol=1e-6, atol=1e-6)
        assert J.abs().amax((0, 1, 2)).min() > 1  # no column is trivially zero
    up, down = (centre_pixels(world.poses, inv_depth + sign * step, world) for sign in (1, -1))
    torch.testing.assert_close(Jz[0, :, :, 0], (up - down) / (2 * step), rtol=1e-6, atol=1e-6)


def few(world: World, count: int) -> tuple[Tensor, Tensor, Tensor]:
    ii, jj, kk = (label[:count] for label in world.edges)
    return ii, jj, kk


@pytest.mark.parametrize("options", [{}, {"depth": True}, {"tonly": True}])
def test_gradients_of_transform(options: dict[str, bool]) -> None:
    world = make_world(4, frames=3, per_frame=2)
    edges = few(world, 8)

    def from_tangent(tangent: Tensor, patches: Tensor, intrinsics: Tensor) -> Tensor:
        return pops.transform(SE3(world.poses).retr(tangent), patches, intrinsics, *edges, **options)

    tangent = 0.05 * torch.randn(1, 3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inputs = [value.clone().requires_grad_() for value in (tangent, world.patches, world.intrinsics)]
    assert torch.autograd.gradcheck(from_tangent, inputs, fast_mode=True)


def test_gradients_of_jacobians_flow_and_cloud() -> None:
    world = make_world(4, frames=3, per_frame=2)
    edges = few(world, 6)

    def everything(tangent: Tensor, patches: Tensor) -> tuple[Tensor, ...]:
        poses = SE3(world.poses).retr(tangent)
        _, _, jacobians = pops.transform(poses, patches, world.intrinsics, *edges, jacobian=True)
        flow = pops.flow_mag(poses, patches, world.intrinsics, *edges)
        cloud = pops.point_cloud(poses, patches, world.intrinsics, torch.arange(3).repeat_interleave(2))
        return (*jacobians, flow[:, edges[0] != edges[1]], cloud)  # a flow of length 0 has no derivative

    tangent = 0.05 * torch.randn(1, 3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inputs = [tangent.requires_grad_(), world.patches.clone().requires_grad_()]
    assert torch.autograd.gradcheck(everything, inputs, fast_mode=True)


def test_gradient_of_plain_pose_tensors_is_ordinary() -> None:
    """Moving the numbers of a pose: translations follow at once, quaternion changes along q have no effect."""
    world = make_world(5)
    poses = world.poses.clone().requires_grad_()
    (grad,) = torch.autograd.grad(pops.transform(poses, *arguments(world)).square().sum(), poses)
    step = 1e-6
    for frame, column in ((1, 0), (2, 2), (3, 4), (4, 6)):
        values = []
        for sign in (1, -1):
            moved = world.poses.clone()
            moved[0, frame, column] += sign * step
            values.append(pops.transform(moved, *arguments(world)).square().sum())
        torch.testing.assert_close(grad[0, frame, column], (values[0] - values[1]) / (2 * step), rtol=1e-5, atol=1e-2)


# --- fast reprojection ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_reproject_edges_equals_transform(dtype: torch.dtype, jitter: float) -> None:
    world = make_world(6, frames=6, per_frame=12, dtype=dtype, jitter_intrinsics=jitter)
    world.patches[0, ::7, 2] = 5.0  # nearer than the limit of the projection in some frames
    expected = planes(pops.transform(SE3(world.poses), *arguments(world)))
    for poses in (world.poses, SE3(world.poses)):
        found = pops.reproject_edges(poses, *arguments(world))
        assert found.shape == (1, len(world.kk), 2, 3, 3)
        assert found.is_contiguous()
        assert found.dtype == dtype
        assert ((found - expected).abs() / (100 + expected.abs())).max() < REPROJECT_EDGES


def test_reproject_edges_records_no_gradient() -> None:
    world = make_world(6)
    assert not pops.reproject_edges(world.poses, world.patches.requires_grad_(), *arguments(world)[1:]).requires_grad


@pytest.mark.parametrize("side", [1, 5])
def test_other_patch_sizes(side: int) -> None:
    world = make_world(7)
    patches = world.patches[:, :, :, 1:2, 1:2].expand(1, 30, 3, side, side).contiguous()
    pixels = pops.transform(world.poses, patches, world.intrinsics, *world.edges)
    assert pixels.shape == (1, len(world.kk), side, side, 2)
    torch.testing.assert_close(pixels[:, :, side // 2, side // 2], world.target)
    torch.testing.assert_close(pops.reproject_edges(world.poses, patches, *arguments(world)[1:]), planes(pixels))


def test_no_edges() -> None:
    world = make_world(0)
    none = torch.zeros(0, dtype=torch.int64)
    edges = (world.patches, world.intrinsics, none, none, none)
    pixels, valid, (Ji, Jj, Jz) = pops.transform(world.poses, *edges, jacobian=True)
    assert pixels.shape == (1, 0, 3, 3, 2)
    assert valid.shape == (1, 0)
    assert Ji.shape == Jj.shape == (1, 0, 2, 6)
    assert Jz.shape == (1, 0, 2, 1)
    assert pops.flow_mag(world.poses, *edges).shape == (1, 0, 3, 3)
    assert pops.reproject_edges(world.poses, *edges).shape == (1, 0, 2, 3, 3)


def test_unbatched_poses_are_refused() -> None:
    world = make_world(0)
    with pytest.raises(InputError, match=r"expected \(1,N,7\)"):
        pops.transform(SE3(world.poses[0]), *arguments(world))


# --- graph helpers ---------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(-50, 50), max_size=30), st.sampled_from([0, 7, 10**6, 2**40]))
def test_unique_with_inverse_equals_torch(labels: list[int], spread: int) -> None:
    tensor = torch.tensor([label * max(spread, 1) for label in labels], dtype=torch.int64)
    unique, inverse = unique_with_inverse(tensor)
    expected = torch.unique(tensor, return_inverse=True)
    assert torch.equal(unique, expected[0])
    assert torch.equal(inverse, expected[1])


edge_lists = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=60)


@settings(deadline=None, max_examples=60)
@given(edge_lists, st.integers(1, 30))
def test_pairs_and_blocks_hold_every_edge_once(edges: list[tuple[int, int]], copies: int) -> None:
    edges = edges + edges[:1] * copies  # one pair with many more edges than the others
    ii, jj = (torch.tensor(column, dtype=torch.int64) for column in zip(*edges))
    pairs = frame_pairs(ii, jj)
    assert torch.equal(pairs.source[pairs.of_edge], ii)
    assert torch.equal(pairs.target[pairs.of_edge], jj)
    assert len(pairs.source) == len(set(edges))
    blocks = pair_blocks(ii, jj)
    assert sorted(blocks.edge[blocks.used].tolist()) == list(range(len(edges)))
    for frames, of_block in ((ii, blocks.source), (jj, blocks.target)):
        assert (frames[blocks.edge] == of_block[:, None])[blocks.used].all()
    assert blocks.edge.numel() <= 2 * len(edges) + len(set(edges))


def test_group_sum() -> None:
    columns = torch.arange(8.0).view(2, 4)
    sums = group_sum(columns, torch.tensor([2, 0, 2, 2]), 4)
    assert sums.tolist() == [[1, 0, 5, 0], [5, 0, 17, 0]]
