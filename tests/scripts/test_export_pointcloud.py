"""The export command as a user runs it: products, statuses, and one-line errors."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scripts.export_pointcloud import main
from utils.cli import run_cli

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "export_pointcloud.py"
CAMERA = ["--image_size", "64", "48", "--intrinsics", "60", "60", "31.5", "23.5"]
TINY = ["--weights", "random:0:16,16,8", "--opts", "PATCHES_PER_FRAME", "8"]


def run(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command as a process of its own, as a user starts it."""
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=cwd,
                          env={**os.environ, "OMP_NUM_THREADS": "1"})


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable:
    """The same command inside this process, for the many cases that differ in their input only."""

    def command(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        words = list(map(str, arguments))
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *words])
        if cwd is not None:
            monkeypatch.chdir(cwd)
        capsys.readouterr()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code = run_cli(main, words)
        output = capsys.readouterr()
        return subprocess.CompletedProcess(words, code, output.out, output.err)

    return command


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fifth of a second of random events on a 64x48 sensor."""
    generator = np.random.default_rng(0)
    count = 20000
    path = tmp_path_factory.mktemp("recording") / "events.npz"
    x, y = generator.integers(0, 64, count), generator.integers(0, 48, count)
    t, p = np.sort(generator.integers(0, 200_000, count)), generator.integers(0, 2, count)
    np.savez(path, x=x.astype(np.uint16), y=y.astype(np.uint16), t=t, p=p.astype(np.uint8))
    return path


def one_line_error(done: subprocess.CompletedProcess[str], code: int, *words: str) -> str:
    """The command failed with `code`; its last line says why and there is no traceback."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    line = done.stderr.strip().splitlines()[-1]
    assert line.startswith("export_pointcloud.py: error: "), line
    for word in words:
        assert word in line, line
    return line


def test_help_is_instant_and_loads_no_torch() -> None:
    start = time.process_time()
    code = (f"import sys, runpy; sys.argv = [{str(SCRIPT)!r}, '--help']\n"
            f"try: runpy.run_path({str(SCRIPT)!r}, run_name='__main__')\n"
            "except SystemExit as end: assert not end.code\n"
            "assert 'torch' not in sys.modules and 'numpy' not in sys.modules")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    assert "--window_events" in done.stdout and time.process_time() - start < 5


def test_uninitialised_run_tells_the_truth_and_keeps_the_description(recording: Path, tmp_path: Path) -> None:
    done = run("--dataset", "generic", "--datapath", recording, *CAMERA, *TINY, "--window-ms", 20,
               "--out", tmp_path / "out" / "cloud.npy", "--opts", "PATCHES_PER_FRAME", "8", cwd=tmp_path)
    one_line_error(done, 1, "not initialised", "cloud_meta.json")
    assert "untrained" in done.stderr
    meta = json.loads((tmp_path / "out" / "cloud_meta.json").read_text())
    assert meta["status"] == "not initialized" and meta["num_poses"] == 10
    assert meta["pose_convention"] == "T_world_cam" and meta["scale"] == "arbitrary"
    assert not (tmp_path / "out" / "cloud.npy").exists()


BAD = {
    "missing path": (["--datapath", "{tmp}/none"], ["none"]),
    "no camera": (["--datapath", "{recording}", *TINY], ["--intrinsics"]),
    "zero size": (["--datapath", "{recording}", "--image_size", "0", "0", *CAMERA[3:], *TINY], ["0"]),
    "nan calibration": (["--datapath", "{recording}", *CAMERA[:3], "--intrinsics", "nan", *CAMERA[5:], *TINY], ["nan"]),
    "outside sensor": (["--datapath", "{recording}", "--image_size", "40", "48", *CAMERA[3:], *TINY], ["40"]),
    "no checkpoint": (["--datapath", "{recording}", *CAMERA, "--weights", "{recording}"], ["events.npz"]),
    "missing weights": (["--datapath", "{recording}", *CAMERA, "--weights", "{tmp}/DEVO.pth"], ["DEVO.pth"]),
    "unknown dataset": (["--datapath", "{recording}", "--dataset", "nosuch", *CAMERA, *TINY], ["nosuch", "generic"]),
    "unknown config": (["--datapath", "{recording}", "--config", "nosuch.yaml", *CAMERA, *TINY], ["nosuch.yaml"]),
    "unknown setting": (["--datapath", "{recording}", *CAMERA, *TINY[:2], "--opts", "KEYFRAME_TRESH", "3"],
                        ["KEYFRAME_TRESH"]),
    "cuda without cuda": (["--datapath", "{recording}", *CAMERA, *TINY, "--device", "cuda:7"], ["cuda:7"]),
    "output is a folder of a file": (["--datapath", "{recording}", *CAMERA, *TINY, "--out", "{recording}/cloud.npy"],
                                     ["events.npz"]),
    "unknown output": (["--datapath", "{recording}", *CAMERA, *TINY, "--out", "{tmp}/cloud.obj"], [".obj"]),
    "empty window": (["--datapath", "{recording}", *CAMERA, *TINY, "--start_us", "9e9"], ["start"]),
}


