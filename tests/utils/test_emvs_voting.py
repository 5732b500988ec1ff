"""EMVS geometry and votes against rays that are intersected one by one, and against points whose depth is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from evals.benchmark_emvs import measure
from tests.tolerances import EMVS_PIXELS, EMVS_VOTES, EMVS_VOTES_NEAR_PLANES
from utils.emvs.depth_map import extract_depth
from utils.emvs.geometry import DepthPlanes, PacketRays, VirtualCamera, packet_rays, usable_packets
from utils.emvs.mapper import EventCamera, ViewVoter
from utils.emvs.settings import EmvsSettings
from utils.emvs.views import PoseTrack
from utils.emvs.voting import cast_votes
from utils.events import Events, make_events
from utils.trajectory_io import Trajectory

CPU = torch.device("cpu")
INTRINSICS = np.array([60.0, 62.0, 33.0, 22.0])
CAMERA = VirtualCamera(64, 48, 60.0, 32.0, 24.0)


def random_poses(rng: np.random.Generator, count: int, size: float = 0.15) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.08, size=(count, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(scale=size, size=(count, 3))
    return poses


def crossings(pixels: np.ndarray, rv_T_ev: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Where rays of pixels (K, S, 2) meet the plane at `depth` of the view, and whether ahead of their camera."""
    fx, fy, cx, cy = INTRINSICS
    ray = np.stack([(pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy, np.ones(pixels.shape[:2])], axis=-1)
    direction = np.einsum("kij,ksj->ksi", rv_T_ev[:, :3, :3], ray)
    center = rv_T_ev[:, None, :3, 3]
    along = (depth - center[..., 2]) / direction[..., 2]
    point = center + along[..., None] * direction
    return point[..., :2] / depth * CAMERA.focal + [CAMERA.cx, CAMERA.cy], along > 0


def voted_by_hand(pixels: np.ndarray, rv_T_ev: np.ndarray, depths: np.ndarray, nearest: bool = False) -> np.ndarray:
    dsi = np.zeros((len(depths), CAMERA.height, CAMERA.width))
    for plane, depth in enumerate(depths):
        position, ahead = crossings(pixels, rv_T_ev, depth)
        x, y = position[..., 0], position[..., 1]
        inside = ahead & (x >= 0) & (y >= 0) & (x <= CAMERA.width - 1) & (y <= CAMERA.height - 1)
        x, y = x[inside], y[inside]
        if nearest:
            np.add.at(dsi[plane], (np.rint(y).astype(int), np.rint(x).astype(int)), 1.0)
            continue
        left, top = np.minimum(x.astype(int), CAMERA.width - 2), np.minimum(y.astype(int), CAMERA.height - 2)
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            weight = np.where(dx, x - left, 1 - x + left) * np.where(dy, y - top, 1 - y + top)
            np.add.at(dsi[plane], (top + dy, left + dx), weight)
    return dsi


def rays_of(pixels: np.ndarray, rv_T_ev: np.ndarray, depths: np.ndarray, valid: np.ndarray | None = None) -> PacketRays:
    mask = torch.ones(pixels.shape[:2], dtype=torch.bool) if valid is None else torch.from_numpy(valid)
    return packet_rays(torch.from_numpy(pixels), mask, rv_T_ev, INTRINSICS, CAMERA, depths)


def votes(rays: PacketRays, vote: str = "bilinear") -> np.ndarray:
    dsi = torch.zeros(len(rays.gain), CAMERA.height, CAMERA.width)
    cast_votes(dsi, rays, vote)  # type: ignore[arg-type]
    return dsi.numpy()


@pytest.mark.parametrize("size", [32, 33])
@pytest.mark.parametrize("spacing", ["inverse", "linear"])
def test_votes_are_those_of_rays_that_meet_the_planes(spacing: str, size: int) -> None:
    rng = np.random.default_rng(3)
    pixels, poses = rng.random((7, size, 2)) * [63, 47], random_poses(rng, 7)
    depths = DepthPlanes(0.6, 4.0, 13, spacing).depths  # type: ignore[arg-type]
    expected = voted_by_hand(pixels, poses, depths)
    found = votes(rays_of(pixels, poses, depths))
    assert expected.sum() > 500
    np.testing.assert_allclose(found, expected, atol=EMVS_VOTES)


def test_nearest_votes_are_whole_and_in_the_right_pixel() -> None:
    rng = np.random.default_rng(4)
    pixels, poses = rng.random((5, 40, 2)) * [63, 47], random_poses(rng, 5)
    depths = DepthPlanes(0.6, 4.0, 9).depths
    found = votes(rays_of(pixels, poses, depths), "nearest")
    np.testing.assert_array_equal(found, np.rint(found))
    expected = voted_by_hand(pixels, poses, depths, nearest=True)
    assert np.abs(found - expected).sum() <= 4  # a position within float32 rounding of .5 may go either way


@pytest.mark.parametrize("vote", ["bilinear", "nearest"])
def test_every_ray_inside_the_view_votes_once_per_plane(vote: str) -> None:
    rng = np.random.default_rng(5)
    pixels, poses = rng.random((6, 64, 2)) * [63, 47], random_poses(rng, 6, 0.4)
    depths = DepthPlanes(0.5, 5.0, 20).depths
    inside = np.zeros(len(depths))
    for plane, depth in enumerate(depths):
        position, ahead = crossings(pixels, poses, depth)
        inside[plane] = (ahead & (position >= 0).all(-1) & (position <= [63, 47]).all(-1)).sum()
    found = votes(rays_of(pixels, poses, depths), vote).sum(axis=(1, 2), dtype=np.float64)
    assert 0.2 < inside.sum() / (6 * 64 * 20) < 0.95
    np.testing.assert_allclose(found, inside, atol=1e-2)


def test_no_votes_behind_the_camera() -> None:
    rng = np.random.default_rng(6)
    poses = random_poses(rng, 5, 0.02)
    poses[:, 2, 3] = [-0.5, 1.0, 1.5, 6.0, 6.0]  # the cameras stand before, among and behind the planes 0.5 to 5
    poses[3, :3, :3] = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()  # one looks back, the last one looks away
    pixels = rng.random((5, 200, 2)) * [63, 47]
    depths = DepthPlanes(0.5, 5.0, 25).depths
    rays = rays_of(pixels, poses, depths)
    assert not rays.all_in_front
    np.testing.assert_allclose(votes(rays), voted_by_hand(pixels, poses, depths), atol=EMVS_VOTES_NEAR_PLANES)


def test_padding_does_not_vote_even_where_its_pixel_is_no_number() -> None:
    rng = np.random.default_rng(7)
    pixels, poses = rng.random((3, 16, 2)) * [63, 47], random_poses(rng, 3)
    valid = rng.random((3, 16)) < 0.5
    depths = DepthPlanes(0.6, 4.0, 8).depths
    expected = sum(voted_by_hand(pixels[k:k + 1, valid[k]], poses[k:k + 1], depths) for k in range(3))
    pixels[~valid] = np.nan
    np.testing.assert_allclose(votes(rays_of(pixels, poses, depths, valid)), expected, atol=EMVS_VOTES)


def test_transfer_to_a_plane_leads_back_to_the_event() -> None:
    rng = np.random.default_rng(8)
    pixels, poses = rng.random((9, 30, 2)) * [63, 47], random_poses(rng, 9)
    depths = DepthPlanes(0.6, 4.0, 12).depths
    rays = rays_of(pixels, poses, depths)
    ev_T_rv = np.linalg.inv(poses)
    for plane, depth in enumerate(depths):
        x = ((rays.gain[plane][:, None] * rays.u + rays.offset_u[plane][:, None]).numpy() + 1) * (63 / 2)
        y = ((rays.gain[plane][:, None] * rays.v + rays.offset_v[plane][:, None]).numpy() + 1) * (47 / 2)
        point = np.stack([(x - CAMERA.cx) / CAMERA.focal, (y - CAMERA.cy) / CAMERA.focal, np.ones_like(x)], -1) * depth
        seen = np.einsum("kij,ksj->ksi", ev_T_rv[:, :3, :3], point) + ev_T_rv[:, None, :3, 3]
        back = seen[..., :2] / seen[..., 2:] * INTRINSICS[:2] + INTRINSICS[2:]
        np.testing.assert_allclose(back, pixels, atol=EMVS_PIXELS)


def test_a_camera_in_the_canonical_plane_is_left_out() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 2, 3] = 2.0
    np.testing.assert_array_equal(usable_packets(poses, 2.0), [True, False, True])


