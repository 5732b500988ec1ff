"""Group laws and accuracy, from tiny angles to almost half a turn, against matrix exponentials and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from devo.lietorch import SE3, SO3, LieGroup, RxSO3, Sim3
from devo.lietorch.jacobians import left_jacobian, left_jacobian_matrix
from devo.lietorch.quaternion import quat_conjugate, quat_multiply, quat_normalize, quat_rotate, quat_to_matrix
from tests.tolerances import LIE_FLOAT32_SMALL, LIE_LAWS_FLOAT32, LIE_LAWS_FLOAT64, LIE_SLOPE

GROUPS = [SO3, RxSO3, SE3, Sim3]
ANGLES = [0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2, 0.3, 1.0, 2.0, 3.0, math.pi - 1e-3, math.pi - 1e-6]
SHAPES = [(), (1,), (7,), (2, 3)]
TOLERANCE = {torch.float32: LIE_LAWS_FLOAT32, torch.float64: LIE_LAWS_FLOAT64}


def tangents(group: type[LieGroup], shape: tuple[int, ...], angle: float, dtype: torch.dtype, seed: int) -> Tensor:
    """Tangents with rotations by `angle` about random axes, translations of order one, scales near one."""
    generator = torch.Generator().manual_seed(seed)
    out = torch.randn(*shape, group.manifold_dim, dtype=torch.float64, generator=generator)
    phi = group.layout.phi(out)
    phi *= angle / torch.linalg.vector_norm(phi, dim=-1, keepdim=True)
    if group.layout.has_scale:
        out[..., -1] = 0.5 * torch.tanh(out[..., -1])
    return out.to(dtype)


def _elements_close(x: LieGroup, y: LieGroup, tolerance: float) -> None:
    torch.testing.assert_close(x.matrix(), y.matrix(), rtol=tolerance, atol=tolerance)


class Case:
    """Random elements and vectors of one batch shape."""

    def __init__(self, group: type[LieGroup], shape: tuple[int, ...], angle: float, dtype: torch.dtype) -> None:
        self.group, self.tolerance = group, TOLERANCE[dtype]
        self.a, self.b, self.c = (tangents(group, shape, angle, dtype, seed) for seed in range(3))
        self.x, self.y, self.z = group.exp(self.a), group.exp(self.b), group.exp(self.c)
        self.p = torch.randn(*shape, 4, dtype=dtype, generator=torch.Generator().manual_seed(4))

    def close(self, found: Tensor, expected: Tensor) -> None:
        torch.testing.assert_close(found, expected, rtol=self.tolerance, atol=self.tolerance)

    def same(self, found: LieGroup, expected: LieGroup) -> None:
        _elements_close(found, expected, self.tolerance)


LAWS = {
    "log of exp": lambda k: k.close(k.x.log(), k.a),
    "exp of log": lambda k: k.same(k.group.exp((k.x * k.y).log()), k.x * k.y),
    "inverse": lambda k: (
        k.same(k.x * k.x.inv(), k.group.IdentityLike(k.x)),
        k.same(k.x.inv() * k.x, k.group.IdentityLike(k.x)),
    ),
    "exp of minus": lambda k: k.same(k.group.exp(-k.a), k.x.inv()),
    "associative": lambda k: k.same((k.x * k.y) * k.z, k.x * (k.y * k.z)),
    "inverse of product": lambda k: k.same((k.x * k.y).inv(), k.y.inv() * k.x.inv()),
    "action of product": lambda k: k.close((k.x * k.y) * k.p, k.x * (k.y * k.p)),
    "matrix": lambda k: (
        k.close((k.x * k.y).matrix(), k.x.matrix() @ k.y.matrix()),
        k.close(k.x * k.p, (k.x.matrix() @ k.p[..., None])[..., 0]),
        k.close(k.x * k.p[..., :3], (k.x * torch.cat((k.p[..., :3], torch.ones_like(k.p[..., :1])), -1))[..., :3]),
        k.close(k.x.translation(), k.x.matrix()[..., 3]),
    ),
    "adjoint": lambda k: k.same(k.x * k.group.exp(k.b), k.group.exp(k.x.adj(k.b)) * k.x),
    "adjoint of product": lambda k: k.close((k.x * k.y).adj(k.c), k.x.adj(k.y.adj(k.c))),
    "adjoint transposed": lambda k: k.close((k.x.adj(k.b) * k.c).sum(-1), (k.b * k.x.adjT(k.c)).sum(-1)),
    "retraction": lambda k: k.same(k.x.retr(k.b), k.group.exp(k.b) * k.x),
    "unit quaternions": lambda k: [
        k.close(torch.linalg.vector_norm(k.group.layout.quaternion(g.data), dim=-1), torch.ones_like(k.p[..., 0]))
        for g in (k.x, k.x * k.y, k.x.inv())
    ],
    "sign of the quaternion": lambda k: (k.close(_flipped(k.x).log(), k.x.log()), k.same(_flipped(k.x), k.x)),
    "inverse jacobian": lambda k: k.close(k.x.Jinv(left_jacobian(k.group.layout, k.a, k.b)), k.b),
}


def _flipped(x: LieGroup) -> LieGroup:
    data = x.data.clone()
    x.layout.quaternion(data).neg_()
    return type(x)(data)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("law", LAWS)
def test_law(law: str, shape: tuple[int, ...], dtype: torch.dtype, group: type[LieGroup]) -> None:
    for angle in ANGLES:
        LAWS[law](Case(group, shape, angle, dtype))


def _generator(group: type[LieGroup], a: Tensor) -> Tensor:
    """The 4x4 matrix whose exponential is the element."""
    x, y, z = group.layout.phi(a).unbind(-1)
    out = a.new_zeros(*a.shape[:-1], 4, 4)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    if group.layout.has_translation:
        out[..., :3, 3] = a[..., :3]
    if group.layout.has_scale:
        out[..., [0, 1, 2], [0, 1, 2]] = a[..., -1:]
    return out


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("angle", [*ANGLES, 4.0, 9.0])
def test_exp_is_the_matrix_exponential(group: type[LieGroup], angle: float) -> None:
    a = tangents(group, (20,), angle, torch.float64, 5)
    torch.testing.assert_close(
        group.exp(a).matrix(),
        torch.linalg.matrix_exp(_generator(group, a)),
        rtol=LIE_LAWS_FLOAT64,
        atol=LIE_LAWS_FLOAT64,
    )


@pytest.mark.parametrize("sigma", [0.0, 1e-20, -1e-12, 1e-7, -1e-4, 0.1, -2.0, 3.0])
@pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-9, 1e-4, 0.5, 3.0])
def test_sim3_at_every_pair_of_scale_and_angle(sigma: float, angle: float) -> None:
    a = tangents(Sim3, (5,), angle, torch.float64, 6)
    a[..., -1] = sigma
    x = Sim3.exp(a)
    torch.testing.assert_close(
        x.matrix(), torch.linalg.matrix_exp(_generator(Sim3, a)), rtol=LIE_LAWS_FLOAT64, atol=LIE_LAWS_FLOAT64
    )
    torch.testing.assert_close(x.log(), a, rtol=LIE_LAWS_FLOAT64, atol=LIE_LAWS_FLOAT64)
    x32 = Sim3.exp(a.float())
    torch.testing.assert_close(x32.matrix().double(), x.matrix(), rtol=LIE_LAWS_FLOAT32, atol=LIE_LAWS_FLOAT32)
    torch.testing.assert_close(x32.log().double(), a, rtol=LIE_LAWS_FLOAT32, atol=LIE_LAWS_FLOAT32)


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("angle", [*ANGLES, 0.9999, 1.0001, 4.5])
def test_left_jacobian_against_the_full_series(
    group: type[LieGroup], angle: float, transposed: bool, inverse: bool
) -> None:
    a, v = tangents(group, (9,), angle, torch.float64, 7), torch.randn(9, group.manifold_dim, dtype=torch.float64)
    expected = left_jacobian_matrix(group.layout, a)
    expected = torch.linalg.inv(expected) if inverse else expected
    expected = expected.mT if transposed else expected
    found = left_jacobian(group.layout, a, v, inverse=inverse, transposed=transposed)
    torch.testing.assert_close(found, (expected @ v[..., None])[..., 0], rtol=LIE_LAWS_FLOAT64, atol=LIE_LAWS_FLOAT64)


@pytest.mark.parametrize("group", GROUPS)
def test_jinv_is_the_derivative_of_the_logarithm(group: type[LieGroup]) -> None:
    a = tangents(group, (6,), 1.2, torch.float64, 8)
    d = torch.randn(6, group.manifold_dim, dtype=torch.float64)
    x, h = group.exp(a), 1e-5
    slope = (x.retr(h * d).log() - x.retr(-h * d).log()) / (2 * h)
    torch.testing.assert_close(x.Jinv(d), slope, rtol=LIE_SLOPE, atol=LIE_SLOPE)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-6, 1e-5, 2.7e-4, 1e-3, 1e-2, 0.05, 0.3, 0.99, 1.01])
def test_float32_is_accurate_near_zero(group: type[LieGroup], angle: float) -> None:
    """Values and gradients in float32 against float64 on the same rounded input."""
    a32 = tangents(group, (50,), angle, torch.float32, 9).requires_grad_()
    a64 = a32.detach().double().requires_grad_()
    weight = torch.randn(50, group.embedded_dim, generator=torch.Generator().manual_seed(1))
    weight[..., group.manifold_dim :] = 0
    outcomes = []
    for a in (a32, a64):
        x = group.exp(a)
        log = x.log()
        x_grad = torch.autograd.grad(x.data, a, weight.to(a.dtype), retain_graph=True)[0]
        log_grad = torch.autograd.grad((log * weight[..., : group.manifold_dim].to(a.dtype)).sum(), x.data)[0]
        outcomes.append([t.detach().double() for t in (x.data, log, x_grad, log_grad)])
    for found, expected in zip(*outcomes):
        torch.testing.assert_close(found, expected, rtol=LIE_FLOAT32_SMALL, atol=LIE_FLOAT32_SMALL)


def test_float32_keeps_tiny_rotations() -> None:
    """A rotation of 1e-10 rad moves the translation by 1e-10 of it; the tangent survives with seven digits."""
    phi = torch.tensor([[3e-10, -2e-11, 1e-15]])
    torch.testing.assert_close(SO3.exp(phi).log(), phi, rtol=1e-6, atol=0)
    torch.testing.assert_close(SO3.exp(phi).data[..., :3], 0.5 * phi, rtol=1e-6, atol=0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_log_of_exact_half_turns(axis: int, sign: float) -> None:
    data = torch.zeros(1, 7, dtype=torch.float64)
    data[0, :3] = torch.tensor([1.0, 2.0, 3.0])
    data[0, 3 + axis] = sign
    log = SE3(data).log()
    assert torch.linalg.vector_norm(log[..., 3:]).item() == pytest.approx(math.pi, abs=1e-15)
    _elements_close(SE3.exp(log), SE3(data), 1e-14)


# --- quaternions --------------------------------------------------------------------------------------------------


def test_quaternions_against_scipy() -> None:
    generator = np.random.default_rng(0)
    q, r, v = generator.normal(size=(40, 4)), generator.normal(size=(40, 4)), generator.normal(size=(40, 3))
    tq, tr, tv = (torch.from_numpy(array) for array in (q, r, v))
    first, second = Rotation.from_quat(q), Rotation.from_quat(r)
    np.testing.assert_allclose(quat_to_matrix(tq).numpy(), first.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(quat_rotate(tq, tv).numpy(), first.apply(v), atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(quat_multiply(tq, tr)).numpy(), (first * second).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(quat_conjugate(tq)).numpy(), first.inv().as_matrix(), atol=1e-14)
    np.testing.assert_allclose(SO3(quat_normalize(tq)).log().numpy(), first.as_rotvec(), atol=1e-13)


@pytest.mark.parametrize("shape", [(4,), (3, 4), (2, 1, 1, 4)])
def test_quat_rotate_broadcasts(shape: tuple[int, ...]) -> None:
    q, v = torch.randn(shape, dtype=torch.float64), torch.randn(2, 5, 3, 3, dtype=torch.float64)
    expected = (quat_to_matrix(q) @ v[..., None])[..., 0]
    torch.testing.assert_close(quat_rotate(q, v), expected, rtol=0, atol=1e-14)


def test_quaternion_functions_differentiate() -> None:
    q, r = (torch.randn(3, 4, dtype=torch.float64, requires_grad=True) for _ in range(2))
    v = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    for function, inputs in [
        (quat_multiply, (q, r)),
        (quat_rotate, (q, v)),
        (quat_to_matrix, (q,)),
        (quat_normalize, (q,)),
    ]:
        assert torch.autograd.gradcheck(function, inputs)


# --- properties ---------------------------------------------------------------------------------------------------

numbers = st.floats(-4, 4, allow_nan=False, allow_subnormal=False)
se3_tangents = st.lists(numbers, min_size=6, max_size=6).map(lambda v: torch.tensor([v], dtype=torch.float64))
sim3_tangents = st.lists(numbers, min_size=7, max_size=7).map(lambda v: torch.tensor([v], dtype=torch.float64))


@settings(max_examples=100, deadline=None)
@given(se3_tangents)
def test_property_log_is_the_shortest_tangent_of_the_same_element(a: Tensor) -> None:
    x = SE3.exp(a)
    log = x.log()
    assert torch.linalg.vector_norm(log[..., 3:]).item() <= math.pi + 1e-12
    _elements_close(SE3.exp(log), x, 1e-11)


@settings(max_examples=100, deadline=None)
@given(se3_tangents, se3_tangents, se3_tangents)
def test_property_se3_is_a_group(a: Tensor, b: Tensor, c: Tensor) -> None:
    x, y, z = SE3.exp(a), SE3.exp(b), SE3.exp(c)
    _elements_close((x * y) * z, x * (y * z), 1e-12)
    _elements_close(x * y * y.inv(), x, 1e-12)


@settings(max_examples=50, deadline=None)
@given(sim3_tangents, sim3_tangents)
def test_property_sim3_is_a_group(a: Tensor, b: Tensor) -> None:
    x, y = Sim3.exp(a), Sim3.exp(b)
    _elements_close((x * y).inv(), y.inv() * x.inv(), 1e-9)
    _elements_close(Sim3.exp(x.log()), x, 1e-10)


@settings(max_examples=50, deadline=None)
@given(se3_tangents, st.integers(1, 5))
def test_property_powers_of_an_element_multiply_its_tangent(a: Tensor, count: int) -> None:
    x = product = SE3.exp(a)
    for _ in range(count - 1):
        product = product * x
    _elements_close(product, SE3.exp(count * a), 1e-11)
