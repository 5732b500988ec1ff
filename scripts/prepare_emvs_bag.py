#!/usr/bin/env python3
"""Write a bag (events, camera, poses) and a flag file for EMVS programs of ROS 1, without ROS.

Example: python scripts/prepare_emvs_bag.py --datapath datasets/board --poses results/board_poses.npy --out_bag emvs.bag

Poses go out camera to world, as EMVS needs them. _poses.npy and TUM text hold just that and are not inverted; a tag in
<base>_meta.json or --pose_convention T_cw says otherwise. Raw events go with the real distortion of the lens where a
calibration is known, else they are undistorted first. scripts/run_emvs.py does the mapping itself and needs no bag.
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
    parser = AliasParser(prog="prepare_emvs_bag.py", description=__doc__)
    add = parser.add_argument
    add("--datapath", "--seq_dir", metavar="FOLDER", help="folder of the recording")
    add("--dataset", default="auto", help="how to read it: generic, vector, ...; auto looks at its files")
    add("--events", metavar="FILE", help="event file instead of a folder, with --calib")
    add("--calib", metavar="FILE", help="calibration of the raw pixels")
    add("--image_size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="sensor size, if no file says it [px]")
    add("--side", choices=("left", "right"), default="left", help="camera of a stereo data set")
    add("--poses", "--devo_poses_npy", required=True, metavar="FILE", help="<base>_poses.npy, TUM text, frame bundle")
    add("--tstamps", "--devo_tstamps_npy", metavar="FILE", help="stamps [us] (default: <base>_tstamps.npy)")
    add("--pose_convention", choices=("auto", "T_wc", "T_cw"), default="auto", help="what --poses holds; see above")
    add("--no_pose_conversion", dest="pose_convention", action="store_const", const="T_wc",
        help="the same as --pose_convention T_wc")
    add("--time_unit", choices=("auto", "s", "ms", "us", "ns"), default="auto", help="unit of the stamps in text")
    add("--out_bag", required=True, metavar="FILE", help="the bag")
    add("--out_conf", metavar="FILE", help="the flag file (default: the bag's name with .conf)")
    add("--overwrite", action="store_true", help="replace an existing bag")
    depth = parser.add_argument_group("depth range in the flag file, in the unit of the poses")
    depth.add_argument("--frames_npz", metavar="FILE", help="frame bundle; gives the bounds that are not given")
    depth.add_argument("--cloud", metavar="FILE", help="cloud of the run (.ply or .npz); gives them too")
    depth.add_argument("--min_depth", type=float, help="nearest depth (default: from the structure, else 0.3)")
    depth.add_argument("--max_depth", type=float, help="farthest depth (default: from the structure, else 5.0)")
    depth.add_argument("--dimZ", type=int, default=100, help="number of depth planes")
    bag = parser.add_argument_group("bag")
    bag.add_argument("--event_topic", default="/dvs/events", help="topic of the events")
    bag.add_argument("--camera_info_topic", default="/dvs/camera_info", help="topic of the camera")
    bag.add_argument("--pose_topic", default="/pose", help="topic of the poses")
    bag.add_argument("--t_margin_s", type=float, default=0.5, help="events around the time of the poses [s]")
    bag.add_argument("--max_events_per_msg", type=int, default=20_000, help="events per message")
    bag.add_argument("--eventarray_schema", choices=("5e8", "732"), default="5e8",
                     help="layout of the event messages by their MD5 sum; 5e8 is the usual one")
    for name in ("--H", "--W", "--progress_every_events"):
        bag.add_argument(name, type=int, help="accepted, without effect")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    given = vars(build_arg_parser().parse_args(argv))
    from utils.ros_output.emvs_bag import EmvsBagOptions, prepare_emvs_bag

    for name in ("H", "W", "progress_every_events"):
        given.pop(name)
    found = prepare_emvs_bag(EmvsBagOptions(**given))
    pixels = "undistorted to whole pixels" if found["rectified"] else "raw pixels, distortion in the camera info"
    print(f"{found['bag']}: {found['events']} events in {found['messages']} messages ({pixels}), {found['poses']} "
          f"poses (camera to world), {found['span_s']:.3f} s")
    print(f"{found['conf']}: depth {found['min_depth']:.4g} to {found['max_depth']:.4g} in the unit of the poses")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
