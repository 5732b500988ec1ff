"""Correlation volumes of all (patch, frame) pairs of a sample, looked up many times with moving positions.

Training repeats the lookup several times on the same maps. Here the products of every patch pixel with every map pixel
of its clip are computed once, in one matrix product per level; a lookup only copies short rows out of them. Backward
passes of all lookups add into one buffer, and one more pair of matrix products turns that into map gradients.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from devo.altcorr.windows import split_coords, spread

CHUNK_EDGES = {"cpu": 1024, "cuda": 1 << 17}
"""Edges looked up at a time: temporaries stay in the cache of a CPU, and few calls are made on a GPU."""
MAX_VOLUME_ELEMENTS = (1 << 31) - (1 << 12)
"""Products of one volume: they and the zeros before them are numbered in 32 bits."""


class Volume:
    """Products of all patch pixels with all map pixels of the same clip, at one pyramid level.

    Every map row is followed by D zero columns (and the first one preceded by them), so a row of D values that starts
    up to D pixels before or right behind the map row reads zeros, without any mask.

    Args:
        gmap: (1, K, C, P, P) patch features, clip after clip; their dtype is that of the products.
        maps: (1, F, C, H, W) feature maps of the same dtype, clip after clip.
        radius: R of the windows; D = 2R+2.
        clips: number of equally long clips in the sample.
    """

    def __init__(self, gmap: Tensor, maps: Tensor, radius: int, clips: int) -> None:
        channels, self.dtype = gmap.shape[2], gmap.dtype
        self.radius, self.side = radius, 2 * radius + 2
        self.height, self.width = maps.shape[-2:]
        self.stride = self.width + self.side
        self.frames, self.pixels = maps.shape[1] // clips, gmap.shape[-1] ** 2
        self.shape = volume_shape(gmap, maps, radius, clips)
        self.products: Tensor | None = None
        self.gradient: Tensor | None = None
        rows = gmap[0].flatten(2).transpose(1, 2).reshape(clips, -1, channels)
        padded = torch.nn.functional.pad(maps[0].permute(0, 2, 3, 1), (0, 0, 0, self.side))
        # the products themselves stay out of the autograd graph: what is differentiated is this token
        self.token = _Products.apply(rows, padded.reshape(clips, -1, channels), self)

    def fill(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Multiply (clips, K/clips * P*P, C) patch pixels with (clips, F/clips * H * stride, C) map pixels."""
        self.rows, self.columns = rows, columns
        products = torch.empty(self.side + math.prod(self.shape), dtype=self.dtype, device=rows.device)
        products[: self.side] = 0
        torch.bmm(rows, columns.transpose(1, 2), out=products[self.side :].view(self.shape))
        self.products = products
        return products

    def row_starts(self, coords: Tensor, kk: Tensor, jj: Tensor) -> tuple[Tensor, Tensor]:
        """Where the window rows of (E, 2, P*P) positions begin, (E*P*P, D) int32, and the fractions (2, E*P*P, 1)."""
        base, fraction = split_coords(coords)
        x = (base[:, 0] - self.radius).clamp_(-self.side, self.width).int()
        y = (base[:, 1] - self.radius).clamp_(-self.side, self.height).int()
        pixel = torch.arange(self.pixels, device=kk.device, dtype=torch.int32)
        matrix_row = (kk.int() * self.pixels)[:, None] + pixel
        first = (matrix_row * self.frames + (jj.int() % self.frames)[:, None]) * (self.height * self.stride) + self.side
        rows = y[..., None] + torch.arange(self.side, device=kk.device, dtype=torch.int32)
        outside = (rows < 0) | (rows >= self.height)
        start = rows.mul_(self.stride).add_((first + x)[..., None])
        # rows above and below the map read the zeros behind its first row
        start = torch.where(outside, (first + self.width)[..., None], start)
        return start.flatten(0, 1), fraction.transpose(0, 1).flatten(1)[..., None]

    def look_up(self, coords: Tensor, kk: Tensor, jj: Tensor, out: Tensor) -> None:
        """Blend the windows at (E, 2, P*P) positions into `out` (E, x-shift, y-shift, P*P)."""
        products = self.fill(self.rows, self.columns) if self.products is None else self.products
        side, runs = self.side, products.as_strided((len(products) - self.side + 1, self.side), (1, 1))
        start, fraction = self.row_starts(coords, kk, jj)
        blending = torch.promote_types(out.dtype, torch.float32)
        window = runs.index_select(0, start.view(-1)).view(len(start), -1).to(blending)
        dx, dy = fraction.to(blending)
        # the window is blended as one run, row after row; the values between the rows are never read
        along_x = torch.lerp(window[:, :-1], window[:, 1:], dx)
        blended = torch.lerp(along_x[:, :-side], along_x[:, side:], dy).to(out.dtype)
        run = blended.shape[1]
        out.copy_(blended.as_strided(out.shape, (self.pixels * run, 1, side, run)))

    def add_gradient(self, coords: Tensor, kk: Tensor, jj: Tensor, grad: Tensor) -> None:
        """Transpose of `look_up`: add gradients (E, x-shift, y-shift, P*P) to those of the products."""
        if self.gradient is None:
            # the backward pass needs positions only, so the products make room for their gradient
            size = self.side + math.prod(self.shape)
            spare = grad.new_empty(size, dtype=self.dtype) if self.products is None else self.products
            self.products, self.gradient = None, spare.zero_()
        start, fraction = self.row_starts(coords, kk, jj)
        dx, dy = fraction[..., 0].to(torch.promote_types(grad.dtype, torch.float32))
        window = spread(grad.permute(0, 3, 2, 1).flatten(0, 1).to(dx.dtype), dx, dy).to(self.dtype)
        places = start[..., None] + torch.arange(self.side, device=start.device, dtype=torch.int32)
        self.gradient.index_add_(0, places.view(-1), window.view(-1))

    def map_gradients(self) -> tuple[Tensor, Tensor]:
        """Gradients of the `fill` arguments; the gradient of the products is used up."""
        if self.gradient is None:
            return torch.zeros_like(self.rows), torch.zeros_like(self.columns)
        gradient, self.gradient = self.gradient[self.side :].view(self.shape), None
        towards_columns = torch.bmm(self.rows.transpose(1, 2), gradient).transpose(1, 2)
        return torch.bmm(gradient, self.columns), towards_columns


