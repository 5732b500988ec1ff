#!/usr/bin/env python3
"""Map a recording with known poses: event-based multi-view stereo (EMVS), from events to a semi-dense cloud.

Example: python scripts/run_emvs.py --datapath datasets/board --min_depth 0.5 --max_depth 3 --out results/board_emvs

Poses are camera to world: ground truth (TUM text), or <base>_poses.npy of export_pointcloud.py; then give the cloud
of the same run with --cloud and the depth range follows from it. Lengths are in the unit of the poses.
Rebecq et al., IJCV 2018. The method is named in the patent application WO/2018/037079: check before commercial use.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above

BAG_FLAGS = ("bag_filename", "event_topic", "pose_topic", "camera_info_topic")


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="run_emvs.py", description=__doc__)
    add = parser.add_argument
    add("--out", required=True, help="beginning of the names of all outputs, for example results/board_emvs")
    add("--datapath", help="folder of a recording: events.*, calib.*, groundtruth.txt, or as --dataset has it")
    add("--dataset", default="generic", help="data set of the folder; auto = recognised by its files")
    add("--side", choices=("left", "right"), default="left", help="camera of a stereo data set")
    add("--events", help="event file, instead of that of the folder")
    add("--poses", help="camera poses: TUM text or <base>_poses.npy (default: groundtruth.txt of the folder)")
    add("--calib", help="calibration, instead of that of the folder")
    add("--image_size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="sensor size, if no file says it [px]")
    add("--cloud", help="sparse cloud in the frame of the poses; gives the depth bounds that are not given")
    add("--flagfile", help="file with one --name=value per line; the command line wins")
    add("--pose_format", choices=("auto", "npy", "tum_s", "tum_us"), default="auto",
        help="auto: npy by its name, else TUM with seconds")
    add("--pose_convention", choices=("auto", "T_wc", "T_cw"), default="auto",
        help="what the poses are: camera to world (T_wc, also auto) or world to camera (T_cw)")
    add("--start_time_s", type=float, default=0.0, help="begin, from the first stamp of events or poses [s]")
    add("--stop_time_s", type=float, default=1000.0, help="end, from the first stamp of events or poses [s]")
    add("--device", default="auto", help="auto, cpu, cuda or cuda:0")
    add("--pictures", action=argparse.BooleanOptionalAction, default=True, help="write PNG files")
    add("--save_dsi", action="store_true", help="write the votes (dimZ, dimY, dimX) as _dsi.npy")
    add("--check_poses", action=argparse.BooleanOptionalAction, default=True,
        help="warn if inverse poses would give a sharper result")
    _add_mapper_flags(parser)
    bag = parser.add_argument_group("ROS bags (accepted so that flag files can be shared; bags are not read)")
    for name, default in zip(BAG_FLAGS, ("input.bag", "/dvs/events", "/optitrack/davis", "/dvs/camera_info")):
        bag.add_argument(f"--{name}", help=f"elsewhere {default} by default")
    return parser


def _add_mapper_flags(parser: argparse.ArgumentParser) -> None:
    view = parser.add_argument_group("reference view and depth planes")
    view.add_argument("--dimX", type=int, default=0, help="width of the view, 0 = sensor [px]")
    view.add_argument("--dimY", type=int, default=0, help="height of the view, 0 = sensor [px]")
    view.add_argument("--dimZ", type=int, default=100, help="number of depth planes")
    view.add_argument("--fov_deg", type=float, default=0.0, help="field of view, below 10 = the camera's [degrees]")
    view.add_argument("--min_depth", type=float, help="nearest depth (default: from --cloud, else 0.3)")
    view.add_argument("--max_depth", type=float, help="farthest depth (default: from --cloud, else 5.0)")
    view.add_argument("--depth_spacing", choices=("inverse", "linear"), default="inverse",
                      help="planes equidistant in inverse depth or in depth")
    view.add_argument("--reference", choices=("fixed", "baseline"), default="fixed",
                      help="one view at the middle of the window, or a new one whenever the camera has moved on")
    view.add_argument("--view_baseline", type=float, default=0.3,
                      help="baseline: a view ends after a move of this share of the mean depth")
    view.add_argument("--view_angle_deg", type=float, default=20.0, help="baseline: or after this rotation [degrees]")
    view.add_argument("--min_view_baseline", type=float, default=0.005,
                      help="leave out views whose camera moves less than this share of the mean depth")
    vote = parser.add_argument_group("votes")
    vote.add_argument("--vote", choices=("bilinear", "nearest"), default="bilinear", help="how a vote is shared")
    vote.add_argument("--packet_size", type=int, default=1024, help="events that share a pose")
    vote.add_argument("--event_stride", type=int, default=1, help="use every n-th event")
    depth = parser.add_argument_group("depth map and cloud")
    depth.add_argument("--adaptive_threshold_kernel_size", type=int, default=5, help="width of the window, odd [px]")
    depth.add_argument("--adaptive_threshold_c", type=float, default=5.0, help="smaller = denser and noisier")
    depth.add_argument("--median_filter_size", type=int, default=5, help="width of the window, odd [px]")
    depth.add_argument("--subplane", action=argparse.BooleanOptionalAction, default=False,
                       help="refine depths between the planes")
    depth.add_argument("--radius_search", type=_radius, default=0.05,
                       help="radius of the outlier filter in the unit of the poses; auto = 3 x median distance of "
                            "nearest neighbours, for poses of arbitrary scale")
    depth.add_argument("--min_num_neighbors", type=int, default=3, help="other points needed within; 0 = no filter")


def _radius(text: str) -> float | None:
    return None if text == "auto" else float(text)


def read_flagfile(path: str) -> list[str]:
    """The words of a flag file: one `--name=value` or `--name` per line, `#` begins a comment.

    Raises:
        InputError: the file cannot be read, or a line is no flag.
    """
    from devo.errors import InputError

    try:
        lines = [line.strip() for line in Path(path).read_text("utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--flagfile {path}: cannot be read ({error})") from error
    words = [line for line in lines if line and not line.startswith("#")]
    bad = [word for word in words if not word.startswith("--")]
    if bad:
        raise InputError(f"--flagfile {path}: found {bad[0]!r}, expected one --name=value per line")
    return words


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    parser = build_arg_parser()
    finder = AliasParser(add_help=False)
    finder.add_argument("--flagfile")
    flagfile = finder.parse_known_args(words)[0].flagfile
    args = parser.parse_args((read_flagfile(flagfile) if flagfile else []) + words)

    import dataclasses

    from devo.errors import InputError
    from utils.emvs.run import EmvsOptions, run_emvs
    from utils.emvs.settings import EmvsSettings

    given = vars(args)
    given.pop("flagfile")
    bag = {name: given.pop(name) for name in BAG_FLAGS}
    if not (args.datapath or args.events):
        raise InputError(f"--bag_filename {bag['bag_filename']}: ROS bags are not read; convert the events and give "
                         "--events, --poses and --calib" if bag["bag_filename"] else
                         "give --datapath FOLDER, or --events, --poses and --calib")
    names = {field.name for field in dataclasses.fields(EmvsSettings)}
    settings = EmvsSettings(**{name: given.pop(name) for name in names})
    run_emvs(EmvsOptions(settings=settings, **given))
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
