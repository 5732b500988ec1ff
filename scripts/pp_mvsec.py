#!/usr/bin/env python3
"""Preprocess sequences of MVSEC indoor flying: one folder per recording with stamps, undistorted camera and images.

Example: python scripts/pp_mvsec.py datasets/mvsec --side left --jobs 2

Expects {name}_data.hdf5 and {name}_gt.hdf5 beside indoor_flying_calib/camchain-imucam-indoor_flying.yaml, and makes
{name}_data/ beside them.
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
    return preprocess_main("mvsec", argv, description=__doc__)


if __name__ == "__main__":
    sys.exit(run_cli(main))
