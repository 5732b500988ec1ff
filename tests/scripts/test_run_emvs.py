"""The command line of the EMVS mapper as a user runs it: products, third-party readers, errors on one line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from devo.errors import DevoError, InputError
from scripts import run_emvs
from utils.cli import run_cli
from utils.clouds import PointCloud, read_cloud, write_cloud
from utils.emvs.views import PoseTrack
from utils.events import make_events, write_events_h5
from utils.trajectory_io import Trajectory, inverted, write_npy, write_tum

FAST = ["--dimZ", "30", "--packet_size", "256", "--min_depth", "0.6", "--max_depth", "3", "--device", "cpu"]


def _trajectory() -> Trajectory:
    share = np.linspace(0, 1, 101)
    quat = Rotation.from_rotvec(np.outer(share - 0.5, [0.05, -0.2, 0.1])).as_quat()
    position = np.stack([0.4 * (share - 0.5), 0.1 * np.sin(4 * share), 0.05 * share], axis=1)
    return Trajectory(np.arange(101) * 10_000, np.concatenate([position, quat], axis=1))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the generic dataset: vertical lines on a slanted plane, seen by a moving camera of 64 x 48 pixels."""
    folder = tmp_path_factory.mktemp("recording")
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.6, 0.6, 7), np.linspace(-0.5, 0.5, 60)))
    points = np.stack([x, y, 1.2 + 0.2 * x], axis=1)
    trajectory = _trajectory()
    t_us = np.arange(0, 1_000_001, 5_000)
    world_T_cam = PoseTrack(trajectory)(t_us)
    seen = np.einsum("tji,tnj->tni", world_T_cam[:, :3, :3], points[None] - world_T_cam[:, None, :3, 3])
    pixel = np.rint(seen[..., :2] / seen[..., 2:] * 60.0 + [32.0, 24.0]).astype(int)
    visible = (pixel >= 0).all(-1) & (pixel < [64, 48]).all(-1)
    events = make_events(*pixel[visible].T, t_us[np.nonzero(visible)[0]], np.ones(int(visible.sum())))
    write_events_h5(folder / "events.h5", events, sensor_size=(64, 48))
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0, "distortion_model": "none"}
    (folder / "calib.yaml").write_text(yaml.safe_dump(camera), "utf-8")
    write_tum(folder / "groundtruth.txt", trajectory)
    write_cloud(folder / "sparse.ply", PointCloud(points))
    return folder


def _run(*words: object) -> int:
    return run_emvs.main([str(word) for word in words])


def test_products_of_one_view(recording: Path, tmp_path: Path) -> None:
    assert _run("--datapath", recording, "--out", tmp_path / "sub" / "map.ply", "--save_dsi", *FAST) == 0
    names = {path.name for path in (tmp_path / "sub").iterdir()}
    assert names == {"map.ply", "map.npy", "map_camera.ply", "map_camera.pcd", "map_depth.npy", "map_confidence.npy",
                     "map_mask.npy", "map_dsi.npy", "map_depth.png", "map_depth_gray.png", "map_confidence.png",
                     "map_mask.png", "map_overview.png", "map_meta.json"}
    base = str(tmp_path / "sub" / "map")
    world, camera = read_cloud(f"{base}.ply"), read_cloud(f"{base}_camera.ply")
    np.testing.assert_array_equal(np.load(f"{base}.npy"), world.points)
    assert {"depth", "confidence", "intensity", "view"} == set(world.scalars)
    error = np.abs(world.points[:, 2] - (1.2 + 0.2 * world.points[:, 0]))
    assert len(world) > 30 and np.median(error) < 0.03
    meta = json.loads(Path(f"{base}_meta.json").read_text("utf-8"))
    pose = np.array(meta["views"][0]["world_T_view_xyz_quat_xyzw"])
    moved = Rotation.from_quat(pose[3:]).apply(camera.points) + pose[:3]
    np.testing.assert_allclose(moved, world.points, atol=1e-5)
    assert meta["pose_convention"] == "T_world_cam" and meta["points"] == len(world)
    assert set(meta["files"]) == names - {"map_meta.json"}
    assert meta["convention_check"]["suspicious"] is False
    dsi = np.load(f"{base}_dsi.npy")
    assert dsi.shape == (30, 48, 64) and dsi.dtype == np.float32
    np.testing.assert_array_equal(dsi.max(axis=0), np.load(f"{base}_confidence.npy"))


