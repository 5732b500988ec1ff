"""The pipeline command: stages, records, resuming, failures, forms of paths; tracking itself is replaced by a stand-in.

One test at the end runs everything for real, as a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devo.errors import TrackingError
from scripts.start_pipline import main
from tests.scripts.export_stand_in import FRAMES, POINTS, StandIn
from utils.cli import run_cli
from utils.clouds.io import read_cloud
from utils.pipeline import stages
from utils.preprocessing import PREPROCESSORS, PreprocessOptions

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "start_pipline.py"
CALIBRATION = "width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\ndistortion_model: none\n"


@pytest.fixture
def tracked(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    stand_in = StandIn()
    monkeypatch.setattr(stages, "export_pointcloud", stand_in)
    return stand_in


@pytest.fixture
def export(tracked: StandIn, monkeypatch: pytest.MonkeyPatch) -> StandIn:
    """The stand-in, and pictures that take no time."""
    monkeypatch.setattr("utils.clouds.preview.save_preview", lambda path, *_, **__: Path(path).write_text("picture"))
    return tracked


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "data" / "walk"
    folder.mkdir(parents=True)
    write_events(folder)
    return folder


def write_events(folder: Path) -> None:
    generator = np.random.default_rng(0)
    count = 4000
    np.savez(folder / "events.npz", x=generator.integers(0, 64, count).astype(np.uint16),
             y=generator.integers(0, 48, count).astype(np.uint16), t=np.sort(generator.integers(0, 190_000, count)),
             p=generator.integers(0, 2, count).astype(np.uint8))
    (folder / "calib.yaml").write_text(CALIBRATION)


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable:
    """Run the command in this process, in an empty working directory."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)

    def command(*arguments: object) -> subprocess.CompletedProcess[str]:
        words = list(map(str, arguments))
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *words])
        capsys.readouterr()
        try:
            code = run_cli(main, words)
        except SystemExit as end:
            code = int(str(end.code))
        output = capsys.readouterr()
        return subprocess.CompletedProcess(words, code, output.out, output.err)

    return command


def statuses(folder: Path) -> dict[str, str]:
    record = json.loads((folder / "pipeline.json").read_text())
    return {stage["name"]: stage["status"] for stage in record["stages"]}


def test_products_and_record(call: Callable, tracked: StandIn, recording: Path) -> None:
    done = call(recording, "--seed", 3)
    assert done.returncode == 0, done.stderr
    out = Path("results/walk")
    assert statuses(out) == {"preprocess": "skipped", "export": "done", "ply": "done", "cleanup": "done",
                             "view": "done"}
    for name in ("pointcloud.ply", "pointcloud_cleaned.ply", "pointcloud_cleaned.png", "pointcloud_view.html"):
        assert (out / name).stat().st_size > 1000 and str(out / name) in done.stdout
    cleaned = read_cloud(out / "pointcloud_cleaned.ply")
    assert 0 < len(cleaned) <= POINTS - 50
    line = done.stdout.splitlines()[0]
    assert line == (f"walk: tracked {FRAMES} frames with 14 keyframes (100% of the frames explained); {POINTS} points, "
                    f"{len(cleaned)} after cleaning ({len(cleaned) / POINTS:.0%}); no warnings")
    record = json.loads((out / "pipeline.json").read_text())
    assert record["status"] == "ok" and record["summary"] == done.stdout.splitlines()
    assert record["recognised"]["dataset"] == "generic" and record["command"] == [str(recording), "--seed", "3"]
    stage = record["stages"][1]
    assert stage["inputs"][str(recording)].startswith("folder:2:") and stage["settings"]["seed"] == 3
    assert any(path.endswith("tiny.yaml") for path in stage["inputs"])
    assert all(mark != "missing" for stage in record["stages"] for mark in stage["outputs"].values())
    assert tracked.calls[0].export_frame_data and tracked.calls[0].dataset == "generic"


@pytest.mark.parametrize("form", ["{walk}", "{walk}/", "--indir {walk}", "--indir {walk}/", "{around}", "{relative}/",
                                  "{walk} --indir {walk}/"])
def test_forms_of_the_path(form: str, call: Callable, export: StandIn, recording: Path) -> None:
    relative = os.path.relpath(recording, Path.cwd())
    words = form.format(walk=recording, around=recording.parent, relative=relative).split()
    assert call(*words, "--outdir", "out").returncode == 0
    assert export.calls[0].datapath == str(recording) and Path(export.calls[0].out) == Path("out/pointcloud.npy")


def test_results_are_named_after_the_folder_that_was_given(call: Callable, export: StandIn, recording: Path) -> None:
    inner = recording / "walk"
    inner.mkdir()
    for file in recording.glob("*.*"):
        file.rename(inner / file.name)
    assert call(str(recording) + "/").returncode == 0
    assert export.calls[0].datapath == str(inner) and Path("results/walk/pipeline.json").is_file()


