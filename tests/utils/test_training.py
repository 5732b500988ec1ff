"""Training: the clip pool, augmentation, schedules, smoke test, exact resume, and what happens with bad input."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from devo.data_readers.base import TrainingClips
from devo.enet import eVONet
from devo.errors import CheckpointError, DevoError, InputError, OutputError
from devo.lietorch import SE3
from utils.training.augment import (
    AugmentSettings,
    augment,
    choose_frames,
    disturb,
    generator_for,
    random_crop,
    reflect,
    reverse_time,
    zoom,
)
from utils.training.log import TrainingLog, draw_curves, read_log
from utils.training.optimiser import learning_rate
from utils.training.pool import ClipPool, ShardSettings, read_shard, write_shard
from utils.training.settings import LossSettings, TrainSettings
from utils.training.trainer import RunSettings, Trainer

SMALL: dict[str, Any] = {
    "dim_inet": 24,
    "dim_fnet": 16,
    "dim": 8,
    "patches": 8,
    "clips": 2,
    "frames": 3,
    "initial_frames": 3,
    "updates": 2,
    "structure_only": 0.3,
    "perturbed": 0.5,
    "steps": 100,
    "warmup": 0,
    "schedule": "constant",
    "learning_rate": 2e-3,
}


def moving_plane(
    clips: int, frames: int, height: int = 64, width: int = 80, seed: int = 0, shift: int = 6
) -> TrainingClips:
    """A wall at depth 1 in front of a camera that moves sideways by `shift` pixels per frame: exact by construction."""
    generator = torch.Generator().manual_seed(seed)
    wide = torch.randn(clips, 5, height // 4, (width + shift * frames) // 4 + 2, generator=generator)
    wide = torch.nn.functional.interpolate(wide, scale_factor=4, mode="nearest")
    wide = torch.where(wide.abs() > 0.8, wide, 0.0)
    voxels = torch.stack([wide[..., :height, shift * i : shift * i + width] for i in range(frames)], 1)
    focal = 80.0
    poses = torch.zeros(clips, frames, 7)
    poses[..., 6] = 1.0
    poses[..., 0] = torch.arange(frames) * shift / focal
    intrinsics = torch.tensor([focal, focal, (width - 1) / 2, (height - 1) / 2]).expand(clips, frames, 4).contiguous()
    return TrainingClips(voxels, poses, torch.ones(clips, frames, height, width), intrinsics).check()


class FixedSource:
    """The same clips in every step, or clips made from the step number."""

    def __init__(self, make: Any = None, poison: int | None = None) -> None:
        self.make = make or (lambda step: moving_plane(2, 3))
        self.poison = poison

    def batch(self, step: int) -> TrainingClips:
        clips = self.make(step)
        if step == self.poison:
            clips.voxels[0, 0, 0, 20, 20] = math.nan
        return clips

    def close(self) -> None:
        return None


def make_trainer(
    folder: Path, source: FixedSource | None = None, run: dict[str, Any] | None = None, **changes: Any
) -> Trainer:
    settings = TrainSettings.from_preset("tiny", **{**SMALL, **changes})
    torch.manual_seed(5)
    network = eVONet(**settings.network_arguments())
    options = {"log_every": 2, "save_every": 1000, "validate_every": 1000, **(run or {})}
    return Trainer(network, settings, RunSettings(folder, **options), source or FixedSource())


def state_of(trainer: Trainer) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in trainer.network.state_dict().items()}


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Operations here are too small to be worth a second thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


# --- the loop ---------------------------------------------------------------------------------------------------


def test_thirty_steps_on_one_sample_halve_the_loss(tmp_path: Path) -> None:
    trainer = make_trainer(
        tmp_path,
        structure_only=0.0,
        perturbed=0.0,
        learning_rate=5e-3,
        match_gradient_every=1,
        depth_noise=0.0,
        loss=LossSettings(scores=0.0, pose=1.0, match=0.0, published_from=0),
    )
    losses = []
    for _ in range(30):
        torch.manual_seed(0)  # the same patches and initial depths, too
        trainer.step = 0
        losses.append(trainer.train_step()["total"])
    assert losses[-1] < 0.5 * losses[0]


def test_matching_alone_is_learned_without_the_loop(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, learning_rate=5e-3, unroll_every=100, match_gradient_every=1)
    matched = []
    for _ in range(60):
        torch.manual_seed(0)
        trainer.step = 1  # only every hundredth step unrolls
        values = trainer.train_step()
        assert "flow" not in values
        matched.append(values["match"])
    assert matched[-1] < 0.8 * matched[0]


def test_the_scorer_alone_is_trained_and_nothing_else(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, only="scorer", learning_rate=5e-3, weight_decay=0.0)
    before = state_of(trainer)
    correlations = []
    for _ in range(40):
        torch.manual_seed(0)
        values = trainer.train_step()
        assert math.isfinite(values["total"])
        correlations.append(values["score_correlation"])
    after = state_of(trainer)
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(name.startswith("patchify.scorer.") for name in changed)
    assert correlations[-1] > correlations[0] + 0.1


def test_resume_is_bit_exact(tmp_path: Path) -> None:
    def source() -> FixedSource:
        return FixedSource(lambda step: moving_plane(2, 3, seed=step))

    straight = make_trainer(tmp_path / "a", source(), run={"stop_after": 5})
    straight.train()
    first = make_trainer(tmp_path / "b", source(), run={"stop_after": 2})
    first.train()
    torch.manual_seed(99)  # whatever happens in between must not matter
    second = make_trainer(tmp_path / "b", source(), run={"stop_after": 5})
    second.resume(tmp_path / "b" / "last.pth")
    assert second.step == 2
    second.train()
    for name, value in state_of(straight).items():
        assert torch.equal(value, second.network.state_dict()[name]), name
        assert torch.equal(straight.average.values[name], second.average.values[name]), name


def test_a_step_that_is_not_finite_changes_nothing_and_is_counted(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, FixedSource(poison=1))
    trainer.train_step()
    before = state_of(trainer)
    values = trainer.train_step()
    assert values["finite"] == 0
    assert trainer.skipped == 1
    assert all(torch.equal(before[name], value) for name, value in trainer.network.state_dict().items())
    assert trainer.train_step()["finite"] == 1


def test_training_that_never_is_finite_stops_with_advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("utils.training.trainer.FAILED_IN_A_ROW", 2)

    def poisoned(step: int) -> TrainingClips:
        clips = moving_plane(2, 3)
        clips.voxels[:, 0, 0, 20, 20] = math.nan
        return clips

    trainer = make_trainer(tmp_path, FixedSource(poisoned))
    with pytest.raises(DevoError, match="2 steps in a row"):
        trainer.train()


def test_run_writes_log_curves_best_and_last(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, run={"stop_after": 2, "validate_every": 2})
    trainer.validation = moving_plane(1, 3, seed=7)
    assert trainer.train() == "all steps done"
    assert {path.name for path in tmp_path.iterdir()} == {
        "train.csv",
        "validation.csv",
        "curves.png",
        "best.pth",
        "last.pth",
    }
    assert read_log(tmp_path / "train.csv")["step"] == [2.0]
    assert read_log(tmp_path / "validation.csv")["flow"][0] > 0
    assert math.isfinite(trainer.best)


def test_time_limit_stops_before_the_first_step(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, run={"minutes": 0.0})
    assert "time limit" in trainer.train()
    assert trainer.step == 0
    assert (tmp_path / "last.pth").is_file()


def test_checkpoint_of_other_dimensions_is_refused(tmp_path: Path) -> None:
    make_trainer(tmp_path, run={"stop_after": 0}).train()
    other = make_trainer(tmp_path, dim_inet=32)
    with pytest.raises(CheckpointError, match=r"last.pth holds a network of other dimensions: .*this run expects"):
        other.resume(tmp_path / "last.pth")


def test_weights_alone_cannot_be_resumed(tmp_path: Path) -> None:
    from devo.checkpoint import save_checkpoint

    trainer = make_trainer(tmp_path)
    save_checkpoint(tmp_path / "weights.pth", trainer.network)
    with pytest.raises(CheckpointError, match="--init"):
        trainer.resume(tmp_path / "weights.pth")


def test_learning_rate_schedules() -> None:
    settings = TrainSettings.from_preset(
        "tiny", steps=110, warmup=10, learning_rate=1.0, schedule="cosine", final_rate=0.1
    )
    assert learning_rate(settings, 0) == pytest.approx(1 / 25)
    assert learning_rate(settings, 10) == pytest.approx(1.0)
    assert learning_rate(settings, 60) == pytest.approx(0.55)
    assert learning_rate(settings, 500) == pytest.approx(0.1)
    linear = TrainSettings.from_preset("tiny", steps=110, warmup=10, learning_rate=1.0, schedule="onecycle")
    assert learning_rate(linear, 60) == pytest.approx(0.5)
    with pytest.raises(InputError, match="expected one of cosine"):
        learning_rate(TrainSettings.from_preset("tiny", schedule="step"), 1000)


def test_unknown_presets_and_settings_are_refused() -> None:
    with pytest.raises(InputError, match="expected one of tiny, small, base"):
        TrainSettings.from_preset("huge")
    with pytest.raises(InputError, match="'framse'"):
        TrainSettings.from_preset("tiny", framse=3)


def test_tiny_preset_normalises_as_inference_does() -> None:
    from devo.normalize import normalize_voxel

    settings = TrainSettings.from_preset("tiny")
    network = eVONet(**settings.network_arguments())
    clips = augment(moving_plane(1, 4), 3, (64, 80), AugmentSettings(), generator_for(1))
    ours = network.normalize(clips.voxels)
    for frame in range(3):
        torch.testing.assert_close(ours[0, frame], normalize_voxel(clips.voxels[0, frame], "std"))
    assert (
        float((clips.voxels == 0).float().mean()) > 0.3
    )  # noise must not fill the empty cells (statistics of inference)


# --- augmentation -----------------------------------------------------------------------------------------------


def projected(clips: TrainingClips, pixel: Tensor, source: int, target: int) -> Tensor:
    """Where a pixel (x, y) of frame `source` of clip 0 appears in frame `target`."""
    fx, fy, cx, cy = clips.intrinsics[0, source].double()
    x, y = pixel.double()
    inv_depth = clips.inv_depths[0, source, round(float(y)), round(float(x))].double()
    point = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones((), dtype=torch.float64)]) / inv_depth
    poses = SE3(clips.world_T_cam[:1].double())
    moved = poses[:, target].inv() * poses[:, source]
    seen = moved[:, None].act(point[None, None])[0, 0]
    fx, fy, cx, cy = clips.intrinsics[0, target].double()
    return torch.stack([fx * seen[0] / seen[2] + cx, fy * seen[1] / seen[2] + cy])


def tilted_clips(seed: int = 0) -> TrainingClips:
    generator = torch.Generator().manual_seed(seed)
    clips = moving_plane(1, 4)
    poses = SE3.exp(0.1 * torch.randn(1, 4, 6, generator=generator)).data
    depth = 0.5 + torch.rand(1, 4, 64, 80, generator=generator)
    return TrainingClips(clips.voxels, poses, depth, clips.intrinsics + torch.tensor([0.0, 0.0, 3.0, -2.0]))


@pytest.mark.parametrize("axis", [0, 1])
def test_reflection_mirrors_the_geometry(axis: int) -> None:
    clips = tilted_clips()
    mirrored = reflect(clips, axis)
    side = clips.voxels.shape[-1 - axis]
    pixel = torch.tensor([30.0, 20.0])
    flipped = pixel.clone()
    flipped[axis] = side - 1 - pixel[axis]
    expected = projected(clips, pixel, 0, 2)
    expected[axis] = side - 1 - expected[axis]
    torch.testing.assert_close(projected(mirrored, flipped, 0, 2), expected, rtol=0, atol=1e-4)
    assert torch.equal(reflect(mirrored, axis).voxels, clips.voxels)


def test_crop_and_zoom_keep_points_where_they_were() -> None:
    clips = tilted_clips()
    pixel = torch.tensor([40.0, 30.0])
    expected = projected(clips, pixel, 1, 3)
    cropped = random_crop(clips, 48, 64, generator_for(4))
    offset = (clips.intrinsics - cropped.intrinsics)[0, 0, 2:]
    torch.testing.assert_close(projected(cropped, pixel - offset, 1, 3), expected - offset, rtol=0, atol=1e-4)
    doubled = zoom(clips, 2.0)
    assert doubled.voxels.shape[-2:] == (128, 160)
    torch.testing.assert_close(projected(doubled, 2 * pixel + 0.5, 1, 3), 2 * expected + 0.5, rtol=0, atol=1e-3)


def test_reversed_time_swaps_windows_bins_and_polarity() -> None:
    clips = tilted_clips()
    backwards = reverse_time(clips)
    assert torch.equal(backwards.voxels[:, 0, 0], -clips.voxels[:, 3, 4])
    assert torch.equal(backwards.world_T_cam[:, 1], clips.world_T_cam[:, 2])
    assert torch.equal(reverse_time(backwards).voxels, clips.voxels)


def test_chosen_frames_are_ascending_and_distinct() -> None:
    for number in range(20):
        frames = choose_frames(9, 5, 0.5, generator_for(number))
        assert bool((frames.diff() > 0).all())
        assert int(frames[0]) >= 0
        assert int(frames[-1]) < 9
    assert choose_frames(9, 5, 0.0, generator_for(1)).diff().tolist() == [1] * 4
    with pytest.raises(ValueError, match="4 frames, 5 wanted"):
        choose_frames(4, 5, 0.5, generator_for(0))


def test_noise_and_hot_pixels_touch_few_cells() -> None:
    voxels = torch.zeros(1, 4, 5, 40, 40)
    noisy = disturb(
        voxels.clone(), AugmentSettings(noise=1.0, hot_pixels=0.0, thinning=0.0, noise_density=0.02), generator_for(5)
    )
    assert 0 < int((noisy != 0).sum()) <= 0.02 * voxels.numel()
    hot = disturb(voxels.clone(), AugmentSettings(noise=0.0, hot_pixels=1.0, thinning=0.0), generator_for(3))
    pixels = (hot != 0).all(dim=2).all(dim=1)[0]
    assert 1 <= int(pixels.sum()) <= 12
    assert int((hot != 0).sum()) == 20 * int(pixels.sum())


def test_depth_is_normalised_with_the_poses() -> None:
    clips = tilted_clips()
    scaled = clips.with_unit_depth()
    assert float(torch.quantile(scaled.inv_depths.flatten(), 0.98)) == pytest.approx(1 / 0.7, rel=1e-2)
    torch.testing.assert_close(
        projected(scaled, torch.tensor([30.0, 20.0]), 0, 3),
        projected(clips, torch.tensor([30.0, 20.0]), 0, 3),
        rtol=0,
        atol=1e-3,
    )


# --- the pool ---------------------------------------------------------------------------------------------------

SHARD = ShardSettings(clips=2, frames=4, height=64, width=80, seed=3)


def make_shard(settings: ShardSettings, number: int) -> TrainingClips:
    return moving_plane(settings.clips, settings.frames, settings.height, settings.width, seed=number)


def make_pool(folder: Path, **changes: Any) -> ClipPool:
    options: dict[str, Any] = {
        "clips": 2,
        "frames": 3,
        "sizes": ((48, 64), (64, 64)),
        "shards": 2,
        "reuse": 2,
        "first": 2,
        "augment_settings": AugmentSettings(),
        "producer": "inline",
        **changes,
    }
    return ClipPool(folder, SHARD, make_shard, **options)


def test_batches_depend_on_the_step_only(tmp_path: Path) -> None:
    first, second = make_pool(tmp_path / "a"), make_pool(tmp_path / "b")
    expected = [first.batch(step) for step in range(5)]
    again = second.batch(4)  # straight to step 4, as after a resume
    assert all(torch.equal(a, b) for a, b in zip(again.tensors(), expected[4].tensors()))
    assert not torch.equal(expected[0].world_T_cam, expected[1].world_T_cam)
    assert [first.window(step) for step in (0, 2, 4, 40)] == [(0, 1), (1, 2), (2, 3), (20, 21)]


@pytest.mark.parametrize("processes", [1, 3])
def test_background_processes_give_the_same_batches(tmp_path: Path, processes: int) -> None:
    inline = make_pool(tmp_path / "a")
    background = make_pool(tmp_path / "b", producer="background", processes=processes)
    try:
        for step in (0, 3, 7):
            expected, found = inline.batch(step), background.batch(step)
            assert all(torch.equal(a, b) for a, b in zip(found.tensors(), expected.tensors()))
    finally:
        background.close()


def test_shard_round_trip(tmp_path: Path) -> None:
    clips = make_shard(SHARD, 0)
    write_shard(tmp_path / "shard.npz", clips)
    back = read_shard(tmp_path / "shard.npz", SHARD)
    torch.testing.assert_close(back.voxels.float(), clips.voxels, rtol=1e-3, atol=1e-6)
    assert torch.equal(back.world_T_cam, clips.world_T_cam)


def damaged(path: Path, how: str) -> None:
    content = path.read_bytes()
    if how == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif how == "garbage":
        path.write_bytes(b"not a zip file")
    elif how == "flipped bits":
        middle = len(content) // 3
        path.write_bytes(
            content[:middle] + bytes(byte ^ 255 for byte in content[middle : middle + 64]) + content[middle + 64 :]
        )
    elif how == "other size":
        write_shard(path, moving_plane(2, 4, 64, 64))
    else:
        np.savez(path, voxels=np.zeros(3))


@pytest.mark.parametrize("how", ["truncated", "garbage", "flipped bits", "other size", "missing arrays"])
def test_corrupt_sample_is_reported_and_made_again(tmp_path: Path, how: str, caplog: pytest.LogCaptureFixture) -> None:
    expected = make_pool(tmp_path).batch(0)
    for path in sorted(tmp_path.glob("shard_*.npz")):
        damaged(path, how)
    pool = make_pool(tmp_path)
    with caplog.at_level(logging.WARNING):
        found = pool.batch(0)
    assert pool.repaired >= 1
    assert "shard_00000" in caplog.text
    assert all(torch.equal(a, b) for a, b in zip(found.tensors(), expected.tensors()))


def test_unwritable_cache_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="--cache"):
        make_pool(tmp_path / "file" / "cache")


# --- log --------------------------------------------------------------------------------------------------------


def test_log_round_trip_and_picture(tmp_path: Path) -> None:
    for step in (1, 2):
        TrainingLog(tmp_path / "log.csv").append({"step": step, "total": 1.5 / step, "flow": math.nan})
    assert read_log(tmp_path / "log.csv")["total"] == [1.5, 0.75]
    draw_curves(tmp_path / "log.csv", tmp_path / "absent.csv", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
