"""Options that all commands on event files share."""

from __future__ import annotations

import argparse
import sys
import warnings
from typing import Any


def add_reading_options(parser: argparse.ArgumentParser) -> None:
    """Add what `open_events` wants to know."""
    parser.add_argument("--sensor_size", type=_size, metavar="WIDTHxHEIGHT",
                        help="sensor in pixels; default: what the file says")
    parser.add_argument("--time_unit", choices=("s", "ms", "us", "ns"),
                        help="unit of the stamps in the file; default: what the file says, else by their form")
    parser.add_argument("--stream", metavar="NAME",
                        help="which camera of a file with several: topic, group, or a part of the name such as left")


def reading_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return the keyword arguments for `open_events`."""
    return {"sensor_size": options.sensor_size, "time_unit": options.time_unit, "stream": options.stream}


def warn_in_one_line() -> None:
    """Let warnings of this process appear as one line on stderr, without the place in the source."""
    warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 640x480, found {text}")
    return int(width), int(height)
