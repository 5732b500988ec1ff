"""Linearisation in float32, edge by edge and in the order in which the published kernel adds up.

A monocular problem is nearly singular along its free scale, so float32 results depend on the order of summation. This
is the order of the published solver, for results that have to agree with it; `devo.normal_equations` is faster and
more accurate.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from devo.lietorch.quaternion import quat_conjugate

MIN_DEPTH = 0.2


class System(NamedTuple):
    """Normal equations of N free poses and M patches, and what the edges said."""

    B: Tensor  # (6N,6N)
    E: Tensor  # (6N,M)
    v: Tensor  # (6N,)
    C: Tensor  # (M,)
    u: Tensor  # (M,)
    valid: Tensor  # (edges,) bool
    residual: Tensor  # (edges,2) target - pixel, 0 where not valid


class Edges(NamedTuple):
    """The constant part of the problem, one row per edge."""

    ray: Tensor  # (edges,3) normalised image coordinates in the source camera, 1
    target: Tensor  # (edges,2) pixels
    weight: Tensor  # (edges,2)
    usable: Tensor  # (edges,) bool, all numbers finite
    camera: Tensor  # (edges,4) or (1,4), of the target frame
    upper: Tensor  # (1,2) or (edges,2) largest valid pixel
    margin: float
    max_residual: float
    source: Tensor  # (edges,) frame
    seen: Tensor  # (edges,) frame
    patch: Tensor  # (edges,) 0..M-1


def _cross(a: Tensor, b: Tensor) -> Tensor:
    x, y, z = a.unbind(1)
    X, Y, Z = b.unbind(1)
    return torch.stack((y * Z - z * Y, z * X - x * Z, x * Y - y * X), 1)


def _rotate(q: Tensor, p: Tensor) -> Tensor:
    twice = 2 * _cross(q[:, :3], p)
    return p + q[:, 3:] * twice + _cross(q[:, :3], twice)


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    x, y, z, w = a.unbind(1)
    X, Y, Z, W = b.unbind(1)
    return torch.stack((w * X + x * W + y * Z - z * Y, w * Y + y * W + z * X - x * Z,
                        w * Z + z * W + x * Y - y * X, w * W - x * X - y * Y - z * Z), 1)


def linearize(poses: Tensor, inv_depth: Tensor, e: Edges, t0: int, free: int, patches: int) -> System:
    """Normal equations at the current state.

    Args:
        poses: (N,7) float32 world->camera. inv_depth: (M,) of the patches. e: the edges.
        t0, free: first free pose and their number. patches: M.

    Returns:
        The system; derivatives with respect to left perturbations (translation, rotation) of the poses.
    """
    start, end = poses[e.source], poses[e.seen]
    q = _multiply(end[:, 3:], quat_conjugate(start[:, 3:]))
    t = end[:, :3] - _rotate(q, start[:, :3])
    depth = inv_depth[e.patch]
    X, Y, Z = (_rotate(q, e.ray) + t * depth[:, None]).unbind(1)
    in_front = Z > MIN_DEPTH
    usable = e.usable & in_front & torch.isfinite(X) & torch.isfinite(Y)
    X, Y, Z, depth = (torch.where(usable, value, 0.0) for value in (X, Y, Z, depth))
    rho = torch.where(usable, 1 / torch.where(usable, Z, 1.0), 0.0)
    fx, fy, cx, cy = e.camera.unbind(1)
    u, v = fx * (X * rho) + cx, fy * (Y * rho) + cy
    residual = e.target - torch.stack((u, v), 1)
    inside = (u > -e.margin) & (v > -e.margin) & (u < e.upper[:, 0]) & (v < e.upper[:, 1])
    valid = usable & inside & (residual.square().sum(1).sqrt() < e.max_residual)
    residual = torch.where(valid[:, None], residual, 0.0)
    weight = torch.where(valid[:, None], e.weight, 0.0)
    q, t = (torch.where(valid[:, None], value, 0.0) for value in (q, t))

    rho2, zero = rho * rho, torch.zeros_like(X)
    row_x = (depth * rho, zero, -X * depth * rho2, -X * Y * rho2, 1 + X * X * rho2, -Y * rho)
    row_y = (zero, depth * rho, -Y * depth * rho2, -1 - Y * Y * rho2, X * Y * rho2, X * rho)
    to_x, to_y = fx[:, None] * torch.stack(row_x, 1), fy[:, None] * torch.stack(row_y, 1)
    jz = torch.stack((fx * (t[:, 0] * rho - t[:, 2] * (X * rho2)), fy * (t[:, 1] * rho - t[:, 2] * (Y * rho2))), 1)
    back = quat_conjugate(q)

    def at_source(J: Tensor) -> Tensor:
        moved, turned = J[:, :3], J[:, 3:]
        return -torch.cat((_rotate(back, moved), _rotate(back, turned) + _rotate(back, _cross(moved, t))), 1)

    # rows x and y of each edge follow each other, as the kernel visits them
    Jj = torch.stack((to_x, to_y), 1).flatten(0, 1)
    Ji = torch.stack((at_source(to_x), at_source(to_y)), 1).flatten(0, 1)
    w, r, Jz = weight.flatten(), residual.flatten(), jz.flatten()
    slots = free + 1  # slot 0 collects what concerns fixed poses

    def slot(frame: Tensor) -> Tensor:
        return torch.where((frame >= t0) & (frame < t0 + free), frame - t0 + 1, 0).repeat_interleave(2)

    i, j, k = slot(e.source), slot(e.seen), e.patch.repeat_interleave(2)
    C = w.new_zeros(patches).index_add_(0, k, w * Jz * Jz)
    u_ = w.new_zeros(patches).index_add_(0, k, w * Jz * r)
    B = w.new_zeros(slots * slots, 36)
    v_ = w.new_zeros(slots, 6)
    E = w.new_zeros(slots * patches, 6)
    for row, rows, column, columns in ((i, Ji, i, Ji), (j, Jj, j, Jj), (i, Ji, j, Jj), (j, Jj, i, Ji)):
        products = w[:, None, None] * (rows[:, :, None] * columns[:, None])
        B.index_add_(0, row * slots + column, products.flatten(1))
    for row, rows in ((i, Ji), (j, Jj)):
        v_.index_add_(0, row, (w * r)[:, None] * rows)
        E.index_add_(0, row * patches + k, (w * Jz)[:, None] * rows)
    B = B.view(slots, slots, 6, 6)[1:, 1:].transpose(1, 2).reshape(6 * free, 6 * free)
    E = E.view(slots, patches, 6)[1:].transpose(1, 2).reshape(6 * free, patches)
    return System(B, E, v_[1:].flatten(), C, u_, valid, residual)
