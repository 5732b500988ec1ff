"""A window of Open3D with cloud, camera path and camera pyramids; needs a display."""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np

from devo.errors import DevoError
from utils.clouds.cloud import PointCloud
from utils.clouds.open3d_import import import_open3d
from utils.plots.coloring import NO_COLOR, OWN_COLORS
from utils.plots.draw import BACKGROUND, LOOK, PATH, PLAIN, START, color_map
from utils.plots.scene import FRUSTUM_EDGES, Scene

REMEDY = "write a page with --html FILE instead"


def has_display() -> bool:
    """Whether a window could be opened here."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def geometries(scene: Scene) -> list[Any]:
    """The scene as Open3D geometries: points, camera path, camera pyramids, first camera's axes.

    Raises:
        InputError: Open3D cannot be imported.
    """
    open3d = import_open3d(REMEDY)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scene.points))
    cloud.colors = open3d.utility.Vector3dVector(point_colors(scene))
    shapes = [cloud]
    if len(scene.poses):
        steps = np.stack([np.arange(len(scene.poses) - 1), np.arange(1, len(scene.poses))], axis=1)
        shapes.append(_lines(open3d, scene.poses[:, :3], steps, PATH))
        corners = scene.frusta()
        edges = (np.arange(len(corners))[:, None, None] * 5 + np.array(FRUSTUM_EDGES)).reshape(-1, 2)
        shapes.append(_lines(open3d, corners.reshape(-1, 3), edges, PATH))
        shapes.append(_lines(open3d, scene.frusta(1).reshape(-1, 3), np.array(FRUSTUM_EDGES), START))
    return shapes


def point_colors(scene: Scene) -> np.ndarray:
    """`(N, 3)` float64 red, green, blue in 0..1 of the drawn points."""
    coloring = scene.coloring
    if coloring.name == OWN_COLORS and scene.cloud.colors is not None:
        return scene.cloud.colors / 255.0
    if coloring.name == NO_COLOR:
        return np.tile(_rgb(PLAIN), (len(scene.cloud), 1))
    low, high = coloring.limits
    return np.asarray(color_map()(np.clip((coloring.values - low) / (high - low), 0, 1)))[:, :3].astype(np.float64)


def show(scene: Scene, title: str) -> None:
    """Open a window and return when it is closed.

    Raises:
        InputError: Open3D cannot be imported.
        DevoError: no window can be opened.
    """
    shapes = geometries(scene)
    open3d = import_open3d(REMEDY)
    window = open3d.visualization.Visualizer()
    if not window.create_window(window_name=title):
        raise DevoError("no window could be opened (is there a display with OpenGL?); write a page with --html FILE")
    for shape in shapes:
        window.add_geometry(shape)
    window.get_render_option().background_color = _rgb(BACKGROUND)
    window.get_render_option().point_size = 3.0
    control = window.get_view_control()
    control.set_lookat((scene.low + scene.high) / 2)
    control.set_front([-share for share in LOOK])
    control.set_up([0.0, -1.0, 0.0])  # the world's y points down, as in an image
    window.run()
    window.destroy_window()


def show_cloud(cloud: PointCloud, title: str) -> None:
    """Open a window with the points alone, in their own colours if they have any; see `show`."""
    color_by = OWN_COLORS if cloud.colors is not None else "depth"
    show(Scene.build(cloud, np.empty((0, 7)), color_by, show_outside=True, most_points=max(len(cloud), 1)), title)


def _lines(open3d: Any, points: np.ndarray, pairs: np.ndarray, color: str) -> Any:
    shape = open3d.geometry.LineSet(open3d.utility.Vector3dVector(points), open3d.utility.Vector2iVector(pairs))
    shape.paint_uniform_color(_rgb(color))
    return shape


def _rgb(color: str) -> list[float]:
    return [int(color[i:i + 2], 16) / 255 for i in (1, 3, 5)]
