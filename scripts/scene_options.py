"""The options that the commands for looking at clouds and trajectories share."""

from __future__ import annotations

import argparse

CAMERA = (640, 480)


def add_input_flags(parser: argparse.ArgumentParser, *, color_by: str = "depth") -> None:
    """Which files, how many of their points, and what the picture says about them."""
    group = parser.add_argument_group("what is shown")
    add = group.add_argument
    add("--poses", "--trajectory", metavar="FILE",
        help="camera poses: <base>_poses.npy, TUM text or a frame bundle (default: those of the same run)")
    add("--no_poses", dest="find_poses", action="store_false", help="do not look for the poses of the run")
    add("--pose_convention", choices=("auto", "T_wc", "T_cw"), default="auto",
        help="what the poses are: camera to world (T_wc) or the inverse; auto reads the tag of the run")
    add("--color_by", default=color_by, metavar="WHAT",
        help="depth, height, x, y, z, time, intensity, rgb, none or a per-point value of the file")
    add("--downsample", type=int, default=1, metavar="N", help="use every n-th point")
    add("--voxel_size", type=float, metavar="LENGTH", help="keep one point per cube of this edge length")
    add("--radius", type=float, metavar="LENGTH", help="keep points this near to the mean camera position")
    add("--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"),
        help="shape of the cameras [px] (default: from the description of the run)")
    add("--width", type=int, default=CAMERA[0], help="with --intrinsics: image width [px]")
    add("--height", type=int, default=CAMERA[1], help="with --intrinsics: image height [px]")
    add("--frustum_scale", type=float, metavar="LENGTH", help="length of the camera pyramids (default: by the scene)")
    add("--title", help="headline (default: the name of the file)")
    add("--unit", default="arbitrary units", help="what one unit of length is; say m only of aligned clouds")
