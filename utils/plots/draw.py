"""The pieces of a picture: perspective and flat views, camera path, colour bar, texts; in one dark style.

Everything here takes figures and axes of Matplotlib and uses none of its global state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from utils.plots.coloring import NO_COLOR, OWN_COLORS
from utils.plots.scene import FRUSTUM_EDGES, FloatArray, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BACKGROUND, PANEL, GRID, TEXT, FAINT = "#0e1116", "#151a21", "#2a313c", "#e6e9ee", "#97a1b0"
PATH, START, END, PLAIN = "#ff6f61", "#7ee787", "#ffffff", "#8fb4d9"
AXIS_COLORS = ("#ff7b72", "#7ee787", "#79c0ff")
Place = tuple[float, float, float, float]
_START_MARKER: dict[str, Any] = {"marker": "o", "color": START, "markersize": 11, "markerfacecolor": "none",
                                 "markeredgewidth": 2, "linestyle": ""}
_END_MARKER: dict[str, Any] = {"marker": "s", "color": END, "markersize": 6, "markeredgecolor": BACKGROUND,
                               "linestyle": ""}
LOOK = (0.44, 0.36, 0.88)
"""Viewing direction of the perspective in world axes: from the left, above and behind."""


def new_figure(width: float, height: float, dpi: int = 120) -> Figure:
    """An empty dark figure of `width` x `height` inches that knows how to be saved."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    return figure


