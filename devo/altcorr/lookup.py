"""Fast correlation features for inference: one shared window per patch instead of one window per patch pixel.

The windows of the P*P pixels of a patch overlap almost entirely. Per edge and pyramid level the features of one square
that covers all of them are gathered once and multiplied with all patch pixels in one matrix product; each pixel then
cuts its own (2R+2)-square out of the result and blends it. Edges are handled frame by frame, so that the frame, copied
into a buffer with a zero margin, stays in the cache and positions outside need no special case.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from devo.altcorr.correlation import corr
from devo.altcorr.windows import check_edges, split_coords
from devo.errors import InputError
from devo.kernels import cuda_kernel

CHUNK_BYTES = 1 << 22
"""Gathered features per step; larger steps fall out of the cache, smaller ones are dominated by call overhead."""
SHAPE_STEP = 32
"""Steps hold a multiple of this many edges: matrix products of ever new sizes would be compiled again and again."""
WIDEST_SLACK = 8
"""Extra window pixels beyond 2R+2 up to which the shared window is considered."""


def corr_features(
    gmap: Tensor, pyramid: Sequence[Tensor], coords: Tensor, kk: Tensor, jj: Tensor, radius: int = 3
) -> Tensor:
    """Correlation features of all pyramid levels, laid out as the update operator expects them (no gradients).

    Equal to stacking `corr(gmap, pyramid[l], coords / 4**l, kk, jj, radius)` over the levels l as the last dimension,
    up to the rounding of the sums. Fastest with maps stored channels-last and with bfloat16 where the CPU multiplies it
    in hardware.

    Args:
        gmap: (1, K, C, P, P) patch features.
        pyramid: per level l (1, F, C, H / 4**l, W / 4**l) feature maps in the dtype of `gmap`.
        coords: (1, E, 2, P, P) float32 positions (x, y) in pixels of level 0.
        kk: (E,) int64, row of `gmap` for each edge.
        jj: (E,) int64, row of the maps for each edge.
        radius: R, largest shift.

    Returns:
        (1, E, (2R+1)**2 * P*P * L) in the dtype of the maps; index (((xo*(2R+1) + yo)*P + i)*P + j)*L + l.

    Raises:
        InputError: shapes or dtypes do not fit together.
    """
    levels, edges, patch, side = len(pyramid), len(kk), gmap.shape[-1], 2 * radius + 1
    maps = (1, pyramid[0].shape[1], gmap.shape[2]) if levels else ()
    if not levels or any(level.dtype != gmap.dtype or level.shape[:3] != maps for level in pyramid):
        found = ", ".join(f"{tuple(level.shape)} {level.dtype}" for level in pyramid) or "nothing"
        expected = f"(1, F, {gmap.shape[2]}, height, width) {gmap.dtype} with the same F"
        raise InputError(f"corr_features got the pyramid {found}; expected levels {expected}")
    check_edges("corr_features", coords, kk, jj, patch)
    out = gmap.new_empty(edges, side, side, patch * patch, levels)
    with torch.no_grad(), torch.autocast(gmap.device.type, enabled=False):
        if cuda_kernel("altcorr", gmap, *pyramid) is not None or gmap.device.type != "cpu":
            _by_corr(out, gmap, pyramid, coords, kk, jj, radius)
        elif edges:
            _by_shared_windows(out, gmap, pyramid, coords, kk, jj, radius)
    return out.flatten(1)[None]


def _by_corr(
    out: Tensor, gmap: Tensor, pyramid: Sequence[Tensor], coords: Tensor, kk: Tensor, jj: Tensor, radius: int
) -> None:
    for number, level in enumerate(pyramid):
        out[..., number] = corr(gmap, level, coords / 4**number, kk, jj, radius)[0].flatten(3)


def _by_shared_windows(
    out: Tensor, gmap: Tensor, pyramid: Sequence[Tensor], coords: Tensor, kk: Tensor, jj: Tensor, radius: int
) -> None:
    edges, channels, pixels = len(kk), gmap.shape[2], out.shape[3]
    frame_of_edge, order = torch.sort(jj, stable=True)
    sorted_coords = coords[0].flatten(2)[order].permute(1, 2, 0).contiguous()
    levels = [_Level(level[0], sorted_coords / 4**number, radius) for number, level in enumerate(pyramid)]
    step = min(level.edges_per_step() for level in levels)
    for level in levels:
        level.allocate(step)
    # the last step of a frame runs on into later edges; what it computes for them is not used
    patch_of_edge = torch.cat([kk[order], kk.new_zeros(step)])
    patches = gmap[0].flatten(2).transpose(1, 2).flatten(1)
    staged = out.new_empty(step, *out.shape[1:])
    pairs = out.view(edges, -1)
    first = 0
    for frame, count in enumerate(torch.bincount(frame_of_edge).tolist()):
        last = first + count
        for level in levels if count else ():
            level.enter(frame)
        for start in range(first, last, step):
            used = min(step, last - start)
            many = -(-used // SHAPE_STEP) * SHAPE_STEP
            part = patches.index_select(0, patch_of_edge[start : start + many])
            features = part.view(many, pixels, channels)
            for number, level in enumerate(levels):
                level.look_up(features, start, used, staged[:used, ..., number])
            pairs[order[start : start + used]] = staged[:used].view(used, -1)
        first = last
    for number, level in enumerate(levels):
        rest = order[level.left_over]
        if len(rest):
            exact = corr(gmap, pyramid[number], coords[:, rest] / 4**number, kk[rest], jj[rest], radius)
            out[rest, ..., number] = exact[0].flatten(3)


class _Level:
    """One pyramid level: window positions of all edges (sorted by frame) and the buffers of one step."""

    def __init__(self, maps: Tensor, coords: Tensor, radius: int) -> None:
        self.maps, self.side = maps, 2 * radius + 2
        height, width = maps.shape[-2:]
        # positions stay floating point as long as possible: that arithmetic is vectorised, and exact up to FAR
        base, fraction = split_coords(coords)
        lowest = base.amin(1)
        spread = (base.amax(1) - lowest).amax(0)
        self.window = margin = _best_window(spread, self.side, coords.shape[1])
        self.margin, self.stride = margin, width + 2 * margin
        # a window that begins a whole window before the map, or right behind it, already sees nothing of it
        corner = torch.minimum((lowest - radius).clamp_(min=-margin), base.new_tensor([[width], [height]]))
        inner = (base - (radius + corner)[:, None]).clamp_(0, self.window - self.side)
        self.start = (corner[1] + margin).int() * self.stride + (corner[0] + margin).int()
        self.inner = (inner[1] * self.window + inner[0]).t().contiguous().int()
        fraction = fraction.to(torch.promote_types(maps.dtype, torch.float32))
        self.fraction = fraction.transpose(1, 2).flatten(1)[..., None]
        self.left_over = torch.nonzero(spread > self.window - self.side).squeeze(1)

    def edges_per_step(self) -> int:
        per_edge = self.window**2 * self.maps.shape[1] * self.maps.element_size()
        steps = CHUNK_BYTES // (per_edge * SHAPE_STEP)
        return SHAPE_STEP * min(max(steps, 1), 32)

    def allocate(self, step: int) -> None:
        """Prepare for steps of at most `step` edges."""
        channels, height, width = self.maps.shape[1:]
        window, margin, pixels = self.window, self.margin, self.inner.shape[1]
        area, run = window * window, self.side * window - (window - self.side)
        self.start = torch.cat([self.start, self.start.new_zeros(step)])
        self.inner += torch.arange(pixels, dtype=torch.int32) * area
        padded = self.maps.new_zeros(height + 2 * margin, self.stride, channels)
        self.interior = padded[margin : margin + height, margin : margin + width]
        # rows of overlapping views are runs of memory: the pixels of a window row, the rows of a pixel's own window
        self.map_runs = padded.as_strided((padded.numel() // channels - window + 1, window * channels), (channels, 1))
        self.row_start = torch.arange(window, dtype=torch.int32) * self.stride
        self.gathered = self.maps.new_empty(step, area, channels)
        self.volume = self.maps.new_empty(step, pixels, area)
        self.volume_runs = self.volume.as_strided((self.volume.numel() - run + 1, run), (1, 1))
        self.volume_start = (torch.arange(step, dtype=torch.int32) * (pixels * area))[:, None]
        self.own = self.maps.new_empty(step * pixels, run)
        self.along_x = self.fraction.new_empty(step * pixels, run - 1)
        self.blended = self.fraction.new_empty(step * pixels, run - 1 - window)

    def enter(self, frame: int) -> None:
        """Copy one frame into the zero-margined buffer."""
        self.interior.copy_(self.maps[frame].permute(1, 2, 0))

    def look_up(self, features: Tensor, start: int, used: int, out: Tensor) -> None:
        """Correlate edges `start ...` with the entered frame.

        Args:
            features: (n, P*P, C) patch features.
            start: first edge, in the order of the frames.
            used: how many of the n results are wanted.
            out: (used, x-shift, y-shift, P*P) receives them.
        """
        many, window, pixels, side = len(features), self.window, self.inner.shape[1], self.side - 1
        rows = (self.start[start : start + many, None] + self.row_start).view(-1)
        torch.index_select(self.map_runs, 0, rows, out=self.gathered[:many].view(many * window, -1))
        torch.bmm(features, self.gathered[:many].transpose(1, 2), out=self.volume[:many])
        runs = (self.volume_start[:used] + self.inner[start : start + used]).view(-1)
        own = torch.index_select(self.volume_runs, 0, runs, out=self.own[: used * pixels]).to(self.fraction.dtype)
        dx, dy = self.fraction[:, start * pixels : (start + used) * pixels]
        # whole runs are blended, window after window row; the few values between the rows are never read
        along_x = torch.lerp(own[:, :-1], own[:, 1:], dx, out=self.along_x[: used * pixels])
        blended = torch.lerp(along_x[:, :-window], along_x[:, window:], dy, out=self.blended[: used * pixels])
        run = blended.shape[1]
        blended = blended.to(out.dtype)
        out.copy_(blended.as_strided((used, side, side, pixels), (pixels * run, 1, window, run)))


def _best_window(spread: Tensor, side: int, pixels: int) -> int:
    """Side of the shared window with the least work, given by how many pixels the patches spread over.

    A wider window costs its area for every edge; the edges that do not fit cost one window per patch pixel each.
    """
    fitting = torch.bincount(spread.clamp(max=WIDEST_SLACK + 1).long(), minlength=WIDEST_SLACK + 2).cumsum(0).tolist()
    work = [
        (fits * (side + slack) ** 2 + (len(spread) - fits) * 2 * pixels * side**2, side + slack)
        for slack, fits in enumerate(fitting[:-1])
    ]
    return min(work)[1]
