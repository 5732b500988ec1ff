#!/usr/bin/env python3
"""Times of the kernels on problems as the tracker has them: torch twin on the CPU and on CUDA, CUDA kernels.

`tiny` is the size of the built-in network (64 channels, 96 patches per frame, maps of 80x60 pixels), `full` that of the
published one on a 640x480 sensor (128 channels, maps of 160x120). Rows are the two pyramid levels of the correlation,
its gradient on the finer one, patch extraction, reprojection, neighbours and two iterations of bundle adjustment; the
figures are medians in milliseconds. What is not available (no GPU, kernels not built) is left out.

Example: python evals/benchmark_kernels.py --problems full --repeats 50 --json results/kernels.json
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


class Size(NamedTuple):
    """One problem: network, maps and graph."""

    channels: int
    height: int
    width: int
    patches_per_frame: int
    keyframes: int  # in the window of the graph
    edges: int


SIZES = {"tiny": Size(64, 60, 80, 96, 12, 5_000), "full": Size(128, 120, 160, 96, 22, 10_000)}
RADIUS, PATCH = 3, 3


@contextlib.contextmanager
def kernels(mode: str) -> Iterator[None]:
    """`DEVO_KERNELS` set to `mode`."""
    before = os.environ.get("DEVO_KERNELS")
    os.environ["DEVO_KERNELS"] = mode
    try:
        yield
    finally:
        if before is None:
            del os.environ["DEVO_KERNELS"]
        else:
            os.environ["DEVO_KERNELS"] = before


def operations(size: Size, device: Any, dtype: Any) -> dict[str, Callable[[], Any]]:
    """What is timed, with all operands on the device."""
    import torch

    from devo import fastba
    from devo.altcorr import corr, patchify

    source = torch.Generator().manual_seed(0)
    frames, per_frame, edges = size.keyframes, size.patches_per_frame, size.edges

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=source)

    count = frames * per_frame
    kk = torch.randint(0, count, (edges,), generator=source)
    jj, ii = torch.randint(0, frames, (edges,), generator=source), kk // per_frame
    poses = torch.cat((0.1 * uniform(1, frames, 3), 0.02 * uniform(1, frames, 3), torch.ones(1, frames, 1)), 2)
    poses[..., 3:] /= poses[..., 3:].norm(dim=-1, keepdim=True)
    centre = torch.stack((uniform(count) * size.width, uniform(count) * size.height), 1).floor()
    offset = torch.stack(torch.meshgrid(torch.arange(-1, 2), torch.arange(-1, 2), indexing="xy"))
    patches = torch.cat((centre[:, :, None, None] + offset,
                         (0.2 + 0.8 * uniform(count, 1, 1, 1)).expand(-1, -1, PATCH, PATCH)), 1)[None]
    intrinsics = torch.tensor([size.width, size.width, size.width / 2, size.height / 2]).expand(1, frames, 4).float()
    with kernels("torch"):
        coords = fastba.reproject(poses, patches, intrinsics, ii, jj, kk)
    target = coords[..., PATCH // 2, PATCH // 2] + uniform(1, edges, 2) - 0.5
    weight = uniform(1, edges, 2)
    # maps are stored channels last, as the tracker does
    maps = [torch.randn(frames, size.height // n, size.width // n, size.channels, generator=source)
            .to(device, dtype).permute(0, 3, 1, 2)[None] for n in (1, 4)]
    gmap = torch.randn(1, count, size.channels, PATCH, PATCH, generator=source).to(device, dtype)
    places = torch.stack((uniform(1, per_frame) * size.width, uniform(1, per_frame) * size.height), 2).to(device)
    ii, jj, kk, coords, poses, patches, intrinsics, target, weight = (
        tensor.to(device).contiguous() for tensor in (ii, jj, kk, coords, poses, patches, intrinsics, target, weight))
    damping = torch.tensor([1e-4], device=device)
    learned = gmap.clone().requires_grad_(), maps[0].clone().requires_grad_()

    def gradient() -> None:
        out = corr(learned[0], learned[1], coords, kk, jj, RADIUS)
        torch.autograd.grad(out, learned, out.detach())

    def adjust() -> None:
        fastba.BA(poses.clone(), patches.clone(), intrinsics, target, weight, damping, ii, jj, kk,
                  max(1, frames - 10), frames, 2, image_size=(size.height, size.width), accurate=True)

    return {
        "corr, level 1": lambda: corr(gmap, maps[0], coords, kk, jj, RADIUS),
        "corr, level 4": lambda: corr(gmap, maps[1], coords / 4, kk, jj, RADIUS),
        "corr, level 1, forward and backward": gradient,
        "patchify": lambda: patchify(maps[0][0, :1], places, PATCH // 2),
        "reproject": lambda: fastba.reproject(poses, patches, intrinsics, ii, jj, kk),
        "neighbors": lambda: fastba.neighbors(kk, jj),
        "ba, 2 iterations": adjust,
    }


def median_ms(call: Callable[[], Any], device: Any, repeats: int, budget: float) -> float:
    """Median time of a call [ms], by CUDA events on a GPU; stops after `budget` seconds."""
    import torch

    cuda = device.type == "cuda"
    for _ in range(3 if cuda else 1):
        call()
    times, start = [], time.perf_counter()
    for _ in range(repeats):
        if cuda:
            first, last = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            torch.cuda.synchronize(device)
            first.record()
            call()
            last.record()
            torch.cuda.synchronize(device)
            times.append(first.elapsed_time(last))
        else:
            before = time.perf_counter()
            call()
            times.append(1e3 * (time.perf_counter() - before))
        if time.perf_counter() - start > budget:
            break
    return statistics.median(times)


def measure(args: argparse.Namespace) -> list[dict[str, Any]]:
    """One row for each problem and operation, with a column for each implementation that is available."""
    import torch

    from devo.kernels import active_kernels

    dtype = getattr(torch, args.dtype)
    wanted = {"cpu": ["cpu"], "cuda": ["cuda"], "all": ["cpu", "cuda"]}[args.device]
    columns = []
    for name in wanted:
        if name == "cuda" and not torch.cuda.is_available():
            print("benchmark_kernels: no CUDA device", file=sys.stderr)
            continue
        columns.append((f"twin on {name}", name, "torch"))
        with kernels("auto"):
            built = active_kernels()
        if name == "cuda" and "torch" in built.values():
            print(f"benchmark_kernels: the CUDA kernels are not all built ({built})", file=sys.stderr)
        elif name == "cuda":
            columns.append(("kernels", name, "cuda"))
    rows: list[dict[str, Any]] = []
    for problem in args.problems:
        found: dict[str, dict[str, Any]] = {}
        for column, name, mode in columns:
            device = torch.device(name)
            with kernels(mode):
                for operation, call in operations(SIZES[problem], device, dtype).items():
                    row = found.setdefault(operation, {"problem": problem, "operation": operation})
                    row[column] = median_ms(call, device, args.repeats, args.seconds)
        rows += found.values()
    return rows


def print_table(rows: list[dict[str, Any]]) -> None:
    """Markdown, milliseconds."""
    names = [name for name in rows[0] if name not in ("problem", "operation")]
    print(f"| problem | operation | {' | '.join(f'{name} [ms]' for name in names)} |")
    print(f"| --- | --- |{' ---: |' * len(names)}")
    for row in rows:
        print(f"| {row['problem']} | {row['operation']} | {' | '.join(f'{row[name]:.3f}' for name in names)} |")


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--device", choices=["cpu", "cuda", "all"], default="all")
    add("--problems", nargs="+", choices=list(SIZES), default=list(SIZES))
    add("--dtype", choices=["float32", "float16", "bfloat16"], default="float32", help="of the maps")
    add("--repeats", type=int, default=30)
    add("--seconds", type=float, default=2.0, help="limit of the repeats of one operation")
    add("--threads", type=int, help="of torch on the CPU; default: as torch chooses")
    add("--json", type=Path, help="also write the figures here")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print a Markdown table and write JSON if wanted."""
    args = build_arg_parser().parse_args(argv)
    import torch

    if args.threads:
        torch.set_num_threads(args.threads)
    rows = measure(args)
    if not rows or len(rows[0]) == 2:
        print("benchmark_kernels: nothing to measure on this machine; try --device cpu", file=sys.stderr)
        return 2
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    about = {"gpu": gpu, "cpu threads": torch.get_num_threads(), "torch": torch.__version__, "maps": args.dtype}
    print("; ".join(f"{name}: {value}" for name, value in about.items()), end="\n\n")
    print_table(rows)
    if args.json:
        from utils.atomic import atomic_path

        with atomic_path(args.json) as temporary:
            temporary.write_text(json.dumps(about | {"rows": rows}, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
