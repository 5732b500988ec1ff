#!/usr/bin/env python3
"""Preprocess sequences of the Event Camera Dataset (DAVIS240C): stamps, undistorted camera and images.

Example: python scripts/pp_ecd.py datasets/ecd --jobs 2

Expects folders with events.txt, images.txt, images/ and calib.txt (fx fy cx cy k1 k2 p1 p2 k3).
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
    return preprocess_main("ecd", argv, description=__doc__, sides=("left",))


if __name__ == "__main__":
    sys.exit(run_cli(main))
