"""Every product of the export command, on a recording whose scene and camera path are known.

The events are those of dots on known walls; the network is an oracle that answers with the true flow, so the whole
command runs in seconds and the clouds have a ground truth.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import threading
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

import utils.eval_utils as drivers
import utils.export_run as export_run
from evals.alignment import umeyama_sim3
from scripts.export_focus_edge_cloud_only import main as focus_only
from scripts.export_pointcloud import build_arg_parser, main
from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleNetwork, OracleScene, OracleTracker
from tests.utils.dotted_scene import FRAME_US, write_recording
from utils.cli import run_cli
from utils.clouds.io import read_cloud
from utils.edge_clouds.settings import EdgeSettings, FocusSettings
from utils.export_options import ExportOptions
from utils.frame_bundle import read_frame_bundle
from utils.trajectory_io import inverted, rotation_matrices

FRAMES = 20
CAMERA = ["--image_size", WIDTH, HEIGHT, "--intrinsics", *INTRINSICS.tolist()]
SETTINGS = ["PATCHES_PER_FRAME", 48, "REMOVAL_WINDOW", 10, "OPTIMIZATION_WINDOW", 6, "PATCH_LIFETIME", 6, "NORM",
            "none", "MIXED_PRECISION", "False", "KEYFRAME_THRESH", 9.0]
ALL = ["--export_frame_data", "--export_edge_cloud", "--edge-max-dist", 12, "--edge-topk", 300,
       "--export_focus_edge_cloud", "--focus-max-dist", 12, "--focus_downsample", 2, "--focus_keyframe_stride", 4,
       "--save_dpviewer_cloud", "--save_per_frame_cloud", "--viz-flow", "--convert_ply"]
EXPECTED = {"dataset", "datapath", "side", "config", "weights", "edge_cloud_exported", "edge_cloud_path", "edge_topk",
            "edge_border", "edge_knn", "edge_max_dist", "focus_edge_cloud_exported", "focus_edge_cloud_path",
            "focus_topk", "focus_border", "focus_knn", "focus_max_dist", "focus_support", "focus_support_stride",
            "focus_rho_samples", "focus_rho_rel", "focus_rho_abs", "focus_patch_radius", "focus_min_peak_ratio",
            "focus_min_score", "focus_min_baseline", "focus_keyframe_stride", "focus_max_keyframes", "start_us",
            "stop_us", "H", "W", "intrinsics_file", "intrinsics_fx_fy_cx_cy", "start_pose_xyz_quat_xyzw",
            "start_timestamp_us", "num_poses", "point_cloud_shape", "depths_shape", "flow_saved", "export_frame_data",
            "save_per_frame_cloud", "schema_version", "pose_convention", "depths_convention", "scale", "git_revision",
            "seed", "runtime_s", "n_keyframes", "n_skipped_voxels", "focus_downsample"}


@pytest.fixture
def scene() -> OracleScene:
    return OracleScene(FRAMES, 0.12)


@pytest.fixture
def export(scene: OracleScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict]:
    """Run the command on the dotted recording; returns the description of the run."""
    recording = write_recording(tmp_path / "events.npz", scene)
    monkeypatch.setattr(drivers, "DEVO", OracleTracker)
    monkeypatch.setattr(export_run, "load_network", lambda *_, **__: OracleNetwork(scene))

    def command(*arguments: object, out: str = "out/run.npy") -> dict:
        words = ["--datapath", recording, "--dataset", "generic", *CAMERA, "--window_ms", FRAME_US / 1000, "--weights",
                 "oracle", "--opts", *SETTINGS, "--out", tmp_path / out, "--save_per_frame_cloud_path",
                 tmp_path / "clouds", *arguments]
        assert run_cli(main, [str(word) for word in words]) == 0
        return json.loads((tmp_path / out).with_name(Path(out).stem + "_meta.json").read_text())

    return command


@pytest.fixture
def no_preview(monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture takes longer than everything else and is drawn once, in `test_all_products`."""
    monkeypatch.setattr(export_run, "write_preview", lambda *_: None)


