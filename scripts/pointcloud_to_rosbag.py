#!/usr/bin/env python3
"""Write a point cloud, clouds per frame, or a trajectory as a bag of ROS 1, without ROS.

Example: python scripts/pointcloud_to_rosbag.py --input results/board_frames.npz --output_bag results/board.bag

Clouds (.npy .ply .pcd .npz) become sensor_msgs/PointCloud2, poses (.txt, _poses.npy) geometry_msgs/PoseStamped,
camera to world. The first stamp is one second.
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
    parser = AliasParser(prog="pointcloud_to_rosbag.py", description=__doc__)
    add = parser.add_argument
    add("--input", required=True, metavar="FILE", help="cloud, (F, N, 3) array, frame bundle, or trajectory")
    add("--output_bag", required=True, metavar="FILE", help="the bag")
    add("--topic", help="default: /devo/pointcloud for clouds, /devo/pose for poses, /pose with --emvs_style")
    add("--frame_id", default="world", help="frame of the points and poses")
    add("--timestamp_unit", choices=("auto", "us", "s"), default="auto",
        help="unit of --timestamps_npy and of text poses; auto: microseconds if they span more than 1e5")
    add("--timestamps_npy", metavar="FILE", help="stamps of the clouds or poses")
    add("--include_empty", action="store_true", help="write frames without points too")
    add("--emvs_style", action="store_true",
        help="trajectories: on /pose, beside an empty /dvs/events and a dummy /dvs/camera_info")
    add("--H", type=int, default=480, help="accepted, without effect")
    add("--W", type=int, default=640, help="accepted, without effect")
    add("--overwrite", action="store_true", help="replace an existing bag")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    from utils.ros_output.clouds import BagOptions, write_input_as_bag

    print(write_input_as_bag(BagOptions(**vars(args))))
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
