"""From voxel grids to edge pixels with a first depth: pooled event images, Sobel edges, depths of nearby patches.

Three pixel grids occur: full resolution, the quarter resolution of patch centres and frame intrinsics ("qres", full
resolution / 4), and the pooled images (full resolution averaged over s x s squares). The pooled pixel u covers full
pixels `s u .. s u + s - 1`, whose middle is `s u + (s-1)/2`, hence `(s u + (s-1)/2) / 4` in qres.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from utils.edge_clouds.settings import EdgeSettings

RES = 4
"""Full-resolution pixels per quarter-resolution pixel."""

MIN_INV_DEPTH = 1e-4
"""The solver's lower limit; seeds that sit on it carry no depth."""

_SOBEL_X = torch.tensor([[1.0, 0.0, -1.0], [2.0, 0.0, -2.0], [1.0, 0.0, -1.0]])
_NORMALISED_AT = 0.95


def crop_of(height: int, width: int) -> tuple[int, int]:
    """Rows at the top and columns at the left that the tracker crops from frames of this size [px]."""
    return (height % RES) // 2, (width % RES) // 2


def event_image(voxel: Tensor, downsample: int) -> Tensor:
    """Mean number of (weighted) events per pixel: `sum_bins |V|`, cropped as the tracker crops and averaged.

    Args:
        voxel: `(B,H,W)` voxel grid, not normalised.
        downsample: side s of the squares [px].

    Returns:
        `(h,w)` float32 with `h = (H - H % 4) // s`.
    """
    height, width = voxel.shape[-2:]
    top, left = crop_of(height, width)
    cropped = voxel[:, top:top + height - height % RES, left:left + width - width % RES]
    return F.avg_pool2d(cropped.float().abs().sum(dim=0)[None, None], downsample)[0, 0]


def normalised(image: Tensor) -> Tensor:
    """The image over the 95th percentile of its non-zero pixels, so that busy and quiet moments weigh alike."""
    filled = image[image > 0]
    if len(filled) == 0:
        return image
    return image / torch.quantile(filled, _NORMALISED_AT)


def edge_pixels(image: Tensor, topk: int, border: int) -> Tensor:
    """The pixels with the strongest gradient of a pooled event image.

    Args:
        image: `(h,w)` float.
        topk: at most this many.
        border: rows and columns along the border that are left out.

    Returns:
        `(N,2)` int64 columns and rows, in reading order; only pixels with a positive, finite gradient.
    """
    kernels = torch.stack([_SOBEL_X, _SOBEL_X.T])[:, None].to(image.device)
    gradient = F.conv2d(image[None, None], kernels, padding=1)[0].norm(dim=0)
    return _strongest(gradient, topk, border)


def ridge_pixels(image: Tensor, topk: int, border: int) -> Tensor:
    """The brightest pixels on the ridges of a pooled event image: brighter than neighbours on opposite sides.

    An edge of the scene leaves a ridge of events; the gradient of the image is largest on its two flanks and vanishes
    on the ridge itself. Arguments and result as for `edge_pixels`.
    """
    height, width = image.shape
    padded = F.pad(image, (1, 1, 1, 1))
    shifted = [padded[1 + dy:1 + dy + height, 1 + dx:1 + dx + width] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    on_ridge = torch.zeros_like(image, dtype=torch.bool)
    for one, other in zip(shifted[:4], reversed(shifted[5:])):  # >= on one side: a ridge may be two pixels wide
        on_ridge |= (image > one) & (image >= other)
    return _strongest(image * on_ridge, topk, border)


def _strongest(strength: Tensor, topk: int, border: int) -> Tensor:
    """Columns and rows `(N,2)` of the largest positive, finite values of an image away from its border."""
    height, width = strength.shape
    inside = strength.new_zeros(height, width)
    inside[border:max(height - border, border), border:max(width - border, border)] = 1.0
    flat = torch.nan_to_num(strength * inside, nan=0.0, posinf=0.0).flatten()
    values, index = flat.topk(min(topk, flat.numel()))
    index = index[values > 0].sort().values
    return torch.stack([index % width, torch.div(index, width, rounding_mode="floor")], dim=1)


def pooled_to_qres(pixels: Tensor, settings: EdgeSettings) -> Tensor:
    """Quarter-resolution camera coordinates `(N,2)` of pooled pixels `(N,2)`."""
    return (pixels.to(torch.float32) + settings.pixel_shift) * (settings.downsample / RES)


def interpolate_inv_depths(xy: Tensor, centers: Tensor, inv_depths: Tensor, settings: EdgeSettings) -> tuple[
        Tensor, Tensor]:
    """Inverse depths at `xy` from the nearest patch centres, weighted by inverse distance.

    `rho = sum w rho_k / sum w` with `w = 1 / max(distance, 1e-3)`; all of the `knn` nearest centres must lie within
    `max_dist`. Centres that are not finite or whose inverse depth sits on the solver's lower limit do not vote.

    Args:
        xy: `(N,2)`; centers: `(K,2)`, both quarter-resolution px. inv_depths: `(K,)`.

    Returns:
        The rows `(M,)` int64 of `xy` that got a value, and the values `(M,)`; M = 0 if fewer than `knn` centres vote.
    """
    votes = torch.isfinite(centers).all(dim=1) & torch.isfinite(inv_depths) & (inv_depths > MIN_INV_DEPTH)
    centers, inv_depths = centers[votes], inv_depths[votes]
    if len(centers) < settings.knn or len(xy) == 0:
        return torch.zeros(0, dtype=torch.int64, device=xy.device), xy.new_zeros(0)
    distance = torch.cdist(xy, centers, compute_mode="donot_use_mm_for_euclid_dist")
    nearest, index = distance.topk(settings.knn, dim=1, largest=False)
    rows = torch.nonzero(nearest[:, -1] <= settings.max_dist)[:, 0]
    weight = 1.0 / nearest[rows].clamp(min=1e-3)
    return rows, (weight * inv_depths[index[rows]]).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-6)


def camera_rays(xy: Tensor, intrinsics: Tensor) -> Tensor:
    """Rays `((x-cx)/fx, (y-cy)/fy, 1)`, `(N,3)`, of pixels `(N,2)` of a camera `fx fy cx cy`."""
    return torch.cat([(xy - intrinsics[2:]) / intrinsics[:2], torch.ones_like(xy[:, :1])], dim=1)


def full_resolution(xy: Tensor, crop: tuple[int, int]) -> np.ndarray:
    """Full-resolution, uncropped pixels `(N,2)` float32 of quarter-resolution pixels; crop is (top, left)."""
    return (xy * RES + torch.tensor([crop[1], crop[0]], device=xy.device)).cpu().numpy().astype(np.float32)
