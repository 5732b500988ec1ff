"""Correlation of patch features with a window of a feature map around each reprojected patch pixel."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from devo.altcorr.windows import blend, check_edges, pixel_rows, split_coords, spread, window_rows
from devo.device import random_home
from devo.errors import InputError
from devo.kernels import cuda_kernel

CHUNK_ELEMENTS = {"cpu": 1 << 22, "other": 1 << 26}
"""Feature values gathered at a time; bounds the temporary memory whatever the number of edges."""


def corr(
    fmap1: Tensor,
    fmap2: Tensor,
    coords: Tensor,
    ii: Tensor,
    jj: Tensor,
    radius: int = 1,
    dropout: float = 1,
    *,
    generator: torch.Generator | None = None,
    chunk_edges: int | None = None,
) -> Tensor:
    """Correlate every patch pixel with the feature map around its position, sampled bilinearly at integer shifts.

    `out[e, b, a, i, j] = <fmap1[ii_e, :, i, j], fmap2[jj_e] at (x + b - R, y + a - R)>` with maps that are zero
    outside, rounded to the integer pixel by floor and blended bilinearly; no normalisation.

    Args:
        fmap1: (1, K, C, P, P) patch features.
        fmap2: (1, F, C, H, W) feature maps of the same dtype; any C.
        coords: (1, E, 2, P, P) float32 (float64 with float64 maps) positions (x, y) in pixels of `fmap2`.
        ii: (E,) int64, row of `fmap1` for each edge.
        jj: (E,) int64, row of `fmap2` for each edge.
        radius: R, largest shift.
        dropout: probability with which an edge takes part in the backward pass, without rescaling; the forward
            pass is never affected.
        generator: source of the randomness of `dropout`.
        chunk_edges: edges handled at a time, by default what keeps temporaries small; the result does not depend on it.

    Returns:
        (1, E, 2R+1, 2R+1, P, P) in the dtype of the maps, the shift along x first, then along y. NaN or infinite
        coordinates give NaN, large ones lie outside and give zero. Differentiable to both maps, not to `coords`.

    Raises:
        InputError: shapes or dtypes do not fit together, or `dropout` is not a probability.
    """
    _check(fmap1, fmap2, coords, ii, jj, radius, dropout)
    extension = cuda_kernel("altcorr", fmap1, fmap2, coords, ii, jj)
    keep = None
    if dropout < 1 and torch.is_grad_enabled() and (fmap1.requires_grad or fmap2.requires_grad):
        keep = draw_kept_edges(len(ii), dropout, coords.device, generator)
    if extension is not None:
        return extension.corr(fmap1, fmap2, coords, ii, jj, radius, keep)
    side, patch, channels = 2 * radius + 2, fmap1.shape[-1], fmap1.shape[2]
    elements = CHUNK_ELEMENTS["cpu" if fmap1.device.type == "cpu" else "other"]
    chunk = chunk_edges or max(1, elements // max(1, side * side * patch * patch * channels))
    with torch.autocast(fmap1.device.type, enabled=False):
        return _Corr.apply(fmap1, fmap2, coords.detach(), ii, jj, radius, keep, chunk)


def draw_kept_edges(edges: int, keep: float, device: torch.device, generator: torch.Generator | None) -> Tensor:
    """Numbers (int64, increasing) of the edges that an independent coin of probability `keep` selects."""
    coins = torch.rand(edges, generator=generator, device=random_home(generator))
    return torch.nonzero(coins < keep).squeeze(1).to(device)


def _check(fmap1: Tensor, fmap2: Tensor, coords: Tensor, ii: Tensor, jj: Tensor, radius: int, dropout: float) -> None:
    patch = fmap1.shape[-1]
    if fmap1.dim() != 5 or fmap2.dim() != 5 or fmap1.shape[0] != 1 or fmap2.shape[0] != 1:
        found = f"{tuple(fmap1.shape)} and {tuple(fmap2.shape)}"
        raise InputError(f"corr got maps of shape {found}; expected (1, K, C, P, P) and (1, F, C, H, W)")
    if fmap1.shape[2] != fmap2.shape[2] or fmap1.dtype != fmap2.dtype:
        found = f"{fmap1.shape[2]} x {fmap1.dtype} and {fmap2.shape[2]} x {fmap2.dtype}"
        raise InputError(f"corr got patch and map features of {found}; expected the same channels and dtype")
    check_edges("corr", coords, ii, jj, patch)
    if radius < 0 or not 0 <= dropout <= 1:
        raise InputError(f"corr got radius={radius}, dropout={dropout}; expected radius >= 0 and 0 <= dropout <= 1")


class _Corr(torch.autograd.Function):
    """`corr` in chunks of edges; the backward pass gathers the windows again instead of storing them."""

    @staticmethod
    def forward(
        ctx: Any,
        fmap1: Tensor,
        fmap2: Tensor,
        coords: Tensor,
        ii: Tensor,
        jj: Tensor,
        radius: int,
        keep: Tensor | None,
        chunk: int,
    ) -> Tensor:
        ctx.save_for_backward(fmap1, fmap2, coords, ii, jj, keep)
        ctx.radius, ctx.chunk = radius, chunk
        patch, side = fmap1.shape[-1], 2 * radius + 1
        patches, pixels = fmap1[0].flatten(2).transpose(1, 2), pixel_rows(fmap2[0])
        out = fmap1.new_empty(len(ii), side, side, patch, patch)
        for first in range(0, len(ii), chunk):
            part = slice(first, first + chunk)
            window = _Windows(coords[0, part], jj[part], fmap2, radius)
            features = patches[ii[part]].reshape(-1, 1, fmap1.shape[2])
            # (1, C) x (C, D*D): unlike its transpose, this product does not depend on the size of the chunk
            products = torch.bmm(features, window.gather(pixels).transpose(1, 2)).squeeze(1)
            volume = products.masked_fill_(~window.inside, 0).unflatten(1, (side + 1, side + 1))
            blended = blend(volume, window.dx, window.dy).unflatten(0, (-1, patch, patch))
            out[part] = blended.permute(0, 4, 3, 1, 2)
        return out[None]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        fmap1, fmap2, coords, ii, jj, keep = ctx.saved_tensors
        grad, coords = grad[0], coords[0]
        if keep is not None:
            grad, coords, ii, jj = grad[keep], coords[keep], ii[keep], jj[keep]
        patch, channels = fmap1.shape[-1], fmap1.shape[2]
        # half-precision sums of many small terms stall, so gradients are accumulated in at least float32
        total = torch.promote_types(fmap1.dtype, torch.float32)
        patches, pixels = fmap1[0].flatten(2).transpose(1, 2).to(total), pixel_rows(fmap2[0])
        grad1, grad2 = torch.zeros_like(patches), torch.zeros_like(pixels, dtype=total)
        for first in range(0, len(ii), ctx.chunk):
            part = slice(first, first + ctx.chunk)
            window = _Windows(coords[part], jj[part], fmap2, ctx.radius)
            incoming = grad[part].permute(0, 3, 4, 2, 1).flatten(0, 2).to(total)
            volume = spread(incoming, window.dx.to(total), window.dy.to(total)).flatten(1)
            volume = volume.masked_fill_(~window.inside, 0)
            if ctx.needs_input_grad[0]:
                towards1 = torch.bmm(volume[:, None], window.gather(pixels).to(total)).view(-1, patch * patch, channels)
                grad1.index_add_(0, ii[part], towards1)
            if ctx.needs_input_grad[1]:
                features = patches[ii[part]].reshape(-1, 1, channels)
                grad2.index_add_(0, window.rows.flatten(), (volume[..., None] * features).flatten(0, 1))
        grad1 = grad1.transpose(1, 2).reshape(fmap1.shape).to(fmap1.dtype)
        grad2 = grad2.view(*fmap2.shape[1:2], *fmap2.shape[3:], channels).permute(0, 3, 1, 2)[None].to(fmap2.dtype)
        needed1, needed2 = ctx.needs_input_grad[:2]
        return (grad1 if needed1 else None, grad2 if needed2 else None, *[None] * 6)


class _Windows:
    """The windows of a chunk of edges: one per patch pixel, (edges * P * P) of them."""

    def __init__(self, coords: Tensor, jj: Tensor, maps: Tensor, radius: int) -> None:
        patch = coords.shape[-1]
        base, fraction = split_coords(coords.flatten(2).transpose(0, 1).flatten(1))
        base = base.long()
        self.dx, self.dy = fraction.to(maps.dtype)
        frame = jj.repeat_interleave(patch * patch)
        self.rows, self.inside = window_rows(base[0], base[1], frame, (maps.shape[-2], maps.shape[-1]), radius)

    def gather(self, pixels: Tensor) -> Tensor:
        """Features (windows, D*D, C) from pixels (F*H*W, C); what lies outside holds some arbitrary pixel."""
        return pixels.index_select(0, self.rows.flatten()).unflatten(0, self.rows.shape)
