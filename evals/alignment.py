"""Similarity and rigid transforms that bring one set of points onto another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devo.errors import InputError

_COLLINEAR = 1e-12  # ratio of the covariance's singular values: a micrometre of sideways spread on a metre


@dataclass(frozen=True, eq=False)
class Similarity:
    """`target = scale * rotation @ source + translation`.

    Attributes:
        scale: positive, 1 for a rigid transform.
        rotation: `(3, 3)` float64 with determinant +1.
        translation: `(3,)` float64 in the unit of the target.
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Source points `(..., 3)` in the target's frame, float64."""
        return self.scale * np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def matrix(self) -> np.ndarray:
        """`(4, 4)` float64; the upper left block is scale times rotation."""
        result = np.eye(4)
        result[:3, :3] = self.scale * self.rotation
        result[:3, 3] = self.translation
        return result

    def angle_deg(self) -> float:
        """Rotation angle in degrees, 0..180."""
        sine = np.linalg.norm(self.rotation - self.rotation.T) / np.sqrt(8)
        return float(np.degrees(np.arctan2(sine, (np.trace(self.rotation) - 1) / 2)))


def umeyama_sim3(source: np.ndarray, target: np.ndarray, with_scale: bool = True) -> Similarity:
    """The similarity that minimises the sum of squared distances between paired points (Umeyama, PAMI 1991).

    The rotation never mirrors: for mirrored points the best proper rotation is returned. Points in a plane determine
    it uniquely. Points on one line leave the turn about the line open; then the smallest rotation that brings line
    onto line is returned (a half turn about some perpendicular axis where the directions are opposite).

    Args:
        source: `(N, 3)`, any unit.
        target: `(N, 3)`, row i belongs to row i of `source`.
        with_scale: estimate the scale too; otherwise it is 1.

    Raises:
        InputError: shapes differ, fewer than 3 pairs, values that are not finite, or no direction in common because
            all points of one set coincide or the sets are uncorrelated.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise InputError(f"alignment needs two arrays of one shape (N, 3), found {source.shape} and {target.shape}")
    if len(source) < 3:
        raise InputError(f"alignment needs at least 3 pairs of points, found {len(source)}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise InputError("alignment needs finite points; remove rows with NaN or infinity from both sets")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centered, wanted = source - source_mean, target - target_mean
    left, singular, right_t = np.linalg.svd(wanted.T @ centered)
    spread = np.linalg.norm(centered) * np.linalg.norm(wanted)
    if not singular[0] > _COLLINEAR * spread:
        raise InputError("alignment is undetermined: all points of one set coincide, or the two sets are uncorrelated")
    if singular[1] <= _COLLINEAR * singular[0]:
        rotation = _smallest_rotation(right_t[0], left[:, 0])
    else:
        left[:, 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right_t))
        rotation = left @ right_t
    # trace(D S) of Umeyama's eq. 42, written so that it holds for the collinear choice as well
    scale = float(np.sum(wanted * (centered @ rotation.T)) / np.sum(centered**2)) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def _smallest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation by the smallest angle that turns the unit vector `start` into `end`."""
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -1 + 1e-12:
        across = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        across /= np.linalg.norm(across)
        return 2 * np.outer(across, across) - np.eye(3)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def aligned_path_share(source: np.ndarray, target: np.ndarray) -> tuple[float, float, Similarity]:
    """How far two paths differ once the first is aligned to the second (Sim3).

    Args:
        source, target: `(N, 3)` paired positions.

    Returns:
        Rms distance over the length of the target (NaN where that is 0), the length, and the alignment.

    Raises:
        InputError: as `umeyama_sim3`.
    """
    alignment = umeyama_sim3(source, target)
    error = np.linalg.norm(alignment.apply(source) - target, axis=1)
    length = float(np.linalg.norm(np.diff(target, axis=0), axis=1).sum())
    share = float(np.sqrt((error * error).mean())) / length if length > 0 else float("nan")
    return share, length, alignment
