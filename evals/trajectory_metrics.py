"""How far an estimated trajectory is from the ground truth: ATE, RPE and MPE.

ATE (absolute trajectory error): distances between matched camera centres after one global alignment. RPE (relative
pose error): error of the motion over a fixed span. MPE: mean ATE in percent of the ground truth's path length. The
errors themselves are computed by evo, which is imported only here and only when it is used.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from devo.errors import InputError
from evals.alignment import Similarity, umeyama_sim3
from utils.trajectory_io import Trajectory

ALIGNMENTS = ("sim3", "se3", "none")
ASSOCIATIONS = ("one_to_one", "nearest")
RPE_UNITS = ("s", "frames", "m")


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of one estimate, with units in the names; lengths assume a ground truth in metres.

    Attributes:
        alignment: `sim3`, `se3` or `none`.
        association: `one_to_one` or `nearest`.
        max_difference_ms: largest time difference that was allowed between matched poses.
        matches: number of matched poses, on which all errors but the path length rest.
        reference_poses: number of poses of the ground truth.
        estimate_poses: number of poses of the estimate.
        reference_reused: matches whose ground-truth pose serves an earlier match already (0 for `one_to_one`).
        scale: factor from the estimate's unit to metres; 1 unless `sim3`.
        ate_rmse_cm: root mean square distance of the camera centres; next to it mean, median, standard deviation, max.
        rotation_rmse_deg: root mean square rotation error after alignment.
        body_rotation_deg: angle of the constant rotation between camera and body that was estimated and taken out;
            0 where none was.
        mpe_percent: 100 * mean distance / path length of the whole ground truth; NaN where it does not move.
        reference_path_length_m: that path length.
        rpe_delta: span of a relative motion, in `rpe_unit` (`s`, `frames` or `m` along the ground truth).
        rpe_pairs: number of spans; with none, the RPE is NaN.
        rpe_translation_rmse_cm: root mean square translation error of the relative motions, estimate scaled.
        rpe_rotation_rmse_deg: root mean square rotation error of the relative motions.
    """

    alignment: str
    association: str
    max_difference_ms: float
    matches: int
    reference_poses: int
    estimate_poses: int
    reference_reused: int
    scale: float
    ate_rmse_cm: float
    ate_mean_cm: float
    ate_median_cm: float
    ate_std_cm: float
    ate_max_cm: float
    rotation_rmse_deg: float
    body_rotation_deg: float
    mpe_percent: float
    reference_path_length_m: float
    rpe_delta: float
    rpe_unit: str
    rpe_pairs: int
    rpe_translation_rmse_cm: float
    rpe_rotation_rmse_deg: float

    def __str__(self) -> str:
        return (
            f"ATE {self.ate_rmse_cm:.3f} cm (mean {self.ate_mean_cm:.3f}, max {self.ate_max_cm:.3f}), "
            f"MPE {self.mpe_percent:.3f} %, rotation {self.rotation_rmse_deg:.3f} deg, "
            f"RPE {self.rpe_translation_rmse_cm:.3f} cm and {self.rpe_rotation_rmse_deg:.3f} deg per "
            f"{self.rpe_delta:g} {self.rpe_unit}; {self.matches} of {self.estimate_poses} poses matched within "
            f"{self.max_difference_ms:g} ms ({self.association}), {self.alignment} alignment, scale {self.scale:.4f}"
        )

    def as_dict(self) -> dict[str, float | int | str]:
        """Name -> value, in the order of the fields; ready for JSON or a table row."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}


def associate(
    reference_t_us: np.ndarray, estimate_t_us: np.ndarray, *, max_difference_ms: float, one_to_one: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Match poses by time: each stamp of the shorter list takes its nearest one in the longer list.

    Args:
        reference_t_us: `(R,)` increasing microseconds.
        estimate_t_us: `(E,)` increasing microseconds.
        max_difference_ms: pairs that are farther apart are left out.
        one_to_one: where several stamps claim the same partner, only the nearest keeps it (the earlier one on a tie);
            otherwise a stamp of the longer list may serve several times, as in evo and the published protocol.

    Returns:
        Row numbers `(K,)` into the reference and `(K,)` into the estimate, increasing.
    """
    swapped = len(reference_t_us) < len(estimate_t_us)
    few, many = (reference_t_us, estimate_t_us) if swapped else (estimate_t_us, reference_t_us)
    if not len(few):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    nearest, difference_us = _nearest(few, many)
    rows = np.flatnonzero(difference_us <= 1e3 * max_difference_ms)
    if one_to_one and len(rows):
        order = rows[np.lexsort((rows, difference_us[rows], nearest[rows]))]
        first = np.ones(len(order), dtype=bool)
        first[1:] = nearest[order][1:] != nearest[order][:-1]
        rows = np.sort(order[first])
    return (rows, nearest[rows]) if swapped else (nearest[rows], rows)


