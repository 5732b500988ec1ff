"""Start-up of the tracker: the first structure, and the search for a better one.

A scene seen from nearby places has a family of explanations of nearly the same image motion: relief can be traded for
sideways motion and rotation (the bas-relief ambiguity of structure from motion), and with a negative factor the relief
is inside out (the reversal ambiguity; both exact under orthographic projection, see Szeliski and Kang, "Shape
ambiguities in structure from motion", PAMI 1997). From equal depths and poses, any of them can be found. Once found,
updates hardly lead from one to another, since measurements lean towards the structure they start from; but the wrong
ones leave larger residuals.
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
"""Limits of the inverse depths of a reshaped relief, relative to the middle one."""
REVERSED = -1.0
RESHAPED = (0.4, 2.5, 6.0)
"""Factors of the relief to start from again; updates level it more easily than they raise it."""
CLEAR_GAIN = 0.9
"""In a search over several starts, residuals have to fall below this share to replace a solution."""


def initialize(tracker: DEVO) -> None:
    """Solve for the first keyframes of a tracker that has just collected them, and keep the best of several starts.

    `INITIAL_UPDATES` updates; then as many again from other explanations of the same image motion. With `MIRROR_TEST`
    that is the reversed relief, and the solution with the smaller residuals stays. `START_ROUNDS` > 0 also tries
    flatter and deeper reliefs, that often from the best found so far, as long as a round lowers the residuals clearly.

    `counters["reversed_start"]` says 1 where the solution that stayed came from a reversed relief (or thrice, ...),
    `counters["better_starts"]` how often a solution was replaced.
    """
    tracker.is_initialized = True
    mirror, rounds = getattr(tracker.cfg, "MIRROR_TEST", False), getattr(tracker.cfg, "START_ROUNDS", 0)
    factors = (REVERSED,) * mirror + RESHAPED * (rounds > 0)
    _solve(tracker)
    if not factors:
        return
    gain = CLEAR_GAIN if rounds > 0 else 1.0
    best, replaced, is_reversed = _Solution.of(tracker), 0, 0
    for _ in range(max(rounds, 1)):
        others = {factor: _solve_from(tracker, best, factor) for factor in factors}
        factor = min(others, key=lambda key: others[key].cost)
        if not others[factor].cost < gain * best.cost:
            break
        best, replaced, is_reversed = others[factor], replaced + 1, is_reversed ^ (factor < 0)
    best.restore(tracker)
    tracker.counters["reversed_start"], tracker.counters["better_starts"] = is_reversed, replaced


def _solve_from(tracker: DEVO, start: _Solution, factor: float) -> _Solution:
    """The solution found from the reshaped relief of another one, with measurements that do not remember that one."""
    start.restore(tracker)
    count = tracker.n
    poses, inv_depths = reshaped_relief(tracker.poses_[:count], tracker.patches_[:count, :, 2], factor)
    tracker.poses_[:count], tracker.patches_[:count, :, 2] = poses, inv_depths
    tracker.net = torch.zeros_like(tracker.net)
    _solve(tracker)
    return _Solution.of(tracker)


def _solve(tracker: DEVO) -> None:
    for _ in range(getattr(tracker.cfg, "INITIAL_UPDATES", 12)):
        tracker.update()


def reshaped_relief(cam_T_world: Tensor, inv_depths: Tensor, factor: float) -> tuple[Tensor, Tensor]:
    """Another explanation of the same image motion, to first order in motion and relief.

    With inverse depths d = m + e around their median m, image motion is A w + m B t + e B t (A: rotation, B:
    translation). Multiplying e and dividing the sideways part of t by `factor` keeps the last term, and a rotation by
    (1 - 1 / factor) m (-t_y, t_x, 0), which for small angles moves the image as a sideways shift does, keeps the sum of
    the others. Motion along the optical axis has no such partner and stays.

    Args:
        cam_T_world: `(N,7)`, the first one near the identity.
        inv_depths: `(N,M,...)`, positive.
        factor: of the relief, not 0; -1 turns it inside out.

    Returns:
        Poses `(N,7)` and inverse depths of the same shape, these limited to `FARTHEST`..`NEAREST` times the median.
    """
    middle = torch.quantile(inv_depths.flatten(), 0.5)
    x, y, z = cam_T_world[:, :3].unbind(dim=1)
    turn = SO3.exp((1.0 - 1.0 / factor) * middle * torch.stack([-y, x, torch.zeros_like(z)], dim=1))
    rotation = turn * SO3(cam_T_world[:, 3:])
    poses = torch.cat([torch.stack([x / factor, y / factor, z], dim=1), rotation.data], dim=1)
    reshaped = middle + factor * (inv_depths - middle)
    return SE3(poses).data, reshaped.clamp(FARTHEST * middle, NEAREST * middle)


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
