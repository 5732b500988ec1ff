"""Which recording a command reads and how it is cut into windows."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from utils.datasets.registry import Recording


def add_recording_options(parser: argparse.ArgumentParser, flag: str = "--datapath", required: bool = True) -> None:
    """Add the recording (`flag` names its path) and everything `SequenceOptions` takes from a command line."""
    group = parser.add_argument_group("what is read")
    add = group.add_argument
    add(flag, required=required, dest="datapath", help="sequence folder, or an event file for --dataset generic")
    add("--dataset", default="auto", help="how to read it: generic, fpv, rpg, vector, ...; auto looks at its files")
    add("--stride", type=int, default=1, help="use every n-th window")
    add("--side", default="left", help="camera of a stereo recording")
    add("--stream", metavar="NAME", help="generic: topic or group (or part of it) of a file with several cameras")
    add("--start_us", type=float, help="first time [us]")
    add("--stop_us", type=float, help="last time [us]")
    add("--window_ms", type=float, help="length of the event windows [ms]")
    add("--window_events", type=int, help="events per window, instead of a fixed time")
    add("--calib", help="calibration file (default: calib.{yaml,json,txt} of the folder)")
    add("--image_size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="sensor size [px]")
    add("--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"),
        help="pinhole camera without distortion, instead of a calibration file [px]")


def open_recording(args: argparse.Namespace) -> Recording:
    """Open what `add_recording_options` parsed.

    Raises:
        InputError: no such recording, or options that do not fit.
    """
    from utils.datasets.registry import SequenceOptions, open_sequence

    options = SequenceOptions(
        side=args.side, stride=args.stride, start_us=args.start_us, stop_us=args.stop_us, window_ms=args.window_ms,
        window_events=args.window_events, calib=Path(args.calib) if args.calib else None,
        image_size=tuple(args.image_size) if args.image_size else None,
        intrinsics=tuple(args.intrinsics) if args.intrinsics else None, stream=args.stream)
    return open_sequence(args.dataset, args.datapath, options)
