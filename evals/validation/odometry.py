"""Trials of the odometry, several side by side, kept in the report folder for the next run."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import devo
from devo.checkpoint import load_network
from devo.config import Config
from devo.device import resolve_device
from devo.errors import TrackingError
from evals.validation.settings import ValidationSettings
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import FilterReport, clean_cloud
from utils.clouds.io import read_cloud, write_cloud
from utils.datasets.registry import open_sequence
from utils.eval_utils import track
from utils.export_products import observables_to_cloud, save_json
from utils.export_run import ExportOptions, find_config, find_weights
from utils.trajectory_io import Trajectory, read_npy, write_npy

_POLL_S = 0.5


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of the odometry.

    Attributes:
        seed: of the drawing of patches.
        trajectory: camera to world, units of the odometry; None if the run is unusable.
        raw: every point of every keyframe, world frame of the odometry.
        facts: status, message, seconds, counts; `key` says what the result depends on.
        reused: taken from an earlier run.
    """

    seed: int
    trajectory: Trajectory | None
    raw: PointCloud
    facts: dict[str, Any]
    reused: bool = False

    @property
    def ok(self) -> bool:
        """Whether the run can be used."""
        return self.trajectory is not None

    def cleaned(self) -> tuple[PointCloud, list[FilterReport]]:
        """The cloud after the filters of `export_pointcloud.py`, and what they removed."""
        return clean_cloud(self.raw, ExportOptions("").cleanup_steps())


def run_trials(settings: ValidationSettings) -> list[Trial]:
    """Track the recording once per seed; progress goes to stderr.

    Results that lie in the report folder and depend on nothing that has changed since are reused.

    Raises:
        InputError: unusable settings or recording.
        TrackingError: the first trial, on which everything else rests, gave nothing usable.
    """
    keys = trial_keys(settings)
    found = {} if settings.fresh else {seed: trial for seed, key in keys.items()
                                       if (trial := _load(settings, seed, key)) is not None}
    missing = [seed for seed in settings.seeds if seed not in found]
    workers = min(settings.processes or os.cpu_count() or 1, len(missing))
    if torch.device(resolve_device(settings.device)).type != "cpu":
        workers = min(workers, 1)  # trials would share one device
    sequence = open_sequence(settings.dataset, settings.sequence, settings.sequence_options())
    frames = min(sequence.expected_length or 0, settings.max_frames or 1 << 62) or None
    with tqdm(total=frames and frames * len(missing), unit="frame", desc=f"odometry, {len(missing)} trial(s)",
              disable=not missing) as bar:
        run = _serially if workers <= 1 else _in_parallel
        for seed in run(settings, missing, keys, workers, bar):
            trial = _load(settings, seed, keys[seed])
            assert trial is not None, "written a moment ago"
            found[seed] = dataclasses.replace(trial, reused=False)
    trials = [found[seed] for seed in settings.seeds]
    if not trials[0].ok:
        raise TrackingError(f"{settings.sequence}: seed {trials[0].seed}: {trials[0].facts['message']}, or another "
                            "--seed")
    return trials


def _serially(settings: ValidationSettings, seeds: list[int], keys: dict[int, str], _workers: int,
              bar: Any) -> Iterator[int]:
    for seed in seeds:
        track_seed(settings, seed, keys[seed], bar.update)
        yield seed


def _in_parallel(settings: ValidationSettings, seeds: list[int], keys: dict[int, str], workers: int,
                 bar: Any) -> Iterator[int]:
    context = multiprocessing.get_context("spawn")
    counter = context.Value("q", 0)
    with ProcessPoolExecutor(workers, context, _start_worker, (counter,)) as pool:
        waiting: dict[Future[None], int] = {pool.submit(_work, settings, seed, keys[seed]): seed for seed in seeds}
        try:
            while waiting:
                done, _ = wait(waiting, _POLL_S, FIRST_COMPLETED)
                bar.update(counter.value - bar.n)
                for future in done:
                    future.result()
                    yield waiting.pop(future)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_frames_done: Any = None  # a worker process counts the frames of all trials here


def _start_worker(counter: Any) -> None:
    global _frames_done
    _frames_done = counter


