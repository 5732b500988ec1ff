"""Index structures over the edges (ii, jj, kk) of a patch graph, computed once per distinct graph."""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from devo.errors import InputError


@dataclass(frozen=True)
class Segments:
    """A partition of E edges into `count` groups.

    Attributes:
        label: (E,) int64, group of each edge, 0..count-1 in ascending order of the original label.
        count: number of groups.
        order: (E,) int64, edges sorted by group.
        start: (count+1,) int64, group g owns `order[start[g]:start[g+1]]`.
    """

    label: Tensor
    count: int
    order: Tensor
    start: Tensor

    @classmethod
    def from_order(cls, order: Tensor, sorted_labels: Tensor) -> Segments:
        """Build from a permutation (E,) and the ascending int64 labels (E,) it leads to."""
        edges = len(order)
        first = torch.ones(edges, dtype=torch.bool, device=order.device)
        torch.ne(sorted_labels[1:], sorted_labels[:-1], out=first[1:])
        starts = first.nonzero()[:, 0]
        label = torch.empty_like(order)
        label[order] = first.cumsum(0) - 1
        return cls(label, len(starts), order, torch.cat([starts, starts.new_tensor([edges])]))

    def chunks(self, rows: int) -> list[tuple[int, int, int, int]]:
        """Cut the sorted edges into pieces of whole groups and at most `rows` edges.

        Returns:
            `(first edge, last edge + 1, first group, last group + 1)` of each piece; a group larger than `rows` is
            a piece of its own.
        """
        ends = self.start.tolist()
        pieces, group = [], 0
        while group < self.count:
            after = max(group + 1, bisect.bisect_right(ends, ends[group] + rows) - 1)
            pieces.append((ends[group], ends[after], group, after))
            group = after
        return pieces


@dataclass(frozen=True)
class EdgeGroups:
    """What the update operator needs to know about a graph; build it with `EdgeGroups.build`.

    Attributes:
        jj, kk: (E,) int64 destination frame and patch of each edge.
        patch: edges grouped by patch; inside a group ordered by destination frame, ties by position.
        frame_pair: edges grouped by (source frame, destination frame).
    """

    jj: Tensor
    kk: Tensor
    patch: Segments
    frame_pair: Segments

    @classmethod
    def build(cls, ii: Tensor, jj: Tensor, kk: Tensor) -> EdgeGroups:
        """Group the edges given by three (E,) int64 tensors on one device.

        Raises:
            InputError: the three differ in length.
        """
        if not (ii.shape == jj.shape == kk.shape) or ii.dim() != 1:
            found = f"{tuple(ii.shape)}, {tuple(jj.shape)}, {tuple(kk.shape)}"
            raise InputError(f"edge indices ii, jj, kk have shapes {found}; expected three equal 1-D tensors")
        # the published label ii*12345+jj is unique only below 12345 frames; a span of the data is so for any length
        span = int(jj.max()) + 1 if len(jj) else 1
        by_patch, patch_order = torch.sort(kk * span + jj, stable=True)
        by_pair, pair_order = torch.sort(ii * span + jj, stable=True)
        patch = Segments.from_order(patch_order, torch.div(by_patch, span, rounding_mode="floor"))
        return cls(jj, kk, patch, Segments.from_order(pair_order, by_pair))

    @cached_property
    def neighbours(self) -> tuple[Tensor, Tensor]:
        """(E,) int64 each: the edge of the same patch towards the previous / next destination frame, -1 if none."""
        from devo.fastba import neighbors  # late: fastba needs the geometry packages, the networks do not

        return neighbors(self.kk, self.jj)
