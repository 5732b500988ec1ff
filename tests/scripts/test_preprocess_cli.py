"""The command line that the preprocessing scripts share: help, arguments, exit codes, what they print."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from tests.utils.raw_layouts.recording import random_recording
from tests.utils.raw_layouts.text_folders import write_ecd
from utils.cli import run_cli

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("pp_*.py"))
LINE = "200 201 120 90 -0.3 0.1 0.001 -0.001 0.01"


def run(script: str, *arguments: object) -> int:
    return run_cli(importlib.import_module(f"scripts.{script}").main, [str(word) for word in arguments])


def test_help_of_all_scripts_is_instant_and_loads_nothing_heavy() -> None:
    """In one process: every script has a short main and all of it comes after parsing."""
    code = ("import importlib, sys, time\nsys.path.insert(0, '.')\n"
            f"for name in {SCRIPTS}:\n"
            "    try:\n        importlib.import_module('scripts.' + name).main(['--help'])\n"
            "    except SystemExit as leave:\n        assert not leave.code\n"
            "heavy = {'torch', 'numpy', 'cv2', 'h5py', 'rosbags'} & set(sys.modules)\nassert not heavy, heavy\n"
            "assert time.process_time() < 0.5\n")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60,
                          check=False)
    assert done.returncode == 0, done.stderr
    assert len(SCRIPTS) >= 4
    for script in SCRIPTS:
        assert f"usage: {script}.py" in done.stdout and f"python scripts/{script}.py" in done.stdout
    assert done.stdout.count("--jobs") >= 2 * len(SCRIPTS)


def test_one_folder_by_position_or_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_ecd(tmp_path, random_recording(start_us=0, count=50), LINE)
    assert run("pp_ecd", tmp_path, "--no-images") == 0
    output = capsys.readouterr()
    assert output.out == f"{folder}: tss_us.txt, calib_undist.txt, rectify_map.h5\n"
    assert "preprocessing ecd: 100%" in output.err
    assert run("pp_ecd", "--indir", folder, "--no-images") == 0
    assert capsys.readouterr().out == f"{folder}: nothing to do, all products are there\n"
    assert run("pp_ecd", folder, "--quiet", "--overwrite") == 0
    output = capsys.readouterr()
    assert (output.out, output.err) == ("", "")
    assert (folder / "images_undistorted").is_dir()


@pytest.mark.parametrize(("arguments", "words"), [
    ([], "expected one folder, as positional argument or as --indir"),
    (["a", "--indir", "b"], "two folders were given, a and b"),
    (["a", "--side", "right"], "invalid choice: 'right'"),
    (["a", "--jobs", "many"], "invalid int value: 'many'"),
    (["a", "--on_unsorted", "sort"], "unrecognized arguments"),
])
def test_wrong_command_lines(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leave:
        run("pp_ecd", *arguments)
    assert leave.value.code == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert len(error.splitlines()) == 1


def test_failures_are_one_line_and_the_exit_code_tells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("pp_rpg", tmp_path / "nowhere", "--side", "right") == 2
    assert "does not exist" in capsys.readouterr().err
    good = write_ecd(tmp_path, random_recording(start_us=0, count=50), LINE, "good")
    bad = write_ecd(tmp_path, random_recording(start_us=0, count=50), "200 201", "bad")
    assert run("pp_ecd", tmp_path, "--jobs", 1, "--no-images") == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"error: 1 of 2 recordings failed: {bad}: {bad / 'calib.txt'}: 2 numbers" in error
    assert (good / "rectify_map.h5").is_file()
    blocked = good / "images_undistorted"
    blocked.write_text("a file where a folder should be")
    assert run("pp_ecd", good, "--quiet") == 1
    assert "cannot write" in capsys.readouterr().err
