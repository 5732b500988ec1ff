#!/usr/bin/env python3
"""How fast EMVS votes: million event-plane votes per second, against plain NumPy in the same run.

All implementations start from the same rays (where events cross the canonical plane) and end with the same votes,
which is checked. `add.at` is what one writes first: packet by packet `np.add.at(dsi, (planes, rows, columns), weight)`,
once for each of the four pixels. The others go plane by plane through all packets: `add.at by plane` with two indices,
`add.at flat` with one, `bincount` instead of it. Every figure is the best of several runs. The machine should be
idle; where it is not, the column per CPU second is the fairer one for a single thread.

Example: python evals/benchmark_emvs.py --sizes 240x180 --threads 1 2
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

PACKET = 1024
PLAIN_PACKETS = 4
REFERENCE_PLANES = 5
LARGEST_DIFFERENCE = 1e-2  # votes; positions are float32 here and float64 there, voxels hold up to some hundred votes


def make_rays(width: int, height: int, events: int, planes: int) -> Any:
    """Random events of a camera that moves sideways and turns a little, as packets on the canonical plane."""
    import torch
    from scipy.spatial.transform import Rotation

    from utils.emvs.geometry import DepthPlanes, VirtualCamera, packet_rays

    rng = np.random.default_rng(0)
    packets = events // PACKET
    share = np.linspace(-1, 1, packets)
    rv_T_ev = np.tile(np.eye(4), (packets, 1, 1))
    rv_T_ev[:, :3, :3] = Rotation.from_rotvec(np.outer(share, [0.02, 0.05, 0.03])).as_matrix()
    rv_T_ev[:, :3, 3] = np.outer(share, [0.1, 0.05, 0.04])
    pixels = torch.from_numpy(rng.random((packets, PACKET, 2)) * [width - 1, height - 1])
    camera = VirtualCamera(width, height, 0.9 * width, width / 2, height / 2)
    return packet_rays(pixels, torch.ones(packets, PACKET, dtype=torch.bool), rv_T_ev,
                       [0.9 * width, 0.9 * width, width / 2, height / 2], camera, DepthPlanes(0.5, 3.0, planes).depths)


def plain_votes(rays: Any, dsi: np.ndarray, packets: int) -> None:
    """Add the bilinear votes of the first packets to `dsi` (P, H, W), packet by packet, all planes at once."""
    height, width = dsi.shape[1:]
    gain, offset_u, offset_v, u, v = (values.numpy().astype(np.float64) for values in
                                      (rays.gain, rays.offset_u, rays.offset_v, rays.u, rays.v))
    for k in range(packets):
        x = (gain[:, k, None] * u[k] + offset_u[:, k, None] + 1) * (0.5 * (width - 1))
        y = (gain[:, k, None] * v[k] + offset_v[:, k, None] + 1) * (0.5 * (height - 1))
        left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        inside = (left >= 0) & (top >= 0) & (left + 1 < width) & (top + 1 < height)
        plane = np.nonzero(inside)[0]
        left, top = left[inside], top[inside]
        a, b = x[inside] - left, y[inside] - top
        np.add.at(dsi, (plane, top, left), (1 - a) * (1 - b))
        np.add.at(dsi, (plane, top, left + 1), a * (1 - b))
        np.add.at(dsi, (plane, top + 1, left), (1 - a) * b)
        np.add.at(dsi, (plane, top + 1, left + 1), a * b)


def numpy_votes(kind: str, rays: Any, dsi: np.ndarray, planes: Sequence[int]) -> None:
    """Add the bilinear votes on the given planes to `dsi` (len(planes), H, W) float64, one plane after the other."""
    height, width = dsi.shape[1:]
    u, v = rays.u.numpy().astype(np.float64), rays.v.numpy().astype(np.float64)
    for slot, plane in enumerate(planes):
        gain, offset_u, offset_v = (values[plane].numpy()[:, None] for values in
                                    (rays.gain, rays.offset_u, rays.offset_v))
        x = ((gain * u + offset_u).ravel() + 1) * (0.5 * (width - 1))
        y = ((gain * v + offset_v).ravel() + 1) * (0.5 * (height - 1))
        left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        inside = (left >= 0) & (top >= 0) & (left + 1 < width) & (top + 1 < height)
        left, top = left[inside], top[inside]
        a, b = x[inside] - left, y[inside] - top
        for dx, dy, weight in ((0, 0, (1 - a) * (1 - b)), (1, 0, a * (1 - b)), (0, 1, (1 - a) * b), (1, 1, a * b)):
            if kind == "add.at by plane":
                np.add.at(dsi[slot], (top + dy, left + dx), weight)
            elif kind == "add.at flat":
                np.add.at(dsi[slot].reshape(-1), (top + dy) * width + left + dx, weight)
            else:
                cells = (top + dy) * width + left + dx
                dsi[slot] += np.bincount(cells, weight, minlength=height * width).reshape(height, width)


def torch_votes(vote: str, blocks: Sequence[Any], dsi: Any) -> None:
    """Add all votes to the tensor `dsi` (P, H, W) as the mapper does, block by block."""
    from utils.emvs.voting import cast_votes

    for rays in blocks:
        cast_votes(dsi, rays, vote)  # type: ignore[arg-type]


def speeds(work: Callable[[], Any], votes: int, repeats: int) -> dict[str, float]:
    """Million votes per second of wall time and of CPU time, each the best of a few runs."""
    wall, cpu = [], []
    for _ in range(repeats):
        start = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    return {"mvotes_per_s": votes / min(wall) / 1e6, "mvotes_per_cpu_s": votes / min(cpu) / 1e6}


def split_blocks(rays: Any, packets: int) -> list[Any]:
    """The rays in blocks of so many packets."""
    from utils.emvs.geometry import PacketRays

    return [PacketRays(rays.u[k:k + packets], rays.v[k:k + packets], rays.side[k:k + packets],
                       rays.gain[:, k:k + packets].contiguous(), rays.offset_u[:, k:k + packets].contiguous(),
                       rays.offset_v[:, k:k + packets].contiguous(), rays.ahead[:, k:k + packets].contiguous())
            for k in range(0, len(rays.u), packets)]


def measure(size: str, events: int, planes: int, threads: Sequence[int], repeats: int) -> list[dict[str, Any]]:
    """Rows with the speeds of all implementations for one sensor size.

    Raises:
        SystemExit: two implementations disagree about the votes.
    """
    import torch

    from utils.emvs.voting import block_packets

    width, height = map(int, size.split("x"))
    events = events // PACKET * PACKET
    rays = make_rays(width, height, events, planes)
    blocks = split_blocks(rays, block_packets(PACKET, width * height, torch.device("cpu")))
    chosen = np.linspace(0, planes - 1, min(REFERENCE_PLANES, planes)).astype(int).tolist()
    dsi, few = torch.zeros(planes, height, width), np.zeros((len(chosen), height, width))
    all_planes = np.ones((planes, height, width), np.float32)  # written, so that the memory is there
    numpy_votes("bincount", rays, few, chosen)
    torch_votes("bilinear", blocks, dsi)
    inner = (slice(None), slice(1, -1), slice(1, -1))  # rays on the rim are in or out by rounding
    difference = float(np.abs(dsi.numpy()[chosen] - few)[inner].max())
    if not difference < LARGEST_DIFFERENCE:
        raise SystemExit(f"{size}: the votes differ by {difference}")
    rows: list[dict[str, Any]] = [{
        "size": size, "implementation": "numpy add.at", "vote": "bilinear", "threads": 1,
        **speeds(lambda: plain_votes(rays, all_planes, PLAIN_PACKETS), PLAIN_PACKETS * PACKET * planes, repeats)}]
    for kind in ("add.at by plane", "add.at flat", "bincount"):
        found = speeds(lambda kind=kind: numpy_votes(  # type: ignore[misc]
            kind, rays, few, chosen), events * len(chosen), repeats)
        rows.append({"size": size, "implementation": f"numpy {kind}", "vote": "bilinear", "threads": 1, **found})
    for vote in ("bilinear", "nearest"):
        for count in threads:
            torch.set_num_threads(count)
            found = speeds(lambda vote=vote: torch_votes(  # type: ignore[misc]
                vote, blocks, dsi), events * planes, repeats)
            rows.append({"size": size, "implementation": "utils.emvs", "vote": vote, "threads": count, **found})
    for row in rows:
        row["times_add_at"] = row["mvotes_per_s"] / rows[0]["mvotes_per_s"]
        row["times_add_at_cpu"] = row["mvotes_per_cpu_s"] / rows[0]["mvotes_per_cpu_s"]
        row["largest_difference_votes"] = difference
    return rows


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["240x180", "640x480"], help="WIDTHxHEIGHT of the sensor")
    parser.add_argument("--events", type=int, default=65_536, help="events; short runs find a quiet moment more easily")
    parser.add_argument("--planes", type=int, default=100, help="depth planes (NumPy does five of them)")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=15, help="the best of so many runs counts")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print a Markdown table."""
    args = build_arg_parser().parse_args(argv)
    header = ("sensor", "implementation", "vote", "threads", "M votes/s", "x add.at", "per CPU second", "x add.at")
    print("| " + " | ".join(header) + " |\n|" + "---|" * len(header), flush=True)
    rows = []
    for size in args.sizes:
        for row in measure(size, args.events, args.planes, args.threads, args.repeats):
            rows.append(row)
            print(f"| {size} | {row['implementation']} | {row['vote']} | {row['threads']} | "
                  f"{row['mvotes_per_s']:.2f} | {row['times_add_at']:.1f} | {row['mvotes_per_cpu_s']:.2f} | "
                  f"{row['times_add_at_cpu']:.1f} |", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
