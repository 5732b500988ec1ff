"""The classes SO3, RxSO3, SE3 and Sim3: batches of group elements with the operations as methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar, overload

import torch
from torch import Tensor

from devo.errors import InputError
from devo.lietorch import autograd
from devo.lietorch.jacobians import left_jacobian
from devo.lietorch.layout import RXSO3_LAYOUT, SE3_LAYOUT, SIM3_LAYOUT, SO3_LAYOUT, Layout

Group = TypeVar("Group", bound="LieGroup")
_DTYPES = (torch.float32, torch.float64)


class LieGroup:
    """A batch of elements of a Lie group; `data` holds them as (batch..., N), float32 or float64.

    Operands of one operation have the same number of batch dimensions; sizes of 1 broadcast. Gradients of elements are
    left-tangent gradients, see `devo.lietorch.autograd`. Quaternions are normalised when used, not when stored.

    Made from a tensor (taken as it is), or from another group: missing translation and scale become 0 and 1, and
    only `SO3` may drop them. Raises `InputError` for wrong sizes, dtypes and operands that do not broadcast.
    """

    layout: ClassVar[Layout]
    embedded_dim: ClassVar[int]
    manifold_dim: ClassVar[int]
    data: Tensor

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.embedded_dim, cls.manifold_dim = cls.layout.element_dim, cls.layout.tangent_dim

    def __init__(self, data: Tensor | LieGroup) -> None:
        if isinstance(data, LieGroup):
            data = self._converted(data)
        if data.dim() == 0 or data.shape[-1] != self.embedded_dim or data.dtype not in _DTYPES:
            raise InputError(
                f"found a {data.dtype} tensor of shape {tuple(data.shape)} as data of {self.layout.name}, "
                f"expected float32 or float64 of shape (..., {self.embedded_dim})"
            )
        self.data = data

    def _converted(self, other: LieGroup) -> Tensor:
        source, target = other.layout, self.layout
        if source == target:
            return other.data
        dropped = (source.has_translation and not target.has_translation) or (source.has_scale and not target.has_scale)
        if dropped and target != SO3_LAYOUT:
            raise InputError(f"found {source.name}, parts of which {target.name} cannot hold; SO3(...) takes rotations")
        return autograd.convert(source, target, other.data)

    # --- construction -------------------------------------------------------------------------------------------

    @classmethod
    def _wrap(cls: type[Group], data: Tensor) -> Group:
        """An element batch around data that is known to be right, without the checks."""
        group = cls.__new__(cls)
        group.data = data
        return group

    @classmethod
    def Identity(  # noqa: N802 - the published name
        cls: type[Group], *batch_shape: Any, device: Any = None, dtype: torch.dtype = torch.float32
    ) -> Group:
        """Identity elements of the batch shape, given as numbers or as one sequence."""
        data = torch.zeros(*_shape(batch_shape), cls.embedded_dim, device=device, dtype=dtype)
        data[..., cls.layout.start + 3 :] = 1
        return cls(data)

    @classmethod
    def IdentityLike(cls: type[Group], group: LieGroup) -> Group:  # noqa: N802
        """Identity elements with batch shape, device and dtype of `group`."""
        return cls.Identity(*group.shape, device=group.device, dtype=group.dtype)

    @classmethod
    def InitFromVec(cls: type[Group], vector: Tensor) -> Group:  # noqa: N802
        """Elements from plain vectors (..., N), through which an ordinary gradient flows back to `vector`."""
        group = cls(vector)
        group.data = autograd.from_vec(cls.layout, vector)
        return group

    @classmethod
    def Random(  # noqa: N802
        cls: type[Group],
        *batch_shape: Any,
        sigma: Any = 1.0,
        device: Any = None,
        dtype: torch.dtype = torch.float32,
        generator: torch.Generator | None = None,
    ) -> Group:
        """exp of normal tangents with standard deviation `sigma`: a number, or K numbers."""
        shape = (*_shape(batch_shape), cls.manifold_dim)
        noise = torch.randn(shape, device=device, dtype=dtype, generator=generator)
        return cls.exp(noise * torch.as_tensor(sigma, dtype=dtype, device=device))

    @classmethod
    def exp(cls: type[Group], tangent: Tensor) -> Group:
        """Exponential map of tangents (..., K)."""
        cls._check_tangent(tangent)
        return cls._wrap(autograd.exp(cls.layout, tangent))

    # --- group operations ---------------------------------------------------------------------------------------

    def log(self) -> Tensor:
        """Tangents (..., K), with rotation angles up to pi."""
        return autograd.log(self.layout, self.data)

    def inv(self: Group) -> Group:
        """Inverse elements."""
        return self._wrap(autograd.inv(self.layout, self.data))

    @overload
    def mul(self: Group, other: Group) -> Group: ...

    @overload
    def mul(self: Group, other: Tensor) -> Tensor: ...

    def mul(self: Group, other: Group | Tensor) -> Group | Tensor:
        """Product with another group element, or action on points."""
        if not isinstance(other, LieGroup):
            return self.act(other)
        if type(other) is not type(self):
            raise InputError(f"found a product of {self.layout.name} and {other.layout.name}; convert one of them")
        if other.dtype != self.dtype:
            raise InputError(f"found a product of {self.dtype} and {other.dtype}; convert one by .float() or .double()")
        self._check_batch(other.data)
        return self._wrap(autograd.mul(self.layout, self.data, other.data))

    @overload
    def __mul__(self: Group, other: Group) -> Group: ...

    @overload
    def __mul__(self: Group, other: Tensor) -> Tensor: ...

    def __mul__(self: Group, other: Group | Tensor) -> Group | Tensor:
        return self.mul(other)

    def retr(self: Group, tangent: Tensor) -> Group:
        """Retraction exp(a) X for tangents `a` (..., K)."""
        tangent = self._operand(tangent)
        self._check_tangent(tangent)
        return self.exp(tangent).mul(self)

    def adj(self, tangent: Tensor) -> Tensor:
        """Ad(X) a for tangents `a` (..., K)."""
        return autograd.adj(self.layout, self.data, self._tangent_operand(tangent))

    def adjT(self, tangent: Tensor) -> Tensor:  # noqa: N802
        """Ad(X)^T a for tangents `a` (..., K)."""
        return autograd.adjT(self.layout, self.data, self._tangent_operand(tangent))

    def Jinv(self, tangent: Tensor) -> Tensor:  # noqa: N802
        """Inverse left Jacobian at log(X) times tangents `a` (..., K); differentiable in both."""
        tangent = self._tangent_operand(tangent)
        return left_jacobian(self.layout, self.log(), tangent, inverse=True)

    def act(self, points: Tensor) -> Tensor:
        """Points (..., 3), or homogeneous points (..., 4), moved by the elements."""
        points = self._operand(points)
        if points.dim() == 0 or points.shape[-1] not in (3, 4):
            raise InputError(f"found points of shape {tuple(points.shape)}, expected (..., 3) or (..., 4)")
        self._check_batch(points)
        return autograd.act(self.layout, self.data, points)

    def matrix(self) -> Tensor:
        """Matrices (..., 4, 4) that act on homogeneous points."""
        return autograd.matrix(self.layout, self.data)

    def translation(self) -> Tensor:
        """Image of the origin as homogeneous points (..., 4)."""
        return self.matrix()[..., 3]

    def vec(self) -> Tensor:
        """Elements as plain vectors (..., N) with an ordinary gradient."""
        return autograd.to_vec(self.layout, self.data)

    # --- checks -------------------------------------------------------------------------------------------------

    @classmethod
    def _check_tangent(cls, tangent: Tensor) -> None:
        if tangent.dim() == 0 or tangent.shape[-1] != cls.manifold_dim or tangent.dtype not in _DTYPES:
            raise InputError(
                f"found a {tangent.dtype} tensor of shape {tuple(tangent.shape)} as tangent of {cls.layout.name}, "
                f"expected float32 or float64 of shape (..., {cls.manifold_dim})"
            )

    def _check_batch(self, operand: Tensor) -> None:
        mine, theirs = self.data.shape[:-1], operand.shape[:-1]
        if mine == theirs:
            return
        if len(mine) != len(theirs) or any(m != t and m != 1 and t != 1 for m, t in zip(mine, theirs)):
            raise InputError(
                f"found batch shapes {tuple(mine)} and {tuple(theirs)}, expected as many dimensions on both sides, "
                "each of equal size or 1; add dimensions of size 1 with [None] or view()"
            )

    def _operand(self, tensor: Tensor) -> Tensor:
        """The tensor in the group's dtype: half precision is lifted, float64 never silently lost."""
        if tensor.dtype == self.data.dtype:
            return tensor
        if torch.promote_types(tensor.dtype, self.data.dtype) != self.data.dtype:
            raise InputError(f"found a {tensor.dtype} operand for {self.dtype} elements; use .float() or .double()")
        return tensor.to(self.data.dtype)

    def _tangent_operand(self, tangent: Tensor) -> Tensor:
        tangent = self._operand(tangent)
        self._check_tangent(tangent)
        self._check_batch(tangent)
        return tangent

    # --- tensor habits ------------------------------------------------------------------------------------------

    @property
    def shape(self) -> torch.Size:
        """Batch shape."""
        return self.data.shape[:-1]

    @property
    def tangent_shape(self) -> torch.Size:
        """Shape (batch..., K) of tangents."""
        return torch.Size((*self.shape, self.manifold_dim))

    @property
    def device(self) -> torch.device:
        """Device of the data."""
        return self.data.device

    @property
    def dtype(self) -> torch.dtype:
        """torch.float32 or torch.float64."""
        return self.data.dtype

    @property
    def requires_grad(self) -> bool:
        """Whether the data take part in a gradient."""
        return self.data.requires_grad

    def __len__(self) -> int:
        return self.data.shape[0] if self.shape else 0

    def __repr__(self) -> str:
        return f"{self.layout.name}(shape={tuple(self.shape)}, dtype={self.dtype}, device={self.device})"

    def __getitem__(self: Group, index: Any) -> Group:
        return self._wrap(self.data[self._batch_index(index)])

    def __setitem__(self: Group, index: Any, value: Group) -> None:
        if type(value) is not type(self):
            raise InputError(f"found {type(value).__name__} to write into {self.layout.name}, expected the same group")
        self.data[self._batch_index(index)] = value.data

    def _batch_index(self, index: Any) -> tuple[Any, ...]:
        """The index with the last dimension of the data kept out of its reach."""
        entries = index if isinstance(index, tuple) else (index,)
        if not any(entry is Ellipsis for entry in entries):
            entries = (*entries, Ellipsis)
        taken = sum(_consumed(entry) for entry in entries)
        if taken > len(self.shape):
            raise InputError(f"found an index into {taken} dimensions, but the batch shape is {tuple(self.shape)}")
        return (*entries, slice(None))

    def view(self: Group, *dims: Any) -> Group:
        """Elements with another batch shape, given as numbers or as one sequence."""
        return self._wrap(self.data.view(*_shape(dims), self.embedded_dim))

    def unbind(self: Group, dim: int = 0) -> tuple[Group, ...]:
        """Elements along one batch dimension, one by one."""
        return tuple(self._wrap(data) for data in self.data.unbind(_batch_dim(dim, len(self.shape))))

    def detach(self: Group) -> Group:
        """Same elements outside the gradient."""
        return self._wrap(self.data.detach())

    def clone(self: Group) -> Group:
        """Copy of the elements."""
        return self._wrap(self.data.clone())

    def to(self: Group, *args: Any, **kwargs: Any) -> Group:
        """Elements on another device or in another dtype, arguments as `torch.Tensor.to`."""
        return type(self)(self.data.to(*args, **kwargs))

    def cpu(self: Group) -> Group:
        """Elements on the CPU."""
        return self.to("cpu")

    def cuda(self: Group, device: Any = "cuda") -> Group:
        """Elements on a CUDA device."""
        return self.to(device)

    def float(self: Group) -> Group:
        """Elements in float32."""
        return self.to(torch.float32)

    def double(self: Group) -> Group:
        """Elements in float64."""
        return self.to(torch.float64)


