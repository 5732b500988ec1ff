"""Training clips from the simulator."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from devo.data_readers.base import TrainingClips
from utils.training.augment import generator_for
from utils.training.pool import ClipPool, ShardSettings
from utils.training.settings import TrainSettings

SIMULATOR_VERSION = 1  # part of the cache key: raise it when the simulator changes its output


def simulate_shard(settings: ShardSettings, number: int) -> TrainingClips:
    """Simulate one shard; the same (settings, number) gives the same clips."""
    from utils.simulator.training import sample_clips

    generator = generator_for(settings.seed, 2, number)
    clips = sample_clips(settings.clips, settings.frames, settings.height, settings.width, generator=generator)
    return TrainingClips(clips.voxels, clips.world_T_cam, clips.inv_depths, clips.intrinsics).to("cpu").check()


def shard_settings(settings: TrainSettings) -> ShardSettings:
    """Shard settings of a training run."""
    height, width = settings.shard_size
    return ShardSettings(settings.shard_clips, settings.shard_frames, height, width, settings.seed)


def cache_folder(root: Path, settings: ShardSettings) -> Path:
    """Folder of a cache; differs for settings that give other clips."""
    key = json.dumps({**asdict(settings), "version": SIMULATOR_VERSION}, sort_keys=True)
    return root / f"sim_{hashlib.sha256(key.encode()).hexdigest()[:12]}"


def simulated_source(
    settings: TrainSettings, cache: Path, *, producer: str = "background", start_step: int = 0
) -> ClipPool:
    """Pool of simulated clips for a training run, cached below `cache`."""
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
    )


def validation_clips(
    settings: TrainSettings, cache: Path, count: int = 32, frames: int = 10, size: tuple[int, int] = (128, 160)
) -> TrainingClips:
    """Fixed clips that no training run sees (their seed lies outside the range of training seeds), cached on disk."""
    from utils.training.pool import ensure_shard, read_shard, shard_path

    part = ShardSettings(8, frames, *size, seed=2**31 - 7)
    folder = cache_folder(cache, part)
    numbers = range((count + part.clips - 1) // part.clips)
    for number in numbers:
        ensure_shard(folder, number, part, simulate_shard)
    parts = [read_shard(shard_path(folder, number), part).to("cpu").with_unit_depth() for number in numbers]
    return TrainingClips.join(parts)
