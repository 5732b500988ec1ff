"""Differentiable bundle adjustment for training: one Gauss-Newton step on poses and inverse depths.

Edges are arranged in blocks of one frame pair, so that a step with its gradient costs a few hundred torch calls
regardless of the number of edges, patches and clips.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from devo.errors import InputError
from devo.graph import PairBlocks, pair_blocks, relative_matrices
from devo.lietorch import SE3
from devo.normal_equations import Layout, Measurements, depth_system, observe, pose_system, solve

MAX_RESIDUAL = 250.0  # pixels
MIN_INV_DEPTH, MAX_INV_DEPTH = 1e-3, 10.0


def _layout(blocks: PairBlocks, kk: Tensor, frames: int, patches: int, fixedp: int, clips: int) -> Layout:
    if clips < 1 or frames % clips or patches % clips:
        raise InputError(f"found {frames} frames and {patches} patches for {clips} clips; expected equal shares")
    n, m = frames // clips, patches // clips
    source, target = blocks.source % n, blocks.target % n
    free = max(int(torch.maximum(source, target).max()) + 1 - fixedp, 0)
    clip = torch.div(blocks.source, n, rounding_mode="floor")
    patch = kk[blocks.edge]
    if clips > 1 and not (
        torch.equal(clip, torch.div(blocks.target, n, rounding_mode="floor"))
        and torch.equal(clip[:, None].expand_as(patch), torch.div(patch, m, rounding_mode="floor"))
    ):
        raise InputError(f"an edge joins two clips; expected ii, jj // {n} and kk // {m} to agree")
    first = clip * (free + 1) - (fixedp - 1)
    row = clip * (free + 1)
    return Layout(
        source_slot=torch.maximum(source + first, row),
        target_slot=torch.maximum(target + first, row),
        patch=patch,
        clips=clips,
        free=free,
        patches=m,
    )


def _measure(
    blocks: PairBlocks, patches: Tensor, intrinsics: Tensor, targets: Tensor, weights: Tensor, kk: Tensor, bounds: Any
) -> tuple[Measurements, Tensor]:
    """Measurements in blocks, and the inverse depths (S,c) of the patch centres."""
    place, size = blocks.edge.flatten(), blocks.edge.shape
    middle = patches.shape[-1] // 2
    centre = patches[0, :, :, middle, middle].index_select(0, kk[place]).t().contiguous().view(3, *size)
    cameras = intrinsics[0].t().unsqueeze(2)
    source, target = cameras.index_select(1, blocks.source), cameras.index_select(1, blocks.target)
    seen = torch.cat((targets[0], weights[0]), 1).to(patches.dtype).index_select(0, place)
    seen = seen.t().contiguous().view(4, *size)
    limits = torch.as_tensor(bounds, dtype=patches.dtype, device=patches.device).view(4, 1, 1)
    ray = (centre[:2] - source[2:]) / source[:2]
    return Measurements(
        ray, seen[:2], seen[2:], blocks.used, target, limits[:2], limits[2:], MAX_RESIDUAL
    ), centre[2]  # fmt: skip


def BA(  # noqa: N802 - the published name
    poses: SE3,
    patches: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    lmbda: Tensor | float,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    bounds: Sequence[float] | Tensor,
    ep: float = 100.0,
    PRINT: bool = False,  # noqa: N803
    fixedp: int = 1,
    structure_only: bool = False,
    *,
    clips: int = 1,
    blocks: PairBlocks | None = None,
) -> tuple[SE3, Tensor]:
    """Take one differentiable Gauss-Newton step that moves patch centres towards their targets.

    It minimises sum w |target - projection|^2 by a Schur complement over the depths (Triggs et al. 2000, section 6.1)
    with S + diag(ep + 1e-4 diag S); poses move by left multiplication with exp(dx). Edges are not valid, and are
    neither used nor differentiated, where the centre has Z <= 0.2, lies outside `bounds` or misses the target by
    250 pixels or more, or where the target is not finite. Where the system of a clip has no Cholesky factor, its poses
    stay, and depths move as if the pose step were 0.

    Args:
        poses: `SE3` with batch (1,N), world->camera; N = clips * n, clip by clip.
        patches: (1,K,3,P,P), channels x, y in pixels and inverse depth; K = clips * m, clip by clip.
        intrinsics: (1,N,4) `fx fy cx cy` in the same pixels.
        targets: (1,E,2) measured position of each patch centre in frame jj, pixels.
        weights: (1,E,2) confidence of x and y.
        lmbda: damping added to the information of every inverse depth.
        ii: (E,) int64 source frames.
        jj: (E,) int64 target frames.
        kk: (E,) int64 patches.
        bounds: (x_min, y_min, x_max, y_max) in pixels.
        ep: damping added to the diagonal of the reduced pose system.
        PRINT: accepted for the published signature; nothing is ever printed.
        fixedp: number of poses at the start of each clip that stay exactly as they are.
        structure_only: move depths only.
        clips: number of independent problems of equal size that are solved at once.
        blocks: `devo.graph.pair_blocks(ii, jj)`, if it is known already from another call with the same edges.

    Returns:
        New poses (1,N) and new patches (1,K,3,P,P) with all inverse depths limited to [1e-3, 10]; with no edges at all,
        the arguments. Gradients flow to poses (left-tangent), patches, intrinsics, targets, weights and `lmbda`.

    Raises:
        devo.errors.InputError: frames or patches cannot be shared equally by the clips, or an edge joins two clips.
    """
    if kk.numel() == 0:
        return poses, patches
    blocks = pair_blocks(ii, jj) if blocks is None else blocks
    layout = _layout(blocks, kk, poses.data.shape[1], patches.shape[1], fixedp, clips)
    with torch.autocast(patches.device.type, enabled=False):
        damping = torch.as_tensor(lmbda, dtype=patches.dtype, device=patches.device).reshape(())
        G = relative_matrices(poses.data[0], blocks.source, blocks.target)
        measurements, centre_depth = _measure(blocks, patches, intrinsics, targets, weights, kk, bounds)
        seen, depth_terms = observe(G, centre_depth, measurements)
        poses_move = layout.free > 0 and not structure_only
        system = pose_system(seen, G, layout) if poses_move else None
        dX, dZ, _ = solve(*depth_system(depth_terms, layout), system, damping, ep)
        inv_depth = (patches[:, :, 2:] + dZ.view(1, -1, 1, 1, 1)).clamp(MIN_INV_DEPTH, MAX_INV_DEPTH)
        patches = torch.cat((patches[:, :, :2], inv_depth), 2)
        if dX is None:
            return poses, patches
        data = poses.data.view(clips, -1, 7)
        first, last = fixedp, fixedp + layout.free
        moved = SE3(data[:, first:last]).retr(dX)
        joined = torch.cat((data[:, :first], moved.data, data[:, last:]), 1)
    return SE3(joined.view(1, -1, 7)), patches
