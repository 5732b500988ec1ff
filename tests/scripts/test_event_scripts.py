"""convert_events.py and check_events.py, run as a user runs them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from tests.utils.event_samples import random_events, same, write_npy_records
from tests.utils.prophesee_encoder import HEADER_EVT3, encode_evt3
from utils.events import Events, open_events, write_events_text

EPOCH_US = 1_600_000_000_000_000
CONVERT, CHECK = "convert_events.py", "check_events.py"


def run(repository: Path, folder: Path, script: str, *words: object) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "DISPLAY")}
    return subprocess.run([sys.executable, repository / "scripts" / script, *map(str, words)], cwd=folder,
                          capture_output=True, text=True, env=environment)


def read(path: Path, **options: object) -> Events:
    with open_events(path, **options) as reader:  # type: ignore[arg-type]
        return Events.concatenate(list(reader.chunks()))


def one_line(done: subprocess.CompletedProcess[str], code: int) -> str:
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    return done.stderr


@pytest.mark.parametrize("start_us", [0, EPOCH_US])
def test_round_trip_through_every_output(start_us: int, repository: Path, tmp_path: Path) -> None:
    """npz -> h5 -> txt -> npz: the same events, to the microsecond, also with stamps since the epoch."""
    events = random_events(800, seed=1, start_us=start_us)
    with (tmp_path / "a.npz").open("wb") as stream:
        np.savez(stream, x=events.x, y=events.y, t=events.t_us, p=events.p)
    for source, target in (("a.npz", "b.h5"), ("b.h5", "c.txt"), ("c.txt", "d.npz")):
        done = run(repository, tmp_path, CONVERT, source, target)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith(f"{target}: 800 events, {(events.t_us[-1] - events.t_us[0]) * 1e-6:.6f} s, from")
        assert done.stderr == ""
        assert same(read(tmp_path / target), events)
    with h5py.File(tmp_path / "b.h5") as file:
        assert int(file["t_offset"][()]) == start_us
        assert file["events/t"].dtype == np.uint32


def test_convert_raw_with_crop_and_losses(repository: Path, tmp_path: Path) -> None:
    events = random_events(3000, seed=2)
    words = encode_evt3(events, repeat_time_high=16)
    (tmp_path / "e.raw").write_bytes(HEADER_EVT3 + words[:2000] + b"\x00\x90" + words[2000:])
    done = run(repository, tmp_path, CONVERT, "e.raw", "e.h5", "--start", "0.01", "--stop=0.05")
    assert done.returncode == 0, done.stderr
    assert "from Prophesee RAW EVT3; 1 damaged parts were left out" in done.stdout
    assert done.stderr.startswith("warning: e.raw: 1 words of unknown type left out in bytes")
    first = int(events.t_us[0])
    assert same(read(tmp_path / "e.h5"), events.between(first + 10_000, first + 50_000))
    with open_events(tmp_path / "e.h5") as reader:
        assert reader.sensor_size == (64, 48)


def test_convert_sorts_on_request(repository: Path, tmp_path: Path) -> None:
    events = random_events(300, seed=3)
    rows = np.random.default_rng(4).permutation(300)
    write_events_text(tmp_path / "e.txt", Events(events.x[rows], events.y[rows], events.t_us[rows], events.p[rows]))
    assert "time stamps are not sorted" in one_line(run(repository, tmp_path, CONVERT, "e.txt", "e.npz"), 2)
    done = run(repository, tmp_path, CONVERT, "e.txt", "e.npz", "--sort")
    assert done.stdout.endswith("from text t x y p (sorted)\n"), done.stderr
    assert np.array_equal(read(tmp_path / "e.npz").t_us, events.t_us)


def test_convert_refuses(repository: Path, tmp_path: Path) -> None:
    write_events_text(tmp_path / "e.txt", random_events(30, seed=5))
    (tmp_path / "old.npz").write_bytes(b"keep me")
    assert "must end in one of" in one_line(run(repository, tmp_path, CONVERT, "e.txt", "e.bag"), 2)
    assert "old.npz exists" in one_line(run(repository, tmp_path, CONVERT, "e.txt", "old.npz"), 2)
    assert "e.txt exists" in one_line(run(repository, tmp_path, CONVERT, "e.txt", "e.txt", "--overwrite"), 2)
    assert "No such file" in one_line(run(repository, tmp_path, CONVERT, "no.txt", "new.npz"), 2)
    assert "no events between" in one_line(run(repository, tmp_path, CONVERT, "e.txt", "n.h5", "--start", "9"), 2)
    assert "expected WIDTHxHEIGHT" in one_line(run(repository, tmp_path, CONVERT, "e.txt", "n.h5",
                                                   "--sensor-size", "wide"), 2)
    assert (tmp_path / "old.npz").read_bytes() == b"keep me"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["e.txt", "old.npz"]
    assert run(repository, tmp_path, CONVERT, "e.txt", "old.npz", "--overwrite").returncode == 0
    assert len(read(tmp_path / "old.npz")) == 30


def test_check_draws_and_reports(repository: Path, tmp_path: Path) -> None:
    events = random_events(5000, seed=6)
    write_npy_records(tmp_path / "e.npy", events)
    done = run(repository, tmp_path, CHECK, "e.npy", "--json", "e.json", "--sensor-size", "64x48")
    assert done.returncode == 0, done.stderr
    for part in ("format     npy", "sensor     64 x 48 pixels, ", "events     5,000", "order      sorted by time",
                 "hot pixels none", "losses     none", "picture    e_events.png"):
        assert part in done.stdout
    numbers = json.loads((tmp_path / "e.json").read_text())
    assert numbers["events"] == 5000
    assert numbers["brighter"] == int(events.p.sum())
    assert numbers["last_us"] == int(events.t_us[-1])
    picture = cv2.imread(str(tmp_path / "e_events.png"))
    assert picture.shape == (900, 1500, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500  # not an empty canvas


def test_check_ends_with_1_if_stamps_run_backwards(repository: Path, tmp_path: Path) -> None:
    events = random_events(500, seed=7)
    t_us = events.t_us.copy()
    t_us[100] = 0
    write_events_text(tmp_path / "e.txt", Events(events.x, events.y, t_us, events.p))
    done = run(repository, tmp_path, CHECK, "e.txt", "--picture", "sub/p.png")
    assert done.returncode == 1, done.stderr
    assert "NOT sorted: 1 stamps run backwards" in done.stdout
    assert (tmp_path / "sub/p.png").is_file()


def test_check_ends_with_1_if_parts_are_damaged(repository: Path, tmp_path: Path) -> None:
    events = random_events(500, seed=7)
    (tmp_path / "e.raw").write_bytes(HEADER_EVT3 + encode_evt3(events) + b"\x00")
    done = run(repository, tmp_path, CHECK, "e.raw", "--no-picture")
    assert done.returncode == 1
    assert "losses     1 incomplete words" in done.stdout
    assert not list(tmp_path.glob("*.png"))


def test_check_refuses(repository: Path, tmp_path: Path) -> None:
    (tmp_path / "e.txt").write_text("# nothing\n")
    assert "no events" in one_line(run(repository, tmp_path, CHECK, "e.txt"), 2)
    assert "cannot read event file" in one_line(run(repository, tmp_path, CHECK, "missing.raw"), 2)


@pytest.mark.parametrize("script", [CONVERT, CHECK])
def test_help_is_light(script: str, repository: Path, tmp_path: Path) -> None:
    """`--help` works and loads neither torch nor numpy."""
    done = run(repository, tmp_path, script, "--help")
    assert done.returncode == 0
    assert "--sensor_size" in done.stdout
    code = (f"import runpy, sys\nsys.argv = ['{script}', '--help']\n"
            f"try: runpy.run_path(r'{repository / 'scripts' / script}', run_name='__main__')\n"
            "except SystemExit: pass\n"
            "print('LOADED', [name for name in ('torch', 'numpy', 'h5py') if name in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert "LOADED []" in done.stdout
