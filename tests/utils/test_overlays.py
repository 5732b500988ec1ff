"""Overlays: where points land, what the score says about right and wrong poses, and events paired by time."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from devo.errors import InputError
from devo.lietorch import SE3
from devo.poses import invert_poses_numpy
from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleScene
from tests.utils.dotted_scene import FRAME_US, project, wall_points
from utils.datasets.registry import Recording, SequenceOptions, open_sequence
from utils.frame_bundle import FrameBundle
from utils.overlays import build_overlays, contact_sheet, density_score, draw_overlay, event_histogram, write_arrays

FRAMES = 7


@pytest.fixture(scope="module")
def scene() -> OracleScene:
    return OracleScene(FRAMES, 0.3)


@pytest.fixture(scope="module")
def recording(scene: OracleScene, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Each dot fires three times in the middle of every frame."""
    path = tmp_path_factory.mktemp("overlays") / "events.npz"
    table = []
    for frame in range(FRAMES):
        pixel = torch.round(project(scene, wall_points(scene, 40, margin=0.2), frame)).numpy()
        inside = (pixel >= 0).all(axis=1) & (pixel[:, 0] < WIDTH) & (pixel[:, 1] < HEIGHT)
        middle = frame * FRAME_US + FRAME_US // 2
        table += [np.column_stack([pixel[inside], np.full(inside.sum(), middle + k)]) for k in (-1, 0, 1)]
    events = np.concatenate(table).astype(np.int64)
    np.savez(path, x=events[:, 0].astype(np.uint16), y=events[:, 1].astype(np.uint16), t=events[:, 2],
             p=np.ones(len(events), np.uint8))
    return open_sequence("generic", path, SequenceOptions(image_size=(WIDTH, HEIGHT),
                                                          intrinsics=tuple(INTRINSICS.tolist())))


def bundle_of(scene: OracleScene, shift_us: float = 0.0) -> FrameBundle:
    points = wall_points(scene, 40, margin=0.2)
    frames = []
    for i, pose in enumerate(scene.cam_T_world.data):
        mine = points[i::FRAMES]  # every frame hosts some of the points
        frames.append({"frame_id": i + 7, "timestamp": i * FRAME_US + FRAME_US / 2 + shift_us, "pose": pose.numpy(),
                       "intrinsics": (INTRINSICS / 4).numpy(), "points": mine.numpy(),
                       "inv_depths": 1.0 / SE3(pose.expand(len(mine), 7).clone()).act(mine)[:, 2].numpy(),
                       "centers": project(scene, mine, i).numpy() / 4})
    return FrameBundle.from_frames(frames)


def test_points_of_right_poses_lie_on_the_events(scene: OracleScene, recording: Recording) -> None:
    bundle = bundle_of(scene)
    overlays = list(build_overlays(recording, bundle, neighbors=FRAMES))
    assert [overlay.frame_id for overlay in overlays] == list(range(7, 7 + FRAMES))
    for i, overlay in enumerate(overlays):
        inside = bundle.centers[bundle.rows(i)] * 4
        inside = inside[((inside >= 0) & (inside <= [WIDTH - 1, HEIGHT - 1])).all(axis=1)]
        np.testing.assert_allclose(overlay.own, inside, atol=1e-3)
        assert overlay.own_score > 20 and overlay.others_score > 20
        assert overlay.event_image.sum() == len(overlay.events["t"])


def test_inverted_poses_and_wrong_times_score_like_chance(scene: OracleScene, recording: Recording) -> None:
    bundle = bundle_of(scene)
    inverted = dataclasses.replace(bundle, cam_T_world=invert_poses_numpy(bundle.cam_T_world))
    late = bundle_of(scene, shift_us=2 * FRAME_US)
    for wrong in (inverted, late):
        scores = [overlay.others_score for overlay in build_overlays(recording, wrong, neighbors=FRAMES)]
        assert np.nanmedian(scores) < 8, "a third of what the right poses give at least"


