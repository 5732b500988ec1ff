#!/usr/bin/env python3
"""Track a recording and write trajectory, sparse point cloud, depths and a preview picture.

Example: python scripts/export_pointcloud.py --datapath my_recording --out results/cloud.npy
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.cli import AliasParser, run_cli  # noqa: E402 - needs the path above


def build_arg_parser(datapath_required: bool = True) -> argparse.ArgumentParser:
    """The command line; every flag also works with hyphens for underscores and the other way round."""
    parser = AliasParser(prog="export_pointcloud.py", description=__doc__)
    add = parser.add_argument
    add("--datapath", required=datapath_required, help="sequence folder, or an event file for --dataset generic")
    add("--dataset", default="auto", help="how to read it: generic, fpv, rpg, vector, ...; auto looks at its files")
    add("--out", default="point_cloud.npy", help="base name of all outputs; .npy, .ply, .npz or .pcd")
    add("--weights", help="checkpoint, name of built-in weights, or random:SEED (default: the built-in ones)")
    add("--config", help="settings as YAML (default: preset of the dataset)")
    add("--opts", nargs="+", metavar="KEY VALUE", help="override settings, for example --opts KEYFRAME_THRESH 10")
    add("--device", default="auto", help="auto, cpu, cuda or cuda:0")
    add("--seed", type=int, default=0, help="seed of patch selection and initial depths")
    add("--rgb", action="store_true", help="use the image frames instead of the events (needs frame weights)")

    window = parser.add_argument_group("what is read")
    window.add_argument("--stride", type=int, default=1, help="use every n-th window")
    window.add_argument("--side", default="left", help="camera of a stereo recording")
    window.add_argument("--start_us", type=float, help="first time [us]")
    window.add_argument("--stop_us", type=float, help="last time [us]")
    window.add_argument("--window_ms", type=float, help="length of the event windows [ms]")
    window.add_argument("--window_events", type=int, help="events per window, instead of a fixed time")
    window.add_argument("--calib", help="calibration file (default: calib.{yaml,json,txt} of the folder)")
    window.add_argument("--image_size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="sensor size [px]")
    window.add_argument("--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"),
                        help="pinhole camera without distortion, instead of a calibration file [px]")

    extra = parser.add_argument_group("further products")
    extra.add_argument("--viz", action="store_true", help="accepted; there is no live viewer")
    extra.add_argument("--viz-flow", action="store_true", help="write edges and reprojections as _flow.npz")
    extra.add_argument("--debug", action="store_true", help="show tracebacks of errors")
    extra.add_argument("--save_per_frame_cloud", action="store_true", help="write the map after every frame")
    extra.add_argument("--save_per_frame_cloud_path", default="results/clouds", help="folder of those clouds")
    extra.add_argument("--voxel_size", type=float, default=0.05, help="grid of combined_map.ply [trajectory units]")
    extra.add_argument("--export_frame_data", action="store_true", help="write the structure per frame as _frames.npz")
    extra.add_argument("--frame_data_out", help="file of that bundle")
    extra.add_argument("--frame_mode", choices=("final", "online"), default="final",
                       help="per-frame structure from the final state, or as it was right after each frame")
    extra.add_argument("--save_dpviewer_cloud", action="store_true", help="write the accumulated map as _dpviewer.npy")

    clean = parser.add_argument_group("cleaning (lengths in trajectory units, scale is arbitrary)")
    clean.add_argument("--convert_ply", action="store_true", help="accepted; the PLY is always written")
    clean.add_argument("--cleanup", action=argparse.BooleanOptionalAction, default=True,
                       help="write _cleaned.ply: quality filter, then the outlier filter")
    clean.add_argument("--cleanup_algo", choices=("sor", "ror"), default="sor", help="statistical or radius filter")
    clean.add_argument("--sor_nb_neighbors", type=int, default=20, help="neighbours looked at")
    clean.add_argument("--sor_std_ratio", type=float, default=2.0, help="how many standard deviations may be kept")
    clean.add_argument("--ror_radius", type=float, help="radius (default: 3 x median neighbour distance)")
    clean.add_argument("--ror_min_neighbors", type=int, help="points needed within the radius")
    return parser


def run_export_pointcloud(args: argparse.Namespace) -> int:
    """Do what the parsed arguments ask for; returns the exit code."""
    from utils.export_run import ExportOptions, export_pointcloud

    export_pointcloud(ExportOptions(**vars(args)))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Parse and run."""
    return run_export_pointcloud(build_arg_parser().parse_args(argv))


if __name__ == "__main__":
    sys.exit(run_cli(main))
