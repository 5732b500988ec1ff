"""Pinhole geometry of inverse-depth patches: back-projection, projection, transfer between frames, point clouds.

A patch pixel (x, y, d) of a camera K = (fx, fy, cx, cy) is the homogeneous point ((x-cx)/fx, (y-cy)/fy, 1, d), whose
Euclidean point is its XYZ / d (Civera et al. 2008). Poses are world->camera; tensors have a batch dimension of 1.
Gradients of `SE3` poses are left-tangent gradients as in `devo.lietorch`, those of plain pose tensors are ordinary.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from devo.errors import InputError
from devo.graph import Pairs, adjoint_matrices, frame_pairs, relative_matrices, relative_poses
from devo.lietorch import SE3
from devo.lietorch.quaternion import precise_matmul

MIN_PROJECTION_DEPTH = 0.1  # nearer points are projected as if they were here
MIN_VALID_DEPTH = 0.2  # nearer points are not valid and have no Jacobian


def _pose_rows(poses: SE3 | Tensor) -> Tensor:
    """SE3 data (N,7) of `SE3` with batch (1,N), or of a tensor (1,N,7)."""
    data = SE3.InitFromVec(poses).data if isinstance(poses, Tensor) else poses.data
    if data.dim() != 3 or data.shape[0] != 1:
        raise InputError(f"poses have data of shape {tuple(data.shape)}; expected (1,N,7), one batch of N poses")
    return data[0]


def iproj(patches: Tensor, intrinsics: Tensor) -> Tensor:
    """Back-project patch pixels to homogeneous points of their own camera.

    Args:
        patches: (1,E,3,P,P), channels x, y in pixels and inverse depth.
        intrinsics: (1,E,4) `fx fy cx cy` in the same pixels.

    Returns:
        (1,E,P,P,4) points ((x-cx)/fx, (y-cy)/fy, 1, d).
    """
    x, y, d = patches.unbind(2)
    fx, fy, cx, cy = intrinsics[..., None, None].unbind(2)
    return torch.stack(((x - cx) / fx, (y - cy) / fy, torch.ones_like(d), d), dim=-1)


def proj(X: Tensor, intrinsics: Tensor, depth: bool = False) -> Tensor:
    """Project homogeneous points of the camera frame, with Z limited to at least 0.1.

    Args:
        X: (1,E,P,P,4) points (X, Y, Z, W).
        intrinsics: (1,E,4) `fx fy cx cy`.
        depth: append 1 / max(Z, 0.1).

    Returns:
        (1,E,P,P,2) pixels (x, y), or (1,E,P,P,3) with `depth`.
    """
    inverse_z = X[..., 2].clamp(min=MIN_PROJECTION_DEPTH).reciprocal()
    fx, fy, cx, cy = intrinsics[..., None, None].unbind(2)
    columns = [fx * (X[..., 0] * inverse_z) + cx, fy * (X[..., 1] * inverse_z) + cy]
    if depth:
        columns.append(inverse_z)
    return torch.stack(columns, dim=-1)


def _moved(G: Tensor, X0: Tensor) -> Tensor:
    """Homogeneous points (1,E,P,P,4) moved by `[R|t]` (E,3,4)."""
    edges, side = X0.shape[1], X0.shape[2]
    xyz = precise_matmul(X0.view(edges, side * side, 4), G.mT)
    return torch.cat((xyz.view(1, edges, side, side, 3), X0[..., 3:]), dim=-1)


def _edge_matrices(poses: SE3 | Tensor, pairs: Pairs) -> tuple[Tensor, Tensor]:
    of_pairs = relative_matrices(_pose_rows(poses), pairs.source, pairs.target)
    return of_pairs, of_pairs.index_select(0, pairs.of_edge)


def transform(
    poses: SE3 | Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    depth: bool = False,
    valid: bool = False,
    jacobian: bool = False,
    tonly: bool = False,
) -> Any:
    """Transfer patches from their source frames into the target frames; differentiable in poses, patches, intrinsics.

    Args:
        poses: `SE3` with batch (1,N), or tensor (1,N,7), world->camera.
        patches: (1,K,3,P,P), channels x, y in pixels and inverse depth.
        intrinsics: (1,N,4) `fx fy cx cy` of every frame.
        ii: (E,) int64 source frames.
        jj: (E,) int64 target frames.
        kk: (E,) int64 patches.
        depth: append 1 / max(Z, 0.1) to the pixels.
        valid: return the validity as well.
        jacobian: return validity and Jacobians as well.
        tonly: use only the translation of the relative pose.

    Returns:
        `x1` (1,E,P,P,2 or 3); with `valid` `(x1, v)`, v (1,E) = 1 where the patch centre has Z > 0.2, else 0; with
        `jacobian` `(x1, v, (Ji, Jj, Jz))`, derivatives of the centre pixel with respect to left perturbations
        (translation, rotation) of source and target pose (1,E,2,6) and to the inverse depth (1,E,2,1); they are 0
        where |Z| <= 0.2.

    Raises:
        devo.errors.InputError: the batch of the poses is not (1,N).
    """
    pairs = frame_pairs(ii, jj)
    of_pairs, G = _edge_matrices(poses, pairs)
    if tonly:
        rotation = torch.eye(3, dtype=G.dtype, device=G.device)
        of_pairs, G = (torch.cat((rotation.expand(len(m), 3, 3), m[:, :, 3:]), 2) for m in (of_pairs, G))
    X0 = iproj(patches.index_select(1, kk), intrinsics.index_select(1, ii))
    target_camera = intrinsics.index_select(1, jj)
    X1 = _moved(G, X0)
    x1 = proj(X1, target_camera, depth)
    if not (valid or jacobian):
        return x1
    middle = X1.shape[2] // 2
    centre = X1[:, :, middle, middle]
    in_front = (centre[..., 2] > MIN_VALID_DEPTH).to(x1.dtype)
    if not jacobian:
        return x1, in_front
    return x1, in_front, _jacobians(centre, target_camera, G, adjoint_matrices(of_pairs)[pairs.of_edge])


def _jacobians(centre: Tensor, intrinsics: Tensor, G: Tensor, adjoint: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of the pixel of points (1,E,4), see `transform`; `G` (E,3,4) and its adjoint (E,6,6)."""
    X, Y, Z, W = centre.unbind(-1)
    far = Z.abs() > MIN_VALID_DEPTH
    inverse_z = torch.where(far, torch.where(far, Z, 1.0).reciprocal(), 0.0)
    fx, fy = intrinsics[..., 0] * inverse_z, intrinsics[..., 1] * inverse_z
    a, b, zero = X * inverse_z, Y * inverse_z, torch.zeros_like(X)
    of_point = torch.stack((fx, zero, -fx * a, zero, fy, -fy * b), -1).unflatten(-1, (2, 3))
    # A left perturbation moves the point by W * translation + rotation x XYZ.
    moments = torch.linalg.cross(centre[..., None, :3].expand_as(of_point), of_point, dim=-1)
    Jj = torch.cat((of_point * W[..., None, None], moments), -1)
    return -precise_matmul(Jj, adjoint), Jj, precise_matmul(of_point, G[None, :, :, 3:])


