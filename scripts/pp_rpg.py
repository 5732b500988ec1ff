#!/usr/bin/env python3
"""Preprocess stereo DAVIS240C recordings (RPG, ECCV 2018): events, ground truth, camera and images of one side.

Example: python scripts/pp_rpg.py datasets/rpg --side left --jobs 2

Expects bags of ROS 1 with /davis_left/events and /davis_left/image_raw (or /davis/left/...); the products of NAME.bag
go to the folder NAME beside it. Needs the package rosbags, but no ROS.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.preprocess_cli import add_on_unsorted, preprocess_main  # noqa: E402
from utils.cli import run_cli  # noqa: E402 - needs the path above


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return preprocess_main("rpg", argv, description=__doc__, extend=add_on_unsorted)


if __name__ == "__main__":
    sys.exit(run_cli(main))
