"""Left Jacobians of the exponential map, J(a) = sum ad(a)^n / (n + 1)!, their inverses and transposes, times vectors.

SO3 and SE3 in closed form (Barfoot 2017, ch. 7; the SE3 block Q is the derivative of the SO3 Jacobian along tau), with
series below one radian; Sim3 as a matrix series. Plain differentiable torch; values and
derivatives are finite at zero.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache

import torch
from torch import Tensor

from devo.lietorch.formulas import small_adj_transposed
from devo.lietorch.layout import SO3_LAYOUT, Layout, dot, join
from devo.lietorch.quaternion import cos_sin, hat, precise_matmul

_TERMS = 12  # for one radian: the forward series then ends at 1e-22, the Bernoulli series of the inverse at 1e-18
_SERIES_BELOW = 1.0  # squared angle


def _bernoulli(count: int) -> list[float]:
    """|B_2|, |B_4|, ... up to `count` numbers, from the recurrence of the Bernoulli numbers."""
    numbers = [Fraction(1)]
    for m in range(1, 2 * count + 1):
        numbers.append(-sum((math.comb(m + 1, k) * numbers[k] for k in range(m)), Fraction(0)) / (m + 1))
    return [float(abs(numbers[2 * n])) for n in range(1, count + 1)]


@lru_cache(maxsize=16)
def _series(inverse: bool, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Power series in theta^2, one column each: the even and odd coefficient of J, and their derivatives."""
    if inverse:
        bernoulli = _bernoulli(_TERMS + 1)
        even = [bernoulli[n] / math.factorial(2 * n + 2) for n in range(_TERMS + 1)]
        columns = [even]
    else:
        odd = [(-1) ** n / math.factorial(2 * n + 2) for n in range(_TERMS + 1)]
        even = [(-1) ** n / math.factorial(2 * n + 3) for n in range(_TERMS + 1)]
        columns = [odd, even]
    derived = [[2 * (n + 1) * column[n + 1] for n in range(_TERMS)] for column in columns]
    with torch.inference_mode(False), torch.no_grad():
        return torch.tensor([c[:_TERMS] for c in columns] + derived, dtype=dtype).T.contiguous().to(device)


def _evaluate_series(x: Tensor, inverse: bool) -> tuple[Tensor, ...]:
    powers = torch.cat((torch.ones_like(x), x.expand(*x.shape[:-1], _TERMS - 1)), -1).cumprod(-1)
    return precise_matmul(powers, _series(inverse, x.dtype, x.device)).split(1, -1)


def _coefficients(x: Tensor, inverse: bool) -> tuple[Tensor | float, Tensor, Tensor | float, Tensor]:
    """(a, b, a', b') of J = I + a Phi + b Phi^2 at theta^2 = `x` (..., 1), where ' is (d / d theta) / theta.

    With `inverse` those of the inverse Jacobian, for which a = -1/2 and a' = 0.
    """
    small = x < _SERIES_BELOW
    series = _evaluate_series(x.masked_fill(~small, 0.0), inverse)
    x = x.masked_fill(small, 1.0)
    theta = x * x.rsqrt()  # not Tensor.sqrt, for the reason given at cos_sin
    real, imag = cos_sin(0.5 * theta)
    imag = imag / theta
    if inverse:
        half_cot = 0.5 * real / imag
        even = (1 - half_cot) / x
        slope = (half_cot - 0.25 / (imag * imag)) / x
        b, db = (torch.where(small, s, c) for s, c in zip(series, (even, (-slope - 2 * even) / x)))
        return -0.5, b, 0.0, db
    sinc, odd = 2 * imag * real, 2 * imag * imag
    even = (1 - sinc) / x
    slope = (1 - x * odd - sinc) / x
    closed = (odd, even, (sinc - 2 * odd) / x, (-slope - 2 * even) / x)
    a, b, da, db = (torch.where(small, s, c) for s, c in zip(series, closed))
    return a, b, da, db


