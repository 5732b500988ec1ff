#!/usr/bin/env python3
"""Preprocess sequences of TUM-VIE: undistorted cameras, rectification map and images.

Example: python scripts/pp_tumvie.py datasets/tumvie --side left --jobs 2

Expects sequence folders with *events_{side}.h5, {side}_images/ and mocap_data.txt, beside camera-calibrationA.json and
camera-calibrationB.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.preprocess_cli import preprocess_main  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above

_SIDE_OF_CAMERA = {"0": "left", "1": "right"}


def _side(camera: str) -> str:
    if camera not in _SIDE_OF_CAMERA:
        raise argparse.ArgumentTypeError(f"{camera!r} is no camera, expected 0 (left) or 1 (right)")
    return _SIDE_OF_CAMERA[camera]


def _add_camera(parser: AliasParser) -> None:
    parser.add_argument("--camId", dest="side", type=_side, default=argparse.SUPPRESS,
                        help="camera as a number: 0 is --side left, 1 is --side right")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return preprocess_main("tumvie", argv, description=__doc__, extend=_add_camera)


if __name__ == "__main__":
    sys.exit(run_cli(main))