def color_map() -> Any:
    """Viridis without its darkest fifth, which the dark background would swallow."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["viridis"](np.linspace(0.2, 1.0, 256)))


def point_size_of(scene: Scene) -> float:
    """Marker area in square points: small where many points are drawn."""
    return float(np.clip(40_000 / max(len(scene.cloud), 1), 1.2, 9.0))


def scatter_points(axes: Axes, scene: Scene, positions: npt.NDArray[np.floating], order: npt.NDArray[np.intp],
                   size: float | FloatArray, **style: Any) -> None:
    """Draw the points of a scene at image positions `(N, 2)` (or `(N, 3)` in 3-D axes) in the given order."""
    coloring = scene.coloring
    if coloring.name == OWN_COLORS and scene.cloud.colors is not None:
        style["c"] = scene.cloud.colors[order] / 255.0
    elif coloring.name == NO_COLOR:
        style["color"] = PLAIN
    else:
        low, high = coloring.limits
        style |= {"c": coloring.values[order], "cmap": color_map(), "vmin": low, "vmax": high, "plotnonfinite": True}
    style["s"] = size if np.isscalar(size) else np.asarray(size)[order]
    axes.scatter(*positions[order].T, linewidths=0, **style)


# --- perspective --------------------------------------------------------------------------------------------


def view_axes(look: npt.ArrayLike = LOOK) -> FloatArray:
    """Rows right, up and forward of the virtual camera in world axes; the world's y points down, as in an image."""
    forward = np.asarray(look, dtype=np.float64) / np.linalg.norm(look)
    down = (0.0, 1.0, 0.0) if abs(forward[1]) < 0.999 else (0.0, 0.0, -np.sign(forward[1]))
    right = np.cross(down, forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def project(world: FloatArray, scene: Scene, look: npt.ArrayLike = LOOK) -> tuple[FloatArray, FloatArray]:
    """Image coordinates (right, up) and relative distances (about 1) of world points in the perspective view."""
    away = 1.7 * scene.diagonal
    seen = (world - (scene.low + scene.high) / 2) @ view_axes(look).T + np.array([0.0, 0.0, away])
    distance = np.maximum(seen[..., 2], 1e-3 * away)
    return seen[..., :2] / distance[..., None], distance / away


def _stage(scene: Scene, look: npt.ArrayLike) -> FloatArray:
    """`(K, 2, 3)` world line segments: a grid on the floor and on the two walls behind the scene."""
    from matplotlib.ticker import MaxNLocator

    ticks = MaxNLocator(7, steps=(1, 2, 5, 10)).tick_values(0, float((scene.high - scene.low).max()))
    step = ticks[1] - ticks[0]
    back = np.where(np.asarray(look) >= 0, scene.high, scene.low)  # the corner that the virtual camera looks at
    segments = []
    for along in range(3):  # lines that run along this axis, on the two faces that contain it
        for across in {0, 1, 2} - {along}:
            stops = np.arange(np.ceil(scene.low[across] / step), np.floor(scene.high[across] / step) + 1) * step
            for stop in (scene.low[across], *stops, scene.high[across]):
                start, end = back.copy(), back.copy()
                start[across] = end[across] = stop
                start[along], end[along] = scene.low[along], scene.high[along]
                segments.append((start, end))
    return np.array(segments)


def draw_perspective(figure: Figure, place: Place, scene: Scene, look: npt.ArrayLike = LOOK,
                     size: float | None = None, faint_points: bool = False) -> None:
    """The scene in perspective on a stage of grid lines, with the directions of the world axes in the corner.

    Args:
        figure: where.
        place: left, bottom, width, height as shares of the figure.
        scene: what.
        look: viewing direction in world axes.
        size: marker area in square points; None chooses one by the number of points.
        faint_points: let the path stand out.
    """
    from matplotlib.collections import LineCollection

    axes = figure.add_axes(place)
    axes.set_axis_off()
    stage = project(_stage(scene, look), scene, look)[0]
    axes.add_collection(LineCollection(list(stage), colors=GRID, linewidths=0.6, alpha=0.8))
    image, distance = project(scene.points, scene, look)
    order = np.argsort(-distance, kind="stable")
    area = 1.3 * point_size_of(scene) if size is None else size
    scatter_points(axes, scene, image, order, area / distance**2, alpha=0.4 if faint_points else 0.9)
    draw_path(axes, scene, lambda world: project(world, scene, look)[0])
    set_equal_limits(figure, axes, stage.min(axis=(0, 1)), stage.max(axis=(0, 1)))
    _draw_triad(figure, place, look)


def _draw_triad(figure: Figure, place: Place, look: npt.ArrayLike) -> None:
    """The directions of the world axes as the perspective view shows them."""
    width, height = figure.get_size_inches()
    axes = figure.add_axes((place[0] + 0.008, place[1] + 0.015, 1.08 / width, 1.08 / height))
    axes.set_axis_off()
    axes.set_xlim(-1.4, 1.4)
    axes.set_ylim(-1.4, 1.4)
    for name, tip in zip("xyz", view_axes(look)[:2].T):
        axes.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": FAINT, "shrinkA": 0, "shrinkB": 0})
        x, y = tip * (1 + 0.25 / max(float(np.linalg.norm(tip)), 0.3))
        axes.text(x, y, name, color=FAINT, ha="center", va="center", fontsize=10)


# --- flat views ---------------------------------------------------------------------------------------------


def dark_axes(figure: Figure, place: Place, title: str, x_label: str, y_label: str) -> Axes:
    """Axes with a grid in the style of the pictures."""
    axes = figure.add_axes(place)
    axes.set_facecolor(PANEL)
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=9, length=0)
    for spine in axes.spines.values():
        spine.set_color(GRID)
    axes.set_xlabel(x_label, color=FAINT, fontsize=10)
    axes.set_ylabel(y_label, color=FAINT, fontsize=10)
    axes.set_title(title, color=TEXT, fontsize=12, loc="left")
    return axes


