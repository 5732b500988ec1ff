"""Camera trajectories and their files: TUM text, KITTI text, EuRoC CSV, NPY.

Every pose that is written or returned here is camera to world (`world_T_cam`); `inverted` converts.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NoReturn

import numpy as np

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.clouds.arrays import load_array

_UNITS = {"s": Decimal(1_000_000), "ms": Decimal(1_000), "us": Decimal(1), "ns": Decimal("0.001")}
_LATEST_US = 2**62  # what int64 holds, with room for differences
QUATERNION_TOLERANCE = 1e-2
"""How far from 1 the norm of a quaternion may be to count as one that was rounded when it was printed."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Time-stamped camera poses.

    Attributes:
        t_us: `(T,)` int64 or float64 microseconds, strictly increasing.
        world_T_cam: `(T, 7)` float64 camera-to-world `tx ty tz qx qy qz qw`, unit quaternions (normalised here).

    Raises:
        InputError: other shapes, values that are not finite, stamps that do not increase, or a quaternion whose norm
            differs from 1 by more than `QUATERNION_TOLERANCE`.
    """

    t_us: np.ndarray
    world_T_cam: np.ndarray  # noqa: N815 - the frame notation of the project

    def __post_init__(self) -> None:
        stamps, poses = np.asarray(self.t_us), np.array(self.world_T_cam, dtype=np.float64)
        if stamps.ndim != 1 or stamps.dtype.kind not in "iuf":
            raise InputError(f"t_us must be an array of shape (T,), found {stamps.dtype} of shape {stamps.shape}")
        if poses.shape != (len(stamps), 7):
            raise InputError(f"world_T_cam must have shape ({len(stamps)}, 7), found {poses.shape}")
        stamps = stamps.astype(np.float64 if stamps.dtype.kind == "f" else np.int64)
        bad = np.flatnonzero(~(np.isfinite(poses).all(axis=1) & np.isfinite(stamps)))
        if len(bad):
            raise InputError(f"pose {bad[0]} is not finite: {stamps[bad[0]]} {poses[bad[0]]}")
        bad = np.flatnonzero(np.diff(stamps) <= 0)
        if len(bad):
            raise InputError(f"stamps must increase, found {stamps[bad[0]]} us followed by {stamps[bad[0] + 1]} us "
                             f"at pose {bad[0] + 1}; sort the poses and drop repeated stamps")
        norm = np.linalg.norm(poses[:, 3:], axis=1)
        bad = np.flatnonzero(np.abs(norm - 1) > QUATERNION_TOLERANCE)
        if len(bad):
            raise InputError(f"pose {bad[0]} has a quaternion of norm {norm[bad[0]]:.6g}, expected 1; columns are "
                             "tx ty tz qx qy qz qw")
        poses[:, 3:] /= norm[:, None]
        object.__setattr__(self, "t_us", stamps)
        object.__setattr__(self, "world_T_cam", poses)

    def __len__(self) -> int:
        return len(self.t_us)

    def path_length(self) -> float:
        """Sum of the distances between successive camera centres, in the trajectory's unit."""
        return float(np.linalg.norm(np.diff(self.world_T_cam[:, :3], axis=0), axis=1).sum())

    def matrices(self) -> np.ndarray:
        """`(T, 4, 4)` float64 camera-to-world matrices."""
        result = np.tile(np.eye(4), (len(self), 1, 1))
        result[:, :3, :3] = rotation_matrices(self.world_T_cam[:, 3:])
        result[:, :3, 3] = self.world_T_cam[:, :3]
        return result


def rotation_matrices(quat_xyzw: np.ndarray) -> np.ndarray:
    """`(..., 3, 3)` rotation matrices of unit quaternions `(..., 4)` with the scalar last."""
    x, y, z, w = np.moveaxis(np.asarray(quat_xyzw, dtype=np.float64), -1, 0)
    return np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ], axis=-1).reshape(*x.shape, 3, 3)


