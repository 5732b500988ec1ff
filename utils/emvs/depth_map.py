"""From votes to depth: confidence, adaptive threshold, median filter, border.

Rebecq et al. 2018, section 5.2. What is done per image is done once per view, on the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from utils.emvs.geometry import DepthPlanes
from utils.emvs.settings import EmvsSettings

_MEDIAN_CELLS = 8_000_000  # values sorted at a time: 16 MB
_NO_PLANE = np.iinfo(np.int16).max


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth map of one reference view; all arrays are (H, W).

    Attributes:
        confidence: float32, votes of the best plane.
        plane: int16, number of that plane after the median filter.
        mask: bool, pixels whose depth is believed.
        depth: float32 z-depth in the unit of the poses; meaningful where `mask` is set.
    """

    confidence: npt.NDArray[np.float32]
    plane: npt.NDArray[np.int16]
    mask: npt.NDArray[np.bool_]
    depth: npt.NDArray[np.float32]


def extract_depth(dsi: Tensor, planes: DepthPlanes, settings: EmvsSettings) -> DepthMap:
    """Find where rays meet.

    Args:
        dsi: `(P, H, W)` float32 votes, any device.
        planes: the P planes.
        settings: threshold, median filter, refinement between planes.
    """
    best, best_plane = (values.cpu() for values in dsi.max(dim=0))  # the first one on a tie
    confidence = best.numpy()
    mask = adaptive_threshold(to_bytes(confidence), settings.adaptive_threshold_kernel_size,
                              settings.adaptive_threshold_c)
    plane = masked_median(best_plane.numpy().astype(np.int16), mask, settings.median_filter_size)
    mask = mask & _inside_border(mask.shape, max(settings.adaptive_threshold_kernel_size // 2, 1))
    position: npt.NDArray[np.float64] = plane.astype(np.float64)
    if settings.subplane:
        position += _parabola_offset(dsi, plane, mask)
    return DepthMap(confidence, plane, mask, planes.at(position).astype(np.float32))


def to_bytes(values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Scale from the least to the largest value to 0..255, rounded; all equal gives 0."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return np.zeros(values.shape, np.uint8)
    return np.rint((values.astype(np.float64) - low) * (255.0 / (high - low))).astype(np.uint8)


def adaptive_threshold(image: npt.NDArray[np.uint8], size: int, margin: float) -> npt.NDArray[np.bool_]:
    """Pixels that exceed the rounded Gaussian mean of their surroundings by more than `margin`.

    The kernel is exp(-i^2 / 2 sigma^2) with sigma = 0.3 ((size - 1) / 2 - 1) + 0.8, edges are replicated. It is
    written out because OpenCV's `adaptiveThreshold` takes other kernels for small sizes, depending on its version.

    Args:
        image: `(H, W)`.
        size: odd width in pixels.
        margin: of 255.
    """
    half = size // 2
    sigma = 0.3 * ((size - 1) / 2 - 1) + 0.8
    kernel = torch.exp(-0.5 * (torch.arange(-half, half + 1, dtype=torch.float64) / sigma) ** 2)
    kernel /= kernel.sum()
    padded = torch.from_numpy(np.pad(image, half, mode="edge").astype(np.float64))[None, None]
    blurred = F.conv2d(F.conv2d(padded, kernel[None, None, :, None]), kernel[None, None, None, :])[0, 0]
    return image > np.rint(blurred.numpy()) + margin


def masked_median(plane: npt.NDArray[np.int16], mask: npt.NDArray[np.bool_], size: int) -> npt.NDArray[np.int16]:
    """Lower median of the plane numbers in a window, of the pixels in `mask` alone; 0 where the window has none.

    Args:
        plane: `(H, W)` plane numbers.
        mask: `(H, W)`.
        size: odd width of the window in pixels; what lies outside the image does not count.
    """
    half = size // 2
    padded = np.pad(np.where(mask, plane, _NO_PLANE), half, constant_values=_NO_PLANE).astype(np.int16)
    result = np.zeros(plane.shape, np.int16)
    step = max(1, _MEDIAN_CELLS // (plane.shape[1] * size * size))
    for first in range(0, len(plane), step):
        rows = padded[first:first + step + 2 * half]
        windows = np.lib.stride_tricks.sliding_window_view(rows, (size, size)).reshape(-1, size * size)
        ordered = np.sort(windows, axis=1)
        count = (ordered != _NO_PLANE).sum(axis=1)
        middle = np.take_along_axis(ordered, np.maximum((count + 1) // 2 - 1, 0)[:, None], axis=1)[:, 0]
        result[first:first + step] = np.where(count > 0, middle, 0).reshape(-1, plane.shape[1])
    return result


def _inside_border(shape: tuple[int, ...], border: int) -> npt.NDArray[np.bool_]:
    """False where the threshold saw replicated pixels: up to and with `border` at the low ends, from -`border` on."""
    inside = np.zeros(shape, bool)
    inside[border + 1:max(shape[0] - border, 0), border + 1:max(shape[1] - border, 0)] = True
    return inside


def _parabola_offset(dsi: Tensor, plane: npt.NDArray[np.int16], mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """`(H, W)` distance from the plane to the top of the parabola through its votes and its neighbours', in planes.

    0 where the plane is the first or last one, or no maximum among the three.
    """
    rows, columns = np.nonzero(mask & (plane > 0) & (plane < len(dsi) - 1))
    index = torch.from_numpy(plane[rows, columns].astype(np.int64)).to(dsi.device)
    at = torch.from_numpy(rows).to(dsi.device), torch.from_numpy(columns).to(dsi.device)
    before, middle, after = (dsi[index + step, at[0], at[1]].double().cpu().numpy() for step in (-1, 0, 1))
    curvature = before - 2 * middle + after
    is_peak = (middle >= before) & (middle >= after) & (curvature < 0)
    offset = np.zeros(plane.shape)
    offset[rows, columns] = np.where(is_peak, 0.5 * (before - after) / np.where(is_peak, curvature, 1.0), 0.0)
    return offset
