"""One training step: unroll the network over a batch of clips and add up the losses."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from devo.data_readers.base import TrainingClips
from devo.enet import eVONet
from devo.errors import InputError
from devo.extractor import channels_last_frames
from devo.lietorch import SE3
from devo.losses import (
    confidence_loss,
    direct_loss,
    fine_loss,
    flow_errors,
    flow_loss,
    masked_mean,
    peak_loss,
    pose_loss,
    same_direction,
    score_loss,
    structure_loss,
)
from devo.selector import event_gradient
from devo.unroll import UnrollResult, UnrollStep, prepare_images, unroll_clips
from devo.unroll_matching import MatchUpdate
from devo.unroll_state import UnrollSettings
from utils.training.settings import LossSettings, TrainSettings

PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16, "float16": torch.float16}


@dataclass(frozen=True)
class StepPlan:
    """What is drawn at random for one step.

    Attributes:
        structure_only: poses stay at the truth.
        start_fraction: (B,) where each clip's poses start between identity (0) and truth (1).
        published_weight: factor of the flow and pose losses, 0..1.
        train_scorer: the scorer gets its loss in this step.
        unroll: this step runs the loop with bundle adjustment.
    """

    structure_only: bool
    start_fraction: Tensor
    published_weight: float
    train_scorer: bool
    unroll: bool = True


def plan_step(settings: TrainSettings, step: int, generator: torch.Generator) -> StepPlan:
    """Draw the start mode of a step."""
    structure_only = float(torch.rand((), generator=generator)) < settings.structure_only
    perturbed = torch.rand(settings.clips, generator=generator) < settings.perturbed
    fraction = torch.rand(settings.clips, generator=generator) * perturbed
    ramp = settings.loss.published_from
    weight = 1.0 if ramp <= 0 else min(1.0, max(0.0, (step - ramp) / ramp))
    train_scorer = settings.only == "scorer" or step % settings.score_every == 0
    return StepPlan(structure_only, fraction, weight, train_scorer, step % settings.unroll_every == 0)


class TrainingStep(nn.Module):
    """Network and losses as one module, so that distributed training can wrap it."""

    def __init__(self, network: eVONet, settings: TrainSettings) -> None:
        super().__init__()
        self.network = network
        self.settings = settings

    def unroll_settings(self, plan: StepPlan) -> UnrollSettings:
        """The graph schedule of a training step."""
        wanted = self.settings
        return UnrollSettings(
            steps=wanted.updates if plan.unroll else 0,
            patches_per_image=wanted.patches,
            structure_only=plan.structure_only,
            initial_frames=wanted.initial_frames,
            solver_gradient_every=wanted.solver_gradient_every,
            match_gradient_every=wanted.match_gradient_every,
            flat_depth=wanted.flat_depth,
            probe=wanted.loss.probe > 0,
            match_updates=wanted.match_updates if wanted.loss.match > 0 else 0,
            depth_noise=wanted.depth_noise,
            mixed_precision=PRECISIONS[wanted.precision],
        )

    def forward(self, clips: TrainingClips, plan: StepPlan) -> dict[str, Tensor]:
        """Total loss (key `total`) and its parts (without gradient) for a batch on the network's device."""
        images = prepare_images(self.network, clips.voxels)
        if self.settings.only == "scorer":
            return self._scorer_loss(images)
        poses = SE3(clips.world_T_cam).inv()
        result = unroll_clips(
            self.network,
            images,
            poses,
            clips.inv_depths,
            clips.intrinsics,
            self.unroll_settings(plan),
            plan.start_fraction.to(images.device),
        )
        return total_loss(result, self.settings.loss, plan)

    def _scorer_loss(self, images: Tensor) -> dict[str, Tensor]:
        """How well the scorer finds the structure of the frames."""
        scorer = getattr(self.network.patchify, "scorer", None)
        if scorer is None:
            raise InputError("this network has no scorer to train")
        frames = channels_last_frames(images)
        loss, correlation = structure_loss(scorer.rate(frames), event_gradient(frames))
        return {"total": loss, "scores": loss.detach(), "score_correlation": correlation}


