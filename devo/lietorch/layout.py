"""How the numbers of the four groups are arranged, so that one set of formulas serves all of them.

| group | element | tangent |
|---|---|---|
| SO3 | q | phi |
| RxSO3 | q, s | phi, sigma |
| SE3 | t, q | tau, phi |
| Sim3 | t, q, s | tau, phi, sigma |

t, tau, phi are 3-vectors, q = (x, y, z, w), s = exp(sigma) > 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Layout:
    """Which parts a group has, and where they lie in element vectors (N numbers) and tangent vectors (K numbers)."""

    name: str
    has_translation: bool
    has_scale: bool

    def __post_init__(self) -> None:
        start = 3 if self.has_translation else 0
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "element_dim", start + 4 + int(self.has_scale))
        object.__setattr__(self, "tangent_dim", start + 3 + int(self.has_scale))

    # Set above; declared without values so that they are no constructor arguments.
    start = 0
    element_dim = 4
    tangent_dim = 3

    def translation(self, data: Tensor) -> Tensor:
        """Translation t (..., 3) of elements (..., N); only for groups that have one."""
        return data[..., :3]

    def quaternion(self, data: Tensor) -> Tensor:
        """Quaternion (..., 4) xyzw of elements (..., N)."""
        return data[..., self.start : self.start + 4] if self.element_dim > 4 else data

    def scale(self, data: Tensor) -> Tensor:
        """Scale s (..., 1) of elements (..., N); only for groups that have one."""
        return data[..., -1:]

    def phi(self, tangent: Tensor) -> Tensor:
        """Rotation part (..., 3) of tangents (..., K), in radians; K-long, not the N-long element gradients."""
        return tangent[..., self.start : self.start + 3] if self.tangent_dim > 3 else tangent

    def tangent_gradient(self, grad: Tensor) -> Tensor:
        """The K numbers of an N-long gradient tensor that carry the left-tangent gradient."""
        return grad[..., : self.tangent_dim]

    def element_gradient(self, grad: Tensor) -> Tensor:
        """A left-tangent gradient (..., K) as the N-long gradient tensor that autograd wants, filled up with zeros."""
        return torch.constant_pad_nd(grad, (0, self.element_dim - self.tangent_dim))


SO3_LAYOUT = Layout("SO3", has_translation=False, has_scale=False)
RXSO3_LAYOUT = Layout("RxSO3", has_translation=False, has_scale=True)
SE3_LAYOUT = Layout("SE3", has_translation=True, has_scale=False)
SIM3_LAYOUT = Layout("Sim3", has_translation=True, has_scale=True)


def join(parts: list[Tensor]) -> Tensor:
    """Concatenate the parts of elements or tangents along the last dimension."""
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product over the last dimension, which is kept with size 1."""
    return (a * b).sum(-1, keepdim=True)