def test_which_frames_are_drawn(scene: OracleScene, recording: Recording) -> None:
    bundle = bundle_of(scene)
    some = list(build_overlays(recording, bundle, max_frames=3, neighbors=0))
    assert [overlay.frame_id for overlay in some] == [7, 10, 13]
    assert all(len(overlay.others) == 0 and np.isnan(overlay.others_score) for overlay in some)
    half = list(build_overlays(recording, bundle_of(scene, shift_us=4 * FRAME_US), window_us=FRAME_US / 2))
    assert len(half) == 3, "frames without events are left out"


@pytest.mark.parametrize(("values", "word"), [
    ({"window_us": 0.0}, "window_us"), ({"neighbors": -1}, "neighbors"), ({"max_frames": -1}, "max_frames"),
    ({"res_scale": float("nan")}, "res_scale")])
def test_senseless_arguments_are_refused(values: dict, word: str, scene: OracleScene, recording: Recording) -> None:
    with pytest.raises(InputError, match=word):
        list(build_overlays(recording, bundle_of(scene), **values))


def test_a_bundle_of_another_recording_is_refused(scene: OracleScene, recording: Recording) -> None:
    with pytest.raises(InputError, match="another recording"):
        list(build_overlays(recording, bundle_of(scene, shift_us=1e9)))
    with pytest.raises(InputError, match="no frame"):
        list(build_overlays(recording, FrameBundle.from_frames([])))


def test_score_of_known_images() -> None:
    image = np.zeros((30, 40), np.float32)
    image[10, 20] = 9.0  # its 3x3 surroundings have a density of 1, the image one of 9/1200
    assert density_score(image, np.array([[20.0, 10.0]])) == pytest.approx(1200 / 9)
    assert density_score(image, np.array([[20.0, 10.0], [5.0, 5.0]])) == pytest.approx(600 / 9)
    assert np.isnan(density_score(image, np.zeros((0, 2)))) and np.isnan(density_score(image * 0, np.ones((1, 2))))
    uniform = np.ones((30, 40), np.float32)
    assert density_score(uniform, np.random.default_rng(0).uniform(0, 29, (50, 2))) == pytest.approx(1.0)


def test_histogram_leaves_out_what_lies_outside() -> None:
    image = event_histogram(np.array([0.4, 3.6, -0.6, 1.0, 9.0]), np.array([0.0, 1.4, 0.0, 2.6, 0.0]), 3, 4)
    assert image.sum() == 1 and image[0, 0] == 1
    assert event_histogram(np.array([2.0, 2.0]), np.array([1.0, 1.0]), 3, 4)[1, 2] == 2


def test_pictures(scene: OracleScene, recording: Recording, tmp_path: Path) -> None:
    overlays = list(build_overlays(recording, bundle_of(scene)))
    picture = draw_overlay(overlays[3], label=False)
    assert picture.shape == (HEIGHT, WIDTH, 3)
    column, row = np.rint(overlays[3].own[0]).astype(int)
    assert picture[row, column].tolist() == [60, 60, 255]
    sheet = contact_sheet([draw_overlay(overlay) for overlay in overlays])
    assert sheet.shape == (1200, 1600, 3)  # 3 x 3 tiles of 160 x 120
    path = write_arrays(tmp_path / "one.npz", overlays[3], HEIGHT, WIDTH)
    with np.load(path) as arrays:
        assert arrays["voxel"].shape == (5, HEIGHT, WIDTH) and arrays["frame_id"] == 10
        np.testing.assert_allclose(np.abs(arrays["voxel"]).sum(), overlays[3].event_image.sum(), rtol=1e-5)
        np.testing.assert_allclose(np.column_stack([arrays["u"], arrays["v"]]), overlays[3].own)
    assert cv2.countNonZero(sheet[:, :, 2]) > 0
