#!/usr/bin/env python3
"""Track the events of a ROS bag and write trajectory, point cloud and the rest, without ROS and without unpacking it.

Example: python scripts/export_pointcloud_from_rosbag.py --bag walk.bag --delta-ms 30

Any topic with dvs_msgs or prophesee_event_msgs EventArray will do (ROS 1 and 2). The camera comes from CameraInfo in
the bag, from --calib, or from --intrinsics and --image_size. All other flags are those of export_pointcloud.py.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.export_pointcloud import build_arg_parser as build_export_parser  # noqa: E402
from scripts.export_pointcloud import run_export_pointcloud  # noqa: E402
from utils.cli import run_cli  # noqa: E402 - needs the path above

BAG_FLAGS = ("bag", "delta_ms", "output_dir", "skip_preprocess", "camera_info_topic")


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line: that of the export, and the flags of bags."""
    parser = build_export_parser(datapath_required=False)
    parser.prog, parser.description = "export_pointcloud_from_rosbag.py", __doc__
    parser.set_defaults(out=None, dataset="generic")
    bag = parser.add_argument_group("bag")
    bag.add_argument("--bag", required=True, help="bag of ROS 1 (.bag) or ROS 2 (.mcap, .db3, folder)")
    bag.add_argument("--event_topic", dest="stream", help="topic of the events, or a part of its name")
    bag.add_argument("--camera_info_topic", help="topic of the camera (default: beside the events, else the only one)")
    bag.add_argument("--delta_ms", type=float, help="length of the event windows [ms], as --window_ms")
    bag.add_argument("--output_dir", metavar="FOLDER", help="of the products (default: the bag's name without ending)")
    bag.add_argument("--skip_preprocess", action="store_true", help="accepted; bags are read as they are")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    from devo.errors import InputError
    from utils.ros_output.bag_export import export_arguments

    if args.dataset not in ("generic", "rpg", "auto"):
        raise InputError(f"--dataset {args.dataset}: a bag is read as it is; leave the flag out, or use "
                         "export_pointcloud.py for preprocessed folders")
    if args.delta_ms is not None and args.window_ms is not None:
        raise InputError("--delta_ms and --window_ms say the same; give one of them")
    return run_export_pointcloud(export_arguments(args, BAG_FLAGS))


if __name__ == "__main__":
    sys.exit(run_cli(main))
