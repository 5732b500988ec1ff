#!/usr/bin/env python3
"""Validate the exported cloud: odometry against EMVS maps with true and estimated poses, in one report folder.

Example: python evals/validate_pointcloud.py --sequence datasets/board

Needs a recording with ground truth: a simulated one (python scripts/simulate.py --scene board --out datasets/board
--seconds 8 --seed 1), a generic folder with groundtruth.txt, or a preprocessed sequence of a data set that publishes
the poses of its event camera: VECtor, for example, but neither TUM-VIE nor EDS.
Open validation.html in the report folder. Trials of the odometry are kept there and reused by the next run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog="validate_pointcloud.py", description=__doc__, allow_abbrev=False,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--sequence", type=Path, default=Path("datasets/board"), help="folder of the recording (default: %(default)s)")
    add("--dataset", default="auto", help="how to read it (default: recognised by its files)")
    add("--side", default="left", help="camera of a stereo recording (default: %(default)s)")
    add("--out", type=Path, help="report folder (default: results/validation_<name of the sequence>)")
    add("--weights", help="checkpoint or name of built-in weights (default: the built-in ones)")
    add("--config", help="settings of the odometry (default: the preset of the weights)")
    add("--opts", nargs="+", default=[], metavar="KEY VALUE", help="override settings of the odometry")
    add("--seed", type=int, default=0, help="seed of the first trial, which is shown (default: %(default)s)")
    add("--trials", type=int, default=3, help="seeds to run (default: %(default)s)")
    add("--processes", type=int, default=0, help="trials side by side, 0 = one per core (default: %(default)s)")
    add("--start_us", type=float, help="begin of the part to use [us]")
    add("--stop_us", type=float, help="end of the part to use [us]")
    add("--max_frames", type=int, help="stop the odometry after so many frames")
    add("--emvs_events", type=int, default=2_000_000, help="about so many events vote per map (default: %(default)s)")
    add("--emvs_threshold", type=float, default=7.0, help="adaptive_threshold_c of EMVS (default: %(default)s)")
    add("--emvs_median", type=int, default=15, help="median_filter_size of EMVS [px] (default: %(default)s)")
    add("--emvs_planes", type=int, default=100, help="depth planes of EMVS (default: %(default)s)")
    add("--min_depth", type=float, help="nearest depth of EMVS [m] (default: from the exported cloud)")
    add("--max_depth", type=float, help="farthest depth of EMVS [m] (default: from the exported cloud)")
    add("--view_scale", type=float, default=1.5, help="size of the EMVS view, sensor = 1 (default: %(default)s)")
    add("--device", default="cpu", help="auto, cpu, cuda or cuda:0 (default: %(default)s)")
    add("--fresh", action="store_true", help="track again even if the report folder has the result")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    args = build_arg_parser().parse_args(argv)
    from dataclasses import replace

    from devo.errors import DevoError
    from evals.validation import ValidationSettings, validate, write_report
    from evals.validation.report import duration_s
    from evals.validation.settings import experiment_emvs_settings
    from evals.validation.verdict import criteria, headline

    try:
        emvs = replace(experiment_emvs_settings(), adaptive_threshold_c=args.emvs_threshold,
                       median_filter_size=args.emvs_median, dimZ=args.emvs_planes, min_depth=args.min_depth,
                       max_depth=args.max_depth)
        out = args.out or Path("results") / f"validation_{args.sequence.resolve().name}"
        found = validate(ValidationSettings(
            sequence=args.sequence, out=out, dataset=args.dataset, side=args.side, weights=args.weights,
            config=args.config, opts=tuple(args.opts), seed=args.seed, trials=args.trials, processes=args.processes,
            start_us=args.start_us, stop_us=args.stop_us, max_frames=args.max_frames, emvs_events=args.emvs_events,
            view_scale=args.view_scale, emvs=emvs, fresh=args.fresh, device=args.device))
        written = write_report(found)
    except DevoError as error:
        print(f"validate_pointcloud.py: error: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("validate_pointcloud.py: interrupted; trials that were finished are kept and reused", file=sys.stderr)
        return 130
    judged = criteria(found, duration_s(found))
    for one in judged:
        print(f"{one.word:>10}  {one.name}: {one.value} (expected {one.limit})" + (f". {one.why}" if one.why else ""))
    print(f"{headline(judged)}\nreport: {written[0]} and {len(written) - 1} more files")
    return 0


if __name__ == "__main__":
    sys.exit(main())
