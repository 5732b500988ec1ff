"""The command line of the simulator."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts.simulate import main
from utils.cli import run_cli


def test_help_does_not_import_torch(repository: Path) -> None:
    code = ("import runpy, sys\nsys.argv = ['simulate.py', '--help']\n"
            "try:\n    runpy.run_path('scripts/simulate.py', run_name='__main__')\n"
            "except SystemExit as leave:\n    assert leave.code == 0\n"
            "heavy = {'torch', 'numpy', 'cv2', 'h5py'} & set(sys.modules)\nassert not heavy, heavy\n")
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--scene" in done.stdout
    assert "[px]" in done.stdout


def test_a_recording_is_written_and_summarised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "board"
    arguments = ["--scene", "board", "--out", str(out), "--seconds", "0.1", "--seed", "1", "--size", "48x36",
                 "--preset", "fast", "--no-depth", "--frames"]
    assert run_cli(main, arguments) == 0
    output = capsys.readouterr()
    assert "events in 0.1 s" in output.out
    assert "thousand a second" in output.out
    assert "simulating" in output.err
    assert sorted(path.name for path in out.iterdir()) == [
        "calib.yaml", "events.h5", "groundtruth.txt", "images", "images_timestamps_us.txt", "scene.json"]
    assert run_cli(main, arguments) == 2, "it exists now"
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(("arguments", "code", "words"), [
    (["--size", "0x0"], 2, "image size"),
    (["--size", "big"], 2, "WIDTHxHEIGHT"),
    (["--seconds", "-3"], 2, "seconds"),
    (["--seed", "-3"], 2, "seed"),
    (["--fps", "0"], 2, "images per second"),
    (["--threshold", "nan"], 2, "threshold"),
    (["--device", "tpu9"], 2, "device"),
])
def test_bad_arguments_give_one_line(arguments: list[str], code: int, words: str, tmp_path: Path,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(main, ["--out", str(tmp_path / "x"), *arguments]) == code
    error = capsys.readouterr().err.strip()
    assert words in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_unwritable_output_is_a_failed_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert run_cli(main, ["--out", str(blocked / "x"), "--seconds", "0.1", "--size", "32x24"]) == 1
    error = capsys.readouterr().err.strip()
    assert "cannot write" in error
    assert len(error.splitlines()) == 1
    assert run_cli(main, ["--out", str(blocked)]) == 2
    assert "is a file" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--out"], ["--scene", "moon", "--out", "x"], ["--unknown", "--out", "x"], []])
def test_wrong_command_lines_exit_with_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leave:
        main(arguments)
    assert leave.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_images_of_a_folder_cover_the_surfaces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    (tmp_path / "pictures").mkdir()
    for name, height, width in (("wide.png", 90, 160), ("tall.jpg", 120, 64)):
        picture = cv2.resize(rng.integers(0, 255, (9, 16), dtype=np.uint8), (width, height))
        assert cv2.imwrite(str(tmp_path / "pictures" / name), picture)
    (tmp_path / "pictures" / "notes.txt").write_text("no image")

    def simulate(*extra: str) -> np.ndarray:
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        assert run_cli(main, ["--scene", "planes", "--out", str(out), "--seconds", "0.1", "--seed", "1", "--size",
                              "48x36", "--no-depth", "--frames", *extra]) == 0
        return cv2.imread(str(sorted((out / "images").iterdir())[0]), cv2.IMREAD_GRAYSCALE)

    covered = simulate("--textures", str(tmp_path / "pictures"))
    np.testing.assert_array_equal(covered, simulate("--textures", str(tmp_path / "pictures")))
    assert np.abs(covered.astype(int) - simulate().astype(int)).mean() > 5, "the textures made no difference"
    capsys.readouterr()

    (tmp_path / "pictures" / "tall.jpg").write_bytes(b"damaged")
    for folder, words in (("pictures", "tall.jpg"), ("nothing", "no images")):
        assert run_cli(main, ["--scene", "planes", "--out", str(tmp_path / "x"), "--textures",
                              str(tmp_path / folder)]) == 2
        assert words in capsys.readouterr().err
