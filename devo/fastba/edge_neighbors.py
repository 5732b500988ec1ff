"""Neighbouring edges of a patch track, in torch."""

from __future__ import annotations

import torch
from torch import Tensor


def neighbors_torch(kk: Tensor, jj: Tensor) -> tuple[Tensor, Tensor]:
    """Torch twin of `devo.fastba.neighbors`: two stable sorts and one comparison, on the device of `kk`."""
    by_frame = torch.argsort(jj, stable=True)
    order = by_frame[torch.argsort(kk[by_frame], stable=True)]
    patch = kk[order]
    # Two edges that follow each other in (patch, frame, position) order are neighbours if they share the patch.
    before, after = order[:-1], order[1:]
    linked = patch[:-1] == patch[1:]
    previous = torch.full_like(kk, -1)
    following = torch.full_like(kk, -1)
    previous[after] = torch.where(linked, before, -1)
    following[before] = torch.where(linked, after, -1)
    return previous, following
