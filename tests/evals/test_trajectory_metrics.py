"""Trajectory errors: published figures, closed forms, evo, association, degenerate paths."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from evals.alignment import Similarity, umeyama_sim3
from evals.trajectory_metrics import TrajectoryErrors, associate, evaluate_trajectory
from tests.tolerances import UMEYAMA_AGAINST_EVO
from utils.trajectory_io import Trajectory, inverted, read_tum


def _walk(count: int = 200, seed: int = 0) -> Trajectory:
    """A smooth path in metres with turning cameras, 20 poses a second."""
    rng = np.random.default_rng(seed)
    time = np.arange(count) * 0.05
    centers = np.stack([np.sin(0.7 * time), 0.3 * np.cos(1.1 * time), 0.2 * time], axis=1) + rng.normal(size=3)
    rotations = Rotation.from_euler("yxz", np.stack([0.4 * np.sin(time), 0.2 * time, 0.1 * time], axis=1))
    return Trajectory(np.arange(count) * 50_000, np.concatenate([centers, rotations.as_quat()], axis=1))


def _moved(trajectory: Trajectory, fit: Similarity) -> Trajectory:
    turned = Rotation.from_matrix(fit.rotation) * Rotation.from_quat(trajectory.world_T_cam[:, 3:])
    return Trajectory(trajectory.t_us, np.concatenate([fit.apply(trajectory.world_T_cam[:, :3]), turned.as_quat()], 1))


def _similarity(seed: int, scale: float | None = None) -> Similarity:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    return Similarity(float(np.exp(rng.normal())) if scale is None else scale, rotation, rng.normal(size=3) * 5)


# --- known answers ------------------------------------------------------------------------------------------

# pair, system, its time unit, poses, ATE Sim3 cm, ATE SE3 cm, MPE %, scale, path m, published figures
KNOWN = [
    ("tumvie_1d", "deio", "us", 571, "0.423", "1.336", "0.076", "1.0526", "5.03", {"ate": "0.42", "mpe": "0.08"}),
    ("tumvie_3d", "deio", "us", 554, "1.106", "1.116", "0.146", "0.9936", "6.87", {"ate": "1.11", "mpe": "0.15"}),
    ("tumvie_6dof", "deio", "us", 352, "1.373", "1.393", "0.215", "1.0172", "5.38", {"ate": "1.37", "mpe": "0.22"}),
    ("mvsec_flying4", "deio", "us", 443, "9.451", "16.259", "0.780", "1.1043", "9.81", {"mpe": "0.78"}),
    ("rpg_bin", "sdevo", "s", 170, "1.164", "1.207", "0.128", "1.0147", "8.41", {"ate": "1.16"}),
]


@pytest.mark.parametrize("known", KNOWN, ids=[row[0] for row in KNOWN])
def test_published_figures_to_the_last_digit(shared_data: Path, known: tuple) -> None:
    name, system, unit, poses, ate_sim3, ate_se3, mpe, scale, length, published = known
    folder = shared_data / "eval_trajectories"
    reference = read_tum(folder / f"{name}_gt.txt")
    estimate = read_tum(folder / f"{name}_{system}_est.txt", time_unit=unit)
    errors = evaluate_trajectory(reference, estimate, association="nearest")
    assert errors.matches == poses
    assert f"{errors.ate_rmse_cm:.3f}" == ate_sim3
    assert f"{errors.mpe_percent:.3f}" == mpe
    assert f"{errors.scale:.4f}" == scale
    assert f"{errors.reference_path_length_m:.2f}" == length
    rigid = evaluate_trajectory(reference, estimate, association="nearest", alignment="se3")
    assert f"{rigid.ate_rmse_cm:.3f}" == ate_se3
    for figure, text in published.items():
        value = errors.ate_rmse_cm if figure == "ate" else errors.mpe_percent
        assert f"{value:.2f}" == text
    strict = evaluate_trajectory(reference, estimate)
    assert strict.reference_reused == 0
    assert strict.matches == poses - errors.reference_reused
    assert f"{strict.mpe_percent:.2f}" == f"{errors.mpe_percent:.2f}"


def test_body_rotation_makes_relative_errors_of_body_ground_truth_meaningful(shared_data: Path) -> None:
    folder = shared_data / "eval_trajectories"
    reference = read_tum(folder / "tumvie_1d_gt.txt")
    estimate = read_tum(folder / "tumvie_1d_deio_est.txt", time_unit="us")
    plain = evaluate_trajectory(reference, estimate)
    turned = evaluate_trajectory(reference, estimate, body_frame=True)
    assert turned.ate_rmse_cm == pytest.approx(plain.ate_rmse_cm, rel=1e-12)
    assert plain.rotation_rmse_deg > 90 > turned.rotation_rmse_deg * 10
    assert turned.rpe_translation_rmse_cm < 3 < plain.rpe_translation_rmse_cm / 5


# --- closed forms -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_moved_copy_has_no_error(seed: int) -> None:
    truth, fit = _walk(), _similarity(seed)
    errors = evaluate_trajectory(truth, _moved(truth, fit))
    assert errors.scale == pytest.approx(1 / fit.scale, rel=1e-12)
    for value in (errors.ate_max_cm, errors.rotation_rmse_deg, errors.rpe_translation_rmse_cm,
                  errors.rpe_rotation_rmse_deg, errors.mpe_percent):
        assert value == pytest.approx(0, abs=1e-5)  # arccos in evo resolves angles to about 1e-6 degrees
    assert errors.rpe_pairs == 180
    assert (errors.matches, errors.reference_poses, errors.estimate_poses) == (200, 200, 200)


def test_alignment_does_only_what_it_is_asked_to() -> None:
    truth = _walk()
    shifted = _moved(truth, Similarity(1.0, np.eye(3), np.array([0.03, 0.0, 0.04])))
    errors = evaluate_trajectory(truth, shifted, alignment="none")
    assert errors.ate_rmse_cm == pytest.approx(5, rel=1e-9)
    assert errors.ate_mean_cm == pytest.approx(5, rel=1e-9)
    assert errors.ate_std_cm == pytest.approx(0, abs=1e-9)
    assert errors.mpe_percent == pytest.approx(100 * 0.05 / truth.path_length(), rel=1e-9)
    assert errors.scale == 1
    assert evaluate_trajectory(truth, shifted, alignment="se3").ate_rmse_cm == pytest.approx(0, abs=1e-9)
    doubled = _moved(truth, Similarity(2.0, np.eye(3), np.zeros(3)))
    spread = np.linalg.norm(truth.world_T_cam[:, :3] - truth.world_T_cam[:, :3].mean(axis=0), axis=1)
    rigid = evaluate_trajectory(truth, doubled, alignment="se3")
    assert rigid.scale == 1
    assert rigid.ate_rmse_cm == pytest.approx(100 * np.sqrt((spread**2).mean()), rel=1e-9)


def test_rotation_error_and_the_order_of_quaternions() -> None:
    """Cameras turned by 3 degrees about their own y: a swap of wxyz and xyzw would show here."""
    truth = _walk()
    offset = Rotation.from_euler("y", 3, degrees=True)
    turned = (Rotation.from_quat(truth.world_T_cam[:, 3:]) * offset).as_quat()
    estimate = Trajectory(truth.t_us, np.concatenate([truth.world_T_cam[:, :3], turned], axis=1))
    errors = evaluate_trajectory(truth, estimate)
    assert errors.rotation_rmse_deg == pytest.approx(3, rel=1e-6)
    assert errors.body_rotation_deg == 0
    body = evaluate_trajectory(truth, estimate, body_frame=True)
    assert body.body_rotation_deg == pytest.approx(3, rel=1e-9)
    assert body.rotation_rmse_deg == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize(("delta", "unit", "pairs"), [(1.0, "s", 180), (7, "frames", 193), (0.5, "m", None)])
def test_relative_error_of_a_drift(delta: float, unit: str, pairs: int | None) -> None:
    """A straight path estimated 2 % too long, not aligned: every span is off by 2 % of its length."""
    count, speed = 200, 0.4
    centers = np.zeros((count, 3))
    centers[:, 2] = np.arange(count) * 0.05 * speed
    poses = np.concatenate([centers, np.tile([0, 0, 0, 1.0], (count, 1))], axis=1)
    truth = Trajectory(np.arange(count) * 50_000, poses)
    estimate = Trajectory(truth.t_us, poses * np.array([1, 1, 1.02, 1, 1, 1, 1]))
    errors = evaluate_trajectory(truth, estimate, alignment="none", rpe_delta=delta, rpe_unit=unit)
    span_m = {"s": delta * speed, "frames": delta * 0.05 * speed, "m": delta}[unit]
    assert errors.rpe_translation_rmse_cm == pytest.approx(100 * 0.02 * span_m, rel=1e-6)
    assert errors.rpe_rotation_rmse_deg == pytest.approx(0, abs=1e-9)
    assert errors.rpe_pairs == (pairs or 175)


def test_relative_error_equals_evo() -> None:
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    truth = _walk()
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(200, 7)) * np.array([1e-2] * 3 + [1e-3] * 4)
    noisy = Trajectory(truth.t_us, truth.world_T_cam + noise)
    errors = evaluate_trajectory(truth, noisy, alignment="none", rpe_delta=5, rpe_unit="frames")
    pair = [PoseTrajectory3D(one.world_T_cam[:, :3], one.world_T_cam[:, [6, 3, 4, 5]], one.t_us * 1e-6)
            for one in (truth, noisy)]
    for relation, value in ((metrics.PoseRelation.translation_part, errors.rpe_translation_rmse_cm / 100),
                            (metrics.PoseRelation.rotation_angle_deg, errors.rpe_rotation_rmse_deg)):
        metric = metrics.RPE(relation, 5, metrics.Unit.frames, all_pairs=True)
        metric.process_data(tuple(pair))
        assert value == pytest.approx(metric.get_statistic(metrics.StatisticsType.rmse), rel=1e-7)
    assert errors.rpe_pairs == 195


def test_spans_longer_than_the_trajectory_give_nan() -> None:
    errors = evaluate_trajectory(_walk(), _walk(), rpe_delta=60)
    assert errors.rpe_pairs == 0
    assert np.isnan(errors.rpe_translation_rmse_cm)
    assert "200 of 200 poses matched" in str(errors)
    assert list(errors.as_dict()) == list(TrajectoryErrors.__dataclass_fields__)


def test_inverted_poses_are_not_mistaken_for_poses() -> None:
    truth = _walk()
    wrong = Trajectory(truth.t_us, inverted(truth.world_T_cam))
    assert evaluate_trajectory(truth, wrong).ate_rmse_cm > 10


def test_a_path_that_does_not_move_has_no_mpe() -> None:
    poses = np.tile([1, 2, 3, 0, 0, 0, 1.0], (9, 1))
    still = Trajectory(np.arange(9) * 100_000, poses)
    errors = evaluate_trajectory(still, still, alignment="none")
    assert np.isnan(errors.mpe_percent)
    assert errors.ate_rmse_cm == 0
    with pytest.raises(InputError, match="coincide"):
        evaluate_trajectory(still, still)


# --- association --------------------------------------------------------------------------------------------


def test_one_to_one_where_evo_reuses_a_pose() -> None:
    reference, estimate = np.array([0, 100_000]), np.array([1_000, 4_000, 9_000, 99_000])
    rows, columns = associate(reference, estimate, max_difference_ms=10)
    np.testing.assert_array_equal((rows, columns), ([0, 1], [0, 3]))
    reference, estimate = np.array([0, 100_000, 200_000, 300_000]), np.array([1_000, 4_000, 99_000])
    rows, columns = associate(reference, estimate, max_difference_ms=10)
    np.testing.assert_array_equal((rows, columns), ([0, 1], [0, 2]))
    rows, columns = associate(reference, estimate, max_difference_ms=10, one_to_one=False)
    np.testing.assert_array_equal((rows, columns), ([0, 0, 1], [0, 1, 2]))


def test_the_limit_is_inclusive_and_explicit() -> None:
    reference, estimate = np.array([0, 50_000, 100_000]), np.array([10_000, 60_001])
    assert associate(reference, estimate, max_difference_ms=10)[1].tolist() == [0]
    assert associate(reference, estimate, max_difference_ms=10.001)[1].tolist() == [0, 1]
    assert associate(reference, np.empty(0, int), max_difference_ms=10)[0].tolist() == []


STAMPS = st.lists(st.integers(0, 400), unique=True, max_size=25).map(sorted).map(np.array)


@settings(max_examples=200, deadline=None)
@given(reference=STAMPS, estimate=STAMPS, limit=st.integers(0, 60))
def test_association_laws(reference: np.ndarray, estimate: np.ndarray, limit: int) -> None:
    rows, columns = associate(reference, estimate, max_difference_ms=limit / 1e3)
    assert len(set(rows.tolist())) == len(rows) == len(set(columns.tolist()))
    assert (np.diff(rows) > 0).all()
    assert (np.diff(columns) > 0).all()
    gaps = np.abs(reference[rows] - estimate[columns]) if len(rows) else np.empty(0)
    assert (gaps <= limit).all()
    loose_rows, loose_columns = associate(reference, estimate, max_difference_ms=limit / 1e3, one_to_one=False)
    few, many, kept, loose = ((reference, estimate, rows, loose_rows) if len(reference) < len(estimate)
                              else (estimate, reference, columns, loose_columns))
    nearest = [np.abs(many - stamp).min() for stamp in few] if len(many) else []
    assert loose.tolist() == [row for row, gap in enumerate(nearest) if gap <= limit]
    assert set(kept.tolist()) <= set(loose.tolist())


def test_nearest_association_equals_evo() -> None:
    from evo.core.sync import matching_time_indices

    rng = np.random.default_rng(3)
    for count in (30, 90):
        reference, estimate = np.sort(rng.integers(0, 10**6, 60)), np.sort(rng.integers(0, 10**6, count))
        ours = associate(reference, estimate, max_difference_ms=12, one_to_one=False)
        lists = (reference, estimate) if len(reference) < count else (estimate, reference)
        theirs = matching_time_indices(lists[0] * 1e-6, lists[1] * 1e-6, max_diff=0.012)
        gaps = [np.abs(lists[0][list(pair[0])] - lists[1][list(pair[1])]) for pair in
                (theirs, ours if len(reference) < count else ours[::-1])]
        np.testing.assert_array_equal(*gaps)


def test_too_few_matches_say_why() -> None:
    truth = _walk()
    late = Trajectory(truth.t_us + 10**12, truth.world_T_cam)
    with pytest.raises(InputError, match="0 of 200 estimated poses.*clock"):
        evaluate_trajectory(truth, late)
    two = Trajectory(truth.t_us[:2], truth.world_T_cam[:2])
    with pytest.raises(InputError, match="2 of 2 estimated poses.*at least 3"):
        evaluate_trajectory(truth, two)
    with pytest.raises(InputError, match="0 of 0"):
        evaluate_trajectory(truth, Trajectory(np.empty(0), np.empty((0, 7))))


@pytest.mark.parametrize(
    "arguments",
    [{"alignment": "scale"}, {"association": "fuzzy"}, {"rpe_unit": "deg"}, {"rpe_delta": 0},
     {"max_difference_ms": -1}, {"max_difference_ms": float("nan")}],
)
def test_unknown_options(arguments: dict) -> None:
    with pytest.raises(InputError):
        evaluate_trajectory(_walk(), _walk(), **arguments)


# --- alignment ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_scale", [True, False])
def test_umeyama_equals_evo_on_random_pairs(with_scale: bool) -> None:
    from evo.core.geometry import umeyama_alignment

    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(100):
        count = int(rng.integers(3, 60))
        source, target = rng.normal(size=(2, count, 3)) * np.exp(rng.normal(size=(2, 1, 1)))
        fit = umeyama_sim3(source, target, with_scale)
        rotation, translation, scale = umeyama_alignment(source.T, target.T, with_scale)
        worst = max(worst, np.abs(fit.rotation - rotation).max(), np.abs(fit.translation - translation).max(),
                    abs(fit.scale - scale))
    assert worst <= UMEYAMA_AGAINST_EVO


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(4, 40))
def test_umeyama_recovers_a_similarity(seed: int, count: int) -> None:
    source = np.random.default_rng(seed).normal(size=(count, 3))
    truth = _similarity(seed)
    fit = umeyama_sim3(source, truth.apply(source))
    np.testing.assert_allclose(fit.matrix(), truth.matrix(), rtol=1e-7, atol=1e-7)
    assert np.linalg.det(fit.rotation) == pytest.approx(1)


def test_mirrored_points_get_a_proper_rotation() -> None:
    source = np.random.default_rng(0).normal(size=(50, 3)) * [3, 2, 1]
    fit = umeyama_sim3(source, source * [1, 1, -1])
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    np.testing.assert_allclose(fit.rotation, np.eye(3), atol=0.2)  # turning the thin axis over would cost more
    error = ((fit.apply(source) - source * [1, 1, -1]) ** 2).sum()
    for seed in range(200):  # no other proper similarity does better
        other = _similarity(seed, scale=fit.scale)
        centered = other.apply(source)
        centered += (source * [1, 1, -1] - centered).mean(axis=0)
        assert ((centered - source * [1, 1, -1]) ** 2).sum() >= error - 1e-9


def test_points_in_a_plane_determine_the_transform() -> None:
    source = np.random.default_rng(0).normal(size=(30, 3)) * [1, 1, 0]
    truth = _similarity(4)
    np.testing.assert_allclose(umeyama_sim3(source, truth.apply(source)).matrix(), truth.matrix(), atol=1e-9)


@pytest.mark.parametrize("direction", [[1, 0, 0], [1, 2, -3], [-1, 0, 0], [0, 0, 1]])
def test_points_on_a_line_get_the_smallest_rotation(direction: list[float]) -> None:
    along = np.array([1.0, 0, 0])
    wanted = np.array(direction) / np.linalg.norm(direction)
    steps = np.array([0, 1, 2.5, 4])[:, None]
    fit = umeyama_sim3(steps * along + 7, 3 * steps * wanted - 1)
    np.testing.assert_allclose(fit.apply(steps * along + 7), 3 * steps * wanted - 1, atol=1e-12)
    assert fit.scale == pytest.approx(3)
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    angle = np.degrees(np.arccos(np.clip(along @ wanted, -1, 1)))
    assert fit.angle_deg() == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "at least 3 pairs of points, found 2"),
        (np.zeros((4, 3)), np.zeros((5, 3)), "one shape"),
        (np.zeros((4, 2)), np.zeros((4, 2)), r"\(N, 3\)"),
        (np.ones((4, 3)), np.eye(4)[:, :3], "coincide"),
        (np.eye(4)[:, :3], np.ones((4, 3)), "coincide"),
        (np.full((4, 3), np.nan), np.eye(4)[:, :3], "finite"),
        (np.array([[1, 0, 0], [-1, 0, 0], [1, 0, 0], [-1.0, 0, 0]]),
         np.array([[1, 0, 0], [1, 0, 0], [-1, 0, 0], [-1.0, 0, 0]]), "uncorrelated"),
    ],
)
def test_what_cannot_be_aligned(source: np.ndarray, target: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        umeyama_sim3(source, target)


def test_evo_is_imported_by_the_call_only(repository: Path) -> None:
    code = "import sys, evals.trajectory_metrics, evals.pointcloud_metrics; " \
           "assert not {'evo', 'open3d', 'matplotlib', 'torch'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
