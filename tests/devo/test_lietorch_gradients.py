"""Gradients of every operation of every group against numerical derivatives under left perturbations, in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from devo.errors import InputError
from devo.lietorch import SE3, SO3, LieGroup, RxSO3, Sim3, cat, stack
from tests.tolerances import LIE_GRADIENT

GROUPS = [SO3, RxSO3, SE3, Sim3]
# Zero, tiny, small, on both sides of the change from series to closed form, large.
ANGLES = torch.tensor([0.0, 1e-9, 1e-4, 0.4, 0.999, 1.001, 2.2, 2.9], dtype=torch.float64)
STEP = 1e-3
Value = Tensor | LieGroup


def random_tangents(group: type[LieGroup], seed: int, angles: Tensor = ANGLES) -> Tensor:
    out = torch.randn(
        len(angles), group.manifold_dim, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    phi = group.layout.phi(out)
    phi *= (angles / torch.linalg.vector_norm(phi, dim=-1))[:, None]
    if group.layout.has_scale:
        out[:, -1] = 0.5 * torch.tanh(out[:, -1])  # scales around one, for which the steps of the differences are small
    out[0, :] *= 0 if group is not SE3 else 1  # SE3: translation without rotation; others: exactly zero
    return out


def element(group: type[LieGroup], seed: int) -> LieGroup:
    return group.exp(random_tangents(group, seed))


def vector(size: int, seed: int) -> Tensor:
    return torch.randn(len(ANGLES), size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@dataclass
class Op:
    """A function of elements and plain tensors, and how to make its inputs."""

    function: Callable[..., Value]
    inputs: Callable[[type[LieGroup]], list[Value]]
    rowwise: bool = True


OPS = {
    "exp": Op(lambda a: a, lambda g: [random_tangents(g, 0)]),  # the function is put in below, it depends on the group
    "log": Op(lambda x: x.log(), lambda g: [element(g, 0)]),
    "inv": Op(lambda x: x.inv(), lambda g: [element(g, 0)]),
    "mul": Op(lambda x, y: x * y, lambda g: [element(g, 0), element(g, 1)]),
    "retr": Op(lambda x, a: x.retr(a), lambda g: [element(g, 0), random_tangents(g, 1)]),
    "adj": Op(lambda x, a: x.adj(a), lambda g: [element(g, 0), vector(g.manifold_dim, 1)]),
    "adjT": Op(lambda x, a: x.adjT(a), lambda g: [element(g, 0), vector(g.manifold_dim, 1)]),
    "Jinv": Op(lambda x, a: x.Jinv(a), lambda g: [element(g, 0), vector(g.manifold_dim, 1)]),
    "act3": Op(lambda x, p: x.act(p), lambda g: [element(g, 0), vector(3, 1)]),
    "act4": Op(lambda x, p: x * p, lambda g: [element(g, 0), vector(4, 1)]),
    "matrix": Op(lambda x: x.matrix(), lambda g: [element(g, 0)]),
    "translation": Op(lambda x: x.translation(), lambda g: [element(g, 0)]),
    "vec": Op(lambda x: x.vec(), lambda g: [element(g, 0)]),
    "InitFromVec": Op(lambda v: v, lambda g: [element(g, 0).data * 1.0]),
    "chain": Op(
        lambda x, y, p: (x.inv() * y).log().sum(-1, keepdim=True) * (y * x.inv() * p), lambda g: [
            element(g, 0), g.exp(0.3 * random_tangents(g, 1)), vector(4, 2)]),
    "index": Op(lambda x: x[[3, 3, 1]], lambda g: [element(g, 0)], rowwise=False),
    "cat": Op(lambda x, y: cat([x, y], 0), lambda g: [element(g, 0), element(g, 1)], rowwise=False),
    "stack": Op(lambda x, y: stack([x, y], 1), lambda g: [element(g, 0), element(g, 1)], rowwise=False),
    "view": Op(lambda x: x.view(2, 4)[1:], lambda g: [element(g, 0)], rowwise=False),
    "unbind": Op(lambda x: x.unbind(0)[4], lambda g: [element(g, 0)], rowwise=False),
}  # fmt: skip


def _difference(plus: Value, minus: Value) -> Tensor:
    """plus - minus: for elements the tangent that leads from minus to plus, in the left tangent space."""
    if isinstance(plus, LieGroup):
        return (plus * minus.inv()).log()
    return plus - minus


def _moved(value: Value, index: int, step: float) -> Value:
    if isinstance(value, LieGroup):
        direction = torch.zeros(*value.tangent_shape, dtype=torch.float64)
        direction[..., index] = step
        return value.retr(direction)
    moved = value.clone()
    moved[..., index] += step
    return moved


def numerical_gradient(
    function: Callable[..., Value], inputs: list[Value], which: int, weight: Tensor, rows: slice = slice(None)
) -> Tensor:
    """Fourth-order central differences of sum(weight * f), for rows of one input that are moved together.

    Several rows give one gradient each, for functions whose rows do not depend on one another.
    """
    value = inputs[which]
    size = value.manifold_dim if isinstance(value, LieGroup) else value.shape[-1]
    out = []
    for index in range(size):
        slopes = []
        for step in (STEP, 2 * STEP):
            ends = []
            for signed in (step, -step):
                changed = value.clone()
                changed[rows] = _moved(value[rows], index, signed)
                ends.append(function(*inputs[:which], changed, *inputs[which + 1 :]))
            slope = (_difference(*ends) * weight) / (2 * step)
            slopes.append(slope.flatten(1).sum(1) if rows == slice(None) else slope.sum()[None])
        out.append((4 * slopes[0] - slopes[1]) / 3)
    return torch.stack(out, -1)


def check(function: Callable[..., Value], inputs: list[Value], rowwise: bool = True) -> None:
    """Analytic against numerical gradients for all inputs; the entries of element gradients past K are zero."""
    inputs = [v.detach() for v in inputs]
    leaves = [v.clone() for v in inputs]
    for leaf in leaves:
        (leaf.data if isinstance(leaf, LieGroup) else leaf).requires_grad_()
    result = function(*leaves)
    shape = result.tangent_shape if isinstance(result, LieGroup) else result.shape
    weight = torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(11))
    if isinstance(result, LieGroup):
        result.data.backward(result.layout.element_gradient(weight))
    else:
        result.backward(weight)
    for which, (leaf, value) in enumerate(zip(leaves, inputs)):
        grad = (leaf.data if isinstance(leaf, LieGroup) else leaf).grad
        assert grad is not None
        assert torch.isfinite(grad).all()
        if isinstance(leaf, LieGroup):
            assert grad.shape == leaf.data.shape
            assert (grad[..., leaf.manifold_dim :] == 0).all()
            grad = grad[..., : leaf.manifold_dim]
        rows = [slice(None)] if rowwise else [slice(row, row + 1) for row in range(len(value))]
        numerical = torch.cat([numerical_gradient(function, inputs, which, weight, row) for row in rows])
        torch.testing.assert_close(grad, numerical, rtol=LIE_GRADIENT, atol=LIE_GRADIENT)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("name", OPS)
def test_gradient(name: str, group: type[LieGroup]) -> None:
    op = OPS[name]
    function = {"exp": group.exp, "InitFromVec": group.InitFromVec}.get(name, op.function)
    check(function, op.inputs(group), op.rowwise)


@pytest.mark.parametrize("group", GROUPS)
def test_gradient_of_init_from_vec_with_quaternions_of_any_length(group: type[LieGroup]) -> None:
    data = element(group, 0).data
    group.layout.quaternion(data).mul_(1.3)
    check(group.InitFromVec, [data])


@pytest.mark.parametrize("group", GROUPS)
def test_vec_after_init_from_vec_keeps_gradients_that_stay_on_the_group(group: type[LieGroup]) -> None:
    """The gradient of a function that does not depend on the length of the quaternion passes unchanged."""
    data = element(group, 0).data.requires_grad_()
    quaternion = group.layout.quaternion

    def loss(v: Tensor) -> Tensor:
        q = quaternion(v) / torch.linalg.vector_norm(quaternion(v), dim=-1, keepdim=True)
        return (q * torch.arange(1.0, 5.0)).sum() + (v[..., :3] * 2).sum() * int(group.layout.has_translation)

    direct = torch.autograd.grad(loss(data), data)[0]
    through = torch.autograd.grad(loss(group.InitFromVec(data).vec()), data)[0]
    torch.testing.assert_close(through, direct, rtol=0, atol=1e-12)


CONVERSIONS = [(SO3, SE3), (SO3, Sim3), (SO3, RxSO3), (SE3, Sim3), (RxSO3, Sim3), (SE3, SO3), (Sim3, SO3), (RxSO3, SO3)]


@pytest.mark.parametrize(("source", "target"), CONVERSIONS)
def test_gradient_of_conversions(source: type[LieGroup], target: type[LieGroup]) -> None:
    check(target, [element(source, 0)])


def test_gradient_of_scaled_translations() -> None:
    check(lambda x, s: x.scale(s[..., 0]), [element(SE3, 0), vector(1, 3)])


BROADCASTS = [((1, 3), (2, 3)), ((2, 3), (1, 3)), ((2, 1), (1, 3)), ((1, 1), (2, 3)), ((2, 3), (2, 1))]


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize(("left", "right"), BROADCASTS)
def test_broadcasting_is_repeating(group: type[LieGroup], left: tuple[int, ...], right: tuple[int, ...]) -> None:
    """Values and gradients of size-1 dimensions equal those of operands that were repeated before."""
    x = group.Random(left, dtype=torch.float64).data.requires_grad_()
    others = {
        "mul": group.Random(right, dtype=torch.float64).data.requires_grad_(),
        "act3": torch.randn(*right, 3, dtype=torch.float64, requires_grad=True),
        "act4": torch.randn(*right, 4, dtype=torch.float64, requires_grad=True),
        "adj": torch.randn(*right, group.manifold_dim, dtype=torch.float64, requires_grad=True),
        "adjT": torch.randn(*right, group.manifold_dim, dtype=torch.float64, requires_grad=True),
        "Jinv": torch.randn(*right, group.manifold_dim, dtype=torch.float64, requires_grad=True),
        "retr": torch.randn(*right, group.manifold_dim, dtype=torch.float64, requires_grad=True),
    }
    full = torch.broadcast_shapes(left, right)
    for name, y in others.items():

        def apply(a: Tensor, b: Tensor, name: str = name) -> Tensor:
            if name == "mul":
                return (group(a) * group(b)).data
            out = getattr(group(a), name.rstrip("34") if name.startswith("act") else name)(b)
            return out.data if isinstance(out, LieGroup) else out

        weight = None
        outcomes = []
        for a, b in ((x, y), (x.expand(*full, -1).contiguous(), y.expand(*full, -1).contiguous())):
            out = apply(a, b)
            weight = torch.randn_like(out) if weight is None else weight
            outcomes.append((out, *torch.autograd.grad(out, (x, y), weight)))
        for found, expected in zip(*outcomes):
            torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-11)


def test_no_second_derivative_is_promised() -> None:
    a = torch.randn(2, 6, dtype=torch.float64, requires_grad=True)
    first = torch.autograd.grad(SE3.exp(a).data.square().sum(), a, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_at_the_identity_are_finite(group: type[LieGroup], dtype: torch.dtype) -> None:
    a = torch.zeros(3, group.manifold_dim, dtype=dtype, requires_grad=True)
    x = group.exp(a)
    loss = (x.log() + (x * x.inv()).log() + x.Jinv(x.adj(x.adjT(x.log())))).sum() + x.matrix().sum() + x.vec().sum()
    (grad,) = torch.autograd.grad(loss, a)
    assert torch.isfinite(grad).all()
    assert (grad != 0).all()


def test_gradient_reaches_through_half_precision_points() -> None:
    points = torch.randn(4, 3, dtype=torch.bfloat16, requires_grad=True)
    SE3.Random(4).act(points).sum().backward()
    assert points.grad is not None
    assert points.grad.dtype == torch.bfloat16
    with pytest.raises(InputError, match="float64"):
        SE3.Random(4).act(torch.randn(4, 3, dtype=torch.float64))
