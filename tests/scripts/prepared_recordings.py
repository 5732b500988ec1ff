"""The simulated recording: as raw files of a data set through its script and reader, and as a recording of one's own.

Used by the tests of all preprocessing scripts; each says in its `Case` what is particular about a data set.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import pytest
import torch

from devo.config import Config
from tests.tolerances import VOXEL_RECTIFIED
from tests.utils.raw_layouts.recording import RawRecording, simulated, write_generic
from utils.calibration import Calibration
from utils.datasets.registry import Recording, SequenceOptions, open_sequence
from utils.datasets.sequence import Frame
from utils.eval_utils import track
from utils.preprocessing import PREPROCESSORS

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A data set, its camera, how it is written, and how its windows differ from those of the simulated recording."""

    camera: Calibration
    write: Callable[[Path, RawRecording], Path]
    """Writes the raw files of the simulated recording and returns the folder that is the sequence afterwards."""
    products: set[str]
    window_ms: float | None
    """Length of the windows of a recording of one's own; None goes from image to image."""
    side: str = "left"
    seen: Callable[[RawRecording], RawRecording] = lambda recording: recording
    """What that side sees of the recording in the middle of its sensor."""
    clock_us: int | None = None
    """On what clock the products are; None lets them begin at 0, with the first stamp of all."""
    arguments: tuple[str, ...] = ()
    """Of the script, besides the folder."""
    iterator_arguments: tuple[tuple[str, object], ...] = ()


CaseT = TypeVar("CaseT", bound=Case)


@dataclass(frozen=True)
class Prepared(Generic[CaseT]):
    """A preprocessed recording, what the script said, and the same recording as one's own."""

    dataset: str
    case: CaseT
    folder: Path
    recording: RawRecording
    output: str
    sequence: Recording
    own: Recording


def prepare(dataset: str, case: CaseT, folder: Path) -> Prepared[CaseT]:
    """Write the raw files below `folder`, preprocess them as a user does it, and open the result."""
    root = folder / "nested" / "raw"
    root.mkdir(parents=True)
    written = case.write(root, simulated())
    # From another folder, with a trailing slash, as users do.
    command = [sys.executable, str(ROOT / "scripts" / f"pp_{dataset}.py"), "--indir", f"{root.parent.name}/"]
    done = subprocess.run([*command, *case.arguments], cwd=folder, timeout=300, check=False, capture_output=True,
                          text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    assert f"preprocessing {dataset}: 100%" in done.stderr
    recording = case.seen(simulated().on_sensor((case.camera.width, case.camera.height)))
    first_us = int(min(recording.events.t_us[0], recording.stamps_us[0], recording.poses_us[0]))
    recording = recording.later(-first_us if case.clock_us is None else case.clock_us)
    sequence = open_sequence(dataset, f"{written}/", SequenceOptions(side=case.side))
    own = open_sequence("generic", write_generic(root / "own", recording, case.camera),
                        SequenceOptions(window_dt_ms=case.window_ms))
    return Prepared(dataset, case, written, recording, done.stdout, sequence, own)


def check_products(prepared: Prepared[CaseT]) -> Path:
    """The script has listed what it should make, and everything the reader needs is there; the folder of images."""
    names = set(prepared.output.strip().partition(": ")[2].split(", "))
    assert names == prepared.case.products
    needed = PREPROCESSORS[prepared.dataset].outputs(prepared.folder, prepared.case.side)
    assert all(path.exists() for path in needed)
    return next(prepared.folder / name for name in names if "images_undistorted" in name)


def assert_same_frames(frames: Sequence[Frame], own: Sequence[Frame], within_us: float) -> None:
    """Voxel grids, intrinsics and stamps (up to `within_us`) of the data set are those of a recording of one's own."""
    for (voxel, intrinsics, t_us), (own_voxel, own_intrinsics, own_t_us) in zip(frames, own, strict=True):
        assert (voxel.dtype, intrinsics.dtype) == (torch.float32, torch.float64)
        assert voxel.shape == own_voxel.shape
        assert float((voxel - own_voxel).abs().max()) <= VOXEL_RECTIFIED
        assert torch.allclose(intrinsics, own_intrinsics, atol=1e-9, rtol=0)
        assert t_us == pytest.approx(own_t_us, abs=within_us)


def assert_same_trajectory(frames: Sequence[Frame], own: Sequence[Frame], within_us: float) -> None:
    """A small untrained network moves over the frames, and goes the same way over those of a recording of one's own."""
    # an untrained network sees no motion, so none is asked for
    config = Config({"PATCHES_PER_FRAME": 8, "MIXED_PRECISION": False, "PROBE_FLOW": 0.0})
    result, other = (track(iter(stream), config, "random:0:16,16,8", seed=0) for stream in (frames, own))
    assert result.poses.shape == (len(frames), 7)
    assert np.ptp(result.poses[:, :3], axis=0).max() > 0
    assert result.tstamps.tolist() == [t_us for _, _, t_us in frames]
    np.testing.assert_array_equal(result.poses, other.poses)
    np.testing.assert_allclose(result.tstamps, other.tstamps, atol=within_us, rtol=0)
