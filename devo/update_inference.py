"""The update operator without gradients: chunks of edges whose temporaries stay in the cache.

Three passes over the edges, which keep nothing between them but the hidden state, in the tensor that becomes the
result: as given (correlation MLP); sorted by patch, in pieces of whole patches (exchange with the temporal neighbours,
which are the neighbouring rows in that order, and pooling per patch); sorted by frame pair (pooling per pair, gated
residuals and output heads).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional

from devo.blocks import LAYER_NORM_EPS, GatedResidual, SoftAgg
from devo.edges import EdgeGroups, Segments

if TYPE_CHECKING:
    from devo.update import Update

# measured: 1024 to 4096 rows are equally fast, fewer pay for the calls, more for cache misses
CHUNK_ROWS = 2048
CUDA_CHUNK_ROWS = 65536
# Matrix products on the CPU are compiled for each new number of rows, which costs ten times the product itself, and
# a tracker's graph has other sizes in every frame. So rows and groups are padded to multiples of these.
ROW_STEP = 128
GROUP_STEP = 64


class _Piece:
    """Rows of one chunk: edges sorted by group, with group numbers counted from 0 inside the chunk.

    Attributes:
        size: number of edges; padding follows them.
        edges: edge of each row.
        rows: the same, with 0 for padding.
        label: group of each row; padding has a group of its own.
        count: number of groups with padding.
        heads, tails: first and last row of each group.
    """

    def __init__(self, segments: Segments, bounds: tuple[int, int, int, int]) -> None:
        first, last, first_group, last_group = bounds
        self.size = last - first
        padding = (0, -self.size % ROW_STEP)
        self.edges = segments.order[first:last]
        self.rows = functional.pad(self.edges, padding)
        label = segments.label.index_select(0, self.edges) - first_group
        self.label = functional.pad(label, padding, value=last_group - first_group)
        self.count = -(-(last_group - first_group + 1) // GROUP_STEP) * GROUP_STEP
        starts = segments.start[first_group : last_group + 1] - first
        self.heads, self.tails = starts[:-1], starts[1:] - 1


def _pieces(segments: Segments, rows: int) -> Iterator[_Piece]:
    for bounds in segments.chunks(rows):
        yield _Piece(segments, bounds)


def _slices(edges: int, rows: int) -> Iterator[slice]:
    """Consecutive slices of `rows` edges; the last one reaches back into its predecessor to a multiple of ROW_STEP."""
    for first in range(0, edges, rows):
        last = min(first + rows, edges)
        yield slice(max(0, first - (first - last) % ROW_STEP), last)


class _Layers:
    """Weights of the update operator, cast once per call to the type of the matrix products."""

    def __init__(self, update: Update, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self._cast: dict[nn.Module, tuple[Tensor, Tensor]] = {
            module: (module.weight.to(dtype), module.bias.to(dtype))
            for module in update.modules()
            if isinstance(module, nn.Linear | nn.LayerNorm)
        }

    def linear(self, x: Tensor, module: nn.Module) -> Tensor:
        """`x @ weight.T + bias` of a linear layer, `x` already in the right type."""
        weight, bias = self._cast[module]
        return functional.linear(x, weight, bias)

    def mlp(self, x: Tensor, chain: nn.Sequential) -> Tensor:
        """Linear, ReLU, linear."""
        return self.linear(self.linear(x, chain[0]).relu_(), chain[2])

    def correlation(self, x: Tensor, chain: nn.Sequential) -> Tensor:
        """The correlation MLP, all of it in the type of the matrix products."""
        x = self.mlp(x.to(self.dtype), chain)
        weight, bias = self._cast[chain[3]]
        return self.linear(functional.layer_norm(x, (x.shape[-1],), weight, bias, LAYER_NORM_EPS).relu_(), chain[5])

    def soft_aggregation_(self, x: Tensor, module: SoftAgg, piece: _Piece) -> Tensor:
        """Add the pooled and redistributed features of each group to `x` (R, dim) float32, in place."""
        lowered = x.to(self.dtype)
        score = self.linear(lowered, module.g).to(x.dtype)
        index = piece.label[:, None].expand_as(score)
        peak = x.new_full((piece.count, x.shape[1]), -torch.inf).scatter_reduce_(0, index, score, "amax")
        weight = score.sub_(peak.index_select(0, piece.label)).exp_()
        total = torch.zeros_like(peak).scatter_add_(0, index, weight)
        pooled = torch.zeros_like(peak).scatter_add_(0, index, weight.mul_(self.linear(lowered, module.f)))
        total.clamp_(min=1.0)  # the peak of a group contributes 1, so only groups of padding are below
        handed_back = self.linear(pooled.div_(total).to(self.dtype), module.h).to(x.dtype)
        return x.add_(handed_back.index_select(0, piece.label))

    def gated_residual_(self, x: Tensor, module: nn.Module) -> Tensor:
        """`x + sigmoid(gate(x)) * res(x)` of a `GatedResidual`, in place."""
        assert isinstance(module, GatedResidual)
        lowered = x.to(self.dtype)
        gate = self.linear(lowered, module.gate[0]).sigmoid_()
        return x.add_(gate.mul_(self.mlp(lowered, module.res)))


def _heads(update: Update) -> tuple[Tensor, Tensor]:
    """The linear layers of `d` and `w` as one: weight (4, dim), bias (4,)."""
    revision, confidence = update.d.get_submodule("1"), update.w.get_submodule("1")
    names = ("weight", "bias")
    weight, bias = (torch.cat([revision.get_parameter(name), confidence.get_parameter(name)]) for name in names)
    return weight, bias


def _exchange_(x: Tensor, update: Update, layers: _Layers, piece: _Piece) -> Tensor:
    """Hand each edge its predecessor through `c1`, then its successor through `c2`; a missing one counts as zero."""
    shifted = torch.empty(x.shape, dtype=layers.dtype, device=x.device)
    shifted[1:] = x[:-1]
    x.add_(layers.mlp(shifted.index_fill_(0, piece.heads, 0), update.c1))
    shifted[:-1] = x[1:]
    return x.add_(layers.mlp(shifted.index_fill_(0, piece.tails, 0), update.c2))


def matmul_dtype(reference: Tensor) -> torch.dtype:
    """The autocast type of the device of `reference` while autocast is on, else its own type."""
    device = reference.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else reference.dtype


@torch.no_grad()
def update_in_chunks(
    update: Update, net: Tensor, inp: Tensor, corr: Tensor, groups: EdgeGroups, chunk_rows: int | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Run the update operator without gradients.

    Args:
        update: the operator.
        net: (E, dim) hidden state.
        inp: (E, dim) context, any floating dtype.
        corr: (E, 98*P*P) correlation features, any floating dtype.
        groups: structure of the graph.
        chunk_rows: edges per chunk, chosen by device if omitted; the result depends on it by rounding only.

    Returns:
        New hidden state (E, dim), revision (E, 2) and confidence (E, 2), all in the dtype of the weights (float32).
    """
    dtype = matmul_dtype(update.norm.weight)
    if chunk_rows is None:
        chunk_rows = CUDA_CHUNK_ROWS if net.is_cuda else CHUNK_ROWS
    full = update.norm.weight.dtype
    with torch.autocast(net.device.type, enabled=False):
        layers = _Layers(update, dtype)
        state = torch.empty(net.shape, dtype=full, device=net.device)
        for rows in _slices(len(net), chunk_rows):
            x = net[rows] + inp[rows]
            state[rows] = update.norm(x.to(full).add_(layers.correlation(corr[rows], update.corr)))
        for piece in _pieces(groups.patch, chunk_rows):
            x = _exchange_(state.index_select(0, piece.rows), update, layers, piece)
            state.index_copy_(0, piece.edges, layers.soft_aggregation_(x, update.agg_kk, piece)[: piece.size])
        heads_weight, heads_bias = _heads(update)
        heads = torch.empty(len(net), 4, dtype=full, device=net.device)
        for piece in _pieces(groups.frame_pair, chunk_rows):
            x = layers.soft_aggregation_(state.index_select(0, piece.rows), update.agg_ij, piece)
            x = layers.gated_residual_(update.gru[0](x), update.gru[1])
            x = layers.gated_residual_(update.gru[2](x), update.gru[3])
            x = x[: piece.size]
            state.index_copy_(0, piece.edges, x)
            heads.index_copy_(0, piece.edges, functional.linear(x.relu_(), heads_weight, heads_bias))
    return state, heads[:, :2].contiguous(), heads[:, 2:].sigmoid()
