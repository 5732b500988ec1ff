"""Building blocks of the update operator: gated residual, soft aggregation over edge groups, gradient clipping."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from devo.edges import Segments

GRADIENT_LIMIT = 0.01
LAYER_NORM_EPS = 1e-3


class _GradientClipFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return torch.nan_to_num(gradients[0], nan=0.0, posinf=None, neginf=None).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)


class GradientClip(nn.Module):
    """Identity whose backward pass replaces NaN by 0 and clamps every element to [-0.01, 0.01]."""

    def forward(self, x: Tensor) -> Tensor:
        """Return `x` unchanged (any shape and dtype)."""
        return _GradientClipFunction.apply(x)


class GatedResidual(nn.Module):
    """`x + sigmoid(gate(x)) * res(x)` over the last axis (size `dim`)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gate = nn.Sequential(nn.Linear(dim, dim), nn.Sigmoid())
        self.res = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(inplace=True), nn.Linear(dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        """Map `(..., dim)` to `(..., dim)`."""
        return x + self.gate(x) * self.res(x)


class _SegmentSoftmaxSum(torch.autograd.Function):
    """`y[s] = sum over the rows e of segment s of value[e] * softmax_s(score)[e]`, independently per channel.

    Written as one function because autograd would keep four temporaries of the size of the edge features
    alive; here the backward pass needs the values, the softmax weights and the result only.
    """

    @staticmethod
    def forward(ctx: Any, value: Tensor, score: Tensor, label: Tensor, count: int) -> Tensor:
        index = label[:, None].expand_as(score)
        peak = score.new_full((count, score.shape[1]), -torch.inf).scatter_reduce_(0, index, score, "amax")
        weight = (score - peak[label]).exp_()
        total = torch.zeros_like(peak).scatter_add_(0, index, weight)
        weight = weight.div_(total[label])
        pooled = torch.zeros_like(peak).scatter_add_(0, index, weight * value)
        ctx.save_for_backward(value, weight, pooled, label)
        return pooled

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        value, weight, pooled, label = ctx.saved_tensors
        grad_value = gradients[0][label] * weight
        return grad_value, grad_value * (value - pooled[label]), None, None


def segment_softmax_sum(value: Tensor, score: Tensor, segments: Segments) -> Tensor:
    """Pool rows of each segment with a per-channel softmax of their scores.

    Args:
        value: `(E, C)` floating point.
        score: `(E, C)`, same dtype.
        segments: the segment of each of the E rows.

    Returns:
        `(segments.count, C)`.
    """
    return _SegmentSoftmaxSum.apply(value, score, segments.label, segments.count)


class SoftAgg(nn.Module):
    """Soft aggregation: pool edges of one group by a learned per-channel softmax and hand the result back to each edge.

    `h(sum_e f(x_e) * softmax_group(g(x))_e)`; `h` runs once per group.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.f = nn.Linear(dim, dim)
        self.g = nn.Linear(dim, dim)
        self.h = nn.Linear(dim, dim)

    def forward(self, x: Tensor, segments: Segments) -> Tensor:
        """Map `(1, E, dim)` to `(1, E, dim)`."""
        rows = x[0]
        value, score = self.f(rows), self.g(rows)
        if value.dtype in (torch.bfloat16, torch.float16):
            value, score = value.float(), score.float()
        return self.h(segment_softmax_sum(value, score, segments)).index_select(0, segments.label)[None]
