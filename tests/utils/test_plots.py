"""Pictures: the right thing is shown, nothing is mirrored, far points do not matter, files are complete or absent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.plots.coloring import color_cloud, colorings_of
from utils.plots.draw import draw_plane, new_figure, project, view_axes
from utils.plots.pages import (
    PLANES,
    look_direction,
    overview_page,
    perspective_page,
    picture_path,
    plane_page,
    save_figure,
    trajectory_page,
)
from utils.plots.scene import Scene, camera_pyramid, place_pyramids


def _cloud(count: int = 400) -> PointCloud:
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-1, 1, (count, 2)), rng.normal(3, 0.1, count)]
    return PointCloud(points, rng.integers(0, 255, (count, 3)).astype(np.uint8),
                      {"t_us": np.arange(count) * 1000 + 5_000_000, "observations": np.arange(count) % 7,
                       "depth": points[:, 2]})


POSES = np.c_[np.linspace(0, 1, 9), np.zeros((9, 5)), np.ones(9)]


# --- colours --------------------------------------------------------------------------------------------------


def test_values_of_the_colourings() -> None:
    cloud = _cloud()
    points = cloud.points.astype(np.float64)
    np.testing.assert_array_equal(color_cloud(cloud, "depth").values, points[:, 2])
    np.testing.assert_array_equal(color_cloud(cloud, "height").values, -points[:, 1])
    np.testing.assert_allclose(color_cloud(cloud, "time").values, np.arange(400) * 1e-3)
    np.testing.assert_allclose(color_cloud(cloud, "intensity").values, cloud.colors.mean(axis=1))
    np.testing.assert_array_equal(color_cloud(cloud, "observations").values, cloud.scalars["observations"])
    assert color_cloud(cloud, "observations").label == "observing frames"
    assert color_cloud(cloud, "depth", "m").label.endswith("(m)")
    assert not color_cloud(cloud, "rgb").has_scale and not color_cloud(cloud, "none").has_scale


def test_limits_of_the_colours_ignore_outliers_and_nan() -> None:
    values = np.r_[np.linspace(0, 1, 1001), 1e9, np.nan]
    found = color_cloud(PointCloud(np.zeros((1003, 3)), scalars={"weight": values}), "weight")
    assert found.limits[0] == pytest.approx(0.02, abs=2e-3) and found.limits[1] == pytest.approx(0.98, abs=2e-3)
    low, high = color_cloud(PointCloud(np.ones((3, 3))), "x").limits
    assert (low, high) == (0.5, 1.5)


def test_only_what_the_cloud_has_is_offered() -> None:
    bare = PointCloud(np.zeros((2, 3)))
    assert set(colorings_of(bare)) == {"depth", "height", "x", "y", "z", "none"}
    for name in ("time", "rgb", "intensity", "observations"):
        with pytest.raises(InputError, match="depth, height"):
            color_cloud(bare, name)


# --- scene ----------------------------------------------------------------------------------------------------


def test_far_points_are_counted_and_shown_only_on_request() -> None:
    cloud = PointCloud(np.vstack([_cloud().points, [[1e6, 0, 0], [np.nan, 0, 0]]]))
    scene = Scene.build(cloud, POSES)
    assert scene.total == 402 and scene.nonfinite == 1 and scene.outside >= 1
    assert len(scene.cloud) == 401 - scene.outside and scene.left_out == 0
    everything = Scene.build(cloud, POSES, show_outside=True)
    assert len(everything.cloud) == 401 and everything.high[0] < 100
    assert any("far off" in note for note in everything.describe())
    assert Scene.build(cloud, POSES, robust=False).high[0] > 1e6
    thin = Scene.build(cloud, POSES, most_points=100)
    assert len(thin.cloud) == 100 and "100 points drawn" in thin.describe()
    assert "path length 1 units" in scene.summary() and "arbitrary scale" in scene.describe()[0]
    assert "arbitrary" not in " ".join(Scene.build(cloud, POSES, unit="m").describe())


def test_camera_pyramids_have_the_shape_of_the_camera() -> None:
    pyramid = camera_pyramid([100, 200, 50, 40], 160, 120)
    np.testing.assert_allclose(pyramid[1:], [[-0.5, -0.2, 1], [1.1, -0.2, 1], [1.1, 0.4, 1], [-0.5, 0.4, 1]])
    np.testing.assert_allclose(place_pyramids(POSES[-1:], pyramid)[0], pyramid + [1, 0, 0])
    scene = Scene.build(_cloud(), POSES, pyramid=pyramid, frustum_scale=0.5)
    np.testing.assert_allclose(scene.frusta(1)[0], 0.5 * pyramid)
    for numbers in ([0, 1, 0, 0], [np.nan, 1, 0, 0], [-5, 1, 0, 0]):
        with pytest.raises(InputError, match="no camera"):
            camera_pyramid(numbers, 10, 10)
    with pytest.raises(InputError, match="positive length"):
        Scene.build(_cloud(), POSES, frustum_scale=-1)


@pytest.mark.parametrize(("elevation", "azimuth", "expected"), [
    (0, -90, [0, 0, 1]), (0, 0, [-1, 0, 0]), (90, 0, [0, 1, 0]), (30, -90, [0, 0.5, np.sqrt(0.75)])])
def test_where_the_observer_stands(elevation: float, azimuth: float, expected: list[float]) -> None:
    np.testing.assert_allclose(look_direction(elevation, azimuth), expected, atol=1e-12)


@pytest.mark.parametrize("look", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-0.3, 0.2, -0.5)])
def test_no_view_is_a_mirror_image(look: tuple[float, float, float]) -> None:
    right, up, forward = view_axes(look)
    np.testing.assert_allclose(np.cross(right, -up), forward, atol=1e-12)
    scene = Scene.build(_cloud(), POSES)
    center = (scene.low + scene.high) / 2
    image, _ = project(np.stack([center, center + 0.1 * right, center + 0.1 * up]), scene, look)
    assert image[1, 0] > image[0, 0] and image[2, 1] > image[0, 1]


def test_planes_show_the_axes_they_name_with_equal_scales() -> None:
    scene = Scene.build(_cloud(), POSES)
    for name, (right, up) in PLANES.items():
        figure = new_figure(8, 5)
        draw_plane(figure, (0.1, 0.1, 0.8, 0.8), scene, (right, up), "")
        axes = figure.axes[0]
        drawn = axes.collections[0].get_offsets()
        assert sorted(map(tuple, np.round(drawn, 6))) == sorted(map(tuple, np.round(scene.points[:, [right, up]], 6)))
        assert axes.get_xlabel().startswith("xyz"[right]) and axes.get_ylabel().startswith("xyz"[up])
        width, height = axes.get_position().size * figure.get_size_inches()
        assert np.ptp(axes.get_xlim()) / width == pytest.approx(np.ptp(axes.get_ylim()) / height)
        assert axes.yaxis_inverted() == (up == 1), name


# --- files ----------------------------------------------------------------------------------------------------


def _ink(path: Path) -> int:
    from PIL import Image

    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"), dtype=np.int64)
    return int((pixels.max(axis=2) - pixels.min(axis=2) > 60).sum())


def test_pages_show_the_points(tmp_path: Path) -> None:
    full, empty = Scene.build(_cloud(), POSES), Scene.build(PointCloud(np.empty((0, 3))), POSES)
    pages = {"overview": overview_page, "plane": lambda s: plane_page(s, "xz"), "view": perspective_page,
             "path": lambda s: trajectory_page(s, np.arange(9) * 1e5)}
    for name, page in pages.items():
        save_figure(page(full), tmp_path / f"{name}.png")
        save_figure(page(empty), tmp_path / f"{name}_empty.png")
        assert _ink(tmp_path / f"{name}.png") > _ink(tmp_path / f"{name}_empty.png") + 1000, name


def test_vector_files_are_readable_and_repeatable(tmp_path: Path) -> None:
    import xml.etree.ElementTree as Tree

    scene = Scene.build(_cloud(), POSES)
    for name in "ab":
        save_figure(plane_page(scene, "xy", title="<board> & $1"), tmp_path / f"{name}.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert Tree.parse(tmp_path / "a.svg").getroot().tag.endswith("svg")
    save_figure(plane_page(scene, "xy"), tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")


def test_names_of_pictures(tmp_path: Path) -> None:
    assert picture_path(None, tmp_path / "cloud_xy").name == "cloud_xy.png"
    assert picture_path(None, tmp_path / "v1.5_xy", "svg").name == "v1.5_xy.svg"
    assert picture_path("a.PDF", tmp_path).name == "a.PDF"
    for asked, wanted in (("a.jpg", "auto"), ("a", "auto"), ("a.png", "svg")):
        with pytest.raises(InputError, match="pictures end in"):
            picture_path(asked, tmp_path, wanted)
    with pytest.raises(InputError, match="plane must be"):
        plane_page(Scene.build(_cloud(), POSES), "yx")
    with pytest.raises(InputError, match="finite"):
        look_direction(float("nan"), 0)
