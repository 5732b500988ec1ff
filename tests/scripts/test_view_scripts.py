"""The commands that show clouds or hand them over, as a user runs them: products, defaults, errors on one line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

import scripts.export_colmap as export_colmap
import scripts.export_pointcloud_from_rosbag as export_from_bag
import scripts.plot_pointcloud as plot_pointcloud
import scripts.plot_trajectory as plot_trajectory
import scripts.pointcloud_to_rosbag as to_bag
import scripts.prepare_emvs_bag as prepare
import scripts.view_pointcloud as view
from tests.utils.bag_samples import pieces, write_bag
from utils.calibration import Calibration
from utils.cli import run_cli
from utils.clouds import PointCloud, read_cloud, write_cloud
from utils.colmap.observations import Observations, save_observations
from utils.events import make_events, write_events_h5
from utils.trajectory_io import Trajectory, rotation_matrices, write_npy, write_tum

SCRIPTS = {"view_pointcloud": view, "plot_pointcloud": plot_pointcloud, "plot_trajectory": plot_trajectory,
           "export_colmap": export_colmap, "pointcloud_to_rosbag": to_bag, "prepare_emvs_bag": prepare,
           "export_pointcloud_from_rosbag": export_from_bag}
CAMERA = np.array([60.0, 60.0, 31.5, 23.5])


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small finished export `run*`, its recording, and files that are no use."""
    folder = tmp_path_factory.mktemp("results")
    rng = np.random.default_rng(0)
    share = np.linspace(0, 1, 10)
    poses = np.c_[share, 0.2 * share, 0 * share, np.tile([0, 0, 0, 1.0], (10, 1))]
    track = Trajectory((share * 900_000).astype(int), poses)
    points = np.c_[rng.uniform(-1, 1.5, (60, 2)), rng.uniform(3, 4, 60)].astype(np.float32)
    point, frame = np.divmod(np.arange(600), 10)
    seen = np.einsum("eji,ej->ei", rotation_matrices(poses[:, 3:])[frame], points[point] - poses[frame, :3])
    pixel = (seen[:, :2] / seen[:, 2:] * CAMERA[:2] + CAMERA[2:]).astype(np.float32)
    scalars = {"host_frame": np.zeros(60, np.int64), "t_us": np.zeros(60), "pixel_x": pixel[::10, 0],
               "pixel_y": pixel[::10, 1], "depth": points[:, 2], "observations": np.arange(60)}
    cloud = PointCloud(points, rng.integers(0, 255, (60, 3)).astype(np.uint8), scalars)
    for name in ("run.ply", "run.npz", "run_cleaned.ply", "run.npy"):
        write_cloud(folder / name, cloud)
    write_npy(folder / "run", track)
    write_tum(folder / "truth.txt", track)
    save_observations(folder / "run_observations.npz", Observations(60, point, frame, pixel, np.ones(600, np.float32)))
    meta = {"pose_convention": "T_world_cam", "intrinsics_fx_fy_cx_cy": CAMERA.tolist(), "W": 64, "H": 48}
    (folder / "run_meta.json").write_text(json.dumps(meta))
    events = make_events(rng.integers(0, 64, 4000), rng.integers(0, 48, 4000), np.sort(rng.integers(0, 900_000, 4000)),
                         rng.integers(0, 2, 4000))
    (folder / "walk").mkdir()
    write_events_h5(folder / "walk" / "events.h5", events, sensor_size=(64, 48))
    camera = Calibration(64, 48, *CAMERA.tolist())
    (folder / "walk" / "calib.yaml").write_text(yaml.safe_dump(camera.as_dict()))
    write_bag(folder / "events.bag", {"/dvs/events": pieces(events, 5)})
    write_bag(folder / "stereo.bag", {"/left/events": [events], "/right/events": [events]})
    (folder / "garbage.ply").write_text("no cloud")
    np.save(folder / "nan_poses.npy", np.full((4, 7), np.nan))
    np.save(folder / "lone_poses.npy", poses)
    return folder


