"""Correlation for training: all patches times all frames of a clip once per sample, windows looked up per update.

The same features as `devo.altcorr.corr` on two levels, cheaper where every patch meets every frame several times. Maps
carry a margin of zeros before the first column and after each one (columns are stored one after the other): a window
that leaves the map anywhere reads a margin, so no lookup needs a mask.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

RADIUS = 3
SIDE = 2 * RADIUS + 2  # integer shifts per axis, one more than the 2R+1 blended ones
MARGIN = SIDE


class CorrelationVolume:
    """Lookup of correlation windows, differentiable to features, not to coordinates.

    Args:
        fmap: (1,B*n,C,h,w) float32 feature maps of B joined clips.
        gmap: (1,B*n*M,C,P,P) float32 patch features, clip-major.
        clips: B.
        keep: share of the (patch, frame) pairs, per frame, that take part in the backward pass, without rescaling. The
            published training draws edges anew at every lookup; here the pairs of a sample are drawn once.
        dtype: type of the stored products, float32 or bfloat16.
        levels: pooling factors of the maps.
    """

    def __init__(
        self,
        fmap: Tensor,
        gmap: Tensor,
        clips: int,
        keep: float = 0.2,
        dtype: torch.dtype = torch.float32,
        levels: tuple[int, ...] = (1, 4),
    ) -> None:
        frames = fmap.shape[1]
        patches, pixels = gmap.shape[1], gmap.shape[-1] ** 2
        self.per_clip, self.pixels, self.clips = patches // clips, pixels, clips
        self.frames_per_clip = frames // clips
        rows = gmap[0].flatten(2).transpose(1, 2).reshape(clips, self.per_clip * pixels, -1)
        kept = max(1, round(keep * self.per_clip)) if keep < 1 else self.per_clip
        pairs = torch.rand(frames, self.per_clip).topk(kept, dim=1).indices.to(fmap.device)
        slots = torch.full((frames, self.per_clip), -1, dtype=torch.int64, device=fmap.device)
        slots.scatter_(1, pairs, torch.arange(frames * kept, device=fmap.device).view(frames, kept))
        self.slots, self.pairs = slots.view(-1), pairs
        self.levels = []
        for factor in levels:
            maps = fmap[0] if factor == 1 else F.avg_pool2d(fmap[0], factor, factor)
            self.levels.append(_Level(self, rows, maps, factor, dtype))

    def __call__(self, kk: Tensor, jj: Tensor, coords: Tensor) -> Tensor:
        """Correlation features.

        Args:
            kk, jj: (E,) patch and frame of each edge, of the same clip.
            coords: (1,E,2,P,P) float32 quarter-resolution pixels (x,y).

        Returns:
            (1,E,98*P*P) in the storage type, order x-shift, y-shift, row, column, level.
        """
        pair = jj * self.per_clip + kk % self.per_clip
        flat = coords[0].flatten(2)
        both = [level.lookup(pair, flat) for level in self.levels]
        return torch.stack(both, dim=-1).view(1, len(kk), -1)


class _Level:
    """Products of one pyramid level, stored as (frame, patch of the clip, pixel, margin + height, width + margin)."""

    def __init__(self, volume: CorrelationVolume, rows: Tensor, maps: Tensor, factor: int, dtype: torch.dtype) -> None:
        self.volume, self.factor = volume, factor
        self.height, self.width = maps.shape[-2:]
        self.row = self.width + MARGIN  # maps are stored transposed below: x is the slow axis
        self.column = self.height + MARGIN
        self.area = self.row * self.column
        self.gradient: Tensor | None = None
        self.products = torch.zeros(0)
        self.token = _Build.apply(rows, maps, self, dtype)

    def padded(self, maps: Tensor) -> Tensor:
        """(F,C,h,w) -> (F,C,(margin+w)*(h+margin)), x slow, zeros before the first columns and after each row."""
        return F.pad(maps.transpose(2, 3), (0, MARGIN, MARGIN, 0)).flatten(2)

    def unpadded(self, gradient: Tensor) -> Tensor:
        """Inverse of `padded`, for gradients."""
        return gradient.view(*gradient.shape[:2], self.row, self.column)[:, :, MARGIN:, : self.height].transpose(2, 3)

    def lookup(self, pair: Tensor, coords: Tensor) -> Tensor:
        """(E,7,7,P*P) blended windows of pairs (E,) at full-level coordinates (E,2,P*P)."""
        return _Lookup.apply(self.token, self, pair, coords / self.factor)

    def window_starts(self, pair: Tensor, coords: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """First elements (E,8,P*P) of the windows' columns, counted from the pair's maps; fractions (E,P*P)."""
        base = coords.floor()
        x_fraction, y_fraction = (coords - base).unbind(1)
        x = base[:, 0].nan_to_num(-1e6).clamp(-1e6, 1e6).long().sub_(RADIUS).clamp_(-MARGIN, self.width) + MARGIN
        y = base[:, 1].nan_to_num(-1e6).clamp(-1e6, 1e6).long().sub_(RADIUS).clamp_(-MARGIN, self.height)
        pixel = torch.arange(coords.shape[2], device=coords.device) * self.area
        start = x * self.column + y + pixel
        shifts = torch.arange(SIDE, device=coords.device) * self.column
        return start[:, None] + shifts[:, None], x_fraction, y_fraction


class _Build(torch.autograd.Function):
    """Fills the products; its output is a token that ties lookups to the features in the autograd graph."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, maps: Tensor, level: _Level, dtype: torch.dtype) -> Tensor:
        volume = level.volume
        frames = volume.frames_per_clip
        padded = level.padded(maps).to(dtype)
        count = len(maps) * rows.shape[1] * level.area
        # windows at the outermost corners reach one margin beyond the first and the last map
        store = torch.empty(count + 2 * MARGIN * (level.column + 1), dtype=dtype, device=maps.device)
        edge = MARGIN * (level.column + 1)
        store[:edge] = 0
        store[edge + count :] = 0
        products = store[edge : edge + count].view(volume.clips, frames, rows.shape[1], level.area)
        for clip in range(volume.clips):
            left = rows[clip].to(dtype).expand(frames, -1, -1)
            torch.bmm(left, padded[clip * frames : (clip + 1) * frames], out=products[clip])
        level.products = store
        ctx.level = level
        ctx.save_for_backward(rows, maps)
        return maps.new_zeros(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, token_gradient: Tensor) -> tuple[Tensor | None, ...]:
        level, (rows, maps) = ctx.level, ctx.saved_tensors
        if level.gradient is None:
            return torch.zeros_like(rows), torch.zeros_like(maps), None, None
        volume = level.volume
        kept = volume.pairs.shape[1]
        gradient = level.gradient[MARGIN * (level.column + 1) :][: len(maps) * kept * volume.pixels * level.area]
        gradient = gradient.view(len(maps), kept * volume.pixels, level.area)
        clip = torch.arange(len(maps), device=maps.device)[:, None] // volume.frames_per_clip
        chosen = (clip * volume.per_clip + volume.pairs).view(-1)
        features = rows.reshape(volume.clips * volume.per_clip, volume.pixels, -1)
        left = features.index_select(0, chosen).view(len(maps), kept * volume.pixels, -1)
        to_maps = level.unpadded(torch.bmm(left.transpose(1, 2), gradient))
        to_left = torch.bmm(gradient, level.padded(maps).transpose(1, 2))
        to_rows = torch.zeros_like(features).index_add_(0, chosen, to_left.view(len(chosen), volume.pixels, -1))
        level.gradient = None
        return to_rows.view_as(rows), to_maps, None, None


