#!/usr/bin/env python3
"""Track a recording and write trajectory, sparse point cloud, depths and a preview picture.

Example: python scripts/export_pointcloud.py --datapath my_recording --out results/cloud.npy
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.edge_options import add_edge_options, add_focus_options  # noqa: E402
from scripts.recording_options import add_recording_options  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above


def build_arg_parser(datapath_required: bool = True) -> argparse.ArgumentParser:
    """The command line; every flag also works with hyphens for underscores and the other way round."""
    parser = AliasParser(prog="export_pointcloud.py", description=__doc__)
    add = parser.add_argument
    add("--out", default="point_cloud.npy", help="base name of all outputs; .npy, .ply, .npz or .pcd")
    add("--weights", help="checkpoint, name of built-in weights, or random:SEED (default: the built-in ones)")
    add("--config", help="settings as YAML (default: preset of the dataset)")
    add("--opts", nargs="+", metavar="KEY VALUE", help="override settings, for example --opts KEYFRAME_THRESH 10")
    add("--device", default="auto", help="auto, cpu, cuda or cuda:0")
    add("--seed", type=int, default=0, help="seed of patch selection and initial depths")
    add("--rgb", action="store_true", help="use the image frames instead of the events (needs frame weights)")
    add("--workers", type=int, default=1,
        help="threads that voxelise ahead of the tracker, while one more reads; 0 = none; same result")
    add_recording_options(parser, required=datapath_required)

    extra = parser.add_argument_group("further products")
    extra.add_argument("--viz", action="store_true", help="accepted; there is no live viewer")
    extra.add_argument("--viz-flow", action="store_true", help="write edges and reprojections as _flow.npz")
    extra.add_argument("--debug", action="store_true", help="one line per frame, and tracebacks of errors")
    extra.add_argument("--save_per_frame_cloud", action="store_true", help="write the map after every frame")
    extra.add_argument("--save_per_frame_cloud_path", default="results/clouds", help="folder of those clouds")
    extra.add_argument("--per_frame_keep", choices=("all", "last", "none"), default="all",
                       help="which of them stay; none: only combined_map.ply")
    extra.add_argument("--voxel_size", type=float, default=0.05, help="grid of combined_map.ply [trajectory units]")
    extra.add_argument("--export_frame_data", action="store_true",
                       help="write the structure per frame as _frames.npz, and a table of the frames as _frames.csv")
    extra.add_argument("--frame_data_out", help="file of that bundle; the table goes beside it")
    extra.add_argument("--frame_mode", choices=("final", "online"), default="final",
                       help="per-frame structure from the final state, or as it was right after each frame")
    extra.add_argument("--save_observations", action="store_true",
                       help="write where points were measured as _observations.npz (for export_colmap.py)")
    extra.add_argument("--save_dpviewer_cloud", action="store_true", help="write the accumulated map as _dpviewer.npy")

    edges = parser.add_argument_group("edge cloud: edges of the events with depths of the patches around them")
    edges.add_argument("--export_edge_cloud", action="store_true", help="write _edges.npy, .ply")
    edges.add_argument("--edge_cloud_out", help="file of that cloud")
    add_edge_options(edges)

    focus = parser.add_argument_group("focus-refined edge cloud: depths at which neighbouring event images agree")
    focus.add_argument("--export_focus_edge_cloud", action="store_true",
                       help="write _focus_edges.npy, .ply; reads the recording a second time")
    focus.add_argument("--focus_edge_cloud_out", help="file of that cloud")
    add_focus_options(focus)

    clean = parser.add_argument_group("cleaning (lengths in trajectory units, scale is arbitrary)")
    clean.add_argument("--convert_ply", action="store_true", help="accepted; PLY files are always written")
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
    from devo.errors import DevoError
    from utils.export_run import ExportOptions, export_pointcloud

    try:
        export_pointcloud(ExportOptions.from_flags(vars(args)))
    except DevoError:
        if args.debug:
            traceback.print_exc()
        raise
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Parse and run."""
    return run_export_pointcloud(build_arg_parser().parse_args(argv))


if __name__ == "__main__":
    sys.exit(run_cli(main))
