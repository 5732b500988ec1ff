"""Closed formulas of the group operations (Sola et al. 2018; Strasdat 2012 for Sim3), on plain tensors.

Elements (..., N) and tangents (..., K) as in `layout`; all operands of a call have the same number of batch dimensions,
and size 1 broadcasts. Quaternions of any non-zero length are accepted, results are unit quaternions. Nothing here is
meant for autograd: gradients of elements are tangent vectors, see `autograd`. The forms stay accurate at small angles
down to exactly zero, because each quotient that loses digits is multiplied by what it was divided by.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.linalg import cross

from devo.lietorch.layout import Layout, dot, join
from devo.lietorch.quaternion import (
    apply_matrix,
    cos_sin,
    precise_matmul,
    quat_conjugate,
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    quat_to_matrix4,
)

# Far above the smallest float32 (so that quotients stay exact), far below what matters in float64.
TINY = 1e-36


def matrix(layout: Layout, data: Tensor) -> Tensor:
    """Matrices [[sR, t], [0, 1]] (..., 4, 4) of elements."""
    out = quat_to_matrix4(layout.quaternion(data))
    if layout.has_scale:
        out[..., :3, :3] *= layout.scale(data).unsqueeze(-1)
    if layout.has_translation:
        out[..., :3, 3] = layout.translation(data)
    return out


def exp(layout: Layout, tangent: Tensor) -> Tensor:
    """Exponential map: tangents (..., K) to elements (..., N)."""
    phi = layout.phi(tangent)
    theta = torch.linalg.vector_norm(phi, dim=-1, keepdim=True)
    theta2 = theta * theta
    imag = torch.sinc(theta * (0.5 / math.pi)) * 0.5  # sin(theta / 2) / theta
    real, _ = cos_sin(theta * 0.5)
    parts = [imag * phi, real]
    scale = tangent[..., -1:].exp() if layout.has_scale else None
    if layout.has_translation:
        tau = tangent[..., :3]
        sinc, half_versine = 2 * imag * real, 2 * imag * imag  # sin(theta) / theta, (1 - cos(theta)) / theta^2
        if scale is None:
            along = (1 - sinc) / theta2.clamp_min(TINY)
            moved = sinc * tau + half_versine * cross(phi, tau) + along * dot(phi, tau) * phi
        else:
            straight, turn, axis = _phi1(tangent[..., -1:], scale, theta2, sinc, half_versine)
            along = (axis - straight) / theta2.clamp_min(TINY)
            moved = straight * tau + turn * cross(phi, tau) + along * dot(phi, tau) * phi
        parts.insert(0, moved)
    if scale is not None:
        parts.append(scale)
    return join(parts)


def _phi1(
    sigma: Tensor, scale: Tensor, theta2: Tensor, sinc: Tensor, half_versine: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Real part, imaginary part / theta of f(z) = (e^z - 1) / z at z = sigma + i theta, and f(sigma).

    These are the eigenvalues of the Sim3 matrix W = sum (Phi + sigma I)^n / (n + 1)! across and along the axis.
    """
    grown = torch.expm1(sigma)
    square = sigma * sigma + theta2
    at_zero = square < TINY
    safe = square.masked_fill(at_zero, 1.0)
    real = grown * (1 - theta2 * half_versine) - theta2 * half_versine  # Re(e^z - 1)
    straight = ((real * sigma + scale * sinc * theta2) / safe).masked_fill(at_zero, 1.0)
    turn = ((scale * sinc * sigma - real) / safe).masked_fill(at_zero, 0.5)
    no_growth = sigma.abs() < TINY
    axis = (grown / sigma.masked_fill(no_growth, 1.0)).masked_fill(no_growth, 1.0)
    return straight, turn, axis


def log(layout: Layout, data: Tensor) -> Tensor:
    """Logarithm: elements (..., N) to tangents (..., K) with |phi| <= pi; q and -q give the same result."""
    q = layout.quaternion(data)
    vector, w = q[..., :3], q[..., 3:]
    length = torch.linalg.vector_norm(vector, dim=-1, keepdim=True).clamp_min(TINY)
    half = torch.atan2(length.copysign(w), w.abs())  # atan(length / w), with a right angle at w = 0
    per_length = half / length
    phi = 2 * per_length * vector
    parts = [phi]
    if layout.has_translation:
        t = layout.translation(data)
        theta2 = (4 * half * half).clamp_min(TINY)
        half_cot = per_length * w  # (theta / 2) cot(theta / 2)
        if layout.has_scale:
            straight, turn, axis = _inverse_phi1(layout.scale(data), half, theta2)
        else:
            straight, turn, axis = half_cot, torch.full_like(half_cot, -0.5), torch.ones_like(half_cot)
        along = (axis - straight) / theta2
        parts.insert(0, straight * t + turn * cross(phi, t) + along * dot(phi, t) * phi)
    if layout.has_scale:
        parts.append(layout.scale(data).log())
    return join(parts)


