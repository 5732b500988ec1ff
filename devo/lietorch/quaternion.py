"""Hamilton quaternions, scalar last (x, y, z, w): plain torch, broadcasting, differentiable.

Every bilinear formula is one outer product times one constant table: for the small batches of an odometry the time
of a call is the number of torch operations in it, not the arithmetic. Products run outside autocast: poses never become
half precision.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

# Row 4 * i + j of a table belongs to the product q_i * r_j.
_HAMILTON = (
    # x = x1 w2 + w1 x2 + y1 z2 - z1 y2, and so on
    ((0, 3, 1), (3, 0, 1), (1, 2, 1), (2, 1, -1)),
    ((1, 3, 1), (3, 1, 1), (2, 0, 1), (0, 2, -1)),
    ((2, 3, 1), (3, 2, 1), (0, 1, 1), (1, 0, -1)),
    ((3, 3, 1), (0, 0, -1), (1, 1, -1), (2, 2, -1)),
)
# The 4x4 matrix |q|^2 * [[R, 0], [0, 1]], entry by entry.
_SQUARED_NORM = ((0, 0, 1), (1, 1, 1), (2, 2, 1), (3, 3, 1))
_ROTATION = (
    ((3, 3, 1), (0, 0, 1), (1, 1, -1), (2, 2, -1)), ((0, 1, 2), (2, 3, -2)), ((0, 2, 2), (1, 3, 2)), (),
    ((0, 1, 2), (2, 3, 2)), ((3, 3, 1), (1, 1, 1), (0, 0, -1), (2, 2, -1)), ((1, 2, 2), (0, 3, -2)), (),
    ((0, 2, 2), (1, 3, -2)), ((1, 2, 2), (0, 3, 2)), ((3, 3, 1), (2, 2, 1), (0, 0, -1), (1, 1, -1)), (),
    (), (), (), _SQUARED_NORM,
)  # fmt: skip


@lru_cache(maxsize=32)
def _table(entries: tuple[tuple[tuple[int, int, int], ...], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    # Made outside inference mode, because a tensor made inside could never be saved for a later backward pass.
    with torch.inference_mode(False), torch.no_grad():
        table = torch.zeros(16, len(entries), dtype=dtype)
        for column, terms in enumerate(entries):
            for first, second, factor in terms:
                table[4 * first + second, column] += factor
        return table.to(device)


@lru_cache(maxsize=32)
def _hat_table(dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False), torch.no_grad():
        rows = [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]]
        return torch.tensor(rows, dtype=dtype, device=device)


@lru_cache(maxsize=32)
def _conjugation(dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False), torch.no_grad():
        return torch.tensor([-1.0, -1.0, -1.0, 1.0], dtype=dtype, device=device)


def precise_matmul(a: Tensor, b: Tensor) -> Tensor:
    """Matrix product that autocast leaves alone; same shapes and errors as `torch.matmul`."""
    if torch.is_autocast_enabled(a.device.type):
        with torch.autocast(a.device.type, enabled=False):
            return torch.matmul(a, b)
    return torch.matmul(a, b)


def apply_matrix(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix times vector, broadcasting the batch dimensions without repeating matrices in memory.

    `matrix` (..., n, m), `vector` (..., m) with as many batch dimensions; result (..., n).
    """
    batch = matrix.dim() - 2
    shared = 0  # trailing batch dimensions in which all vectors share one matrix
    while shared < batch and matrix.shape[batch - 1 - shared] == 1:
        shared += 1
    if shared == 0 or vector.dim() - 1 != batch:
        return precise_matmul(matrix, vector.unsqueeze(-1)).squeeze(-1)
    lead = batch - shared
    rows = vector.flatten(lead, -2)
    out = precise_matmul(rows, matrix.reshape(*matrix.shape[:lead], *matrix.shape[-2:]).mT)
    return out if shared == 1 else out.reshape(*out.shape[:lead], *vector.shape[lead:-1], out.shape[-1])


def cos_sin(angle: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine of angles in radians.

    One complex operation, because `Tensor.cos`, `sin`, `sqrt` and `atan` start threads for as few as a hundred numbers
    on CPUs with MKL, which costs milliseconds per call on a busy machine.
    """
    pair = torch.polar(torch.ones_like(angle), angle)
    return pair.real, pair.imag


def hat(a: Tensor) -> Tensor:
    """Matrices (..., 3, 3) with hat(a) b = a x b, of vectors `a` (..., 3)."""
    return precise_matmul(a, _hat_table(a.dtype, a.device)).unflatten(-1, (3, 3))


def quat_multiply(q: Tensor, r: Tensor) -> Tensor:
    """Hamilton product q r of quaternions `q`, `r` (..., 4) xyzw; result (..., 4), not normalised."""
    outer = q.unsqueeze(-1) * r.unsqueeze(-2)
    return precise_matmul(outer.flatten(-2), _table(_HAMILTON, outer.dtype, outer.device))


def quat_conjugate(q: Tensor) -> Tensor:
    """Conjugate of quaternions `q` (..., 4) xyzw, which is the inverse rotation."""
    return q * _conjugation(q.dtype, q.device)


def quat_normalize(q: Tensor) -> Tensor:
    """Quaternions `q` (..., 4) scaled to unit length; a zero quaternion gives NaN, because it is no rotation."""
    return q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)


def quat_to_matrix4(q: Tensor) -> Tensor:
    """Homogeneous rotation matrices (..., 4, 4) of quaternions `q` (..., 4) xyzw of any non-zero length."""
    outer = q.unsqueeze(-1) * q.unsqueeze(-2)
    flat = precise_matmul(outer.flatten(-2), _table(_ROTATION, q.dtype, q.device))
    return (flat / flat[..., 15:]).unflatten(-1, (4, 4))


def quat_to_matrix(q: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions `q` (..., 4) xyzw of any non-zero length."""
    return quat_to_matrix4(q)[..., :3, :3]


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors `v` (..., 3) rotated by quaternions `q` (..., 4) xyzw of any non-zero length; result (..., 3)."""
    while q.dim() < v.dim():
        q = q.unsqueeze(0)
    return apply_matrix(quat_to_matrix(q), v)
