"""What the README promises is run as it stands there, in order: shell commands and the Python example."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.S | re.M)


def commands() -> list[str]:
    """Every command line in a code block or between backticks that starts a program of this project."""
    lines = [line for block in blocks("(?:bash)?") for line in block.splitlines()]
    lines += re.findall(r"`((?:python|bash) [^`]+)`", README)
    return list(dict.fromkeys(line.strip() for line in lines if line.startswith(("python ", "bash "))))


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recordings that the README talks about: events of a drifting dot pattern."""
    folder = tmp_path_factory.mktemp("readme")
    generator = np.random.default_rng(0)
    count = 60_000
    t = np.sort(generator.integers(0, 300_000, count))
    dot = generator.integers(0, 40, count)
    x = (generator.random(40)[dot] * 240 + t * 1e-4 + generator.integers(0, 4, count)) % 240
    y = (generator.random(40)[dot] * 180 + generator.integers(0, 4, count)) % 180
    events = {"x": x.astype(np.uint16), "y": y.astype(np.uint16), "t": t, "p": (dot % 2).astype(np.uint8)}
    calibration = "width: 240\nheight: 180\nfx: 200.0\nfy: 200.0\ncx: 119.5\ncy: 89.5\ndistortion_model: none\n"
    for name in ("my_recording", "my_walk"):
        (folder / name).mkdir()
        np.savez(folder / name / "events.npz", **events)
        (folder / name / "calib.yaml").write_text(calibration)
    rows = np.stack([events["t"] * 1e-6, events["x"], events["y"], events["p"]], axis=1)
    np.savetxt(folder / "walk.txt", rows[:40_000], fmt=["%.6f", "%d", "%d", "%d"])
    return folder


def test_the_first_screen_has_the_two_commands() -> None:
    first = blocks("bash")[0]
    assert "setup_env.sh" in first and "export_pointcloud.py" in first


@pytest.mark.parametrize("command", commands())
def test_commands_run(command: str, workplace: Path) -> None:
    words = command.replace("--seconds 8", "--seconds 1").split("&&")[0].split()  # the only liberty taken
    program = ROOT / words[1] if words[1] != "-m" else None
    if words[0] == "bash":
        assert program is not None
        checked = subprocess.run(["bash", "-n", str(program)], capture_output=True, text=True, timeout=10)
        assert checked.returncode == 0 and os.access(program, os.X_OK), checked.stderr
        return
    arguments = words[1:] if program is None else [str(program), *words[2:]]
    done = subprocess.run([sys.executable, *arguments], cwd=workplace, capture_output=True, text=True, timeout=300,
                          env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)})
    assert "Traceback" not in done.stderr and done.returncode in (0, 1), done.stderr[-2000:]


@pytest.mark.parametrize("example", blocks("python"))
def test_python_examples_run(example: str, workplace: Path) -> None:
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", example], cwd=workplace, capture_output=True,
                          text=True, timeout=300, env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr[-2000:]


def test_info_names_what_is_installed() -> None:
    done = subprocess.run([sys.executable, "-m", "devo.info"], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    for word in ("torch", "kernels", "built-in weights", "device"):
        assert word in done.stdout
