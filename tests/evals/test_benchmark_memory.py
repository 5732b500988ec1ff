"""The memory and look-ahead benchmarks run; their figures are not judged here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evals.benchmark_memory import main as memory
from evals.benchmark_prefetch import main as prefetch


def test_memory_is_sampled_per_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = memory(["--frames", "12", "--size", "64x48", "--events", "3000", "--patches", "4", "--encoder", "pooling",
                   "--edge_topk", "20", "--json", str(tmp_path / "row.json")])
    row = json.loads((tmp_path / "row.json").read_text())
    assert code in (0, 1) and row["frames"] == 12 and row["keyframes"] == 8
    assert 10 < row["rss_first_mib"] <= row["peak_mib"] and [sample[0] for sample in row["samples"]] == [*range(1, 13)]
    assert "slope" in capsys.readouterr().out


def test_look_ahead_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert prefetch(["--frames", "3", "--size", "64x48", "--events", "100", "--tracker_ms", "1", "--repeats", "1"]) == 0
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()[2:]] == ["none", "wait", "compute"]