@pytest.mark.parametrize("case", BAD, ids=lambda name: name.replace(" ", "-"))
def test_bad_input_is_one_line_and_exit_code_2(case: str, call: Callable, recording: Path, tmp_path: Path) -> None:
    arguments, words = BAD[case]
    filled = [argument.format(tmp=tmp_path, recording=recording) for argument in arguments]
    extra = [] if "--dataset" in filled else ["--dataset", "generic"]
    out = [] if "--out" in filled else ["--out", tmp_path / "cloud.npy"]
    one_line_error(call(*extra, *filled, *out, cwd=tmp_path), 2, *words)
    assert not list(tmp_path.glob("cloud*"))


def corrupt(kind: str, path: Path, recording: Path) -> None:
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "garbage":
        path.write_bytes(np.random.default_rng(1).bytes(4096))
    elif kind == "truncated":
        path.write_bytes(recording.read_bytes()[:5000])
    else:
        with np.load(recording) as archive:
            events = {name: archive[name].copy() for name in "xytp"}
        events["t"] = events["t"].astype(np.int64)
        if kind == "unsorted":
            events["t"][100] = 0
        elif kind == "negative":
            events["t"] -= 1000
        elif kind == "wrapping":
            events["t"] += 2**32 - 100_000
            events["t"] %= 2**32
        elif kind == "one event":
            events = {name: values[:1] for name, values in events.items()}
        np.savez(path, **events)


@pytest.mark.parametrize("kind", ["empty", "garbage", "truncated", "unsorted", "negative", "wrapping"])
def test_broken_event_files_are_named(kind: str, call: Callable, recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "broken.npz"
    corrupt(kind, path, recording)
    done = call("--dataset", "generic", "--datapath", path, *CAMERA, *TINY, "--out", tmp_path / "cloud.npy")
    one_line_error(done, 2, "broken.npz")


def test_one_event_is_no_motion(call: Callable, recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "single.npz"
    corrupt("one event", path, recording)
    done = call("--dataset", "generic", "--datapath", path, *CAMERA, *TINY, "--out", tmp_path / "cloud.npy")
    assert done.returncode in (1, 2) and "Traceback" not in done.stderr


@pytest.mark.parametrize("file", ["stripes", "garfield", "building"])
@pytest.mark.slow
def test_real_recordings_run_through(file: str, shared_data: Path, tmp_path: Path) -> None:
    done = run("--dataset", "generic", "--datapath", shared_data / "dvs128_handheld" / f"{file}.npz",
               "--image_size", 128, 128, "--intrinsics", 115, 115, 63.5, 63.5, "--window_events", 8000, *TINY,
               "--out", tmp_path / "cloud.npy")
    assert "untrained" in done.stderr
    meta = json.loads((tmp_path / "cloud_meta.json").read_text())
    assert done.returncode == (0 if meta["status"] == "tracked" else 1)


def test_real_calibrated_recording_runs_through(shared_data: Path, tmp_path: Path) -> None:
    """Distorted events, calibration and image time stamps of a real folder; untrained weights cannot track it."""
    done = run("--dataset", "generic", "--datapath", shared_data / "slider_depth_chunk", "--image_size", 240, 180,
               "--window_events", 10000, *TINY, "--out", tmp_path / "cloud.npy")
    assert "untrained" in done.stderr and "Traceback" not in done.stderr
    meta = json.loads((tmp_path / "cloud_meta.json").read_text())
    assert (meta["W"], meta["H"]) == (240, 180) and meta["num_poses"] == 5


def test_wrong_arguments_as_a_user_meets_them(recording: Path, tmp_path: Path) -> None:
    one_line_error(run("--datapath", recording, "--no_such_flag", cwd=tmp_path), 2, "--no_such_flag")
    one_line_error(run("--dataset", "generic", "--datapath", tmp_path / "none", cwd=tmp_path), 2, "none")


def test_a_full_disk_leaves_nothing_half_written(call: Callable, recording: Path, tmp_path: Path,
                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fills up while the poses are written: one line, exit 1, no torn file."""
    import utils.map_recorder as recorder

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(recorder.np, "save", full)
    done = call("--dataset", "generic", "--datapath", recording, *CAMERA, *TINY, "--window-ms", 20,
                "--out", tmp_path / "cloud.npy")
    one_line_error(done, 1, "cloud_poses.npy", "No space left")
    assert not [path for path in tmp_path.iterdir() if path.name != "cloud_meta.json"]
