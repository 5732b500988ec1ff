#!/usr/bin/env python3
"""Draw a point cloud, and the camera's path if there is one, into a PNG, SVG or PDF.

  overview   perspective, top, side and front view on one page (default)
  2d         one plane: xy = front, xz = top, yz = side
  3d         perspective from --elev and --azim

Example: python scripts/plot_pointcloud.py results/board_cleaned.ply --plane xz

Limits follow percentiles, so that a few far outliers do not shrink the scene. The scale of a monocular cloud is
arbitrary.
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
    parser = AliasParser(prog="plot_pointcloud.py", description=__doc__)
    add = parser.add_argument
    add("cloud", nargs="?", help=".ply, .pcd, .npy, .npz or the frame bundle of an export")
    add("--pointcloud", dest="cloud_flag", metavar="CLOUD", help="the cloud, named by a flag")
    add("--output", "-o", metavar="FILE", help="default: beside the cloud, <stem>_<plane or kind>.<format>")
    add("--format", choices=("auto", "png", "svg", "pdf"), default="auto", help="auto: by the output's name, else png")
    add("--kind", choices=("overview", "2d", "3d"), help="what to draw (default: 2d with --plane, 3d with an angle)")
    add("--plane", choices=("xy", "xz", "yz"), help="2d: the world axes that go right and up")
    add("--elev", type=float, help="3d: height of the observer above the horizon [degrees], 15 if not given")
    add("--azim", type=float, help="3d: -90 is behind the first camera, 0 at its right [degrees], -60 if not given")
    add("--point_size", type=float, metavar="AREA", help="in square points (default: by the number of points)")
    add("--tight", action="store_true", help="limits around all points instead of percentiles")
    add_input_flags(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    args.cloud = args.cloud or args.cloud_flag
    kind = args.kind or ("2d" if args.plane else "overview" if args.elev is None and args.azim is None else "3d")
    plane = args.plane or "xy"
    from devo.errors import InputError
    from utils.plots.inputs import default_output, read_inputs
    from utils.plots.pages import overview_page, perspective_page, picture_path, plane_page, save_figure
    from utils.plots.scene import Scene

    if args.point_size is not None and not 0 < args.point_size < 1e4:
        raise InputError(f"--point_size is {args.point_size:g}, expected a positive area in square points")
    found = read_inputs(args)
    target = picture_path(args.output, default_output(args, f"_{plane if kind == '2d' else kind}"), args.format)
    scene = Scene.build(found.cloud, found.world_T_cam, args.color_by, unit=found.unit, pyramid=found.pyramid,
                        frustum_scale=args.frustum_scale, robust=not args.tight)
    if kind == "2d":
        figure = plane_page(scene, plane, title=found.title, point_size=args.point_size)
    elif kind == "3d":
        angles = (15.0 if args.elev is None else args.elev, -60.0 if args.azim is None else args.azim)
        figure = perspective_page(scene, *angles, title=found.title, point_size=args.point_size)
    else:
        figure = overview_page(scene, title=found.title, point_size=args.point_size)
    save_figure(figure, target)
    print(f"{target}: {scene.summary()}")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
