#!/usr/bin/env python3
"""Simulate an event camera that is carried through a synthetic scene, with perfect ground truth.

Example: python scripts/simulate.py --scene board --out datasets/board --seconds 8 --seed 1

Writes a folder that every command reads with --dataset generic: events.h5, calib.yaml, groundtruth.txt,
images_timestamps_us.txt, depth/, images/ (with --frames) and scene.json with the planes of the scene.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="simulate.py", description=__doc__)
    add = parser.add_argument
    add("--scene", choices=("board", "room", "planes", "corridor"), default="board", help="what the camera sees")
    add("--out", required=True, help="folder to create")
    add("--seconds", type=float, default=8.0, help="length of the recording [s]")
    add("--seed", type=int, default=0, help="decides geometry, textures, motion and noise")
    add("--preset", choices=("slow", "normal", "fast"), default="normal", help="how the hand moves")
    add("--size", default="240x180", help="sensor as WIDTHxHEIGHT [px]")
    add("--fps", type=float, default=30.0, help="image and depth stamps per second")
    add("--frames", action=argparse.BooleanOptionalAction, default=False, help="write intensity frames to images/")
    add("--depth", action=argparse.BooleanOptionalAction, default=True, help="write depth maps to depth/")
    add("--distortion", action="store_true", help="use a barrel-distorted lens (radtan)")
    add("--background", action="store_true", help="put a slanted textured plane behind the board")
    add("--threshold", type=float, default=0.22, help="contrast threshold in log intensity")
    add("--noise", choices=("none", "typical", "strong"), default="typical", help="noise of the pixels")
    add("--textures", default="", metavar="FOLDER", help="images for the surfaces (default: procedural textures)")
    add("--device", default="auto", help="where to render: auto, cpu, cuda or cuda:0")
    add("--overwrite", action="store_true", help="replace an older simulated recording")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    import torch

    from devo.device import resolve_device
    from utils.simulator.camera import parse_size
    from utils.simulator.dataset_folder import FolderOptions, write_recording
    from utils.simulator.sequence import SequenceSettings

    torch.set_num_threads(1)  # drawing and pixels run side by side; more threads would only wait for each other
    settings = SequenceSettings(
        scene=args.scene, seconds=args.seconds, seed=args.seed, preset=args.preset, size=parse_size(args.size),
        distorted=args.distortion, background=args.background, threshold=args.threshold, noise=args.noise,
        textures=args.textures)
    options = FolderOptions(args.fps, args.frames, args.depth, args.overwrite, progress=True)
    summary = write_recording(args.out, settings, options, resolve_device(args.device))
    print(f"{summary.folder}: {summary.events} events in {summary.seconds:g} s "
          f"({summary.events_per_s / 1e3:.0f} thousand a second), path {summary.path_length_m:.2f} m, "
          f"image motion {summary.mean_flow_px_s:.0f} px/s, {summary.frames} stamps")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
