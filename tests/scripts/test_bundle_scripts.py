"""The commands that start from a frame bundle, as processes of their own: focus cloud and event overlays."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleScene
from tests.utils.dotted_scene import FRAME_US, write_recording
from tests.utils.test_overlays import bundle_of
from utils.cli import run_cli
from utils.clouds.io import read_cloud
from utils.frame_bundle import write_frame_bundle

ROOT = Path(__file__).resolve().parents[2]
CAMERA = ["--dataset", "generic", "--image_size", WIDTH, HEIGHT, "--intrinsics", *INTRINSICS.tolist()]
FRAMES = 7


def run(script: str, *words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(ROOT / "scripts" / script), *map(str, words)], capture_output=True,
                          text=True, timeout=120, cwd=cwd, env={**os.environ, "OMP_NUM_THREADS": "1"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording and the bundle of its true poses."""
    scene, path = OracleScene(FRAMES, 0.25), tmp_path_factory.mktemp("run")
    write_recording(path / "events.npz", scene)
    write_frame_bundle(path / "frames.npz", bundle_of(scene))
    return path


def test_focus_cloud_command(folder: Path, tmp_path: Path) -> None:
    done = run("export_focus_edge_cloud_only.py", "--datapath", folder / "events.npz", *CAMERA, "--window-ms",
               FRAME_US / 1000, "--frames-npz", folder / "frames.npz", "--out", "edges.ply", "--focus-knn", 1,
               "--focus-max-dist", 9, "--focus-downsample", 2, "--cache-dtype", "fp32", "--focus-max-keyframes", 3,
               "--progress-every", 0, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    cloud = read_cloud(tmp_path / "edges.ply")
    assert len(cloud) > 20 and "confidence" in cloud.scalars and f"{len(cloud)} points" in done.stdout
    assert set(np.unique(cloud.scalars["host_frame"])) <= {7, 8, 9}


def test_overlay_command(folder: Path, tmp_path: Path) -> None:
    done = run("build_event_overlays.py", "--frames", folder / "frames.npz", "--scene", folder / "events.npz", *CAMERA,
               "--out", "pictures", "--max_frames", 3, "--singles", "--npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "pictures"
    report = json.loads((out / "overlays.json").read_text())
    assert [row["frame_id"] for row in report["rows"]] == [7, 10, 13] and report["neighbor_score"] > 1.2
    assert {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()} == {
        "overlays.png", "overlays.json", *(f"overlays/overlay_{i:05d}.png" for i in (7, 10, 13)),
        *(f"npz_frames/frame_{i:05d}.npz" for i in (7, 10, 13))}


@pytest.mark.parametrize(("script", "flags", "word"), [
    ("export_focus_edge_cloud_only.py", ["--datapath", "{events}", "--frames_npz", "none.npz", "--out", "x.ply"],
     "none.npz"),
    ("export_focus_edge_cloud_only.py", ["--datapath", "none", "--frames_npz", "{frames}", "--out", "x.ply"], "none"),
    ("export_focus_edge_cloud_only.py", ["--datapath", "{events}", "--frames_npz", "{events}", "--out", "x.ply"],
     "events.npz"),
    ("export_focus_edge_cloud_only.py", ["--datapath", "{events}", "--frames_npz", "{frames}", "--out", "x.obj"],
     ".obj"),
    ("build_event_overlays.py", ["--scene", "{events}", "--frames", "none.npz", "--out", "x"], "none.npz"),
    ("build_event_overlays.py", ["--scene", "{events}", "--frames", "{frames}", "--out", "x", "--sheet", "0"],
     "--sheet"),
])
def test_wrong_input_is_one_line_and_exit_code_2(script: str, flags: list[str], word: str, folder: Path,
                                                 tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    words = [flag.format(events=folder / "events.npz", frames=folder / "frames.npz") for flag in flags]
    monkeypatch.chdir(tmp_path)
    main = importlib.import_module(f"scripts.{script.removesuffix('.py')}").main
    code = run_cli(main, [*words, *map(str, CAMERA)])
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert code == 2 and word in line and ": error: " in line and not list(tmp_path.iterdir())


@pytest.mark.parametrize("script", ["export_focus_edge_cloud_only.py", "build_event_overlays.py"])
def test_help_is_light(script: str, tmp_path: Path) -> None:
    code = (f"import sys, runpy; sys.argv = [{script!r}, '--help']\n"
            f"try: runpy.run_path({str(ROOT / 'scripts' / script)!r}, run_name='__main__')\n"
            "except SystemExit as end: assert not end.code\n"
            "assert 'torch' not in sys.modules and 'numpy' not in sys.modules")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, cwd=tmp_path)
    assert done.returncode == 0 and "--dataset" in done.stdout, done.stderr
