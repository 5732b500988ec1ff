#!/usr/bin/env python3
"""Measure the odometry on simulated sequences with perfect ground truth, against two baselines.

Every sequence differs in scene, textures, motion and sensor size from what training draws (other seeds, and the
hand-held motion of the full simulator instead of short clips). Variants: `trained` (the preset as it is), `random
patches`, `scored patches` and `gradient patches` (the same network, patches drawn at random, by its scorer, by the
gradient of the event image) and `untrained` (the same architecture, random weights). A run counts as lost if the
tracker says so or its error exceeds a fifth of the path.

Depth errors are medians over the points that the quality filter keeps with its defaults (`depth %`), and over the
cloud that `export_pointcloud.py --cleanup` writes (`cleaned %`), both after the scale of the trajectory.

Example: python evals/eval_simulated.py --split test --trials 3
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above

SCENES = ("board", "room", "planes", "corridor")
SIZES = ((240, 180), (346, 260), (320, 240))
PRESETS = ("slow", "normal", "normal", "fast", "slow")
FIRST_SEED = {"val": 7_000, "test": 9_000}
PER_SCENE = 5
LOST_ABOVE = 0.2  # of the path length
SELECTORS = {"random patches": "random", "scored patches": "scorer", "gradient patches": "gradient"}
VARIANTS = ("trained", *SELECTORS, "untrained")
DEFAULT_VARIANTS = ("trained", "random patches", "untrained")


@dataclass(frozen=True)
class Score:
    """Outcome of one run: `ate` as a share of the path length, `depth` the median relative depth error after scale.

    `cleaned_depth` and `cleaned_points` belong to the cleaned cloud, `depth` to the points of good quality, `points`
    to all.
    """

    sequence: str
    variant: str
    trial: int
    status: str
    ate: float
    depth: float
    cleaned_depth: float
    points: int
    cleaned_points: int
    keyframes: int
    tracked_share: float
    fps: float

    @property
    def row(self) -> str:
        """One line of the table."""
        return (f"| {self.sequence} | {self.variant} | {self.trial} | {self.status} | {100 * self.ate:.2f} | "
                f"{100 * self.depth:.2f} | {100 * self.cleaned_depth:.2f} | {self.points} | {self.cleaned_points} | "
                f"{self.keyframes} | {self.fps:.2f} |")

    @property
    def lost(self) -> bool:
        """Whether the result is unusable."""
        return self.status != "tracked" or not self.ate <= LOST_ABOVE


def sequences(split: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names and simulator settings of the sequences of a split: every scene with several sizes and motions."""
    for index, scene in enumerate(SCENES):
        for k in range(PER_SCENE):
            size, preset = SIZES[(index + k) % len(SIZES)], PRESETS[(index + k) % len(PRESETS)]
            seed = FIRST_SEED[split] + 100 * index + k
            yield f"{scene}_{preset}_{size[0]}x{size[1]}_{seed}", {
                "scene": scene, "seed": seed, "preset": preset, "size": size}


def recording_folder(name: str, settings: dict[str, Any], seconds: float, cache: Path) -> Path:
    """Folder of a sequence in the cache; simulated now if it is not there."""
    from utils.simulator.dataset_folder import FolderOptions, write_recording
    from utils.simulator.sequence import SequenceSettings

    folder = cache / f"{name}_{seconds:g}s"
    if not folder.is_dir():
        write_recording(folder, SequenceSettings(seconds=seconds, **settings), FolderOptions(depth=False))
    return folder


def evaluate(name: str, settings: dict[str, Any], seconds: float, cache: Path, network: Any, cfg: Any, variant: str,
             trial: int) -> Score:
    """Track a sequence and compare with the truth."""
    import numpy as np

    from utils.datasets.registry import SequenceOptions, open_sequence
    from utils.eval_utils import track
    from utils.simulator.sequence import SequenceSettings, SimulatedSequence

    simulated = SequenceSettings(seconds=seconds, **settings)
    folder = recording_folder(name, settings, seconds, cache)
    recording = open_sequence("generic", folder, SequenceOptions())
    start = time.perf_counter()
    result = track(recording.voxels(), cfg, network, seed=trial)
    fps = len(result.poses) / (time.perf_counter() - start)
    ate, depth, cleaned = float("nan"), (float("nan"), float("nan")), 0
    if result.ok and result.observables is not None:
        truth = recording.ground_truth()
        assert truth is not None, f"{folder} was simulated, so it has a ground truth"
        ate, scale = trajectory_share(result.tstamps, result.poses, *truth)
        depth, cleaned = depth_errors(result.observables, scale, SimulatedSequence(simulated))
    count = 0 if result.observables is None or not np.isfinite(ate) else len(result.observables)
    return Score(name, variant, trial, result.status.value, ate, *depth, count, cleaned,
                 result.counters.get("keyframes", 0), result.tracked_share, fps)


