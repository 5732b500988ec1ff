"""Voxel grids straight from crossings, without a list of events in between."""

from __future__ import annotations

import torch

from utils.simulator.events import Crossings

BINS = 5


def accumulate_step(grid: torch.Tensor, crossings: Crossings, lower_bin: int, start: float, length: float) -> None:
    """Add the events of one step to a voxel grid, split linearly in time between two bins (in place).

    The step lies between `lower_bin` and the next bin and covers the fractions `start .. start + length` of that
    interval. With the crossing fractions `f + k d`, k < n, the sum of the n shares of the upper bin is
    `n start + length (n f + d n (n - 1) / 2)`; the lower bin gets the rest.

    Args:
        grid: `(5, ...)` float32, trailing shape of the pixels.
        crossings: the events.
        lower_bin: 0 .. 3.
        start: in bins.
        length: in bins.
    """
    count = crossings.count
    series = torch.addcmul(crossings.first, crossings.spacing, (count - 1.0).mul_(0.5)).clamp_(0.0, 1.0)
    upper = series.mul_(length).add_(start).mul_(count).mul_(crossings.sign)
    grid[lower_bin + 1].add_(upper)
    grid[lower_bin].addcmul_(count, crossings.sign).sub_(upper)


def scatter_events(voxels: torch.Tensor, pixel: torch.Tensor, time: torch.Tensor, sign: torch.Tensor) -> None:
    """Add single events to the grids of adjacent windows, split linearly in time (in place).

    Args:
        voxels: `(n, 5, H, W)` float32, contiguous.
        pixel: `(K,)` int64 flat pixel index.
        time: `(K,)` float32 in windows, `0 <= time < n`.
        sign: `(K,)` -1 or +1.
    """
    area = voxels.shape[-2] * voxels.shape[-1]
    window = time.floor()
    bins = (time - window) * (BINS - 1)
    lower = bins.floor().clamp(0, BINS - 2)
    share = bins - lower
    cell = (window.long() * BINS + lower.long()) * area + pixel
    flat = voxels.view(-1)
    flat.index_add_(0, cell, (1.0 - share) * sign)
    flat.index_add_(0, cell + area, share * sign)
