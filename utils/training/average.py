"""Average the weights of several runs that began from the same weights: `python -m utils.training.average A B --out C`.

Runs that share their beginning end in the same basin; the mean of their weights is better than each (Wortsman et al.,
"Model soups", ICML 2022), and runs need no communication, unlike one run with larger batches. The result holds
validation figures, so that it can be exported.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from devo.checkpoint import network_from_state, save_checkpoint
from devo.enet import eVONet
from devo.errors import CheckpointError, DevoError
from utils.training.simulated import validation_clips
from utils.training.trainer import training_state
from utils.training.validate import ValidationSettings, validate


def averaged_weights(checkpoints: Sequence[Path]) -> dict[str, Tensor]:
    """Mean of the weights of training checkpoints, by name; of a `last.pth` its moving average counts.

    Raises:
        CheckpointError: unreadable, or networks of different dimensions.
    """
    states = []
    for path in checkpoints:
        state = training_state(path)
        states.append(state["average"]["values"] if "average" in state else state["model_state_dict"])
    for path, state in zip(checkpoints, states):
        for name in sorted(set(state) | set(states[0])):
            found, expected = (tuple(values[name].shape) if name in values else None for values in (state, states[0]))
            if found != expected:
                raise CheckpointError(
                    f"{path} holds {name} with shape {found}, expected {expected} as in {checkpoints[0]}; "
                    "only networks of equal dimensions can be averaged"
                )
    return {name: torch.stack([state[name] for state in states]).mean(dim=0) for name in states[0]}


def write_average(checkpoints: Sequence[Path], out: Path, cache: Path, clips: int) -> dict[str, float]:
    """Average, validate on the fixed clips as the trainer does, and write weights, figures and settings of the first.

    Args:
        checkpoints, out: files. cache: folder of simulated clips. clips: how many to validate on, 0 for none.

    Raises:
        CheckpointError: as `averaged_weights`.
    """
    network = cast(eVONet, network_from_state(averaged_weights(checkpoints)))
    extras: dict[str, Any] = {"steps": 0, "settings": training_state(checkpoints[0]).get("settings", {})}
    if clips:
        extras["validation"] = validate(network, validation_clips(cache, clips), ValidationSettings(patches=24))
    save_checkpoint(out, network, **extras)
    return extras.get("validation", {})


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoints", type=Path, nargs="+", help="best.pth or last.pth of runs")
    parser.add_argument("--out", type=Path, required=True, help="weights file, for train.py --init")
    parser.add_argument("--cache", type=Path, default=Path("runs/cache"), help="folder of simulated clips")
    parser.add_argument("--validation-clips", type=int, default=16)
    options = parser.parse_args(arguments)
    try:
        figures = write_average(options.checkpoints, options.out, options.cache, options.validation_clips)
    except DevoError as error:
        sys.stderr.write(f"average: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{options.out}: mean of {len(options.checkpoints)} checkpoints\n")
    sys.stdout.write("".join(f"{name} {value:.3f}\n" for name, value in figures.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