def trajectory_share(tstamps: Any, poses: Any, stamps: Any, truth: Any) -> tuple[float, float]:
    """ATE (Sim3, RMSE) as a share of the true path between the matched frames, and the scale of the alignment."""
    import numpy as np

    from evals.alignment import aligned_path_share

    centres = np.stack([np.interp(tstamps, stamps, truth[:, axis]) for axis in range(3)], axis=1)
    share, _, alignment = aligned_path_share(poses[:, :3].astype(np.float64), centres)
    return share, float(alignment.scale)


def depth_errors(observables: Any, scale: float, simulated: Any) -> tuple[tuple[float, float], int]:
    """Medians of |scale * depth - true depth| / true depth.

    Args:
        observables: of the run.
        scale: true over estimated length.
        simulated: the sequence, which knows its depth at every time.

    Returns:
        The medians over the points of good quality and over the cleaned cloud (NaN where there are none), and the
        size of the cleaned cloud.
    """
    import numpy as np
    import torch

    from evals.image_metrics import summarise_depth_errors
    from utils.clouds.filters import clean_cloud
    from utils.export_options import ExportOptions
    from utils.export_products import observables_to_cloud

    cloud = observables_to_cloud(observables)
    if len(cloud) == 0:
        return (float("nan"), float("nan")), 0
    stamps, host = np.unique(observables.t_us, return_inverse=True)
    column, row = np.rint(observables.pixel_xy).astype(int).T
    truth = torch.cat([simulated.depth(stamps[i:i + 8]) for i in range(0, len(stamps), 8)])[host, row, column].numpy()
    error = (scale * observables.depths - truth) / np.where(truth > 0, truth, np.nan)
    cloud = replace(cloud, scalars={**cloud.scalars, "relative_error": error})
    good, cleaned = (clean_cloud(cloud, steps)[0].scalars["relative_error"]
                     for steps in (["quality"], ExportOptions(datapath="").cleanup_steps()))
    return (summarise_depth_errors(good).median, summarise_depth_errors(cleaned).median), len(cleaned)


def summarise(scores: Sequence[Score], variant: str) -> dict[str, Any]:
    """Medians over the runs of one variant that were not lost, and how many were."""
    import numpy as np

    mine = [score for score in scores if score.variant == variant]
    good = [score for score in mine if not score.lost]

    def median(values: list[float]) -> float:
        return float(np.median(values)) if values else float("nan")

    worst = sorted({score.sequence for score in mine if score.lost})
    return {"variant": variant, "runs": len(mine), "lost runs": len(mine) - len(good), "lost sequences": len(worst),
            "ate_percent": 100 * median([score.ate if not score.lost else np.inf for score in mine]),
            "ate_percent_tracked": 100 * median([score.ate for score in good]),
            "depth_percent": 100 * median([score.depth for score in good]),
            "cleaned_percent": 100 * median([score.cleaned_depth for score in good]),
            "points": median([score.points for score in good]), "fps": median([score.fps for score in mine])}


class Report:
    """Scores of an evaluation, in a file that grows with every run, so that a stopped evaluation can go on.

    Args:
        path: JSON file, or None to keep nothing; scores that it holds already are taken over.
        about: what the scores depend on.

    Raises:
        InputError: the file belongs to something else.
    """

    def __init__(self, path: Path | None, about: dict[str, Any]) -> None:
        from devo.errors import InputError

        self.path, self.about = path, about
        self.scores: list[Score] = []
        if path is None or not path.is_file():
            return
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            self.scores = [Score(**entry) for entry in found["scores"]]
            other = [name for name, value in about.items() if found["about"].get(name) != value]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"--json {path} is no report of this command ({error}); choose another file") from error
        if other:
            raise InputError(f"--json {path} was made with other {' and '.join(other)}; choose another file")

    def add(self, score: Score) -> None:
        """Take in one run and write the file."""
        from utils.atomic import atomic_path

        self.scores.append(score)
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            content = {"about": self.about, "summary": self.summary(), "scores": [asdict(s) for s in self.scores]}
            with atomic_path(self.path) as temporary:
                temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")

    def summary(self) -> list[dict[str, Any]]:
        """One row per variant."""
        return [summarise(self.scores, name) for name in dict.fromkeys(score.variant for score in self.scores)]


