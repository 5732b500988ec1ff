"""From the body that a tracking system follows to the camera."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from utils.trajectory_io import quaternions, rotation_matrices

Floats = npt.NDArray[np.float64]


def rigid(rows: npt.ArrayLike) -> Floats:
    """Return the 4x4 matrix of three rows of four numbers (or of the twelve numbers in a row)."""
    return np.vstack([np.asarray(rows, np.float64).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def times_transform(world_T_body: npt.ArrayLike, body_T_cam: npt.ArrayLike) -> Floats:
    """Return camera poses (N, 7) `tx ty tz qx qy qz qw` from body poses (N, 7) and one constant 4x4 transform."""
    poses, offset = np.asarray(world_T_body, np.float64), np.asarray(body_T_cam, np.float64)
    rotations = rotation_matrices(poses[:, 3:])
    return np.concatenate([rotations @ offset[:3, 3] + poses[:, :3], quaternions(rotations @ offset[:3, :3])], axis=1)


def inverse(transform: npt.ArrayLike) -> Floats:
    """Return the inverse of a 4x4 transform."""
    return np.asarray(np.linalg.inv(np.asarray(transform, np.float64)), np.float64)
