"""The tracker on a known scene: geometry, bookkeeping invariants, odd inputs, determinism."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from devo.config import Config
from devo.devo import DEVO
from devo.errors import InputError
from devo.lietorch import SE3
from devo.result import TrackingStatus
from devo.trajectory import accumulated_map
from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleNetwork, OracleScene, OracleTracker
from tests.tolerances import ORACLE_PATH

SETTINGS = {"PATCHES_PER_FRAME": 24, "REMOVAL_WINDOW": 14, "OPTIMIZATION_WINDOW": 7, "PATCH_LIFETIME": 8,
            "NORM": "none", "MIXED_PRECISION": False, "KEYFRAME_THRESH": 4.0}


def make_tracker(frames: int = 24, step: float = 0.1, **changes: object) -> tuple[OracleTracker, OracleScene]:
    scene = OracleScene(frames, step)
    options = {key: changes.pop(key) for key in ("record_frame_observables", "accumulate_map") if key in changes}
    cfg = Config(SETTINGS | changes)
    return OracleTracker(cfg, OracleNetwork(scene), evs=True, ht=HEIGHT, wd=WIDTH, **options), scene


def drive(tracker: OracleTracker, scene: OracleScene, check: bool = False) -> None:
    torch.manual_seed(0)
    for voxel, intrinsics, t_us in scene.frames():
        tracker(t_us, voxel, intrinsics)
        if check:
            assert_invariants(tracker)
    tracker.refine()


def assert_invariants(tracker: DEVO) -> None:
    cfg, ii, jj, kk = tracker.cfg, tracker.ii, tracker.jj, tracker.kk
    assert tracker.m == tracker.n * tracker.M
    if len(kk) == 0:
        return
    assert torch.equal(tracker.ix[kk], ii)
    assert int(ii.min()) >= 0 and int(jj.min()) >= 0
    assert int(ii.max()) < tracker.n and int(jj.max()) < tracker.n and int(kk.max()) < tracker.m
    reach = int(torch.maximum(tracker.n - jj, tracker.n - ii).max())
    if tracker.is_initialized and tracker.n > 8:
        assert reach <= cfg.REMOVAL_WINDOW + cfg.PATCH_LIFETIME - 1
    assert tracker.mem >= cfg.REMOVAL_WINDOW + cfg.PATCH_LIFETIME
    for name in ("net", "target_", "weight_"):
        assert getattr(tracker, name).shape[1] == len(kk)
    pairs = kk * tracker.N + jj
    assert len(torch.unique(pairs)) == len(pairs), "an edge exists twice"


@pytest.fixture(scope="module")
def tracked() -> tuple[OracleTracker, OracleScene]:
    """A finished run with everything recorded and a third of the keyframes removed; tests only read it."""
    tracker, scene = make_tracker(frames=30, KEYFRAME_THRESH=9.0, record_frame_observables=True, accumulate_map=True)
    drive(tracker, scene, check=True)
    return tracker, scene


def test_index_invariants_hold_after_every_frame() -> None:
    tracker, scene = make_tracker(KEYFRAME_THRESH=0.0)
    drive(tracker, scene, check=True)
    assert tracker.is_initialized


def test_every_counted_frame_gets_one_pose_and_the_first_is_the_identity(tracked: tuple) -> None:
    tracker, _ = tracked
    result = tracker.result()
    assert result.poses.shape == (30, 7) and result.poses.dtype == np.float32
    assert result.tstamps.tolist() == [1e4 * i for i in range(30)]
    np.testing.assert_allclose(result.poses[0], [0, 0, 0, 0, 0, 0, 1], atol=1e-7)
    assert result.status is TrackingStatus.TRACKED and result.tracked_share > 0.9


def test_buffers_grow_and_change_nothing() -> None:
    small, scene = make_tracker(frames=20, BUFFER_SIZE=9)
    large, _ = make_tracker(frames=20, BUFFER_SIZE=64)
    drive(small, scene)
    drive(large, scene)
    assert small.N > 9
    assert small.result().poses.tobytes() == large.result().poses.tobytes()


def test_same_seed_gives_the_same_bytes() -> None:
    results = []
    for _ in range(2):
        tracker, scene = make_tracker(frames=17)
        drive(tracker, scene)
        results.append(tracker.result(observables=True))
    first, second = results
    assert first.poses.tobytes() == second.poses.tobytes()
    for name, values in first.observables.scalars().items():
        assert values.tobytes() == second.observables.scalars()[name].tobytes(), name


def test_odd_sizes_are_cropped_and_the_principal_point_moves() -> None:
    scene = OracleScene(2, 0.1)
    for legacy, shift in ((False, 1.0), (True, 0.0)):
        cfg = Config(SETTINGS | {"LEGACY_PRINCIPAL_POINT": legacy})
        tracker = OracleTracker(cfg, OracleNetwork(scene), evs=True, ht=122, wd=163)
        tracker(0.0, torch.ones(5, 122, 163), INTRINSICS)
        assert tracker.fmap1_.shape[-2:] == (30, 40)
        expected = (INTRINSICS - torch.tensor([0.0, 0.0, shift, shift])) / 4
        torch.testing.assert_close(tracker.intrinsics_[0], expected)
    width_346 = OracleTracker(Config(SETTINGS), OracleNetwork(scene), evs=True, ht=260, wd=346)
    assert (width_346.crop_left, width_346.crop_top, tuple(width_346.fmap1_.shape[-2:])) == (1, 0, (65, 86))


def test_pixels_of_points_are_those_of_the_uncropped_frame(tracked: tuple) -> None:
    tracker, _ = tracked
    structure = tracker.result(observables=True).observables
    fx, fy, cx, cy = INTRINSICS.double().numpy()
    poses = tracker.result().poses[structure.host_frame]
    in_camera = SE3(torch.from_numpy(poses)).inv().act(torch.from_numpy(structure.points)).double().numpy()
    np.testing.assert_allclose(in_camera[:, 2], structure.depths, rtol=1e-3)
    np.testing.assert_allclose(in_camera[:, 0] / in_camera[:, 2] * fx + cx, structure.pixel_xy[:, 0], atol=0.05)
    np.testing.assert_allclose(in_camera[:, 1] / in_camera[:, 2] * fy + cy, structure.pixel_xy[:, 1], atol=0.05)


@pytest.mark.parametrize("voxel", [
    torch.ones(5, 60, 160), torch.ones(3, HEIGHT, WIDTH)[0], torch.full((5, HEIGHT, WIDTH), float("nan")),
    torch.full((5, HEIGHT, WIDTH), float("inf")),
], ids=["size", "dimensions", "nan", "inf"])
def test_unusable_frames_are_refused(voxel: torch.Tensor) -> None:
    tracker, _ = make_tracker()
    with pytest.raises(InputError, match="frame 1"):
        tracker(0.0, voxel, INTRINSICS)


def test_too_small_images_are_refused() -> None:
    with pytest.raises(InputError, match="0x120"):
        OracleTracker(Config(SETTINGS), OracleNetwork(OracleScene(2, 0.1)), evs=True, ht=120, wd=0)


def test_empty_and_sparse_voxels_do_not_start_a_run() -> None:
    tracker, _ = make_tracker()
    sparse = torch.zeros(5, HEIGHT, WIDTH)
    sparse[0, 0, :3] = 1.0
    assert not tracker(0.0, torch.zeros(5, HEIGHT, WIDTH), INTRINSICS)
    assert not tracker(1.0, sparse, INTRINSICS)
    result = tracker.result()
    assert result.status is TrackingStatus.EMPTY_STREAM and len(result.poses) == 0
    assert "2 read" in result.message


def test_without_motion_the_run_says_not_initialised_and_gives_no_poses() -> None:
    tracker, scene = make_tracker(step=0.0, frames=10)
    scene.cam_T_world.data[:] = scene.cam_T_world.data[:1]
    drive(tracker, scene)
    tracker.update()
    with pytest.warns(UserWarning, match="not initialised"):
        poses, tstamps = tracker.terminate()
    assert poses.shape == (10, 7) and np.isnan(poses).all() and len(tstamps) == 10


def test_updates_without_edges_do_nothing() -> None:
    tracker, _ = make_tracker()
    tracker.update()
    tracker.is_initialized = True
    tracker.refine()
    assert tracker.counters["updates"] == 0


TUPLES = [((False, False, False), 2), ((False, True, False), 3), ((True, False, False), 4), ((True, False, True), 5),
          ((True, True, False), 5), ((True, True, True), 6)]


@pytest.mark.parametrize(("flags", "length"), TUPLES)
def test_terminate_returns_the_published_tuples(tracked: tuple, flags: tuple[bool, bool, bool], length: int) -> None:
    tracker, _ = tracked
    values = tracker.terminate(*flags)
    assert len(values) == length
    if flags[0]:
        points, depths = values[2:4]
        assert points.shape == (len(depths), 3) and (depths > 0).all()
    if flags[2]:
        assert values[4].shape == points.shape and values[4].max() <= 1.0
    if flags[1]:
        assert isinstance(values[-1], list) and set(values[-1][0]) >= {"frame_id", "timestamp", "pose", "points"}


@pytest.mark.parametrize("frames", [False, True])
def test_colours_need_observables(frames: bool) -> None:
    tracker, _ = make_tracker(record_frame_observables=True)
    with pytest.raises(ValueError, match="include_colors"):
        tracker.terminate(False, frames, True)


def test_frame_observables_final_and_online(tracked: tuple) -> None:
    tracker, scene = tracked
    assert tracker.counters["keyframes_dropped"] > 3
    poses = tracker.result().poses
    final, online = (tracker.result(frame_mode=mode).frame_data for mode in ("final", "online"))
    assert [f["frame_id"] for f in final] == [f["frame_id"] for f in online]
    assert final[0]["frame_id"] >= 7
    for frame in final:
        world_T_cam = SE3(torch.from_numpy(frame["pose"])).inv().data.numpy()
        np.testing.assert_allclose(np.abs(world_T_cam), np.abs(poses[frame["frame_id"]]), atol=1e-5)
        np.testing.assert_allclose(frame["depths"] * frame["inv_depths"], 1.0, rtol=1e-5)
    scale = trajectory_scale(tracker, scene)
    errors = [np.median(scene_distance(scene, f["points"], scale)) for f in final]
    assert np.median(errors) < 0.02 * 3.0
    with pytest.raises(InputError, match="frame_mode"):
        tracker.result(frame_mode="later")


def test_accumulated_map_holds_keyframes_and_removed_ones(tracked: tuple) -> None:
    tracker, _ = tracked
    points, colors = accumulated_map(tracker)
    expected = (tracker.n + tracker.counters["keyframes_dropped"]) * tracker.M
    assert points.shape == (expected, 3) and colors.shape == (expected, 3)
    assert len(tracker.get_accumulated_map()) == expected
    plain, _ = make_tracker()
    with pytest.raises(InputError, match="accumulate_map"):
        accumulated_map(plain)


def trajectory_scale(tracker: DEVO, scene: OracleScene) -> float:
    """Scene units per trajectory unit; both start in the first camera, so only the scale is free.

    Measured on keyframes: with STILL_FRAMES: hold, frames that were passed over before initialisation stand still.
    """
    keyframes = tracker.tstamps_[:tracker.n]
    estimate = tracker.result().poses[keyframes, :3].astype(np.float64)
    truth = scene.world_T_cam.data[keyframes, :3].numpy()
    return float((truth * estimate).sum() / (estimate * estimate).sum())


def scene_distance(scene: OracleScene, points: np.ndarray, scale: float) -> np.ndarray:
    return scene.distance(torch.from_numpy(points).double() * scale).numpy()


@pytest.mark.parametrize(("threshold", "dropped_share"), [(0.0, 0.0), (3.0, 0.1), (5.0, 0.3)])
def test_cloud_lies_on_the_scene_and_the_path_is_right(threshold: float, dropped_share: float) -> None:
    """True flow in, true geometry out: cloud within 2 % of the distance, path within 0.2 % of its length."""
    tracker, scene = make_tracker(frames=40, KEYFRAME_THRESH=threshold)
    drive(tracker, scene)
    share = tracker.counters["keyframes_dropped"] / tracker.counter
    assert share == 0.0 if dropped_share == 0.0 else share >= dropped_share
    result = tracker.result(observables=True)
    scale = trajectory_scale(tracker, scene)
    truth = scene.world_T_cam.data[:, :3].numpy()
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    error = np.linalg.norm(scale * result.poses[:, :3] - truth, axis=1)
    assert np.sqrt((error * error).mean()) < ORACLE_PATH * length
    structure = result.observables
    distance = scene_distance(scene, structure.points, scale) / (scale * structure.depths)
    observed = (structure.observations >= 3) & (structure.parallax_deg >= 1.0)
    assert observed.mean() > 0.7
    assert np.quantile(distance[observed], 0.95) < 0.02


def test_frames_passed_over_before_initialisation_are_interpolated_in_time() -> None:
    """`hold` repeats the keyframe before, as published; `interpolate` puts them on the way to the next one."""
    held, scene = make_tracker(frames=20, STILL_FRAMES="hold")
    drive(held, scene)
    moving, scene = make_tracker(frames=20)
    drive(moving, scene)
    still = moving.still_frames
    assert len(still) >= 5 and still == held.still_frames
    others = np.setdiff1d(np.arange(20), still)
    np.testing.assert_array_equal(held.result().poses[others], moving.result().poses[others])
    poses = moving.result().poses
    for frame in still:
        before, after = others[others < frame].max(), others[others > frame].min()
        np.testing.assert_array_equal(held.result().poses[frame], held.result().poses[before])
        share = (frame - before) / (after - before)
        # on such short ways the geodesic is nearly straight
        expected = (1 - share) * poses[before, :3] + share * poses[after, :3]
        way = np.linalg.norm(poses[after, :3] - poses[before, :3])
        assert np.linalg.norm(poses[frame, :3] - expected) < 0.02 * way


def test_quality_describes_the_points(tracked: tuple) -> None:
    tracker, _ = tracked
    structure = tracker.result(observables=True).observables
    assert structure.observations.max() <= 2 * tracker.cfg.PATCH_LIFETIME
    assert np.nanmedian(structure.residual_px) < 0.5  # true flow
    seen = structure.observations > 0
    assert np.isfinite(structure.residual_px[seen]).all() and np.isnan(structure.residual_px[~seen]).all()
    assert (structure.parallax_deg >= 0).all() and structure.parallax_deg.max() < 90
    assert np.allclose(structure.mean_weight[seen], 1.0, atol=1e-6)
    near = structure.parallax_deg > np.median(structure.parallax_deg)
    relative = structure.inv_depth_sigma * structure.depths
    assert np.median(relative[near]) < np.median(relative[~near])  # more parallax, more certainty
    stamps = structure.t_us / 1e4
    np.testing.assert_array_equal(stamps, structure.host_frame)


def test_retired_edges_survive_keyframe_removal() -> None:
    """What is kept of old edges still measures the right keyframes after slots moved."""
    tracker, scene = make_tracker(frames=30, KEYFRAME_THRESH=6.0, REMOVAL_WINDOW=8, PATCH_LIFETIME=6)
    drive(tracker, scene)
    assert tracker.counters["keyframes_dropped"] > 3
    edges = tracker.all_edges()
    assert len(edges) > len(tracker.kk) and torch.equal(tracker.ix[edges.kk], edges.ii)
    pairs = list(itertools.chain(edges.ii.tolist(), edges.jj.tolist()))
    assert max(pairs) < tracker.n
    structure = tracker.result(observables=True).observables
    assert np.nanquantile(structure.residual_px, 0.9) < 1.0


def state_bytes(tracker: DEVO) -> int:
    """Everything the tracker holds in tensors that can grow, edges and remembered observations included."""
    records = [tracker.active_edges(), *tracker.retired_edges]
    tensors = [t for record in records for t in (record.ii, record.jj, record.kk, record.target, record.weight)]
    tensors += [tracker.net, tracker.poses_, tracker.patches_, tracker.index_, tracker.ring.fmap1_, tracker.ring.gmap_]
    tensors += [pose for _, pose in tracker.delta.values()]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def test_memory_grows_by_keyframes_only() -> None:
    """With every new keyframe removed again, twice as many frames cost a pose each and nothing else."""
    tracker, scene = make_tracker(frames=60, step=0.08, KEYFRAME_THRESH=200.0, BUFFER_SIZE=32)
    torch.manual_seed(0)
    sizes = {}
    for i, (voxel, intrinsics, t_us) in enumerate(scene.frames()):
        tracker(t_us, voxel, intrinsics)
        sizes[i] = state_bytes(tracker)
        if i == 39:
            keyframes = tracker.n
    assert tracker.is_initialized and tracker.n == keyframes and tracker.N == 32
    assert sizes[59] - sizes[39] <= 20 * 7 * 4
