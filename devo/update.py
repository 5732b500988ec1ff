"""Update operator: revises the hidden state of every edge and predicts its flow revision and confidence."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devo.blocks import LAYER_NORM_EPS, GatedResidual, GradientClip, SoftAgg
from devo.edges import EdgeGroups
from devo.update_inference import update_in_chunks

CORRELATION_WINDOW = 7
CORRELATION_LEVELS = 2


def correlation_size(patch_size: int) -> int:
    """Number of correlation features per edge: 2 levels x 7x7 shifts x P*P patch pixels."""
    return CORRELATION_LEVELS * CORRELATION_WINDOW**2 * patch_size**2


def _masked_rows(x: Tensor, edge: Tensor) -> Tensor:
    """Rows `x[edge]`, zero where `edge` is -1; `x` is (E, C)."""
    rows = x.index_select(0, edge.clamp(min=0))
    return rows * (edge >= 0)[:, None].to(rows.dtype)


class Update(nn.Module):
    """Recurrent update operator over the edges of a patch graph.

    Without gradients it runs in chunks of edges, so that its temporaries stay in the cache and memory does not grow
    beyond the result. Under `torch.autocast` the linear layers run in the autocast type, the hidden state, the
    softmax pooling and the two output heads in float32.

    Args:
        p: patch side P.
        dim: size of the hidden state and of the context vectors.
    """

    def __init__(self, p: int, dim: int = 384) -> None:
        super().__init__()
        self.dim = dim
        self.c1 = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(inplace=True), nn.Linear(dim, dim))
        self.c2 = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(inplace=True), nn.Linear(dim, dim))
        self.norm = nn.LayerNorm(dim, eps=LAYER_NORM_EPS)
        self.agg_kk = SoftAgg(dim)
        self.agg_ij = SoftAgg(dim)
        self.gru = nn.Sequential(
            nn.LayerNorm(dim, eps=LAYER_NORM_EPS),
            GatedResidual(dim),
            nn.LayerNorm(dim, eps=LAYER_NORM_EPS),
            GatedResidual(dim),
        )
        self.corr = nn.Sequential(
            nn.Linear(correlation_size(p), dim),
            nn.ReLU(inplace=True),
            nn.Linear(dim, dim),
            nn.LayerNorm(dim, eps=LAYER_NORM_EPS),
            nn.ReLU(inplace=True),
            nn.Linear(dim, dim),
        )
        self.d = nn.Sequential(nn.ReLU(), nn.Linear(dim, 2), GradientClip())
        self.w = nn.Sequential(nn.ReLU(), nn.Linear(dim, 2), GradientClip(), nn.Sigmoid())

    def forward(
        self,
        net: Tensor,
        inp: Tensor,
        corr: Tensor,
        flow: None,
        ii: Tensor,
        jj: Tensor,
        kk: Tensor,
        groups: EdgeGroups | None = None,
    ) -> tuple[Tensor, tuple[Tensor, Tensor, None]]:
        """Run one update.

        Args:
            net: (1, E, dim) float32 hidden state.
            inp: (1, E, dim) context vectors, any floating dtype.
            corr: (1, E, 98*P*P) correlation features, any floating dtype.
            flow: ignored, kept for the published signature.
            ii, jj, kk: (E,) int64 source frame, destination frame, patch of each edge.
            groups: result of `EdgeGroups.build(ii, jj, kk)` where the same graph is used several times.

        Returns:
            `net` (1, E, dim) float32, `delta` (1, E, 2) flow revision (x, y) in quarter-resolution pixels, `weight`
            (1, E, 2) in (0, 1), and None.
        """
        if groups is None:
            groups = EdgeGroups.build(ii, jj, kk)
        if torch.is_grad_enabled():
            return self._differentiable(net, inp, corr, groups)
        state, delta, weight = update_in_chunks(self, net[0], inp[0], corr[0], groups)
        return state[None], (delta[None], weight[None], None)

    def _differentiable(
        self, net: Tensor, inp: Tensor, corr: Tensor, groups: EdgeGroups
    ) -> tuple[Tensor, tuple[Tensor, Tensor, None]]:
        previous, following = groups.neighbours
        weights = self.norm.weight.dtype
        if not torch.is_autocast_enabled(net.device.type):
            inp, corr = inp.to(weights), corr.to(weights)
        x = self.norm(net + inp + self.corr(corr))
        x = x + self.c1(_masked_rows(x[0], previous))[None]
        x = x + self.c2(_masked_rows(x[0], following))[None]
        x = x + self.agg_kk(x, groups.patch)
        x = x + self.agg_ij(x, groups.frame_pair)
        x = self.gru(x)
        # bfloat16 has 8 bits: a revision of 10 pixels would be rounded to 0.06
        with torch.autocast(x.device.type, enabled=False):
            return x, (self.d(x), self.w(x), None)
