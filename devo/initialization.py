"""Start-up of the tracker: the first structure, and whether its relief is the right way round.

A scene seen from nearby places has two explanations of nearly the same image motion: the true one, and one with the
relief turned inside out, the opposite motion and a rotation that makes up for it (the reversal ambiguity of
structure from motion; exact under orthographic projection, see Szeliski and Kang, "Shape ambiguities in structure
from motion", PAMI 1997). From equal depths and poses, either can be found. Once found, no update leads from one to the
other, but the wrong one leaves larger residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from devo.fastba import BAResult
from devo.lietorch import SE3, SO3

if TYPE_CHECKING:
    from devo.devo import DEVO

UNEXPLAINED = 1.0
"""Squared residual [quarter-resolution px^2] at which a measurement counts as not explained at all."""
NEAREST, FARTHEST = 3.0, 0.3
"""Limits of the inverse depths of a reversed relief, relative to the middle one."""


def initialize(tracker: DEVO) -> None:
    """Solve for the first keyframes of a tracker that has just collected them.

    `INITIAL_UPDATES` updates; with `MIRROR_TEST`, as many again from the reversed relief, and the solution with the
    smaller residuals stays. `counters["reversed_start"]` says 1 where that was the second one.
    """
    tracker.is_initialized = True
    _solve(tracker)
    if not getattr(tracker.cfg, "MIRROR_TEST", False):
        return
    first = _Solution.of(tracker)
    count = tracker.n
    poses, inv_depths = reversed_relief(tracker.poses_[:count], tracker.patches_[:count, :, 2])
    tracker.poses_[:count], tracker.patches_[:count, :, 2] = poses, inv_depths
    tracker.net = torch.zeros_like(tracker.net)
    _solve(tracker)
    is_better = _Solution.of(tracker).cost < first.cost
    if not is_better:
        first.restore(tracker)
    tracker.counters["reversed_start"] = int(is_better)


def _solve(tracker: DEVO) -> None:
    for _ in range(getattr(tracker.cfg, "INITIAL_UPDATES", 12)):
        tracker.update()


def reversed_relief(cam_T_world: Tensor, inv_depths: Tensor) -> tuple[Tensor, Tensor]:
    """The other explanation of the same image motion, to first order in motion and relief.

    With inverse depths d = m + e around their median m, image motion is A w + m B t + e B t (A: rotation, B:
    translation). Turning e and the sideways part of t around keeps the last term, and a rotation by 2 m (-t_y, t_x, 0),
    which for small angles moves the image as a sideways shift does, keeps the sum of the others. Motion along the
    optical axis has no such partner and stays.

    Args:
        cam_T_world: `(N,7)`, the first one near the identity.
        inv_depths: `(N,M,...)`, positive.

    Returns:
        Poses `(N,7)` and inverse depths of the same shape, these limited to `FARTHEST`..`NEAREST` times the median.
    """
    middle = torch.quantile(inv_depths.flatten(), 0.5)
    x, y, z = cam_T_world[:, :3].unbind(dim=1)
    turn = SO3.exp(2.0 * middle * torch.stack([-y, x, torch.zeros_like(z)], dim=1))
    rotation = turn * SO3(cam_T_world[:, 3:])
    poses = torch.cat([torch.stack([-x, -y, z], dim=1), rotation.data], dim=1)
    return SE3(poses).data, (2.0 * middle - inv_depths).clamp(FARTHEST * middle, NEAREST * middle)


@dataclass(frozen=True)
class _Solution:
    """State of the tracker that updates change, and how badly it explains its measurements."""

    poses: Tensor
    patches: Tensor
    net: Tensor
    target: Tensor
    weight: Tensor
    solve: BAResult
    cost: float

    @classmethod
    def of(cls, tracker: DEVO) -> _Solution:
        return cls(tracker.poses_[:tracker.n].clone(), tracker.patches_[:tracker.n].clone(), tracker.net.clone(),
                   tracker.target_.clone(), tracker.weight_.clone(), tracker.last_solve, unexplained_share(tracker))

    def restore(self, tracker: DEVO) -> None:
        tracker.poses_[:tracker.n], tracker.patches_[:tracker.n] = self.poses, self.patches
        tracker.net, tracker.target_, tracker.weight_ = self.net, self.target, self.weight
        tracker.last_solve = self.solve


def unexplained_share(tracker: DEVO) -> float:
    """Weighted mean squared residual of all measurements between different keyframes, 0..1.

    Residuals are limited to `UNEXPLAINED`; measurements of points behind the camera count as that. Infinite where
    nothing was measured.
    """
    centre = tracker.P // 2
    residual = tracker.target_[0] - tracker.reproject()[0, :, :, centre, centre]
    square = residual.square().sum(dim=1).nan_to_num(UNEXPLAINED, UNEXPLAINED).clamp(max=UNEXPLAINED)
    square = torch.where(tracker.last_solve.valid.bool().reshape(-1), square, UNEXPLAINED)
    weight = tracker.weight_[0].mean(dim=1) * (tracker.ii != tracker.jj)
    total = float(weight.sum())
    return float((weight * square).sum()) / total if total > 0 else float("inf")