def _inverse_phi1(scale: Tensor, half: Tensor, theta2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As `_phi1` for 1 / f(z), which belongs to the inverse of W."""
    imag = 0.5 * torch.sinc(half / math.pi)
    straight, turn, axis = _phi1(scale.log(), scale, theta2, 2 * imag * cos_sin(half)[0], 2 * imag * imag)
    size = straight * straight + theta2 * turn * turn
    return straight / size, -turn / size, 1 / axis


def inv(layout: Layout, data: Tensor) -> Tensor:
    """Inverse elements."""
    q = quat_conjugate(quat_normalize(layout.quaternion(data)))
    if layout.element_dim == 4:
        return q
    parts = [q]
    inverse_scale = 1 / layout.scale(data) if layout.has_scale else None
    if layout.has_translation:
        t = apply_matrix(quat_to_matrix(q), layout.translation(data)).neg()
        parts.insert(0, t if inverse_scale is None else t * inverse_scale)
    if inverse_scale is not None:
        parts.append(inverse_scale)
    return join(parts)


def mul(layout: Layout, x: Tensor, y: Tensor) -> Tensor:
    """Products x y of elements: first y, then x."""
    q = layout.quaternion(x)
    parts = [quat_normalize(quat_multiply(q, layout.quaternion(y)))]
    if layout.has_translation:
        t = apply_matrix(quat_to_matrix(q), layout.translation(y))
        if layout.has_scale:
            t = t * layout.scale(x)
        parts.insert(0, t + layout.translation(x))
    if layout.has_scale:
        parts.append(layout.scale(x) * layout.scale(y))
    return join(parts)


def act(layout: Layout, element_matrix: Tensor, points: Tensor) -> Tensor:
    """Points (..., 3), or homogeneous points (..., 4), moved by the matrices (..., 4, 4) of elements."""
    if points.shape[-1] == 4:
        return apply_matrix(element_matrix, points)
    moved = apply_matrix(element_matrix[..., :3, :3], points)
    return moved + element_matrix[..., :3, 3] if layout.has_translation else moved


def act_gradient(layout: Layout, moved: Tensor, grad: Tensor, homogeneous: Tensor | float) -> Tensor:
    """Left-tangent gradient (..., K) of moved points (..., 3), whose gradient and fourth coordinate are given."""
    parts = [cross(moved, grad)]
    if layout.has_translation:
        parts.insert(0, grad * homogeneous)
    if layout.has_scale:
        parts.append(dot(moved, grad))
    return join(parts)


def _rotate_tangent(rotation: Tensor, layout: Layout, tangent: Tensor) -> tuple[Tensor, ...]:
    """Every 3-vector of the tangents (..., K) rotated; one product for all of them."""
    vectors = 2 if layout.has_translation else 1
    rows = tangent[..., : 3 * vectors].unflatten(-1, (vectors, 3))
    return precise_matmul(rows, rotation.mT).unbind(-2)


def adj(layout: Layout, x: Tensor, tangent: Tensor) -> Tensor:
    """Ad(x) a: the tangents `a` (..., K) moved from the right of x to its left, x exp(a) = exp(Ad(x) a) x."""
    *tau, phi = _rotate_tangent(quat_to_matrix(layout.quaternion(x)), layout, tangent)
    parts = [phi]
    sigma = tangent[..., -1:]
    if layout.has_translation:
        t = layout.translation(x)
        moved = tau[0] * layout.scale(x) - t * sigma if layout.has_scale else tau[0]
        parts.insert(0, moved + cross(t, phi))
    if layout.has_scale:
        parts.append(sigma.expand(*phi.shape[:-1], 1))
    return join(parts)


def adj_transposed(layout: Layout, x: Tensor, tangent: Tensor) -> Tensor:
    """Ad(x)^T a for tangents `a` (..., K)."""
    sigma = tangent[..., -1:]
    if layout.has_translation:
        t, tau = layout.translation(x), tangent[..., :3]
        tangent = torch.cat(torch.broadcast_tensors(tau, tangent[..., 3:6] - cross(t, tau)), -1)
        sigma = sigma - dot(t, tau) if layout.has_scale else sigma
    *moved, phi = _rotate_tangent(quat_to_matrix(layout.quaternion(x)).mT, layout, tangent)
    parts = [phi]
    if layout.has_translation:
        parts.insert(0, moved[0] * layout.scale(x) if layout.has_scale else moved[0])
    if layout.has_scale:
        parts.append(sigma.expand(*phi.shape[:-1], 1))
    return join(parts)


def small_adj_transposed(layout: Layout, generator: Tensor, tangent: Tensor) -> Tensor:
    """ad(xi)^T a: transposed derivative of Ad(exp(xi)) at zero, for tangents `xi` and `a` (..., K)."""
    phi = layout.phi(generator)
    parts = [cross(layout.phi(tangent), phi)]
    if layout.has_translation:
        tau, a_tau = generator[..., :3], tangent[..., :3]
        moved = cross(a_tau, phi)
        if layout.has_scale:
            moved = moved + generator[..., -1:] * a_tau
        parts = [moved, parts[0] + cross(a_tau, tau)]
        if layout.has_scale:
            parts.append(-dot(tau, a_tau))
    elif layout.has_scale:
        parts.append(torch.zeros_like(parts[0][..., :1]))
    return join(parts)