def test_all_products(export: Callable[..., dict], scene: OracleScene, tmp_path: Path) -> None:
    meta = export(*ALL)
    out = tmp_path / "out"
    assert set(meta) >= EXPECTED
    assert meta["num_poses"] == FRAMES and meta["status"] == "tracked" and meta["seed"] == 0
    assert meta["edge_max_dist"] == 12 and meta["focus_downsample"] == 2 and meta["flow_saved"]
    for name in meta["files"]:
        assert Path(name).stat().st_size > 0
    ours = {path.name for path in out.iterdir()}
    assert ours == {Path(name).name for name in meta["files"]} - {"combined_map.ply"}
    assert ours >= {f"run{ending}" for ending in (
        ".npy", ".ply", ".npz", "_depths.npy", "_poses.npy", "_tstamps.npy", "_meta.json", "_flow.npz", "_frames.npz",
        "_frames.csv", "_edges.npy", "_edges.ply", "_edges_cleaned.ply", "_focus_edges.npy", "_focus_edges.ply",
        "_dpviewer.npy", "_cleaned.ply", "_preview.png", "_trajectory.txt")}
    poses = np.load(out / "run_poses.npy")
    edges = check_edge_cloud(meta, out / "run_edges", "edge_cloud", poses)
    check_edge_cloud(meta, out / "run_focus_edges", "focus_edge_cloud", poses)
    aligned = umeyama_sim3(poses[:, :3].astype(np.float64), scene.world_T_cam.data[:, :3].numpy()).apply(edges)
    distance = scene.distance(torch.from_numpy(aligned))
    assert float(distance.median()) < 0.1, "the walls are about 3 away"
    check_frames(out, meta)
    check_frame_clouds(tmp_path / "clouds", meta)
    with np.load(out / "run_flow.npz") as flow:
        assert {name.split("_", 1)[1] for name in flow.files} == {"ii", "jj", "kk", "coords_est", "n"}
    points = np.load(out / "run_dpviewer.npy")
    assert len(points) >= meta["point_cloud_shape"][0]
    check_stand_alone(tmp_path, meta)


def check_edge_cloud(meta: dict, base: Path, product: str, poses: np.ndarray) -> np.ndarray:
    """Every point is seen from its host frame at the pixel and depth that the file says; returns the points."""
    assert meta[f"{product}_exported"] and Path(meta[f"{product}_path"]) == base.with_suffix(".npy")
    points, cloud = np.load(base.with_suffix(".npy")), read_cloud(base.with_suffix(".ply"))
    assert meta[f"{product}_points"] == len(points) == len(cloud) > 100
    assert points.dtype == np.float32 and np.array_equal(points, cloud.points)
    host = poses[cloud.scalars["host_frame"]].astype(np.float64)
    seen = np.einsum("nji,nj->ni", rotation_matrices(host[:, 3:]), points - host[:, :3])
    fx, fy, cx, cy = INTRINSICS.tolist()
    np.testing.assert_allclose(seen[:, 2], cloud.scalars["depth"], rtol=1e-3)
    np.testing.assert_allclose(fx * seen[:, 0] / seen[:, 2] + cx, cloud.scalars["pixel_x"], atol=0.05)
    np.testing.assert_allclose(fy * seen[:, 1] / seen[:, 2] + cy, cloud.scalars["pixel_y"], atol=0.05)
    return points.astype(np.float64)


