"""Group elements as parameters of any torch optimiser."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from devo.lietorch.groups import LieGroup


class LieGroupParameter(torch.nn.Parameter):
    """An element batch to be optimised: a zero tangent (batch..., K) as parameter of exp(tangent) X.

    `retr()` gives the elements for the loss; after a step of any optimiser, `fold_()` moves the tangent into X.
    """

    group: LieGroup

    def __new__(cls, group: LieGroup, requires_grad: bool = True) -> LieGroupParameter:
        """Zero tangent of the batch shape of `group`, on its device and in its dtype."""
        parameter: LieGroupParameter = torch.Tensor._make_subclass(
            cls, torch.zeros(group.tangent_shape, dtype=group.dtype, device=group.device), requires_grad
        )
        parameter.group = group.detach()
        return parameter

    def __init__(self, group: LieGroup, requires_grad: bool = True) -> None:
        pass

    def retr(self) -> LieGroup:
        """exp(tangent) X."""
        return self.group.retr(self.as_subclass(Tensor))  # type: ignore[arg-type]

    def fold_(self) -> LieGroupParameter:
        """Write exp(tangent) X into X and zero into the tangent."""
        with torch.no_grad():
            self.group = self.retr()
            self.zero_()
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> LieGroupParameter:
        copied = type(self)(self.group.clone(), self.requires_grad)
        with torch.no_grad():
            copied.copy_(self)
        memo[id(self)] = copied
        return copied
