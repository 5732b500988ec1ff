"""Torch twin of the bundle adjustment kernel: the specification, on any device.

All edges of a frame pair share the relative pose G, and the Jacobian of the source pose is J_i = -J_j Ad(G). So only
J_j is formed for each edge, and its squares are summed for each pair before Ad enters. State is read and written in the
caller's dtype; linearisation and solution run in float64, because the normal matrix of a monocular problem is nearly
singular along the free scale, where float32 leaves little more than rounding errors.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from devo.errors import InputError
from devo.graph import Pairs, frame_pairs, group_sum, relative_poses, unique_with_inverse
from devo.lietorch import SE3

MAX_RESIDUAL = 128.0  # pixels
MIN_DEPTH = 0.2
MARGIN = 64.0  # pixels outside the image
POSE_DAMPING_RELATIVE = 1e-4
POSE_DAMPING = 1.0
MAX_INV_DEPTH, RESET_INV_DEPTH, MIN_INV_DEPTH = 20.0, 1.0, 1e-4

# Places of the 20 products of (5 Jacobian entries and the residual) in the upper triangle of a 7x7 matrix; the row of x
# has no entry for tangent 1, the row of y none for tangent 0.
_TANGENTS_X, _TANGENTS_Y = (0, 2, 3, 4, 5, 6), (1, 2, 3, 4, 5, 6)
_UPPER_X, _UPPER_Y = (
    tuple(zip(*((tangents[row], tangents[column]) for row in range(5) for column in range(row, 6))))
    for tangents in (_TANGENTS_X, _TANGENTS_Y)
)


class BAResult(NamedTuple):
    """What the solver did; E edges, M' distinct patches.

    `success`: every requested iteration was applied (True as well when there was nothing to do).
    `iterations`: number of iterations applied; after a failure the state is that of the last of them.
    `patch_ids`: (M',) int64 distinct `kk`, ascending.
    `depth_information`: (M',) float64, diagonal C of the last linearisation: information (inverse variance) of each
        inverse depth with poses held, if a weight of 1 means a standard deviation of one feature-map pixel.
    `valid`: (E,) bool, edges that took part in the last linearisation.
    `residual`: (E,2) target - projection at the last linearisation in feature-map pixels, dtype of `target`; 0 for
        edges that are not valid.
    """

    success: bool
    iterations: int
    patch_ids: Tensor
    depth_information: Tensor
    valid: Tensor
    residual: Tensor


class _Measurements(NamedTuple):
    """What stays constant over the iterations; float64. Unusable edges have target and weight 0."""

    pairs: Pairs
    patch_ids: Tensor  # (M',)
    patch_of_edge: Tensor  # (E,)
    target: Tensor  # (2,E)
    weight: Tensor  # (2,E), 0 for self edges: they say nothing
    usable: Tensor  # (E,) bool: all numbers of this edge are finite
    patch_finite: Tensor  # (M',) bool
    xy: Tensor  # (2,E) normalised image coordinates of the patch centre
    camera: tuple[Tensor, Tensor, Tensor, Tensor]  # fx fy cx cy of the target camera, scalars or (E,)
    image_size: tuple[Tensor | float, Tensor | float]  # height, width


class _Projection(NamedTuple):
    """Patch centres seen from the target camera; rows over the E edges, 0 where an edge is not valid."""

    G: Tensor  # (Q,3,4) relative pose of each pair
    rotation: Tensor  # (3,3,E)
    translation: Tensor  # (3,E)
    inv_depth: Tensor  # (E,)
    a: Tensor  # (E,) X / Z
    b: Tensor  # (E,) Y / Z
    scale: Tensor  # (2,E) fx / Z, fy / Z
    focal: tuple[Tensor, Tensor]
    valid: Tensor  # (E,) bool
    residual: Tensor  # (2,E)
    weight: Tensor  # (2,E)


class _DepthSystem(NamedTuple):
    """Depth part of the normal equations and the rows it came from."""

    C: Tensor  # (M',)
    u: Tensor  # (M',)
    weighted_jacobian: Tensor  # (2,E) w J_z


class _PoseSystem(NamedTuple):
    """Pose part of the normal equations for N' free poses and its coupling E with the depths."""

    B: Tensor  # (6N',6N')
    E: Tensor  # (6N',M')
    v: Tensor  # (6N',)


def _rows(tensor: Tensor, dims: int, name: str) -> Tensor:
    """View without the batch dimension of size 1."""
    if tensor.dim() == dims + 1 and tensor.shape[0] == 1:
        return tensor[0]
    if tensor.dim() != dims:
        raise InputError(f"{name} has shape {tuple(tensor.shape)}; expected {dims} dimensions and a batch of at most 1")
    return tensor


def _camera_columns(intrinsics: Tensor, frame: Tensor, of_edge: Tensor, per_frame: bool) -> tuple[Tensor, ...]:
    if not per_frame:
        return intrinsics[0].unbind()
    return intrinsics[frame].t().index_select(1, of_edge).unbind()


def _measure(
    patches: Tensor,
    intrinsics: Tensor,
    target: Tensor,
    weight: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    image_size: tuple[float, float] | None,
    per_frame: bool,
) -> _Measurements:
    edges = kk.numel()
    if target.shape != (edges, 2) or weight.shape != (edges, 2) or ii.numel() != edges or jj.numel() != edges:
        shapes = {"target": tuple(target.shape), "weight": tuple(weight.shape), "ii": ii.numel(), "jj": jj.numel()}
        raise InputError(f"kk has {edges} edges, but {shapes}; expected target and weight (1,E,2), ii and jj (E,)")
    pairs = frame_pairs(ii, jj)
    patch_ids, patch_of_edge = unique_with_inverse(kk)
    middle = patches.shape[-1] // 2
    centre = patches[patch_ids, :2, middle, middle].double()  # (M',2)
    patch_finite = torch.isfinite(patches[patch_ids].flatten(1)).all(1)

    intrinsics = intrinsics.double()
    fx, fy, cx, cy = _camera_columns(intrinsics, pairs.source, pairs.of_edge, per_frame)
    camera = _camera_columns(intrinsics, pairs.target, pairs.of_edge, per_frame)
    x, y = centre.t().index_select(1, patch_of_edge)
    columns = torch.stack(((x - cx) / fx, (y - cy) / fy, *target.double().t(), *weight.double().t()))
    usable = torch.isfinite(columns).all(0) & patch_finite[patch_of_edge]
    columns = torch.where(usable, columns, 0.0)
    size = (2 * camera[3], 2 * camera[2]) if image_size is None else image_size
    return _Measurements(
        pairs=pairs,
        patch_ids=patch_ids,
        patch_of_edge=patch_of_edge,
        target=columns[2:4],
        weight=columns[4:] * (ii != jj),
        usable=usable,
        patch_finite=patch_finite,
        xy=columns[:2],
        camera=(camera[0], camera[1], camera[2], camera[3]),
        image_size=size,
    )


def _adjoint(G: Tensor) -> Tensor:
    """Ad(G) (Q,6,6) of `[R|t]` (Q,3,4), for tangents (translation, rotation)."""
    rotation, translation = G[:, :, :3], G[:, :, 3:]
    adjoint = G.new_zeros(G.shape[0], 6, 6)
    adjoint[:, :3, :3] = rotation
    adjoint[:, 3:, 3:] = rotation
    adjoint[:, :3, 3:] = torch.linalg.cross(translation.expand_as(rotation), rotation, dim=1)
    return adjoint


def _pose_blocks(H: Tensor, g: Tensor, G: Tensor, i: Tensor, j: Tensor, free: int) -> tuple[Tensor, Tensor]:
    """Assemble B (6N',6N') and v (6N',) from the sums of each pair: H (Q,6,6) of J_j^T J_j, g (Q,6) of J_j^T r.

    `i`, `j` (Q,) are the slots of source and target: 0 for a fixed pose, 1..N' for a free one.
    """
    adjoint = _adjoint(G)
    upper = -adjoint.mT @ H  # source row, target column
    blocks = torch.cat((H, -upper @ adjoint, upper, upper.mT)).flatten(1)
    width = free + 1
    place = torch.cat((j * width + j, i * width + i, i * width + j, j * width + i))
    B = H.new_zeros(width * width, 36).index_add_(0, place, blocks).view(width, width, 6, 6)
    gradients = torch.cat((g, -(adjoint.mT @ g[:, :, None])[:, :, 0]))
    v = H.new_zeros(width, 6).index_add_(0, torch.cat((j, i)), gradients)
    return B[1:, 1:].transpose(1, 2).reshape(6 * free, 6 * free), v[1:].reshape(-1)


def _project(poses: Tensor, inv_depth: Tensor, m: _Measurements) -> _Projection:
    G = relative_poses(poses, m.pairs.source, m.pairs.target)
    # A pair with a broken pose becomes G = 0, which puts its points at Z = 0: its edges are not valid.
    G = torch.where(torch.isfinite(G).flatten(1).all(1)[:, None, None], G, 0.0)
    table = G.permute(1, 2, 0).reshape(12, -1).index_select(1, m.pairs.of_edge).view(3, 4, -1)
    rotation, translation = table[:, :3], table[:, 3]
    d = inv_depth.index_select(0, m.patch_of_edge)
    X, Y, Z = rotation[:, 0] * m.xy[0] + rotation[:, 1] * m.xy[1] + rotation[:, 2] + translation * d

    fx, fy, cx, cy = m.camera
    in_front = Z > MIN_DEPTH
    inverse_z = torch.where(in_front, Z, 1.0).reciprocal()
    a, b = X * inverse_z, Y * inverse_z
    u, v = fx * a + cx, fy * b + cy
    rx, ry = m.target[0] - u, m.target[1] - v
    height, width = m.image_size
    valid = in_front & m.usable & (rx * rx + ry * ry < MAX_RESIDUAL**2)
    valid &= (u > -MARGIN) & (v > -MARGIN) & (u < width + MARGIN) & (v < height + MARGIN)
    return _Projection(
        G=G,
        rotation=rotation,
        translation=translation,
        inv_depth=d,
        a=a,
        b=b,
        scale=torch.stack((fx * inverse_z, fy * inverse_z)),
        focal=(fx, fy),
        valid=valid,
        residual=torch.where(valid, torch.stack((rx, ry)), 0.0),
        weight=torch.where(valid, m.weight, 0.0),
    )


def _depth_system(p: _Projection, m: _Measurements) -> _DepthSystem:
    # The pixel moves with the point by (1, 0, -a) fx / Z and (0, 1, -b) fy / Z, the point with d by the translation.
    tx, ty, tz = p.translation
    jacobian = p.scale * torch.stack((tx - tz * p.a, ty - tz * p.b))
    weighted = p.weight * jacobian
    terms = torch.stack(((weighted * jacobian).sum(0), (weighted * p.residual).sum(0)))
    C, u = group_sum(terms, m.patch_of_edge, m.patch_ids.numel())
    return _DepthSystem(C, u, weighted)


def _pose_system(p: _Projection, depth: _DepthSystem, m: _Measurements, t0: int, free: int) -> _PoseSystem:
    # J_j without the zero of each row, followed by the residual: products of two rows then hold J^T J and J^T r.
    a, b, d, pairs = p.a, p.b, p.inv_depth, m.pairs
    (fx, fy), ab, (sx, sy) = p.focal, a * b, p.scale * d
    rows_x = (sx, -sx * a, -fx * ab, fx * (1 + a * a), -fx * b, p.residual[0])
    rows_y = (sy, -sy * b, -fy * (1 + b * b), fy * ab, fy * a, p.residual[1])
    J = torch.stack(rows_x + rows_y).view(2, 6, -1)
    wJ = p.weight[:, None] * J[:, :5]
    products = J.new_empty(2, 20, J.shape[2])
    for row, start in enumerate((0, 6, 11, 15, 18)):
        torch.mul(J[:, row:], wJ[:, row : row + 1], out=products[:, start : start + 6 - row])
    sums = group_sum(products.flatten(0, 1), pairs.of_edge, pairs.source.numel()).t()
    upper = sums.new_zeros(sums.shape[0], 7, 7)
    upper[(slice(None), *_UPPER_X)] = sums[:, :20]
    upper[(slice(None), *_UPPER_Y)] += sums[:, 20:]
    H = upper[:, :6, :6] + upper[:, :6, :6].triu(1).mT
    # Slot 0 collects whatever belongs to fixed poses.
    slot_i, slot_j = ((f - t0 + 1).masked_fill_((f < t0) | (f >= t0 + free), 0) for f in (pairs.source, pairs.target))
    B, v = _pose_blocks(H, upper[:, :6, 6], p.G, slot_i, slot_j, free)

    # Columns of E: sum w J_z J_j for the target; for the source minus (d n, X_i x n) with n = R^T sum w J_z p.
    wz = depth.weighted_jacobian
    of_target = torch.cat((wz * J[:, 0], (wz[:, None] * J[:, 1:5]).sum(0)))
    px, py = wz * p.scale
    nx, ny, nz = p.rotation[0] * px + p.rotation[1] * py - p.rotation[2] * (px * a + py * b)
    x, y = m.xy
    of_source = torch.stack((-d * nx, -d * ny, -d * nz, ny - y * nz, x * nz - nx, y * nx - x * ny))
    patch_slots = m.patch_of_edge * (free + 1)
    E = J.new_zeros(6, depth.C.numel() * (free + 1))
    for slot, columns in ((slot_i, of_source), (slot_j, of_target)):
        E.scatter_add_(1, (patch_slots + slot[pairs.of_edge]).expand(6, -1), columns)
    E = E.view(6, -1, free + 1)[:, :, 1:].permute(2, 0, 1).reshape(6 * free, -1)
    return _PoseSystem(B, E, v)


def _solve(depth: _DepthSystem, pose: _PoseSystem | None, lmbda: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return pose step (6N',), depth step (M',) and whether both can be used (0-dim bool)."""
    Q = (depth.C + lmbda).reciprocal()
    if pose is None:
        depth_step = Q * depth.u
        return depth_step[:0], depth_step, torch.isfinite(depth_step).all()
    EQ = pose.E * Q
    S = pose.B - EQ @ pose.E.mT
    diagonal = S.diagonal()
    diagonal.add_(POSE_DAMPING_RELATIVE * diagonal + POSE_DAMPING)
    factor, info = torch.linalg.cholesky_ex(S)
    pose_step = torch.cholesky_solve((pose.v - EQ @ depth.u)[:, None], factor)[:, 0]
    depth_step = Q * (depth.u - pose.E.mT @ pose_step)
    usable = (info == 0) & torch.isfinite(pose_step).all() & torch.isfinite(depth_step).all()
    return pose_step, depth_step, usable


def _apply(poses: Tensor, patches: Tensor, m: _Measurements, t0: int, pose_step: Tensor, depth_step: Tensor) -> None:
    """Move poses, then depths; numbers that are not finite stay what they are."""
    moved = poses[t0 : t0 + pose_step.numel() // 6]
    if moved.numel():
        steps = SE3.exp(pose_step.view(-1, 6))
        new = steps.mul(SE3(moved.double())).data
        quaternion = new[:, 3:]
        new = torch.cat((new[:, :3], quaternion / quaternion.norm(dim=-1, keepdim=True)), -1)
        finite = torch.isfinite(new).all(1, keepdim=True)
        moved.copy_(torch.where(finite, new.to(moved.dtype), moved))
    depth = patches[m.patch_ids, 2, 0, 0] + depth_step.to(patches.dtype)
    depth = torch.where(depth > MAX_INV_DEPTH, RESET_INV_DEPTH, depth).clamp(min=MIN_INV_DEPTH)
    keep = m.patch_finite
    patches[m.patch_ids[keep], 2] = depth[keep][:, None, None]


@torch.no_grad()
def ba(
    poses: Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    target: Tensor,
    weight: Tensor,
    lmbda: Tensor | float,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    t0: int,
    t1: int,
    iterations: int = 2,
    *,
    image_size: tuple[float, float] | None = None,
    per_frame_intrinsics: bool = False,
) -> BAResult:
    """Torch twin of `devo.fastba.BA`; the same arguments (poses as tensor) and results.

    Edges with a number that is not finite (pose, patch, target, weight) are not valid. A patch that is not finite is
    left as it is, and so is a pose.
    """
    pose_rows = _rows(poses.detach(), 2, "poses")
    patch_rows = _rows(patches.detach(), 4, "patches")
    target_rows, weight_rows = _rows(target.detach(), 2, "target"), _rows(weight.detach(), 2, "weight")
    if kk.numel() == 0:
        nothing = target_rows.new_zeros(0, 2)
        return BAResult(True, 0, kk.clone(), nothing.double()[:, 0], nothing[:, 0].bool(), nothing)
    measurements = _measure(
        patch_rows, _rows(intrinsics, 2, "intrinsics"), target_rows, weight_rows, ii, jj, kk, image_size,
        per_frame_intrinsics,
    )  # fmt: skip
    damping = torch.as_tensor(lmbda, dtype=torch.float64, device=patch_rows.device).reshape(())
    t0, t1 = max(int(t0), 0), min(int(t1), pose_rows.shape[0])
    free = max(t1 - t0, 0)
    middle = patch_rows.shape[-1] // 2
    done, success = 0, True
    information = pose_rows.new_zeros(measurements.patch_ids.numel(), dtype=torch.float64)
    valid, residual = torch.zeros_like(measurements.usable), torch.zeros_like(measurements.target)
    for _ in range(iterations):
        inv_depth = patch_rows[measurements.patch_ids, 2, middle, middle].double()
        inv_depth = torch.where(measurements.patch_finite, inv_depth, 0.0)
        projection = _project(pose_rows, inv_depth, measurements)
        depth = _depth_system(projection, measurements)
        pose = _pose_system(projection, depth, measurements, t0, free) if free else None
        information, valid, residual = depth.C, projection.valid, projection.residual
        pose_step, depth_step, usable = _solve(depth, pose, damping)
        if not bool(usable):
            success = False
            break
        _apply(pose_rows, patch_rows, measurements, t0, pose_step, depth_step)
        done += 1
    return BAResult(success, done, measurements.patch_ids, information, valid, residual.t().to(target.dtype))


@torch.no_grad()
def reproject(poses: Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor) -> Tensor:
    """Torch twin of `devo.fastba.reproject`; the same arguments (poses as tensor) and result."""
    patch_rows = _rows(patches, 4, "patches")
    pairs = frame_pairs(ii, jj)
    G = relative_poses(_rows(poses, 2, "poses"), pairs.source, pairs.target)[pairs.of_edge][..., None, None]
    fx, fy, cx, cy = _rows(intrinsics, 2, "intrinsics")[0].double()
    x, y, d = patch_rows[kk].double().unbind(1)  # (E,P,P) each
    x, y = (x - cx) / fx, (y - cy) / fy
    X, Y, Z = (G[:, r, 0] * x + G[:, r, 1] * y + G[:, r, 2] + G[:, r, 3] * d for r in range(3))
    return torch.stack((fx * X / Z + cx, fy * Y / Z + cy), 1)[None].to(patches.dtype)
