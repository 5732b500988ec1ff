#!/usr/bin/env python3
"""Look at a point cloud and the camera's path: in a window, or as one HTML page for any browser.

Example: python scripts/view_pointcloud.py results/board_cleaned.ply --html results/board_view.html

Without a display the page is written next to the cloud. It needs no network and no server: open it from the disk.
Clouds: .ply .pcd .npy .npz, and the frame bundle of an export. The scale of a monocular cloud is arbitrary.
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
    parser = AliasParser(prog="view_pointcloud.py", description=__doc__)
    parser.add_argument("cloud", nargs="?", help="cloud file; may be left out if --poses is given")
    parser.add_argument("--points", dest="cloud_flag", metavar="CLOUD", help="the cloud, named by a flag")
    parser.add_argument("--html", metavar="FILE", help="write a page instead of opening a window")
    parser.add_argument("--max_points", type=int, default=2_000_000, help="thin out larger clouds on the page")
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    add_input_flags(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    args.cloud = args.cloud or args.cloud_flag
    from devo.errors import InputError
    from utils.plots.inputs import default_output, read_inputs
    from utils.plots.scene import Scene
    from utils.viewer.page import save_page
    from utils.viewer.window import has_display, show

    if args.max_points < 1:
        raise InputError(f"--max_points is {args.max_points}, expected at least 1")
    found = read_inputs(args)
    scene = Scene.build(found.cloud, found.world_T_cam, args.color_by, unit=found.unit, most_points=args.max_points,
                        show_outside=True, pyramid=found.pyramid, frustum_scale=args.frustum_scale)
    if args.html is None and not args.open and has_display():
        show(scene, found.title)
        return 0
    target = Path(args.html) if args.html else default_output(args, "_view.html")
    if args.html is None and not args.open:
        print("no display here: writing a page instead of opening a window", file=sys.stderr)
    save_page(target, scene, title=found.title, t_us=found.t_us)
    print(f"{target}: {scene.summary()}; open it in a browser")
    if args.open:
        import webbrowser

        webbrowser.open(target.resolve().as_uri())
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
