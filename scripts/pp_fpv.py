#!/usr/bin/env python3
"""Preprocess UZH-FPV sequences (DAVIS346): stamps from 0, ground truth of the camera, undistorted camera and images.

Example: python scripts/pp_fpv.py datasets/uzh-fpv --jobs 4

Expects folders with events.txt, images.txt, img/ and groundtruth.txt (where the name has _with_gt). The name of the
folder decides about the calibration: indoor_45_, indoor_forward_ or outdoor_forward_.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.preprocess_cli import preprocess_main  # noqa: E402
from utils.cli import run_cli  # noqa: E402 - needs the path above


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return preprocess_main("fpv", argv, description=__doc__, sides=("left",))


if __name__ == "__main__":
    sys.exit(run_cli(main))