def test_depths_of_planes() -> None:
    inverse = DepthPlanes(0.5, 4.0, 7)
    np.testing.assert_allclose(1 / inverse.depths, 0.25 + np.arange(7) / 7 * 1.75)
    assert inverse.depths[0] == 4.0 and inverse.depths[-1] > 0.5
    np.testing.assert_allclose(DepthPlanes(1.0, 3.0, 4, "linear").depths, [1.0, 1.5, 2.0, 2.5])
    for near, far in ((0.0, 1.0), (2.0, 1.0), (1.0, 1.0), (1.0, np.inf), (np.nan, 1.0)):
        with pytest.raises(InputError, match="depth range"):
            DepthPlanes(near, far, 5)


def test_virtual_camera() -> None:
    assert VirtualCamera.of(EmvsSettings(), (64, 48), INTRINSICS) == CAMERA
    wide = VirtualCamera.of(EmvsSettings(dimX=100, dimY=80, fov_deg=90), (64, 48), INTRINSICS)
    assert (wide.width, wide.height, wide.cx, wide.cy) == (100, 80, 50.0, 40.0)
    assert wide.focal == pytest.approx(50.0)
    assert VirtualCamera.of(EmvsSettings(fov_deg=9), (64, 48), INTRINSICS).focal == 60.0


