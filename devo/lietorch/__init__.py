"""Lie groups SO3, RxSO3, SE3 and Sim3 in pure torch, with gradients in the left tangent space."""

from __future__ import annotations

from devo.lietorch.groups import SE3, SO3, LieGroup, RxSO3, Sim3, cat, stack
from devo.lietorch.parameter import LieGroupParameter

__all__ = ["SE3", "SO3", "LieGroup", "LieGroupParameter", "RxSO3", "Sim3", "cat", "stack"]
