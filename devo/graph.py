"""Small tools for graphs of edges: compact labels, sums over groups of edges, relative poses of frame pairs."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

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


def group_sum(columns: Tensor, group: Tensor, groups: int) -> Tensor:
    """Sum columns that belong to the same group, in a fixed order on the CPU.

    Args:
        columns: (C,E) values, one column for each edge.
        group: (E,) int64 in [0, groups).
        groups: number of groups G.

    Returns:
        (C,G), zero for empty groups.
    """
    sums = columns.new_zeros(columns.shape[0], groups)
    return sums.scatter_add_(1, group.expand(columns.shape[0], -1), columns)
