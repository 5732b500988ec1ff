"""Poses as 7-vectors `tx ty tz qx qy qz qw`: the one place that turns them around and into matrices.

Inside `devo/` poses are world to camera (`cam_T_world`), everything that leaves is camera to world (`world_T_cam`).
`a_T_b` maps coordinates of b to coordinates of a.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from devo.errors import InputError
from devo.lietorch import SE3

FloatArray = NDArray[np.float64]

_SHORTEST_QUATERNION = 1e-6  # shorter ones are no rounded unit quaternions but missing data
_ROTATION_TOLERANCE = 1e-3  # of R R^T - I; float32 files reach 1e-6, matrices printed with four digits 1e-4


def world_T_cam_from_cam_T_world(poses: Tensor) -> Tensor:  # noqa: N802 - frames as in all names of poses
    """Inverse poses: `poses` (..., 7) float32 or float64, world to camera; result (..., 7), camera to world.

    Differentiable with ordinary gradients. Raises `InputError` for another last dimension or dtype.
    """
    return SE3.InitFromVec(poses).inv().vec()


def cam_T_world_from_world_T_cam(poses: Tensor) -> Tensor:  # noqa: N802
    """The same inversion under the name of the other direction."""
    return world_T_cam_from_cam_T_world(poses)


def relative_pose(world_T_a: Tensor, world_T_b: Tensor) -> Tensor:
    """`a_T_b` = world_T_a^-1 world_T_b of poses (..., 7) with the same number of dimensions; differentiable."""
    return (SE3.InitFromVec(world_T_a).inv() * SE3.InitFromVec(world_T_b)).vec()


def normalize_poses_numpy(poses: Any) -> FloatArray:
    """Poses (..., 7) as float64 with unit quaternions.

    Raises `InputError` for another last dimension, numbers that are not finite and quaternions of length zero.
    """
    array: FloatArray = np.array(np.asarray(poses), dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 7:
        raise InputError(f"found poses of shape {array.shape}, expected (..., 7): tx ty tz qx qy qz qw")
    _check_finite(array, 1, "pose")
    length = np.linalg.norm(array[..., 3:], axis=-1, keepdims=True)
    if np.any(length < _SHORTEST_QUATERNION):
        row = int(np.argmax(length.reshape(-1) < _SHORTEST_QUATERNION))
        raise InputError(f"found a quaternion of length zero in pose {row}, expected unit quaternions qx qy qz qw")
    array[..., 3:] /= length
    return array


def invert_poses_numpy(poses: Any) -> FloatArray:
    """Inverse poses (..., 7) in float64, world to camera from camera to world or the reverse.

    Raises `InputError` as `normalize_poses_numpy`.
    """
    array = normalize_poses_numpy(poses)
    rotation = _quaternion_to_rotation(array[..., 3:])
    array[..., :3] = -np.einsum("...ji,...j->...i", rotation, array[..., :3])
    array[..., 3:6] *= -1
    return array


def pose_to_matrix(poses: Any) -> FloatArray:
    """Homogeneous matrices (..., 4, 4) float64 of poses (..., 7); raises `InputError` as `normalize_poses_numpy`."""
    array = normalize_poses_numpy(poses)
    matrices = np.zeros((*array.shape[:-1], 4, 4))
    matrices[..., :3, :3] = _quaternion_to_rotation(array[..., 3:])
    matrices[..., :3, 3] = array[..., :3]
    matrices[..., 3, 3] = 1
    return matrices


def matrix_to_pose(matrices: Any) -> FloatArray:
    """Poses (..., 7) float64 with qw >= 0 of homogeneous matrices (..., 4, 4), half turns included (Shepperd 1978).

    Raises `InputError` for other shapes, numbers that are not finite, and matrices that are no rigid motion.
    """
    array: FloatArray = np.asarray(matrices, dtype=np.float64)
    if array.ndim < 2 or array.shape[-2:] != (4, 4):
        raise InputError(f"found matrices of shape {array.shape}, expected (..., 4, 4)")
    _check_finite(array, 2, "matrix")
    rotation = array[..., :3, :3]
    error = np.abs(np.einsum("...ij,...kj->...ik", rotation, rotation) - np.eye(3)).max(axis=(-2, -1))
    bottom = np.abs(array[..., 3, :] - [0, 0, 0, 1]).max(axis=-1)
    wrong = (error > _ROTATION_TOLERANCE) | (bottom > _ROTATION_TOLERANCE) | (np.linalg.det(rotation) < 0)
    if np.any(wrong):
        row = int(np.argmax(np.ravel(wrong)))
        raise InputError(
            f"found matrix {row} that is no rigid motion (scaled, mirrored, or its last row is not 0 0 0 1), "
            "expected [[R, t], [0, 1]]"
        )
    return np.concatenate((array[..., :3, 3], _rotation_to_quaternion(rotation)), axis=-1)


def _check_finite(array: FloatArray, item_dims: int, what: str) -> None:
    bad = ~np.isfinite(array).all(axis=tuple(range(-item_dims, 0)))
    if np.any(bad):
        row = int(np.argmax(np.ravel(bad)))
        raise InputError(f"found numbers that are not finite in {what} {row}, expected finite poses; remove such rows")


def _quaternion_to_rotation(q: FloatArray) -> FloatArray:
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rotation_to_quaternion(rotation: FloatArray) -> FloatArray:
    """The column of 4 q q^T that belongs to the largest component: it never divides by something small."""
    r = rotation
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    xw, yw, zw = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    columns = np.stack(
        [
            np.stack([1 + xx - yy - zz, xy, xz, xw], axis=-1),
            np.stack([xy, 1 - xx + yy - zz, yz, yw], axis=-1),
            np.stack([xz, yz, 1 - xx - yy + zz, zw], axis=-1),
            np.stack([xw, yw, zw, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.stack([columns[..., i, i] for i in range(4)], axis=-1), axis=-1)
    q = np.take_along_axis(columns, largest[..., None, None], axis=-2)[..., 0, :]
    q = np.where(q[..., 3:] < 0, -q, q)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