def test_pictures_and_third_party_readers(recording: Path, tmp_path: Path) -> None:
    from plyfile import PlyData

    assert _run("--datapath", recording, "--out", tmp_path / "map", *FAST) == 0
    mask = np.load(tmp_path / "map_mask.npy")
    picture = cv2.imread(str(tmp_path / "map_depth.png"))
    assert picture is not None and picture.shape == (48, 64, 3)
    np.testing.assert_array_equal((picture == 255).all(axis=2), ~mask)  # white where there is no depth
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "map_mask.png"), cv2.IMREAD_UNCHANGED), mask * 255)
    confidence = cv2.imread(str(tmp_path / "map_confidence.png"), cv2.IMREAD_UNCHANGED)
    assert confidence is not None and (confidence.min(), confidence.max()) == (0, 255)
    vertices = PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    np.testing.assert_array_equal(np.stack([vertices[axis] for axis in "xyz"], axis=1), np.load(tmp_path / "map.npy"))
    head = (tmp_path / "map_camera.pcd").read_text("ascii").split("\n")
    assert "FIELDS x y z intensity" in head and "DATA ascii" in head and f"POINTS {len(vertices)}" in head
    numbers = np.loadtxt(tmp_path / "map_camera.pcd", skiprows=head.index("DATA ascii") + 1)
    np.testing.assert_allclose(numbers[:, 2] * numbers[:, 3], 1.0, rtol=1e-5)


def test_several_views(recording: Path, tmp_path: Path) -> None:
    assert _run("--datapath", recording, "--out", tmp_path / "map", "--reference", "baseline", "--view-baseline",
                "0.12", "--adaptive_threshold_c", "1", "--no-pictures", *FAST) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"map.ply", "map_view000_depth.npy", "map_view001_depth.npy", "map_meta.json"} <= names
    assert not any(name.endswith(".png") or "camera" in name for name in names)


def test_depth_range_from_the_cloud_and_poses_of_the_odometry(recording: Path, tmp_path: Path) -> None:
    write_npy(tmp_path / "run", _trajectory())
    assert _run("--events", recording / "events.h5", "--calib", recording / "calib.yaml", "--poses",
                tmp_path / "run_poses.npy", "--cloud", recording / "sparse.ply", "--out", tmp_path / "map",
                "--no-pictures", "--packet_size", "128") == 0
    view = json.loads((tmp_path / "map_meta.json").read_text("utf-8"))["views"][0]
    assert 0.7 < view["min_depth"] < 1.0 and 1.4 < view["max_depth"] < 1.8


def test_inverse_poses_are_noticed_and_can_be_declared(recording: Path, tmp_path: Path,
                                                       capsys: pytest.CaptureFixture[str]) -> None:
    trajectory = _trajectory()
    write_tum(tmp_path / "inverse.txt", Trajectory(trajectory.t_us, inverted(trajectory.world_T_cam)))
    words = ["--datapath", recording, "--poses", tmp_path / "inverse.txt", "--no-pictures", *FAST]
    assert _run(*words, "--out", tmp_path / "wrong", "--adaptive_threshold_c", "0") == 0
    assert "WARNING: the inverse poses give a sharper result" in capsys.readouterr().err
    assert _run(*words, "--out", tmp_path / "declared", "--pose_convention", "T_cw") == 0
    assert "WARNING" not in capsys.readouterr().err
    assert _run("--datapath", recording, "--no-pictures", *FAST, "--out", tmp_path / "right") == 0
    np.testing.assert_allclose(np.load(tmp_path / "declared.npy"), np.load(tmp_path / "right.npy"), atol=1e-5)


def test_flagfile_as_others_write_it(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "board.conf").write_text(
        "--bag_filename=board.bag\n--event_topic=/dvs/events\n# a comment\n\n--start_time_s=0.1\n--stop_time_s=0.9\n"
        "--min_depth=0.6\n--max_depth=4\n--dimZ=30\n--adaptive_threshold_c=4\n", "utf-8")
    assert _run("--datapath", recording, "--flagfile", tmp_path / "board.conf", "--max_depth", "3", "--packet_size",
                "128", "--out", tmp_path / "map", "--no-pictures") == 0
    meta = json.loads((tmp_path / "map_meta.json").read_text("utf-8"))
    assert (meta["settings"]["min_depth"], meta["settings"]["max_depth"], meta["settings"]["dimZ"]) == (0.6, 3.0, 30)
    assert meta["views"][0]["start_us"] == pytest.approx(100_000) and meta["views"][0]["stop_us"] <= 900_001


def test_published_defaults() -> None:
    args = run_emvs.build_arg_parser().parse_args(["--out", "x"])
    expected = {"dimX": 0, "dimY": 0, "dimZ": 100, "fov_deg": 0.0, "start_time_s": 0.0, "stop_time_s": 1000.0,
                "adaptive_threshold_kernel_size": 5, "adaptive_threshold_c": 5.0, "median_filter_size": 5,
                "radius_search": 0.05, "min_num_neighbors": 3}
    assert {name: getattr(args, name) for name in expected} == expected


