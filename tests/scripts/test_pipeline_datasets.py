"""Raw recordings of every data set through recognition, their preprocessor and reader, as the pipeline runs them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from scripts.start_pipline import main
from tests.scripts.export_stand_in import StandIn
from tests.utils.raw_layouts.hdf5_folders import write_eds, write_mvsec, write_tumvie, write_vector
from tests.utils.raw_layouts.recording import RawRecording
from tests.utils.raw_layouts.stereo_bags import write_hku, write_rpg
from tests.utils.raw_layouts.text_folders import write_ecd, write_fpv
from utils.datasets.recognise import LAYOUTS, recognise
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.events import Events
from utils.export_run import find_config
from utils.pipeline import stages
from utils.preprocessing import PREPROCESSORS, find_sequences

START_US = 50_000_000


def recording(size: tuple[int, int]) -> RawRecording:
    """Random events over 0.2 s with six images and ten poses."""
    rng = np.random.default_rng(3)
    t_us = START_US + np.sort(rng.integers(0, 200_000, 4000))
    events = Events(rng.integers(0, size[0], 4000).astype(np.uint16), rng.integers(0, size[1], 4000).astype(np.uint16),
                    t_us, rng.integers(0, 2, 4000).astype(np.uint8))
    images = [rng.integers(0, 256, (size[1], size[0])).astype(np.uint8) for _ in range(6)]
    poses = np.zeros((10, 7))
    poses[:, 0], poses[:, 6] = np.linspace(0, 1, 10), 1
    return RawRecording(size, events, START_US + 5_000 + 33_000 * np.arange(6), images,
                        START_US + 20_000 * np.arange(10), poses)


@dataclass(frozen=True)
class Case:
    """How a raw recording is written, what is given to the pipeline, and what the sequence is called."""

    write: Callable[[Path], object]
    given: str
    sequence: str
    side: str = "left"


CASES = {
    "fpv": Case(lambda root: write_fpv(root, recording((346, 260)), "indoor_forward_7_davis"), "",
                "indoor_forward_7_davis"),
    "ecd": Case(lambda root: write_ecd(root, recording((240, 180)), "200 201 120 90 -0.3 0.1 0.001 -0.001 0.01"),
                "slider_test", "slider_test"),
    "rpg": Case(lambda root: write_rpg(root, recording((240, 180)), np.eye(4)), "desk_test.bag", "desk_test"),
    "hku": Case(lambda root: write_hku(root, recording((346, 260)), np.eye(4)), "", "test_walk", "right"),
    "vector": Case(lambda root: write_vector(root, recording((240, 180)), "right", frames=False, beside=False),
                   "corridors_walk", "corridors_walk", "right"),
    "tumvie": Case(lambda root: write_tumvie(root, recording((240, 180)), frames=False), "mocap-1d-trans",
                   "mocap-1d-trans"),
    "eds": Case(lambda root: write_eds(root, recording((240, 180)), frames=False), "", "00_peanuts_dark"),
    "mvsec": Case(lambda root: write_mvsec(root, {"left": recording((240, 180))}), "indoor_flying1_data.hdf5",
                  "indoor_flying1_data"),
}


def test_every_preprocessor_is_tested() -> None:
    assert set(CASES) == set(PREPROCESSORS) == {layout.dataset for layout in LAYOUTS if layout.raw or layout.archive}


@pytest.mark.parametrize("dataset", sorted(CASES))
def test_published_weights_run_with_the_preset_of_the_data_set(dataset: str) -> None:
    """The Event Camera Dataset has none of its own and the same sensor as rpg."""
    assert find_config(None, dataset, "DEVO.pth").name == f"eval_{'rpg' if dataset == 'ecd' else dataset}.yaml"


@pytest.mark.parametrize("dataset", sorted(CASES))
def test_raw_files_to_sequence(dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case, export = CASES[dataset], StandIn()
    monkeypatch.setattr(stages, "export_pointcloud", export)
    monkeypatch.setattr("utils.clouds.preview.save_preview", lambda path, *_, **__: Path(path).write_text("picture"))
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "raw"
    root.mkdir()
    case.write(root)
    # the command that is named to users finds just this sequence
    assert find_sequences(dataset, recognise(root / case.given, case.side).source, case.side)[1] == [
        root / case.sequence]
    command = [str(root / case.given), "--side", case.side, "--outdir", "out"]
    assert main(command) == 0
    asked = export.calls[0]
    assert (asked.dataset, asked.datapath) == (dataset, str(root / case.sequence))
    record = json.loads(Path("out/pipeline.json").read_text())
    assert record["recognised"]["dataset"] == dataset and record["recognised"]["missing"]
    assert record["stages"][0]["status"] == "done" and record["stages"][0]["outputs"]
    # what preprocessing made is what recognition and reader look for
    found = recognise(root / case.given, case.side)
    assert (found.dataset, found.path, found.ready) == (dataset, root / case.sequence, True)
    sequence = open_sequence("auto", root / case.given, SequenceOptions(side=case.side))
    voxel, intrinsics, _ = next(iter(sequence.voxels()))
    assert voxel.abs().sum() > 0 and intrinsics.shape == (4,)
    assert {path.name for path in PREPROCESSORS[dataset].outputs(found.path, case.side)} <= {
        path.name for path in found.path.rglob("*")}
    assert main([*command, "--resume"]) == 0
    assert [stage["status"] for stage in json.loads(Path("out/pipeline.json").read_text())["stages"]][:2] == [
        "skipped", "unchanged"]
    assert len(export.calls) == 1


def test_a_failing_preprocessor_fails_the_pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                   capsys: pytest.CaptureFixture[str]) -> None:
    export = StandIn()
    monkeypatch.setattr(stages, "export_pointcloud", export)
    folder = write_fpv(tmp_path, replace(recording((346, 260)), images=[]), "outdoor_45_1_davis")
    assert main([str(folder), "--outdir", str(tmp_path / "out")]) == 1
    assert "preprocess failed" in capsys.readouterr().out and not export.calls
