"""A sliding pool of simulated clips: made in the background, used several times, the same for the same seed."""

from __future__ import annotations

import logging
import multiprocessing
import time
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from devo.data_readers.base import TrainingClips
from devo.errors import DevoError, InputError, OutputError
from utils.atomic import atomic_path
from utils.training.augment import AugmentSettings, augment, generator_for

logger = logging.getLogger(__name__)

FIELDS = ("voxels", "world_T_cam", "inv_depths", "intrinsics")
POLL_SECONDS = 0.2


@dataclass(frozen=True)
class ShardSettings:
    """What one shard holds: `clips` clips of `frames` frames of `height` x `width`, made from (seed, shard number)."""

    clips: int = 8
    frames: int = 12
    height: int = 144
    width: int = 176
    seed: int = 0


ShardMaker = Callable[[ShardSettings, int], TrainingClips]


def write_shard(path: Path, clips: TrainingClips) -> None:
    """Store clips as float16 voxels and depths, float32 poses and intrinsics (npz, written atomically)."""
    with atomic_path(path) as temporary:
        np.savez(
            temporary,
            voxels=clips.voxels.clamp(-6e4, 6e4).half().numpy(),
            inv_depths=clips.inv_depths.half().numpy(),
            world_T_cam=clips.world_T_cam.float().numpy(),
            intrinsics=clips.intrinsics.float().numpy(),
        )


