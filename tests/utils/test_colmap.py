"""COLMAP models: pycolmap reads back what was written, and computes the same reprojection errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devo.errors import InputError, OutputError
from utils.clouds.cloud import PointCloud
from utils.colmap.files import write_model
from utils.colmap.model import PIXEL_CENTER, ColmapModel, TrackRules, build_model, reprojection_errors
from utils.colmap.observations import Observations, observations_of, read_observations, save_observations
from utils.trajectory_io import inverted, rotation_matrices

SIZE, CAMERA = (160, 120), np.array([120.0, 118.0, 79.0, 61.0])
FRAMES, POINTS = 6, 40


def world() -> tuple[PointCloud, np.ndarray]:
    """Points in front of a camera that moves sideways and turns."""
    rng = np.random.default_rng(2)
    points = np.c_[rng.uniform(-1, 1, (POINTS, 2)), rng.uniform(3, 5, POINTS)]
    share = np.linspace(0, 1, FRAMES)
    quat = np.c_[0.02 * share, -0.05 * share, 0.03 * share, np.ones(FRAMES)]
    poses = np.c_[0.5 * share, 0.1 * share, 0.05 * share, quat / np.linalg.norm(quat, axis=1, keepdims=True)]
    return PointCloud(points, rng.integers(0, 256, (POINTS, 3)).astype(np.uint8)), poses


def measured(noise_px: float = 0.0) -> Observations:
    """Every point in every second frame from its own number on, with noise."""
    cloud, poses = world()
    point, frame = np.nonzero((np.arange(FRAMES) + np.arange(POINTS)[:, None]) % 2 == 0)
    R = rotation_matrices(poses[:, 3:])[frame]
    seen = np.einsum("eji,ej->ei", R, cloud.points[point] - poses[frame, :3])
    pixel = seen[:, :2] / seen[:, 2:] * CAMERA[:2] + CAMERA[2:]
    pixel += noise_px * np.random.default_rng(3).normal(size=pixel.shape)
    return Observations(POINTS, point, frame, pixel.astype(np.float32), np.ones(len(point), np.float32))


def model(noise_px: float = 0.5, **rules: Any) -> ColmapModel:
    cloud, poses = world()
    names = [f"frame_{i:06d}.png" for i in range(FRAMES)]
    return build_model(cloud, measured(noise_px), poses, names, CAMERA, SIZE, TrackRules(**rules))


@pytest.fixture(scope="module")
def pycolmap() -> Any:
    return pytest.importorskip("pycolmap", reason="the reader of COLMAP models is not installed (pip install pycolmap)")


# --- the third-party reader -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_pycolmap_reads_everything_back(pycolmap: Any, tmp_path: Path, kind: str) -> None:
    written = model(scale=10.0)
    write_model(tmp_path, written, kind)
    found = pycolmap.Reconstruction(str(tmp_path))
    camera = found.cameras[1]
    assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == SIZE
    np.testing.assert_allclose(camera.params, CAMERA + [0, 0, PIXEL_CENTER, PIXEL_CENTER])
    cloud, poses = world()
    assert found.num_images() == FRAMES and found.num_points3D() == POINTS
    for number, image in found.images.items():
        assert image.name == f"frame_{number - 1:06d}.png"
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        expected = rotation_matrices(inverted(poses)[:, 3:])[number - 1]
        np.testing.assert_allclose(pose.rotation.matrix(), expected, atol=1e-12)
        np.testing.assert_allclose(pose.translation, 10 * inverted(poses)[number - 1, :3], atol=1e-12)
        np.testing.assert_allclose(image.projection_center(), 10 * poses[number - 1, :3], atol=1e-9)
    for number, point in found.points3D.items():
        np.testing.assert_allclose(point.xyz, 10 * cloud.points[number - 1].astype(np.float64), rtol=1e-8)
        np.testing.assert_array_equal(point.color, cloud.colors[number - 1])
        assert point.color.dtype == np.uint8
    tracks = {(number, element.image_id) for number, point in found.points3D.items()
              for element in point.track.elements}
    observations = measured()
    assert tracks == set(zip((observations.point + 1).tolist(), (observations.frame + 1).tolist()))


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_the_errors_are_those_that_pycolmap_computes(pycolmap: Any, tmp_path: Path, kind: str) -> None:
    write_model(tmp_path, model(noise_px=0.7), kind)
    found = pycolmap.Reconstruction(str(tmp_path))
    ours = {number: point.error for number, point in found.points3D.items()}
    found.update_point_3d_errors()
    theirs = {number: point.error for number, point in found.points3D.items()}
    assert 0.3 < np.mean(list(ours.values())) < 2.0
    np.testing.assert_allclose([ours[n] for n in theirs], list(theirs.values()), atol=1e-5)


def test_without_noise_the_error_is_zero() -> None:
    assert model(noise_px=0.0).errors.max() < 1e-4


def test_inverted_poses_would_show() -> None:
    """Camera-to-world poses written as they are: the published tools mixed them up."""
    cloud, poses = world()
    names = [str(i) for i in range(FRAMES)]
    wrong = build_model(cloud, measured(), inverted(poses), names, CAMERA, SIZE, TrackRules(1e9, 1, 1.0))
    assert np.median(wrong.errors) > 3, "pixels; with the right poses it is below 1e-4"


# --- rules and refusals ---------------------------------------------------------------------------------------


def test_outliers_and_short_tracks_are_left_out() -> None:
    cloud, poses = world()
    spoilt = measured()
    spoilt.pixel_xy[0] += 50  # one observation of point 0
    first = spoilt.point == 1
    kept = spoilt.select(~first | (spoilt.frame == spoilt.frame[first][0]))  # point 1 is seen once
    names = [str(i) for i in range(FRAMES)]
    found = build_model(cloud, kept, poses, names, CAMERA, SIZE, TrackRules(4.0, 2, 1.0))
    assert len(found.points) == POINTS - 1
    np.testing.assert_allclose(found.points[1], cloud.points[2])
    assert found.track_lengths()[0] == 2 and found.errors.max() < 1e-3
    assert sorted(found.slot[found.image == 0]) == list(range(int((found.image == 0).sum())))


def test_points_behind_a_camera_are_no_observations() -> None:
    cloud, poses = world()
    behind = PointCloud(cloud.points * [1, 1, -1], cloud.colors)
    with pytest.raises(InputError, match="none of the 40 points"):
        build_model(behind, measured(), poses, [str(i) for i in range(FRAMES)], CAMERA, SIZE)


def test_what_does_not_fit_together() -> None:
    cloud, poses = world()
    names = [f"{i}.png" for i in range(FRAMES)]
    cases = [
        ((cloud.select(slice(5)), measured(), poses, names), "cloud of 40 points, found 5"),
        ((cloud, measured(), poses[:3], names[:3]), "for 3 poses"),
        ((cloud, measured(), poses, names[:-1]), "5 image names"),
        ((cloud, measured(), poses, ["a b", *names[1:]]), "hold no blanks"),
        ((cloud, measured(), poses, [names[0], *names[:-1]]), "a name twice"),
        ((cloud, measured(), np.full_like(poses, np.nan), names), "not finite"),
    ]
    for (points, seen, path, labels), message in cases:
        with pytest.raises(InputError, match=message):
            build_model(points, seen, path, labels, CAMERA, SIZE)
    for rules in ({"max_error_px": 0.0}, {"min_length": 0}, {"scale": -1.0}, {"scale": float("nan")}):
        with pytest.raises(InputError, match="tracks need"):
            TrackRules(**rules)


def test_files_replace_those_of_the_other_kind(tmp_path: Path) -> None:
    write_model(tmp_path, model(), "binary")
    write_model(tmp_path, model(), "text")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
    with pytest.raises(InputError, match="text or binary"):
        write_model(tmp_path, model(), "xml")
    with pytest.raises(OutputError):
        write_model("/proc/devo-test", model())


# --- observations ---------------------------------------------------------------------------------------------


def test_observations_survive_their_file(tmp_path: Path) -> None:
    written = measured(1.0)
    save_observations(tmp_path / "run_observations.npz", written)
    found = read_observations(tmp_path / "run_observations.npz")
    for name in ("points", "point", "frame", "pixel_xy", "weight"):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))


@pytest.mark.parametrize(("change", "message"), [
    ({"point": None}, "point missing"), ({"frame": np.zeros(3)}, "frame is"), ({"points": np.array(2)}, "too large"),
    ({"pixel_xy": np.array([["a", "b"]])}, "pixel_xy is")])
def test_damaged_observations(tmp_path: Path, change: dict, message: str) -> None:
    found = measured()
    arrays = {"points": np.array(POINTS), "point": found.point, "frame": found.frame, "pixel_xy": found.pixel_xy,
              "weight": found.weight} | change
    np.savez(tmp_path / "o.npz", **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(InputError, match=message):
        read_observations(tmp_path / "o.npz")


def test_the_hosts_row_counts_where_a_pair_occurs_twice() -> None:
    hosts = Observations.of_hosts([1, 0], [[5.0, 6.0], [7.0, 8.0]])
    seen = Observations(2, np.array([1, 0, 0]), np.array([0, 1, 2]), np.full((3, 2), 9, np.float32),
                        np.full(3, 0.5, np.float32))
    joined = hosts.joined(seen)
    assert list(zip(joined.point.tolist(), joined.frame.tolist())) == [(0, 1), (0, 2), (1, 0)]
    np.testing.assert_array_equal(joined.pixel_xy, [[5, 6], [9, 9], [7, 8]])


def test_observations_of_a_real_tracker_lie_where_the_points_are_seen() -> None:
    """The errors of the tracks are the residuals that the tracker itself reports, and small with the true flow."""
    import torch

    from devo.config import Config
    from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleNetwork, OracleScene, OracleTracker
    from utils.export_products import observables_to_cloud

    scene = OracleScene(20, 0.2)
    torch.manual_seed(0)
    cfg = Config({"PATCHES_PER_FRAME": 16, "REMOVAL_WINDOW": 10, "OPTIMIZATION_WINDOW": 6, "PATCH_LIFETIME": 6,
                  "NORM": "none", "MIXED_PRECISION": False, "KEYFRAME_THRESH": 9.0})
    tracker = OracleTracker(cfg, OracleNetwork(scene), evs=True, ht=HEIGHT, wd=WIDTH)
    for image, intrinsics, t_us in scene.frames():
        tracker(t_us, image, intrinsics)
    tracker.refine()
    result, found = tracker.result(observables=True), observations_of(tracker)
    assert result.observables is not None and found.points == len(result.observables)
    host = found.frame == result.observables.host_frame[found.point]
    assert host.sum() == found.points and (found.weight[host] == 1).all()
    np.testing.assert_array_equal(found.pixel_xy[host], result.observables.pixel_xy)
    errors = reprojection_errors(result.observables.points.astype(np.float64), inverted(result.poses),
                                 INTRINSICS.numpy().astype(np.float64), found)
    compared = 0
    for number in range(0, found.points, 7):
        own = np.sort(errors[(found.point == number) & ~host])
        if len(own) == result.observables.observations[number] > 0:  # the solver passes over very near points
            compared += 1
            assert own[(len(own) - 1) // 2] == pytest.approx(result.observables.residual_px[number], abs=0.02)
    assert compared > 20
    model_of_run = build_model(observables_to_cloud(result.observables), found, result.poses,
                               [str(i) for i in range(20)], INTRINSICS.numpy(), (WIDTH, HEIGHT))
    assert model_of_run.track_lengths().mean() > 4
    assert np.median(model_of_run.errors) < 0.5, "pixels of 160 x 120"
