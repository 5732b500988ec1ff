"""Remove outliers from a point cloud file (PLY, PCD, NPY, NPZ) and say how many.

  sor      statistical: mean distance to the neighbours far above average
  ror      radius: too few other points nearby
  quality  the odometry's own figures, where the file has them: observations, parallax, depth, age
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # noqa: PTH100, PTH120

from utils.cli import AliasParser, run_cli  # noqa: E402


def build_parser() -> AliasParser:
    """The command line of this script."""
    parser = AliasParser(prog="cleanup_pointcloud.py", description=__doc__)
    parser.add_argument("--input_file", "-i", required=True, metavar="FILE", help="cloud to clean")
    parser.add_argument("--algorithm", "-a", required=True, choices=("sor", "ror", "quality"), help="which filter")
    parser.add_argument("--output_file", "-o", metavar="FILE", help="default: the input's name with _cleaned")
    parser.add_argument("--display", action="store_true", help="open a window with the result (needs a display)")
    parser.add_argument("--verbose", "-v", action="store_true", help="print the parameters in effect too")
    sor = parser.add_argument_group("sor")
    sor.add_argument("--nb_neighbors", type=int, default=20, metavar="N", help="neighbours per point, itself included")
    sor.add_argument("--std_ratio", type=float, default=2.0, metavar="R",
                     help="a point goes if its mean distance exceeds the average by R standard deviations")
    ror = parser.add_argument_group("ror")
    ror.add_argument("--radius", type=_radius, default="auto", metavar="LENGTH",
                     help="in the cloud's unit; auto = 3 times the median nearest-neighbour distance, since the scale "
                          "of a monocular cloud is arbitrary")
    ror.add_argument("--min_neighbors", type=int, metavar="N",
                     help="other points that must lie within the radius (default: 16 with a given radius, 4 with auto)")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Clean one file; 0 on success, otherwise a `DevoError` with its exit code."""
    options = build_parser().parse_args(argv)
    from pathlib import Path

    from devo.errors import DevoError, InputError
    from utils.clouds.filters import clean_cloud
    from utils.clouds.io import read_cloud, write_cloud
    from utils.viewer.window import has_display, show_cloud

    if options.display and not has_display():
        raise InputError("--display: there is no display here; leave it out and look at the written file elsewhere")
    source = Path(options.input_file)
    target = Path(options.output_file) if options.output_file else source.with_stem(f"{source.stem}_cleaned")
    cloud = read_cloud(source)
    if not len(cloud):
        raise InputError(f"{source}: the cloud is empty, there is nothing to clean")
    cleaned, reports = clean_cloud(cloud, [(options.algorithm, _arguments(options))])
    if not len(cleaned):
        raise DevoError(f"{source}: no point passed, nothing was written ({reports[0]}); loosen the parameters")
    write_cloud(target, cleaned)
    print(reports[0] if options.verbose else f"{options.algorithm}: kept {len(cleaned)} of {len(cloud)} points")
    print(target)
    if options.display:
        show_cloud(cleaned, "cleaned cloud")
    return 0


def _radius(text: str) -> float | None:
    if text == "auto":
        return None
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive length or auto, found {text}")
    return value


def _arguments(options: argparse.Namespace) -> dict[str, Any]:
    if options.algorithm == "sor":
        return {"neighbors": options.nb_neighbors, "std_ratio": options.std_ratio}
    if options.algorithm == "ror":
        return {"radius": options.radius, "min_neighbors": options.min_neighbors}
    return {}


if __name__ == "__main__":
    sys.exit(run_cli(main))
