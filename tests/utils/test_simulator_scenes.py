"""Rendering against ray casting written out plainly; textures, mip levels, cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from devo.errors import InputError
from tests.tolerances import SIMULATOR_DEPTH, SIMULATOR_SURFACE
from utils.calibration import Calibration
from utils.simulator.camera import camera_preset, camera_rays, parse_size
from utils.simulator.layouts import LAYOUTS, PlaneList
from utils.simulator.renderer import Renderer, pinhole_rays
from utils.simulator.scenes import Planes
from utils.simulator.textures import (
    KINDS,
    SYMBOLS,
    build_atlas,
    draw_symbol,
    log_reflectance,
    random_texture,
    texture_bank,
)
from utils.simulator.trajectory import Spline, compose, invert, quaternion_to_matrix, rotate
from utils.simulator.worlds import WORLDS, build_world, printed_board


def random_planes(name: str, seed: int) -> Planes:
    layout = PlaneList(60.0, 32, np.random.default_rng(seed))
    LAYOUTS[name](layout, (0.5, 0.4))
    return layout.planes()


def random_poses(count: int, seed: int, reach: float = 0.15) -> torch.Tensor:
    knots = torch.randn(count + 3, 6, generator=torch.Generator().manual_seed(seed)) * reach
    spline = Spline(torch.tensor([0.0, 0, 0, 0, 0, 0, 1]), knots, 1.0)
    return spline.poses(torch.arange(count, dtype=torch.float64))


def cast_rays(planes: Planes, pose: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Z-depth of `(N, 3)` rays with z = 1, one plane after the other in float64; infinite where nothing is hit."""
    rotation = quaternion_to_matrix(torch.from_numpy(pose[3:])).numpy()
    directions = rays @ rotation.T
    nearest = np.full(len(rays), np.inf)
    fields = [getattr(planes, name)[0].double().numpy() for name in ("origin", "axis_u", "axis_v", "half_extent")]
    for origin, axis_u, axis_v, half in zip(*fields):
        normal = np.cross(axis_u, axis_v)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = normal @ (origin - pose[:3]) / (directions @ normal)
            points = pose[:3] + depth[:, None] * directions - origin
            hit = (depth > 0) & (np.abs(points @ axis_u) <= half[0]) & (np.abs(points @ axis_v) <= half[1])
        nearest = np.where(hit, np.minimum(nearest, depth), nearest)
    return nearest


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_depth_agrees_with_plain_ray_casting(name: str) -> None:
    planes, poses = random_planes(name, 3), random_poses(3, 4)
    rays = pinhole_rays((60.0, 61.0, 31.0, 24.5), 48, 64)
    inverse = Renderer(planes, torch.zeros(1, 1, 0, 0), rays).inverse_depth(poses).double().numpy()
    x, y = np.meshgrid((np.arange(64) - 31.0) / 60.0, (np.arange(48) - 24.5) / 61.0)
    directions = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    for k in range(3):
        expected = 1.0 / cast_rays(planes, poses[k].double().numpy(), directions)
        wrong = np.abs(inverse[k].ravel() - expected) > SIMULATOR_DEPTH * expected.max()
        assert wrong.mean() < 0.002, "only pixels cut by the edge of a plane piece may differ by rounding"
        assert (expected > 0).mean() > 0.9


@pytest.mark.parametrize("name", list(WORLDS))
@pytest.mark.parametrize("distorted", [False, True])
def test_back_projected_depth_lands_on_the_scene(name: str, distorted: bool) -> None:
    camera = camera_preset(60, 44, distorted)
    planes = build_world(name, camera.fx, 2, background=True).planes
    poses, rays = random_poses(4, 9, 0.08), camera_rays(camera)
    inverse = Renderer(planes, torch.zeros(1, 1, 0, 0), rays).inverse_depth(poses)
    x, y = torch.broadcast_tensors(rays.x, rays.y)
    directions = torch.stack([x, y, torch.ones_like(x)], -1).view(1, -1, 3)
    hit = inverse.view(4, -1) > 0
    points = directions / inverse.view(4, -1, 1)
    world = torch.einsum("mij,mnj->mni", quaternion_to_matrix(poses[:, 3:]), points) + poses[:, None, :3]
    distance = planes.distance_to_surface(world[hit][None])[0]
    assert hit.float().mean() > 0.9
    assert (distance / points[hit].norm(dim=-1)).max() < SIMULATOR_SURFACE


def test_distorted_rays_project_back_onto_their_pixels() -> None:
    camera = camera_preset(80, 60, distorted=True)
    rays = camera_rays(camera)
    points = np.stack([rays.x.numpy(), rays.y.numpy(), np.ones((60, 80))], -1).reshape(-1, 1, 3).astype(np.float64)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.camera_matrix, np.array(camera.coefficients))
    rows, columns = np.mgrid[0:60, 0:80]
    np.testing.assert_allclose(pixels.reshape(60, 80, 2), np.stack([columns, rows], -1), atol=1e-3)
    straight = camera_rays(camera_preset(80, 60))
    assert rays.x.abs().max() > 1.05 * straight.x.abs().max(), "a barrel lens sees further outwards"


