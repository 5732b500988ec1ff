#!/usr/bin/env python3
"""Check a recording without ground truth: tracked backwards in time, it must give the mirrored trajectory.

Every event window is tracked once in order and once in reverse order, with time running backwards inside the windows
and polarities flipped: what a camera would have seen on the way back. The second trajectory, reversed and aligned to
the first one (Sim3), differs from it by the errors of both runs. The check says nothing about errors that both share.

Example: python evals/forward_backward.py --datapath walk.npz --intrinsics 115 115 63.5 63.5 --image_size 128 128 \\
    --window_events 8000
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above

if TYPE_CHECKING:
    import numpy as np

    from devo.config import Config
    from utils.datasets.sequence import Frame


@dataclass(frozen=True)
class Agreement:
    """How well the two runs agree.

    Attributes:
        forward, backward: status of the runs.
        frames: number of windows with a pose in both runs.
        path_length: of the forward run, trajectory units.
        position_share: rms distance of the aligned positions over `path_length`; NaN where a run failed.
        scale: of the alignment, forward units per backward unit.
        rotation_deg: median angle between the orientations after alignment.
    """

    forward: str
    backward: str
    frames: int = 0
    path_length: float = float("nan")
    position_share: float = float("nan")
    scale: float = float("nan")
    rotation_deg: float = float("nan")


def reversed_frames(frames: list[Frame]) -> list[Frame]:
    """The stream that the same camera would have produced on the way back.

    Args:
        frames: list of `(voxel grid (5,H,W), intrinsics (4,), t_us)` in time order. A grid's bins are placed between
            its first and last event, so reversing time reverses the bins; brighter becomes darker.

    Returns:
        A list of the same kind whose stamps run from 0 and keep their distances.
    """
    end_us = frames[-1][2] if frames else 0.0
    return [(-voxel.flip(0), intrinsics, end_us - t_us) for voxel, intrinsics, t_us in reversed(frames)]


def compare(t_us: np.ndarray, world_T_cam: np.ndarray, back_t_us: np.ndarray, back_world_T_cam: np.ndarray,
            end_us: float) -> Agreement:
    """Align the backward run to the forward one and measure what is left.

    Args:
        t_us: (T,) stamps of the forward run; world_T_cam: (T,7) its poses.
        back_t_us: (S,) stamps of the backward run, counted from the end; back_world_T_cam: (S,7) its poses.
        end_us: stamp of the forward clock where the backward clock is 0.

    Raises:
        InputError: fewer than 3 windows have a pose in both runs.
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from devo.errors import InputError
    from evals.alignment import aligned_path_share

    common, first, second = np.intersect1d(np.round(t_us), np.round(end_us - back_t_us), return_indices=True)
    if len(common) < 3:
        raise InputError(f"{len(common)} windows have a pose in both directions, expected at least 3; use shorter "
                         "windows or a longer recording")
    forth, back = world_T_cam[first].astype(np.float64), back_world_T_cam[second].astype(np.float64)
    share, length, alignment = aligned_path_share(back[:, :3], forth[:, :3])
    turned = Rotation.from_matrix(alignment.rotation) * Rotation.from_quat(back[:, 3:])
    angle = (turned.inv() * Rotation.from_quat(forth[:, 3:])).magnitude()
    return Agreement("tracked", "tracked", len(common), length, share, alignment.scale,
                     float(np.degrees(np.median(angle))))


def check(frames: list[Frame], cfg: Config, network: Any, seed: int = 0) -> Agreement:
    """Track `frames` in both directions and compare; a failed run gives an `Agreement` of NaNs with its status."""
    from utils.eval_utils import track

    forth = track(frames, cfg, network, seed=seed)
    back = track(reversed_frames(frames), cfg, network, seed=seed)
    if not (forth.ok and back.ok):
        return Agreement(forth.status.value, back.status.value)
    return compare(forth.tstamps, forth.poses, back.tstamps, back.poses, frames[-1][2])


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="forward_backward.py", description=__doc__)
    add = parser.add_argument
    add("--datapath", required=True, help="sequence folder, or an event file for --dataset generic")
    add("--dataset", default="generic", help="how to read it")
    add("--weights", help="checkpoint or name of built-in weights (default: the built-in ones)")
    add("--config", help="settings as YAML (default: preset of the weights or data set)")
    add("--opts", nargs="+", metavar="KEY VALUE", default=[], help="override settings")
    add("--trials", type=int, default=1, help="seeds to try")
    add("--window_ms", type=float, help="length of the event windows [ms]")
    add("--window_events", type=int, help="events per window")
    add("--start_us", type=float, help="first time [us]")
    add("--stop_us", type=float, help="last time [us]")
    add("--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="pinhole camera [px]")
    add("--image_size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="sensor size [px]")
    add("--most_frames", type=int, default=600, help="windows held in memory at the most")
    add("--json", type=Path, help="also write the figures to this file")
    return parser


def read_frames(args: argparse.Namespace) -> list[Frame]:
    """All windows of the recording as a list.

    Raises:
        InputError: unusable recording, or more windows than `--most_frames`.
    """
    import itertools

    from devo.errors import InputError
    from utils.datasets.registry import SequenceOptions, open_sequence

    options = SequenceOptions(start_us=args.start_us, stop_us=args.stop_us, window_ms=args.window_ms,
                              window_events=args.window_events,
                              image_size=tuple(args.image_size) if args.image_size else None,
                              intrinsics=tuple(args.intrinsics) if args.intrinsics else None)
    stream = open_sequence(args.dataset, args.datapath, options).voxels()
    frames = list(itertools.islice(stream, args.most_frames + 1))
    if len(frames) > args.most_frames:
        raise InputError(f"{args.datapath}: more than {args.most_frames} windows, which are all held in memory; pass "
                         "--stop_us or a larger --most_frames")
    return frames


def main(argv: Sequence[str] | None = None) -> int:
    """Run the check; returns 1 if a run failed."""
    args = build_arg_parser().parse_args(argv)
    from devo.checkpoint import load_network
    from devo.config import Config
    from utils.export_run import find_config, find_weights

    weights = find_weights(args.weights)
    cfg = Config().merge_from_file(find_config(args.config, args.dataset, weights)).merge_from_list(args.opts)
    frames = read_frames(args)
    network = load_network(weights, patch_selector=cfg.PATCH_SELECTOR)
    results = [check(frames, cfg, network, seed) for seed in range(args.trials)]
    print(f"{args.datapath}: {len(frames)} windows, weights {weights}")
    print("| seed | forward | backward | frames | difference, % of path | scale | rotation, deg |\n|" + "---|" * 7)
    for seed, result in enumerate(results):
        print(f"| {seed} | {result.forward} | {result.backward} | {result.frames} | {100 * result.position_share:.2f} "
              f"| {result.scale:.3f} | {result.rotation_deg:.2f} |")
    if args.json:
        from utils.export_products import save_json

        save_json(args.json, {"datapath": args.datapath, "weights": weights,
                              "results": [asdict(result) for result in results]})
    return int(any(result.frames == 0 for result in results))


if __name__ == "__main__":
    sys.exit(run_cli(main))