def test_resume_does_only_what_changed(call: Callable, export: StandIn, recording: Path) -> None:
    out = Path("results/walk")
    assert call(recording).returncode == 0
    assert call(recording, "--resume").returncode == 0
    assert len(export.calls) == 1
    assert set(statuses(out).values()) == {"skipped", "unchanged"}
    assert call(recording, "--resume", "--cleanup-algorithm", "sor").returncode == 0
    assert statuses(out)["export"] == "unchanged" and statuses(out)["cleanup"] == "done"
    assert statuses(out)["view"] == "done"
    assert len(export.calls) == 1
    (out / "pointcloud_view.html").unlink()
    assert call(recording, "--resume", "--cleanup-algorithm", "sor").returncode == 0
    assert statuses(out)["cleanup"] == "unchanged" and statuses(out)["view"] == "done"
    calibration = recording / "calib.yaml"
    calibration.write_text(calibration.read_text().replace("60", "61"))
    assert call(recording, "--resume").returncode == 0
    assert len(export.calls) == 2 and statuses(out)["export"] == "done"
    assert call(recording, "--resume", "--", "--stride", 2).returncode == 0
    assert len(export.calls) == 3 and export.calls[-1].stride == 2
    assert call(recording).returncode == 0 and len(export.calls) == 4


def test_resume_goes_on_after_a_failure(call: Callable, export: StandIn, recording: Path) -> None:
    export.error = TrackingError("lost: the geometry no longer explains the measurements")
    done = call(recording)
    assert done.returncode == 1 and "lost: the geometry" in done.stdout and "Traceback" not in done.stderr
    assert statuses(Path("results/walk")) == {"preprocess": "skipped", "export": "failed", "ply": "not run",
                                              "cleanup": "not run", "view": "not run"}
    export.error = None
    assert call(recording, "--resume").returncode == 0
    assert statuses(Path("results/walk"))["view"] == "done"


