#!/usr/bin/env python3
"""Does memory stay flat over a long recording? Resident memory of iterator, look-ahead, tracker and recorders.

A recording of random events is written to a temporary folder (streamed, as large as the disk allows), then read,
voxelised and tracked as `scripts/export_pointcloud.py` does; `--record` also keeps what the frame bundle and the
accumulated map need, `--edge_topk` the edge cloud. The network is untrained and small: memory over time does not depend
on what it says. With `--keyframes few` every keyframe is removed again as soon as possible, so growth beyond keyframes
shows; with `--keyframes all` none is removed.

Ctrl-C ends the recording early; the figures are then those of the frames until there.

Example: python evals/benchmark_memory.py --frames 2000 --size 640x480
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

WINDOW_US = 33_000
WARM_UP = 0.5  # share of the frames before which growth does not count: allocators settle slowly
LIMIT_MIB, LIMIT_SLOPE = 1536.0, 1.0


def write_random_recording(path: Path, width: int, height: int, frames: int, events_per_frame: int) -> None:
    """Uniform random events, the same number in every window."""
    import numpy as np

    from utils.events import make_events
    from utils.events.writers import EventH5Writer

    generator = np.random.default_rng(0)
    with EventH5Writer(path, sensor_size=(width, height)) as writer:
        for frame in range(frames):
            t_us = np.sort(generator.integers(0, WINDOW_US, events_per_frame)) + frame * WINDOW_US
            writer.write(make_events(generator.integers(0, width, events_per_frame),
                                     generator.integers(0, height, events_per_frame), t_us,
                                     generator.integers(0, 2, events_per_frame)))


def replace_encoder(network: Any) -> None:
    """Let pooled images stand in for the feature maps, which otherwise take most of the time."""
    import torch
    import torch.nn.functional as F  # noqa: N812

    def pooling(channels: int) -> Callable[[torch.Tensor], torch.Tensor]:
        def encode(images: torch.Tensor) -> torch.Tensor:
            pooled = F.avg_pool2d(images[:, :1].float(), 4, ceil_mode=True)
            return pooled.expand(-1, channels, -1, -1).contiguous()

        return encode

    network.patchify.fnet.encode = pooling(network.dim_fnet)
    network.patchify.inet.trunk = pooling(network.patchify.inet.conv2.in_channels)


def resident_mib() -> float:
    """Resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 2**20


def measure(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Track the recording; returns peak, slope and the samples."""
    import resource

    import numpy as np
    import torch

    from devo.checkpoint import load_network
    from devo.config import Config
    from devo.devo import DEVO
    from utils.datasets.prefetch import prefetch_tasks
    from utils.datasets.registry import SequenceOptions, open_sequence
    from utils.edge_clouds.edges import EdgeRecorder
    from utils.edge_clouds.settings import EdgeSettings
    from utils.eval_utils import track
    from utils.map_recorder import MapRecorder

    torch.set_num_threads(args.threads)
    width, height = map(int, args.size.split("x"))
    sequence = open_sequence("generic", folder / "events.h5", SequenceOptions(
        intrinsics=(0.9 * width, 0.9 * width, width / 2, height / 2), image_size=(width, height),
        window_ms=WINDOW_US / 1000))
    cfg = Config({"PATCHES_PER_FRAME": args.patches, "PATCH_SELECTOR": "random", "REMOVAL_WINDOW": 16,
                  "OPTIMIZATION_WINDOW": 7, "PATCH_LIFETIME": 11, "MIXED_PRECISION": False,
                  "KEYFRAME_THRESH": 0.0 if args.keyframes == "all" else 1e9})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network = load_network(args.weights, patch_selector="random")
    if args.encoder == "pooling":
        replace_encoder(network)
    recorder = MapRecorder(full_map_out=folder / "map.npy" if args.record else None)
    edges = EdgeRecorder(EdgeSettings(topk=args.edge_topk)) if args.edge_topk else None
    samples: list[tuple[int, float, int]] = []

    def on_frame(tracker: DEVO) -> None:
        if edges is not None:
            edges.on_frame(tracker)
        samples.append((tracker.counter, resident_mib(), tracker.n))

    frames = prefetch_tasks(sequence.voxel_tasks(), 1)
    start = time.perf_counter()
    # scale 0 lets every frame count as moving before initialisation, whatever the untrained network says
    result = track(frames if edges is None else edges.tap(frames), cfg, network, height=height, width=width, scale=0.0,
                   colors=True, frame_mode="final" if args.record else None, accumulate_map=args.record,
                   total=sequence.expected_length, progress=True, keep_on_interrupt=True, on_frame=on_frame,
                   on_end=recorder.on_end)
    frames.close()
    count, memory, keyframes = np.array(samples).T
    late = count > WARM_UP * count[-1]
    slope = float(np.polyfit(count[late], memory[late], 1)[0]) * 100
    return {"frames": len(result.poses), "size": args.size, "keyframes": int(keyframes[-1]),
            "fps": len(result.poses) / (time.perf_counter() - start), "rss_first_mib": float(memory[0]),
            "rss_last_mib": float(memory[-1]),
            "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "slope_mib_per_100_frames": slope, "samples": samples[::max(1, len(samples) // 50)]}


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--frames", type=int, default=2000)
    add("--size", default="640x480", help="WIDTHxHEIGHT")
    add("--events", type=int, default=24_000, help="events per frame")
    add("--keyframes", choices=("few", "all"), default="few")
    add("--patches", type=int, default=16, help="patches per frame")
    add("--record", action="store_true", help="also record the frame bundle and the accumulated map")
    add("--edge_topk", type=int, default=0, help="also record the edge cloud with so many pixels per frame")
    add("--weights", default="random:0:16,16,8")
    add("--encoder", choices=("network", "pooling"), default="network",
        help="pooling: without convolutions, several times faster; the peak then lacks their intermediate results")
    add("--threads", type=int, default=1)
    add("--json", type=Path, help="also write the figures and 50 samples (frame, MiB, keyframes) to this file")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, and exit with 1 if a limit is exceeded."""
    args = build_arg_parser().parse_args(argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        width, height = map(int, args.size.split("x"))
        write_random_recording(folder / "events.h5", width, height, args.frames, args.events)
        row = measure(args, folder)
    print(f"{row['frames']} frames of {row['size']}, {row['keyframes']} keyframes at the end, {row['fps']:.2f} fps: "
          f"resident {row['rss_first_mib']:.0f} MiB at the first frame, {row['rss_last_mib']:.0f} MiB at the last, "
          f"peak {row['peak_mib']:.0f} MiB, slope {row['slope_mib_per_100_frames']:.2f} MiB per 100 frames")
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(row, indent=1), encoding="utf-8")
    flat = args.keyframes == "all" or row["slope_mib_per_100_frames"] < LIMIT_SLOPE
    return 0 if flat and row["peak_mib"] < LIMIT_MIB else 1


if __name__ == "__main__":
    sys.exit(main())
