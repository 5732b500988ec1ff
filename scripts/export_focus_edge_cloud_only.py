#!/usr/bin/env python3
"""Make the focus-refined edge cloud of a recording that was tracked before, from its frame bundle.

Example: python scripts/export_focus_edge_cloud_only.py --datapath board --frames_npz board_frames.npz --out edges.ply

The bundle comes from export_pointcloud.py --export_frame_data; read the recording with the same window options.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.edge_options import add_focus_options  # noqa: E402
from scripts.recording_options import add_recording_options, open_recording  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="export_focus_edge_cloud_only.py", description=__doc__)
    add = parser.add_argument
    add("--frames_npz", required=True, help="frame bundle of the run: <base>_frames.npz")
    add("--out", required=True, help="the cloud; .ply and .npz also keep depth, score and confidence of each point")
    add("--device", default="auto", help="auto, cpu, cuda or cuda:0")
    add("--cache_dtype", choices=("fp16", "fp32"), default="fp16", help="type in which event images wait")
    add("--progress_every", type=int, default=1, help="frames between updates of the progress bar, 0 = no bar")
    add_recording_options(parser)
    add_focus_options(parser.add_argument_group("edges and focus"))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    import contextlib

    import torch

    from devo.device import resolve_device
    from utils.clouds.io import write_cloud
    from utils.datasets.prefetch import prefetch_tasks
    from utils.edge_clouds.run import collect_focus_cloud
    from utils.edge_clouds.settings import FocusSettings
    from utils.export_options import settings_from
    from utils.export_products import cloud_file
    from utils.frame_bundle import read_frame_bundle

    out = cloud_file(args.out, "--out")
    settings = settings_from(FocusSettings, "focus", vars(args))
    bundle = read_frame_bundle(args.frames_npz)
    recording = open_recording(args)
    dtype = torch.float16 if args.cache_dtype == "fp16" else torch.float32
    with contextlib.closing(prefetch_tasks(recording.voxel_tasks(), 1)) as frames:
        cloud = collect_focus_cloud(frames, bundle, settings, resolve_device(args.device), image_dtype=dtype,
                                    progress_every=max(args.progress_every, 0))
    write_cloud(out, cloud)
    print(f"{out}: {len(cloud)} points of {len(bundle)} frames")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
