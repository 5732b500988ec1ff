"""The same results on a CUDA device as on the CPU: tracker, training step, correlation volumes, solver."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devo import fastba
from devo.altcorr import CorrBlock, corr, corr_features, patchify
from devo.config import Config
from devo.data_readers.base import TrainingClips
from devo.enet import eVONet
from devo.lietorch import SE3
from devo.result import TrackingStatus
from tests.conftest import REPOSITORY
from tests.devo.worlds import make_world
from tests.tolerances import GPU_BA, GPU_CORRELATION, GPU_TRACKER, GPU_TRAINING_GRADIENT, GPU_TRAINING_LOSS
from utils.eval_utils import track
from utils.training.settings import TrainSettings
from utils.training.simulated import sampled_clips
from utils.training.step import TrainingStep, plan_step

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


@pytest.fixture(autouse=True)
def _exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Full float32 in convolutions, too; the kernels are the torch twins unless a test says otherwise."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    monkeypatch.setenv("DEVO_KERNELS", "torch")


def clips(count: int, frames: int, height: int, width: int) -> TrainingClips:
    return sampled_clips(count, frames, height, width, generator=torch.Generator().manual_seed(4)).with_unit_depth()


def settings(mixed: bool) -> Config:
    """Those of the shipped network, with every frame accepted."""
    shipped = Config().merge_from_file(REPOSITORY / "config/tiny.yaml")
    return shipped.merge({"MIXED_PRECISION": mixed, "PROBE_FLOW": 0.0})


def error(found: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest value."""
    return float((found.detach().cpu() - expected.detach()).abs().max() / expected.detach().abs().max())


def test_correlation_agrees() -> None:
    generator = torch.Generator().manual_seed(0)
    fmap = torch.randn(1, 6, 16, 24, 32, generator=generator)
    gmap = torch.randn(1, 30, 16, 3, 3, generator=generator)
    kk, jj = torch.arange(30).repeat_interleave(3), (torch.arange(90) % 3) + 3 * (torch.arange(90) // 45)
    coords = 36 * torch.rand(1, 90, 2, 3, 3, generator=generator) - 2
    coarse = torch.nn.functional.avg_pool2d(fmap[0], 4)[None]

    def results(device: str) -> list[Tensor]:
        first, second = fmap.to(device).requires_grad_(), gmap.to(device).requires_grad_()
        edges = kk.to(device), jj.to(device)
        block = CorrBlock(first, second, clips=2, dropout=1.0)
        assert block.volumes is not None
        features = block(*edges, coords.to(device))
        single = corr(second, first, coords.to(device), *edges, 3)
        gradients = torch.autograd.grad((features**2).sum() + (single**3).sum(), (first, second))
        tracked = corr_features(second.detach(), (first.detach(), coarse.to(device)), coords.to(device), *edges)
        cut = patchify(first[0, :1].detach(), coords[..., 0, 0].to(device), 1)
        return [features, single, *gradients, tracked, cut]

    for found, expected in zip(results("cuda"), results("cpu"), strict=True):
        assert error(found, expected) <= GPU_CORRELATION


@pytest.mark.parametrize("accurate", [False, True])
def test_bundle_adjustment_agrees(accurate: bool) -> None:
    world = make_world(0)
    poses, patches = world.disturbed(0.01, 0.05, 1, 1)

    def solved(device: str) -> tuple[Tensor, Tensor]:
        state = poses.clone().to(device), patches.clone().to(device)
        measured = (world.intrinsics.to(device), world.target.to(device), world.weight.to(device))
        edges = [index.to(device) for index in world.edges]
        result = fastba.BA(state[0], state[1], *measured, 1e-4, *edges, 1, 5, 2, accurate=accurate)
        assert result.success
        return state

    for found, expected in zip(solved("cuda"), solved("cpu"), strict=True):
        assert error(found, expected) <= GPU_BA


def training_losses(device: str, batch: TrainingClips, unroll: bool) -> tuple[dict[str, float], dict[str, Tensor]]:
    chosen = TrainSettings.from_preset(
        "tiny", clips=2, frames=5, initial_frames=4, updates=3, patches=12, unroll_every=1 if unroll else 2,
        match_gradient_every=1,
    )  # fmt: skip
    torch.manual_seed(0)
    network = eVONet(**chosen.network_arguments()).to(device).train()
    plan = plan_step(chosen, 0 if unroll else 1, torch.Generator().manual_seed(1))
    torch.manual_seed(2)
    losses = TrainingStep(network, chosen)(batch.to(device), plan)
    losses["total"].backward()
    gradients = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
    return {name: float(value.detach()) for name, value in losses.items()}, gradients


@pytest.mark.parametrize("unroll", [False, True])
def test_training_step_agrees(unroll: bool) -> None:
    batch = clips(2, 5, 96, 112)
    losses, gradients = training_losses("cuda", batch, unroll)
    expected_losses, expected = training_losses("cpu", batch, unroll)
    assert set(gradients) == set(expected)
    for name, value in expected_losses.items():
        assert losses[name] == pytest.approx(value, rel=GPU_TRAINING_LOSS, abs=1e-4), name
    found = torch.cat([gradients[name].cpu().flatten() for name in expected])
    wanted = torch.cat([expected[name].flatten() for name in expected])
    assert float((found - wanted).norm() / wanted.norm()) <= GPU_TRAINING_GRADIENT


def test_tracker_agrees() -> None:
    made = clips(1, 12, 120, 160)
    frames = [(made.voxels[0, i], made.intrinsics[0, i], 1e4 * i) for i in range(12)]
    cfg = settings(mixed=False)

    def positions(device: str) -> tuple[TrackingStatus, Tensor]:
        result = track(frames, cfg, "devo-tiny", seed=1, device=device)
        return result.status, torch.from_numpy(result.poses)

    (status, found), (expected_status, expected) = positions("cuda"), positions("cpu")
    assert status == expected_status == TrackingStatus.TRACKED
    turn = (SE3(found.double()).inv() * SE3(expected.double())).log()
    scale = expected[:, :3].norm(dim=1).max()
    assert float(turn[:, 3:].norm(dim=1).max()) <= GPU_TRACKER
    assert float((found - expected)[:, :3].norm(dim=1).max() / scale) <= GPU_TRACKER


def test_half_precision_runs_and_stays_near() -> None:
    made = clips(1, 10, 120, 160)
    frames = [(made.voxels[0, i], made.intrinsics[0, i], 1e4 * i) for i in range(10)]
    results = []
    for mixed in (False, True):
        results.append(track(frames, settings(mixed), "devo-tiny", seed=1, device="cuda"))
    assert results[0].status == results[1].status
    assert torch.isfinite(torch.from_numpy(results[1].poses)).all()