def _work(settings: ValidationSettings, seed: int, key: str) -> None:
    def count() -> None:
        with _frames_done.get_lock():
            _frames_done.value += 1

    track_seed(settings, seed, key, count)


def track_seed(settings: ValidationSettings, seed: int, key: str, on_frame: Any) -> None:
    """Run one trial and write it to the report folder; `on_frame()` is called after every frame."""
    network, cfg, _ = _load_odometry(settings)
    sequence = open_sequence(settings.dataset, settings.sequence, settings.sequence_options())
    started = time.perf_counter()

    def counted() -> Iterator[Any]:
        for frame in itertools.islice(sequence.voxels(), settings.max_frames):
            yield frame
            on_frame()

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so that the number of processes does not change the last digits
    try:
        result = track(counted(), cfg, network, height=sequence.height, width=sequence.width, seed=seed)
    finally:
        torch.set_num_threads(threads)
    base = _base(settings, seed)
    usable = result.ok and result.observables is not None and len(result.observables) > 0
    if usable:
        assert result.observables is not None
        write_npy(base, Trajectory(result.tstamps, result.poses.astype(np.float64)))
        write_cloud(Path(f"{base}_cloud.npz"), observables_to_cloud(result.observables))
    save_json(Path(f"{base}.json"), {
        "key": key, "usable": usable, "status": result.status.value, "message": result.message,
        "frames": len(result.poses), "keyframes": result.counters.get("keyframes", 0),
        "tracked_share": result.tracked_share, "seconds": round(time.perf_counter() - started, 2)})


def _base(settings: ValidationSettings, seed: int) -> Path:
    return settings.out / "odometry" / f"seed{seed}"


def _load(settings: ValidationSettings, seed: int, key: str) -> Trial | None:
    """A trial from the report folder; None if there is none, or it belongs to other settings."""
    base = _base(settings, seed)
    try:
        facts = json.loads(Path(f"{base}.json").read_text("utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError):
        return None  # no earlier run, or one that was cut off
    if not isinstance(facts, dict) or facts.get("key") != key:
        return None
    if not facts["usable"]:
        return Trial(seed, None, PointCloud(np.zeros((0, 3))), facts, True)
    if not all(Path(f"{base}_{end}").is_file() for end in ("poses.npy", "tstamps.npy", "cloud.npz")):
        return None
    return Trial(seed, read_npy(f"{base}_poses.npy"), read_cloud(f"{base}_cloud.npz"), facts, True)


def _load_odometry(settings: ValidationSettings) -> tuple[torch.nn.Module, Config, str]:
    weights = find_weights(settings.weights)
    cfg = Config().merge_from_file(find_config(settings.config, settings.dataset, weights))
    cfg = cfg.merge_from_list(list(settings.opts))
    device = resolve_device(settings.device)
    return load_network(weights, patch_selector=cfg.PATCH_SELECTOR, device=device), cfg, weights


def effective_odometry(settings: ValidationSettings) -> dict[str, Any]:
    """Weights and settings that the odometry uses, for the report."""
    _, cfg, weights = _load_odometry(settings)
    return {"weights": weights, **cfg.as_dict()}


def trial_keys(settings: ValidationSettings) -> dict[int, str]:
    """For each seed a digest of everything that its result depends on: recording, weights, settings, program."""
    network, cfg, _ = _load_odometry(settings)
    sequence = open_sequence(settings.dataset, settings.sequence, settings.sequence_options())
    files = {role: [str(path), os.stat(path).st_size, os.stat(path).st_mtime_ns]  # noqa: PTH116 - names are text here
             for role, path in sequence.describe()["files"].items()}
    common = hashlib.sha256(json.dumps([files, cfg.as_dict(), settings.max_frames, settings.start_us, settings.stop_us,
                                        settings.side, settings.dataset, settings.device], sort_keys=True).encode())
    for name, tensor in sorted(network.state_dict().items()):
        common.update(name.encode() + tensor.cpu().numpy().tobytes())
    for source in sorted(Path(devo.__file__).parent.rglob("*.py")):
        common.update(source.read_bytes())
    return {seed: f"{common.hexdigest()}-{seed}" for seed in settings.seeds}