class _Lookup(torch.autograd.Function):
    """Gather windows and blend them; the backward pass adds to the level's one gradient buffer."""

    @staticmethod
    def forward(ctx: Any, token: Tensor, level: _Level, pair: Tensor, coords: Tensor) -> Tensor:
        starts, x_fraction, y_fraction = level.window_starts(pair, coords)
        ctx.level = level
        ctx.save_for_backward(pair, coords)
        stride = level.volume.pixels * level.area
        rows = (starts + (pair * stride + MARGIN * (level.column + 1))[:, None, None]).view(-1)
        store = level.products
        window = store.as_strided((len(store) - SIDE + 1, SIDE), (1, 1)).index_select(0, rows)
        window = window.view(*starts.shape, SIDE).float()
        x_fraction, y_fraction = x_fraction[:, None, :, None], y_fraction[:, None, :, None]
        window = torch.lerp(window[:, :-1], window[:, 1:], x_fraction)
        window = torch.lerp(window[..., :-1], window[..., 1:], y_fraction)
        return window.transpose(2, 3).to(store.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        level, (pair, coords) = ctx.level, ctx.saved_tensors
        slot = level.volume.slots.index_select(0, pair)
        kept = (slot >= 0).nonzero()[:, 0]
        slot = slot.index_select(0, kept)
        starts, x_fraction, y_fraction = level.window_starts(pair, coords.index_select(0, kept))
        x_fraction, y_fraction = x_fraction[:, None, :, None], y_fraction[:, None, :, None]
        gradient = gradient.index_select(0, kept).float().transpose(2, 3)
        upper = gradient * y_fraction
        spread = F.pad(gradient - upper, (0, 1)) + F.pad(upper, (1, 0))
        upper = spread * x_fraction
        spread = F.pad(spread - upper, (0, 0, 0, 0, 0, 1)) + F.pad(upper, (0, 0, 0, 0, 1, 0))
        edge = MARGIN * (level.column + 1)
        stride = level.volume.pixels * level.area
        if level.gradient is None:
            level.gradient = spread.new_zeros(level.volume.pairs.numel() * stride + 2 * edge)
        rows = starts + (slot * stride + edge)[:, None, None]
        cells = (rows[..., None] + torch.arange(SIDE, device=rows.device)).view(-1)
        level.gradient.index_add_(0, cells, spread.reshape(-1))
        return gradient.new_zeros(1), None, None, None