def test_a_dsi_of_another_size_or_an_unknown_vote_is_refused() -> None:
    rays = rays_of(np.zeros((1, 4, 2)), np.eye(4)[None], DepthPlanes(1, 2, 5).depths)
    with pytest.raises(InputError, match=r"expected float32 \(5, H, W\)"):
        cast_votes(torch.zeros(4, 48, 64), rays)
    with pytest.raises(InputError, match="bilinear or nearest"):
        cast_votes(torch.zeros(5, 48, 64), rays, "cubic")  # type: ignore[arg-type]


# --- from events --------------------------------------------------------------------------------------------

EVENT_CAMERA = EventCamera(np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1).astype(np.float32),
                           INTRINSICS)


def moving_track(scale: float = 1.0) -> PoseTrack:
    """A camera that moves sideways by 0.4 and turns a little, over one second."""
    share = np.linspace(0, 1, 101)
    quat = Rotation.from_rotvec(np.outer(share - 0.5, [0.05, -0.2, 0.1])).as_quat()
    position = np.stack([0.4 * (share - 0.5), 0.1 * np.sin(4 * share), 0.05 * share], axis=1)
    return PoseTrack(Trajectory(np.arange(101) * 10_000, np.concatenate([position * scale, quat], axis=1)))


def events_of_points(track: PoseTrack, points: np.ndarray, count: int = 4096) -> Events:
    """At each of `count` times every visible world point (N, 3) makes an event in its nearest pixel."""
    t_us = np.linspace(0, 1_000_000, count).astype(np.int64)
    world_T_cam = track(t_us)
    seen = np.einsum("tji,tnj->tni", world_T_cam[:, :3, :3], points[None] - world_T_cam[:, None, :3, 3])
    pixel = np.rint(seen[..., :2] / seen[..., 2:] * INTRINSICS[:2] + INTRINSICS[2:]).astype(int)
    visible = (pixel >= 0).all(-1) & (pixel < [64, 48]).all(-1)
    time, _ = np.nonzero(visible)
    return make_events(pixel[visible][:, 0], pixel[visible][:, 1], t_us[time], np.ones(len(time)))


def voter_for(track: PoseTrack, planes: DepthPlanes, **options: object) -> ViewVoter:
    return ViewVoter(track(500_000)[0], CAMERA, planes, EVENT_CAMERA, track,
                     EmvsSettings(packet_size=64, **options), CPU)  # type: ignore[arg-type]


def test_rays_of_a_point_meet_in_its_plane() -> None:
    """20 depths, each on a plane: all rays of the point meet in that very plane and pixel, and nowhere else."""
    planes = DepthPlanes(0.6, 3.0, 40)
    poses = moving_track()(np.linspace(0, 1_000_000, 50))
    for number in range(0, 40, 2):
        depth = planes.depths[number]
        point = CAMERA.points(np.array([20.0]), np.array([30.0]), np.array([depth]))[0]
        seen = np.einsum("kji,kj->ki", poses[:, :3, :3], point - poses[:, :3, 3])
        pixels = (seen[:, :2] / seen[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:])[:, None]
        dsi = votes(rays_of(pixels, poses, planes.depths))
        assert np.unravel_index(dsi.argmax(), dsi.shape) == (number, 30, 20)
        assert dsi.max() == pytest.approx(50, abs=0.01)
        assert np.sort(dsi.max(axis=(1, 2)))[-2] < 49.5


