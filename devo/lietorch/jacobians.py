"""Left Jacobians of the exponential map, J(a) = sum ad(a)^n / (n + 1)!, their inverses and transposes, times vectors.

SO3 and SE3 in closed form (Barfoot 2017, ch. 7; the SE3 block Q is the derivative of the SO3 Jacobian along tau), with
series below one radian; Sim3 through a matrix exponential. Plain differentiable torch; values and
derivatives are finite at zero.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache

import torch
from torch import Tensor
from torch.linalg import cross

from devo.lietorch.formulas import small_adj_transposed
from devo.lietorch.layout import SO3_LAYOUT, Layout, dot, join
from devo.lietorch.quaternion import precise_matmul

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
    theta = x.sqrt()
    imag = torch.sin(0.5 * theta) / theta
    if inverse:
        half_cot = 0.5 * torch.cos(0.5 * theta) / imag
        even = (1 - half_cot) / x
        slope = (half_cot - 0.25 / (imag * imag)) / x
        b, db = (torch.where(small, s, c) for s, c in zip(series, (even, (-slope - 2 * even) / x)))
        return -0.5, b, 0.0, db
    real = torch.cos(0.5 * theta)
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
    sign = -1.0 if transposed else 1.0  # J(a)^T = J(-a), which flips the odd terms

    def rotational(v: Tensor) -> tuple[Tensor, Tensor]:
        turned = cross(phi, v)
        return v + sign * a * turned + cross(phi, b * turned), turned

    if not layout.has_translation:
        return rotational(vector)[0]
    tau = tangent[..., :3]
    first, first_turned = rotational(vector[..., :3])
    second, second_turned = rotational(vector[..., 3:])
    v, turned = (vector[..., :3], first_turned) if transposed else (vector[..., 3:], second_turned)
    along, moved = dot(phi, tau), cross(tau, v)
    coupling = (
        sign * (a * moved + along * da * turned)
        + cross(phi, b * moved + along * db * turned)
        + cross(tau, b * turned)
    )  # fmt: skip
    return torch.cat((first, second + coupling) if transposed else (first + coupling, second), -1)


def left_jacobian_matrix(layout: Layout, tangent: Tensor) -> Tensor:
    """Left Jacobians (..., K, K) of tangents (..., K) of any size, from the exponential of [[ad, I], [0, 0]]."""
    k = layout.tangent_dim
    identity = torch.eye(k, dtype=tangent.dtype, device=tangent.device)
    small_adj = small_adj_transposed(layout, tangent.unsqueeze(-2), identity.expand(*tangent.shape[:-1], k, k))
    upper = torch.cat((small_adj, identity.expand_as(small_adj)), -1)
    return torch.linalg.matrix_exp(torch.cat((upper, torch.zeros_like(upper)), -2))[..., :k, k:]


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
