"""Trajectory files: exact round trips, evo as an independent reader, strictness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devo.errors import InputError, OutputError
from utils.trajectory_io import (
    Trajectory,
    inverted,
    quaternions,
    read_kitti,
    read_npy,
    read_tum,
    rotation_matrices,
    write_euroc,
    write_kitti,
    write_npy,
    write_tum,
)

EPOCH_US = 1_600_000_000_123_457


def _trajectory(count: int = 40, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    t_us = EPOCH_US + np.cumsum(rng.integers(1, 50_000, count))
    rotations = Rotation.random(count, random_state=seed).as_quat() if count else np.empty((0, 4))
    return Trajectory(t_us, np.concatenate([rng.normal(size=(count, 3)), rotations], axis=1))


# --- container ----------------------------------------------------------------------------------------------


def test_quaternions_are_normalised_and_the_input_stays() -> None:
    poses = np.array([[1, 2, 3, 0, 0, 0, 1.005], [1, 2, 4, 0, 0.6, 0, 0.8]])
    copy = poses.copy()
    trajectory = Trajectory(np.array([0, 1]), poses)
    np.testing.assert_allclose(np.linalg.norm(trajectory.world_T_cam[:, 3:], axis=1), 1, atol=1e-15)
    np.testing.assert_array_equal(poses, copy)
    assert trajectory.path_length() == 1.0


@pytest.mark.parametrize(
    ("t_us", "poses", "message"),
    [
        ([0, 1], np.zeros((2, 6)), r"\(2, 7\)"),
        ([0], np.zeros((2, 7)), r"\(1, 7\)"),
        ([[0, 1]], np.zeros((2, 7)), r"\(T,\)"),
        ([0, 1], [[0, 0, 0, 0, 0, 0, 1]] * 1 + [[0, np.nan, 0, 0, 0, 0, 1]], "pose 1 is not finite"),
        ([0, np.inf], [[0, 0, 0, 0, 0, 0, 1]] * 2, "pose 1 is not finite"),
        ([5, 5], [[0, 0, 0, 0, 0, 0, 1]] * 2, "stamps must increase, found 5 us followed by 5 us"),
        ([5, 4], [[0, 0, 0, 0, 0, 0, 1]] * 2, "sort the poses"),
        ([0, 1], [[0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 0]], "pose 1 has a quaternion of norm 0"),
        ([0], [[0, 0, 0, 1, 0, 0, 1]], "norm 1.41421"),
    ],
)
def test_what_is_no_trajectory(t_us: list, poses: list, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Trajectory(np.array(t_us), np.array(poses))


def test_inverse_twice_is_nothing_and_matches_matrices() -> None:
    trajectory = _trajectory()
    cam_T_world = inverted(trajectory.world_T_cam)
    np.testing.assert_allclose(inverted(cam_T_world), trajectory.world_T_cam, atol=1e-14)
    product = Trajectory(trajectory.t_us, cam_T_world).matrices() @ trajectory.matrices()
    np.testing.assert_allclose(product, np.tile(np.eye(4), (40, 1, 1)), atol=1e-14)


def test_rotations_agree_with_scipy() -> None:
    quat_xyzw = Rotation.random(200, random_state=1).as_quat()
    np.testing.assert_allclose(rotation_matrices(quat_xyzw), Rotation.from_quat(quat_xyzw).as_matrix(), atol=1e-14)
    back = quaternions(rotation_matrices(quat_xyzw))
    np.testing.assert_allclose(back, quat_xyzw * np.sign(quat_xyzw[:, 3:]), atol=1e-14)


# --- TUM ----------------------------------------------------------------------------------------------------


def test_tum_round_trip_is_exact_at_epoch_scale(tmp_path: Path) -> None:
    trajectory = _trajectory()
    write_tum(tmp_path / "t.txt", trajectory, comments=["scale: arbitrary\nseed 1"])
    found = read_tum(tmp_path / "t.txt")
    assert found.t_us.dtype == np.int64
    np.testing.assert_array_equal(found.t_us, trajectory.t_us)
    np.testing.assert_allclose(found.world_T_cam, trajectory.world_T_cam, rtol=0, atol=3e-16)
    head = [line for line in (tmp_path / "t.txt").read_text().splitlines() if line.startswith("#")]
    assert "camera-to-world" in head[0]
    assert head[1:] == ["# scale: arbitrary", "# seed 1", "# timestamp[s] tx ty tz qx qy qz qw"]


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(stamps=st.lists(st.integers(-(10**9), 4 * 10**15), unique=True, max_size=8))
def test_any_microsecond_comes_back(tmp_path: Path, stamps: list[int]) -> None:
    t_us = np.array(sorted(stamps), dtype=np.int64)
    poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(t_us), 1))
    for stored in (t_us, t_us.astype(np.float64)):
        write_tum(tmp_path / "t.txt", Trajectory(stored, poses))
        np.testing.assert_array_equal(read_tum(tmp_path / "t.txt").t_us, t_us)


def test_fractions_of_microseconds(tmp_path: Path) -> None:
    t_us = np.array([0.25, 16_666.625, 33_333.125])
    poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (3, 1))
    write_tum(tmp_path / "t.txt", Trajectory(t_us, poses))
    assert "0.016666625 " in (tmp_path / "t.txt").read_text()
    found = read_tum(tmp_path / "t.txt").t_us
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, t_us)


@pytest.mark.parametrize(
    ("word", "unit", "expected"),
    [
        ("1600000000.123457", "s", 1600000000123457), ("1.600000000123456955e+09", "s", 1600000000123457),
        ("1600000000123457.0", "us", 1600000000123457), ("1600000000123457000", "ns", 1600000000123457),
        ("1600000000123.457", "ms", 1600000000123457), ("-1.5", "s", -1500000), ("7", "us", 7),
    ],
)
def test_time_units_and_spellings(tmp_path: Path, word: str, unit: str, expected: int) -> None:
    (tmp_path / "t.txt").write_text(f"\ufeff# head\n\n{word}\t1 2 3  0 0 0 1\r\n", encoding="utf-8")
    found = read_tum(tmp_path / "t.txt", time_unit=unit)
    assert found.t_us.tolist() == [expected]
    np.testing.assert_array_equal(found.world_T_cam, [[1, 2, 3, 0, 0, 0, 1]])


def test_evo_reads_our_tum_and_kitti(tmp_path: Path) -> None:
    from evo.tools import file_interface

    trajectory = _trajectory()
    write_tum(tmp_path / "t.txt", trajectory)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "t.txt")
    np.testing.assert_array_equal(theirs.positions_xyz, trajectory.world_T_cam[:, :3])
    np.testing.assert_allclose(theirs.orientations_quat_wxyz, trajectory.world_T_cam[:, [6, 3, 4, 5]], atol=1e-15)
    np.testing.assert_array_equal(np.rint(theirs.timestamps * 1e6), trajectory.t_us)
    write_kitti(tmp_path / "k.txt", trajectory)
    np.testing.assert_array_equal(file_interface.read_kitti_poses_file(tmp_path / "k.txt").poses_se3,
                                  trajectory.matrices())


def test_evo_reads_our_euroc(tmp_path: Path) -> None:
    from evo.tools import file_interface

    trajectory = _trajectory()
    write_euroc(tmp_path / "e.csv", trajectory)
    theirs = file_interface.read_euroc_csv_trajectory(tmp_path / "e.csv")
    np.testing.assert_array_equal(theirs.positions_xyz, trajectory.world_T_cam[:, :3])
    np.testing.assert_allclose(theirs.orientations_quat_wxyz, trajectory.world_T_cam[:, [6, 3, 4, 5]], atol=1e-15)
    stamps = [int(line.split(",")[0]) for line in (tmp_path / "e.csv").read_text().splitlines()[1:]]
    assert stamps == [1000 * int(stamp) for stamp in trajectory.t_us]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1.0 0 0 0 0 0 0", "line 2 has 7 columns, expected 8"),
        ("1.0 0 0 0 0 0 0 1 9", "line 2 has 9 columns"),
        ("1.0,0,0,0,0,0,0,1", "line 2 has 1 columns"),
        ("noon 0 0 0 0 0 0 1", "line 2 begins with 'noon'"),
        ("nan 0 0 0 0 0 0 1", "out of range"),
        ("1e400 0 0 0 0 0 0 1", "out of range"),
        ("1.0 0 0 zero 0 0 0 1", "line 2: could not convert"),
        ("1.0 0 0 inf 0 0 0 1", "not finite"),
        ("1.0 0 0 0 0 0 0 0", "quaternion of norm 0"),
        ("1.0 0 0 0 0.5 0.5 0.5 0.6", "quaternion of norm"),
        ("0.0 0 0 0 0 0 0 1", "stamps must increase"),
        ("-1.0 0 0 0 0 0 0 1", "stamps must increase"),
    ],
)
def test_malformed_tum(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "bad.txt").write_text(f"0.0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=rf"bad\.txt: .*{message}"):
        read_tum(tmp_path / "bad.txt")


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00" * 9)
    with pytest.raises(InputError, match=r"bytes\.txt: is no text file"):
        read_tum(tmp_path / "bytes.txt")
    with pytest.raises(InputError, match=r"nowhere\.txt: cannot be read"):
        read_tum(tmp_path / "nowhere.txt")
    with pytest.raises(InputError, match="time_unit must be one of s, ms, us, ns"):
        read_tum(tmp_path / "bytes.txt", time_unit="minutes")
    (tmp_path / "empty.txt").write_text("# nothing yet\n")
    assert len(read_tum(tmp_path / "empty.txt")) == 0


def test_truncated_tum_never_gives_a_shorter_pose(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.txt", _trajectory(12))
    content, whole = (tmp_path / "t.txt").read_bytes(), read_tum(tmp_path / "t.txt")
    for length in range(0, len(content), 17):
        (tmp_path / "cut.txt").write_bytes(content[:length])
        try:
            found = read_tum(tmp_path / "cut.txt")
        except InputError as error:
            assert "cut.txt" in str(error)
        else:  # cut in or behind the last number of a line: all lines before it are intact
            rows = max(len(found) - 1, 0)
            np.testing.assert_array_equal(found.t_us[:rows], whole.t_us[:rows])
            np.testing.assert_array_equal(found.world_T_cam[:rows], whole.world_T_cam[:rows])


# --- KITTI, NPY, failing disks ------------------------------------------------------------------------------


def test_kitti_round_trip(tmp_path: Path) -> None:
    trajectory = _trajectory()
    write_kitti(tmp_path / "k.txt", trajectory)
    found = read_kitti(tmp_path / "k.txt", trajectory.t_us)
    np.testing.assert_allclose(found.matrices(), trajectory.matrices(), atol=1e-14)
    np.testing.assert_array_equal(read_kitti(tmp_path / "k.txt").t_us, np.arange(40))
    with pytest.raises(InputError, match=r"k\.txt: .*\(3, 7\)"):
        read_kitti(tmp_path / "k.txt", np.arange(3))


@pytest.mark.parametrize(
    ("line", "message"),
    [("1 0 0 0 0 1 0 0 0 0 1", "11 columns"), ("1 0 0 0 0 1 0 0 0 0 -1 0", "no rigid motion"),
     ("2 0 0 0 0 2 0 0 0 0 2 0", "no rigid motion"), ("nan 0 0 0 0 1 0 0 0 0 1 0", "no rigid motion"),
     ("1 0 0 inf 0 1 0 0 0 0 1 0", "not finite"), ("1 0 0 a 0 1 0 0 0 0 1 0", "could not convert")],
)
def test_malformed_kitti(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "bad.txt").write_text(line + "\n")
    with pytest.raises(InputError, match=rf"bad\.txt: .*{message}"):
        read_kitti(tmp_path / "bad.txt")


def test_npy_round_trip(tmp_path: Path) -> None:
    trajectory = _trajectory()
    poses, stamps = write_npy(tmp_path / "run.npy", trajectory)
    assert (poses.name, stamps.name) == ("run_poses.npy", "run_tstamps.npy")
    assert np.load(poses).dtype == np.float32
    assert np.load(stamps).dtype == np.float64
    found = read_npy(poses)
    np.testing.assert_array_equal(found.t_us, trajectory.t_us)
    np.testing.assert_allclose(found.world_T_cam, trajectory.world_T_cam, atol=3e-7)  # float32 on disk
    np.save(stamps, np.arange(3.0))
    with pytest.raises(InputError, match=r"run_poses\.npy: .*\(3, 7\)"):
        read_npy(poses)
    with pytest.raises(InputError, match="name it"):
        read_npy(tmp_path / "other.npy")


@pytest.mark.parametrize("write", [write_tum, write_kitti, write_euroc, write_npy])
def test_unwritable_places(write: object) -> None:
    with pytest.raises(OutputError, match="cannot write /proc/devo-test"):
        write("/proc/devo-test/t", _trajectory())  # type: ignore[operator]


@pytest.mark.parametrize("write", [write_tum, write_kitti, write_euroc])
def test_empty_and_single(tmp_path: Path, write: object) -> None:
    for count in (0, 1):
        write(tmp_path / "t.txt", _trajectory(count))  # type: ignore[operator]
        data = [line for line in (tmp_path / "t.txt").read_text().splitlines() if not line.startswith("#")]
        assert len(data) == count
