"""Figures of merit of a network on a fixed set of clips."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devo.data_readers.base import TrainingClips
from devo.enet import eVONet
from devo.lietorch import SE3
from devo.losses import alignment_scale, flow_errors, pose_errors
from devo.unroll import UnrollResult, UnrollStep, unroll_clips
from devo.unroll_matching import MatchUpdate
from devo.unroll_state import UnrollSettings
from utils.training.step import last_score_loss

MATCH_UPDATES = 3


@dataclass(frozen=True)
class ValidationSettings:
    """Protocol: identity start, random depths, patches as in training, `updates` updates, seed for all choices."""

    updates: int = 12
    patches: int = 32
    initial_frames: int = 8
    batch: int = 2
    seed: int = 12345


@torch.no_grad()
def validate(
    network: eVONet, clips: TrainingClips, settings: ValidationSettings = ValidationSettings()
) -> dict[str, float]:  # noqa: B008
    """Evaluate; the random state outside is left as it was.

    Returns:
        flow: median error after bundle adjustment over edges of neighbouring frames, quarter-resolution pixels.
        start: median true displacement before the first update. first, last: median error of the revised centres in the
        first and last update. probe: median error of single edges from a zero state, probe_ratio: median predicted over
        median true displacement there. match: median error after three updates of edges that start off the truth, each
        in its own way. rotation: median degrees. ate: median over clips of the position error (rms)
        over the path length. score: scorer loss. confidence: mean weight.
    """
    was_training = network.training
    device = next(network.parameters()).device
    gathered: dict[str, list[Tensor]] = {}
    with torch.random.fork_rng(devices=[] if device.type == "cpu" else [device]):
        torch.manual_seed(settings.seed)
        network.train()  # patches are drawn as in training: the scores of the candidates are reported
        try:
            for first in range(0, len(clips.voxels), settings.batch):
                part = clips.clips(torch.arange(first, min(first + settings.batch, len(clips.voxels)))).to(device)
                for name, value in _figures(network, part, settings).items():
                    gathered.setdefault(name, []).append(value.reshape(-1).float().cpu())
        finally:
            network.train(was_training)
    joined = {name: torch.cat(values) for name, values in gathered.items()}
    medians = ("flow", "start", "first", "last", "probe", "match", "rotation", "ate")
    result = {name: float(joined[name].median()) for name in medians}
    result["flow90"] = float(joined["flow"][:: max(1, len(joined["flow"]) // 1000000)].quantile(0.9))
    result["lost"] = float((joined["ate"] > 0.3).float().mean())
    result["probe_ratio"] = float(joined["probe_length"].median() / joined["probe_true"].median().clamp(min=1e-6))
    result["score"], result["confidence"] = float(joined["score"].mean()), float(joined["confidence"].mean())
    return result


def _figures(network: eVONet, clips: TrainingClips, settings: ValidationSettings) -> dict[str, Tensor]:
    unrolled = unroll_clips(
        network,
        network.normalize(clips.voxels),
        SE3(clips.world_T_cam).inv(),
        clips.inv_depths,
        clips.intrinsics,
        UnrollSettings(
            steps=settings.updates,
            patches_per_image=settings.patches,
            drop_probability=0.0,
            flat_depth=1.0,
            probe=True,
            match_updates=MATCH_UPDATES,
            initial_frames=settings.initial_frames,
        ),
    )
    first, last = unrolled.steps[0], unrolled.steps[-1]
    probe, match = unrolled.probe, unrolled.matches[-1]
    assert probe is not None and last.coords is not None and last.poses is not None
    score = last_score_loss(last)
    figures = {
        "flow": flow_errors(last.coords, last.coords_gt)[last.valid.bool()],
        "start": first.start_error[first.predicted_valid],
        "first": _revision_errors(first),
        "last": _revision_errors(last),
        "probe": _revision_errors(probe),
        "match": _revision_errors(match),
        "probe_length": (probe.predicted - probe.centre).norm(dim=-1)[probe.predicted_valid],
        "probe_true": (probe.predicted_gt - probe.centre).norm(dim=-1)[probe.predicted_valid],
        "confidence": last.weight[last.predicted_valid],
        "score": torch.zeros(1) if score is None else score,
    }
    figures["rotation"], figures["ate"] = _trajectory_errors(unrolled)
    return figures


def _revision_errors(update: UnrollStep | MatchUpdate) -> Tensor:
    """Errors of the revised centres of an update, edges that can be judged only [quarter-resolution px]."""
    return (update.predicted - update.predicted_gt).norm(dim=-1)[update.predicted_valid]


def _trajectory_errors(unrolled: UnrollResult) -> tuple[Tensor, Tensor]:
    """Rotation errors of frame pairs in degrees, and rms position error over path length of each clip."""
    poses = unrolled.steps[-1].poses
    assert poses is not None
    truth = unrolled.poses_gt[:, : poses.shape[1]]
    _, rotation = pose_errors(poses.data, truth.data)
    centres, centres_gt = poses.inv().data[..., :3], truth.inv().data[..., :3]
    scale = alignment_scale(centres_gt, centres, limit=1e6)[:, None, None]
    error = (scale * (centres - centres[:, :1]) - (centres_gt - centres_gt[:, :1])).square().sum(-1).mean(-1).sqrt()
    length = (centres_gt[:, 1:] - centres_gt[:, :-1]).norm(dim=-1).sum(-1)
    return torch.rad2deg(rotation), error / length.clamp(min=1e-9)
