"""Loaders of ground truth under their published names."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from devo.errors import InputError
from utils import load_utils

POSE = "1 2 3 0 0 0.6 0.8"


@pytest.mark.parametrize(("load", "text"), [
    (load_utils.load_gt_us, f"5.0 {POSE}\n5.0 {POSE}\n7.0 {POSE}\n"),
    (lambda path: load_utils.load_gt_us(path, skiprows=1), f"time pose\n5.0 {POSE}\n7.0 {POSE}\n"),
    (load_utils.load_eds_traj, f"# # timestamp[us] px py pz qx qy qz qw\n5.0 {POSE}\n7 {POSE}\n"),
    (load_utils.load_tumvie_traj, f"timestamp px py pz qx qy qz qw\n5 {POSE}\n7 {POSE}\n"),
    (load_utils.load_ecd_gt, f"0.000005 {POSE}\n0.000007 {POSE}\n"),
])
def test_text(load: object, text: str, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(text)
    stamps_us, poses = load(tmp_path / "poses.txt")  # type: ignore[operator]
    assert stamps_us.tolist() == [5, 7], "a repeated stamp counts once"
    assert poses.tolist() == [[1, 2, 3, 0, 0, 0.6, 0.8]] * 2


def test_wrong_text(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(f"5 {POSE}\n4 {POSE}\n")
    with pytest.raises(InputError, match="stamps must increase"):
        load_utils.load_gt_us(tmp_path / "poses.txt")
    with pytest.raises(InputError, match="cannot be read"):
        load_utils.load_eds_traj(tmp_path / "nothing.txt")


def test_mvsec(tmp_path: Path) -> None:
    folder = tmp_path / "walk_data"
    folder.mkdir()
    with h5py.File(folder / "walk_data.hdf5", "w"), h5py.File(folder / "walk_gt.hdf5", "w") as truth:
        matrices = np.tile(np.eye(4), (3, 1, 1))
        matrices[:, :3, 3] = [[1, 2, 3], [9, 9, 9], [4, 5, 6]]
        truth["davis/left/pose"], truth["davis/left/pose_ts"] = matrices, np.array([10.0, 10.0, 11.0])
        truth["davis/right/pose"], truth["davis/right/pose_ts"] = matrices[:2], np.array([10.0, 10.0, 11.0])
    stamps_us, poses = load_utils.load_mvsec_traj(f"{folder}/")
    assert stamps_us.tolist() == [10e6, 11e6]
    assert poses.tolist() == [[1, 2, 3, 0, 0, 0, 1], [4, 5, 6, 0, 0, 0, 1]]
    with pytest.raises(InputError, match=r"poses have shape \(2, 4, 4\) for 3 stamps"):
        load_utils.load_mvsec_traj(folder, "right")
