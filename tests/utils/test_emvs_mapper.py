"""The mapper on real events, on a simulated board, along a trajectory, and on input that cannot work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from utils.calibration import Calibration, read_calibration
from utils.clouds import PointCloud
from utils.emvs import EmvsMap, EmvsSettings, View, map_events
from utils.emvs.convention import PacketSample, check_convention
from utils.emvs.mapper import EventCamera, filter_cloud
from utils.emvs.views import PoseTrack, choose_spans, depth_range_from_points
from utils.events import MemoryEventReader, make_events, open_events
from utils.simulator.sequence import SequenceSettings, SimulatedSequence
from utils.trajectory_io import Trajectory, inverted, read_tum
from utils.undistort import rectify_map

CPU = torch.device("cpu")

# --- real events: slider_depth ------------------------------------------------------------------------------

SLIDER = EmvsSettings(min_depth=0.47, max_depth=2.4)  # the published settings of this recording


class Slider:
    def __init__(self, folder: Path) -> None:
        self.file = folder / "events_chunk.txt"
        self.calibration = read_calibration(folder / "calib.txt", (240, 180))
        self.camera = EventCamera(*rectify_map(self.calibration))
        self.trajectory = read_tum(folder / "groundtruth.txt")

    def map(self, trajectory: Trajectory | None = None, settings: EmvsSettings = SLIDER, **options: object) -> EmvsMap:
        with open_events(self.file, sensor_size=(240, 180)) as reader:
            return map_events(reader, trajectory or self.trajectory, self.camera, settings,
                              **options)  # type: ignore[arg-type]

    def errors(self, view: View) -> dict[str, float]:
        """Relative error of the median depth per object; regions are pixels of the calibrated camera."""
        rows, columns = np.mgrid[:180, :240]
        x = (columns - view.camera.cx) / view.camera.focal * self.calibration.fx + self.calibration.cx
        y = (rows - view.camera.cy) / view.camera.focal * self.calibration.fy + self.calibration.cy
        objects = {"dartboard": (2.12, (x > 160) & (y < 70)), "foreground": (0.65, y > 140), "books": (0.67, x < 60),
                   "box": (0.97, (x > 130) & (x < 165) & (y > 60) & (y < 120))}
        found = {}
        for name, (depth, region) in objects.items():
            values = view.depth_map.depth[view.depth_map.mask & region]
            assert len(values) > 100, name
            found[name] = float(np.median(values)) / depth - 1
        return found


@pytest.fixture(scope="module")
def slider(shared_data: Path) -> Slider:
    return Slider(shared_data / "slider_depth_chunk")


@pytest.mark.parametrize("subplane", [False, True])
def test_real_events_give_the_measured_depths(slider: Slider, subplane: bool) -> None:
    result = slider.map(settings=EmvsSettings(min_depth=0.47, max_depth=2.4, subplane=subplane))
    errors = slider.errors(result.views[0])
    assert all(abs(error) < 0.05 for error in errors.values()), errors
    assert result.counts["us_before_first_pose"] == 18_481
    assert result.views[0].counts["events"] == 46_749  # of 50000, the others lie before the first pose
    assert len(result.cloud) > 2000


def test_real_events_with_inverted_poses_are_wrong_and_noticed(slider: Slider) -> None:
    wrong = Trajectory(slider.trajectory.t_us, inverted(slider.trajectory.world_T_cam))
    sample = PacketSample(1024)
    result = slider.map(wrong, on_events=sample.add)
    errors = slider.errors(result.views[0])
    assert abs(errors["dartboard"]) > 0.3 and abs(errors["foreground"]) > 0.1, errors
    for trajectory, suspicious in ((wrong, True), (slider.trajectory, False)):
        check = check_convention(result.views[0], sample.events, PoseTrack(trajectory), slider.camera, SLIDER, CPU)
        assert check is not None and check.suspicious == suspicious, check


def test_scaling_poses_range_and_radius_keeps_the_count(slider: Slider) -> None:
    scale = 1.4184
    poses = slider.trajectory.world_T_cam * np.array([scale] * 3 + [1.0] * 4)
    metric = slider.map()
    scaled = slider.map(Trajectory(slider.trajectory.t_us, poses), EmvsSettings(
        min_depth=0.47 * scale, max_depth=2.4 * scale, radius_search=0.05 * scale))
    assert len(scaled.cloud) == pytest.approx(len(metric.cloud), rel=0.01)
    same = metric.views[0].depth_map.plane == scaled.views[0].depth_map.plane
    assert same.mean() > 0.999
    unscaled_radius = filter_cloud(scaled.views[0].cloud, SLIDER)
    assert len(unscaled_radius) < 0.98 * len(metric.cloud)  # the radius alone can fake an effect of scale


def test_same_input_same_bytes(slider: Slider) -> None:
    first, second = slider.map(keep_dsi=True), slider.map(keep_dsi=True)
    assert first.views[0].dsi is not None and second.views[0].dsi is not None
    assert first.views[0].dsi.numpy().tobytes() == second.views[0].dsi.numpy().tobytes()
    assert first.cloud.points.tobytes() == second.cloud.points.tobytes()


def test_world_cloud_is_the_depth_map_seen_from_the_world(slider: Slider) -> None:
    quat = Rotation.from_rotvec([0.3, -0.2, 0.5])
    poses = slider.trajectory.world_T_cam.copy()
    poses[:, :3] = quat.apply(poses[:, :3]) + [5.0, -3.0, 2.0]
    poses[:, 3:] = quat.as_quat()
    moved, still = slider.map(Trajectory(slider.trajectory.t_us, poses)), slider.map()
    assert len(moved.cloud) == pytest.approx(len(still.cloud), rel=0.01)
    expected = quat.apply(still.cloud.points) + [5.0, -3.0, 2.0]
    distance = np.linalg.norm(moved.cloud.points[:, None] - expected[None, ::20], axis=2).min(axis=0)
    assert np.quantile(distance, 0.98) < 1e-4
    view = still.views[0]
    np.testing.assert_allclose(view.cloud.scalars["depth"], view.cloud.points[:, 2], rtol=1e-6)
    np.testing.assert_allclose(view.cloud.scalars["intensity"] * view.cloud.scalars["depth"], 1, rtol=1e-6)


def test_depth_range_from_a_sparse_cloud(slider: Slider) -> None:
    full = slider.map().cloud.points
    sparse = np.concatenate([full[::20], np.full((3, 3), np.nan), [[0, 0, -50.0]]])  # rows that cannot count
    result = slider.map(settings=EmvsSettings(), sparse_points=sparse)
    low, high = np.percentile(full[::20, 2], (5, 95))
    assert result.views[0].planes.near == pytest.approx(0.8 * low, rel=1e-6)
    assert result.views[0].planes.far == pytest.approx(1.2 * high, rel=1e-6)
    half = slider.map(settings=EmvsSettings(min_depth=0.47), sparse_points=sparse)
    assert (half.views[0].planes.near, half.views[0].planes.far) == pytest.approx((0.47, 1.2 * high))
    both = slider.map(settings=EmvsSettings())
    assert (both.views[0].planes.near, both.views[0].planes.far) == (0.3, 5.0)


# --- simulated board ----------------------------------------------------------------------------------------

BOARD = {"min_depth": 0.5, "max_depth": 1.8, "adaptive_threshold_c": 7.0, "median_filter_size": 15}


class Board:
    """A short walk in front of a textured board; every depth is known."""

    def __init__(self, settings: SequenceSettings) -> None:
        sequence = SimulatedSequence(settings)
        pieces = [events for _, events in sequence.events()]
        self.reader = MemoryEventReader(type(pieces[0]).concatenate(pieces), sensor_size=settings.size)
        self.camera = EventCamera(*rectify_map(sequence.camera))
        t_us = np.arange(0, sequence.duration_us + 1, 2000)
        self.trajectory = Trajectory(t_us, sequence.path.poses(t_us).numpy())
        board = sequence.world.names.index("board")
        self.normal = sequence.world.planes.normal[0, board].double().numpy()
        self.origin = sequence.world.planes.origin[0, board].double().numpy()

    def map(self, scale: float = 1.0, **options: object) -> EmvsMap:
        settings = {**BOARD, "radius_search": 0.05 * scale, **options}
        settings |= {name: BOARD[name] * scale for name in ("min_depth", "max_depth")}
        poses = self.trajectory.world_T_cam * np.array([scale] * 3 + [1.0] * 4)
        return map_events(self.reader, Trajectory(self.trajectory.t_us, poses), self.camera,
                          EmvsSettings(**settings))  # type: ignore[arg-type]

    def distances(self, points: np.ndarray) -> np.ndarray:
        return np.abs((points - self.origin) @ self.normal)

    def judge(self, result: EmvsMap) -> tuple[int, float, float]:
        """Pixels with depth, median relative depth error, share of points within 2 % of the distance of the plane."""
        view = result.views[0]
        rows, columns = np.nonzero(view.depth_map.mask)
        rays = view.camera.points(columns.astype(float), rows.astype(float), np.ones(len(rows)))
        rays = rays @ view.world_T_view[:3, :3].T
        truth = (self.origin - view.world_T_view[:3, 3]) @ self.normal / (rays @ self.normal)
        error = np.abs(view.depth_map.depth[rows, columns] - truth)
        near = self.distances(result.cloud.points) <= 0.02 * np.median(truth)
        return len(rows), float(np.median(error / truth)), float(np.mean(near))


@pytest.fixture(scope="module")
def board() -> Board:
    return Board(SequenceSettings("board", seconds=1.2, seed=2, size=(160, 120), threshold=0.5, noise="none"))


def test_simulated_board_is_where_it_is(board: Board) -> None:
    pixels, median_error, share_near = board.judge(board.map())
    assert pixels > 1000
    assert median_error <= 0.01
    assert share_near >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_simulated_board_with_noise_at_full_size(seed: int) -> None:
    board = Board(SequenceSettings("board", seconds=4.0, seed=seed))
    pixels, median_error, share_near = board.judge(board.map())
    assert pixels > 2000
    assert median_error <= 0.01
    assert share_near >= 0.9


def test_simulated_board_with_inverted_poses_falls_apart(board: Board) -> None:
    wrong = Trajectory(board.trajectory.t_us, inverted(board.trajectory.world_T_cam))
    result = map_events(board.reader, wrong, board.camera, EmvsSettings(**BOARD))  # type: ignore[arg-type]
    assert board.judge(result)[1] > 0.05


def test_simulated_board_scaled(board: Board) -> None:
    assert len(board.map(1.4184).cloud) == pytest.approx(len(board.map().cloud), rel=0.01)


def test_views_along_the_path_merge_into_one_cloud(board: Board) -> None:
    result = board.map(reference="baseline", view_baseline=0.12)
    assert len(result.views) >= 3
    assert len(result.cloud) == sum(len(view.cloud) for view in result.views)
    np.testing.assert_array_equal(np.unique(result.cloud.scalars["view"]), np.arange(len(result.views)))
    assert sum(view.counts["events"] for view in result.views) == len(board.reader)  # each event votes once
    assert np.median(board.distances(result.cloud.points)) < 0.02
    fixed = board.map()
    assert fixed.views[0].span.reference_us == pytest.approx(600_000, abs=3000)


# --- views --------------------------------------------------------------------------------------------------


def line(length: float = 1.0, turn_deg: float = 0.0, count: int = 101) -> PoseTrack:
    share = np.linspace(0, 1, count)
    quat = Rotation.from_rotvec(np.outer(share, [0, np.radians(turn_deg), 0])).as_quat()
    position = np.outer(share * length, [1.0, 0, 0])
    return PoseTrack(Trajectory(np.arange(count) * 10_000, np.concatenate([position, quat], axis=1)))


def test_poses_between_poses() -> None:
    first, last = Rotation.from_rotvec([0.1, 0.2, -0.3]), Rotation.from_rotvec([-0.4, 0.5, 1.0])
    poses = np.array([[0, 1, 2, *first.as_quat()], [4, 3, 0, *-last.as_quat()]])  # the sign of q does not matter
    track = PoseTrack(Trajectory(np.array([1_600_000_000_000_000, 1_600_000_000_100_000]), poses))
    found = track([1_600_000_000_000_000, 1_600_000_000_025_000, 1_600_000_000_100_000])
    np.testing.assert_allclose(found[:, :3, 3], [[0, 1, 2], [1, 1.5, 1.5], [4, 3, 0]], atol=1e-9)
    between = first * Rotation.from_rotvec(0.25 * (first.inv() * last).as_rotvec())
    np.testing.assert_allclose(found[:, :3, :3], [first.as_matrix(), between.as_matrix(), last.as_matrix()], atol=1e-9)
    for t_us in (1_599_999_999_999_999, 1_600_000_000_100_001):
        with pytest.raises(InputError, match="is not extrapolated"):
            track(t_us)
    np.testing.assert_allclose(track.inverted()([1_600_000_000_000_000])[0], np.linalg.inv(found[0]), atol=1e-12)


def test_spans_follow_the_baseline_and_the_rotation() -> None:
    settings = EmvsSettings(reference="baseline", view_baseline=0.25)
    spans, still = choose_spans(line(), 0, 1_000_000, settings, mean_depth=1.0)
    assert [span.start_us for span in spans] == pytest.approx([0, 250_000, 500_000, 750_000], abs=10_000)
    assert all(a.stop_us == b.start_us for a, b in zip(spans, spans[1:])) and still == 0
    assert spans[-1].stop_us > 1_000_000  # the last stamp belongs to the last span
    turning = choose_spans(line(turn_deg=90), 0, 1_000_000, EmvsSettings(reference="baseline", view_baseline=9.0), 1.0)
    assert len(turning[0]) == 5
    fixed, _ = choose_spans(line(), 100_000, 500_000, EmvsSettings(), 1.0)
    assert len(fixed) == 1 and fixed[0].reference_us == 300_000


def test_a_camera_that_only_turns_sees_no_depth() -> None:
    settings = EmvsSettings(reference="baseline")
    with pytest.raises(InputError, match="without parallax there is no depth"):
        choose_spans(line(length=1e-4, turn_deg=90), 0, 1_000_000, settings, 1.0)
    with pytest.raises(InputError, match="the camera moves by 0 only"):
        choose_spans(line(length=0.0), 0, 1_000_000, EmvsSettings(), 1.0)


def test_depth_range_of_points() -> None:
    depth = np.linspace(1, 2, 101)
    points = np.stack([0 * depth, 0 * depth, depth], axis=1)
    outside = np.array([[50.0, 0, 1], [0, 0, -3], [0, np.inf, 1]])
    pose = np.eye(4)
    found = depth_range_from_points(np.concatenate([points, outside]), pose, 60.0, (64, 48))
    assert found == pytest.approx((0.8 * 1.05, 1.2 * 1.95))
    pose[2, 3] = -1.0
    assert depth_range_from_points(points, pose, 60.0, (64, 48)) == pytest.approx((0.8 * 2.05, 1.2 * 2.95))
    with pytest.raises(InputError, match="none of the 2 finite points"):
        depth_range_from_points(outside, np.eye(4), 60.0, (64, 48))


# --- input that cannot work ---------------------------------------------------------------------------------


def small_recording(start_us: int = 0) -> tuple[MemoryEventReader, EventCamera]:
    rng = np.random.default_rng(0)
    events = make_events(rng.integers(0, 64, 5000), rng.integers(0, 48, 5000),
                         start_us + np.sort(rng.integers(0, 1_000_000, 5000)), rng.integers(0, 2, 5000))
    camera = EventCamera(*rectify_map(Calibration(64, 48, 60.0, 60.0, 32.0, 24.0)))
    return MemoryEventReader(events, "small.h5", (64, 48)), camera


def test_poses_at_another_time_than_the_events() -> None:
    reader, camera = small_recording(start_us=5_000_000)
    with pytest.raises(InputError, match=r"poses span 0 us to 1000000 us, events 50\d+ us to .*do not overlap"):
        map_events(reader, line().trajectory, camera)


def test_poses_that_cover_a_part_of_the_events() -> None:
    reader, camera = small_recording()
    part = Trajectory(line().trajectory.t_us[20:71], line().trajectory.world_T_cam[20:71])
    result = map_events(reader, part, camera)
    inside = int(((reader.events.t_us >= 200_000) & (reader.events.t_us <= 700_000)).sum())
    assert result.views[0].counts["events"] == inside
    assert result.counts["us_before_first_pose"] > 190_000 and result.counts["us_after_last_pose"] > 290_000


def test_one_pose_is_not_enough() -> None:
    reader, camera = small_recording()
    with pytest.raises(InputError, match="1 pose"):
        map_events(reader, Trajectory(np.array([5]), np.array([[0, 0, 0, 0, 0, 0, 1.0]])), camera)


def test_a_window_without_events() -> None:
    reader, camera = small_recording()
    with pytest.raises(InputError, match="none lies in the window from 3000000 us"):
        map_events(reader, line().trajectory, camera, start_us=3_000_000, stop_us=4_000_000)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), np.nan), np.zeros((4, 2))])
def test_sparse_clouds_that_give_no_depth(points: np.ndarray) -> None:
    reader, camera = small_recording()
    with pytest.raises(InputError, match="sparse cloud"):
        map_events(reader, line().trajectory, camera, sparse_points=points)


def test_identical_points_survive_the_radius_filter_together() -> None:
    same = PointCloud(np.ones((5, 3)))
    assert len(filter_cloud(same, EmvsSettings())) == 5
    assert len(filter_cloud(same.select(slice(3)), EmvsSettings())) == 0  # two others are fewer than three
    assert len(filter_cloud(same.select(slice(3)), EmvsSettings(min_num_neighbors=0))) == 3
    assert len(filter_cloud(same.select(slice(0)), EmvsSettings())) == 0
    assert len(filter_cloud(same, EmvsSettings(radius_search=None))) == 5  # no automatic radius: all stay
