"""Voxel grids: signed events spread over time bins and neighbouring pixels, and what is done to them afterwards."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
import torch.nn.functional as F  # noqa: N812

from devo.errors import InputError
from utils.events.types import Events

NUMBER_OF_BINS = 5
Floats = npt.NDArray[np.float64]


def to_voxel_grid(x: Any, y: Any, t: Any, p: Any, H: int = 480, W: int = 640,
                  nb_of_time_bins: int = NUMBER_OF_BINS) -> torch.Tensor:
    """Spread events over a grid of time bins by trilinear interpolation.

    Event k at (x, y) gets the bin coordinate tau = (B-1) (t - t_first) / (t_last - t_first), or 0 if all stamps are
    equal, and adds `s (1-|X-x|) (1-|Y-y|) (1-|Z-tau|)` to each of the 8 cells (Z, Y, X) around it, with the sign
    s = -1 for p = 0 and s = p otherwise. Cells outside the grid are left out one by one, without renormalisation.
    Weights are summed in float64 and rounded to float32 once, at the end.

    Args:
        x, y: (N,) pixel coordinates, whole or fractional (rectified); the integer is the pixel's centre.
        t: (N,) stamps in any linear unit; t[0] and t[-1] are taken as first and last.
        p: (N,) polarity: bool, 0/1 or -1/+1.
        H, W: grid size in pixels.
        nb_of_time_bins: B, at least 1.

    Returns:
        (B, H, W) float32; zeros for N = 0. The inputs are not changed.

    Raises:
        InputError: columns of unequal length, coordinates or stamps that are not finite, an impossible size.
    """
    x, y, t, p = (np.asarray(column) for column in (x, y, t, p))
    if x.ndim != 1 or not x.shape == y.shape == t.shape == p.shape:
        raise InputError(f"event columns have shapes x {x.shape}, y {y.shape}, t {t.shape}, p {p.shape}, expected "
                         "(N,) each")
    if min(H, W, nb_of_time_bins) < 1:
        raise InputError(f"voxel grid of {nb_of_time_bins} bins and {W}x{H} pixels, expected at least 1 each")
    if not len(t):
        return torch.zeros(nb_of_time_bins, H, W)
    tau, order = _bin_coordinates(t, nb_of_time_bins)
    sign = _signs(p)
    if order is not None:
        x, y, sign = x[order], y[order], sign[order]
    if x.dtype.kind in "iub" and y.dtype.kind in "iub":
        grid = _splat_whole_pixels(x, y, tau, sign, H, W, nb_of_time_bins)
    else:
        grid = _splat_fractional(x.astype(np.float64), y.astype(np.float64), tau, sign, H, W, nb_of_time_bins)
    return torch.from_numpy(grid.astype(np.float32))


class VoxelRectifier:
    """Voxel grids of a camera whose events are rectified by a fixed map.

    All events of one sensor pixel land on the same rectified position, and the spatial weights do not depend on
    time. Hence the grid of rectified events is a constant sparse matrix (at most four entries per sensor pixel)
    times the grid of raw events. The result is that of `to_voxel_grid` on looked-up coordinates, up to rounding, at
    the price of whole-pixel events plus one sparse product.

    Args:
        rectify_map: (H, W, 2) float; rectified (x, y) of each sensor pixel, indexed [row, column]. Positions that
            are not finite count as outside.
        nb_of_time_bins: B, at least 1.

    Raises:
        InputError: the map has another shape.
    """

    def __init__(self, rectify_map: npt.ArrayLike, nb_of_time_bins: int = NUMBER_OF_BINS) -> None:
        positions = np.asarray(rectify_map, np.float64)
        if positions.ndim != 3 or positions.shape[2] != 2 or min(positions.shape) < 1:
            raise InputError(f"rectification map has shape {positions.shape}, expected (H, W, 2)")
        self.height, self.width = positions.shape[:2]
        self.nb_of_time_bins = nb_of_time_bins
        self._spread = _spread_matrix(positions)

    def __call__(self, events: Events) -> torch.Tensor:
        """Return the (B, H, W) float32 voxel grid of raw events; zeros for none.

        Raises:
            InputError: an event lies outside the map.
        """
        bins, height, width = self.nb_of_time_bins, self.height, self.width
        if not len(events):
            return torch.zeros(bins, height, width)
        if int(events.x.max()) >= width or int(events.y.max()) >= height:
            raise InputError(f"an event at x={int(events.x.max())} or y={int(events.y.max())} lies outside the "
                             f"rectification map of {width}x{height} pixels; the map belongs to another sensor")
        tau, _ = _bin_coordinates(events.t_us, bins)
        raw = _splat_whole_pixels(events.x, events.y, tau, _signs(events.p), height, width, bins)
        grid = self._spread @ np.ascontiguousarray(raw.reshape(bins, -1).T)
        return torch.from_numpy(np.ascontiguousarray(grid.T, dtype=np.float32).reshape(bins, height, width))


def _bin_coordinates(t: npt.NDArray[Any], bins: int) -> tuple[Floats, npt.NDArray[np.intp] | None]:
    """Return tau (N,) in increasing order and, if the stamps were not, the order that sorts them."""
    if t.dtype.kind in "ub":
        t = t.astype(np.int64)  # differences of unsigned stamps would wrap
    tau = (t - t[0]).astype(np.float64)
    duration = tau[-1]
    if not np.isfinite(tau.min()) or not np.isfinite(tau.max()):
        raise InputError("a time stamp is not finite")
    if duration == 0:
        tau = np.zeros_like(tau)
    else:
        tau *= bins - 1
        tau /= duration
    if np.any(tau[1:] < tau[:-1]):
        order = np.argsort(tau, kind="stable")
        order = order[(tau[order] > -1) & (tau[order] < bins)]  # the others do not touch any bin
        return tau[order], order
    return tau, None


def _signs(p: npt.NDArray[Any]) -> npt.NDArray[np.int8]:
    sign = p.astype(np.int8)
    sign[sign == 0] = -1
    return sign


def _segments(tau: Floats, bins: int) -> list[tuple[int, slice]]:
    """Split sorted tau at whole numbers: pairs (floor(tau), rows), for floor(tau) = -1 .. B-1."""
    edges = np.searchsorted(tau, np.arange(-1, bins + 1, dtype=np.float64), side="left")
    return [(i - 1, slice(int(edges[i]), int(edges[i + 1]))) for i in range(bins + 1) if edges[i] < edges[i + 1]]


def _splat_whole_pixels(x: npt.NDArray[Any], y: npt.NDArray[Any], tau: Floats, sign: npt.NDArray[np.int8],
                        H: int, W: int, bins: int) -> Floats:
    """Interpolate in time only; events in time order fill one pair of bins after the other (cache-friendly)."""
    planes = np.zeros((bins + 2, H * W))  # one bin more at each end takes what falls outside
    unsigned = x.dtype.kind == "u" and y.dtype.kind == "u"
    outside = int(x.max()) >= W or int(y.max()) >= H or (not unsigned and (int(x.min()) < 0 or int(y.min()) < 0))
    for floor, rows in _segments(tau, bins):
        pixel = y[rows].astype(np.int64)
        pixel *= W
        pixel += x[rows]
        early = sign[rows].astype(np.float64)
        late = (tau[rows] - floor) * early
        early -= late
        if outside:
            inside = (x[rows] >= 0) & (x[rows] < W) & (y[rows] >= 0) & (y[rows] < H)
            pixel, early, late = pixel[inside], early[inside], late[inside]
        planes[floor + 1] += np.bincount(pixel, early, H * W)
        planes[floor + 2] += np.bincount(pixel, late, H * W)
    return planes[1:bins + 1].reshape(bins, H, W)


def _splat_fractional(x: Floats, y: Floats, tau: Floats, sign: npt.NDArray[np.int8],
                      H: int, W: int, bins: int) -> Floats:
    """Interpolate in time and space on a grid with a margin of one pixel, which takes what falls outside."""
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("an event coordinate is not finite")
    stride = W + 2
    planes = np.zeros((bins + 2, (H + 2) * stride))
    for floor, rows in _segments(tau, bins):
        inside = (x[rows] > -1) & (x[rows] < W) & (y[rows] > -1) & (y[rows] < H)
        u, v = x[rows][inside], y[rows][inside]
        column, row = np.floor(u), np.floor(v)
        u -= column
        v -= row
        cell = ((row + 1) * stride + (column + 1)).astype(np.int64)
        weight = sign[rows][inside].astype(np.float64)
        late_share = (tau[rows] - floor)[inside]
        for offset, spatial in ((0, (1 - u) * (1 - v)), (1, u * (1 - v)), (stride, (1 - u) * v), (stride + 1, u * v)):
            spatial *= weight
            late = spatial * late_share
            planes[floor + 1] += np.bincount(cell + offset, spatial - late, planes.shape[1])
            planes[floor + 2] += np.bincount(cell + offset, late, planes.shape[1])
    return planes[1:bins + 1].reshape(bins, H + 2, stride)[:, 1:-1, 1:-1]


def _spread_matrix(positions: Floats) -> scipy.sparse.csr_matrix:
    """Build the (H*W, H*W) matrix that moves the content of raw pixels to the four pixels around their position."""
    height, width = positions.shape[:2]
    x, y = positions[..., 0].ravel(), positions[..., 1].ravel()
    inside = np.isfinite(x) & np.isfinite(y) & (x > -1) & (x < width) & (y > -1) & (y < height)
    source = np.flatnonzero(inside)
    x, y = x[source], y[source]
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    targets, sources, weights = [], [], []
    for right in (0, 1):
        for down in (0, 1):
            weight = np.abs(1 - right - (x - column)) * np.abs(1 - down - (y - row))
            valid = (column + right >= 0) & (column + right < width) & (row + down >= 0) & (row + down < height)
            targets.append(((row + down) * width + column + right)[valid])
            sources.append(source[valid])
            weights.append(weight[valid])
    shape = (height * width, height * width)
    entries = (np.concatenate(weights), (np.concatenate(targets), np.concatenate(sources)))
    return scipy.sparse.csr_matrix(entries, shape=shape)


def remove_hot_pixels(voxel: torch.Tensor, num_stds: float | None = None,
                      num_hot_pixels: int | None = None) -> torch.Tensor:
    """Return the voxel grid with its largest cells set to zero.

    With `num_stds`, every cell with `|E| > mean(E) + num_stds * std(E)` goes (signed values of all cells, zeros
    included; unbiased standard deviation). With `num_hot_pixels`, the n cells of largest magnitude go. Cells are judged
    one by one, not whole pixels.

    Args:
        voxel: (B, H, W) float.
        num_stds: threshold in standard deviations.
        num_hot_pixels: number of cells.

    Raises:
        InputError: not exactly one of the two criteria is given, or it is negative.
    """
    if (num_stds is None) == (num_hot_pixels is None):
        raise InputError("give either num_stds or num_hot_pixels to remove_hot_pixels")
    if num_stds is not None:
        threshold = voxel.mean() + num_stds * voxel.std()
        return torch.where(voxel.abs() > threshold, torch.zeros_like(voxel), voxel)
    if num_hot_pixels is None or num_hot_pixels < 0:
        raise InputError(f"num_hot_pixels is {num_hot_pixels}, expected 0 or more")
    cells = voxel.reshape(-1).clone()
    cells[cells.abs().topk(min(num_hot_pixels, cells.numel())).indices] = 0
    return cells.reshape(voxel.shape)


def resize_voxel(voxel: torch.Tensor, H: int, W: int) -> torch.Tensor:
    """Resize a (B, h, w) voxel grid to (B, H, W) bilinearly (pixel centres at half integers, no antialiasing)."""
    if voxel.shape[-2:] == (H, W):
        return voxel
    return F.interpolate(voxel[None], size=(H, W), mode="bilinear", align_corners=False, antialias=False)[0]


def scale_intrinsics(intrinsics: npt.ArrayLike, old_size: tuple[int, int], new_size: tuple[int, int]) -> Floats:
    """Scale `fx fy cx cy` per axis from one image size (width, height) to another; returns (4,) float64."""
    horizontal, vertical = new_size[0] / old_size[0], new_size[1] / old_size[1]
    return np.asarray(intrinsics, np.float64) * np.array([horizontal, vertical, horizontal, vertical])