def _apply_se3(layout: Layout, tangent: Tensor, vector: Tensor, inverse: bool, transposed: bool) -> Tensor:
    """`left_jacobian` of SE3, whose matrix is [[J, Q], [0, J]], and of SO3, where it is J."""
    phi = layout.phi(tangent)
    a, b, da, db = _coefficients(dot(phi, phi), inverse)
    # J(a)^T = J(-a), which flips the odd terms. Products of rows with this matrix are products phi x v.
    sign = -1.0 if transposed else 1.0
    turn = hat(phi).mT
    vectors = vector.unflatten(-1, (-1, 3))
    turned = precise_matmul(vectors, turn)
    rotational = vectors + sign * _per_row(a) * turned + precise_matmul(_per_row(b) * turned, turn)
    if not layout.has_translation:
        return rotational.squeeze(-2)
    # The off-diagonal block takes its input from one half and adds its output to the other.
    source = slice(0, 1) if transposed else slice(1, 2)
    shift = hat(tangent[..., :3]).mT
    moved, turned = precise_matmul(vectors[..., source, :], shift), turned[..., source, :]
    along = dot(phi, tangent[..., :3])
    coupling = (
        sign * (_per_row(a) * moved + _per_row(along * da) * turned)
        + precise_matmul(_per_row(b) * moved + _per_row(along * db) * turned, turn)
        + precise_matmul(_per_row(b) * turned, shift)
    )
    first, second = rotational.split(1, -2)
    parts = (first, second + coupling) if transposed else (first + coupling, second)
    return torch.cat(parts, -2).flatten(-2)


def _per_row(coefficient: Tensor | float) -> Tensor | float:
    return coefficient if isinstance(coefficient, float) else coefficient.unsqueeze(-1)


def left_jacobian_matrix(layout: Layout, tangent: Tensor) -> Tensor:
    """Left Jacobians (..., K, K) of tangents (..., K) of any size: the series of a fraction A of ad, doubled again.

    Doubling is J(2A) = J(A) (I + A J(A) / 2), which follows from exp(2A) - 1 = (exp(A) - 1)(exp(A) + 1).
    """
    k = layout.tangent_dim
    identity = torch.eye(k, dtype=tangent.dtype, device=tangent.device)
    small_adj = small_adj_transposed(layout, tangent.unsqueeze(-2), identity.expand(*tangent.shape[:-1], k, k))
    size = float(small_adj.detach().abs().sum(-1).max()) if small_adj.numel() else 0.0
    doublings = max(0, math.ceil(math.log2(size / 0.5))) if 0.5 < size < math.inf else 0
    fraction = small_adj * 0.5**doublings
    jacobian = identity.expand_as(fraction)
    for n in range(_TERMS + 2, 1, -1):
        jacobian = identity + precise_matmul(fraction, jacobian) / n
    for _ in range(doublings):
        jacobian = jacobian + precise_matmul(precise_matmul(jacobian, fraction), jacobian) / 2
        fraction = fraction * 2
    return jacobian


def left_jacobian(
    layout: Layout, tangent: Tensor, vector: Tensor, inverse: bool = False, transposed: bool = False
) -> Tensor:
    """J(a) v, J(a)^-1 v, J(a)^T v or J(a)^-T v for tangents `a` and vectors `v`, both (..., K)."""
    if not layout.has_scale:
        return _apply_se3(layout, tangent, vector, inverse, transposed)
    if not layout.has_translation:
        rotation = _apply_se3(SO3_LAYOUT, tangent[..., :3], vector[..., :3], inverse, transposed)
        return join([rotation, vector[..., 3:].expand(*rotation.shape[:-1], 1)])
    jacobian = left_jacobian_matrix(layout, tangent)
    jacobian = jacobian.mT if transposed else jacobian
    if inverse:
        return torch.linalg.solve(jacobian, vector.unsqueeze(-1)).squeeze(-1)
    return precise_matmul(jacobian, vector.unsqueeze(-1)).squeeze(-1)
