"""The validation as a user runs it: help, errors on one line, the whole run, and the notebook."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from evals import validate_pointcloud
from tests.evals.validation_samples import write_board

QUICK = ["--trials", "1", "--max_frames", "26", "--emvs_events", "100000", "--emvs_planes", "40", "--view_scale", "1.2",
         "--opts", "PATCHES_PER_FRAME", "48"]
NOTEBOOK = "evals/notebooks/board_slow_shape_validation.ipynb"


def _command(repository: Path, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(repository / "evals" / "validate_pointcloud.py"), *map(str, words)],
                          capture_output=True, text=True, timeout=900, check=False)


def test_help_needs_no_torch(repository: Path) -> None:
    code = ("import sys, runpy; sys.argv = ['validate_pointcloud.py', '--help']\n"
            "try:\n    runpy.run_path(sys.argv[0], run_name='__main__')\n"
            "except SystemExit as done:\n    assert done.code == 0\n"
            "assert not {'torch', 'numpy', 'matplotlib'} & set(sys.modules)\n")
    done = subprocess.run([sys.executable, "-c", code], cwd=repository / "evals", capture_output=True, text=True,
                          timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "--sequence" in done.stdout and "validation.html" in done.stdout


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for words, expected in (
            (["--sequence", str(tmp_path / "none")], "does not exist"), (["--sequence", str(empty)], "empty"),
            (["--sequence", str(empty), "--dataset", "nosuch"], "unknown data set"),
            (["--sequence", str(empty), "--trials", "0"], "trials is 0"),
            (["--sequence", str(empty), "--emvs_median", "4"], "median_filter_size is 4"),
            (["--sequence", str(empty), "--min_depth", "2", "--max_depth", "1"], "min_depth 2 is not below")):
        assert validate_pointcloud.main([*words, "--out", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err.strip()
        assert error.startswith("validate_pointcloud.py: error: ") and expected in error and "\n" not in error
    assert not (tmp_path / "out").exists()


def test_the_notebook_is_thin_and_stripped(repository: Path) -> None:
    import nbformat

    notebook = nbformat.read(repository / NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(cells) >= 6
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)
    assert [cell.metadata.get("tags") for cell in cells].count(["parameters"]) == 1
    text = "\n".join(cell.source for cell in cells)
    assert "def " not in text and "class " not in text and len(text.splitlines()) < 60
    for cell in cells:
        compile(cell.source, cell.id, "exec")


@pytest.mark.slow
def test_a_whole_run_twice(repository: Path, tmp_path: Path) -> None:
    board = write_board(tmp_path / "board", frames=True)
    first = _command(repository, "--sequence", board, "--out", tmp_path / "report", *QUICK)
    assert first.returncode == 0, first.stderr
    assert "requirements are met" in first.stdout and "validation.html" in first.stdout
    assert "odometry" in first.stderr and "EMVS maps" in first.stderr
    values = json.loads((tmp_path / "report" / "validation.json").read_text("utf-8"))
    assert {one["outcome"] for one in values["criteria"]} <= {"met", "missed", "not judged"}
    assert values["maps"]["gt"]["points"] == values["maps"]["gt_scaled"]["points"]
    assert values["image"] and values["depth"]
    cloud = (tmp_path / "report" / "clouds" / "devo_cloud.ply").read_bytes()
    second = _command(repository, "--sequence", board, "--out", tmp_path / "report", *QUICK)
    assert second.returncode == 0, second.stderr
    assert "1 of 1 trials reused" in second.stdout
    assert (tmp_path / "report" / "clouds" / "devo_cloud.ply").read_bytes() == cloud


@pytest.mark.slow
def test_trials_side_by_side_equal_trials_one_by_one(repository: Path, tmp_path: Path) -> None:
    board = write_board(tmp_path / "board")
    tables = []
    for name, processes in (("one", 1), ("two", 2)):
        done = _command(repository, "--sequence", board, "--out", tmp_path / name, *QUICK, "--trials", 2, "--processes",
                        processes)
        assert done.returncode == 0, done.stderr
        rows = (tmp_path / name / "tables" / "trials.csv").read_text("utf-8").splitlines()
        tables.append([row.rsplit(",", 2)[0] for row in rows])  # without seconds
    assert tables[0] == tables[1] and len(tables[0]) == 5  # header, two trials, mean, standard deviation


def test_the_notebook_runs_from_top_to_bottom(repository: Path, tmp_path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    board = write_board(tmp_path / "board")
    notebook = nbformat.read(repository / NOTEBOOK, as_version=4)
    for cell in notebook.cells:
        if "parameters" in cell.metadata.get("tags", []):
            cell.source = (
                f"sequence, dataset, out, seconds = {str(board)!r}, 'auto', {str(tmp_path / 'report')!r}, 1.2\n"
                "options = {'trials': 1, 'max_frames': 26, 'emvs_events': 100_000, 'view_scale': 1.2,\n"
                "           'opts': ('PATCHES_PER_FRAME', '48')}")
    NotebookClient(notebook, timeout=900, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    shown = [output.data for output in outputs if output.output_type == "display_data"]
    assert sum("image/png" in data for data in shown) == 7
    assert any("requirements are met" in data.get("text/markdown", "") for data in shown)
