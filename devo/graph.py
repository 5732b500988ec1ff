"""Small tools for graphs of edges: compact labels, sums over groups of edges, relative poses of frame pairs."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from devo.lietorch.quaternion import quat_to_matrix

# A table over the whole range of labels is cheaper than sorting them as long as it is not much longer than the list.
_TABLE_PER_LABEL = 8
_SMALL_TABLE = 1 << 16


class Pairs(NamedTuple):
    """The distinct (source, target) frame pairs of an edge list.

    `source`, `target` (Q,) int64 in ascending order of (source, target); `of_edge` (E,) int64, pair of each edge.
    """

    source: Tensor
    target: Tensor
    of_edge: Tensor


def unique_with_inverse(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Sorted distinct labels and the position of every label among them, like `torch.unique(return_inverse=True)`.

    Args:
        labels: (E,) int64, any values; E may be 0.

    Returns:
        `(unique (U,), inverse (E,))` int64 with `unique[inverse] == labels`.
    """
    if labels.numel() == 0:
        return labels, labels
    low, high = (int(bound) for bound in torch.aminmax(labels))
    length = high - low + 1
    if length > max(_TABLE_PER_LABEL * labels.numel(), _SMALL_TABLE):
        unique, inverse = torch.unique(labels, return_inverse=True)
        return unique, inverse
    offset = labels - low
    present = torch.zeros(length, dtype=torch.int64, device=labels.device)
    present[offset] = 1
    position = torch.cumsum(present, 0) - 1
    return present.nonzero().squeeze(1) + low, position[offset]


def frame_pairs(ii: Tensor, jj: Tensor) -> Pairs:
    """Group edges by their frame pair: all edges of a pair share one relative pose.

    Args:
        ii: (E,) int64, source frame of each edge, not negative.
        jj: (E,) int64, target frame of each edge, not negative.
    """
    if ii.numel() == 0:
        return Pairs(ii, jj, ii)
    span = int(jj.max()) + 1
    key, of_edge = unique_with_inverse(ii * span + jj)
    source = torch.div(key, span, rounding_mode="floor")
    return Pairs(source, key - source * span, of_edge)


class PairBlocks(NamedTuple):
    """Edges sorted into S blocks of c places, each block of one frame pair.

    `source`, `target` (S,) int64 frames of the blocks; `edge` (S,c) int64, edge at each place; `used` (S,c) bool, False
    where a place is empty (its `edge` is then some other edge).
    """

    source: Tensor
    target: Tensor
    edge: Tensor
    used: Tensor


def pair_blocks(ii: Tensor, jj: Tensor) -> PairBlocks:
    """Arrange edges by frame pair, so that what is common to a pair becomes one matrix product.

    All pairs of an odometry graph have about as many edges, so a block holds a whole pair. Where the numbers differ
    much, large pairs are split: at most about half of the places are empty.

    Args:
        ii: (E,) int64 source frames, not negative; E > 0.
        jj: (E,) int64 target frames, not negative.
    """
    pairs = frame_pairs(ii, jj)
    edges, count = ii.numel(), torch.bincount(pairs.of_edge)
    largest = int(count.max())
    width = largest if 4 * largest * len(count) <= 5 * edges else -(-edges // len(count))
    blocks = torch.div(count + (width - 1), width, rounding_mode="floor")
    pair = torch.repeat_interleave(blocks)
    rank = torch.arange(len(pair), device=ii.device) - (blocks.cumsum(0) - blocks)[pair]
    end = count.cumsum(0)
    begin = (end - count)[pair] + rank * width
    place = begin[:, None] + torch.arange(width, device=ii.device)
    order = torch.argsort(pairs.of_edge, stable=True)
    used = place < end[pair][:, None]
    return PairBlocks(pairs.source[pair], pairs.target[pair], order[place.clamp_(max=edges - 1)], used)


def relative_poses(poses: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """Matrices `[R|t]` of G = T_target T_source^-1, which move points from the source to the target camera.

    Args:
        poses: (N,7) `tx ty tz qx qy qz qw`, world->camera; quaternions of any non-zero length.
        source: (Q,) int64.
        target: (Q,) int64.

    Returns:
        (Q,3,4) float64; not finite where a pose is not finite or its quaternion is zero.
    """
    first, second = poses[source].double(), poses[target].double()
    rotation = quat_to_matrix(second[:, 3:]) @ quat_to_matrix(first[:, 3:]).mT
    translation = second[:, :3, None] - rotation @ first[:, :3, None]
    return torch.cat((rotation, translation), dim=-1)


def adjoint_matrices(G: Tensor) -> Tensor:
    """Adjoint matrices (Q,6,6) of poses `[R|t]` (Q,3,4) for tangents (translation, rotation), differentiable."""
    rotation, translation = G[:, :, :3], G[:, :, 3:]
    moment = torch.linalg.cross(translation.expand_as(rotation), rotation, dim=1)
    upper = torch.cat((rotation, moment), 2)
    lower = torch.cat((torch.zeros_like(rotation), rotation), 2)
    return torch.cat((upper, lower), 1)


def group_sum(columns: Tensor, group: Tensor, groups: int) -> Tensor:
    """Sum columns that belong to the same group, in a fixed order on the CPU.

    Args:
        columns: (C,E) values, one column for each edge.
        group: (E,) int64 in [0, groups).
        groups: number of groups G.

    Returns:
        (C,G), zero for empty groups; differentiable in `columns`.
    """
    sums = columns.new_zeros(columns.shape[0], groups)
    return sums.scatter_add(1, group.expand(columns.shape[0], -1), columns)


class _RelativeMatrices(Function):
    """`relative_poses` with left-tangent gradients: six numbers in a row of seven, as `devo.lietorch` keeps them."""

    @staticmethod
    def forward(ctx: Any, poses: Tensor, source: Tensor, target: Tensor) -> Tensor:
        G = relative_poses(poses, source, target).to(poses.dtype)
        ctx.save_for_backward(G, source, target)
        ctx.frames = poses.shape[0]
        return G

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        G, source, target = ctx.saved_tensors
        # exp(d) G moves every column c of [R|t] by rotation x c, and t by the translation as well.
        moment = torch.linalg.cross(G, grad, dim=1).sum(2)
        force, translation = grad[:, :, 3], G[:, :, 3]
        of_target = torch.cat((force, moment, torch.zeros_like(force[:, :1])), 1)
        # T_source from the left is G from the right: -Ad(G)^T.
        rotated = G[:, :, :3].mT @ torch.stack((force, moment - torch.linalg.cross(translation, force)), 2)
        of_source = of_target.new_zeros(of_target.shape)
        of_source[:, :6] = -rotated.mT.flatten(1)
        sums = G.new_zeros(ctx.frames, 7)
        return sums.index_add_(0, target, of_target).index_add_(0, source, of_source), None, None


def relative_matrices(poses: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """Differentiable `relative_poses` of SE3 data.

    Args:
        poses: (N,7) data of an `SE3`; its gradient is the left-tangent one (Sola et al. 2018), as in `devo.lietorch`.
        source: (Q,) int64.
        target: (Q,) int64.

    Returns:
        (Q,3,4) `[R|t]` in the dtype of `poses`, computed in float64.
    """
    return _RelativeMatrices.apply(poses, source, target)
