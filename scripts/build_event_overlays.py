#!/usr/bin/env python3
"""Draw the points of a run over the events around its frames, and measure how well they lie on them.

Example: python scripts/build_event_overlays.py --frames results/board_frames.npz --scene datasets/board --out overlays

Writes overlays.png (a sheet of evenly spaced frames) and overlays.json. Red are the points that a frame hosts, blue
those of neighbouring frames, which only lie on the events if poses and depths are right. The score is the event density
under the points over the mean density: 1 = as if scattered at random.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.recording_options import add_recording_options, open_recording  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="build_event_overlays.py", description=__doc__)
    add = parser.add_argument
    add("--frames", required=True, help="frame bundle of the run: <base>_frames.npz")
    add("--out", required=True, help="folder of the pictures")
    add("--window-us", type=float, help="events within half of this of a frame (default: distance of the frames) [us]")
    add("--max-frames", type=int, default=0, help="at most this many frames, evenly spaced, 0 = all")
    add("--neighbors", type=int, default=4, help="also project the points of so many frames on each side")
    add("--res-scale", type=float, default=4.0, help="from the intrinsics of the bundle to full resolution")
    add("--sheet", type=int, default=16, help="pictures on the sheet")
    add("--singles", action="store_true", help="write every picture as overlays/overlay_%%05d.png too")
    add("--npz", action="store_true", help="write event image, voxel grid and pixels as npz_frames/frame_%%05d.npz too")
    add_recording_options(parser, "--scene")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    import numpy as np
    from tqdm import tqdm

    from devo.errors import InputError
    from utils.export_products import save_json
    from utils.frame_bundle import read_frame_bundle
    from utils.overlays import build_overlays, contact_sheet, draw_overlay, write_arrays, write_png

    if args.sheet < 1:
        raise InputError(f"--sheet is {args.sheet}; expected at least 1 picture")
    out = Path(args.out)
    bundle = read_frame_bundle(args.frames)
    recording = open_recording(args)
    total = min(args.max_frames or len(bundle), len(bundle))
    shown = set(np.linspace(0, total - 1, min(args.sheet, total)).round().astype(int).tolist())
    pictures, rows = [], []
    overlays = build_overlays(recording, bundle, window_us=args.window_us, max_frames=args.max_frames,
                              neighbors=args.neighbors, res_scale=args.res_scale)
    for number, overlay in enumerate(tqdm(overlays, total=total, unit="frame", desc="overlays")):
        rows.append({"frame_id": overlay.frame_id, "t_us": overlay.t_us, "points": len(overlay.own),
                     "neighbor_points": len(overlay.others), "score": _number(overlay.own_score),
                     "neighbor_score": _number(overlay.others_score)})
        if number in shown:
            pictures.append(draw_overlay(overlay))
        if args.singles:
            write_png(out / "overlays" / f"overlay_{overlay.frame_id:05d}.png", draw_overlay(overlay, label=False))
        if args.npz:
            write_arrays(out / "npz_frames" / f"frame_{overlay.frame_id:05d}.npz", overlay, recording.height,
                         recording.width)
    medians = {key: _median([row[key] for row in rows]) for key in ("score", "neighbor_score")}
    write_png(out / "overlays.png", contact_sheet(pictures))
    save_json(out / "overlays.json", {"frames": str(args.frames), "scene": str(args.datapath), **medians,
                                      "frames_without_events": total - len(rows), "rows": rows})
    print(f"{out / 'overlays.png'}: {len(rows)} frames; event density under the points over the mean: "
          f"own {medians['score']}, neighbours' {medians['neighbor_score']} (1 = random)")
    return 0


def _number(value: float) -> float | None:
    return round(value, 4) if value == value else None


def _median(values: list[float | None]) -> float | None:
    from statistics import median

    known = [value for value in values if value is not None]
    return round(median(known), 3) if known else None


if __name__ == "__main__":
    sys.exit(run_cli(main))
