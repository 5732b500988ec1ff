#!/usr/bin/env python3
"""Preprocess sequences of VECtor: stamps, poses, undistorted cameras, rectification map and images.

Example: python scripts/pp_vector.py datasets/vector --side left --jobs 2

Expects sequence folders with {seq}1.synced.{side}_event.hdf5, {seq}1.synced.{side}_camera/ and {seq}1.synced.gt.txt,
and the folder 0_calib/ beside them (or in them).
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
    return preprocess_main("vector", argv, description=__doc__)


if __name__ == "__main__":
    sys.exit(run_cli(main))
