#!/usr/bin/env python3
"""How fast event files are decoded and events become voxel grids, on one core.

Synthetic events are written in several formats, read again with `open_events`, and counted; then they are turned into
voxel grids. Rates are per second of processor time, so that other work on the machine disturbs them less; the best of
several repetitions counts. Bags, AEDAT4 and vectors of EVT3 take files of your own.

Example: python evals/benchmark_events.py --events 2000000 --files recording.raw
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

if TYPE_CHECKING:
    from utils.events import Events

EVENTS_PER_VOXEL_GRID = 100_000


def synthetic_events(count: int, width: int, height: int, events_per_second: float, seed: int = 0) -> Events:
    """Edges that cross the sensor: runs of events of one stamp and row, as a sensor with row readout gives them."""
    import numpy as np

    from utils.events import Events

    rng = np.random.default_rng(seed)
    runs = count // 3 + 1
    length = rng.integers(1, 6, runs)
    run = np.repeat(np.arange(runs), length)[:count]
    rank = np.arange(len(run)) - (np.cumsum(length) - length)[run]
    x = (rng.integers(0, width - 40, runs)[run] + 7 * rank).astype(np.uint16)
    t_us = np.sort(rng.integers(0, int(1e6 * count / events_per_second) + 1, runs))
    y, p = rng.integers(0, height, runs).astype(np.uint16), rng.integers(0, 2, runs).astype(np.uint8)
    return Events(x, y[run], t_us[run], p[run])


def encode_evt3(events: Events) -> bytes:
    """EVT3 words of single events; a word for time or row only where it changes."""
    import numpy as np

    t_us = events.t_us
    new_high = np.diff(t_us >> 12, prepend=-1) != 0
    new_low = new_high | (np.diff(t_us & 0xFFF, prepend=-1) != 0)
    new_row = np.diff(events.y.astype(np.int64), prepend=-1) != 0
    x_at = np.cumsum(1 + new_high + new_low + new_row) - 1
    words = np.empty(int(x_at[-1]) + 1, "<u2")
    words[x_at] = 0x2000 | events.p.astype(np.int64) << 11 | events.x
    row_at = x_at - 1
    words[row_at[new_row]] = events.y[new_row]
    low_at = row_at - new_row
    words[low_at[new_low]] = 0x6000 | t_us[new_low] & 0xFFF
    words[(low_at - new_low)[new_high]] = 0x8000 | t_us[new_high] >> 12 & 0xFFF
    return words.tobytes()


def encode_evt2(events: Events) -> bytes:
    """EVT2 words; a time word only where the time changes."""
    import numpy as np

    new_high = np.diff(events.t_us >> 6, prepend=-1) != 0
    at = np.cumsum(1 + new_high) - 1
    words = np.empty(int(at[-1]) + 1, "<u4")
    words[at] = (events.p.astype(np.int64) << 28 | (events.t_us & 63) << 22 | events.x.astype(np.int64) << 11
                 | events.y)
    words[at[new_high] - 1] = 0x80000000 | events.t_us[new_high] >> 6
    return words.tobytes()


def write_all(folder: Path, events: Events, width: int, height: int) -> list[Path]:
    """Write the events in every format; returns the files."""
    import numpy as np

    from utils.events import write_events_h5, write_events_npz, write_events_text

    geometry = f"% geometry {width}x{height}\n".encode()
    (folder / "evt3.raw").write_bytes(b"% evt 3.0\n" + geometry + encode_evt3(events))
    (folder / "evt2.raw").write_bytes(b"% evt 2.0\n" + geometry + encode_evt2(events))
    for compression in ("blosc", "none"):
        write_events_h5(folder / f"{compression}.h5", events, compression=compression)  # type: ignore[arg-type]
    write_events_npz(folder / "compressed.npz", events)
    write_events_text(folder / "events.txt", events)
    records = np.zeros(len(events), np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")]))
    records["t"], records["x"], records["y"], records["p"] = events.t_us, events.x, events.y, events.p
    np.save(folder / "records.npy", records)
    return sorted(folder.iterdir())


def best_rate(count: int, work: Callable[[], object], repetitions: int) -> float:
    """Events per second of processor time, best repetition."""
    seconds = []
    for _ in range(repetitions):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return count / max(min(seconds), 1e-9)


def decode_rates(files: Sequence[Path], repetitions: int) -> Iterator[dict[str, Any]]:
    """Yield one row per file: format, events, bytes per event, rate."""
    from utils.events import open_events

    for file in files:
        with open_events(file) as reader:
            name, count = reader.format_name, sum(len(piece) for piece in reader.chunks())

        def work(file: Path = file) -> int:
            with open_events(file) as reader:
                return sum(len(piece) for piece in reader.chunks())

        yield {"what": f"decode {name} ({file.name})", "events": count, "bytes": file.stat().st_size / count,
               "rate": best_rate(count, work, repetitions)}


def voxel_rates(events: Events, width: int, height: int, repetitions: int) -> Iterator[dict[str, Any]]:
    """Yield one row per way from events to voxel grids."""
    import numpy as np

    from utils.voxel_grid import VoxelRectifier, to_voxel_grid

    windows = [events[first:first + EVENTS_PER_VOXEL_GRID] for first in range(0, len(events), EVENTS_PER_VOXEL_GRID)]
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    rectify_map = np.stack([columns * 1.01 - 2.3, rows * 0.99 + 1.7], axis=-1)
    rectifier = VoxelRectifier(rectify_map)

    def plain(part: Events) -> object:
        return to_voxel_grid(part.x, part.y, part.t_us, part.p, height, width)

    def looked_up(part: Events) -> object:
        places = rectify_map[part.y, part.x]
        return to_voxel_grid(places[:, 0], places[:, 1], part.t_us, part.p, height, width)

    ways: list[tuple[str, Callable[[Events], object]]] = [
        ("voxel grids, raw pixels", plain), ("voxel grids, rectified by a sparse product", rectifier),
        ("voxel grids, rectified event by event", looked_up)]
    for name, way in ways:
        work = functools.partial(_apply, way, windows)
        yield {"what": name, "events": len(events), "bytes": None, "rate": best_rate(len(events), work, repetitions)}


def _apply(way: Callable[[Events], object], windows: Sequence[Events]) -> None:
    for part in windows:
        way(part)


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=1_000_000, help="synthetic events per format")
    parser.add_argument("--size", default="640x480", help="sensor as WIDTHxHEIGHT")
    parser.add_argument("--events_per_second", type=float, default=1e7, help="of the synthetic recording")
    parser.add_argument("--files", type=Path, nargs="*", default=[], help="also decode these recordings")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print a Markdown table."""
    args = build_arg_parser().parse_args(argv)
    os.environ["OMP_NUM_THREADS"] = "1"  # before torch is loaded: the claim is about one core
    import torch

    torch.set_num_threads(1)
    width, height = map(int, args.size.split("x"))
    events = synthetic_events(args.events, width, height, args.events_per_second)
    rows = []
    print("| | events | bytes/event | million events/s |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        files = [*write_all(Path(folder), events, width, height), *args.files]
        for measure in (decode_rates(files, args.repetitions), voxel_rates(events, width, height, args.repetitions)):
            for row in measure:
                rows.append(row)
                size = "" if row["bytes"] is None else f"{row['bytes']:.1f}"
                print(f"| {row['what']} | {row['events']:,} | {size} | {row['rate'] / 1e6:.1f} |", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
