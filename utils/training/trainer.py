"""The training loop: steps, validation, checkpoints, exact resume."""

from __future__ import annotations

import logging
import math
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from devo.checkpoint import read_checkpoint, save_checkpoint
from devo.data_readers.base import ClipSource, TrainingClips
from devo.enet import eVONet
from devo.errors import CheckpointError, DevoError
from utils.training.augment import generator_for
from utils.training.log import TrainingLog, draw_curves
from utils.training.optimiser import (
    AveragedWeights,
    gradient_norm,
    learning_rate,
    random_state,
    restore_random_state,
    seed_everything,
)
from utils.training.settings import TrainSettings
from utils.training.step import TrainingStep, plan_step
from utils.training.validate import ValidationSettings, validate

logger = logging.getLogger(__name__)

LOG_NAMES = (
    "total",
    "start",
    "direct",
    "direct_first",
    "direct_last",
    "probe",
    "match",
    "peak",
    "flow",
    "flow_last",
    "pose",
    "scores",
    "score_correlation",
    "fine",
    "confidence",
)
FAILED_IN_A_ROW = 50


@dataclass(frozen=True)
class RunSettings:
    """What does not change the result of a step: folders, intervals, limits."""

    folder: Path
    log_every: int = 20
    save_every: int = 200
    validate_every: int = 200
    minutes: float | None = None
    stop_after: int | None = None


