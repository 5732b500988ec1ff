"""The benchmarks of the tracker and of its kernels run; their figures are not judged here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from evals.benchmark_kernels import main as kernels
from evals.benchmark_odometry import SETTINGS
from evals.benchmark_odometry import main as odometry


def test_stages_of_a_frame(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    few = {"PATCHES_PER_FRAME": 4, "REMOVAL_WINDOW": 6, "OPTIMIZATION_WINDOW": 4, "PATCH_LIFETIME": 4}
    monkeypatch.setitem(SETTINGS, "fast", few)
    assert odometry(["--frames", "2", "--one", "small", "fast", "64x48", "float32", "1"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert row["edges"] > 100 and row["peak_mib"] > 50
    stages = [row[name] for name in ("encoder", "corr", "update", "ba", "rest")]
    assert min(stages) > 0 and sum(stages) == pytest.approx(row["total"])


def test_a_precision_that_the_device_lacks_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--sizes", "64x48", "--networks", "small", "--settings", "fast", "--threads", "1"]
    assert odometry([*small, "--precisions", "float16", "--json", str(tmp_path / "rows.json")]) == 0
    assert "this cpu does not run float16" in capsys.readouterr().out
    assert json.loads((tmp_path / "rows.json").read_text()) == []


def test_kernels_on_the_cpu(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = kernels(["--device", "cpu", "--problems", "tiny", "--repeats", "1", "--json", str(tmp_path / "rows.json")])
    assert code == 0 and "| tiny | ba, 2 iterations |" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "rows.json").read_text())["rows"]) == 7


@pytest.mark.skipif(torch.cuda.is_available(), reason="tells about machines without CUDA")
def test_kernels_without_a_gpu(capsys: pytest.CaptureFixture[str]) -> None:
    assert kernels(["--device", "cuda", "--problems", "tiny"]) == 2
    assert "no CUDA device" in capsys.readouterr().err
