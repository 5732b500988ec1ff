"""Two training processes, as torchrun starts them: they share the clip cache, average gradients and stop together."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

import train
from devo.checkpoint import read_checkpoint
from tests.utils.test_train_command import SHORT, plane_shard
from utils.training.launch import settings_from_options
from utils.training.pool import ensure_shard
from utils.training.simulated import cache_folder, shard_settings


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "steps"), [("--steps=3", 3), ("--minutes=0", 0)])
def test_two_processes_train_one_network(tmp_path: Path, repository: Path, limit: str, steps: int) -> None:
    arguments = [*SHORT, "--validation-clips", "0", "--runs", str(tmp_path), "--name", "pair", limit]
    shards = shard_settings(settings_from_options(train.parse_arguments(arguments)))
    for number in range(8):
        ensure_shard(cache_folder(tmp_path / "cache", shards), number, shards, plane_shard)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    common = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "WORLD_SIZE": "2",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "train.py", *arguments], cwd=repository, env={**common, "RANK": rank, "LOCAL_RANK": rank}
        )
        for rank in ("0", "1")
    ]
    assert [process.wait(timeout=300) for process in processes] == [0, 0]
    assert read_checkpoint(tmp_path / "pair" / "last.pth")["steps"] == steps