@pytest.fixture
def call(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
         monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, str, str]]:
    """A command inside this process; `{out}` in its words is a fresh folder, other names lie in the run's folder."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    def command(script: str, *words: object) -> tuple[int, str, str]:
        monkeypatch.chdir(run_folder)
        filled = [str(word).format(out=tmp_path) for word in words]
        monkeypatch.setattr(sys, "argv", [f"{script}.py", *filled])
        capsys.readouterr()
        try:
            code = run_cli(SCRIPTS[script].main, filled)
        except SystemExit as end:
            code = int(end.code or 0)
        output = capsys.readouterr()
        return code, output.out, output.err

    return command


# --- every command as a process of its own ----------------------------------------------------------------------


COMMANDS = {
    "view_pointcloud": (["run_cleaned.ply", "--html", "{out}/v.html"], ["v.html"]),
    "plot_pointcloud": (["run_cleaned.ply", "--plane", "xz", "-o", "{out}/p.png"], ["p.png"]),
    "plot_trajectory": (["--poses", "run_poses.npy", "--points", "run.ply", "--out", "{out}/t.png"], ["t.png"]),
    "export_colmap": (["--run", "run", "--colmap-dir", "{out}"], ["cameras.txt", "images.txt", "points3D.txt"]),
    "pointcloud_to_rosbag": (["--input", "run.ply", "--output-bag", "{out}/c.bag"], ["c.bag"]),
    "prepare_emvs_bag": (["--seq-dir", "walk", "--devo-poses-npy", "run_poses.npy", "--devo_tstamps_npy",
                          "run_tstamps.npy", "--out_bag", "{out}/e.bag"], ["e.bag", "e.conf"]),
}


@pytest.mark.parametrize("script", COMMANDS)
def test_as_a_process(repository: Path, run_folder: Path, tmp_path: Path, script: str) -> None:
    words, files = COMMANDS[script]
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "DISPLAY")}
    done = subprocess.run(
        [sys.executable, repository / "scripts" / f"{script}.py", *(word.format(out=tmp_path) for word in words)],
        cwd=run_folder, capture_output=True, text=True, env=environment | {"OMP_NUM_THREADS": "1"}, timeout=300)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == files
    assert all(path.stat().st_size > 0 for path in tmp_path.iterdir())
    assert str(tmp_path) in done.stdout and "Traceback" not in done.stderr


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_loads_nothing_heavy(repository: Path, tmp_path: Path, script: str) -> None:
    code = (f"import sys; sys.path.insert(0, {str(repository)!r}); sys.argv = ['{script}.py', '--help']\n"
            f"import scripts.{script} as script\n"
            "try:\n    script.main()\nexcept SystemExit as end:\n    assert end.code == 0\n"
            "heavy = {'numpy', 'torch', 'scipy', 'open3d', 'matplotlib', 'cv2', 'h5py', 'rosbags'} & set(sys.modules)\n"
            "assert not heavy, heavy\n")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")


# --- what they do without being told ------------------------------------------------------------------------------


def test_without_display_a_page_appears_beside_the_cloud(call: Callable, run_folder: Path) -> None:
    code, out, err = call("view_pointcloud", "run.ply")
    assert code == 0 and "no display" in err and "run_view.html" in out
    page = (run_folder / "run_view.html").read_text("utf-8")
    (run_folder / "run_view.html").unlink()
    assert '"count":60' in page and "10 poses" in page, "the poses of the run are found by their name"
    assert call("view_pointcloud", "run.ply", "--no-poses", "--html", "{out}/v.html")[1].count("poses") == 0


def test_points_can_be_thinned(call: Callable, tmp_path: Path) -> None:
    for words, count in ((["--downsample", 7], 9), (["--radius", "3.4"], None), (["--voxel_size", "100"], 1)):
        code, out, err = call("view_pointcloud", "run.ply", "--html", "{out}/v.html", *words)
        assert code == 0, err
        shown = int(out.split(": ")[1].split(" point")[0])
        assert shown == count if count is not None else 0 < shown < 60


def test_kinds_and_names_of_plots(call: Callable, run_folder: Path, tmp_path: Path) -> None:
    assert call("plot_pointcloud", "--pointcloud", "run.npy", "--format", "svg", "--plane", "yz")[0] == 0
    assert (run_folder / "run_yz.svg").read_text().startswith("<?xml")
    (run_folder / "run_yz.svg").unlink()
    for words in (["--azim", "-90", "--tight"], ["--kind", "overview", "--color-by", "observations"]):
        assert call("plot_pointcloud", "run.ply", "-o", "{out}/p.png", *words)[0] == 0
    assert call("plot_trajectory", "truth.txt", "--unit", "m", "--out", "{out}/t.pdf")[0] == 0
    assert call("plot_trajectory", "--poses", "lone_poses.npy", "--points", "run.ply", "--points-out", "{out}/kept.ply",
                "--radius", 4, "--out", "{out}/t.png")[0] == 0
    assert 0 < len(read_cloud(tmp_path / "kept.ply")) <= 60


def test_colmap_of_a_run_without_observations(call: Callable, run_folder: Path, tmp_path: Path) -> None:
    for name in ("run.npz", "run_poses.npy", "run_meta.json"):
        (tmp_path / name).write_bytes((run_folder / name).read_bytes())
    code, _, err = call("export_colmap", "--run", "{out}/run", "--colmap_dir", "{out}/model")
    assert code == 2 and "--save_observations" in err and not (tmp_path / "model").exists()
    code, out, _ = call("export_colmap", "--run", "{out}/run", "--colmap_dir", "{out}/model", "--min-track", 1)
    assert code == 0 and "60 observations" in out


def test_colmap_of_frames_runs_the_odometry(call: Callable, tmp_path: Path) -> None:
    """Random voxel grids and an untrained network cannot be tracked: the command says so and writes nothing."""
    import h5py

    (tmp_path / "frames").mkdir()
    for number in range(4):
        with h5py.File(tmp_path / "frames" / f"{number:03d}.h5", "w") as file:
            file["voxel"] = np.random.default_rng(number).normal(size=(5, 48, 64)).astype(np.float32)
    camera = ["--fx", 60, "--fy", 60, "--cx", 31.5, "--cy", 23.5, "--weights", "random:0:16,16,8", "--colmap_dir",
              "{out}/model"]
    code, _, err = call("export_colmap", "--input", "{out}/frames", *camera, "--width", 64, "--height", 48)
    assert code == 1 and "not initialised" in err.strip().splitlines()[-1]
    code, _, err = call("export_colmap", "--input", "{out}/frames", *camera, "--width", 32, "--height", 48)
    assert code == 2 and "64x48" in err.strip().splitlines()[-1]
    assert not (tmp_path / "model").exists()


def test_a_bag_goes_straight_into_the_odometry(call: Callable, tmp_path: Path) -> None:
    tiny = ["--weights", "random:0:16,16,8", "--opts", "PATCHES_PER_FRAME", "8", "--delta-ms", 50]
    camera = ["--intrinsics", *CAMERA.tolist(), "--image_size", 64, 48]
    code, _, err = call("export_pointcloud_from_rosbag", "--bag", "events.bag", *camera, *tiny, "--output-dir",
                        "{out}/b")
    assert code == 1 and "not initialised" in err.strip().splitlines()[-1]  # noise and an untrained network
    meta = json.loads((tmp_path / "b" / "point_cloud_meta.json").read_text())
    assert meta["dataset"] == "generic" and meta["sequence"]["counts"]["events"] == 4000
    assert meta["sequence"]["windows"]["window_us"] == 50_000
    code, _, err = call("export_pointcloud_from_rosbag", "--bag", "stereo.bag", "--event-topic", "right", *camera,
                        *tiny, "--output-dir", "{out}/s")
    assert code == 1 and json.loads((tmp_path / "s" / "point_cloud_meta.json").read_text())["num_poses"] > 0


# --- errors -------------------------------------------------------------------------------------------------------


WRONG = [
    ("view_pointcloud", [], "name a cloud"),
    ("view_pointcloud", ["nowhere.ply"], "nowhere.ply: cannot be read"),
    ("view_pointcloud", ["garbage.ply"], "garbage.ply"),
    ("view_pointcloud", ["run.ply", "--poses", "nan_poses.npy"], "not initialised"),
    ("view_pointcloud", ["run.ply", "--color-by", "mood", "--html", "{out}/v.html"], "depth, height"),
    ("view_pointcloud", ["run.ply", "--downsample", "0"], "--downsample"),
    ("view_pointcloud", ["run.ply", "--voxel_size", "-1"], "positive size"),
    ("view_pointcloud", ["run.ply", "--no-poses", "--radius", "1"], "needs --poses"),
    ("view_pointcloud", ["run.ply", "--intrinsics", "0", "1", "2", "3"], "no camera"),
    ("view_pointcloud", ["run.ply", "--frustum_scale", "nan"], "positive length"),
    ("view_pointcloud", ["run.ply", "--max_points", "0"], "--max_points"),
    ("plot_pointcloud", ["run.ply", "-o", "{out}/p.bmp"], "pictures end in"),
    ("plot_pointcloud", ["run.ply", "-o", "{out}/p.png", "--format", "svg"], "pictures end in .svg"),
    ("plot_pointcloud", ["run.ply", "--plane", "yx"], "invalid choice"),
    ("plot_pointcloud", ["run.ply", "--azim", "inf", "-o", "{out}/p.png"], "finite degrees"),
    ("plot_pointcloud", ["run.ply", "--point-size", "-3"], "--point_size"),
    ("plot_pointcloud", ["run.npy", "--color-by", "time"], "'time'"),
    ("plot_trajectory", ["--points", "run.ply"], "name the camera poses"),
    ("plot_trajectory", ["nowhere_poses.npy"], "nowhere_poses.npy"),
    ("plot_trajectory", ["nan_poses.npy"], "not initialised"),
    ("plot_trajectory", ["--frames", "run.npz"], "frame bundle"),
    ("export_colmap", [], "one of the arguments"),
    ("export_colmap", ["--run", "nothing"], "no finished export"),
    ("export_colmap", ["--run", "run", "--max-error-px", "0"], "tracks need"),
    ("export_colmap", ["--run", "run", "--min-track", "99"], "none of the 60 points"),
    ("export_colmap", ["--input", "walk"], "--width and --height"),
    ("export_colmap", ["--input", "walk", "--width", "64", "--height", "48", "--fx", "3"], "--intrinsics_file"),
    ("export_colmap", ["--datapath", "nowhere"], "nowhere"),
    ("pointcloud_to_rosbag", ["--input", "garbage.ply", "--output_bag", "{out}/a.bag"], "garbage.ply"),
    ("pointcloud_to_rosbag", ["--input", "run.ply", "--output_bag", "events.bag"], "--overwrite"),
    ("pointcloud_to_rosbag", ["--input", "run.ply"], "--output_bag"),
    ("prepare_emvs_bag", ["--poses", "run_poses.npy", "--out_bag", "{out}/e.bag"], "name the recording"),
    ("prepare_emvs_bag", ["--poses", "lone_poses.npy", "--datapath", "walk", "--out_bag", "{out}/e.bag"],
     "lone_tstamps.npy"),
    ("prepare_emvs_bag", ["--poses", "run_poses.npy", "--datapath", "walk", "--out_bag", "events.bag"], "--overwrite"),
    ("export_pointcloud_from_rosbag", ["--bag", "nowhere.bag"], "no such bag"),
    ("export_pointcloud_from_rosbag", ["--bag", "run.ply"], "run.ply"),
    ("export_pointcloud_from_rosbag", ["--bag", "events.bag"], "no camera info"),
    ("export_pointcloud_from_rosbag", ["--bag", "stereo.bag", "--event-topic", "events"], "more than one"),
    ("export_pointcloud_from_rosbag", ["--bag", "events.bag", "--dataset", "fpv"], "--dataset fpv"),
    ("export_pointcloud_from_rosbag", ["--bag", "events.bag", "--delta-ms", "5", "--window-ms", "6"], "same"),
]


@pytest.mark.parametrize(("script", "words", "message"), WRONG)
def test_wrong_use_is_one_line_and_exit_code_2(
    call: Callable, run_folder: Path, tmp_path: Path, script: str, words: list[str], message: str
) -> None:
    before = sorted(run_folder.iterdir())
    code, out, err = call(script, *words)
    last = err.strip().splitlines()[-1]
    assert code == 2 and message in last and out == "", (code, err)
    assert last.startswith(f"{script}.py: error: ") and "Traceback" not in err
    assert sorted(run_folder.iterdir()) == before and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("script", "words"), [
    ("view_pointcloud", ["run.ply", "--html", "/proc/devo-test/v.html"]),
    ("plot_pointcloud", ["run.ply", "-o", "/proc/devo-test/p.png"]),
    ("export_colmap", ["--run", "run", "--colmap_dir", "/proc/devo-test"]),
    ("pointcloud_to_rosbag", ["--input", "run.ply", "--output_bag", "/proc/devo-test/c.bag"])])
def test_what_cannot_be_written_ends_with_1(call: Callable, script: str, words: list[str]) -> None:
    code, out, err = call(script, *words)
    assert code == 1 and "cannot write /proc/devo-test" in err and err.count("\n") == 1 and out == ""
