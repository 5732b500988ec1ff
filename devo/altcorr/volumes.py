"""Correlation volumes of all (patch, frame) pairs of a sample, looked up many times with moving positions.

Training repeats the lookup several times on the same maps. Here the products of every patch pixel with every map pixel
of its clip are computed once, in one matrix product per level; a lookup only copies short rows out of them. Backward
passes of all lookups add into one buffer, and one more pair of matrix products turns that into map gradients.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from devo.altcorr.windows import spread, split_coords

CHUNK_EDGES = 1024
"""Edges looked up at a time, so that temporaries stay in the cache."""


class Volume:
    """Products of all patch pixels with all map pixels of the same clip, at one pyramid level.

    Every map row is followed by D zero columns (and the first one preceded by them), so a row of D values that starts
    up to D pixels before or right behind the map reads zeros, without any mask.

    Args:
        gmap: (1, K, C, P, P) patch features, clip after clip.
        maps: (1, F, C, H, W) feature maps, clip after clip.
        radius: R of the windows; D = 2R+2.
        clips: number of equally long clips in the sample.
        compute: dtype of the products; they are stored in it.
    """

    def __init__(self, gmap: Tensor, maps: Tensor, radius: int, clips: int, compute: torch.dtype) -> None:
        self.radius, self.side, self.clips, self.compute = radius, 2 * radius + 2, clips, compute
        self.height, self.width = maps.shape[-2:]
        self.stride = self.width + self.side
        self.patches, self.frames, self.pixels = gmap.shape[1] // clips, maps.shape[1] // clips, gmap.shape[-1] ** 2
        self.shape = (clips, self.patches * self.pixels, self.frames * self.height * self.stride)
        self.holds_gradient = False
        rows = gmap[0].flatten(2).transpose(1, 2).reshape(clips, -1, gmap.shape[2])
        columns = torch.nn.functional.pad(maps[0].permute(0, 2, 3, 1), (0, 0, 0, self.side)).reshape(
            clips, -1, gmap.shape[2]
        )
        # the products themselves stay out of the autograd graph: what is differentiated is this empty token
        self.token = _Products.apply(rows, columns, self)

    def fill(self, rows: Tensor, columns: Tensor) -> None:
        """Multiply (clips, K*P*P, C) patch pixels with (clips, F*H*stride, C) map pixels."""
        self.buffer = _reserve(self.side + math.prod(self.shape), self.compute, rows.device)
        self.buffer[: self.side] = 0
        torch.bmm(rows, columns.transpose(1, 2), out=self.matrices)

    @property
    def matrices(self) -> Tensor:
        """The buffer as (clips, K*P*P, F*H*stride) matrices."""
        return self.buffer[self.side :].view(self.shape)

    def row_starts(self, coords: Tensor, kk: Tensor, jj: Tensor) -> tuple[Tensor, Tensor]:
        """Where the window rows of (E, 2, P*P) positions begin, (E*P*P, D), and the fractions (2, E*P*P, 1)."""
        base, fraction = split_coords(coords)
        x = (base[:, 0] - self.radius).clamp_(-self.side, self.width)
        pixel = torch.arange(self.pixels, device=kk.device)
        row_of_patch = (kk * self.pixels)[:, None] + pixel
        first = (row_of_patch * self.frames + (jj % self.frames)[:, None]) * (self.height * self.stride) + self.side
        y = (base[:, 1] - self.radius)[..., None] + torch.arange(self.side, device=kk.device)
        outside = (y < 0) | (y >= self.height)
        start = y.mul_(self.stride).add_((first + x)[..., None])
        start = torch.where(outside, (first + self.width)[..., None], start)
        return start.flatten(0, 1), fraction.transpose(0, 1).flatten(1)[..., None]

    def look_up(self, coords: Tensor, kk: Tensor, jj: Tensor, out: Tensor) -> None:
        """Blend the windows at (E, 2, P*P) positions into `out` (E, x-shift, y-shift, P*P)."""
        side, runs = self.side, self.buffer.as_strided((len(self.buffer) - self.side + 1, self.side), (1, 1))
        start, fraction = self.row_starts(coords, kk, jj)
        window = runs.index_select(0, start.view(-1)).view(len(start), -1).to(out.dtype)
        dx, dy = fraction.to(out.dtype)
        # the window is blended as one run, row after row; the values between the rows are never read
        along_x = torch.lerp(window[:, :-1], window[:, 1:], dx)
        blended = torch.lerp(along_x[:, :-side], along_x[:, side:], dy)
        run = blended.shape[1]
        out.copy_(blended.as_strided(out.shape, (self.pixels * run, 1, side, run)))

    def add_gradient(self, coords: Tensor, kk: Tensor, jj: Tensor, grad: Tensor) -> None:
        """Transpose of `look_up`: add gradients (E, x-shift, y-shift, P*P) to those of the products."""
        if not self.holds_gradient:
            # the backward pass needs positions only, so the products make room for their gradient
            self.buffer.zero_()
            self.holds_gradient = True
        start, fraction = self.row_starts(coords, kk, jj)
        incoming = grad.permute(0, 3, 2, 1).flatten(0, 1)
        dx, dy = fraction[..., 0].to(grad.dtype)
        window = spread(incoming, dx, dy).to(self.compute)
        places = start[..., None] + torch.arange(self.side, device=start.device)
        self.buffer.index_add_(0, places.view(-1), window.view(-1))


class _Products(torch.autograd.Function):
    """Fills a `Volume`; its backward pass runs after those of all lookups and turns their sum into map gradients."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, columns: Tensor, volume: Volume) -> Tensor:
        rows, columns = rows.to(volume.compute), columns.to(volume.compute)
        volume.fill(rows, columns)
        ctx.save_for_backward(rows, columns)
        ctx.volume = volume
        return rows.new_zeros(())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        rows, columns = ctx.saved_tensors
        volume = ctx.volume
        towards_rows = torch.bmm(volume.matrices, columns)
        towards_columns = torch.bmm(volume.matrices.transpose(1, 2), rows)
        volume.holds_gradient = False
        return towards_rows, towards_columns, None


