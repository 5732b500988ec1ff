"""TartanAir voxel files as a data set."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from devo.errors import InputError
from utils.datasets.registry import SequenceOptions, open_sequence

SCENE = Path("office/office/Easy/P001")


def write_scene(root: Path, frames: int = 4) -> Path:
    """The folder of voxel grids of a scene with `frames` images; the first frame has none."""
    events, images = (root / "office" / "Easy" / kind / SCENE for kind in ("evs_left", "image_left"))
    (events / "h5").mkdir(parents=True)
    (images / "imgs").mkdir(parents=True)
    for number in range(frames):
        cv2.imwrite(str(images / "imgs" / f"{number:06d}_left.png"), np.full((48, 64), 10 * number, np.uint8))
        if number:
            with h5py.File(events / "h5" / f"{number:010d}.h5", "w") as file:
                file["voxel"] = np.full((5, 48, 64), number, np.float16)
    rows = [[number, 0.5, -0.25, 0.0, 0.0, 0.6, 0.8] for number in range(frames)]
    np.savetxt(images / "pose_left.txt", rows)
    return events


def test_voxels_stamps_poses_and_images(tmp_path: Path) -> None:
    sequence = open_sequence("tartan", write_scene(tmp_path))
    frames = list(sequence.voxels())
    assert (sequence.name, sequence.width, sequence.height) == (str(SCENE), 64, 48)
    assert [(float(voxel[0, 0, 0]), t) for voxel, _, t in frames] == [(1, 1), (2, 2), (3, 3)]
    assert sequence.expected_length == 3
    assert all((voxel.dtype, intrinsics.tolist()) == (torch.float32, [320, 320, 320, 240])
               for voxel, intrinsics, _ in frames)
    truth = sequence.ground_truth()
    assert truth is not None
    assert truth[0].tolist() == [0, 1, 2, 3], "the pose of voxel k is that of frame k"
    # north east down -> right down forward
    np.testing.assert_allclose(truth[1][2], [0.5, -0.25, 2, 0, 0.6, 0, 0.8], atol=1e-6)
    images = list(sequence.frames())
    assert [(int(image[0, 0, 0]), t) for image, _, t in images] == [(0, 0), (10, 1), (20, 2), (30, 3)]
    assert sequence.describe()["windows"]["expected"] == 3
    with pytest.raises(InputError, match="ready-made voxel grids and no events"):
        sequence.open_events()


def test_choice_of_frames(tmp_path: Path) -> None:
    events = write_scene(tmp_path, 8)
    chosen = open_sequence("tartan", events / "h5", SequenceOptions(start_us=2, stop_us=7, stride=2))
    assert [t for _, _, t in chosen.voxels()] == [2, 4, 6]
    with pytest.raises(InputError, match=r"no frame inside start_us and stop_us.*there are 1 to 7"):
        next(open_sequence("tartan", events, SequenceOptions(start_us=100)).voxels())


def test_folders_that_lack_something(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no voxel grids h5/<frame number>.h5; pass a folder"):
        open_sequence("tartan", tmp_path)
    events = write_scene(tmp_path)
    for name, value in (("side", "right"), ("window_ms", 5.0), ("image_size", (64, 48))):
        with pytest.raises(InputError, match=f"{name} cannot be used with data set tartan"):
            open_sequence("tartan", events, SequenceOptions(**{name: value}))  # type: ignore[arg-type]
    with h5py.File(events / "h5" / "0000000002.h5", "w") as file:
        file["voxel"] = np.zeros((5, 24, 32), np.float16)
    with pytest.raises(InputError, match=r"0000000002.h5: voxel grid of 32x24 pixels, expected 64x48"):
        list(open_sequence("tartan", events).voxels())
    lonely = tmp_path / "lonely"
    (events / "h5").rename(lonely)
    (tmp_path / "copy").mkdir()
    lonely.rename(tmp_path / "copy" / "h5")
    alone = open_sequence("tartan", tmp_path / "copy")
    assert alone.ground_truth() is None
    with pytest.raises(InputError, match="there is no folder image_left/.../imgs beside evs_left"):
        next(alone.frames())