def check_frames(out: Path, meta: dict) -> None:
    """Bundle and table tell the same, in the conventions they name."""
    with np.load(out / "run_frames.npz") as arrays:
        kinds = {name: str(arrays[name].dtype) for name in arrays.files}
        assert str(arrays["pose_convention"]) == "T_cam_world" and str(arrays["depths_convention"]) == "z-depth"
        np.testing.assert_allclose(arrays["depths"] * arrays["inv_depths"], 1.0, rtol=1e-5)
    assert {"frame_ids": "int64", "timestamps": "float64", "poses": "float32", "intrinsics": "float32",
            "counts": "int32", "offsets": "int64", "points": "float32", "depths": "float32",
            "centers": "float32"}.items() <= kinds.items()
    bundle = read_frame_bundle(out / "run_frames.npz")
    poses = np.load(out / "run_poses.npy")
    np.testing.assert_allclose(inverted(bundle.cam_T_world)[:, :3], poses[bundle.frame_ids, :3], atol=1e-5)
    assert int(bundle.keyframe.sum()) <= meta["n_keyframes"] and bundle.keyframe[-1]
    with (out / "run_frames.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["frame_id"]) for row in rows] == bundle.frame_ids.tolist()
    np.testing.assert_allclose([[float(row[key]) for key in ("tx", "ty", "tz")] for row in rows],
                               poses[bundle.frame_ids, :3], atol=1e-5)


def check_frame_clouds(folder: Path, meta: dict) -> None:
    """One complete file per tracked frame, each with its moment; none before initialisation."""
    clouds = sorted(folder.glob("cloud_*.ply"))
    assert len(clouds) == meta["n_per_frame_clouds"] > 4
    last = read_cloud(clouds[-1])
    assert last.metadata["frame_id"] == str(FRAMES - 1) and len(last.metadata["world_T_cam"].split()) == 7
    assert set(np.unique(last.scalars["host_frame"])) <= set(range(FRAMES))
    assert (folder / "combined_map.ply").is_file()


def check_stand_alone(tmp_path: Path, meta: dict) -> None:
    """The stand-alone command makes the same cloud from the bundle and the recording."""
    words = ["--datapath", tmp_path / "events.npz", "--dataset", "generic", *CAMERA, "--window-ms", FRAME_US / 1000,
             "--frames-npz", tmp_path / "out" / "run_frames.npz", "--out", tmp_path / "again.npy", "--focus-max-dist",
             12, "--focus_downsample", 2, "--focus_keyframe_stride", 4, "--progress_every", 0]
    assert run_cli(focus_only, [str(word) for word in words]) == 0
    np.testing.assert_allclose(np.load(tmp_path / "again.npy"), np.load(meta["focus_edge_cloud_path"]), atol=1e-4)


@pytest.mark.usefixtures("no_preview")
def test_look_ahead_changes_no_byte(export: Callable[..., dict], tmp_path: Path) -> None:
    for workers in (0, 2):
        export("--workers", workers, "--export_edge_cloud", "--no-cleanup", out=f"workers{workers}/run.npy")
    first, second = (tmp_path / f"workers{workers}" for workers in (0, 2))
    names = sorted(path.name for path in first.iterdir() if path.suffix in (".npy", ".ply", ".npz", ".txt", ".png"))
    assert len(names) > 7
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


@pytest.mark.usefixtures("no_preview")
def test_named_files_go_where_they_were_asked_for_and_foreign_ones_stay(export: Callable[..., dict],
                                                                        tmp_path: Path) -> None:
    foreign = tmp_path / "clouds" / "cloud_99999.ply"
    foreign.parent.mkdir()
    foreign.write_text("not of this run")
    meta = export("--export_edge_cloud", "--edge_cloud_out", tmp_path / "x" / "edges", "--export_frame_data",
                  "--frame_data_out", tmp_path / "y" / "frames.npz", "--no-cleanup", "--save_per_frame_cloud",
                  "--per_frame_keep", "last", out="z/run.ply")
    assert meta["edge_cloud_path"] == str(tmp_path / "x" / "edges.npy")
    assert {path.name for path in (tmp_path / "x").iterdir()} == {"edges.npy", "edges.ply"}
    assert {path.name for path in (tmp_path / "y").iterdir()} == {"frames.npz", "frames.csv"}
    assert not (tmp_path / "z" / "run_frames.npz").exists() and meta["cleaned_points"] is None
    assert foreign.read_text() == "not of this run"
    assert {path.name for path in foreign.parent.iterdir()} == {
        "cloud_99999.ply", f"cloud_{FRAMES:05d}.ply", "combined_map.ply"}


@pytest.mark.usefixtures("no_preview")
def test_ctrl_c_keeps_what_exists_and_ends_the_look_ahead(export: Callable[..., dict], tmp_path: Path,
                                                          monkeypatch: pytest.MonkeyPatch,
                                                          capsys: pytest.CaptureFixture[str]) -> None:
    original, calls = OracleTracker.append_factors, []

    def append(self: OracleTracker, *arguments: torch.Tensor) -> None:
        calls.append(1)
        if len(calls) == 21:  # two calls per keyframe
            os.kill(os.getpid(), signal.SIGINT)
        original(self, *arguments)

    monkeypatch.setattr(OracleTracker, "append_factors", append)
    with pytest.raises(AssertionError):  # exit code 1
        export("--export_edge_cloud", "--export_focus_edge_cloud", "--export_frame_data")
    meta = json.loads((tmp_path / "out" / "run_meta.json").read_text())
    assert meta["counters"]["interrupted"] == 1 and 8 < meta["num_poses"] < FRAMES
    assert meta["edge_cloud_exported"] and not meta["focus_edge_cloud_exported"]
    assert "interrupted" in capsys.readouterr().err
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


def test_run_voxel_writes_the_edge_cloud(scene: OracleScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from devo.config import Config
    from utils.datasets.registry import SequenceOptions, open_sequence

    monkeypatch.setattr(drivers, "DEVO", OracleTracker)
    recording = open_sequence("generic", write_recording(tmp_path / "events.npz", scene), SequenceOptions(
        window_ms=FRAME_US / 1000, image_size=(WIDTH, HEIGHT), intrinsics=tuple(INTRINSICS.tolist())))
    cfg = Config().merge_from_list([str(word) for word in SETTINGS])
    values = drivers.run_voxel("unused", cfg, OracleNetwork(scene), iterator=recording.voxels(), export_edge_cloud=True,
                               edge_cloud_out=tmp_path / "edges", edge_topk=50, edge_max_dist=12.0)
    assert len(values) == 3 and 0 < len(np.load(tmp_path / "edges.npy")) <= 50 * FRAMES
    with pytest.raises(drivers.InputError, match="edge_cloud_out"):
        drivers.run_voxel("unused", cfg, OracleNetwork(scene), iterator=iter(()), export_edge_cloud=True)


def test_flags_and_options_have_the_same_names_and_defaults() -> None:
    parsed = vars(build_arg_parser().parse_args(["--datapath", "here"]))
    assert ExportOptions.from_flags(parsed) == ExportOptions("here")
    names = {field.name for field in fields(ExportOptions)} - {"edge", "focus"}
    for prefix, kind in (("edge", EdgeSettings), ("focus", FocusSettings)):
        names |= {f"{prefix}_{field.name}" for field in fields(kind)} - {"edge_edges"}
    assert set(parsed) == names


BAD = {
    "rgb": (["--rgb", "--export_edge_cloud"], "--rgb"), "guard": (["--focus_rho_samples", "5"], "focus_guard"),
    "suffix": (["--edge_cloud_out", "edges.obj"], "edge_cloud_out"), "workers": (["--workers", "-1"], "--workers"),
    "voxel size": (["--voxel_size", "nan"], "--voxel_size"), "radius": (["--ror_radius", "0"], "--ror_radius"),
    "edges": (["--edge_topk", "0"], "--edge_topk"),
}


@pytest.mark.parametrize("case", BAD)
def test_senseless_flags_are_refused_before_the_run(case: str, tmp_path: Path,
                                                    capsys: pytest.CaptureFixture[str]) -> None:
    flags, word = BAD[case]
    code = run_cli(main, ["--datapath", str(tmp_path / "none"), "--out", str(tmp_path / "x.npy"), *flags])
    error = capsys.readouterr().err
    assert code == 2 and word in error and error.count("\n") == 1 and not list(tmp_path.iterdir())