def volume_shape(gmap: Tensor, maps: Tensor, radius: int, clips: int) -> tuple[int, int, int]:
    """Shape of the products that a `Volume` of these maps stores."""
    rows = gmap.shape[1] // clips * gmap.shape[-1] ** 2
    return clips, rows, maps.shape[1] // clips * maps.shape[-2] * (maps.shape[-1] + 2 * radius + 2)


def look_up(
    volumes: list[Volume],
    scales: tuple[int, ...],
    coords: Tensor,
    kk: Tensor,
    jj: Tensor,
    keep: Tensor | None,
    dtype: torch.dtype,
) -> Tensor:
    """Features of all levels, differentiable to the maps of the volumes.

    Args:
        volumes: one per level.
        scales: divisor of the positions at each level.
        coords: (E, 2, P*P) positions (x, y) in pixels of scale 1.
        kk: (E,) int64 patch of each edge.
        jj: (E,) int64 frame of each edge, in the same clip.
        keep: int64 numbers of the edges that take part in the backward pass; `None` for all.
        dtype: dtype of the result.

    Returns:
        (E, x-shift, y-shift, P*P, levels).
    """
    tokens = [volume.token for volume in volumes]
    return _Lookup.apply(coords, kk, jj, keep, volumes, scales, dtype, *tokens)


class _Products(torch.autograd.Function):
    """Fills a `Volume`; its backward pass runs after those of all lookups and turns their sum into map gradients."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, columns: Tensor, volume: Volume) -> Tensor:
        volume.fill(rows, columns)
        ctx.volume = volume
        return rows.new_zeros(())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor, Tensor, None]:
        return (*ctx.volume.map_gradients(), None)


class _Lookup(torch.autograd.Function):
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
        for part in _chunks(kk):
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
        for part in _chunks(kk):
            for level, (volume, scale) in enumerate(zip(ctx.volumes, ctx.scales, strict=True)):
                volume.add_gradient(coords[part] / scale, kk[part], jj[part], grad[part, ..., level])
        return (*[None] * 7, *(grad.new_zeros((), dtype=volume.dtype) for volume in ctx.volumes))


def _chunks(edges: Tensor) -> list[slice]:
    step = CHUNK_EDGES.get(edges.device.type, CHUNK_EDGES["cpu"])
    return [slice(first, first + step) for first in range(0, len(edges), step)]