def test_nothing_believed_leaves_the_pictures_and_says_so(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(DevoError, match="lower --adaptive_threshold_c") as caught:
        _run("--datapath", recording, "--out", tmp_path / "map", "--adaptive_threshold_c", "300", *FAST)
    assert caught.value.exit_code == 1
    assert (tmp_path / "map_confidence.png").is_file() and len(read_cloud(tmp_path / "map.ply")) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give --datapath FOLDER, or --events"),
        (["--bag_filename", "a.bag"], "a.bag: ROS bags are not read"),
        (["--events", "{rec}/events.h5"], "--poses and --calib needed: or give --datapath"),
        (["--datapath", "{tmp}", "--events", "{rec}/events.h5", "--calib", "{rec}/calib.yaml"], "--poses needed"),
        (["--datapath", "{tmp}"], "no event file"),
        (["--datapath", "{rec}", "--poses", "{rec}/nowhere.txt"], "nowhere.txt: cannot be read"),
        (["--datapath", "{rec}", "--poses", "{rec}/groundtruth.txt", "--pose_format", "tum_us"], "only 0.000"),
        (["--datapath", "{rec}", "--start_time_s", "5"], "none lies in the window"),
        (["--datapath", "{rec}", "--start_time_s", "5", "--stop_time_s", "4"], "is empty"),
        (["--datapath", "{rec}", "--min_depth", "3", "--max_depth", "2"], "min_depth 3 is not below"),
        (["--datapath", "{rec}", "--cloud", "{tmp}/empty.ply"], "empty.ply: the cloud has 0 points"),
        (["--datapath", "{rec}", "--cloud", "{tmp}/nan.ply"], "nan.ply: the cloud has 4 points and none is finite"),
        (["--datapath", "{rec}", "--cloud", "{tmp}/behind.ply"], "none of the 4 finite points"),
        (["--datapath", "{rec}", "--flagfile", "{tmp}/bad.conf"], "expected one --name=value per line"),
        (["--datapath", "{rec}", "--flagfile", "{tmp}/none.conf"], "none.conf: cannot be read"),
        (["--datapath", "{tmp}/nowhere"], "nowhere is no folder"),
    ],
)
def test_errors(recording: Path, tmp_path: Path, words: list[str], message: str) -> None:
    write_cloud(tmp_path / "empty.ply", PointCloud(np.zeros((0, 3))))
    write_cloud(tmp_path / "nan.ply", PointCloud(np.full((4, 3), np.nan)))
    write_cloud(tmp_path / "behind.ply", PointCloud(np.full((4, 3), -5.0)))
    (tmp_path / "bad.conf").write_text("min_depth 3\n", "utf-8")
    with pytest.raises(InputError, match=message):
        _run("--out", tmp_path / "map", *(word.format(rec=recording, tmp=tmp_path) for word in words))
    assert not list(tmp_path.glob("map*"))


def test_as_a_process(repository: Path, recording: Path, tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "DISPLAY")}
    words = ["--datapath", recording, "--out", "map", "--no-pictures", *FAST]
    done = subprocess.run([sys.executable, repository / "scripts" / "run_emvs.py", *map(str, words)], cwd=tmp_path,
                          capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert "points from" in done.stderr and done.stdout == ""
    assert (tmp_path / "map.ply").is_file()


def test_an_error_is_one_line_and_exit_code_2(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(run_emvs.main, ["--datapath", str(recording), "--out", "map", "--dimZ", "1"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "dimZ is 1, expected 2 to" in error


def test_help_is_instant(repository: Path) -> None:
    code = ("import sys; sys.argv = ['run_emvs.py', '--help']; import scripts.run_emvs as script\n"
            "try:\n    script.main()\nexcept SystemExit:\n    pass\n"
            "assert not {'torch', 'numpy'} & set(sys.modules), 'heavy imports'")
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "WO/2018/037079" in done.stdout


def test_a_sequence_of_a_data_set_gives_the_same_map(recording: Path, tmp_path: Path) -> None:
    """Through the reader of a data set, or from the single files of a folder."""
    for name, words in {"files": [], "reader": ["--dataset", "auto"]}.items():
        assert _run("--datapath", recording, *words, "--out", tmp_path / name, "--no-pictures", *FAST) == 0
    np.testing.assert_array_equal(np.load(tmp_path / "reader.npy"), np.load(tmp_path / "files.npy"))
    with pytest.raises(InputError, match="without --events"):
        _run("--datapath", recording, "--dataset", "auto", "--events", "e.h5", "--out", tmp_path / "none", *FAST)


def test_nothing_else_imports_the_mapper(repository: Path) -> None:
    """It stays optional: only what is about EMVS by its name, and the experiment that judges clouds by it, uses it."""
    users = [path.relative_to(repository).as_posix() for top in ("devo", "utils", "evals", "scripts")
             for path in (repository / top).rglob("*.py") if "utils.emvs" in path.read_text("utf-8")]
    assert not [user for user in users if "emvs" not in user and not user.startswith("evals/valid")]