def test_keep_going_runs_what_still_can(call: Callable, export: StandIn, recording: Path,
                                        monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise TrackingError("no triangles today")

    monkeypatch.setattr(stages, "write_cloud", fail)
    Path("results/walk").mkdir(parents=True)
    Path("results/walk/pointcloud_cleaned.ply").unlink(missing_ok=True)
    assert call(recording, "--keep-going", "--run-emvs").returncode == 1
    assert statuses(Path("results/walk")) == {"preprocess": "skipped", "export": "done", "ply": "done",
                                              "cleanup": "failed", "emvs": "not run", "view": "not run"}
    assert "pointcloud_cleaned.ply is missing" in Path("results/walk/pipeline.json").read_text()


def test_a_defect_is_recorded_and_not_hidden(call: Callable, export: StandIn, recording: Path) -> None:
    export.error = ZeroDivisionError("a defect")
    with pytest.raises(ZeroDivisionError):
        call(recording)
    record = json.loads(Path("results/walk/pipeline.json").read_text())
    assert record["status"] == "failed" and record["stages"][1]["reason"] == "ZeroDivisionError a defect"


def test_dry_run_touches_nothing(call: Callable, export: StandIn, recording: Path) -> None:
    done = call(recording, "--dry-run", "--run-emvs")
    assert done.returncode == 0 and not export.calls and not Path("results").exists()
    assert "1. preprocess: nothing to do" in done.stdout and "2. export: track" in done.stdout
    assert "emvs/emvs.ply" in done.stdout and "pointcloud_view.html" in done.stdout
    assert call(recording).returncode == 0
    again = call(recording, "--dry-run", "--resume", "--cleanup-algorithm", "sor").stdout
    assert "2. export: nothing to do, inputs, settings and products are unchanged" in again
    assert "4. cleanup: remove" in again and "5. view: write" in again


def test_bag_and_flag_file_for_ros(call: Callable, export: StandIn, recording: Path) -> None:
    done = call(recording, "--export-emvs-mono", "--emvs-dimZ", 50, "--emvs-min-depth", 1, "--emvs-max-depth", 9,
                "--emvs-pose-topic", "/optitrack/davis")
    assert done.returncode == 0, done.stderr
    flags = dict(line.removeprefix("--").split("=") for line in Path("results/walk/emvs_mono.conf").read_text().split())
    assert (flags["dimZ"], flags["pose_topic"]) == ("50", "/optitrack/davis")
    assert (float(flags["min_depth"]), float(flags["max_depth"])) == (1, 9)
    assert Path(flags["bag_filename"]).is_file() and "emvs_input.bag" in done.stdout
    assert call(recording, "--export-emvs-mono").returncode == 0  # of an earlier run, so it may be replaced


def test_the_bag_of_somebody_else_is_not_replaced(call: Callable, export: StandIn, recording: Path) -> None:
    bag = Path("out/emvs_input.bag")
    bag.parent.mkdir()
    bag.write_text("precious")
    done = call(recording, "--export-emvs-mono", "--outdir", "out")
    assert done.returncode == 2 and "--emvs-overwrite" in done.stderr and bag.read_text() == "precious"
    assert not export.calls


def test_mapping_with_ros(call: Callable, export: StandIn, recording: Path, tmp_path: Path,
                          monkeypatch: pytest.MonkeyPatch) -> None:
    assert call(recording, "--run-emvs", "--emvs-backend", "ros").returncode == 2  # no rosrun here
    rosrun = tmp_path / "bin" / "rosrun"
    rosrun.parent.mkdir()
    rosrun.write_text('#!/bin/sh\necho "mapping $*"\necho x > depth_points.pcd\nexit ${ROSRUN_CODE:-0}\n')
    rosrun.chmod(0o755)
    monkeypatch.setenv("PATH", f"{rosrun.parent}:{os.environ['PATH']}")
    words = (recording, "--run-emvs", "--emvs-backend", "ros", "--emvs-min-depth", 1, "--emvs-max-depth", 9)
    done = call(*words)
    assert done.returncode == 0, done.stderr
    conf = Path("results/walk/emvs_mono.conf").absolute()
    assert f"mapping mapper_emvs run_emvs --flagfile={conf}" in done.stderr
    assert Path("results/walk/emvs/depth_points.pcd").is_file() and statuses(Path("results/walk"))["emvs bag"] == "done"
    monkeypatch.setenv("ROSRUN_CODE", "3")
    done = call(*words)
    assert done.returncode == 1 and "ended with 3: mapping mapper_emvs" in done.stdout


def test_edge_clouds_get_files_for_viewers(call: Callable, export: StandIn, recording: Path) -> None:
    assert call(recording, "--export-edge-cloud", "--edge_topk", 99).returncode == 0
    assert export.calls[0].export_edge_cloud and export.calls[0].edge.topk == 99
    assert len(read_cloud("results/walk/pointcloud_edges.ply")) == POINTS
    assert 0 < len(read_cloud("results/walk/pointcloud_edges_cleaned.ply")) < POINTS
    # the same folder, now without edges: those of the run before are not taken for products of this one
    Path("results/walk/pointcloud_edges_cleaned.ply").unlink()
    assert call(recording, "--verbose").returncode == 0
    assert not Path("results/walk/pointcloud_edges_cleaned.ply").exists()


def test_warnings_are_told(call: Callable, export: StandIn, recording: Path) -> None:
    export.share = 0.5
    done = call(recording, "--radius", 1e-6, "--verbose")
    assert done.returncode == 0
    assert "2 warnings" in done.stdout and "explains only 50%" in done.stdout and "passed the cleaning" in done.stdout
    assert "ror(radius=1e-06, min_neighbors=16" in done.stdout and "quality(" in done.stdout
    assert len(read_cloud("results/walk/pointcloud_cleaned.ply")) == 0
    assert Path("results/walk/pointcloud_view.html").is_file()  # of the raw cloud


def test_preprocessing_anew(call: Callable, export: StandIn, recording: Path, tmp_path: Path,
                            monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a recording that was preprocessed before; recordings of one's own have nothing to preprocess."""
    folder = tmp_path / "prepared"
    folder.mkdir()
    for name in ("events.txt", "t_offset_us.txt", "images_timestamps_us.txt", "calib_undist.txt", "rectify_map.h5"):
        (folder / name).touch()
    asked: list[PreprocessOptions] = []

    def run(_: Path, options: PreprocessOptions) -> list[Path]:
        asked.append(options)
        return []

    monkeypatch.setitem(PREPROCESSORS, "fpv", replace(PREPROCESSORS["fpv"], run=run))
    for words in ((), ("--overwrite-preprocessing",), ("--", "--rgb")):
        assert call(folder, *words).returncode == 0
    assert [(options.overwrite, options.images) for options in asked] == [(True, False), (False, True)]
    assert call(recording, "--overwrite-preprocessing").returncode == 0
    assert statuses(Path("results/walk"))["preprocess"] == "skipped"


def test_names_of_products(call: Callable, export: StandIn, recording: Path) -> None:
    assert call(recording, "--outdir", "here", "--outname", "board.ply", "--frame-out", "f.npz", "--cleanup-output",
                "clean/best.ply", "--no-view", "--export-side", "left").returncode == 0
    assert Path("clean/best.ply").is_file() and Path("clean/best.png").is_file()
    assert not list(Path("here").glob("*.html"))
    assert export.calls[0].frame_data_out == str(Path("here/f.npz")) and Path("here/board.ply").is_file()


def test_the_rest_of_the_command_line_goes_to_the_export(call: Callable, export: StandIn, recording: Path) -> None:
    assert call(recording, "--weights", "random:0", "--", "--start-us", "5e3", "--opts", "KEYFRAME_THRESH", 9,
                "--save_per_frame_cloud").returncode == 0
    asked = export.calls[0]
    assert (asked.start_us, asked.opts, asked.weights) == (5e3, ["KEYFRAME_THRESH", "9"], "random:0")
    assert asked.save_per_frame_cloud_path == str(Path("results/walk/clouds"))
    assert "untrained" not in asked.out


WRONG = {
    "no folder": ([], "expected a folder"),
    "two folders": (["{walk}", "--indir", "{tmp}"], "two folders were given"),
    "missing folder": (["{tmp}/none"], "does not exist"),
    "no recording": (["{tmp}/work"], "not recognised as a recording"),
    "unknown data set": (["{walk}", "--dataset", "nosuch"], "unknown data set 'nosuch'"),
    "another data set": (["{walk}", "--dataset", "vector"], "vector"),
    "unknown flag": (["{walk}", "--stride", "2"], "--stride"),
    "unknown flag of the export": (["{walk}", "--", "--no_such_flag"], "--no_such_flag"),
    "pipeline flag for the export": (["{walk}", "--", "--frame-data-out=x.npz"], "use --frame_out"),
    "folder in a name": (["{walk}", "--outname", "a/b.npy"], "--outdir"),
    "unknown kind of cloud": (["{walk}", "--outname", "b.obj"], ".obj"),
    "too many planes": (["{walk}", "--export-emvs-mono", "--emvs-dimZ", "999"], "2 to 256 planes"),
    "missing weights": (["{walk}", "--weights", "none.pth"], "none.pth"),
    "missing config": (["{walk}", "--config", "none.yaml"], "none.yaml"),
    "bad filter": (["{walk}", "--cleanup-algorithm", "statistical"], "invalid choice"),
    "bad radius": (["{walk}", "--radius", "-1"], "positive"),
    "bad depth range": (["{walk}", "--run-emvs", "--emvs-min-depth", "3", "--emvs-max-depth", "2"], "not below"),
    "results in the recording": (["{walk}", "--outdir", "{walk}"], "is the recording itself"),
    "results in a file": (["{walk}", "--outdir", "{walk}/calib.yaml"], "calib.yaml"),
    "display without one": (["{walk}", "--display"], "no display here"),
    "page without page": (["{walk}", "--display", "--no-view"], "--no-view"),
}


@pytest.mark.parametrize("case", WRONG, ids=lambda name: name.replace(" ", "-"))
def test_wrong_arguments_are_one_line_and_exit_code_2(case: str, call: Callable, export: StandIn, recording: Path,
                                                      tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words, expected = WRONG[case]
    monkeypatch.setattr("utils.viewer.window.has_display", lambda: False)
    done = call(*(word.format(walk=recording, tmp=tmp_path) for word in words))
    assert done.returncode == 2, done.stderr
    assert expected in done.stderr.strip().splitlines()[-1] and "Traceback" not in done.stderr
    assert not export.calls and not Path("results").exists()


def test_a_damaged_record_is_named(call: Callable, export: StandIn, recording: Path) -> None:
    assert call(recording).returncode == 0
    record = Path("results/walk/pipeline.json")
    record.write_text(record.read_text()[:200])
    done = call(recording, "--resume")
    assert done.returncode == 2 and "leave --resume out" in done.stderr
    assert call(recording).returncode == 0


def test_help_is_instant_and_loads_no_torch() -> None:
    code = (f"import sys, runpy; sys.argv = [{str(SCRIPT)!r}, '--help']\n"
            f"try: runpy.run_path({str(SCRIPT)!r}, run_name='__main__')\n"
            "except SystemExit as end: assert not end.code\n"
            "assert 'torch' not in sys.modules and 'numpy' not in sys.modules")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    assert "--run-emvs" in done.stdout


def test_as_a_process_from_another_folder(recording: Path, tmp_path: Path) -> None:
    """Random events cannot be tracked: the run says so, exits with 1 and leaves its record."""
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "data/walk/", "--weights", "random:0:16,16,8", "--", "--opts",
         "PATCHES_PER_FRAME", "8"], capture_output=True, text=True, timeout=900, cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert done.stdout.splitlines()[0] == "walk: no trajectory and no cloud"
    assert "export failed: not initialised" in done.stdout
    record = json.loads((tmp_path / "results" / "walk" / "pipeline.json").read_text())
    assert record["status"] == "failed" and record["working_directory"] == str(tmp_path)
