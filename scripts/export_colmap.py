#!/usr/bin/env python3
"""Write trajectory and structure as a COLMAP model, with real tracks and reprojection errors.

  --run results/board       a finished export (made with export_pointcloud.py --save_observations)
  --datapath FOLDER         a recording; the odometry runs first and its products go to <colmap_dir>/run
  --input FOLDER            ready-made frames: images (--mode rgb) or voxel grids in .h5 files (--mode evs)

Example: python scripts/export_colmap.py --run results/board --colmap_dir results/board_colmap

Images without a file are called frame_000000.png, ... by the row of the poses. COLMAP counts pixels from the corner of
the first one, so half a pixel is added. The scale is arbitrary; --colmap_scale multiplies it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above

if TYPE_CHECKING:
    from utils.colmap.export import FolderInput


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="export_colmap.py", description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--run", metavar="BASE", help="base name or any file of a finished export")
    source.add_argument("--datapath", metavar="FOLDER", help="recording to track first")
    source.add_argument("--input", metavar="FOLDER", help="frames to track first")
    add = parser.add_argument
    add("--colmap_dir", default="colmap_export", metavar="FOLDER", help="where the model goes")
    add("--colmap_scale", type=float, default=10.0, help="factor on translations and points")
    add("--format", choices=("text", "binary"), default="text", help="of the model's files")
    add("--min_track", type=int, default=2, help="leave out points with fewer observations")
    add("--max_error_px", type=float, default=4.0, help="leave out observations farther from the reprojected point")
    track = parser.add_argument_group("odometry (--datapath and --input)")
    track.add_argument("--config", help="settings as YAML (default: preset)")
    track.add_argument("--weights", help="checkpoint or built-in weights (default: the built-in ones)")
    track.add_argument("--stride", type=int, default=1, help="use every n-th frame")
    track.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:0")
    track.add_argument("--seed", type=int, default=0, help="seed of patch selection and initial depths")
    track.add_argument("--dataset", default="auto", help="--datapath: how to read it; auto looks at its files")
    frames = parser.add_argument_group("frames (--input)")
    frames.add_argument("--mode", choices=("rgb", "evs"), default="evs", help="images or voxel grids")
    frames.add_argument("--timestamps", metavar="FILE", help="one stamp per frame [us]")
    frames.add_argument("--intrinsics_file", metavar="FILE", help="calibration or one line fx fy cx cy")
    for name in ("--fx", "--fy", "--cx", "--cy"):
        frames.add_argument(name, type=float, help="pinhole camera of the files [px]")
    frames.add_argument("--height", type=int, help="of the files [px]")
    frames.add_argument("--width", type=int, help="of the files [px]")
    frames.add_argument("--scale", type=float, default=1.0, help="resize the frames; the model's camera follows")
    for name in ("--viz", "--viz-flow"):
        frames.add_argument(name, action="store_true", help="accepted, without effect")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    from utils.colmap.export import model_of_folder, model_of_run, write_and_describe
    from utils.colmap.model import TrackRules

    rules = TrackRules(args.max_error_px, args.min_track, args.colmap_scale)
    if args.input:
        model = model_of_folder(_folder_input(args), rules)
    else:
        model = model_of_run(args.run or _track_recording(args), rules)
    print(write_and_describe(args.colmap_dir, model, args.format))
    return 0


def _track_recording(args: argparse.Namespace) -> str:
    from devo.errors import InputError

    if not Path(args.datapath).exists():
        raise InputError(f"--datapath {args.datapath} does not exist, expected a recording")
    from utils.export_options import ExportOptions
    from utils.export_run import export_pointcloud

    out = str(Path(args.colmap_dir) / "run" / "cloud.npy")
    export_pointcloud(ExportOptions(
        datapath=args.datapath, dataset=args.dataset, config=args.config, weights=args.weights, stride=args.stride,
        device=args.device, seed=args.seed, out=out, save_observations=True))
    return out


def _folder_input(args: argparse.Namespace) -> FolderInput:
    from devo.errors import InputError
    from utils.calibration import Calibration, read_calibration
    from utils.colmap.export import FolderInput

    if args.width is None or args.height is None:
        raise InputError("--input needs the size of the frames: --width and --height")
    size, numbers = (args.width, args.height), (args.fx, args.fy, args.cx, args.cy)
    if (args.intrinsics_file is None) == any(value is None for value in numbers):
        raise InputError("--input needs its camera: either --intrinsics_file FILE, or --fx --fy --cx --cy")
    camera = Calibration(*size, *numbers) if args.intrinsics_file is None else read_calibration(
        args.intrinsics_file, size)
    if camera.is_distorted:
        raise InputError(f"{args.intrinsics_file}: the lens is distorted; frames must be undistorted before")
    return FolderInput(Path(args.input), args.mode, tuple(camera.intrinsics.tolist()), size,
                       None if args.timestamps is None else Path(args.timestamps), args.stride, args.scale,
                       args.config, args.weights, args.device, args.seed)


if __name__ == "__main__":
    sys.exit(run_cli(main))