def evaluate_trajectory(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    alignment: str = "sim3",
    max_difference_ms: float = 50.0,
    association: str = "one_to_one",
    body_frame: bool = False,
    rpe_delta: float = 1.0,
    rpe_unit: str = "s",
) -> TrajectoryErrors:
    """Compare an estimate with the ground truth.

    Args:
        reference: ground truth, camera to world, metres.
        estimate: camera to world, any unit of length; same clock as the reference.
        alignment: `sim3` (rotation, translation and scale: for monocular estimates), `se3` (no scale) or `none`,
            fitted on all matched camera centres.
        max_difference_ms: largest time difference between matched poses; the published protocol of DEVO used 1000.
        association: `one_to_one`, or `nearest` for the published protocol (see `associate`).
        body_frame: the ground truth is that of a body with other axes than the camera (TUM-VIE, EDS, MVSEC). The
            constant rotation between the two is then estimated from the matched poses and taken out, without which
            rotation errors and RPE mean nothing; ATE and MPE do not depend on it. The lever arm stays in.
        rpe_delta: span of a relative motion; the pose nearest to the end of the span is taken if it misses it by at
            most a tenth of the span.
        rpe_unit: `s`, `frames` (matched poses) or `m` (path of the reference).

    Raises:
        InputError: an unknown option, fewer than 3 matches, or camera centres that determine no alignment.
    """
    _check_options(alignment, association, rpe_unit, rpe_delta, max_difference_ms)
    one_to_one = association == "one_to_one"
    rows, columns = associate(reference.t_us, estimate.t_us, max_difference_ms=max_difference_ms, one_to_one=one_to_one)
    if len(rows) < 3:
        raise InputError(_too_few(reference, estimate, len(rows), max_difference_ms))
    truth, t_us = reference.world_T_cam[rows], reference.t_us[rows]
    found, fit = _aligned(estimate.world_T_cam[columns], truth[:, :3], alignment)
    body_rotation_deg = _take_out_body_rotation(truth, found) if body_frame else 0.0

    truth_evo, found_evo = _to_evo(truth, t_us), _to_evo(found, t_us)
    distances = _absolute_errors(truth_evo, found_evo, "translation_part")
    angles = _absolute_errors(truth_evo, found_evo, "rotation_angle_deg")
    pairs = _spans(truth, t_us, rpe_delta, rpe_unit)
    relative_distances, relative_angles = _relative_errors(truth_evo, found_evo, pairs)
    length = reference.path_length()
    return TrajectoryErrors(
        alignment=alignment,
        association=association,
        max_difference_ms=float(max_difference_ms),
        matches=len(rows),
        reference_poses=len(reference),
        estimate_poses=len(estimate),
        reference_reused=len(rows) - len(np.unique(rows)),
        scale=fit.scale,
        ate_rmse_cm=100 * _rms(distances),
        ate_mean_cm=100 * float(distances.mean()),
        ate_median_cm=100 * float(np.median(distances)),
        ate_std_cm=100 * float(distances.std()),
        ate_max_cm=100 * float(distances.max()),
        rotation_rmse_deg=_rms(angles),
        body_rotation_deg=body_rotation_deg,
        mpe_percent=100 * float(distances.mean()) / length if length > 0 else float("nan"),
        reference_path_length_m=length,
        rpe_delta=float(rpe_delta),
        rpe_unit=rpe_unit,
        rpe_pairs=len(pairs),
        rpe_translation_rmse_cm=100 * _rms(relative_distances),
        rpe_rotation_rmse_deg=_rms(relative_angles),
    )


def _check_options(
    alignment: str, association: str, rpe_unit: str, rpe_delta: float, max_difference_ms: float
) -> None:
    for name, value, known in (("alignment", alignment, ALIGNMENTS), ("association", association, ASSOCIATIONS),
                               ("rpe_unit", rpe_unit, RPE_UNITS)):
        if value not in known:
            raise InputError(f"{name} must be one of {', '.join(known)}, found {value!r}")
    if not rpe_delta > 0 or not max_difference_ms >= 0:
        raise InputError(f"rpe_delta must be positive and max_difference_ms not negative, found {rpe_delta} and "
                         f"{max_difference_ms}")


