"""Small tensor helpers of the network and the tracker."""

from __future__ import annotations

from types import TracebackType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor


class Timer:
    """Context manager that measures the time of work on a CUDA device in milliseconds.

    After the block `elapsed_ms` holds the time; it stays `None` when `enabled` is false or there is no CUDA device.
    """

    def __init__(self, name: str, enabled: bool = True) -> None:
        self.name = name
        self.enabled = enabled and torch.cuda.is_available()
        self.elapsed_ms: float | None = None
        self._events: tuple[Any, Any] | None = None

    def __enter__(self) -> Timer:
        if self.enabled:
            self._events = (torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True))
            self._events[0].record()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._events is not None:
            start, end = self._events
            end.record()
            torch.cuda.synchronize()
            self.elapsed_ms = start.elapsed_time(end)


def coords_grid_with_index(inv_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel grid with inverse depth, and the frame index of every pixel.

    Args:
        inv_depth: (B,n,h,w).

    Returns:
        `(grid, index)`: (B,n,3,h,w) channels x (column), y (row), inverse depth in the dtype of `inv_depth`, and
        (B,n,1,h,w) int64 position of the frame along n.
    """
    batch, frames, height, width = inv_depth.shape
    y, x = torch.meshgrid(
        torch.arange(height, dtype=inv_depth.dtype, device=inv_depth.device),
        torch.arange(width, dtype=inv_depth.dtype, device=inv_depth.device),
        indexing="ij",
    )
    grid = torch.stack((x.expand_as(inv_depth), y.expand_as(inv_depth), inv_depth), dim=2)
    frame = torch.arange(frames, device=inv_depth.device).view(1, frames, 1, 1, 1)
    return grid, frame.expand(batch, -1, -1, height, width)


def pyramidify(fmap: Tensor, lvls: tuple[int, ...] = (1,)) -> list[Tensor]:
    """Average-pool feature maps to coarser resolutions.

    Args:
        fmap: (B,n,C,h,w).
        lvls: for each level the factor by which it is coarser.

    Returns:
        For each level s a tensor (B,n,C,h//s,w//s), means over s x s pixels.
    """
    batch, frames = fmap.shape[:2]
    flat = fmap.flatten(0, 1)
    return [F.avg_pool2d(flat, level, stride=level).unflatten(0, (batch, frames)) for level in lvls]


def set_depth(patches: Tensor, depth: Tensor) -> Tensor:
    """Write one inverse depth for each patch to all its pixels, in place.

    Args:
        patches: (...,3,P,P), channels x, y, inverse depth.
        depth: (...) inverse depths.

    Returns:
        `patches`.
    """
    patches[..., 2, :, :] = depth[..., None, None]
    return patches


def flatmeshgrid(*vectors: Tensor, indexing: str = "ij") -> tuple[Tensor, ...]:
    """All combinations of the entries of vectors, as one flat vector for each of them.

    Args:
        vectors: 1-D tensors.
        indexing: `ij` (last vector runs fastest) or `xy`, as `torch.meshgrid`.

    Returns:
        As many 1-D tensors, each as long as the product of the lengths.
    """
    return tuple(axis.reshape(-1) for axis in torch.meshgrid(*vectors, indexing=indexing))
