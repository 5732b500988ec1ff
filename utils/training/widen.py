"""A wider network that computes the same: `python -m utils.training.widen devo-tiny --preset base --out wide.pth`.

Every channel is copied; what reads the copies shares its weight between them, unequally and at random, so that the
copies learn different things from the first step on (Chen, Goodfellow and Shlens, "Net2Net", ICLR 2016). Layer and
instance norms do not notice copies. A large network so continues from what a small one learned cheaply.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from devo.checkpoint import load_network, save_checkpoint
from devo.enet import eVONet
from devo.errors import DevoError, InputError
from utils.training.settings import PRESETS, TrainSettings

SPREAD = 0.5  # standard deviation of the shares, in units of an equal share
MATCHED = "patchify.fnet.conv2."  # features that are multiplied with each other


def widened(state: Mapping[str, Tensor], network: eVONet, seed: int = 0) -> dict[str, Tensor]:
    """Weights for `network` that give the outputs of the narrower network of `state`.

    Args:
        state: weights by name. network: the wide one, every width a multiple of the narrow one's.
        seed: of the shares.

    Raises:
        InputError: other parameters, or widths that are no multiples.
    """
    generator = torch.Generator().manual_seed(seed)
    wide = {}
    for name, target in network.state_dict().items():
        source = state.get(name)
        found = () if source is None else tuple(source.shape)
        if source is None or len(found) != target.dim() or any(new % old for new, old in zip(target.shape, found)):
            raise InputError(
                f"{name} is {tuple(target.shape)} in the wide network and {found or 'absent'} in the narrow one; "
                "expected multiples of all widths"
            )
        factors = [new // old for new, old in zip(target.shape, found)]
        value = source.double()
        if target.dim() > 1 and factors[1] > 1:
            value = value.repeat(1, factors[1], *[1] * (target.dim() - 2))
        value = value.repeat(factors[0], *[1] * (target.dim() - 1))
        if target.dim() > 1 and factors[1] > 1:
            value = value * _shares(target, factors[1], generator)
        if name.startswith(MATCHED):
            value = value / factors[0] ** 0.5
        wide[name] = value.to(target.dtype)
    return wide


def _shares(target: Tensor, copies: int, generator: torch.Generator) -> Tensor:
    """Shares of the copies of each input for each output, (out, copies * in, 1...), with the sum 1."""
    outputs, inputs = target.shape[0], target.shape[1] // copies
    noise = torch.randn(outputs, copies, inputs, generator=generator, dtype=torch.float64) * SPREAD
    shares = (1.0 + noise - noise.mean(dim=1, keepdim=True)) / copies
    return shares.reshape(outputs, copies * inputs, *[1] * (target.dim() - 2))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="checkpoint file or name of built-in weights")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="base", help="size of the wide network")
    parser.add_argument("--out", type=Path, required=True, help="weights file, for train.py --init")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    try:
        settings = TrainSettings.from_preset(options.preset)
        network = eVONet(**settings.network_arguments())
        network.load_state_dict(widened(load_network(options.weights).state_dict(), network, options.seed))
        save_checkpoint(options.out, network, steps=0, settings=settings.as_dict())
    except DevoError as error:
        sys.stderr.write(f"widen: {error}\n")
        return error.exit_code
    parameters = sum(value.numel() for value in network.parameters())
    sys.stdout.write(f"{options.out}: {parameters} parameters\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
