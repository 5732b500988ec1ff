"""The sparse geometry of a run, read once at the end: points, depths, provenance and quality."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from devo.lietorch import SE3
from devo.trajectory import backproject

if TYPE_CHECKING:
    from devo.devo import DEVO
    from devo.patchgraph import EdgeRecords

_EDGES_PER_CHUNK = 1 << 18
_MIN_Z = 0.2  # the gates of the solver: an observation counts when the solver could use it
_MAX_RESIDUAL = 128.0
_MARGIN = 64.0
_DEPTH_PRIOR = 1e-4  # damping of the inverse depths in the solver
_CLAMPED_INV_DEPTH = 1e-4
_RESET_INV_DEPTH = 1.0


@dataclass(frozen=True)
class Observables:
    """All finite points of all keyframes; row `i` of every array belongs to point `i`. Nothing is filtered.

    Attributes:
        points: `(K,3)` float32, world frame (first accepted camera), arbitrary scale.
        depths: `(K,)` float32, z-depth in the host camera, trajectory units.
        inv_depths: `(K,)` float32, `1 / depths`.
        host_frame: `(K,)` int64, accepted-frame index (row of the poses) of the host keyframe.
        t_us: `(K,)` float64, time stamp of the host keyframe.
        pixel_xy: `(K,2)` float32, column and row in the full-resolution, uncropped host frame.
        inv_depth_sigma: `(K,)` float32, `(sum w J^2 + lambda)^(-1/2)` over all observations: the standard deviation of
            the inverse depth if a weight of one means a noise of one quarter-resolution pixel.
        observations: `(K,)` int32, keyframes other than the host in which the solver could use the point.
        mean_weight: `(K,)` float32, mean confidence of these observations, 0 without any.
        residual_px: `(K,)` float32, median distance between measured and reprojected position [full-resolution px];
            NaN without observations.
        parallax_deg: `(K,)` float32, largest angle at the point between host and observing camera centres.
        clamped: `(K,)` bool, the inverse depth sits on a limit or on the reset value of the solver.
        colors: `(K,3)` float32 in [0,1]; event rate in event mode. None if not asked for.
    """

    points: np.ndarray
    depths: np.ndarray
    inv_depths: np.ndarray
    host_frame: np.ndarray
    t_us: np.ndarray
    pixel_xy: np.ndarray
    inv_depth_sigma: np.ndarray
    observations: np.ndarray
    mean_weight: np.ndarray
    residual_px: np.ndarray
    parallax_deg: np.ndarray
    clamped: np.ndarray
    colors: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.points)

    def scalars(self) -> dict[str, np.ndarray]:
        """The per-point properties by name, as cloud files store them; pixels split into two columns."""
        single = {field.name: getattr(self, field.name) for field in fields(self)
                  if field.name not in ("points", "pixel_xy", "colors", "depths", "inv_depths", "clamped")}
        return {"depth": self.depths, "inv_depth": self.inv_depths, "pixel_x": self.pixel_xy[:, 0],
                "pixel_y": self.pixel_xy[:, 1], "clamped": self.clamped.astype(np.uint8), **single}


def build_observables(tracker: DEVO, include_colors: bool = False) -> Observables:
    """Read the sparse geometry out of a tracker with its current (normally final) poses and depths."""
    m, quarter_px = tracker.m, tracker.RES
    hosts = tracker.ix[:m]
    patches = tracker.patches[0, :m]
    points, inv_depths, centers = backproject(tracker.poses_[hosts], patches, tracker.intrinsics_[hosts])
    quality = _point_quality(tracker, tracker.all_edges())
    finite = torch.isfinite(points).all(dim=1)
    crop = torch.tensor([tracker.crop_left, tracker.crop_top], device=tracker.device)
    clamped = (inv_depths <= _CLAMPED_INV_DEPTH) | (inv_depths == _RESET_INV_DEPTH)

    def rows(values: Tensor) -> np.ndarray:
        return values[finite].cpu().numpy()

    host_frame = rows(tracker.tstamps_[hosts])
    return Observables(
        points=rows(points.float()), depths=rows(1.0 / inv_depths), inv_depths=rows(inv_depths),
        host_frame=host_frame, t_us=np.asarray(tracker.tlist, dtype=np.float64)[host_frame],
        pixel_xy=rows(centers * quarter_px + crop), clamped=rows(clamped),
        inv_depth_sigma=rows((quality["information"] + _DEPTH_PRIOR).rsqrt()),
        observations=rows(quality["observations"].int()), mean_weight=rows(quality["mean_weight"]),
        residual_px=rows(quality["residual"] * quarter_px), parallax_deg=rows(torch.rad2deg(quality["parallax"])),
        colors=rows(tracker.colors_[:tracker.n].flatten(0, 1).float() / 255.0) if include_colors else None)


def _point_quality(tracker: DEVO, edges: EdgeRecords) -> dict[str, Tensor]:
    """Accumulate what all observations say about each of the `m` patches."""
    m, device = tracker.m, tracker.device
    edges = edges.select(edges.ii != edges.jj)  # a patch always agrees with its own frame
    columns = [_observe(tracker, edges, slice(start, start + _EDGES_PER_CHUNK))
               for start in range(0, max(len(edges), 1), _EDGES_PER_CHUNK)]
    valid, residual, weight, information, parallax = (torch.cat(column) for column in zip(*columns, strict=True))
    patch = edges.kk[valid]
    count = torch.zeros(m, device=device).index_add_(0, patch, torch.ones(len(patch), device=device))
    weight_sum = torch.zeros(m, device=device).index_add_(0, patch, weight[valid])
    return {
        "observations": count,
        "mean_weight": weight_sum / count.clamp(min=1.0),
        "information": torch.zeros(m, device=device).index_add_(0, patch, information[valid]),
        "parallax": torch.zeros(m, device=device).scatter_reduce_(0, patch, parallax[valid], "amax"),
        "residual": _segment_median(residual[valid], patch, m),
    }


def _observe(tracker: DEVO, edges: EdgeRecords, chunk: slice) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Per edge: usable by the solver, residual [px], mean weight, information on the inverse depth, parallax [rad].

    With `G = T_j T_i^-1 = (R, t)` and the host ray `X = ((x-cx)/fx, (y-cy)/fy, 1)` the observed direction is
    `Y = R X + t d`; the parallax is the angle between `R X` and `Y`.
    """
    ii, jj, kk = edges.ii[chunk], edges.jj[chunk], edges.kk[chunk]
    centre = tracker.P // 2
    x, y, inv_depth = tracker.patches[0, kk, :, centre, centre].unbind(dim=1)
    fx, fy, cx, cy = tracker.intrinsics_[ii].unbind(dim=1)
    ray = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], dim=1)
    motion = (SE3(tracker.poses_[jj]) * SE3(tracker.poses_[ii]).inv()).data
    translation = motion[:, :3]
    rotated = SE3(torch.cat([torch.zeros_like(translation), motion[:, 3:]], dim=1)).act(ray)
    seen = rotated + translation * inv_depth[:, None]
    X, Y, Z = seen.unbind(dim=1)
    in_front = Z > _MIN_Z
    rho = torch.where(in_front, 1.0 / Z, torch.zeros_like(Z))
    fx, fy, cx, cy = tracker.intrinsics_[jj].unbind(dim=1)
    u, v = fx * X * rho + cx, fy * Y * rho + cy
    residual = (edges.target[chunk] - torch.stack([u, v], dim=1)).norm(dim=1)
    height, width = tracker.fmap1_.shape[-2:]
    inside = (u > -_MARGIN) & (v > -_MARGIN) & (u < width + _MARGIN) & (v < height + _MARGIN)
    weight = edges.weight[chunk]
    valid = in_front & inside & (residual < _MAX_RESIDUAL) & (weight > 0).any(dim=1)
    tx, ty, tz = translation.unbind(dim=1)
    jacobian_x, jacobian_y = fx * rho * (tx - tz * X * rho), fy * rho * (ty - tz * Y * rho)
    information = weight[:, 0] * jacobian_x.square() + weight[:, 1] * jacobian_y.square()
    parallax = torch.atan2(torch.linalg.cross(rotated, seen).norm(dim=1), (rotated * seen).sum(dim=1))
    return valid, residual, weight.mean(dim=1), information, parallax


def _segment_median(values: Tensor, segment: Tensor, count: int) -> Tensor:
    """Lower median of `values (E,)` per segment id `(E,)` in `0..count-1`; NaN for empty segments."""
    order = torch.argsort(values, stable=True)
    order = order[torch.argsort(segment[order], stable=True)]
    sizes = torch.bincount(segment, minlength=count)
    first = torch.cumsum(sizes, dim=0) - sizes
    result = values.new_full((count,), float("nan"))
    filled = sizes > 0
    result[filled] = values[order][(first + (sizes - 1).clamp(min=0) // 2)[filled]]
    return result
