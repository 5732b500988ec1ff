"""The command lines of the clouds, run as a user runs them: another folder, exit codes, one-line errors."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from devo.errors import DevoError, InputError, TrackingError
from utils.cli import INTERRUPTED, AliasParser, run_cli
from utils.clouds import PointCloud, read_cloud, write_cloud


def _run(repository: Path, folder: Path, script: str, *words: object) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "DISPLAY")}
    return subprocess.run([sys.executable, repository / "scripts" / script, *map(str, words)], cwd=folder,
                          capture_output=True, text=True, env=environment)


def _one_line(done: subprocess.CompletedProcess[str], code: int) -> str:
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    return done.stderr


@pytest.fixture
def clustered(tmp_path: Path) -> Path:
    """200 points near the origin and 5 far away, with scalars."""
    points = np.random.default_rng(0).normal(scale=0.1, size=(205, 3)).astype(np.float32)
    points[200:] += 50 * np.arange(1, 6)[:, None]
    write_cloud(tmp_path / "cloud.ply", PointCloud(points, scalars={"row": np.arange(205)}))
    np.save(tmp_path / "cloud.npy", points)
    return tmp_path


# --- npy2ply ------------------------------------------------------------------------------------------------


def test_npy2ply(repository: Path, clustered: Path) -> None:
    (clustered / "cloud.ply").unlink()
    done = _run(repository, clustered, "npy2ply.py", "cloud.npy")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "cloud.ply: 205 points\n"
    assert (clustered / "cloud.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    np.testing.assert_array_equal(read_cloud(clustered / "cloud.ply").points, np.load(clustered / "cloud.npy"))


def test_npy2ply_with_everything(repository: Path, tmp_path: Path) -> None:
    points = np.arange(12.0).reshape(4, 3)
    points[2, 1] = np.nan
    np.save(tmp_path / "p.npy", points)
    np.save(tmp_path / "c.npy", np.arange(12, dtype=np.uint8).reshape(4, 3))
    np.savez(tmp_path / "q.npz", depth=np.arange(4.0), host_frame=np.arange(4, dtype=np.int32))
    done = _run(repository, tmp_path, "npy2ply.py", "p.npy", "--out", "sub/o.ply", "--ascii", "--colors", "c.npy",
                "--attrs", "q.npz", "--drop-nonfinite")
    assert done.stdout == f"{Path('sub/o.ply')}: 3 points, 1 non-finite left out\n"
    found = read_cloud(tmp_path / "sub" / "o.ply")
    np.testing.assert_array_equal(found.points, points[[0, 1, 3]])
    np.testing.assert_array_equal(found.colors[:, 0], [0, 3, 9])
    np.testing.assert_array_equal(found.scalars["host_frame"], [0, 1, 3])
    assert b"format ascii" in (tmp_path / "sub" / "o.ply").read_bytes()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["nowhere.npy"], "nowhere.npy: cannot be read"),
        (["wrong.txt"], "wrong.txt: expected a .npy file"),
        (["flat.npy"], r"flat.npy: points must be a real array of shape (N, 3), found float64 of shape (7,)"),
        (["garbage.npy"], "garbage.npy: is no NPY array"),
        (["good.npy", "--out", "good.xyz"], "good.xyz: unknown kind of cloud file"),
        (["good.npy", "--colors", "good.npy"], "good.npy: colors must be uint8"),
        (["good.npy", "--attrs", "garbage.npy"], "garbage.npy: is no NPZ archive"),
        ([], "the following arguments are required: input"),
        (["good.npy", "--colour", "x"], "unrecognized arguments: --colour"),
    ],
)
def test_npy2ply_refuses_on_one_line(repository: Path, tmp_path: Path, words: list[str], expected: str) -> None:
    np.save(tmp_path / "flat.npy", np.zeros(7))
    np.save(tmp_path / "good.npy", np.zeros((2, 3)))
    (tmp_path / "garbage.npy").write_text("no array\n")
    (tmp_path / "wrong.txt").write_text("1 2 3\n")
    before = sorted(tmp_path.iterdir())
    line = _one_line(_run(repository, tmp_path, "npy2ply.py", *words), 2)
    assert line.startswith("npy2ply.py: error: ")
    assert expected in line
    assert sorted(tmp_path.iterdir()) == before


def test_npy2ply_that_cannot_write_ends_with_1(repository: Path, clustered: Path) -> None:
    line = _one_line(_run(repository, clustered, "npy2ply.py", "cloud.npy", "--out", "/proc/devo-test/c.ply"), 1)
    assert "cannot write /proc/devo-test/c.ply" in line


# --- cleanup ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["-i", "cloud.ply", "-a", "sor"], "sor(neighbors=20, std_ratio=2, backend="),
        (["--input-file", "cloud.ply", "--algorithm", "sor", "--nb_neighbors", "10", "--std-ratio=1.5"],
         "sor(neighbors=10, std_ratio=1.5, backend="),
        (["--input_file", "cloud.ply", "-a", "ror", "--radius", "0.5", "--min-neighbors", "3"],
         "ror(radius=0.5, min_neighbors=3, backend="),
        (["-i", "cloud.ply", "-a", "ror", "--radius", "auto"], "ror(radius="),
    ],
)
def test_cleanup_removes_the_far_points(repository: Path, clustered: Path, words: list[str], name: str) -> None:
    done = _run(repository, clustered, "cleanup_pointcloud.py", *words, "--verbose")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(name)
    assert done.stdout.endswith("cloud_cleaned.ply\n")
    rows = read_cloud(clustered / "cloud_cleaned.ply").scalars["row"]
    assert set(rows) <= set(range(200))
    assert len(rows) > 150
    assert len(read_cloud(clustered / "cloud.ply")) == 205


def test_cleanup_between_formats(repository: Path, clustered: Path) -> None:
    done = _run(repository, clustered, "cleanup_pointcloud.py", "-i", "cloud.npy", "-a", "sor", "-o", "out/c.pcd")
    assert done.returncode == 0, done.stderr
    assert f"sor: kept {len(read_cloud(clustered / 'out' / 'c.pcd'))} of 205 points" in done.stdout


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["-i", "nowhere.ply", "-a", "sor"], 2, "nowhere.ply: cannot be read"),
        (["-i", "empty.ply", "-a", "sor"], 2, "empty.ply: the cloud is empty"),
        (["-i", "cut.ply", "-a", "sor"], 2, "cut.ply: truncated"),
        (["-i", "cloud.ply"], 2, "--algorithm"),
        (["-i", "cloud.ply", "-a", "statistical"], 2, "invalid choice: 'statistical'"),
        (["-i", "cloud.ply", "-a", "ror", "--radius", "-1"], 2, "positive length or auto"),
        (["-i", "cloud.ply", "-a", "ror", "--radius", "nan"], 2, "positive length or auto"),
        (["-i", "cloud.ply", "-a", "sor", "--nb-neighbors", "1"], 2, "neighbors >= 2"),
        (["-i", "cloud.ply", "-a", "ror", "--radius", "1e-9"], 1, "no point passed, nothing was written"),
        (["-i", "cloud.ply", "-a", "sor", "-o", "/proc/devo-test/c.ply"], 1, "cannot write"),
        (["-i", "cloud.ply", "-a", "sor", "--display"], 2, "there is no display"),
    ],
)
def test_cleanup_fails_on_one_line(
    repository: Path, clustered: Path, words: list[str], code: int, expected: str
) -> None:
    write_cloud(clustered / "empty.ply", PointCloud(np.empty((0, 3))))
    (clustered / "cut.ply").write_bytes((clustered / "cloud.ply").read_bytes()[:-1])
    before = sorted(clustered.iterdir())
    assert expected in _one_line(_run(repository, clustered, "cleanup_pointcloud.py", *words), code)
    assert sorted(clustered.iterdir()) == before


# --- what all command lines share ---------------------------------------------------------------------------


@pytest.mark.parametrize("script", ["npy2ply", "cleanup_pointcloud"])
def test_help_loads_nothing_heavy(repository: Path, tmp_path: Path, script: str) -> None:
    code = (f"import sys; sys.path.insert(0, {str(repository)!r}); sys.argv = ['{script}.py', '--help']\n"
            f"import scripts.{script} as script\n"
            "try:\n    script.main()\nexcept SystemExit as end:\n    assert end.code == 0\n"
            "heavy = {'numpy', 'torch', 'scipy', 'open3d', 'matplotlib', 'cv2', 'h5py'} & set(sys.modules)\n"
            "assert not heavy, heavy\n")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")


def _parser() -> AliasParser:
    parser = AliasParser(prog="tool")
    parser.add_argument("--std_ratio", type=float, default=2.0, help="ratio")
    parser.add_argument("--viz-flow", action="store_true", help="flow")
    parser.add_argument_group("more").add_argument("--start_at_us", "-s", type=int, help="start")
    parser.add_argument("rest", nargs="*")
    return parser


@pytest.mark.parametrize("words", [["--std_ratio", "3"], ["--std-ratio", "3"], ["--std-ratio=3"], ["--std_ratio=3"]])
def test_underscores_and_hyphens_are_one(words: list[str]) -> None:
    found = _parser().parse_args([*words, "--viz_flow", "--start-at_us", "-5"])
    assert found == argparse.Namespace(std_ratio=3.0, viz_flow=True, start_at_us=-5, rest=[])


def test_words_behind_a_double_hyphen_stay_as_they_are() -> None:
    assert _parser().parse_args(["--viz_flow", "--", "--std-ratio"]).rest == ["--std-ratio"]


def test_subcommands_share_the_aliases() -> None:
    parser = AliasParser(prog="tool")
    parser.add_subparsers(dest="verb").add_parser("clean").add_argument("--out_file")
    assert parser.parse_args(["clean", "--out-file", "x"]).out_file == "x"


def test_help_shows_each_flag_once_with_telling_defaults() -> None:
    text = _parser().format_help()
    assert "--std-ratio" not in text
    assert "(default: 2.0)" in text
    assert text.count("(default") == 1


def test_abbreviations_are_not_guessed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        _parser().parse_args(["--std", "3"])
    assert end.value.code == 2
    assert capsys.readouterr().err == "tool: error: unrecognized arguments: --std (see tool --help)\n"


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("no such\n  file"), 2, "tool: error: no such file\n"),
        (TrackingError("lost"), 1, "tool: error: lost\n"),
        (DevoError("other"), 1, "tool: error: other\n"),
        (KeyboardInterrupt(), INTERRUPTED, "tool: interrupted; files that were completed before are kept\n"),
    ],
)
def test_run_cli_turns_errors_into_codes(
    error: BaseException, code: int, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["/some/where/tool"])

    def main(argv: object) -> int:
        raise error

    assert run_cli(main, []) == code
    assert capsys.readouterr().err == line


def test_run_cli_leaves_defects_their_traceback() -> None:
    def main(argv: object) -> int:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_cli(main, [])
    assert run_cli(lambda argv: None, []) == 0
    assert run_cli(lambda argv: 3, []) == 3


def test_a_closed_pipe_ends_quietly(repository: Path) -> None:
    code = ("import sys; from utils.cli import run_cli\n"
            "def main(argv):\n    [print('x' * 100) for _ in range(10000)]\n    sys.stdout.flush()\n"
            "sys.exit(run_cli(main))")
    with subprocess.Popen([sys.executable, "-c", code], cwd=repository, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 0
