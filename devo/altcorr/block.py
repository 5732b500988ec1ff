"""Correlation features for training: the same maps looked up again and again, differentiable to both."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from devo.altcorr.correlation import corr, draw_kept_edges
from devo.altcorr.volumes import MAX_VOLUME_ELEMENTS, Volume, look_up, volume_shape
from devo.altcorr.windows import check_edges
from devo.errors import InputError
from devo.kernels import cuda_kernel, kernel_mode

MAX_VOLUME_BYTES = 1 << 31
"""Largest correlation volumes kept in memory; bigger samples are correlated edge by edge instead."""
GPU_VOLUME_SHARE = 0.25
"""The same on other devices, as a share of the memory that is free there."""


class CorrBlock:
    """Pyramid correlation of fixed maps at positions that change from call to call.

    All products of patch and map pixels of each clip are computed once (`devo.altcorr.volumes`), which makes every
    further call and its backward pass cheap; where they would exceed `MAX_VOLUME_BYTES` (on other devices a share of
    the free memory) and with `DEVO_KERNELS=cuda`, each call runs `corr` per level. Both give the same result up to the
    rounding of sums.

    Args:
        fmap: (1, F, C, H, W) feature maps, clip after clip.
        gmap: (1, K, C, P, P) patch features, clip after clip.
        radius: R, largest shift.
        dropout: probability with which an edge takes part in the backward pass of a call, without rescaling.
        levels: divisors of the pyramid; level l is `fmap` average-pooled in blocks of `levels[l]` pixels.
        clips: number of equally long clips joined in the sample; edges never connect two of them.
        compute_dtype: dtype of the products and of the result, by default the one both maps promote to; bfloat16 is
            faster where the CPU multiplies it in hardware, and halves the memory.
        generator: source of the randomness of `dropout`.

    Raises:
        InputError: shapes do not fit together, or frames or patches cannot be split evenly into `clips`.
    """

    def __init__(
        self,
        fmap: Tensor,
        gmap: Tensor,
        radius: int = 3,
        dropout: float = 0.2,
        levels: Sequence[int] = (1, 4),
        *,
        clips: int = 1,
        compute_dtype: torch.dtype | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        if fmap.dim() != 5 or gmap.dim() != 5 or fmap.shape[:3:2] != (1, gmap.shape[2]) or gmap.shape[0] != 1:
            found = f"{tuple(fmap.shape)} and {tuple(gmap.shape)}"
            raise InputError(f"CorrBlock got maps of shape {found}; expected (1, F, C, H, W) and (1, K, C, P, P)")
        if clips < 1 or fmap.shape[1] % clips or gmap.shape[1] % clips or not 0 <= dropout <= 1:
            found = f"{fmap.shape[1]} frames, {gmap.shape[1]} patches, clips={clips}, dropout={dropout}"
            raise InputError(f"CorrBlock got {found}; expected multiples of clips >= 1 and a probability")
        self.radius, self.dropout, self.levels, self.clips = radius, dropout, tuple(levels), clips
        self.generator = generator
        self.frames, self.patches = fmap.shape[1] // clips, gmap.shape[1] // clips
        compute = self.dtype = compute_dtype or torch.promote_types(fmap.dtype, gmap.dtype)
        with torch.autocast(fmap.device.type, enabled=False):
            self.gmap = gmap.to(compute)
            pooled = [torch.nn.functional.avg_pool2d(fmap[0], n, n)[None] if n > 1 else fmap for n in self.levels]
            self.pyramid = [level.to(compute) for level in pooled]
            self.volumes: list[Volume] | None = None
            elements = [math.prod(volume_shape(gmap, level, radius, clips)) for level in self.pyramid]
            if kernel_mode() == "cuda":
                cuda_kernel("altcorr", fmap, gmap)  # refuses what has no extension
            elif max(elements) < MAX_VOLUME_ELEMENTS and sum(elements) * compute.itemsize <= _memory(fmap.device):
                self.volumes = [Volume(self.gmap, level, radius, clips) for level in self.pyramid]

    def __call__(self, ii: Tensor, jj: Tensor, coords: Tensor) -> Tensor:
        """Correlate patches with frames around the given positions.

        Args:
            ii: (E,) int64, row of `gmap` for each edge.
            jj: (E,) int64, row of `fmap` for each edge.
            coords: (1, E, 2, P, P) float32 positions (x, y) in pixels of `fmap`; no gradient flows to them.

        Returns:
            (1, E, (2R+1)**2 * P*P * L) in the compute dtype; index (((xo*(2R+1) + yo)*P + i)*P + j)*L + l, see
            `corr` for the meaning of the shifts xo and yo.

        Raises:
            InputError: shapes do not fit together, or an edge leaves its clip or the sample.
        """
        check_edges("CorrBlock", coords, ii, jj, self.gmap.shape[-1])
        coords = coords.detach()
        if self.volumes is None:
            return self._by_corr(ii, jj, coords)
        clip = ii // self.patches
        if bool(((ii < 0) | (clip >= self.clips) | (clip != jj // self.frames)).any()):
            expected = f"{self.clips} clips of {self.patches} patches and {self.frames} frames"
            raise InputError(f"CorrBlock got edges between clips or out of range; expected edges within {expected}")
        keep = None
        differentiated = any(volume.token.requires_grad for volume in self.volumes)
        if self.dropout < 1 and torch.is_grad_enabled() and differentiated:
            keep = draw_kept_edges(len(ii), self.dropout, coords.device, self.generator)
        positions = coords[0].flatten(2)
        features = look_up(self.volumes, self.levels, positions, ii, jj, keep, self.dtype)
        return features.flatten(1)[None]

    def _by_corr(self, ii: Tensor, jj: Tensor, coords: Tensor) -> Tensor:
        levels = [
            corr(self.gmap, level, coords / n, ii, jj, self.radius, self.dropout, generator=self.generator)
            for level, n in zip(self.pyramid, self.levels, strict=True)
        ]
        return torch.stack(levels, dim=-1).flatten(2)


def _memory(device: torch.device) -> float:
    """Bytes that correlation volumes may take on a device."""
    if device.type != "cuda":
        return MAX_VOLUME_BYTES
    return GPU_VOLUME_SHARE * torch.cuda.mem_get_info(device)[0]
