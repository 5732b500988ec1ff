"""The training benchmark runs; its figures are not judged here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evals.benchmark_training import main

SMALL = ["--device", "cpu", "--frames", "3", "--updates", "1", "--patches", "4", "--size", "48x64", "--repeats", "1",
         "--simulate", "1"]  # fmt: skip


def test_one_row_per_batch_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SMALL, "--clips", "1", "2", "--json", str(tmp_path / "rates.json")]) == 0
    rates = json.loads((tmp_path / "rates.json").read_text())
    assert rates["simulated_clips_per_s"] > 0
    assert [row["clips"] for row in rates["steps"]] == [1, 2]
    for row in rates["steps"]:
        assert row["clips_per_s"] == pytest.approx(3000 * row["clips"] / (row["loop_ms"] + 2 * row["matching_ms"]))
    assert capsys.readouterr().out.count("\n| ") == 3


def test_unusable_settings_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SMALL, "--device", "tpu9"]) == 2
    assert capsys.readouterr().err.startswith("benchmark_training: device 'tpu9'")
    assert main([*SMALL, "--simulate_on", "tpu9"]) == 2
    assert capsys.readouterr().err.startswith("benchmark_training: device 'tpu9'")
