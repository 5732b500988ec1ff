"""The command line that all `pp_*` scripts share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from utils.cli import AliasParser


def build_arg_parser(dataset: str, description: str | None, sides: tuple[str, ...]) -> AliasParser:
    """The options of a preprocessing script; a data set with one camera has no `--side`."""
    parser = AliasParser(prog=f"pp_{dataset}.py", description=description)
    add = parser.add_argument
    add("folder", nargs="?", help="one recording, or a folder that contains recordings")
    add("--indir", help="the same as the positional argument")
    add("--side", choices=sides, default=sides[0], help="camera to preprocess" if len(sides) > 1 else argparse.SUPPRESS)
    add("--jobs", type=int, default=1, help="recordings processed at the same time")
    add("--overwrite", action="store_true", help="make all products anew; complete ones are kept otherwise")
    add("--images", action=argparse.BooleanOptionalAction, default=True,
        help="undistort the intensity images too (only odometry on images needs them)")
    parser.set_defaults(on_unsorted="error")
    add("--quiet", action="store_true", help="no progress bar and no list of what was made")
    return parser


def add_on_unsorted(parser: AliasParser) -> None:
    """Add the option of data sets whose events are read from bags."""
    parser.add_argument("--on_unsorted", choices=("error", "sort"), default="error",
                        help="what to do about events that run backwards in time; sort needs memory for all events")


def preprocess_main(dataset: str, argv: Sequence[str] | None = None, *, description: str | None = None,
                    sides: tuple[str, ...] = ("left", "right"),
                    extend: Callable[[AliasParser], None] | None = None) -> int:
    """Parse the command line of `pp_<dataset>.py` and run it; returns the exit code.

    Args:
        dataset: key of `utils.preprocessing.PREPROCESSORS`.
        argv: words of the command line, None for those of the process.
        description: what `--help` says first.
        sides: cameras the data set has.
        extend: adds further options, which may set `side`.
    """
    parser = build_arg_parser(dataset, description, sides)
    if extend is not None:
        extend(parser)
    args = parser.parse_args(argv)
    given = [folder for folder in (args.folder, args.indir) if folder]
    if len(given) != 1:
        parser.error("expected one folder, as positional argument or as --indir" if not given
                     else f"two folders were given, {given[0]} and {given[1]}; expected one")
    from utils.preprocessing import preprocess

    made = preprocess(dataset, given[0], side=args.side, jobs=args.jobs, overwrite=args.overwrite,
                      images=args.images, on_unsorted=args.on_unsorted, progress=not args.quiet)
    if not args.quiet:
        for folder, files in made.items():
            names = ", ".join(file.name for file in files) or "nothing to do, all products are there"
            print(f"{folder}: {names}")
    return 0
