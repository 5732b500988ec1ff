"""Ground truth of preprocessed recordings: tables of stamped poses, and from the tracked body to the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.trajectory_io import quaternions, rotation_matrices

Floats = npt.NDArray[np.float64]


def rigid(rows: list[list[float]]) -> Floats:
    """Return the 4x4 matrix of three rows of four numbers."""
    return np.vstack([np.array(rows, np.float64), [0.0, 0.0, 0.0, 1.0]])


def times_transform(world_T_body: npt.ArrayLike, body_T_cam: npt.ArrayLike) -> Floats:  # noqa: N803
    """Return camera poses (N, 7) `tx ty tz qx qy qz qw` from body poses (N, 7) and one constant 4x4 transform."""
    poses, offset = np.asarray(world_T_body, np.float64), np.asarray(body_T_cam, np.float64)
    rotations = rotation_matrices(poses[:, 3:])
    return np.concatenate([rotations @ offset[:3, 3] + poses[:, :3], quaternions(rotations @ offset[:3, :3])], axis=1)


def read_pose_table(path: Path, header_lines: int = 0) -> Floats:
    """Read `t tx ty tz qx qy qz qw` per line, (N, 8) float64 in the units of the file, quaternions normalised.

    Args:
        path: text; lines that begin with `#` are skipped.
        header_lines: lines at the start to skip, whatever they hold.

    Raises:
        InputError: the file is missing or empty, a line is no pose, or stamps run backwards.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file, expected poses") from None
    rows: list[Any] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if number <= header_lines or not words or words[0].startswith("#"):
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            raise InputError(f"{path}: line {number}: {line[:60]!r} is no pose, expected numbers") from None
        if len(words) != 8:
            raise InputError(f"{path}: line {number} has {len(words)} columns, expected t tx ty tz qx qy qz qw")
    return checked_poses(np.array(rows, np.float64).reshape(-1, 8), str(path))


def checked_poses(table: Floats, source: str) -> Floats:
    """Return a table (N, 8) of stamped poses with unit quaternions.

    Raises:
        InputError: no poses, values that are not finite, stamps that run backwards, or no unit quaternions.
    """
    if not len(table):
        raise InputError(f"{source}: no poses")
    norm = np.linalg.norm(table[:, 4:], axis=1)
    bad = ~np.isfinite(table).all(axis=1) | ~(np.abs(norm - 1.0) < 0.05)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{source}: pose {row} is {table[row].tolist()}, expected finite numbers and a unit "
                         "quaternion")
    if np.any(np.diff(table[:, 0]) < 0):
        row = int(np.argmax(np.diff(table[:, 0]) < 0)) + 1
        raise InputError(f"{source}: the stamp of pose {row} is earlier than the one before")
    table = table.copy()
    table[:, 4:] /= norm[:, None]
    return table
