#!/usr/bin/env python3
"""What decoding and voxelising ahead of the tracker saves: milliseconds per frame by number of worker threads.

A recording of random events is read and voxelised while a stand-in for the tracker works for a fixed time per frame:
`wait` sleeps, as a tracker on a GPU lets this process wait, `compute` multiplies matrices in one thread of the CPU.
Runs alternate, and the medians are printed.

Example: python evals/benchmark_prefetch.py --size 640x480 --events 500000
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def trackers(milliseconds: float) -> dict[str, Callable[[], None]]:
    """Stand-ins that take about so long per frame on an idle machine."""
    import torch

    matrix = torch.randn(512, 512)
    start = time.perf_counter()
    for _ in range(20):
        matrix @ matrix
    rounds = max(1, round(milliseconds / 1e3 / ((time.perf_counter() - start) / 20)))

    def compute() -> None:
        for _ in range(rounds):
            matrix @ matrix

    return {"wait": lambda: time.sleep(milliseconds / 1e3), "compute": compute}


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--frames", type=int, default=20)
    add("--size", default="640x480", help="WIDTHxHEIGHT")
    add("--events", type=int, default=500_000, help="events per frame")
    add("--tracker_ms", type=float, default=100.0, help="work of the tracker per frame [ms]")
    add("--workers", type=int, nargs="+", default=[0, 1, 2])
    add("--repeats", type=int, default=3)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print a Markdown table."""
    args = build_arg_parser().parse_args(argv)
    import torch

    from evals.benchmark_memory import WINDOW_US, write_random_recording
    from utils.datasets.prefetch import prefetch_tasks
    from utils.datasets.registry import SequenceOptions, open_sequence

    torch.set_num_threads(1)
    width, height = map(int, args.size.split("x"))
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "events.h5"
        write_random_recording(path, width, height, args.frames, args.events)
        options = SequenceOptions(intrinsics=(width, width, width / 2, height / 2), image_size=(width, height),
                                  window_ms=WINDOW_US / 1000)

        def seconds_per_frame(workers: int, work: Callable[[], None]) -> float:
            sequence = open_sequence("generic", path, options)
            start = time.perf_counter()
            for _ in prefetch_tasks(sequence.voxel_tasks(), workers):
                work()
            return (time.perf_counter() - start) / args.frames

        print("| tracker | " + " | ".join(f"{n} workers [ms/frame]" for n in args.workers) + " |")
        print("|---" * (1 + len(args.workers)) + "|")
        for kind, work in {"none": lambda: None, **trackers(args.tracker_ms)}.items():
            rows = [[seconds_per_frame(n, work) for n in args.workers] for _ in range(args.repeats)]
            medians = [statistics.median(column) for column in zip(*rows, strict=True)]
            print(f"| {kind} | " + " | ".join(f"{1e3 * value:.0f}" for value in medians) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
