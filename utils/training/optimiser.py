"""Learning rate, averaged weights and the state of everything random."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from devo.errors import InputError
from utils.training.settings import TrainSettings

SCHEDULES = ("cosine", "onecycle", "constant")


def learning_rate(settings: TrainSettings, step: int) -> float:
    """Rate at a step: warm-up, then `cosine` to `final_rate` of the peak, `onecycle` (linear to 0) or `constant`.

    Raises:
        InputError: unknown schedule.
    """
    if settings.schedule not in SCHEDULES:
        raise InputError(f"unknown schedule {settings.schedule!r}; expected one of {', '.join(SCHEDULES)}")
    if step < settings.warmup:
        return settings.learning_rate * (1 / 25 + (1 - 1 / 25) * step / settings.warmup)
    if settings.schedule == "constant":
        return settings.learning_rate
    progress = min(1.0, (step - settings.warmup) / max(1, settings.steps - settings.warmup))
    if settings.schedule == "onecycle":
        return settings.learning_rate * (1 - progress)
    low = settings.final_rate
    return settings.learning_rate * (low + (1 - low) * 0.5 * (1 + math.cos(math.pi * progress)))


class AveragedWeights:
    """Exponential moving average of a network's parameters; short runs average over fewer steps."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self.values = {name: value.detach().clone() for name, value in network.state_dict().items()}

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Move towards the current parameters."""
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        self.updates += 1
        for name, value in network.state_dict().items():
            self.values[name].lerp_(value, 1 - decay)

    def state_dict(self) -> dict[str, Any]:
        """Averages and counter."""
        return {"updates": self.updates, "values": self.values}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.updates = int(state["updates"])
        self.values = {name: value.clone() for name, value in state["values"].items()}


def random_state() -> dict[str, Any]:
    """State of the generators of torch, NumPy and Python, as tensors and plain numbers."""
    name, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - libraries draw from it
    version, words, gauss_next = random.getstate()
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "numpy": [
            str(name),
            torch.from_numpy(np.asarray(keys).astype(np.int64)),
            int(position),
            int(has_gauss),
            float(gauss),
        ],
        "python": [version, list(words), gauss_next],
    }
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state_all()
    return state


def restore_random_state(state: dict[str, Any]) -> None:
    """Inverse of `random_state`."""
    torch.set_rng_state(state["torch"])
    name, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), position, has_gauss, gauss))  # noqa: NPY002
    version, words, gauss_next = state["python"]
    random.setstate((version, tuple(words), gauss_next))
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])


def seed_everything(seed: int) -> None:
    """Seed torch, NumPy and Python."""
    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)


def gradient_norm(parameters: list[Tensor]) -> Tensor:
    """Norm of all gradients together; NaN or infinite if any gradient is."""
    norms = torch._foreach_norm([p.grad for p in parameters if p.grad is not None])
    return torch.stack(list(norms)).norm()