def draw_plane(figure: Figure, place: Place, scene: Scene, shown: tuple[int, int], title: str,
               size: float | None = None, path_alpha: float = 1.0) -> None:
    """One orthographic view with equal scales; the axis y, which points down, is drawn downwards.

    Args:
        figure, place, scene, size: as for `draw_perspective`.
        shown: numbers of the world axes that go right and up.
        title: above the axes.
        path_alpha: opacity of the camera path.
    """
    labels = [f"{'xyz'[axis]} ({scene.unit})" for axis in shown]
    axes = dark_axes(figure, place, title, *labels)
    away = {0, 1, 2} - set(shown)
    order = np.argsort(scene.points[:, away.pop()], kind="stable")[::-1]
    area = point_size_of(scene) if size is None else size
    scatter_points(axes, scene, scene.points[:, list(shown)], order, area, alpha=0.8,
                   rasterized=len(scene.cloud) > 20_000)
    draw_path(axes, scene, lambda world: world[..., list(shown)], path_alpha)
    set_equal_limits(figure, axes, scene.low[list(shown)], scene.high[list(shown)])
    if shown[1] == 1:
        axes.invert_yaxis()


def set_equal_limits(figure: Figure, axes: Axes, low: FloatArray, high: FloatArray) -> None:
    """Limits around a box with one scale for both directions, filling the axes' rectangle."""
    width, height = axes.get_position().size * figure.get_size_inches()
    center, extent = (low + high) / 2, (high - low) / 2
    scale = max(extent[0] / width, extent[1] / height)
    axes.set_xlim(center[0] - scale * width, center[0] + scale * width)
    axes.set_ylim(center[1] - scale * height, center[1] + scale * height)


def draw_path(axes: Axes, scene: Scene, to_image: Callable[[FloatArray], FloatArray], alpha: float = 1.0) -> None:
    """Trajectory, camera pyramids, start and end, through a projection from world to image coordinates."""
    if not len(scene.poses):
        return
    from matplotlib.collections import LineCollection

    line = to_image(scene.poses[:, :3])
    segments = to_image(scene.frusta()[:, list(FRUSTUM_EDGES)]).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(segments), colors=PATH, linewidths=0.9, alpha=0.65 * alpha, zorder=3))
    axes.plot(line[:, 0], line[:, 1], color=PATH, linewidth=1.8, alpha=alpha, solid_capstyle="round", zorder=4)
    axes.plot(*line[0], **_START_MARKER, zorder=5)
    axes.plot(*line[-1], **_END_MARKER, zorder=6)


# --- margins ------------------------------------------------------------------------------------------------


def draw_color_bar(figure: Figure, place: Place, scene: Scene) -> None:
    """A horizontal bar that says what the colours mean; nothing if they stand for no number."""
    if not scene.coloring.has_scale or not len(scene.cloud):
        return
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = figure.add_axes(place)
    mapping = ScalarMappable(Normalize(*scene.coloring.limits), color_map())
    bar = figure.colorbar(mapping, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)  # type: ignore[operator]
    axes.tick_params(colors=FAINT, labelsize=9, length=0)
    axes.set_title(scene.coloring.label, color=FAINT, fontsize=9, loc="left", pad=5)


def write_texts(figure: Figure, scene: Scene, title: str, *, left: float = 0.03, right: float = 0.97) -> None:
    """Headline, numbers, remarks and the legend of the path."""
    headline = title or "Trajectory and point cloud"
    width, height = figure.get_size_inches()
    figure.text(left, 1 - 0.495 / height, headline, color=TEXT, fontsize=20, va="center", weight="bold",
                parse_math=False)
    figure.text(left, 1 - 0.83 / height, scene.summary(), color=FAINT, fontsize=12, va="center")
    figure.text(right, 0.22 / height, "  |  ".join(scene.describe()), color=FAINT, fontsize=9, ha="right", va="center")
    if len(scene.poses):
        from matplotlib.lines import Line2D

        handles = [Line2D([], [], color=PATH, linewidth=1.8, label="camera path"),
                   Line2D([], [], **_START_MARKER, label="start"),
                   Line2D([], [], **_END_MARKER, label="end")]
        figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(right, 1 - 0.315 / height), ncols=3,
                      frameon=False, labelcolor=FAINT, fontsize=10)
