"""Reading an export back: files are found by name, and the tag decides what poses are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from devo.errors import InputError
from utils.clouds import PointCloud, write_cloud
from utils.finished_run import FinishedRun, read_any_cloud, read_camera_path, read_trajectory
from utils.frame_bundle import FrameBundle, write_frame_bundle
from utils.trajectory_io import Trajectory, inverted, write_npy, write_tum

POSES = np.array([[0, 0, 0, 0, 0, 0, 1.0], [1, 2, 3, 0, 0.6, 0, 0.8], [2, 2, 1, 0.5, 0.5, 0.5, 0.5]])
T_US = np.array([2_000_000, 2_040_000, 2_100_000])


def bundle() -> FrameBundle:
    rng = np.random.default_rng(0)
    return FrameBundle(
        np.array([0, 2]), T_US[[0, 2]].astype(np.float64), inverted(POSES[[0, 2]]), np.ones((2, 4), np.float32),
        np.array([0, 3, 5]), rng.random((5, 2)).astype(np.float32), np.full(5, 0.5, np.float32),
        rng.random((5, 3)).astype(np.float32), np.array([True, True]))


@pytest.mark.parametrize("name", ["board.npy", "board_cleaned.ply", "board_poses.npy", "board_meta.json", "board",
                                  "board_focus_edges.npy", "board_frames.npz", "board_trajectory.txt"])
def test_every_file_knows_its_run(tmp_path: Path, name: str) -> None:
    assert FinishedRun.of(tmp_path / name).base == tmp_path / "board"


@pytest.mark.parametrize(("tag", "asked", "turned"), [
    (None, "auto", False), ("T_world_cam", "auto", False), ("T_cam_world", "auto", True),
    ("T_cam_world", "T_wc", False), (None, "T_cw", True)])
def test_the_tag_decides_what_poses_are(tmp_path: Path, tag: str | None, asked: str, turned: bool) -> None:
    write_npy(tmp_path / "run", Trajectory(T_US, POSES))
    if tag is not None:
        (tmp_path / "run_meta.json").write_text(json.dumps({"pose_convention": tag}))
    expected = inverted(POSES.astype(np.float32)) if turned else POSES
    np.testing.assert_allclose(read_camera_path(tmp_path / "run_poses.npy", asked), expected, atol=1e-6)
    np.testing.assert_allclose(read_trajectory(tmp_path / "run_poses.npy", convention=asked).world_T_cam, expected,
                               atol=1e-6)


def test_frame_bundles_hold_world_to_camera(tmp_path: Path) -> None:
    write_frame_bundle(tmp_path / "run_frames.npz", bundle())
    np.testing.assert_allclose(read_camera_path(tmp_path / "run_frames.npz"), POSES[[0, 2]], atol=1e-6)
    assert read_trajectory(tmp_path / "run_frames.npz").t_us.tolist() == T_US[[0, 2]].tolist()
    cloud = read_any_cloud(tmp_path / "run_frames.npz")
    np.testing.assert_array_equal(cloud.points, bundle().points)
    assert cloud.scalars["host_frame"].tolist() == [0, 0, 0, 2, 2]


@pytest.mark.parametrize(("factor", "unit"), [(1e-6, "auto"), (1.0, "auto"), (1e-6, "s"), (1e3, "ns")])
def test_units_of_text(tmp_path: Path, factor: float, unit: str) -> None:
    rows = [f"{stamp * factor!r} " + " ".join(map(repr, pose)) for stamp, pose in zip(T_US.tolist(), POSES.tolist())]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    t_us = read_trajectory(tmp_path / "poses.txt", time_unit=unit).t_us
    if factor == 1.0:  # microseconds of a tenth of a second look like seconds; the span must exceed 1e5
        assert t_us.tolist() == (T_US * 10**6).tolist()
    else:
        np.testing.assert_allclose(t_us, T_US, atol=1e-3)
    longer = Trajectory(T_US * 10, POSES)
    (tmp_path / "long.txt").write_text("\n".join(
        f"{stamp} " + " ".join(map(repr, pose)) for stamp, pose in zip(longer.t_us.tolist(), POSES.tolist())))
    assert read_trajectory(tmp_path / "long.txt").t_us.tolist() == longer.t_us.tolist()


def test_clouds_of_any_shape(tmp_path: Path) -> None:
    np.save(tmp_path / "many.npy", np.zeros((4, 5, 3)))
    assert len(read_any_cloud(tmp_path / "many.npy")) == 20
    write_cloud(tmp_path / "c.npz", PointCloud(np.ones((2, 3)), scalars={"depth": np.ones(2)}))
    assert list(read_any_cloud(tmp_path / "c.npz").scalars) == ["depth"]


def test_unusable_files_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "flat_poses.npy", np.zeros(7))
    np.save(tmp_path / "nan_poses.npy", np.full((3, 7), np.nan))
    np.save(tmp_path / "lonely_poses.npy", POSES)
    (tmp_path / "bad_meta.json").write_text("[1, 2]")
    np.save(tmp_path / "bad_poses.npy", POSES)
    (tmp_path / "odd_meta.json").write_text('{"pose_convention": "sideways"}')
    np.save(tmp_path / "odd_poses.npy", POSES)
    for name, words in {"flat": "shape \\(T, 7\\)", "nan": "not initialised", "bad": "JSON object",
                        "odd": "sideways"}.items():
        with pytest.raises(InputError, match=words):
            read_camera_path(tmp_path / f"{name}_poses.npy")
    with pytest.raises(InputError, match="lonely_tstamps.npy"):
        read_trajectory(tmp_path / "lonely_poses.npy")
    with pytest.raises(InputError, match="time_unit"):
        read_trajectory(tmp_path / "lonely_poses.npy", time_unit="h")
    with pytest.raises(InputError, match="pose convention"):
        read_camera_path(tmp_path / "lonely_poses.npy", "T_up")
    write_tum(tmp_path / "t.txt", Trajectory(T_US, POSES))
    assert FinishedRun.of(tmp_path / "t.txt").poses_file() is None


@pytest.mark.parametrize("values", [{"W": "wide"}, {"intrinsics_fx_fy_cx_cy": [1, 2]}, {"H": 0},
                                    {"intrinsics_fx_fy_cx_cy": [1, float("nan"), 0, 0]}])
def test_cameras_in_the_description_are_checked(tmp_path: Path, values: dict) -> None:
    good = {"intrinsics_fx_fy_cx_cy": [60, 61, 32, 24], "W": 64, "H": 48}
    (tmp_path / "run_meta.json").write_text(json.dumps(good))
    camera = FinishedRun(tmp_path / "run").camera()
    assert camera is not None and camera[0].tolist() == [60, 61, 32, 24] and camera[1] == (64, 48)
    (tmp_path / "run_meta.json").write_text(json.dumps(good | values))
    with pytest.raises(InputError, match="no camera"):
        FinishedRun(tmp_path / "run").camera()
    assert FinishedRun(tmp_path / "other").camera() is None
