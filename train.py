#!/usr/bin/env python
"""Train the event network, by default on simulated clips and on a CPU: `python train.py --data sim --preset tiny`."""

from __future__ import annotations

import argparse
import sys


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Command line of the trainer; options left out take the value of the preset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    add("--data", choices=("sim", "tartan"), default="sim", help="simulated clips or TartanAir event voxels")
    add("--datapath", default="", help="root of TartanAir (--data tartan)")
    add("--preset", default="tiny", help="size of the network: tiny, small or base")
    add("--name", default="tiny", help="the run's folder is <runs>/<name>")
    add("--runs", default="runs", help="folder of all runs")
    add("--cache", default=None, help="folder of simulated clips (default: <runs>/cache)")
    add(
        "--resume",
        default=None,
        metavar="CHECKPOINT",
        help="go on exactly from a last.pth; 'auto' takes the run's own if it exists",
    )
    add("--init", default=None, metavar="WEIGHTS", help="start from these weights, with fresh optimiser")
    add("--only", choices=("scorer",), default=None, help="train this part alone, the rest stays as it is")
    add("--minutes", type=float, default=None, help="stop (and save) after this wall-clock time")
    add("--threads", type=int, default=None, help="CPU threads of the trainer")
    add("--device", default=None, help="cpu or cuda (default: cuda where available)")
    add("--simulators", type=int, default=1, help="background processes that simulate clips")
    add("--no-background", action="store_true", help="simulate clips in the training process, when needed")
    add("--log-every", type=int, default=20)
    add("--validate-every", type=int, default=200)
    add("--save-every", type=int, default=200)
    add("--validation-clips", type=int, default=32)
    group = parser.add_argument_group("training (default: preset)")
    for flag, kind in (
        ("steps", int),
        ("clips", int),
        ("frames", int),
        ("updates", int),
        ("patches", int),
        ("initial-frames", int),
        ("structure-only", float),
        ("perturbed", float),
        ("flat-depth", float),
        ("solver-gradient-every", int),
        ("match-gradient-every", int),
        ("match-updates", int),
        ("depth-noise", float),
        ("unroll-every", int),
        ("score-every", int),
        ("warmup", int),
        ("schedule", str),
        ("final-rate", float),
        ("ema", float),
        ("precision", str),
        ("seed", int),
        ("pool-shards", int),
        ("shard-clips", int),
        ("shard-frames", int),
        ("reuse", int),
        ("norm", str),
    ):
        group.add_argument(f"--{flag}", type=kind, default=None)
    group.add_argument("--lr", type=float, default=None, dest="learning_rate", help="peak learning rate")
    group.add_argument("--clip", type=float, default=None, dest="clip_gradient", help="largest gradient norm")
    group.add_argument("--size", action="append", metavar="HxW", help="window of the clips, may be given several times")
    group.add_argument("--shard-size", metavar="HxW", help="size of the simulated clips")
    group.add_argument("--randaug", action="store_true", default=None, help="published voxel augmentation")
    group.add_argument(
        "--loss", action="append", default=[], metavar="NAME=VALUE", help="weight of a loss, e.g. pose=10"
    )
    group.add_argument(
        "--augment", action="append", default=[], metavar="NAME=VALUE", help="augmentation setting, e.g. noise=0.5"
    )
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Train; returns the exit code."""
    options = parse_arguments(arguments)
    from devo.errors import DevoError
    from utils.training.launch import launch

    try:
        return launch(options)
    except DevoError as error:
        print(f"train.py: {error}", file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
