#!/usr/bin/env python3
"""Preprocess sequences of EDS: clock offset, stamps, poses, undistorted cameras and images.

Example: python scripts/pp_eds.py datasets/eds --jobs 2

Expects folders with events.h5, images_timestamps.txt, images/ and stamped_groundtruth.txt. The event file stays as it
is; folders in which it was shifted in place before are recognised.
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
    return preprocess_main("eds", argv, description=__doc__, sides=("left",))


if __name__ == "__main__":
    sys.exit(run_cli(main))
