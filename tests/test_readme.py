"""What the README promises is run as it stands there, in order: shell commands and the Python example."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.utils.raw_layouts.hdf5_folders import write_eds, write_mvsec, write_tumvie, write_vector
from tests.utils.raw_layouts.recording import RawRecording
from tests.utils.raw_layouts.stereo_bags import write_hku, write_rpg
from tests.utils.raw_layouts.text_folders import write_ecd, write_fpv
from utils.events import Events, write_events_h5

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHORTER = {"--seconds 8": "--seconds 0.3 --size 64x48"}
"""The only liberty that is taken with the commands."""
CALIBRATION = "width: 240\nheight: 180\nfx: 200.0\nfy: 200.0\ncx: 119.5\ncy: 89.5\ndistortion_model: none\n"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.S | re.M)


def commands() -> list[str]:
    """Every command line in a code block or between backticks that starts a program of this project."""
    lines = [line for block in blocks("(?:bash)?") for line in block.splitlines()]
    lines += re.findall(r"`((?:python|bash) [^`]+)`", README)
    return list(dict.fromkeys(line.strip() for line in lines if line.startswith(("python ", "bash "))))


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recordings that the README talks about: a drifting dot pattern in the form of each data set."""
    folder = tmp_path_factory.mktemp("readme")
    generator = np.random.default_rng(0)
    count = 40_000
    t_us = np.sort(generator.integers(0, 250_000, count))
    dot = generator.integers(0, 40, count)
    x = (generator.random(40)[dot] * 240 + t_us * 1e-4 + generator.integers(0, 4, count)) % 240
    y = (generator.random(40)[dot] * 180 + generator.integers(0, 4, count)) % 180
    events = Events(x.astype(np.uint16), y.astype(np.uint16), t_us, (dot % 2).astype(np.uint8))
    (folder / "my_recording").mkdir()
    write_events_h5(folder / "my_recording" / "events.h5", events, sensor_size=(240, 180))
    (folder / "my_recording" / "calib.yaml").write_text(CALIBRATION)
    rows = np.column_stack([t_us * 1e-6, events.x, events.y, events.p])
    np.savetxt(folder / "walk.txt", rows, fmt=["%.6f", "%d", "%d", "%d"])
    _write_datasets(folder / "datasets", events)
    return folder


def _write_datasets(root: Path, events: Events) -> None:
    poses = np.zeros((10, 7))
    poses[:, 0], poses[:, 6] = np.linspace(0, 1, 10), 1
    images = [np.full((180, 240), 40 * number, np.uint8) for number in range(6)]
    raw = RawRecording((240, 180), events, 5_000 + 33_000 * np.arange(6), images, 20_000 * np.arange(10),
                       poses).later(50_000_000)
    for name in ("fpv", "ecd", "rpg", "hku", "vector", "tumvie", "eds", "mvsec"):
        (root / name).mkdir(parents=True)
    write_fpv(root / "fpv", raw.on_sensor((346, 260)), "indoor_forward_7_davis")
    write_ecd(root / "ecd", raw, "200 201 120 90 -0.3 0.1 0.001 -0.001 0.01")
    write_rpg(root / "rpg", raw, np.eye(4))
    write_hku(root / "hku", raw.on_sensor((346, 260)), np.eye(4))
    write_vector(root / "vector", raw)
    write_tumvie(root / "tumvie", raw)
    write_eds(root / "eds", raw)
    write_mvsec(root / "mvsec", {"left": raw})


def test_the_first_screen_has_the_two_commands() -> None:
    assert [line.split()[1] for line in blocks("bash")[0].splitlines()] == ["scripts/demo.sh",
                                                                            "scripts/start_pipline.py"]
    assert README.index("![") < README.index("```bash") < 800


def test_every_picture_and_named_file_exists() -> None:
    named = set(re.findall(r"\]\(((?:evals|docs)/[^)]+)\)", README))
    named |= set(re.findall(r"`((?:scripts|evals|devo|utils|config)/[\w./-]+\.\w+)`", README))
    assert len(named) >= 8 and not [name for name in named if not (ROOT / name).is_file()]


def run_here(words: list[str]) -> int:
    """Run `python ...` in this process, which saves seconds per command; returns its exit code."""
    sys.argv = words if words[0] != "-m" else words[1:]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if words[0] == "-m":
                runpy.run_module(words[1], run_name="__main__", alter_sys=False)
            else:
                runpy.run_path(str(ROOT / words[0]), run_name="__main__")
        except SystemExit as end:
            return int(end.code or 0)
    return 0


@pytest.mark.parametrize("command", commands())
def test_commands_run(command: str, workplace: Path, monkeypatch: pytest.MonkeyPatch,
                      capsys: pytest.CaptureFixture[str]) -> None:
    for long, short in SHORTER.items():
        command = command.replace(long, short)
    words = shlex.split(command, comments=True)
    if words[0] == "bash":
        program = ROOT / words[1]
        checked = subprocess.run(["bash", "-n", str(program)], capture_output=True, text=True, timeout=60)
        assert checked.returncode == 0 and os.access(program, os.X_OK), checked.stderr
        return
    monkeypatch.chdir(workplace)
    monkeypatch.setattr(sys, "argv", [])
    # a quarter of a second is too short to be tracked, which the commands say with 1; wrong usage would be 2
    assert run_here(words[1:]) in (0, 1), capsys.readouterr().err[-2000:]


@pytest.mark.slow
def test_the_demo_runs(tmp_path: Path) -> None:
    done = subprocess.run(["bash", str(ROOT / "scripts" / "demo.sh")], capture_output=True, text=True, timeout=1800,
                          env={**os.environ, "DEMO_SECONDS": "3", "DEMO_DIR": str(tmp_path)}, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "path: ATE" in done.stdout and "no warnings" in done.stdout
    paths = re.findall(r"^(?:cloud|picture|HTML view) +(/\S+)", done.stdout, flags=re.M)
    assert len(paths) == 3 and all(Path(path).stat().st_size > 1000 for path in paths)


@pytest.mark.parametrize("example", blocks("python"))
def test_python_examples_run(example: str, workplace: Path) -> None:
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", example], cwd=workplace, capture_output=True,
                          text=True, timeout=300, env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr[-2000:]


def test_info_names_what_is_installed() -> None:
    done = subprocess.run([sys.executable, "-m", "devo.info"], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for word in ("torch", "kernels", "built-in weights", "device"):
        assert word in done.stdout