def inverted(poses: np.ndarray) -> np.ndarray:
    """The inverse of each pose, `(T, 7)` float64: camera-to-world from world-to-camera and the other way round."""
    poses = np.asarray(poses, dtype=np.float64)
    quaternion = poses[:, 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    translation = -np.einsum("tij,tj->ti", rotation_matrices(quaternion), poses[:, :3])
    return np.concatenate([translation, quaternion], axis=1)


def write_tum(path: str | os.PathLike[str], trajectory: Trajectory, *, comments: Sequence[str] = ()) -> None:
    """Write TUM text: seconds and `tx ty tz qx qy qz qw`, camera to world, under comment lines that say so.

    Whole microseconds get six decimals and come back exactly, whatever the epoch; other stamps get nine (whole
    nanoseconds). Poses have 17 significant digits, which give a float64 back exactly.

    Args:
        path: text file, written completely or not at all.
        trajectory: any unit of length.
        comments: further lines for the head of the file, for example what the unit of length is.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = ["# camera-to-world poses, OpenCV camera axes (x right, y down, z forward), quaternion scalar last"]
    lines += [f"# {line}" for comment in comments for line in comment.splitlines()]
    lines.append("# timestamp[s] tx ty tz qx qy qz qw")
    for stamp, pose in zip(_seconds(trajectory.t_us), trajectory.world_T_cam.tolist()):
        lines.append(" ".join([stamp, *(f"{value:.17g}" for value in pose)]))
    _write_lines(path, lines)


def read_tum(path: str | os.PathLike[str], *, time_unit: str = "s", skip_lines: int = 0,
             skip_repeated: bool = False) -> Trajectory:
    """Read TUM text strictly: eight finite numbers a line, stamps increasing, unit quaternions.

    Stamps are parsed as decimals. They come back as int64 where all are whole microseconds up to the resolution
    that float64 seconds have at that epoch, otherwise as float64.

    Args:
        path: text; lines that begin with `#` and empty lines are skipped, a byte order mark is accepted.
        time_unit: unit of the first column: `s`, `ms`, `us` or `ns`.
        skip_lines: lines at the head of the file that are skipped whatever they hold.
        skip_repeated: use the first of several successive poses with the same stamp, instead of refusing them.

    Raises:
        InputError: unreadable file, unknown unit, or a line that is no pose; the message names file and line.
    """
    if time_unit not in _UNITS:
        raise InputError(f"time_unit must be one of {', '.join(_UNITS)}, found {time_unit!r}")
    stamps: list[Decimal] = []
    poses = []
    for number, words in _data_lines(path):
        if number <= skip_lines:
            continue
        if len(words) != 8:
            _reject(path, f"line {number} has {len(words)} columns, expected 8: timestamp tx ty tz qx qy qz qw")
        stamp = _parse_stamp(path, number, words[0], _UNITS[time_unit])
        if skip_repeated and stamps and stamp == stamps[-1]:
            continue
        stamps.append(stamp)
        poses.append(_parse_numbers(path, number, words[1:]))
    return _build(path, _stamp_array(stamps), np.array(poses).reshape(-1, 7))


def write_kitti(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write KITTI text: the first three rows of the camera-to-world matrix per line; the format has no stamps.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = trajectory.matrices()[:, :3].reshape(-1, 12).tolist()
    _write_lines(path, [" ".join(f"{value:.17g}" for value in row) for row in rows])


def read_kitti(path: str | os.PathLike[str], t_us: np.ndarray | None = None) -> Trajectory:
    """Read KITTI text: twelve numbers a line, the first three rows of the camera-to-world matrix.

    Args:
        path: text file.
        t_us: `(T,)` microseconds; None numbers the poses 0, 1, 2, ... us.

    Raises:
        InputError: unreadable file, a line that is no pose, a matrix that is no rotation, or T differs.
    """
    rows = []
    for number, words in _data_lines(path):
        if len(words) != 12:
            _reject(path, f"line {number} has {len(words)} columns, expected the 12 of a 3x4 matrix")
        rows.append(_parse_numbers(path, number, words))
    matrices = np.array(rows, dtype=np.float64).reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    offset = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).reshape(-1, 9).max(axis=1)
    proper = np.einsum("ti,ti->t", np.cross(rotations[:, 0], rotations[:, 1]), rotations[:, 2]) > 0
    bad = np.flatnonzero(~((offset < QUATERNION_TOLERANCE) & proper))
    if len(bad):
        _reject(path, f"pose {bad[0]} is no rigid motion: its rotation part is not orthonormal")
    poses = np.concatenate([matrices[:, :, 3], quaternions(rotations)], axis=1)
    return _build(path, np.arange(len(poses)) if t_us is None else np.asarray(t_us), poses)


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """`(T, 4)` unit quaternions, scalar last, of rotation matrices `(T, 3, 3)`; the scalar is not negative."""
    if not len(rotations):
        return np.empty((0, 4))
    from scipy.spatial.transform import Rotation

    quat_xyzw = Rotation.from_matrix(rotations).as_quat()
    return np.where(quat_xyzw[:, 3:] < 0, -quat_xyzw, quat_xyzw)


def write_euroc(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write EuRoC CSV: whole nanoseconds, position, quaternion with the scalar first; camera to world.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = ["#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"]
    for stamp_ns, pose in zip(_nanoseconds(trajectory.t_us), trajectory.world_T_cam[:, [0, 1, 2, 6, 3, 4, 5]].tolist()):
        lines.append(",".join([str(stamp_ns), *(f"{value:.17g}" for value in pose)]))
    _write_lines(path, lines)


def write_npy(path: str | os.PathLike[str], trajectory: Trajectory) -> tuple[Path, Path]:
    """Write `<base>_poses.npy`, `(T, 7)` float32 camera to world, and `<base>_tstamps.npy`, `(T,)` float64 us.

    Args:
        path: `<base>`, with or without `.npy`.
        trajectory: any unit of length.

    Returns:
        The two paths.

    Raises:
        OutputError: a file cannot be written.
    """
    base = str(path).removesuffix(".npy")
    targets = Path(f"{base}_poses.npy"), Path(f"{base}_tstamps.npy")
    arrays: tuple[np.ndarray, ...] = trajectory.world_T_cam.astype(np.float32), trajectory.t_us.astype(np.float64)
    for target, array in zip(targets, arrays):
        with atomic_path(target) as temporary, temporary.open("wb") as file:
            np.lib.format.write_array(file, array, allow_pickle=False)
    return targets


def read_npy(poses: str | os.PathLike[str], tstamps: str | os.PathLike[str] | None = None) -> Trajectory:
    """Read camera-to-world poses `(T, 7)` and their stamps `(T,)` in microseconds.

    Args:
        poses: `<base>_poses.npy`.
        tstamps: None takes the sibling `<base>_tstamps.npy`.

    Raises:
        InputError: a file is missing or malformed, or the two do not fit together.
    """
    poses = Path(poses)
    if tstamps is None:
        if not poses.name.endswith("_poses.npy"):
            _reject(poses, "the stamps' file cannot be guessed from a name that does not end in _poses.npy; name it")
        tstamps = poses.with_name(poses.name.removesuffix("_poses.npy") + "_tstamps.npy")
    return _build(poses, load_array(tstamps), load_array(poses))


def _reject(path: str | os.PathLike[str], problem: str) -> NoReturn:
    raise InputError(f"{os.fspath(path)}: {problem}")


def _build(path: str | os.PathLike[str], t_us: np.ndarray, poses: np.ndarray) -> Trajectory:
    try:
        return Trajectory(t_us, poses)
    except InputError as error:
        _reject(path, str(error))


def _data_lines(path: str | os.PathLike[str]) -> list[tuple[int, list[str]]]:
    """Line numbers from 1 and words of the lines that hold data."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        _reject(path, f"cannot be read ({error.strerror or error}); check the path")
    except UnicodeDecodeError:
        _reject(path, "is no text file")
    lines = ((number, line.split()) for number, line in enumerate(text.split("\n"), start=1))
    return [(number, words) for number, words in lines if words and not words[0].startswith("#")]


def _parse_stamp(path: str | os.PathLike[str], number: int, word: str, unit_us: Decimal) -> Decimal:
    """Microseconds, as exact as the text."""
    try:
        stamp = Decimal(word)
    except InvalidOperation:
        _reject(path, f"line {number} begins with {word[:40]!r}, expected a time stamp")
    if not stamp.is_finite() or abs(stamp) * unit_us >= _LATEST_US:
        _reject(path, f"line {number} has the time stamp {word[:40]}, which is out of range")
    return stamp * unit_us


def _parse_numbers(path: str | os.PathLike[str], number: int, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        _reject(path, f"line {number}: {error}")


def _stamp_array(stamps: list[Decimal]) -> np.ndarray:
    """Microseconds as int64 where all are whole up to the resolution of float64 seconds, otherwise as float64."""
    t_us = np.array([float(stamp) for stamp in stamps])
    whole = [int(stamp.to_integral_value()) for stamp in stamps]
    resolution = np.spacing(np.abs(t_us) / 1e6) * 1e6
    remainder = np.array([abs(float(stamp - nearest)) for stamp, nearest in zip(stamps, whole)])
    if (remainder <= resolution).all():
        return np.array(whole, dtype=np.int64)
    return t_us


def _nanoseconds(t_us: np.ndarray) -> list[int]:
    if t_us.dtype.kind == "i":
        return [1000 * stamp for stamp in t_us.tolist()]
    return [int((Decimal(stamp) * 1000).to_integral_value()) for stamp in t_us.tolist()]


def _seconds(t_us: np.ndarray) -> list[str]:
    whole = bool((t_us == np.rint(t_us)).all())
    places, unit = (6, 10**6) if whole else (9, 10**9)
    texts = []
    for stamp in (int(stamp) for stamp in t_us.tolist()) if whole else _nanoseconds(t_us):
        seconds, fraction = divmod(abs(stamp), unit)
        texts.append(f"{'-' if stamp < 0 else ''}{seconds}.{fraction:0{places}d}")
    return texts


def _write_lines(path: str | os.PathLike[str], lines: list[str]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
