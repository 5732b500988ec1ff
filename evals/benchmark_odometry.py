#!/usr/bin/env python3
"""Where the time of a tracked frame goes: encoder, correlation, update operator, bundle adjustment, rest.

Every configuration runs in a process of its own (so that peak memory is its own) on random event voxels in the steady
state, with no keyframe removed, which is the largest edge list the settings allow. The network is untrained and its
flow revision is replaced by zero, so the solver does its full work and the geometry stays where it is. On a GPU the
stages are the times until the calls return, and what it still works on then is in the rest; MiB is GPU memory.

Example: python evals/benchmark_odometry.py --sizes 240x180 --threads 2
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

NETWORKS = {"full": "random:0:384,128,32", "small": "random:0:128,64,16"}
SETTINGS = {
    "default": {"PATCHES_PER_FRAME": 96, "REMOVAL_WINDOW": 22, "OPTIMIZATION_WINDOW": 10, "PATCH_LIFETIME": 13},
    "fast": {"PATCHES_PER_FRAME": 48, "REMOVAL_WINDOW": 16, "OPTIMIZATION_WINDOW": 7, "PATCH_LIFETIME": 11},
}
PRECISIONS = {"float32": "cpu cuda", "bfloat16": "cpu", "float16": "cuda"}
STAGES = ("encoder", "corr", "update", "ba")


def measure(
    network: str, setting: str, size: str, precision: str, threads: int, frames: int, device: str = "cpu"
) -> dict[str, Any]:
    """Time `frames` tracked frames in the steady state; returns milliseconds per frame and peak memory in MiB."""
    import warnings

    import torch

    from devo.checkpoint import load_network
    from devo.config import Config
    from devo.devo import DEVO

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    width, height = map(int, size.split("x"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        net: Any = load_network(NETWORKS[network], device=device)
    cfg = Config(SETTINGS[setting] | {"KEYFRAME_THRESH": 0.0, "MIXED_PRECISION": precision != "float32"})
    tracker = DEVO(cfg, net, evs=True, ht=height, wd=width)
    if tracker.dtype != getattr(torch, precision):
        raise SystemExit(f"this {tracker.device.type} does not run {precision}")
    update = net.update.forward

    def still(*arguments: Any, **options: Any) -> Any:
        hidden, (delta, weight, rest) = update(*arguments, **options)
        return hidden, (torch.zeros_like(delta), weight, rest)

    net.update.forward = still
    tracker.motion_probe = lambda: float("inf")  # type: ignore[method-assign]
    intrinsics = torch.tensor([0.9 * width, 0.9 * width, width / 2, height / 2])
    voxel = torch.randn(5, height, width) * (torch.rand(5, height, width) < 0.2)
    steady = cfg.REMOVAL_WINDOW + cfg.PATCH_LIFETIME
    for i in range(steady):
        tracker(float(i), voxel.roll(i, 2), intrinsics)
    tracker.timings.clear()
    on_gpu = tracker.device.type == "cuda"
    finish = torch.cuda.synchronize if on_gpu else lambda: None
    finish()
    start = time.perf_counter()
    for i in range(steady, steady + frames):
        tracker(float(i), voxel.roll(i, 2), intrinsics)
    finish()
    total = (time.perf_counter() - start) / frames * 1e3
    peak = torch.cuda.max_memory_allocated() / 1024 if on_gpu else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    row = {stage: tracker.timings[stage] / frames * 1e3 for stage in STAGES}
    return {**row, "rest": total - sum(row.values()), "total": total, "edges": len(tracker.kk),
            "peak_mib": peak / 1024}


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["240x180", "346x260", "640x480"], help="WIDTHxHEIGHT")
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=list(NETWORKS))
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--precisions", nargs="+", choices=PRECISIONS, help="default: those of the device")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:0")
    parser.add_argument("--frames", type=int, default=5, help="frames timed per configuration")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    parser.add_argument("--one", nargs=5, help=argparse.SUPPRESS)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Measure all configurations and print a Markdown table."""
    args = build_arg_parser().parse_args(argv)
    if args.one:
        network, setting, size, precision, threads = args.one
        print(json.dumps(measure(network, setting, size, precision, int(threads), args.frames, args.device)))
        return 0
    header = ["network", "settings", "size", "precision", "threads", "edges", *STAGES, "rest", "ms/frame", "fps", "MiB"]
    print("| " + " | ".join(header) + " |\n|" + "---|" * len(header), flush=True)
    rows = []
    precisions = args.precisions or [name for name, kinds in PRECISIONS.items() if args.device.split(":")[0] in kinds]
    for case in itertools.product(args.networks, args.settings, args.sizes, precisions, map(str, args.threads)):
        command = [sys.executable, __file__, "--frames", str(args.frames), "--device", args.device, "--one", *case]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            last = (done.stderr.strip().splitlines() or ["failed"])[-1]
            print("| " + " | ".join(case) + f" | {last} |", flush=True)
            continue
        row = json.loads(done.stdout)
        rows.append(dict(zip(header[:5], case, strict=True)) | row)
        numbers = [f"{row[stage]:.0f}" for stage in (*STAGES, "rest", "total")]
        print("| " + " | ".join([*case, str(row["edges"]), *numbers, f"{1e3 / row['total']:.2f}",
                                 f"{row['peak_mib']:.0f}"]) + " |", flush=True)
    if args.json:
        from utils.atomic import atomic_path

        with atomic_path(args.json) as temporary:
            temporary.write_text(json.dumps(rows, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
