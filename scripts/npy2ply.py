"""Convert a NumPy point array to PLY (or PCD, NPZ), with colours and per-point values if there are any."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # noqa: PTH100, PTH120

from utils.cli import AliasParser, run_cli  # noqa: E402


def build_parser() -> AliasParser:
    """The command line of this script."""
    parser = AliasParser(prog="npy2ply.py", description=__doc__)
    parser.add_argument("input", help="points, .npy with an array (N, 3)")
    parser.add_argument("--out", "-o", metavar="FILE", help="default: the input's name with .ply; also .pcd or .npz")
    parser.add_argument("--ascii", action="store_true", help="text instead of binary little-endian")
    parser.add_argument("--colors", metavar="FILE", help="red, green, blue: .npy with a uint8 array (N, 3)")
    parser.add_argument("--attrs", metavar="FILE", help="per-point values: .npz with arrays (N,) and their names")
    parser.add_argument("--drop_nonfinite", action="store_true", help="leave out points with NaN or infinity")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Convert one file; 0 on success, otherwise a `DevoError` with its exit code."""
    options = build_parser().parse_args(argv)
    from pathlib import Path

    from devo.errors import InputError
    from utils.clouds.arrays import load_array, load_arrays
    from utils.clouds.cloud import PointCloud
    from utils.clouds.io import write_cloud

    source = Path(options.input)
    if source.suffix.lower() != ".npy":
        raise InputError(f"{source}: expected a .npy file with an array (N, 3)")
    try:
        cloud = PointCloud(
            load_array(source),
            load_array(options.colors) if options.colors else None,
            load_arrays(options.attrs) if options.attrs else {},
        )
    except InputError as error:
        raise error if str(source) in str(error) else InputError(f"{source}: {error}") from error
    target = Path(options.out) if options.out else source.with_suffix(".ply")
    dropped = write_cloud(target, cloud, text=options.ascii, drop_nonfinite=options.drop_nonfinite)
    print(f"{target}: {len(cloud) - dropped} points" + (f", {dropped} non-finite left out" if dropped else ""))
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
