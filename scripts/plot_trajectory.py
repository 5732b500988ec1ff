#!/usr/bin/env python3
"""Draw a camera's path, with the points around it if a cloud is given, into a PNG, SVG or PDF.

Example: python scripts/plot_trajectory.py --poses results/board_poses.npy --points results/board_cleaned.ply

The page shows the path in perspective and from above, and position and speed over time. Poses are those
of an export (<base>_poses.npy), TUM text, or a frame bundle (<base>_frames.npz, whose points are drawn too).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.scene_options import add_input_flags  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="plot_trajectory.py", description=__doc__)
    add = parser.add_argument
    add("pose_file", nargs="?", metavar="POSES", help="camera poses (or use --poses)")
    add("--points", dest="cloud", metavar="CLOUD", help="points to draw in the background")
    add("--frames", metavar="FILE", help="frame bundle (_frames.npz) whose points are drawn")
    add("--points_out", metavar="FILE", help="also write the points that are drawn (.npy, .ply, .npz, .pcd)")
    add("--out", "-o", metavar="FILE", help="default: beside the poses, <stem>_plot.png")
    add_input_flags(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    args.poses = args.poses or args.pose_file or args.frames
    args.cloud = args.cloud or args.frames
    from devo.errors import InputError
    from utils.clouds.io import write_cloud
    from utils.plots.inputs import default_output, read_inputs
    from utils.plots.pages import picture_path, save_figure, trajectory_page
    from utils.plots.scene import Scene

    if not args.poses:
        raise InputError("name the camera poses: POSES, --poses or --frames")
    found = read_inputs(args)
    if not len(found.world_T_cam):
        raise InputError(f"{args.poses}: there is no finite pose to draw")
    scene = Scene.build(found.cloud, found.world_T_cam, args.color_by, unit=found.unit, pyramid=found.pyramid,
                        frustum_scale=args.frustum_scale)
    named = argparse.Namespace(cloud=None, poses=args.poses)
    target = picture_path(args.out, default_output(named, "_plot"))
    save_figure(trajectory_page(scene, found.t_us, title=found.title), target)
    print(f"{target}: {scene.summary()}")
    if args.points_out:
        write_cloud(args.points_out, found.cloud, drop_nonfinite=True)
        print(args.points_out)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