class Trainer:
    """Trains one network in one process (one of several under torchrun).

    Args:
        network: with the dimensions of `settings`, on the device to use.
        settings: of the training.
        run: folders and intervals.
        source: batches.
        validation: fixed clips, or None.
        report: called with one line of text per event.
        rank, world: of this process; only rank 0 writes files.
    """

    def __init__(
        self,
        network: eVONet,
        settings: TrainSettings,
        run: RunSettings,
        source: ClipSource,
        validation: TrainingClips | None = None,
        report: Callable[[str], None] = logger.info,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        self.network, self.settings, self.run, self.source = network, settings, run, source
        self.validation, self.report, self.rank, self.world = validation, report, rank, world
        self.device = next(network.parameters()).device
        for part in ("inet", "scorer"):  # without instance norm, channels-last convolutions are twice as fast
            getattr(network.patchify, part).to(memory_format=torch.channels_last)
        if settings.only == "scorer":
            network.requires_grad_(False)
            network.patchify.scorer.requires_grad_(True)
        self.module: nn.Module = TrainingStep(network, settings)
        if world > 1:
            devices = [self.device.index] if self.device.type == "cuda" else None
            self.module = nn.parallel.DistributedDataParallel(self.module, devices, find_unused_parameters=True)
        self.optimiser = torch.optim.AdamW(
            network.parameters(),
            lr=settings.learning_rate,
            weight_decay=settings.weight_decay,
            betas=(0.9, 0.999),
            eps=1e-8,
            fused=self.device.type in ("cpu", "cuda"),
        )
        self.average = AveragedWeights(network, settings.ema)
        self.scaler = torch.amp.GradScaler(
            "cuda", enabled=settings.precision == "float16" and self.device.type == "cuda"
        )
        self.step = 0
        self.skipped = 0
        self.best = math.inf
        self.trained_seconds = 0.0
        seed_everything(settings.seed * 1000 + rank)

    # --- one step -----------------------------------------------------------------------------------------------

    def train_step(self) -> dict[str, float]:
        """Run step `self.step`; a loss or gradient that is not finite skips the update and is counted."""
        settings = self.settings
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(settings, self.step)
        index = self.step * self.world + self.rank
        clips = self.source.batch(index).to(self.device)
        plan = plan_step(settings, self.step, generator_for(settings.seed, 3, index))
        self.network.train()
        self.network.patchify.scorer.requires_grad_(plan.train_scorer)
        losses = self.module(clips, plan)
        self.optimiser.zero_grad(set_to_none=True)
        self.scaler.scale(losses["total"]).backward()
        self.scaler.unscale_(self.optimiser)
        norm = gradient_norm(list(self.network.parameters()))
        finite = bool(torch.isfinite(norm) & torch.isfinite(losses["total"].detach()))
        if finite:
            nn.utils.clip_grad_norm_(self.network.parameters(), settings.clip_gradient)
            self.scaler.step(self.optimiser)
            self.average.update(self.network)
        else:
            self.skipped += 1
        self.scaler.update()
        self.step += 1
        values = {name: float(value.detach()) for name, value in losses.items()}
        return {**values, "norm": float(norm), "finite": float(finite)}

    # --- the loop -----------------------------------------------------------------------------------------------

    def train(self) -> str:
        """Train until all steps are done or the time is up; returns which of the two, saves `last.pth`.

        Raises:
            DevoError: many steps in a row gave no finite loss.
        """
        run, settings = self.run, self.settings
        curves = TrainingLog(run.folder / "train.csv") if self.rank == 0 else None
        started = time.monotonic()
        sums: dict[str, list[float]] = defaultdict(list)
        clock, failed = started, 0
        final = min(settings.steps, run.stop_after) if run.stop_after is not None else settings.steps
        reason = "all steps done"
        while self.step < final:
            if run.minutes is not None and self._agreed(time.monotonic() - started > 60 * run.minutes):
                reason = f"time limit of {run.minutes:g} minutes reached"
                break
            values = self.train_step()
            failed = 0 if values["finite"] else failed + 1
            if failed >= FAILED_IN_A_ROW:
                raise DevoError(
                    f"{failed} steps in a row gave no finite loss; lower --lr or --clip, the state before is in "
                    f"{run.folder / 'last.pth'}"
                )
            if values["finite"]:
                for name, value in values.items():
                    sums[name].append(value)
            if curves is not None and self.step % run.log_every == 0:
                now = time.monotonic()
                rate = run.log_every * settings.clips * self.world / (now - clock)
                self._log(curves, sums, rate)
                sums.clear()
                clock = now
            if self.step % run.validate_every == 0:
                self.validate_and_keep()
                clock = time.monotonic()
            if self.step % run.save_every == 0:
                self.save(run.folder / "last.pth", time.monotonic() - started)
        self.save(run.folder / "last.pth", time.monotonic() - started)
        self.trained_seconds += time.monotonic() - started
        return reason

    def _agreed(self, stop: bool) -> bool:
        """What the first process wants, in all processes: none may leave while others still wait for its gradients."""
        if self.world == 1:
            return stop
        flag = torch.tensor([float(stop)], device=self.device)
        torch.distributed.broadcast(flag, 0)
        return bool(flag.item())

    def _log(self, curves: TrainingLog, sums: dict[str, list[float]], rate: float) -> None:
        means = {
            name: (math.fsum(sums[name]) / len(sums[name]) if sums.get(name) else math.nan)
            for name in (*LOG_NAMES, "norm")
        }
        waited = float(getattr(self.source, "waited_seconds", 0.0))
        curves.append(
            {
                "step": self.step,
                "lr": learning_rate(self.settings, self.step - 1),
                **means,
                "clips_per_s": rate,
                "waited_s": waited,
                "skipped": self.skipped,
            }
        )
        shown = " ".join(f"{name} {means[name]:.3f}" for name in LOG_NAMES if not math.isnan(means[name]))
        self.report(
            f"step {self.step} {shown} norm {means['norm']:.2f} {rate:.2f} clips/s waited {waited:.0f} s "
            f"skipped {self.skipped}"
        )

    def validate_and_keep(self) -> dict[str, float] | None:
        """Validate the averaged weights; write `best.pth` where the figure of merit improved. Rank 0 only."""
        if self.validation is None or self.rank != 0:
            return None
        current = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.network.load_state_dict(self.average.values)
        try:
            figures = validate(
                self.network, self.validation, ValidationSettings(patches=max(24, self.settings.patches))
            )
            TrainingLog(self.run.folder / "validation.csv").append({"step": self.step, **figures})
            merit = figure_of_merit(figures)
            better = merit < self.best or bool(self.settings.only)  # merit says little about a part, the newest is best
            if better:
                self.best = merit
                save_checkpoint(
                    self.run.folder / "best.pth",
                    self.network,
                    steps=self.step,
                    validation=figures,
                    settings=self.settings.as_dict(),
                )
        finally:
            self.network.load_state_dict(current)
        shown = " ".join(f"{name} {value:.3f}" for name, value in figures.items())
        self.report(f"step {self.step} VALIDATION {'best ' if better else ''}merit {merit:.4f} {shown}")
        draw_curves(self.run.folder / "train.csv", self.run.folder / "validation.csv", self.run.folder / "curves.png")
        return figures

    # --- checkpoints --------------------------------------------------------------------------------------------

    def save(self, path: Path, seconds: float = 0.0) -> None:
        """Write everything needed to go on exactly from here."""
        if self.rank != 0:
            return
        save_checkpoint(
            path,
            self.network,
            steps=self.step,
            optimizer_state_dict=self.optimiser.state_dict(),
            scheduler_state_dict={"last_epoch": self.step},
            scaler_state_dict=self.scaler.state_dict(),
            average=self.average.state_dict(),
            random=random_state(),
            best=self.best,
            skipped=self.skipped,
            seconds=self.trained_seconds + seconds,
            settings=self.settings.as_dict(),
        )

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint written by `save`.

        Raises:
            CheckpointError: not such a checkpoint, or of a network with other dimensions.
        """
        state = training_state(path)
        missing = {"model_state_dict", "optimizer_state_dict", "average", "random", "steps"} - set(state)
        if missing:
            raise CheckpointError(
                f"{path} cannot be resumed, it lacks {sorted(missing)[0]!r}; use --init to start from its weights"
            )
        check_dimensions(path, state, self.settings)
        self.network.load_state_dict(state["model_state_dict"])
        self.optimiser.load_state_dict(state["optimizer_state_dict"])
        self.average.load_state_dict(state["average"])
        if state.get("scaler_state_dict"):
            self.scaler.load_state_dict(state["scaler_state_dict"])
        self.step, self.best, self.skipped = int(state["steps"]), float(state["best"]), int(state["skipped"])
        self.trained_seconds = float(state.get("seconds", 0.0))
        restore_random_state(state["random"])


def training_state(path: str | Path) -> dict[str, Any]:
    """Content of a training checkpoint.

    Raises:
        CheckpointError: unreadable, or without `model_state_dict`.
    """
    state = read_checkpoint(path)
    if not isinstance(state, dict) or "model_state_dict" not in state:
        raise CheckpointError(f"{path} is no training checkpoint: it lacks 'model_state_dict'")
    return state


def figure_of_merit(figures: dict[str, float]) -> float:
    """One number to compare networks by, smaller is better.

    Median flow errors (after bundle adjustment; last, first, stand-alone update) and rotation; positions count little,
    because a few clips that end in the mirrored solution dominate them.
    """
    weights = {"flow": 1.0, "last": 1.0, "first": 0.3, "probe": 0.3, "rotation": 0.05, "ate": 0.3}
    parts = [weight * figures[name] for name, weight in weights.items()]
    return sum(parts) if all(math.isfinite(part) for part in parts) else math.inf


def check_dimensions(path: Path, state: dict[str, Any], settings: TrainSettings) -> None:
    """Compare the tensors of a checkpoint with the network of `settings`.

    Raises:
        CheckpointError: names the first tensor that differs.
    """
    with torch.device("meta"):
        wanted = {
            name: tuple(value.shape) for name, value in eVONet(**settings.network_arguments()).state_dict().items()
        }
    found = {name: tuple(value.shape) for name, value in state["model_state_dict"].items()}
    if found == wanted:
        return
    name = sorted(key for key in set(found) | set(wanted) if found.get(key) != wanted.get(key))[0]
    raise CheckpointError(
        f"{path} holds a network of other dimensions: {name} is {found.get(name, 'absent')}, this run "
        f"expects {wanted.get(name, 'no such tensor')}; choose the matching --preset"
    )
