"""Votes of rays in the disparity space image (DSI)."""

from __future__ import annotations

import torch
from torch import Tensor

from devo.errors import InputError
from utils.emvs.geometry import PacketRays
from utils.emvs.settings import Vote

_BILINEAR, _NEAREST, _ZERO_PADDING = 0, 1, 0
_BANDS = 8
_STEP_VOTES = {"cpu": 1 << 16, "cuda": 1 << 23}
"""Votes per step: few on the CPU, so that they stay in its cache; many on CUDA (about 30 bytes each)."""


def block_packets(packet_size: int, image_pixels: int, device: torch.device) -> int:
    """How many packets to hand to `cast_votes` at a time.

    Few enough for the cache of a CPU, enough to make up for walking over the whole slice of the DSI once.
    """
    events = max(1 << 15, image_pixels // 4) if device.type == "cpu" else 1 << 18
    return max(1, events // packet_size)


def cast_votes(dsi: Tensor, rays: PacketRays, vote: Vote = "bilinear") -> None:
    """Add one vote per event and plane to the DSI, in place.

    A ray that meets plane i at (x_i, y_i) inside [0, W-1] x [0, H-1] and in front of its camera adds 1 to slice i:
    to the nearest pixel, or spread bilinearly over four. Other rays add nothing there.

    Args:
        dsi: `(P, H, W)` float32; exact up to 2**24 votes per voxel.
        rays: the same P planes, on the same device.
        vote: how a vote is shared.

    Raises:
        InputError: an unknown kind of vote, or a DSI that does not fit the rays.
    """
    if vote not in ("bilinear", "nearest"):
        raise InputError(f"vote is {vote!r}, expected bilinear or nearest")
    planes, packets = rays.gain.shape
    if dsi.ndim != 3 or len(dsi) != planes or dsi.dtype != torch.float32:
        raise InputError(f"the DSI is {dsi.dtype} {tuple(dsi.shape)}, expected float32 ({planes}, H, W)")
    if not packets:
        return
    on_cpu = dsi.device.type == "cpu"
    step = max(1, _STEP_VOTES["cpu" if on_cpu else "cuda"] // rays.u.numel(), torch.get_num_threads() if on_cpu else 1)
    events = _in_bands(rays) if on_cpu else torch.stack([rays.u, rays.v, rays.side])[:, None]
    masked = not rays.all_in_front
    for first in range(0, planes, step):
        rows = slice(first, min(first + step, planes))
        position = _positions(events, rays, rows)
        weight = torch.maximum(position[:, 0].abs(), position[:, 1].abs()).le_(1.0)
        if masked:
            weight *= events[2] * rays.ahead[rows, None, :, None] > 0
        dsi[rows] += _splat(position, weight, dsi.shape[1], dsi.shape[2], vote)


def _in_bands(rays: PacketRays) -> Tensor:
    """Events `(3, B, K, S / B)` as u, v, side: packets sorted by row and cut in B bands, all k-th bands together.

    Successive votes then fall into few rows of a slice, which a fast cache can hold (a third more votes per second).
    """
    packets, size = rays.u.shape
    bands = _BANDS if size % _BANDS == 0 else 1
    v, order = rays.v.sort(dim=1, stable=True)
    events = torch.stack([rays.u.gather(1, order), v, rays.side.gather(1, order)])
    return events.view(3, packets, bands, size // bands).transpose(1, 2).contiguous()


def _positions(events: Tensor, rays: PacketRays, rows: slice) -> Tensor:
    """Normalised positions `(P', 2, B, K, S / B)` on some planes."""
    gain = rays.gain[rows, None, :, None]
    position = torch.empty((gain.shape[0], 2, *events.shape[1:]), dtype=torch.float32, device=events.device)
    for axis, offset in enumerate((rays.offset_u, rays.offset_v)):
        torch.mul(events[axis], gain, out=position[:, axis]).add_(offset[rows, None, :, None])
    return position


def _splat(position: Tensor, weight: Tensor, height: int, width: int, vote: Vote) -> Tensor:
    """Sum of all votes `(P', H, W)`.

    Giving a vote to the four pixels around it with bilinear weights is the transpose of looking up an image there,
    that is, the gradient of that look-up with respect to the image. torch has it as one fused loop, on the CPU about
    ten times as fast as index arithmetic followed by `bincount` or `index_add_`. The look-up itself is never done.
    """
    planes = len(position)
    grid = position.reshape(planes, 2, 1, -1).permute(0, 2, 3, 1)
    image = position.new_zeros(()).expand(planes, 1, height, width)
    mode = _BILINEAR if vote == "bilinear" else _NEAREST
    gradient: Tensor = torch.ops.aten.grid_sampler_2d_backward(
        weight.reshape(planes, 1, 1, -1), image, grid, mode, _ZERO_PADDING, True, [True, False])[0]
    return gradient[:, 0]