def point_cloud(poses: SE3 | Tensor, patches: Tensor, intrinsics: Tensor, ix: Tensor) -> Tensor:
    """Move patches into the world frame.

    Args:
        poses: `SE3` with batch (1,N), or tensor (1,N,7), world->camera.
        patches: (1,K,3,P,P).
        intrinsics: (1,N,4).
        ix: (K,) int64, source frame of each patch.

    Returns:
        (1,K,P,P,4) homogeneous world points; the Euclidean point is XYZ / W in trajectory units, at infinity for W = 0.
    """
    world_T_cam = SE3(_pose_rows(poses)[None]).inv()
    return world_T_cam[:, ix][:, :, None, None] * iproj(patches, intrinsics.index_select(1, ix))


def flow_mag(
    poses: SE3 | Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor, beta: float = 0.3
) -> Tensor:
    """Length of the image motion of patches between two frames, part of it without the rotation.

    Args:
        poses: `SE3` with batch (1,N), or tensor (1,N,7), world->camera.
        patches: (1,K,3,P,P).
        intrinsics: (1,N,4).
        ii: (E,) int64 source frames.
        jj: (E,) int64 target frames.
        kk: (E,) int64 patches.
        beta: share of the full motion; the rest is the motion by translation only.

    Returns:
        (1,E,P,P) beta |full flow| + (1 - beta) |translational flow| in pixels.
    """
    start = patches.index_select(1, kk)
    X0 = iproj(start, intrinsics.index_select(1, ii))
    at_rest = proj(X0, intrinsics.index_select(1, ii))
    target_camera = intrinsics.index_select(1, jj)
    _, G = _edge_matrices(poses, frame_pairs(ii, jj))
    full = proj(_moved(G, X0), target_camera)
    W = X0[..., 3:]
    shifted = torch.cat((X0[..., :3] + G[None, :, None, None, :, 3] * W, W), dim=-1)
    flows = torch.stack((full, proj(shifted, target_camera))) - at_rest
    lengths = torch.linalg.vector_norm(flows, dim=-1)
    return beta * lengths[0] + (1 - beta) * lengths[1]