class SO3(LieGroup):
    """Rotations: data qx qy qz qw, tangents phi (radians)."""

    layout = SO3_LAYOUT


class RxSO3(LieGroup):
    """Rotations with scale: data qx qy qz qw s, tangents phi sigma."""

    layout = RXSO3_LAYOUT


class SE3(LieGroup):
    """Rigid motions: data tx ty tz qx qy qz qw, tangents tau phi."""

    layout = SE3_LAYOUT

    def scale(self, factor: Tensor) -> SE3:
        """Motions with translations multiplied by `factor` (batch shape)."""
        t, q = self.data.split((3, 4), -1)
        return self._wrap(torch.cat((t * self._operand(factor).unsqueeze(-1), q), -1))


class Sim3(LieGroup):
    """Similarities: data tx ty tz qx qy qz qw s, tangents tau phi sigma."""

    layout = SIM3_LAYOUT


def _consumed(entry: Any) -> int:
    """How many dimensions an index entry uses up."""
    if entry is None or entry is Ellipsis or isinstance(entry, bool):
        return 0
    if isinstance(entry, Tensor) and entry.dtype in (torch.bool, torch.uint8):
        return entry.dim()
    return 1


def _shape(dims: Sequence[Any]) -> tuple[int, ...]:
    if len(dims) == 1 and isinstance(dims[0], (tuple, list)):
        return tuple(dims[0])
    return tuple(dims)


def _batch_dim(dim: int, count: int) -> int:
    """A batch dimension counted from the front; negative numbers count batch dimensions from the back."""
    if not -count <= dim < count:
        raise InputError(f"found dimension {dim}, expected one of {count} batch dimensions")
    return dim % count


def _same_group(groups: Sequence[Group]) -> type[Group]:
    kinds = {type(group) for group in groups}
    if len(kinds) != 1:
        found = ", ".join(sorted(kind.__name__ for kind in kinds)) or "no group"
        raise InputError(f"found {found}, expected one or more batches of one group")
    return kinds.pop()


def cat(groups: Sequence[Group], dim: int = 0) -> Group:
    """Batches of one group joined along a batch dimension."""
    kind = _same_group(groups)
    return kind(torch.cat([group.data for group in groups], _batch_dim(dim, len(groups[0].shape))))


def stack(groups: Sequence[Group], dim: int = 0) -> Group:
    """Batches of one group and shape joined along a new batch dimension."""
    kind = _same_group(groups)
    return kind(torch.stack([group.data for group in groups], _batch_dim(dim, len(groups[0].shape) + 1)))
