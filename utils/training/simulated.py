"""Training clips from the simulator."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from devo.data_readers.base import TrainingClips
from utils.training.augment import generator_for
from utils.training.pool import ClipPool, ShardSettings, load_shard
from utils.training.settings import TrainSettings

VALIDATION_FRAMES = 10
VALIDATION_SIZE = (128, 160)
VALIDATION_SEED = 2**31 - 7
SIMULATOR_VERSION = 2  # part of the cache key: raise it when the simulator changes its output
SHARDS_PER_BANK = 16  # new textures after so many shards; painting them costs as much as one shard
BANK_SIZE = 48


def simulate_shard(settings: ShardSettings, number: int) -> TrainingClips:
    """Simulate one shard; the same (settings, number) gives the same clips."""
    from utils.simulator.training import ClipSettings

    generator = generator_for(settings.seed, 2, number)
    bank_seed = generator_for(settings.seed, 4, number // SHARDS_PER_BANK).initial_seed() % 2**31
    bank = ClipSettings(bank_size=BANK_SIZE, bank_seed=bank_seed)
    size = settings.clips, settings.frames, settings.height, settings.width
    return sampled_clips(*size, generator=generator, settings=bank).to("cpu").check()


def sampled_clips(clips: int, frames: int, height: int, width: int, **options: Any) -> TrainingClips:
    """Random clips as a trainer takes them; arguments of `utils.simulator.training.sample_clips`."""
    from utils.simulator.training import sample_clips

    made = sample_clips(clips, frames, height, width, **options)
    return TrainingClips(made.voxels, made.world_T_cam, made.inv_depths, made.intrinsics)


def shard_settings(settings: TrainSettings) -> ShardSettings:
    """Shard settings of a training run."""
    height, width = settings.shard_size
    return ShardSettings(settings.shard_clips, settings.shard_frames, height, width, settings.seed)


def cache_folder(root: Path, settings: ShardSettings) -> Path:
    """Folder of a cache; differs for settings that give other clips."""
    key = json.dumps({**asdict(settings), "version": SIMULATOR_VERSION}, sort_keys=True)
    return root / f"sim_{hashlib.sha256(key.encode()).hexdigest()[:12]}"


def simulated_source(
    settings: TrainSettings,
    cache: Path,
    *,
    producer: str = "background",
    start_step: int = 0,
    processes: int = 1,
) -> ClipPool:
    """Pool of simulated clips for a training run, cached below `cache`, made by so many background processes."""
    shards = shard_settings(settings)
    return ClipPool(
        cache_folder(cache, shards),
        shards,
        simulate_shard,
        clips=settings.clips,
        frames=settings.frames,
        sizes=settings.sizes,
        shards=settings.pool_shards,
        reuse=settings.reuse,
        augment_settings=settings.augment,
        producer=producer,
        start_step=start_step,
        nice=5,
        processes=processes,
    )


def validation_clips(cache: Path, count: int = 32) -> TrainingClips:
    """Fixed clips that no training run sees (their seed lies outside the range of training seeds), cached on disk."""
    part = ShardSettings(8, VALIDATION_FRAMES, *VALIDATION_SIZE, seed=VALIDATION_SEED)
    folder = cache_folder(cache, part)
    parts = []
    for number in range((count + part.clips - 1) // part.clips):
        parts.append(load_shard(folder, number, part, simulate_shard).to("cpu").with_unit_depth())
    return TrainingClips.join(parts).clips(torch.arange(count))