def _too_few(reference: Trajectory, estimate: Trajectory, matches: int, max_difference_ms: float) -> str:
    text = (f"{matches} of {len(estimate)} estimated poses match one of {len(reference)} ground-truth poses within "
            f"{max_difference_ms:g} ms, at least 3 are needed")
    if not len(reference) or not len(estimate):
        return text
    closest_ms = _nearest(estimate.t_us, reference.t_us)[1].min() / 1e3
    return (f"{text}; the closest pair is {closest_ms:.6g} ms apart, the ground truth spans {reference.t_us[0]} to "
            f"{reference.t_us[-1]} us, the estimate {estimate.t_us[0]} to {estimate.t_us[-1]} us. Check the time "
            "unit and the clock of both")


def _nearest(stamps: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row of the nearest entry of the increasing `among` (the earlier one on a tie), and the absolute difference."""
    above = np.clip(np.searchsorted(among, stamps), 0, len(among) - 1)
    below = np.maximum(above - 1, 0)
    nearest = np.where(np.abs(stamps - among[below]) <= np.abs(among[above] - stamps), below, above)
    return nearest, np.abs(stamps - among[nearest])


def _aligned(poses: np.ndarray, centers: np.ndarray, alignment: str) -> tuple[np.ndarray, Similarity]:
    """Estimated poses in the frame of the ground truth, and the transform that took them there."""
    fit = Similarity(1.0, np.eye(3), np.zeros(3))
    if alignment != "none":
        fit = umeyama_sim3(poses[:, :3], centers, with_scale=alignment == "sim3")
    from scipy.spatial.transform import Rotation

    turned = (Rotation.from_matrix(fit.rotation) * Rotation.from_quat(poses[:, 3:])).as_quat()
    return np.concatenate([fit.apply(poses[:, :3]), turned], axis=1), fit


def _take_out_body_rotation(truth: np.ndarray, found: np.ndarray) -> float:
    """Turn the found poses, in place, by the mean rotation from camera to body; its angle in degrees."""
    from scipy.spatial.transform import Rotation

    cameras = Rotation.from_quat(found[:, 3:])
    offset = (cameras.inv() * Rotation.from_quat(truth[:, 3:])).mean()
    found[:, 3:] = (cameras * offset).as_quat()
    return float(np.degrees(offset.magnitude()))


def _to_evo(poses: np.ndarray, t_us: np.ndarray) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        positions_xyz=poses[:, :3],
        orientations_quat_wxyz=poses[:, [6, 3, 4, 5]],  # evo wants the scalar first
        timestamps=(t_us - t_us[0]) * 1e-6,  # relative, because float64 seconds since 1970 are coarse
    )


def _absolute_errors(truth: Any, found: Any, relation: str) -> np.ndarray:
    from evo.core.metrics import APE, PoseRelation

    metric = APE(PoseRelation[relation])
    metric.process_data((truth, found))
    return np.asarray(metric.error, dtype=np.float64)


def _spans(truth: np.ndarray, t_us: np.ndarray, delta: float, unit: str) -> np.ndarray:
    """`(K, 2)` rows of the first and last pose of each span of length `delta`, one for each start that has an end."""
    if unit == "s":
        progress = (t_us - t_us[0]) * 1e-6
    elif unit == "frames":
        progress = np.arange(len(truth), dtype=np.float64)
    else:
        steps = np.linalg.norm(np.diff(truth[:, :3], axis=0), axis=1)
        progress = np.concatenate([[0.0], np.cumsum(steps)])
    last, miss = _nearest(progress + delta, progress)
    first = np.arange(len(progress))
    inside = progress + delta <= progress[-1] + 1e-6 * delta  # no shortened spans at the end
    return np.stack([first, last], axis=1)[(miss <= 0.1 * delta) & (last > first) & inside]


def _relative_errors(truth: Any, found: Any, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translation (unit of the truth) and rotation (degrees) errors of the relative motions."""
    from evo.core.metrics import RPE

    if not len(pairs):
        return np.empty(0), np.empty(0)
    true_poses, found_poses = truth.poses_se3, found.poses_se3
    errors = np.stack([RPE.rpe_base(true_poses[i], true_poses[j], found_poses[i], found_poses[j]) for i, j in pairs])
    rotations = errors[:, :3, :3]
    sine = np.linalg.norm(rotations - rotations.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8)
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(errors[:, :3, 3], axis=1), np.degrees(np.arctan2(sine, cosine))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