def test_a_wall_at_one_texel_per_pixel_shows_its_texture_exactly() -> None:
    tile = torch.rand(16, 16)
    wall = Planes(origin=torch.tensor([[[0.0, 0, 2]]]), axis_u=torch.tensor([[[1.0, 0, 0]]]),
                  axis_v=torch.tensor([[[0.0, 1, 0]]]), half_extent=torch.tensor([[[4.0, 4.0]]]),
                  texture_scale=torch.tensor([[0.5]]), texture_offset=torch.tensor([[[0.5, 0.5]]]))
    # 2 scene units show one tile of 16 texels; at depth 2 a focal length of 16 maps them to 16 pixels
    rays = pinhole_rays((16.0, 16.0, 7.5, 7.5), 16, 16)
    pose = torch.tensor([[0.0, 0, 0, 0, 0, 0, 1]])
    renderer = Renderer(wall, build_atlas(tile[None]), rays)
    torch.testing.assert_close(renderer.render(pose)[0][0], tile, atol=1e-4, rtol=0)
    moved = torch.tensor([[16 * 2 / 16.0, 0, 0, 0, 0, 0, 1]])  # one tile to the right: the mirror image
    torch.testing.assert_close(renderer.render(moved)[0][0], tile.flip(1), atol=1e-4, rtol=0)


def test_uncovered_pixels_are_empty() -> None:
    planes = random_planes("board", 0)
    only_board = Planes(*(getattr(planes, name)[:, :1] for name in
                          ("origin", "axis_u", "axis_v", "half_extent", "texture_scale", "texture_offset")))
    rays = pinhole_rays((30.0, 30.0, 31.5, 23.5), 48, 64)
    light, inverse = Renderer(only_board, build_atlas(torch.full((1, 32, 32), 1.5)), rays, empty=-2.0).render(
        torch.tensor([[0.0, 0, 0, 0, 0, 0, 1]]))
    assert 0 < (inverse == 0).float().mean() < 1
    assert (light[inverse == 0] == -2.0).all()
    torch.testing.assert_close(light[inverse > 0], torch.full_like(light[inverse > 0], 1.5))


def test_mip_levels_average_reflectance_and_keep_plain_tiles() -> None:
    tiles = torch.stack([torch.full((16, 16), -1.3), torch.rand(16, 16)])
    atlas = build_atlas(tiles)[0, 0]
    plain = atlas[: 16 + 2]
    assert set(plain[plain != 0].tolist()) == {float(torch.tensor(-1.3))}
    second = atlas[18 + 1 : 18 + 9, 18 + 1 : 18 + 9]  # level 1 of the second tile, inside its border
    expected = torch.nn.functional.avg_pool2d(tiles[1][None, None].exp(), 2)[0, 0].log()
    torch.testing.assert_close(second, expected)


@pytest.mark.parametrize("kind", list(KINDS))
def test_textures_are_reproducible_and_have_contrast(kind: str) -> None:
    image = random_texture(96, np.random.default_rng(5), kind)
    again = random_texture(96, np.random.default_rng(5), kind)
    assert image.tobytes() == again.tobytes()
    assert image.dtype == np.float32
    assert image.min() >= 0
    assert image.max() <= 1
    assert log_reflectance(image).std() > 0.15


def test_texture_bank_is_seeded() -> None:
    assert torch.equal(texture_bank(3, 32, 1), texture_bank.__wrapped__(3, 32, 1))
    assert not torch.equal(texture_bank(3, 32, 1), texture_bank(3, 32, 2))


@pytest.mark.parametrize("name", SYMBOLS)
def test_symbols_are_drawn_around_their_centre(name: str) -> None:
    canvas = np.full((80, 80), 255, np.uint8)
    draw_symbol(canvas, name, np.array([40.0, 42.0]), 20.0, 0.0)
    rows, columns = np.nonzero(canvas < 128)
    assert 150 < len(rows) < 1500
    assert np.hypot(rows - 42, columns - 40).max() < 30
    assert abs(columns.mean() - 40) < 3


def test_unknown_symbol_is_refused() -> None:
    with pytest.raises(ValueError, match="heart"):
        draw_symbol(np.zeros((9, 9), np.uint8), "heart", np.zeros(2), 3.0, 0.5)


def test_printed_board_has_dark_shapes_on_bright_paper() -> None:
    board = printed_board(512, 0.75, np.random.default_rng(0))
    dark = (board < 0.3).mean()
    assert 0.1 < dark < 0.35
    assert (board > 0.7).mean() > 0.6


def test_pose_algebra() -> None:
    poses = random_poses(5, 0, 0.8).double()
    poses = torch.cat([poses[:, :3], poses[:, 3:] / poses[:, 3:].norm(dim=-1, keepdim=True)], -1)
    identity = compose(poses, invert(poses))
    torch.testing.assert_close(identity[:, :3], torch.zeros(5, 3, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(identity[:, 3:6], torch.zeros(5, 3, dtype=torch.float64), atol=1e-12, rtol=0)
    vector = torch.randn(5, 3, dtype=torch.float64)
    torch.testing.assert_close(rotate(poses[:, 3:], vector).norm(dim=-1), vector.norm(dim=-1))


def test_distance_to_surface_of_a_finite_piece() -> None:
    piece = Planes(origin=torch.zeros(1, 1, 3), axis_u=torch.tensor([[[1.0, 0, 0]]]),
                   axis_v=torch.tensor([[[0.0, 1, 0]]]), half_extent=torch.tensor([[[1.0, 2.0]]]),
                   texture_scale=torch.ones(1, 1), texture_offset=torch.zeros(1, 1, 2))
    points = torch.tensor([[[0.5, 1.0, -3.0], [4.0, 0.0, 0.0], [1.0, 5.0, 4.0]]])
    torch.testing.assert_close(piece.distance_to_surface(points), torch.tensor([[3.0, 3.0, 5.0]]))


@pytest.mark.parametrize("text", ["240", "0x180", "240x", "-4x5", "axb", "99999x4"])
def test_unusable_image_sizes_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="image size"):
        parse_size(text)


def test_fisheye_cameras_are_refused() -> None:
    with pytest.raises(InputError, match="fisheye"):
        camera_rays(Calibration(64, 48, 40.0, 40.0, 31.5, 23.5, "fisheye", (0.1, 0.0, 0.0, 0.0)))
