"""Normal equations of bundle adjustment over inverse depths, for the tracker and, differentiably, for training.

Edges lie in blocks of one frame pair (`devo.graph.PairBlocks`): S blocks of c places. The relative pose G = [R|t] is
one matrix for each block, points and sums are batched matrix products, and the Jacobian of the source pose is left
out: it is -J Ad(G), so it follows from the sums of each block. Derivatives of a pixel are those of Engel et al. 2018
(appendix) for left perturbations (translation, rotation) of the poses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from devo.graph import adjoint_matrices, group_sum

MIN_DEPTH = 0.2  # nearer points are not valid
POSE_DAMPING_RELATIVE = 1e-4


class Measurements(NamedTuple):
    """Patch centres and where they were seen; all finite."""

    ray: Tensor  # (2,S,c) normalised image coordinates in the source camera
    target: Tensor  # (2,S,c) pixels
    weight: Tensor  # (2,S,c)
    usable: Tensor  # (S,c) bool
    camera: Tensor  # (4,S,1) or (4,1,1) fx fy cx cy of the target camera
    lower: Tensor  # (2,S,1) or (2,1,1) projections outside these bounds are not valid
    upper: Tensor
    max_residual: float  # pixels


class Layout(NamedTuple):
    """Where blocks and patches go in the equations of K problems (clips) with N free poses and M patches each."""

    source_slot: Tensor  # (S,) row clip * (N + 1) + slot; slot 0 collects fixed poses, slot 1 is the first free pose
    target_slot: Tensor  # (S,)
    patch: Tensor  # (S,c) clip * M + patch
    clips: int
    free: int
    patches: int

    def first(self, blocks: int) -> Layout:
        """The first blocks only, as views."""
        slots = self.source_slot[:blocks], self.target_slot[:blocks]
        return Layout(*slots, self.patch[:blocks], self.clips, self.free, self.patches)


class Observed(NamedTuple):
    """Patch centres in the target camera; weight and residual are 0 where not valid."""

    valid: Tensor  # (S,c) bool
    residual: Tensor  # (2,S,c) target - pixel
    weight: Tensor  # (2,S,c)
    inv_depth: Tensor  # (S,c)
    slope: Tensor  # (2,S,c) X/Z, Y/Z
    scale: Tensor  # (2,S,c) focal length / Z
    focal: Tensor  # (2,S or 1,1)
    weighted_jz: Tensor  # (2,S,c) weight times derivative of the pixel with respect to the inverse depth

    def first(self, blocks: int) -> Observed:
        """The first blocks only, as views."""
        return Observed(*(rows[:blocks] if rows.dim() == 2 else rows[:, :blocks] for rows in self))


def observe(G: Tensor, inv_depth: Tensor, m: Measurements) -> tuple[Observed, Tensor]:
    """Project patch centres and take the depth part of the equations.

    Args:
        G: (S,3,4) finite relative poses `[R|t]` of the blocks.
        inv_depth: (S,c).
        m: measurements.

    Returns:
        The projection, and (2,S,c) the terms w J_z^2 and w J_z r of each edge.
    """
    start = torch.stack((*m.ray, torch.ones_like(inv_depth), inv_depth), 1)
    point = torch.bmm(G, start)  # (S,3,c)
    z = point[:, 2]
    in_front = z > MIN_DEPTH
    inverse_z = torch.where(in_front, z, 1.0).reciprocal()
    focal = m.camera[:2]
    slope = torch.stack((point[:, 0] * inverse_z, point[:, 1] * inverse_z))
    pixel = torch.addcmul(m.camera[2:], focal, slope)
    residual = m.target - pixel
    near = (residual.square().sum(0) < m.max_residual**2) & in_front & m.usable
    valid = near & ((pixel > m.lower) & (pixel < m.upper)).all(0)
    residual = torch.where(valid, residual, 0.0)
    weight = torch.where(valid, m.weight, 0.0)

    scale = focal * inverse_z
    translation = G[:, :, 3].t().unsqueeze(2)
    jz = scale * (translation[:2] - translation[2] * slope)
    weighted_jz = weight * jz
    depth_terms = (weighted_jz * torch.stack((jz, residual))).sum(1)
    return Observed(valid, residual, weight, inv_depth, slope, scale, focal, weighted_jz), depth_terms


def _target_jacobian(o: Observed) -> Tensor:
    """Derivatives of x and y with respect to the target pose, followed by the residuals (2,7,S,c).

    The rows are (s d, 0, -s d a, -f ab, f (1 + a^2), -f b) for x and (0, s d, -s d b, -f (1 + b^2), f ab, f a) for y,
    with a = X/Z, b = Y/Z, s = f/Z.
    """
    near_x, near_y = along = o.scale * o.inv_depth
    forward_x, forward_y = (along * o.slope).neg()
    moved = o.focal * o.slope
    square_x, square_y = torch.addcmul(o.focal, moved, o.slope)
    other = o.slope.flip(0)
    product_x, product_y = moved * other
    roll_x, roll_y = o.focal * other
    zero = torch.zeros_like(near_x)
    rows = (
        near_x, zero, forward_x, product_x.neg(), square_x, roll_x.neg(), o.residual[0],
        zero, near_y, forward_y, square_y.neg(), product_y, roll_y, o.residual[1],
    )  # fmt: skip
    return torch.stack(rows).unflatten(0, (2, 7))


def pose_system(o: Observed, G: Tensor, layout: Layout) -> tuple[Tensor, Tensor, Tensor]:
    """Pose part of the equations: B (K,6N,6N), E (K,6N,M) and v (K,6N,1)."""
    clips, free, patches = layout.clips, layout.free, layout.patches
    width = free + 1
    J = _target_jacobian(o)
    adjoint = adjoint_matrices(G)
    weighted = o.weight.unsqueeze(1) * J[:, :6]
    # Blocks first, as views: sums over the places of a block are matrix products.
    first, second = J.permute(0, 2, 3, 1)
    weighted_first, weighted_second = weighted.transpose(1, 2)
    sums = torch.baddbmm(torch.bmm(weighted_first, first), weighted_second, second)  # (S,6,7) J^T w J, J^T w r
    of_source = torch.bmm(adjoint.mT, sums).neg()
    H, upper = sums[:, :, :6], of_source[:, :, :6]  # (target, target) and (source, target)
    blocks = torch.cat((H, -upper @ adjoint, upper, upper.mT)).flatten(1)
    i, j = layout.source_slot, layout.target_slot
    column_i, column_j = i % width, j % width
    place = torch.cat((j * width + column_j, i * width + column_i, i * width + column_j, j * width + column_i))
    B = sums.new_zeros(clips * width * width, 36).index_add(0, place, blocks).view(clips, width, width, 6, 6)
    B = B[:, 1:, 1:].transpose(2, 3).reshape(clips, 6 * free, 6 * free)
    gradients = torch.cat((sums[:, :, 6], of_source[:, :, 6]))
    v = sums.new_zeros(clips * width, 6).index_add(0, torch.cat((j, i)), gradients).view(clips, width, 6)

    of_target = (o.weighted_jz.unsqueeze(1) * J[:, :6]).sum(0).transpose(0, 1)  # (S,6,c)
    coupling = torch.stack((torch.bmm(adjoint.mT, of_target).neg(), of_target))
    rows = torch.stack((i, j))[:, :, None, None] * 6 + torch.arange(6, device=i.device)[:, None]  # (2,S,6,1)
    place = rows * patches + (layout.patch % patches)[:, None]
    E = sums.new_zeros(clips * width * 6 * patches).scatter_add(0, place.flatten(), coupling.flatten())
    E = E.view(clips, width, 6, patches)[:, 1:].reshape(clips, 6 * free, patches)
    return B, E, v[:, 1:].reshape(clips, 6 * free, 1)


def depth_system(depth_terms: Tensor, layout: Layout) -> tuple[Tensor, Tensor]:
    """Depth part of the equations, summed over the edges of each patch: C and u (K,M)."""
    sums = group_sum(depth_terms.flatten(1), layout.patch.flatten(), layout.clips * layout.patches)
    C, u = sums.view(2, layout.clips, layout.patches).unbind()
    return C, u


class _CholeskySolve(Function):
    """Solve A x = b for symmetric A (K,D,D), b (K,D,1); x = 0 and no gradient where that fails; and (K,) success."""

    @staticmethod
    def forward(ctx: Any, A: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        factor, info = torch.linalg.cholesky_ex(A)
        x = torch.cholesky_solve(b, factor)
        solved = (info == 0) & torch.isfinite(x).all(1).all(1)
        x = torch.where(solved[:, None, None], x, 0.0)
        ctx.save_for_backward(factor, solved, x)
        ctx.mark_non_differentiable(solved)
        return x, solved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Any) -> tuple[Tensor, Tensor]:
        factor, solved, x = ctx.saved_tensors
        dz = torch.where(solved[:, None, None], torch.cholesky_solve(grad, factor), 0.0)
        return -x @ dz.mT, dz


def solve(
    C: Tensor, u: Tensor, poses: tuple[Tensor, Tensor, Tensor] | None, lmbda: Tensor, ep: float
) -> tuple[Tensor | None, Tensor, Tensor]:
    """Eliminate the depths and solve for both steps; the poses are damped by ep + 1e-4 of their diagonal.

    Args:
        C: (K,M) information of the inverse depths.
        u: (K,M).
        poses: B, E and v of `pose_system`, or `None` if no pose moves.
        lmbda: 0-dim, damping added to C. Without any, a depth that nobody sees stays.
        ep: damping added to the diagonal of the reduced system.

    Returns:
        Pose steps (K,N,6) or `None`, depth steps (K,M), and (K,) bool, False where the reduced system has no Cholesky
        factor: there the pose step is 0.
    """
    information = C + lmbda
    informed = information > 0
    Q = torch.where(informed, torch.where(informed, information, 1.0).reciprocal(), 0.0)
    if poses is None:
        return None, Q * u, torch.ones_like(u[:, 0], dtype=torch.bool)
    B, E, v = poses
    EQ = E * Q[:, None]
    S = B - EQ @ E.mT
    A = S + torch.diag_embed(POSE_DAMPING_RELATIVE * S.diagonal(dim1=1, dim2=2) + ep)
    dX, solved = _CholeskySolve.apply(A, v - EQ @ u.unsqueeze(2))
    return dX.unflatten(1, (-1, 6)).squeeze(3), Q * (u - (E.mT @ dX).squeeze(2)), solved
