"""`corr` and `patchify` on CUDA: the kernels of `kernels.cu` with the arguments and results of the torch twins.

Sums are accumulated in float32 (float64 for float64 maps) and rounded once. Gradients are added up by atomic
operations, so their last bits differ from run to run. Importing this module fails where the library is not built.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from devo.cuda_library import CudaLibrary
from devo.errors import InputError

SIGNATURES = {
    "devo_corr_forward": "iipppppiiiiiiiip",
    "devo_corr_backward": "iipppppppiiiiiiiipp",
    "devo_patchify_forward": "iippiiiiiiiiiiip",
    "devo_patchify_backward": "iippiiiiiiiiiiip",
}
MAP_TYPES = {torch.float32: 0, torch.float64: 1, torch.float16: 2, torch.bfloat16: 3}
LIBRARY = CudaLibrary("altcorr", SIGNATURES)


def corr(
    fmap1: Tensor,
    fmap2: Tensor,
    coords: Tensor,
    ii: Tensor,
    jj: Tensor,
    radius: int,
    keep: Tensor | None,
) -> Tensor:
    """Correlate patch pixels with map windows; arguments (already checked) and result of `devo.altcorr.corr`.

    `keep` holds the numbers (int64) of the edges that take part in the backward pass, None stands for all. An edge
    whose patch or frame does not exist gives NaN and no gradient.

    Raises:
        InputError: the dtype of the maps has no kernel.
    """
    _check_dtype("corr", fmap1)
    return _Corr.apply(fmap1, fmap2, coords.detach(), ii, jj, radius, keep)


def patchify(net: Tensor, coords: Tensor, radius: int, mode: str = "bilinear") -> Tensor:
    """Cut windows out of maps; arguments (already checked) and result of `devo.altcorr.patchify`.

    Raises:
        InputError: the dtype of the maps has no kernel.
    """
    _check_dtype("patchify", net)
    return _Patchify.apply(net, coords.detach().contiguous(), radius, mode == "bilinear")


def _check_dtype(caller: str, maps: Tensor) -> None:
    if maps.dtype not in MAP_TYPES:
        expected = ", ".join(str(dtype) for dtype in MAP_TYPES)
        raise InputError(f"{caller} got {maps.dtype} maps; the CUDA kernels expect one of {expected}")


class _Corr(torch.autograd.Function):
    """Features (1, E, 2R+1, 2R+1, P, P); the backward pass reads the windows again instead of storing them."""

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
    ) -> Tensor:
        coords, ii, jj = coords.contiguous(), ii.long().contiguous(), jj.long().contiguous()
        ctx.save_for_backward(fmap1, fmap2, coords, ii, jj, keep)
        ctx.radius = radius
        side, patch = 2 * radius + 1, fmap1.shape[-1]
        out = fmap1.new_empty(1, len(ii), side, side, patch, patch)
        if out.numel():
            patches, maps = _channels_last(fmap1), _channels_last(fmap2)
            operands = (patches, maps, coords, ii, jj)
            LIBRARY.launch("devo_corr_forward", out.device, *_dtypes(fmap1, coords), *operands, len(ii),
                           *_sizes(fmap1, fmap2), radius, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        fmap1, fmap2, coords, ii, jj, keep = ctx.saved_tensors
        edges, grad = len(ii) if keep is None else len(keep), grad.contiguous()
        patches, maps = _channels_last(fmap1), _channels_last(fmap2)
        needed1, needed2 = ctx.needs_input_grad[:2]
        # half-precision sums of many small terms stall, so gradients are accumulated in at least float32
        total = torch.promote_types(fmap1.dtype, torch.float32)
        grad1 = torch.zeros_like(patches, dtype=total) if needed1 else None
        grad2 = torch.zeros_like(maps, dtype=total) if needed2 else None
        if edges and patches.numel() and maps.numel():
            operands = (patches, maps, coords, ii, jj, keep, grad)
            LIBRARY.launch("devo_corr_backward", grad.device, *_dtypes(fmap1, coords), *operands, edges,
                           *_sizes(fmap1, fmap2), ctx.radius, grad1, grad2)
        return (_channels_first(grad1, fmap1), _channels_first(grad2, fmap2), *[None] * 5)


class _Patchify(torch.autograd.Function):
    """Windows (B, M, C, S, S); the backward pass adds their gradients into maps laid out in memory like `net`."""

    @staticmethod
    def forward(ctx: Any, net: Tensor, coords: Tensor, radius: int, blend: bool) -> Tensor:
        ctx.save_for_backward(coords)
        ctx.radius, ctx.blend, ctx.like = radius, blend, torch.empty_like(net, device="meta")
        side = 2 * radius + (1 if blend else 2)
        dtype = torch.promote_types(net.dtype, coords.dtype) if blend else net.dtype
        out = net.new_empty(*coords.shape[:2], net.shape[1], side, side, dtype=dtype)
        if out.numel():
            LIBRARY.launch("devo_patchify_forward", net.device, *_dtypes(net, coords), net, coords,
                           *_windows(net, coords), radius, blend, *net.stride(), out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        (coords,) = ctx.saved_tensors
        grad = grad.contiguous()
        total = torch.promote_types(ctx.like.dtype, torch.float32)
        sums = torch.zeros_like(ctx.like, dtype=total, device=grad.device)
        if grad.numel() and sums.numel():
            LIBRARY.launch("devo_patchify_backward", grad.device, *_dtypes(ctx.like, coords), grad, coords,
                           *_windows(ctx.like, coords), ctx.radius, ctx.blend, *sums.stride(), sums)
        return sums.to(ctx.like.dtype), None, None, None


def _channels_last(maps: Tensor) -> Tensor:
    """Maps (1, F, C, H, W) as (F, H, W, C): a view of the tracker's maps, a copy of what is stored otherwise."""
    return maps[0].permute(0, 2, 3, 1).contiguous()


def _channels_first(sums: Tensor | None, maps: Tensor) -> Tensor | None:
    """Gradient of `maps` from sums (F, H, W, C)."""
    return None if sums is None else sums.permute(0, 3, 1, 2)[None].to(maps.dtype)


def _dtypes(maps: Tensor, coords: Tensor) -> tuple[int, int]:
    """Numbers of the dtypes as the kernels know them."""
    return MAP_TYPES[maps.dtype], MAP_TYPES[coords.dtype]


def _sizes(fmap1: Tensor, fmap2: Tensor) -> tuple[int, ...]:
    """Patches, frames, channels, height, width and pixels of a patch."""
    return fmap1.shape[1], *fmap2.shape[1:], fmap1.shape[-1] ** 2


def _windows(net: Tensor, coords: Tensor) -> tuple[int, ...]:
    """Maps, positions in each, channels, height and width."""
    return net.shape[0], coords.shape[1], *net.shape[1:]
