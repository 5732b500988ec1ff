#!/usr/bin/env python3
"""Say what an event recording is like: sensor, duration, rate, polarity, order, gaps, hot pixels; and draw it.

Example: python scripts/check_events.py recording.raw --picture recording.png

Ends with 1 if the recording needs attention before it is used: stamps that run backwards, or damaged parts.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # noqa: PTH100, PTH120

from scripts.event_options import add_reading_options, reading_options, warn_in_one_line  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402

if TYPE_CHECKING:
    from utils.events import EventReader, Events
    from utils.events.statistics import EventStatistics

_SAMPLE_SECONDS = 0.03
_MOST_SAMPLE_EVENTS = 150_000


def build_parser() -> AliasParser:
    """The command line of this script."""
    parser = AliasParser(prog="check_events.py", description=__doc__)
    parser.add_argument("input", help="event recording of any supported format")
    add_reading_options(parser)
    parser.add_argument("--picture", metavar="FILE", help="PNG to draw; default: the input's name with _events.png, "
                                                          "in the current folder")
    parser.add_argument("--no_picture", action="store_true", help="do not draw")
    parser.add_argument("--gap", type=float, default=10.0, metavar="MS", help="shortest pause that is counted [ms]")
    parser.add_argument("--json", metavar="FILE", help="also write the numbers as JSON")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Check one recording; 0 if it is sound, 1 if it needs attention."""
    options = build_parser().parse_args(argv)
    from pathlib import Path

    from devo.errors import InputError
    from utils.events import open_events_as_stored
    from utils.events.report import describe, save_picture
    from utils.events.statistics import EventStatistics

    warn_in_one_line()
    path = Path(options.input)
    with open_events_as_stored(path, **reading_options(options)) as reader:
        statistics = EventStatistics(reader.sensor_size, max(int(options.gap * 1000), 1))
        for piece in reader.chunks():
            statistics.add(piece)
        if not statistics.events:
            raise InputError(f"{path}: the file holds no events")
        losses = reader.losses
        print(path)
        for heading, sentence in describe(statistics, format_name=reader.format_name, losses=losses,
                                          size_is_known=reader.sensor_size is not None):
            print(f"  {heading:<11}{sentence}")
        if not options.no_picture:
            picture = Path(options.picture or f"{path.stem}_events.png")
            save_picture(picture, statistics, _sample(reader, statistics), f"{path.name} ({reader.format_name})")
            print(f"  {'picture':<11}{picture}")
        if options.json:
            _write_json(options.json, reader, statistics, losses)
    return 1 if statistics.backward_steps or losses else 0


def _sample(reader: EventReader, statistics: EventStatistics) -> Events:
    """Return a slice from the middle of the recording, or its first events if they are not in order."""
    if statistics.backward_steps:
        return next(reader.chunks(_MOST_SAMPLE_EVENTS))
    length = round(_SAMPLE_SECONDS * 1e6)
    middle = reader.read(*_around(statistics.first_us + statistics.duration_us // 2, length))
    if len(middle):
        return middle[:_MOST_SAMPLE_EVENTS]
    rate = statistics.rate
    busiest = statistics.first_us + int(rate.events.argmax()) * rate.bin_us
    return reader.read(*_around(busiest + rate.bin_us // 2, max(length, rate.bin_us)))[:_MOST_SAMPLE_EVENTS]


def _around(center_us: int, length_us: int) -> tuple[int, int]:
    return center_us - length_us // 2, center_us + length_us // 2 + 1


def _write_json(target: str, reader: EventReader, statistics: EventStatistics, losses: dict[str, int]) -> None:
    import json

    from utils.atomic import atomic_path

    numbers: dict[str, Any] = {
        "file": str(reader.path), "format": reader.format_name, "sensor_size": reader.sensor_size,
        "size_of_events": statistics.size, "events": statistics.events, "brighter": statistics.brighter,
        "first_us": statistics.first_us, "last_us": statistics.last_us, "backward_steps": statistics.backward_steps,
        "largest_backward_us": statistics.largest_backward_us, "gap_us": statistics.gap_us,
        "gap_count": statistics.gap_count, "longest_gaps": [gap._asdict() for gap in statistics.longest_gaps],
        "hot_pixels": [pixel._asdict() for pixel in statistics.hot_pixels()], "losses": losses,
        "rate_bin_us": statistics.rate.bin_us, "rate_events": statistics.rate.events.tolist(),
    }
    with atomic_path(target) as temporary:
        temporary.write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(run_cli(main))