@torch.no_grad()
def reproject_edges(
    poses: SE3 | Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor
) -> Tensor:
    """Fast `transform` without gradients and with pixels as planes, for every update of the tracker.

    Source camera, relative pose and focal length of the target camera are folded into one 3x4 matrix for each distinct
    frame pair (in float64), so that an edge costs one matrix gather and a few passes.

    Args:
        poses: (1,N,7) tensor, or `SE3` with batch (1,N), world->camera.
        patches: (1,K,3,P,P), channels x, y in pixels and inverse depth.
        intrinsics: (1,N,4) `fx fy cx cy` of every frame.
        ii: (E,) int64 source frames.
        jj: (E,) int64 target frames.
        kk: (E,) int64 patches.

    Returns:
        (1,E,2,P,P) pixels (x, y), contiguous, dtype of `patches`; `transform(...)` permuted to (0,1,4,2,3).
    """
    pairs = frame_pairs(ii, jj)
    rows = _pose_rows(poses)
    G = relative_poses(rows, pairs.source, pairs.target)
    cameras = intrinsics[0].double()
    source, target = cameras[pairs.source][:, None], cameras[pairs.target]
    axes = G[:, :, :2] / source[..., :2]
    offset = G[:, :, 2:3] - (axes * source[..., 2:]).sum(-1, keepdim=True)
    folded = torch.cat((axes, offset, G[:, :, 3:]), 2)  # (Q,3,4), acts on (x, y, 1, d)
    folded[:, :2] *= target[:, :2, None]
    table = torch.cat((folded.flatten(1), target[:, 2:]), 1).to(patches.dtype)
    m = table.index_select(0, pairs.of_edge)[..., None].unbind(1)
    side = patches.shape[-1]
    x, y, d = patches[0].flatten(2).index_select(0, kk).unbind(1)
    X, Y, Z = (torch.addcmul(m[r + 2], m[r], x).addcmul_(m[r + 1], y).addcmul_(m[r + 3], d) for r in range(0, 12, 4))
    inverse_z = Z.clamp_(min=MIN_PROJECTION_DEPTH).reciprocal_()
    planes = torch.stack((torch.addcmul(m[12], X, inverse_z), torch.addcmul(m[13], Y, inverse_z)), 1)
    return planes.view(1, -1, 2, side, side)
