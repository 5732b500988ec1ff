"""Augmentation of training clips; every function takes the random generator it draws from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from devo.data_readers.base import TrainingClips


@dataclass(frozen=True)
class AugmentSettings:
    """Probabilities (per clip unless said) and strengths.

    Attributes:
        polarity_flip: negate all voxels (the inverse contrast of the scene).
        reverse: play the batch backwards.
        mirror, upside_down: reflect left-right / top-bottom, poses and principal point included.
        skip_frames: probability, per batch, to draw the frames at random from the clip instead of a contiguous run.
        zoom: probability, per batch, to resize by up to `zoom_range` (log2) in either direction.
        noise: probability of shot noise; `noise_density` is the largest share of cells that get one event.
        hot_pixels: probability of up to `hot_pixel_count` pixels that fire in every bin of every frame.
        thinning: probability to scale single bins by a random factor (uneven event rate within a window).
    """

    polarity_flip: float = 0.5
    reverse: float = 0.5
    mirror: float = 0.5
    upside_down: float = 0.25
    skip_frames: float = 0.35
    zoom: float = 0.0
    zoom_range: float = 0.25
    noise: float = 0.3
    noise_density: float = 0.02
    hot_pixels: float = 0.2
    hot_pixel_count: int = 12
    thinning: float = 0.3


def generator_for(*numbers: int) -> torch.Generator:
    """A generator seeded by several non-negative integers, for example (seed, step)."""
    state = np.random.SeedSequence([int(number) for number in numbers]).generate_state(2, np.uint32)
    return torch.Generator().manual_seed(int(state[0]) << 31 ^ int(state[1]))


def choose_frames(available: int, wanted: int, skip_probability: float, generator: torch.Generator) -> Tensor:
    """Indices (wanted,) in ascending order: a contiguous run, or a random subset (larger and uneven motion).

    Raises:
        ValueError: fewer frames available than wanted.
    """
    if available < wanted:
        raise ValueError(f"clips have {available} frames, {wanted} wanted")
    if float(torch.rand((), generator=generator)) < skip_probability:
        return torch.randperm(available, generator=generator)[:wanted].sort().values
    start = int(torch.randint(0, available - wanted + 1, (), generator=generator))
    return torch.arange(start, start + wanted)


def random_crop(clips: TrainingClips, height: int, width: int, generator: torch.Generator) -> TrainingClips:
    """Cut one random window of (height, width) out of all clips; the principal point moves with it."""
    rows, columns = clips.voxels.shape[-2:]
    top = int(torch.randint(0, rows - height + 1, (), generator=generator))
    left = int(torch.randint(0, columns - width + 1, (), generator=generator))
    window = (..., slice(top, top + height), slice(left, left + width))
    shift = torch.tensor([0.0, 0.0, -left, -top])
    return replace(
        clips, voxels=clips.voxels[window], inv_depths=clips.inv_depths[window], intrinsics=clips.intrinsics + shift
    )


def zoom(clips: TrainingClips, factor: float) -> TrainingClips:
    """Resize by `factor`: voxels bilinear, inverse depth nearest, intrinsics scaled about pixel centres."""
    height, width = (round(side * factor) for side in clips.voxels.shape[-2:])
    voxels = F.interpolate(clips.voxels.flatten(0, 1), (height, width), mode="bilinear", align_corners=False)
    depths = F.interpolate(clips.inv_depths.flatten(0, 1)[:, None], (height, width), mode="nearest-exact")[:, 0]
    old_height, old_width = clips.voxels.shape[-2:]
    scale = torch.tensor([width / old_width, height / old_height] * 2)
    intrinsics = clips.intrinsics * scale
    intrinsics[..., 2:] += 0.5 * scale[2:] - 0.5  # integer coordinates are pixel centres
    return replace(
        clips,
        voxels=voxels.view(*clips.voxels.shape[:3], height, width),
        inv_depths=depths.view(*clips.inv_depths.shape[:2], height, width),
        intrinsics=intrinsics,
    )


def reflect(clips: TrainingClips, axis: int) -> TrainingClips:
    """Mirror images and world: axis 0 left-right, axis 1 top-bottom.

    With S = diag(-1,1,1) (or diag(1,-1,1)) each pose becomes S T S: the translation is reflected, the rotation
    quaternion keeps its component along the mirrored axis and its scalar part.
    """
    side = clips.voxels.shape[-1 - axis]
    flip = torch.tensor([[-1.0, 1, 1, 1, -1, -1, 1], [1.0, -1, 1, -1, 1, -1, 1]][axis])
    intrinsics = clips.intrinsics.clone()
    intrinsics[..., 2 + axis] = side - 1 - intrinsics[..., 2 + axis]
    return TrainingClips(
        clips.voxels.flip(-1 - axis), clips.world_T_cam * flip, clips.inv_depths.flip(-1 - axis), intrinsics
    )


def reverse_time(clips: TrainingClips) -> TrainingClips:
    """Play clips backwards: frames in the opposite order, bins in the opposite order, polarity negated."""
    return TrainingClips(-clips.voxels.flip(1, 2), *(value.flip(1) for value in clips.tensors()[1:]))


def disturb(voxels: Tensor, settings: AugmentSettings, generator: torch.Generator) -> Tensor:
    """Shot noise, hot pixels and uneven event rate, drawn per clip; `voxels` (B,n,5,H,W) is changed in place."""
    clips, frames, bins, height, width = voxels.shape
    for clip in voxels:
        chance = torch.rand(3, generator=generator)
        if chance[0] < settings.thinning:
            clip *= 0.6 + 0.8 * torch.rand(frames, bins, 1, 1, generator=generator)
        if chance[1] < settings.noise:
            density = settings.noise_density * float(torch.rand((), generator=generator)) ** 2
            count = int(density * clip.numel())
            cells = torch.randint(0, clip.numel(), (count,), generator=generator)
            sign = torch.randint(0, 2, (count,), generator=generator) * 2.0 - 1.0
            clip.view(-1).index_add_(0, cells, sign * torch.rand(count, generator=generator))
        if chance[2] < settings.hot_pixels:
            count = int(torch.randint(1, settings.hot_pixel_count + 1, (), generator=generator))
            rows = torch.randint(0, height, (count,), generator=generator)
            columns = torch.randint(0, width, (count,), generator=generator)
            clip[:, :, rows, columns] += 3.0 * torch.randn(count, generator=generator)
    return voxels


def augment(
    clips: TrainingClips, frames: int, size: tuple[int, int], settings: AugmentSettings, generator: torch.Generator
) -> TrainingClips:
    """Draw `frames` frames and a window of `size` (height, width) from `clips` and disturb them."""
    clips = clips.frames(choose_frames(clips.voxels.shape[1], frames, settings.skip_frames, generator)).to("cpu")
    if float(torch.rand((), generator=generator)) < settings.zoom:
        height, width = clips.voxels.shape[-2:]
        smallest = max(size[0] / height, size[1] / width)
        exponent = settings.zoom_range * (2.0 * float(torch.rand((), generator=generator)) - 1.0)
        clips = zoom(clips, max(2.0**exponent, smallest))
    clips = random_crop(clips, *size, generator)
    if float(torch.rand((), generator=generator)) < settings.reverse:
        clips = reverse_time(clips)
    if float(torch.rand((), generator=generator)) < settings.mirror:
        clips = reflect(clips, 0)
    if float(torch.rand((), generator=generator)) < settings.upside_down:
        clips = reflect(clips, 1)
    sign = 1.0 - 2.0 * (torch.rand(len(clips.voxels), generator=generator) < settings.polarity_flip).float()
    voxels = disturb(clips.voxels * sign[:, None, None, None, None], settings, generator)
    return replace(clips, voxels=voxels).with_unit_depth()
