"""The benchmark of event files: its encoders write what the readers read, and the command prints its table."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evals.benchmark_events import encode_evt2, encode_evt3, synthetic_events, write_all
from tests.utils.event_samples import random_events, same
from tests.utils.prophesee_encoder import encode_evt2 as literal_evt2
from tests.utils.prophesee_encoder import encode_evt3 as literal_evt3
from utils.events import Events, open_events


@pytest.mark.parametrize("gap_us", [0, 3, 50, 100_000])
def test_encoders_agree_with_the_literal_ones(gap_us: int) -> None:
    events = random_events(700, seed=1, longest_gap_us=gap_us, start_us=5000)
    literal = np.frombuffer(literal_evt3(events), "<u2")
    # the literal encoder leaves out a fine time of 0 behind a new coarse time
    own = np.frombuffer(encode_evt3(events), "<u2")
    redundant = (own == 0x6000) & (np.concatenate([[0], own[:-1]]) >> 12 == 8)
    assert np.array_equal(own[~redundant], literal)
    assert encode_evt2(events) == literal_evt2(events)


def test_every_file_holds_the_events(tmp_path: Path) -> None:
    events = synthetic_events(3000, 320, 240, 1e6)
    assert np.all(np.diff(events.t_us) >= 0)
    assert len(events) > 2900
    for file in write_all(tmp_path, events, 320, 240):
        with open_events(file) as reader:
            assert same(Events.concatenate(list(reader.chunks())), events), file.name


def test_command(repository: Path, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, repository / "evals" / "benchmark_events.py", "--events", "2000",
                           "--repetitions", "1", "--size", "64x48", "--json", tmp_path / "r.json"],
                          capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "r.json").read_text())
    assert len(rows) == 10
    assert done.stdout.count("\n") == 12
    assert all(row["rate"] > 0 for row in rows)