@pytest.mark.parametrize("vote", ["bilinear", "nearest"])
def test_events_of_a_point_peak_at_its_depth(vote: str) -> None:
    """The same with events, whose pixels are whole numbers: at most one plane off."""
    planes = DepthPlanes(0.6, 3.0, 40)
    track = moving_track()
    for number in range(0, 40, 2):
        depth = planes.depths[number]
        in_view = np.array([(20 - CAMERA.cx) / CAMERA.focal, (30 - CAMERA.cy) / CAMERA.focal, 1.0]) * depth
        view = track(500_000)[0]
        voter = voter_for(track, planes, vote=vote)
        voter.add(events_of_points(track, (view[:3, :3] @ in_view + view[:3, 3])[None], 1024))
        voter.finish()
        peak = np.unravel_index(int(voter.dsi.argmax()), tuple(voter.dsi.shape))
        assert abs(peak[0] - number) <= 1 and peak[1:] == (30, 20), f"depth {depth}: peak at {peak}, plane {number}"


def random_scene(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.4, 0.4, count), rng.uniform(0.8, 2.5, count)], 1)


@pytest.mark.parametrize("stride", [1, 3])
def test_pieces_of_any_size_give_the_same_bytes(stride: int) -> None:
    track, planes = moving_track(), DepthPlanes(0.6, 3.0, 12)
    events = events_of_points(track, random_scene(np.random.default_rng(0), 30), 1500)
    assert len(events) > 33_000  # more than a block
    whole = voter_for(track, planes, event_stride=stride)
    whole.add(events)
    whole.finish()
    pieces = voter_for(track, planes, event_stride=stride)
    borders = np.sort(np.random.default_rng(1).integers(0, len(events), 25))
    for first, last in zip([0, *borders], [*borders, len(events)]):
        pieces.add(events[first:last])
    pieces.finish()
    assert pieces.counts == whole.counts
    assert whole.counts["events"] == -(-len(events) // stride)  # the incomplete last packet votes too
    assert pieces.dsi.numpy().tobytes() == whole.dsi.numpy().tobytes()


@settings(max_examples=8, deadline=None)
@given(scale=st.floats(1e-3, 1e3), seed=st.integers(0, 100))
def test_scaling_poses_and_depths_changes_nothing(scale: float, seed: int) -> None:
    points = random_scene(np.random.default_rng(seed), 15)
    events = events_of_points(moving_track(), points, 300)
    results = []
    for factor in (1.0, scale):
        planes = DepthPlanes(0.6 * factor, 3.0 * factor, 15)
        voter = voter_for(moving_track(factor), planes)
        voter.add(events)
        voter.finish()
        results.append((voter.dsi.numpy(), extract_depth(voter.dsi, planes, voter.settings).mask))
    np.testing.assert_allclose(results[0][0], results[1][0], atol=5e-3)
    assert np.mean(results[0][1] != results[1][1]) < 2e-3


def test_a_packet_has_the_pose_of_its_middle_event() -> None:
    voter = voter_for(moving_track(), DepthPlanes(0.6, 3.0, 5))
    asked = []
    track = voter.track
    voter.track = lambda t_us: asked.extend(t_us) or track(t_us)  # type: ignore[assignment, func-returns-value]
    t_us = np.arange(0, 1000 * 153, 1000)
    voter.add(make_events(np.full(153, 5), np.full(153, 5), t_us, np.ones(153)))
    voter.finish()
    assert asked == [32_000, 96_000, 140_000]  # packets of 64, 64 and 25 events
    assert voter.counts["packets"] == 3


def test_the_benchmark_compares_equal_votes() -> None:
    rows = measure("64x48", 4096, 6, [1], 1)
    assert {row["implementation"] for row in rows} == {"numpy add.at", "numpy add.at by plane", "numpy add.at flat",
                                                       "numpy bincount", "utils.emvs"}
    assert 0 < rows[0]["largest_difference_votes"] < 1e-3 and all(row["mvotes_per_s"] > 0 for row in rows)


def test_an_event_outside_the_sensor_is_an_error() -> None:
    voter = voter_for(moving_track(), DepthPlanes(0.6, 3.0, 5))
    with pytest.raises(InputError, match=r"an event lies at \(64, 3\), outside the sensor of 64x48"):
        voter.add(make_events([64], [3], [5], [1]))
        voter.finish()
