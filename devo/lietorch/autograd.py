"""Group operations with left-tangent gradients, once differentiable.

The gradient of an element X of a loss L is dL(exp(d) X)/dd at d = 0: K numbers, stored as the first K entries of a
tensor as long as the element (N), the others zero. In this form it passes unchanged through indexing, cat, stack,
expand and view of the element tensors, and size-1 batch dimensions are summed. Where no gradient is asked for, the
formulas are called directly.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.linalg import cross

from devo.lietorch import formulas
from devo.lietorch.formulas import adj_transposed, small_adj_transposed
from devo.lietorch.jacobians import left_jacobian
from devo.lietorch.layout import Layout, join
from devo.lietorch.quaternion import apply_matrix, quat_conjugate, quat_multiply

Gradients = tuple[Any, ...]


def _wanted(*tensors: Tensor) -> bool:
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _reduce(grad: Tensor, like: Tensor) -> Tensor:
    """Sum over the batch dimensions in which the operand was broadcast; the last sizes may differ."""
    batch = like.shape[:-1]
    return grad if grad.shape[:-1] == batch else grad.sum_to_size(*batch, grad.shape[-1])


def _element(layout: Layout, grad: Tensor, like: Tensor) -> Tensor:
    return layout.element_gradient(_reduce(grad, like))


class _Exp(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, tangent: Tensor) -> Tensor:
        ctx.layout = layout
        ctx.save_for_backward(tangent)
        return formulas.exp(layout, tangent)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        (tangent,) = ctx.saved_tensors
        return None, left_jacobian(ctx.layout, tangent, ctx.layout.tangent_gradient(grad), transposed=True)


class _Log(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, data: Tensor) -> Tensor:
        ctx.layout = layout
        tangent = formulas.log(layout, data)
        ctx.save_for_backward(tangent)
        return tangent

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        (tangent,) = ctx.saved_tensors
        moved = left_jacobian(ctx.layout, tangent, grad, inverse=True, transposed=True)
        return None, ctx.layout.element_gradient(moved)


class _Inv(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, data: Tensor) -> Tensor:
        ctx.layout = layout
        inverse = formulas.inv(layout, data)
        ctx.save_for_backward(inverse)
        return inverse

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        (inverse,) = ctx.saved_tensors
        layout: Layout = ctx.layout
        return None, layout.element_gradient(adj_transposed(layout, inverse, layout.tangent_gradient(grad)).neg())


class _Mul(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, x: Tensor, y: Tensor) -> Tensor:
        ctx.layout = layout
        ctx.save_for_backward(x, y)
        return formulas.mul(layout, x, y)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        x, y = ctx.saved_tensors
        layout: Layout = ctx.layout
        grad_y = None
        if ctx.needs_input_grad[2]:
            grad_y = _element(layout, adj_transposed(layout, x, layout.tangent_gradient(grad)), y)
        # The gradient of the product is an element gradient already, zeros included.
        return None, _reduce(grad, x), grad_y


class _Adj(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, x: Tensor, tangent: Tensor) -> Tensor:
        ctx.layout = layout
        moved = formulas.adj(layout, x, tangent)
        ctx.save_for_backward(x, tangent, moved)
        return moved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        x, tangent, moved = ctx.saved_tensors
        layout: Layout = ctx.layout
        grad_x = _element(layout, small_adj_transposed(layout, moved, grad).neg(), x)
        return None, grad_x, _reduce(adj_transposed(layout, x, grad), tangent)


class _AdjT(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, x: Tensor, tangent: Tensor) -> Tensor:
        ctx.layout = layout
        ctx.save_for_backward(x, tangent)
        return adj_transposed(layout, x, tangent)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        x, tangent = ctx.saved_tensors
        layout: Layout = ctx.layout
        moved = formulas.adj(layout, x, grad)
        grad_x = _element(layout, small_adj_transposed(layout, moved, tangent).neg(), x)
        return None, grad_x, _reduce(moved, tangent)


class _Act(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, x: Tensor, points: Tensor) -> Tensor:
        ctx.layout = layout
        element_matrix = formulas.matrix(layout, x)
        moved = formulas.act(layout, element_matrix, points)
        ctx.save_for_backward(x, points, element_matrix, moved)
        return moved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        x, points, element_matrix, moved = ctx.saved_tensors
        layout: Layout = ctx.layout
        grad_x = grad_points = None
        size = points.shape[-1]
        if ctx.needs_input_grad[1]:
            homogeneous = moved[..., 3:] if size == 4 else 1.0
            tangent = formulas.act_gradient(layout, moved[..., :3], grad[..., :3], homogeneous)
            grad_x = _element(layout, tangent, x)
        if ctx.needs_input_grad[2]:
            grad_points = _reduce(apply_matrix(element_matrix[..., :size, :size].mT, grad), points)
        return None, grad_x, grad_points


class _Matrix(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, x: Tensor) -> Tensor:
        ctx.layout = layout
        element_matrix = formulas.matrix(layout, x)
        ctx.save_for_backward(element_matrix)
        return element_matrix

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        # The columns are moved points, with fourth coordinates 0 0 0 1.
        columns, grad = ctx.saved_tensors[0].mT, grad.mT
        tangent = formulas.act_gradient(ctx.layout, columns[..., :3], grad[..., :3], columns[..., 3:])
        return None, ctx.layout.element_gradient(tangent.sum(-2))


class _ToVec(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, x: Tensor) -> Tensor:
        ctx.layout = layout
        ctx.save_for_backward(x)
        return x.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        (x,) = ctx.saved_tensors
        layout: Layout = ctx.layout
        q = layout.quaternion(x)
        parts = [0.5 * quat_multiply(layout.quaternion(grad), quat_conjugate(q))[..., :3]]
        grad_scale = layout.scale(x) * layout.scale(grad) if layout.has_scale else None
        if layout.has_translation:
            grad_t = layout.translation(grad)
            translation = formulas.act_gradient(layout, layout.translation(x), grad_t, 1.0)
            parts = [translation[..., :3], parts[0] + translation[..., 3:6]]
            grad_scale = grad_scale + translation[..., 6:] if grad_scale is not None else None
        if grad_scale is not None:
            parts.append(grad_scale)
        return None, layout.element_gradient(join(parts))


class _FromVec(Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, vector: Tensor) -> Tensor:
        ctx.layout = layout
        ctx.save_for_backward(vector)
        return vector.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        (x,) = ctx.saved_tensors
        layout: Layout = ctx.layout
        q = layout.quaternion(x)
        grad = layout.tangent_gradient(grad)
        phi = layout.phi(grad)
        grad_scale = grad[..., -1:]
        parts: list[Tensor] = []
        if layout.has_translation:
            t, tau = layout.translation(x), grad[..., :3]
            phi = phi - cross(t, tau)
            grad_scale = grad_scale - (t * tau).sum(-1, keepdim=True)
            parts.append(tau)
        pure = torch.constant_pad_nd(phi, (0, 1))
        parts.append(quat_multiply(pure, q) * (2 / (q * q).sum(-1, keepdim=True)))
        if layout.has_scale:
            parts.append(grad_scale / layout.scale(x))
        return None, join(parts)


class _Convert(Function):
    """Rotation kept; translation and scale kept where both groups have them, else dropped or neutral."""

    @staticmethod
    def forward(ctx: Any, source: Layout, target: Layout, x: Tensor) -> Tensor:
        ctx.layouts = source, target
        parts = [source.quaternion(x)]
        if target.has_translation:
            parts.insert(0, source.translation(x) if source.has_translation else torch.zeros_like(parts[0][..., :3]))
        if target.has_scale:
            parts.append(source.scale(x) if source.has_scale else torch.ones_like(parts[0][..., :1]))
        return torch.cat(parts, -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        source, target = ctx.layouts
        grad = target.tangent_gradient(grad)
        parts = [target.phi(grad)]
        if source.has_translation:
            parts.insert(0, grad[..., :3] if target.has_translation else torch.zeros_like(parts[0]))
        if source.has_scale:
            parts.append(grad[..., -1:] if target.has_scale else torch.zeros_like(parts[0][..., :1]))
        return None, None, source.element_gradient(torch.cat(parts, -1))


def exp(layout: Layout, tangent: Tensor) -> Tensor:
    """Differentiable `formulas.exp`."""
    return _Exp.apply(layout, tangent) if _wanted(tangent) else formulas.exp(layout, tangent)


def log(layout: Layout, x: Tensor) -> Tensor:
    """Differentiable `formulas.log`."""
    return _Log.apply(layout, x) if _wanted(x) else formulas.log(layout, x)


def inv(layout: Layout, x: Tensor) -> Tensor:
    """Differentiable `formulas.inv`."""
    return _Inv.apply(layout, x) if _wanted(x) else formulas.inv(layout, x)


def mul(layout: Layout, x: Tensor, y: Tensor) -> Tensor:
    """Differentiable `formulas.mul`."""
    return _Mul.apply(layout, x, y) if _wanted(x, y) else formulas.mul(layout, x, y)


def adj(layout: Layout, x: Tensor, tangent: Tensor) -> Tensor:
    """Differentiable `formulas.adj`."""
    return _Adj.apply(layout, x, tangent) if _wanted(x, tangent) else formulas.adj(layout, x, tangent)


def adjT(layout: Layout, x: Tensor, tangent: Tensor) -> Tensor:  # noqa: N802 - the published name
    """Differentiable `formulas.adj_transposed`."""
    return _AdjT.apply(layout, x, tangent) if _wanted(x, tangent) else adj_transposed(layout, x, tangent)


def act(layout: Layout, x: Tensor, points: Tensor) -> Tensor:
    """Differentiable `formulas.act` of elements (..., N) on points (..., 3) or (..., 4)."""
    if _wanted(x, points):
        return _Act.apply(layout, x, points)
    return formulas.act(layout, formulas.matrix(layout, x), points)


def matrix(layout: Layout, x: Tensor) -> Tensor:
    """Differentiable `formulas.matrix`."""
    return _Matrix.apply(layout, x) if _wanted(x) else formulas.matrix(layout, x)


def to_vec(layout: Layout, x: Tensor) -> Tensor:
    """Elements as plain vectors (..., N): a left-tangent gradient on one side, an ordinary one on the other."""
    return _ToVec.apply(layout, x) if _wanted(x) else x


def from_vec(layout: Layout, vector: Tensor) -> Tensor:
    """Plain vectors (..., N) as elements, the reverse of `to_vec`."""
    return _FromVec.apply(layout, vector) if _wanted(vector) else vector


def convert(source: Layout, target: Layout, x: Tensor) -> Tensor:
    """Elements of one group as elements of another, see `LieGroup`."""
    return _Convert.apply(source, target, x)
