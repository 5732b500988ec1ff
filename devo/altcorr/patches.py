"""Extraction of small windows around subpixel positions from feature maps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from devo.altcorr.windows import blend, split_coords, window_rows
from devo.errors import InputError
from devo.kernels import cuda_kernel


def patchify(net: Tensor, coords: Tensor, radius: int, mode: str = "bilinear") -> Tensor:
    """Cut windows around positions out of maps; what lies outside of a map is zero.

    Args:
        net: (B, C, H, W) maps, any floating dtype.
        coords: (B, M, 2) float32 (float64 with float64 maps) positions (x, y) in pixels; integers are pixel centres.
        radius: R, half side of the window.
        mode: `bilinear` interpolates at the positions; anything else returns the raw pixels around their floor.

    Returns:
        `bilinear`: (B, M, C, 2R+1, 2R+1), rows then columns, in the dtype that `net` and `coords` promote to (a half
        `net` gives float32); otherwise (B, M, C, 2R+2, 2R+2) in the dtype of `net`. NaN or infinite positions give
        NaN. Differentiable to `net`, not to `coords`.

    Raises:
        InputError: shapes do not fit together.
    """
    precise = coords.dtype in (torch.float32, torch.float64)
    if not precise or net.dim() != 4 or coords.dim() != 3 or coords.shape[::2] != (net.shape[0], 2) or radius < 0:
        found = f"net {tuple(net.shape)}, coords {tuple(coords.shape)} {coords.dtype}, radius {radius}"
        raise InputError(f"patchify got {found}; expected (B, C, H, W), (B, M, 2) float32 and radius >= 0")
    extension = cuda_kernel("altcorr", net, coords)
    if extension is not None:
        return extension.patchify(net, coords, radius, mode)
    base, fraction = split_coords(coords.detach())
    window = _Windows.apply(net, base.long(), radius)
    if mode != "bilinear":
        return window
    dx, dy = fraction.to(torch.promote_types(net.dtype, coords.dtype)).unsqueeze(2).unbind(-1)
    return blend(window.to(dx.dtype), dx, dy)


class _Windows(torch.autograd.Function):
    """Raw (B, M, C, D, D) windows; the backward pass adds the window gradients into the maps."""

    @staticmethod
    def forward(ctx: Any, net: Tensor, base: Tensor, radius: int) -> Tensor:
        batch, channels, height, width = net.shape
        points = base.shape[1]
        frame = torch.arange(batch, device=net.device).repeat_interleave(points)
        flat = base.flatten(0, 1)
        rows, inside = window_rows(flat[:, 0], flat[:, 1], frame, (height, width), radius)
        ctx.save_for_backward(rows, inside)
        ctx.shape = net.shape
        # indexing two dimensions at once reads any memory layout without rearranging the whole map
        pixels = rows - (frame * (height * width))[:, None]
        pixels = pixels.masked_fill_(~inside, 0)
        picked = net.flatten(2).transpose(1, 2)[frame[:, None], pixels]
        picked = picked.masked_fill_(~inside[..., None], 0)
        side = 2 * radius + 2
        return picked.view(batch, points, side, side, channels).permute(0, 1, 4, 2, 3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        rows, inside = ctx.saved_tensors
        batch, channels, height, width = ctx.shape
        total = torch.promote_types(grad.dtype, torch.float32)
        pixels = torch.zeros(batch * height * width, channels, dtype=total, device=grad.device)
        towards = grad.permute(0, 1, 3, 4, 2).reshape(-1, channels).to(total)
        pixels.index_add_(0, rows.flatten(), towards.masked_fill(~inside.view(-1, 1), 0))
        maps = pixels.view(batch, height, width, channels).permute(0, 3, 1, 2)
        return maps.to(grad.dtype), None, None
