#!/usr/bin/env python3
"""How fast networks train: clips a second of the simulator, and of steps with and without the adjustment loop.

The simulator makes clips as training does; steps run on clips already there, so that the two can be compared: each clip
is used several times, and whichever is slower decides.

Example: python evals/benchmark_training.py --clips 1 4
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--preset", default="tiny", help="network and training settings (default: %(default)s)")
    add("--device", default="auto", help="auto, cpu, cuda or cuda:0 (default: %(default)s)")
    add("--precision", default="float32", choices=("float32", "bfloat16", "float16"))
    add("--clips", type=int, nargs="+", default=[1, 4], help="batch sizes (default: %(default)s)")
    add("--frames", type=int, default=10, help="per clip (default: %(default)s)")
    add("--updates", type=int, default=12, help="per step (default: %(default)s)")
    add("--patches", type=int, default=24, help="per frame (default: %(default)s)")
    add("--size", default="128x160", help="HEIGHTxWIDTH of a clip (default: %(default)s)")
    add("--repeats", type=int, default=3, help="steps of each kind that are timed (default: %(default)s)")
    add("--simulate", type=int, default=4, help="clips that are simulated (default: %(default)s)")
    add("--simulate_on", default="cpu", help="device of the simulator (default: %(default)s)")
    add("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write the figures there, too")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print a Markdown table."""
    args = build_arg_parser().parse_args(argv)
    import torch

    from devo.device import resolve_device
    from devo.errors import DevoError

    torch.set_num_threads(args.threads)
    try:
        device = resolve_device(args.device)
        clips, simulated = simulate(args)
        made = f"{args.frames} frames {args.size}"
        print(f"simulator on {args.simulate_on}: {simulated:.2f} clips/s of {made}", flush=True)
        print("\n| clips a step | matching alone, ms | with the loop, ms | clips/s, one of three with the loop |")
        print("|---|---|---|---|", flush=True)
        rows = [time_steps(args, count, clips, device) for count in args.clips]
    except DevoError as error:
        print(f"benchmark_training: {error}", file=sys.stderr)
        return error.exit_code
    if args.json:
        from utils.atomic import atomic_path

        with atomic_path(args.json) as temporary:
            temporary.write_text(json.dumps({"simulated_clips_per_s": simulated, "steps": rows}, indent=2) + "\n")
    return 0


def simulate(args: argparse.Namespace) -> tuple[Any, float]:
    """Training clips, and how many a second the simulator makes (textures painted before)."""
    import torch

    from devo.device import resolve_device
    from utils.training.launch import size_of
    from utils.training.simulated import sampled_clips

    device = resolve_device(args.simulate_on)

    def sample(count: int, seed: int) -> Any:
        generator = torch.Generator().manual_seed(seed)
        return sampled_clips(count, args.frames, *size_of(args.size), generator=generator, device=device)

    sample(1, 0)
    seconds, clips = timed(lambda: sample(args.simulate, 1), device)
    return clips.with_unit_depth(), args.simulate / seconds


def time_steps(args: argparse.Namespace, count: int, clips: Any, device: Any) -> dict[str, float]:
    """Time optimiser steps with so many clips; prints and returns one row."""
    import torch

    from devo.enet import eVONet
    from utils.training.settings import TrainSettings
    from utils.training.trainer import RunSettings, Trainer

    settings = TrainSettings.from_preset(
        args.preset,
        clips=count,
        frames=args.frames,
        initial_frames=min(8, args.frames),
        updates=args.updates,
        patches=args.patches,
        precision=args.precision,
        match_gradient_every=3,
        unroll_every=2,
    )
    batch = clips.clips(torch.arange(count) % len(clips.voxels))

    class Repeated:
        """The same batch in every step."""

        def batch(self, step: int) -> Any:
            return batch

        def close(self) -> None:
            pass

    network = eVONet(**settings.network_arguments()).to(device)
    trainer = Trainer(network, settings, RunSettings(Path()), Repeated())
    seconds: dict[int, list[float]] = {0: [], 1: []}
    for number in range(2 + 2 * args.repeats):
        spent, _ = timed(trainer.train_step, device)
        if number >= 2:
            seconds[number % 2].append(spent)
    loop, matching = (1000 * statistics.median(seconds[kind]) for kind in (0, 1))
    rate = 3000 * count / (loop + 2 * matching)
    print(f"| {count} | {matching:.0f} | {loop:.0f} | {rate:.2f} |", flush=True)
    return {"clips": count, "matching_ms": matching, "loop_ms": loop, "clips_per_s": rate}


def timed(call: Callable[[], Any], device: Any) -> tuple[float, Any]:
    """Seconds until the device has finished, and the result."""
    import torch

    def finished() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    start = finished()
    result = call()
    return finished() - start, result


if __name__ == "__main__":
    sys.exit(main())