def read_shard(path: Path, settings: ShardSettings) -> TrainingClips:
    """Read a shard.

    Raises:
        InputError: truncated, corrupt, or of other dimensions.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            clips = TrainingClips(*(torch.from_numpy(archive[name]) for name in FIELDS)).check()
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"cached training sample {path} is corrupt ({error}); delete it, it will be made again"
        ) from error
    expected = (settings.clips, settings.frames, settings.height, settings.width)
    shape = clips.voxels.shape
    if (*shape[:2], *shape[3:]) != expected:
        raise InputError(
            f"cached training sample {path} has clips, frames, height, width "
            f"{(*shape[:2], *shape[3:])}, expected {expected}; delete it, it will be made again"
        )
    return clips


def shard_path(folder: Path, number: int) -> Path:
    """File of shard `number`."""
    return folder / f"shard_{number:06d}.npz"


def ensure_shard(folder: Path, number: int, settings: ShardSettings, make: ShardMaker) -> None:
    """Make shard `number` unless its file exists."""
    path = shard_path(folder, number)
    if not path.is_file():
        write_shard(path, make(settings, number))


def load_shard(
    folder: Path, number: int, settings: ShardSettings, make: ShardMaker, repaired: Callable[[], None] = lambda: None
) -> TrainingClips:
    """Read shard `number`; make it where it is missing, and again, with a warning, where its file is corrupt.

    Raises:
        InputError: the new file is unusable, too.
    """
    ensure_shard(folder, number, settings, make)
    try:
        return read_shard(shard_path(folder, number), settings)
    except InputError as error:
        logger.warning("%s", error)
        repaired()
        shard_path(folder, number).unlink(missing_ok=True)
        ensure_shard(folder, number, settings, make)
        return read_shard(shard_path(folder, number), settings)


def _produce(
    folder: Path,
    settings: ShardSettings,
    make: ShardMaker,
    position: Any,
    share: tuple[int, int],
    keep: int,
    nice: int,
) -> None:
    """Background process `share[0]` of `share[1]`: makes every so-many-th shard before it is needed, deletes old ones.

    Each process is one or two of its shards ahead of the trainer's newest one.
    """
    import os

    if nice:
        os.nice(nice)
    torch.set_num_threads(1)
    turn, processes = share
    ahead = 2 * processes
    number = max(0, position.value - keep)
    number += (turn - number) % processes
    while True:
        newest = position.value
        if newest < 0 or os.getppid() == 1:
            return
        if number > newest + ahead:
            time.sleep(POLL_SECONDS)
            continue
        ensure_shard(folder, number, settings, make)
        if keep > 0 and number - ahead - keep >= 0:
            shard_path(folder, number - ahead - keep).unlink(missing_ok=True)
        number += processes


class ClipPool:
    """Deterministic training batches from a sliding window of shards.

    At step s the window holds the `shards` newest shards up to number `first + s*clips/(reuse*shard_clips)`; the batch
    is drawn from it at random, augmented with a generator seeded by (seed, step). It depends on the step only, not on
    timing, and a run can be resumed exactly. Each clip is used about `reuse` times.

    Args:
        folder: cache, one file per shard.
        settings: of a shard.
        make: makes a shard; called in the background process, hence picklable.
        clips: batch size. frames: frames per clip. sizes: windows (height, width), one is drawn per step.
        shards: pool size. reuse: mean uses of a clip. first: shards needed before the first step.
        producer: `background` (a process of its own), `inline` (this process makes shards when they are needed), or
            `elsewhere` (another trainer with the same cache makes them, this one waits).
        processes: number of background processes.
    """

    def __init__(
        self,
        folder: Path,
        settings: ShardSettings,
        make: ShardMaker,
        *,
        clips: int,
        frames: int,
        sizes: tuple[tuple[int, int], ...],
        shards: int,
        reuse: int,
        augment_settings: AugmentSettings,
        first: int = 4,
        producer: str = "background",
        start_step: int = 0,
        nice: int = 0,
        processes: int = 1,
    ) -> None:
        self.folder, self.settings, self.make = folder, settings, make
        self.clips, self.frames_per_clip, self.sizes, self.shards, self.reuse = clips, frames, sizes, shards, reuse
        self.augment_settings, self.first = augment_settings, first
        self.waited_seconds = 0.0
        self.repaired = 0
        self._memory: OrderedDict[int, TrainingClips] = OrderedDict()
        self._check_writable()
        self._processes: list[Any] = []
        self._position: Any = None
        self.producer = producer
        if producer == "background":
            context = multiprocessing.get_context("spawn")
            self._position = context.Value("q", self.window(start_step)[1])
            self._processes = [
                context.Process(
                    target=_produce,
                    daemon=True,
                    args=(folder, settings, make, self._position, (turn, processes), shards + 2, nice),
                )
                for turn in range(processes)
            ]
            for process in self._processes:
                process.start()

    def _check_writable(self) -> None:
        """Fail at once, not after minutes, where the cache cannot be written."""
        try:
            with atomic_path(self.folder / "probe.tmp") as temporary:
                temporary.write_bytes(b"devo")
            (self.folder / "probe.tmp").unlink()
        except OutputError as error:
            raise OutputError(
                f"cannot write the clip cache {self.folder}: {error}; choose another folder with --cache"
            ) from error

    def window(self, step: int) -> tuple[int, int]:
        """Numbers of the oldest and newest shard used at a step."""
        newest = self.first - 1 + step * self.clips // (self.reuse * self.settings.clips)
        return max(0, newest - self.shards + 1), newest

    def shard(self, number: int) -> TrainingClips:
        """Clips of a shard, from memory, disk, or made anew where the file is corrupt."""
        if number in self._memory:
            self._memory.move_to_end(number)
            return self._memory[number]
        self._wait_for(shard_path(self.folder, number), number)
        clips = load_shard(self.folder, number, self.settings, self.make, self._count_repair)
        self._memory[number] = clips
        while len(self._memory) > self.shards + 1:
            self._memory.popitem(last=False)
        return clips

    def _count_repair(self) -> None:
        self.repaired += 1

    def _wait_for(self, path: Path, number: int) -> None:
        if self.producer == "inline":
            ensure_shard(self.folder, number, self.settings, self.make)
            return
        start = time.monotonic()
        while not path.is_file():
            ended = [process.exitcode for process in self._processes if not process.is_alive()]
            if ended:
                raise DevoError(
                    f"a process that simulates training clips ended (exit code {ended[0]}) before {path} was written; "
                    "its message is above. Too little memory? Try fewer --shard-clips"
                )
            time.sleep(POLL_SECONDS)
        self.waited_seconds += time.monotonic() - start

    def batch(self, step: int) -> TrainingClips:
        """Batch of training step `step`."""
        generator = generator_for(self.settings.seed, 1, step)
        oldest, newest = self.window(step)
        if self._position is not None:
            self._position.value = newest
        size = self.sizes[int(torch.randint(0, len(self.sizes), (), generator=generator))]
        numbers = torch.randint(oldest, newest + 1, (self.clips,), generator=generator).tolist()
        chosen = torch.randint(0, self.settings.clips, (self.clips,), generator=generator)
        raw = TrainingClips.join([self.shard(number).clips(chosen[i : i + 1]) for i, number in enumerate(numbers)])
        return augment(raw, self.frames_per_clip, size, self.augment_settings, generator)

    def close(self) -> None:
        """Stop the background processes."""
        if self._processes:
            self._position.value = -1
        for process in self._processes:
            process.join(timeout=10)
            if process.is_alive():
                process.terminate()
        self._processes = []
