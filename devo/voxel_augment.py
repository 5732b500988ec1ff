"""Published augmentation of voxel clips: one random picture operation on all bins, seen as 8-bit colour images.

A bin becomes an image with the magnitude of its negative cells in red and its positive cells in blue. The operations
are the usual ones on 8-bit images (blends are truncated, not rounded), their strengths those of the published training.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from devo.normalize import normalize_sequence

STRENGTHS = 10
PROBABILITY = 0.33
GREY = (0.2989, 0.587, 0.114)


def _blend(image: Tensor, other: Tensor, ratio: float) -> Tensor:
    """ratio * image + (1 - ratio) * other, truncated to whole numbers 0..255; float images (...,3,H,W)."""
    return (ratio * image + (1.0 - ratio) * other).clamp(0, 255).floor()


def _grey(image: Tensor) -> Tensor:
    weights = torch.tensor(GREY, device=image.device).view(3, 1, 1)
    return (image * weights).sum(dim=-3, keepdim=True).floor()


def brightness(image: Tensor, factor: float) -> Tensor:
    """Blend with black."""
    return _blend(image, torch.zeros_like(image), factor)


def contrast(image: Tensor, factor: float) -> Tensor:
    """Blend with the mean grey of each image."""
    return _blend(image, _grey(image).mean(dim=(-3, -2, -1), keepdim=True), factor)


def saturation(image: Tensor, factor: float) -> Tensor:
    """Blend with the grey image."""
    return _blend(image, _grey(image), factor)


def invert(image: Tensor, _: float) -> Tensor:
    """255 - image; for voxels this exchanges the polarities."""
    return 255.0 - image


def posterize(image: Tensor, bits: float) -> Tensor:
    """Keep the highest `bits` bits."""
    step = 2.0 ** (8 - int(bits))
    return (image / step).floor() * step


def solarize(image: Tensor, threshold: float) -> Tensor:
    """Invert everything from `threshold` up."""
    return torch.where(image >= threshold, 255.0 - image, image)


def sharpness(image: Tensor, factor: float) -> Tensor:
    """Blend with a copy smoothed by (1 1 1; 1 5 1; 1 1 1) / 13, the outermost pixels excepted."""
    if min(image.shape[-2:]) <= 2:
        return image
    kernel = torch.ones(1, 1, 3, 3, device=image.device)
    kernel[..., 1, 1] = 5.0
    flat = image.reshape(-1, 1, *image.shape[-2:])
    smooth = flat.clone()
    smooth[..., 1:-1, 1:-1] = F.conv2d(flat, kernel / 13.0).round()
    return _blend(image, smooth.view_as(image), factor)


def _linear(low: float, high: float) -> list[float]:
    return torch.linspace(low, high, STRENGTHS, dtype=torch.float64).tolist()


OPERATIONS: dict[str, tuple[Callable[[Tensor, float], Tensor], list[float]]] = {
    "brightness": (brightness, _linear(0.1, 0.2)),
    "contrast": (contrast, _linear(0.05, 0.2)),
    "invert": (invert, [0.0] * STRENGTHS),
    "posterize": (posterize, [8.0 - round(k * 4 / 9) for k in range(STRENGTHS)]),
    "saturation": (saturation, _linear(0.05, 0.2)),
    "sharpness": (sharpness, _linear(0.9, 2.0)),
    "solarize": (solarize, [float(round(value)) for value in _linear(0.0, 30.0)]),
}


def voxel_augment(voxels: Tensor, operation: str, strength: int) -> Tensor:
    """Apply one operation to whole clips.

    Args:
        voxels: (B,n,bins,H,W) in any normalisation; rescaled to [-1,1] first, per clip.
        operation: a key of `OPERATIONS`.
        strength: 0..9.

    Returns:
        (B,n,bins,H,W) float32, standardised per clip over the non-zero cells.
    """
    scaled = normalize_sequence(voxels, "rescale")
    negative, positive = (-scaled).clamp(min=0), scaled.clamp(min=0)
    image = torch.stack([negative, torch.zeros_like(scaled), positive], dim=3).mul(255.0).floor()
    apply, strengths = OPERATIONS[operation]
    image = apply(image, strengths[strength]) / 255.0
    return normalize_sequence(image[:, :, :, 2] - image[:, :, :, 0], "std2")


def random_voxel_augment(voxels: Tensor, probability: float = PROBABILITY) -> Tensor:
    """With the given probability, one random operation of random strength, the same for all clips of the step."""
    if float(torch.rand(())) >= probability:
        return voxels
    operation = list(OPERATIONS)[int(torch.randint(len(OPERATIONS), ()))]
    return voxel_augment(voxels, operation, int(torch.randint(STRENGTHS, ())))