class Lookup(torch.autograd.Function):
    """Features (E, x-shift, y-shift, P*P, levels) at (E, 2, P*P) level-0 positions; gradients go to the volumes."""

    @staticmethod
    def forward(
        ctx: Any,
        coords: Tensor,
        kk: Tensor,
        jj: Tensor,
        keep: Tensor | None,
        volumes: list[Volume],
        scales: tuple[int, ...],
        dtype: torch.dtype,
        *tokens: Tensor,
    ) -> Tensor:
        side = volumes[0].side - 1
        out = torch.empty(len(kk), side, side, coords.shape[-1], len(volumes), dtype=dtype, device=coords.device)
        for first in range(0, len(kk), CHUNK_EDGES):
            part = slice(first, first + CHUNK_EDGES)
            for level, (volume, scale) in enumerate(zip(volumes, scales, strict=True)):
                volume.look_up(coords[part] / scale, kk[part], jj[part], out[part, ..., level])
        if keep is not None:
            coords, kk, jj = coords[keep], kk[keep], jj[keep]
        ctx.save_for_backward(coords, kk, jj, keep)
        ctx.volumes, ctx.scales = volumes, scales
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        coords, kk, jj, keep = ctx.saved_tensors
        if keep is not None:
            grad = grad[keep]
        for first in range(0, len(kk), CHUNK_EDGES):
            part = slice(first, first + CHUNK_EDGES)
            for level, (volume, scale) in enumerate(zip(ctx.volumes, ctx.scales, strict=True)):
                volume.add_gradient(coords[part] / scale, kk[part], jj[part], grad[part, ..., level])
        return (*[None] * 7, *(grad.new_zeros(()) for _ in ctx.volumes))


def _reserve(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A large flat tensor; on the CPU from NumPy, which asks for huge pages: touching them first is far cheaper."""
    if device.type != "cpu":
        return torch.empty(size, dtype=dtype, device=device)
    return torch.from_numpy(np.empty(size * dtype.itemsize, np.uint8)).view(dtype)
