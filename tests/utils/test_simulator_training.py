"""Random training clips: reproducible, of the promised motion, with ground truth that explains the pictures."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from utils.simulator.layouts import LAYOUTS
from utils.simulator.motion import KINDS
from utils.simulator.renderer import Rays, Renderer, pinhole_rays
from utils.simulator.textures import build_atlas, value_noise
from utils.simulator.training import ClipBatch, ClipSettings, clip_times, plan_clip, sample_clips
from utils.simulator.trajectory import compose, invert, quaternion_to_matrix

SMALL = ClipSettings(tile=64, bank_size=8)


def draw(count: int, seed: int = 0, settings: ClipSettings = SMALL, frames: int = 4) -> ClipBatch:
    return sample_clips(count, frames, 48, 64, generator=torch.Generator().manual_seed(seed), settings=settings)


@pytest.fixture(scope="module")
def clips() -> ClipBatch:
    return draw(4)


def test_shapes_and_contents(clips: ClipBatch) -> None:
    assert clips.voxels.shape == (4, 4, 5, 48, 64)
    assert clips.world_T_cam.shape == (4, 4, 7)
    assert clips.inv_depths.shape == (4, 4, 48, 64)
    assert clips.intrinsics.shape == (4, 4, 4)
    for tensor in (clips.voxels, clips.world_T_cam, clips.inv_depths, clips.intrinsics):
        assert tensor.dtype == torch.float32
        assert tensor.isfinite().all()
    assert (clips.voxels != 0).float().mean((1, 2, 3, 4)).min() > 0.005
    assert (clips.inv_depths > 0).float().mean() > 0.99
    torch.testing.assert_close(clips.world_T_cam[:, 0], torch.tensor([[0.0, 0, 0, 0, 0, 0, 1]]).expand(4, -1))
    torch.testing.assert_close(clips.world_T_cam[..., 3:].norm(dim=-1), torch.ones(4, 4))


def test_inverse_depths_are_normalised(clips: ClipBatch) -> None:
    for inverse in clips.inv_depths:
        assert np.quantile(inverse.numpy(), 0.98) == pytest.approx(1 / 0.7, rel=0.05)


def test_same_generator_same_clips_whatever_the_batches(clips: ClipBatch) -> None:
    again = draw(4)
    assert again.voxels.numpy().tobytes() == clips.voxels.numpy().tobytes()
    assert again.inv_depths.numpy().tobytes() == clips.inv_depths.numpy().tobytes()
    assert again.world_T_cam.numpy().tobytes() == clips.world_T_cam.numpy().tobytes()
    generator = torch.Generator().manual_seed(0)
    single = [sample_clips(1, 4, 48, 64, generator=generator, settings=SMALL) for _ in range(2)]
    assert torch.equal(torch.cat([one.voxels for one in single]), clips.voxels[:2])
    assert not torch.equal(draw(1, seed=1).voxels, clips.voxels[:1])


def test_ground_truth_explains_the_pictures() -> None:
    """A surface point looks the same from both poses when the second one looks at where poses and depth put it."""
    generator = torch.Generator().manual_seed(4)
    settings = dataclasses.replace(SMALL, mean_flow_px=(3.0, 5.0))
    ratios, rng = [], np.random.default_rng(0)
    for _ in range(8):
        plan = plan_clip(4, 48, 64, generator, settings)
        rays = pinhole_rays(plan.intrinsics, 48, 64)
        poses = plan.motion.spline.poses(torch.tensor([0.5, 2.5], dtype=torch.float64))
        # smooth textures, because the blur of distant texels depends on the distance
        tiles = [2 * value_noise(64, rng, coarsest=3, octaves=1) for _ in plan.tiles]
        atlas = build_atlas(torch.from_numpy(np.stack(tiles)))
        light, inverse = Renderer(plan.planes, atlas, rays).render(poses)
        relative = compose(invert(poses[1:]), poses[:1])
        x, y = torch.broadcast_tensors(rays.x, rays.y)
        moved = torch.stack([x, y, torch.ones_like(x)], -1) @ quaternion_to_matrix(relative[0, 3:]).T
        moved = moved + inverse[0][..., None] * relative[0, :3]
        towards = Rays(moved[..., 0] / moved[..., 2], moved[..., 1] / moved[..., 2], rays.focal)
        again, depth = (image[0] for image in Renderer(plan.planes, atlas, towards).render(poses[1:]))
        expected = inverse[0] / moved[..., 2]
        seen = (depth - expected).abs() < 1e-3 * expected
        assert seen.float().mean() > 0.8, "the rest is hidden by something nearer"
        ratios.append(float((again - light[0])[seen].abs().mean() / (light[1] - light[0])[seen].abs().mean()))
    assert max(ratios) < 0.05, ratios


@pytest.mark.parametrize("kind", KINDS)
def test_motion_has_the_requested_amount(kind: str) -> None:
    settings = dataclasses.replace(SMALL, motions=((kind, 1.0),))
    generator = torch.Generator().manual_seed(8)
    for _ in range(6):
        plan = plan_clip(6, 48, 64, generator, settings)
        assert 0.02 < plan.motion.mean_flow_px < 1.2 * settings.mean_flow_px[1]
        assert all(count % 4 == 0 for count in plan.steps)
        positions = plan.motion.spline.poses(torch.linspace(0, 6, 61, dtype=torch.float64))
        assert plan.planes.distance_to_surface(positions[None, :, :3]).min() > 0.05
    fixed = dataclasses.replace(settings, mean_flow_px=(2.0, 2.0))
    flows = [plan_clip(6, 48, 64, generator, fixed).motion.mean_flow_px for _ in range(6)]
    # motion that causes parallax only needs so much room that it is often cut short before a surface
    assert np.median(flows) == pytest.approx(2.0, rel=0.3 if kind == "orbit" else 0.1)
    assert max(flows) < 2.3


def test_renderings_move_less_than_the_limit() -> None:
    generator = torch.Generator().manual_seed(2)
    settings = dataclasses.replace(SMALL, mean_flow_px=(4.0, 4.0), motions=(("rotate", 1.0),))
    plan = plan_clip(4, 48, 64, generator, settings)
    rays = pinhole_rays(plan.intrinsics, 48, 64)
    poses = plan.motion.spline.poses(clip_times(plan.steps))
    forward = torch.tensor([0.0, 0, 1])
    axes = torch.stack([quaternion_to_matrix(pose[3:]) @ forward for pose in poses])
    turned = torch.acos((axes[1:] * axes[:-1]).sum(-1).clamp(-1, 1))
    assert float(turned.max()) * rays.focal < 1.0
    assert len(poses) == sum(plan.steps) + 1


def test_all_layouts_and_motions_occur() -> None:
    generator = torch.Generator().manual_seed(0)
    plans = [plan_clip(2, 16, 16, generator, SMALL) for _ in range(40)]
    assert {plan.scene for plan in plans} == set(LAYOUTS)
    assert {plan.motion.kind for plan in plans} == set(KINDS)
    thresholds = [plan.pixels.threshold for plan in plans]
    assert 0.16 <= min(thresholds) < 0.2
    assert 0.28 < max(thresholds) <= 0.34


def test_other_bank_other_textures() -> None:
    changed = draw(1, settings=dataclasses.replace(SMALL, bank_seed=1))
    same = draw(1)
    assert torch.equal(changed.inv_depths, same.inv_depths), "geometry does not depend on the bank"
    assert not torch.equal(changed.voxels, same.voxels)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_clips_on_a_gpu_agree_with_the_cpu(clips: ClipBatch) -> None:
    on_gpu = sample_clips(4, 4, 48, 64, generator=torch.Generator().manual_seed(0), settings=SMALL, device="cuda")
    torch.testing.assert_close(on_gpu.inv_depths.cpu(), clips.inv_depths, atol=1e-4, rtol=1e-4)
    difference = (on_gpu.voxels.cpu() - clips.voxels).abs().sum() / clips.voxels.abs().sum()
    assert difference < 0.01, "rounding may move a few events by a threshold"