def _fingerprint(weights: str, selector: str) -> str:
    """Of what the weights are, not where they lie."""
    import hashlib

    digest = hashlib.sha256()
    for name, value in _network(weights, "trained", selector).state_dict().items():
        digest.update(name.encode() + value.numpy().tobytes())
    return digest.hexdigest()[:16]


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = AliasParser(prog="eval_simulated.py", description=__doc__)
    parser.add_argument("--split", choices=FIRST_SEED, default="test")
    parser.add_argument("--weights", help="default: the built-in ones")
    parser.add_argument("--config", help="default: the preset of the built-in weights")
    parser.add_argument("--opts", nargs="+", default=[], help="override settings, KEY VALUE ...")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(DEFAULT_VARIANTS))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--every", type=int, default=1, help="use every n-th sequence")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of the sequences [s]")
    parser.add_argument("--jobs", type=int, default=1, help="processes of one thread each; 1 uses all threads in turn")
    parser.add_argument("--cache", type=Path, default=Path("datasets/simulated"), help="where sequences are kept")
    parser.add_argument("--json", type=Path, help="also write all scores to this file, after every run; runs that it "
                                                  "holds are not repeated")
    return parser


@dataclass(frozen=True)
class Task:
    """One run: which sequence, which variant of which network, which seed."""

    sequence: str
    simulated: dict[str, Any]
    seconds: float
    cache: Path
    weights: str
    settings: dict[str, Any]
    variant: str
    trial: int


def run_task(task: Task) -> Score:
    """Do one run; networks are kept from run to run within a process."""
    from devo.config import Config

    cfg = Config(task.settings)
    cfg.PATCH_SELECTOR = SELECTORS.get(task.variant, cfg.PATCH_SELECTOR)
    network = _network(task.weights, task.variant, cfg.PATCH_SELECTOR)
    return evaluate(task.sequence, task.simulated, task.seconds, task.cache, network, cfg, task.variant, task.trial)


@functools.lru_cache(maxsize=len(VARIANTS))
def _network(weights: str, variant: str, selector: str) -> Any:
    from devo.checkpoint import load_network

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        network: Any = load_network(weights, patch_selector=selector)
        if variant == "untrained":
            source = f"random:0:{network.dim_inet},{network.dim_fnet},{network.dim}"
            network = load_network(source, patch_selector=selector)
    return network


def run_all(tasks: Sequence[Task], jobs: int) -> Iterator[Score]:
    """Scores in the order of the tasks; `jobs` processes of one thread each, or this process where it is 1."""
    if jobs == 1:
        yield from map(run_task, tasks)
        return
    import multiprocessing

    with multiprocessing.get_context("spawn").Pool(jobs, _one_thread) as pool:
        first = {task.sequence: task for task in tasks}  # no two processes may simulate the same one
        pool.map(_simulate, first.values(), chunksize=1)
        yield from pool.imap(run_task, tasks)


def _simulate(task: Task) -> None:
    recording_folder(task.sequence, task.simulated, task.seconds, task.cache)


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def main(argv: Sequence[str] | None = None) -> int:
    """Evaluate and print Markdown tables."""
    args = build_arg_parser().parse_args(argv)
    from devo.config import Config
    from utils.export_run import find_config, find_weights

    weights = find_weights(args.weights)
    cfg = Config().merge_from_file(find_config(args.config, "generic", weights)).merge_from_list(args.opts)
    chosen = [(name, settings) for name, settings in sequences(args.split) if settings["scene"] in args.scenes]
    tasks = [Task(name, settings, args.seconds, args.cache, weights, cfg.as_dict(), variant, trial)
             for trial in range(args.trials) for name, settings in chosen[::args.every] for variant in args.variants]
    report = Report(args.json, {"split": args.split, "seconds": args.seconds, "config": cfg.as_dict(),
                                "weights": _fingerprint(weights, cfg.PATCH_SELECTOR)})
    print("| sequence | variant | trial | status | ATE % | depth % | cleaned % | points | cleaned | "
          "keyframes | fps |\n|" + "---|" * 11)
    for score in report.scores:
        print(score.row, flush=True)
    done = {(score.sequence, score.variant, score.trial) for score in report.scores}
    for score in run_all([task for task in tasks if (task.sequence, task.variant, task.trial) not in done], args.jobs):
        report.add(score)
        print(score.row, flush=True)
    rows = report.summary()
    print("\n| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(f"{v:.2f}" if isinstance(v, float) else str(v) for v in row.values()) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
