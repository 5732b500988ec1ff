#!/usr/bin/env python3
"""Convert an event recording of any supported format to HDF5 (DSEC layout), NPZ or text.

Example: python scripts/convert_events.py recording.raw events.h5

The format of the input is found by its content, that of the output by its name: .h5 .hdf5, .npz, .txt. HDF5 and text
are written piece by piece. Times stay those of the recording.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # noqa: PTH100, PTH120

from scripts.event_options import add_reading_options, reading_options, warn_in_one_line  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402

if TYPE_CHECKING:
    from pathlib import Path

    from utils.events import EventReader, Events

_SUFFIXES = (".h5", ".hdf5", ".npz", ".txt")


def build_parser() -> AliasParser:
    """The command line of this script."""
    parser = AliasParser(prog="convert_events.py", description=__doc__)
    parser.add_argument("input", help="event recording of any supported format")
    parser.add_argument("output", help="file to write: .h5, .hdf5, .npz or .txt")
    add_reading_options(parser)
    parser.add_argument("--sort", action="store_true", help="sort by time (loads the recording into memory)")
    parser.add_argument("--start", type=_seconds, default=0.0, metavar="S", help="skip the first S seconds")
    parser.add_argument("--stop", type=_seconds, metavar="S", help="stop S seconds after the first event")
    parser.add_argument("--compression", choices=("blosc", "gzip", "none"), default="blosc",
                        help="of HDF5; blosc needs hdf5plugin to read")
    parser.add_argument("--overwrite", action="store_true", help="replace the output if it exists")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Convert one recording; 0 on success, otherwise a `DevoError` with its exit code."""
    options = build_parser().parse_args(argv)
    from pathlib import Path

    from devo.errors import InputError
    from utils.events import open_events

    warn_in_one_line()
    source, target = Path(options.input), Path(options.output)
    if target.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{target}: the name must end in one of {', '.join(_SUFFIXES)}")
    if target.exists() and (not options.overwrite or source.exists() and target.samefile(source)):
        raise InputError(f"{target} exists; choose another name" + " or pass --overwrite" * (not options.overwrite))
    with open_events(source, on_unsorted="sort" if options.sort else "error", **reading_options(options)) as reader:
        counter = _Counter()
        _write(target, reader, counter.count(_cropped(reader, options.start, options.stop)), options.compression)
        lost = sum(reader.losses.values())
        print(f"{target}: {counter.events:,} events, {counter.duration_us * 1e-6:.6f} s, from {reader.format_name}"
              + (f"; {lost:,} damaged parts were left out" if lost else ""))
    return 0


class _Counter:
    """Counts what passes through."""

    def __init__(self) -> None:
        self.events = 0
        self.duration_us = 0
        self._first_us: int | None = None

    def count(self, pieces: Iterator[Events]) -> Iterator[Events]:
        """Pass all pieces on."""
        for piece in pieces:
            if len(piece):
                self._first_us = int(piece.t_us[0]) if self._first_us is None else self._first_us
                self.duration_us = int(piece.t_us[-1]) - self._first_us
                self.events += len(piece)
            yield piece


def _cropped(reader: EventReader, start_s: float, stop_s: float | None) -> Iterator[Events]:
    if not start_s and stop_s is None:
        yield from reader.chunks()
        return
    first_us = int(next(reader.chunks()).t_us[0])
    stop_us = math.inf if stop_s is None else first_us + round(stop_s * 1e6)
    yield from reader.chunks(start_us=first_us + round(start_s * 1e6), stop_us=stop_us)


def _write(target: Path, reader: EventReader, pieces: Iterator[Events], compression: str) -> None:
    import itertools

    from devo.errors import InputError
    from utils.events import Events, write_events_h5, write_events_npz, write_events_text

    first = next((piece for piece in pieces if len(piece)), None)
    if first is None:
        raise InputError(f"{reader.path}: no events between --start and --stop")
    pieces = itertools.chain([first], pieces)
    suffix = target.suffix.lower()
    if suffix == ".npz":
        write_events_npz(target, Events.concatenate(list(pieces)))
    elif suffix == ".txt":
        write_events_text(target, pieces)
    else:
        # Stamps since the epoch do not fit the 32 bits of the layout: the file then keeps an offset beside them.
        offset = 0 if int(first.t_us[0]) < 1 << 31 else None
        write_events_h5(target, pieces, offset, sensor_size=reader.sensor_size,
                        compression=compression)  # type: ignore[arg-type]


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected seconds, found {text}")
    return value


if __name__ == "__main__":
    sys.exit(run_cli(main))