def total_loss(result: UnrollResult, weights: LossSettings, plan: StepPlan) -> dict[str, Tensor]:
    """Weighted sum of all losses of an unrolled batch, see `LossSettings`; parts are means over the updates."""
    parts: dict[str, list[Tensor]] = defaultdict(list)
    total = result.poses_gt.data.new_zeros(())
    for number, step in enumerate(result.steps):
        first = weights.direct_first if number == 0 else 1.0
        total = total + _revision_loss(step, weights, parts, first)
        total = total + _solution_loss(step, number, result, weights, plan, parts)
    for match in result.matches:
        matched: dict[str, list[Tensor]] = defaultdict(list)
        share = weights.match / len(result.matches)
        total = total + share * _revision_loss(match, weights, matched)
        parts["match"] += matched["direct"]
        peak = peak_loss(match.correlation, match.centre, match.predicted_gt, match.predicted_valid)
        parts["peak"].append(peak)
        total = total + weights.peak / len(result.matches) * peak
    if result.probe is not None and weights.probe > 0:
        probe = direct_loss(result.probe.predicted, result.probe.predicted_gt, result.probe.predicted_valid)
        total = total + weights.probe * probe
        parts["probe"] = [probe]
    scores = last_score_loss(result.steps[-1]) if result.steps else None
    if scores is not None and plan.train_scorer:
        total = total + weights.scores * scores
        parts["scores"] = [scores]
    report = {name: torch.stack(values).detach().mean() for name, values in parts.items() if values}
    if result.steps:
        start = result.steps[0]
        report["start"] = masked_mean(start.start_error.clamp(max=20.0), start.predicted_valid)
        report["direct_first"] = parts["direct"][0].detach()
        report["direct_last"] = parts["direct"][-1].detach()
    if parts["flow"]:
        report["flow_last"] = parts["flow"][-1].detach()
    return {"total": total, **report}


def _revision_loss(
    step: UnrollStep | MatchUpdate, weights: LossSettings, parts: dict[str, list[Tensor]], direct_factor: float = 1.0
) -> Tensor:
    """Losses of one update before bundle adjustment; notes them in `parts`."""
    seen = step.predicted, step.predicted_gt, step.predicted_valid
    total = step.predicted.new_zeros(())
    for name, weight, loss in (
        ("direct", weights.direct * direct_factor, direct_loss(*seen)),
        ("fine", weights.fine, fine_loss(*seen)),
        ("confidence", weights.confidence, confidence_loss(step.weight, *seen)),
    ):
        total = total + weight * loss
        parts[name].append(loss)
    return total


def _solution_loss(
    step: UnrollStep,
    number: int,
    result: UnrollResult,
    weights: LossSettings,
    plan: StepPlan,
    parts: dict[str, list[Tensor]],
) -> Tensor:
    """Published losses of update `number`, after bundle adjustment; notes them in `parts`."""
    total = step.predicted.new_zeros(())
    if step.coords is None or plan.published_weight == 0:
        return total
    flow = flow_loss(step.coords, step.coords_gt, step.valid)
    parts["flow"].append(flow)
    total = total + plan.published_weight * weights.flow * flow
    if number >= 2 and not plan.structure_only and step.poses is not None:
        frames = step.poses.shape[1]
        pair = step.poses.data, result.poses_gt.data[:, :frames]
        pose = pose_loss(*pair, used=same_direction(*pair))[0]
        parts["pose"].append(pose)
        total = total + plan.published_weight * weights.pose * pose
    return total


def last_score_loss(step: UnrollStep) -> Tensor | None:
    """Scorer loss of the last update; None where the network has no scorer or it was not run with gradient."""
    if step.scores is None or not step.scores.requires_grad and torch.is_grad_enabled():
        return None
    if step.coords_full is None or step.coords_gt_full is None or step.weight_full is None:
        return None
    assert step.valid_full is not None and step.kk_full is not None
    errors = flow_errors(step.coords_full, step.coords_gt_full)
    return score_loss(step.scores, errors, step.weight_full, step.valid_full, step.kk_full)


__all__ = ["PRECISIONS", "StepPlan", "TrainingStep", "masked_mean", "plan_step", "total_loss"]
