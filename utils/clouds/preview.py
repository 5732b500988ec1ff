"""One picture of a cloud and the camera's path: perspective, top and side view."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BACKGROUND, _PANEL, _GRID, _TEXT, _FAINT = "#0e1116", "#151a21", "#2a313c", "#e6e9ee", "#97a1b0"
_PATH, _START, _END = "#ff6f61", "#7ee787", "#ffffff"
ARBITRARY = "arbitrary units"
"""What one unit of a monocular reconstruction is."""

_START_MARKER: dict[str, Any] = {"marker": "o", "color": _START, "markersize": 11, "markerfacecolor": "none",
                                 "markeredgewidth": 2, "linestyle": ""}
_END_MARKER: dict[str, Any] = {"marker": "s", "color": _END, "markersize": 6, "markeredgecolor": _BACKGROUND,
                               "linestyle": ""}
_MOST_POINTS = 80_000
_COLORINGS = {
    "depth": (2, 1.0, "depth: z of the first camera"),
    "height": (1, -1.0, "height: -y of the first camera"),
}
_LOOK = (0.44, 0.36, 0.88)  # viewing direction of the perspective: from the left, above and behind


def save_preview(
    path: str | os.PathLike[str],
    cloud: PointCloud,
    world_T_cam: np.ndarray,
    *,
    title: str = "",
    color_by: str = "depth",
    unit: str = ARBITRARY,
) -> None:
    """Draw the cloud and the trajectory into a PNG: perspective, top and side view with equal axes.

    The axes are those of the world frame (first camera: x right, y down, z forward); "top" and "side" are meant
    relative to that camera, because gravity is unknown. The limits follow percentiles, so a few far outliers do not
    shrink the scene; how many points lie outside is written below the picture, as is the arbitrary scale.

    Args:
        path: PNG file, written completely or not at all.
        cloud: may be empty; points with non-finite coordinates are left out and counted.
        world_T_cam: `(T, 7)` camera-to-world poses `tx ty tz qx qy qz qw` in the unit of the cloud; T may be 0.
            Poses that are not finite are left out.
        title: headline.
        color_by: `depth` (world z) or `height` (minus world y).
        unit: what one unit of length is, for the labels; say `m` only of aligned or metric clouds.

    Raises:
        InputError: poses of another shape, or an unknown colouring.
        OutputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if color_by not in _COLORINGS:
        raise InputError(f"color_by must be one of {', '.join(_COLORINGS)}, found {color_by!r}")
    scene = _Scene.build(cloud, world_T_cam, color_by)
    figure = Figure(figsize=(16, 9), dpi=120, facecolor=_BACKGROUND)
    FigureCanvasAgg(figure)
    _draw_perspective(figure, scene)
    _draw_plane(figure, (0.645, 0.555, 0.325, 0.335), scene, (0, 2), "top view", unit)
    _draw_plane(figure, (0.645, 0.105, 0.325, 0.335), scene, (2, 1), "side view", unit)
    _draw_color_bar(figure, scene, f"{_COLORINGS[color_by][2]} ({unit})")
    _write_texts(figure, scene, title, unit)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", facecolor=_BACKGROUND)


@dataclass(frozen=True)
class _Scene:
    """What is drawn, in world coordinates: `points (N, 3)`, `values (N,)` for the colour, `poses (T, 7)`."""

    points: np.ndarray
    values: np.ndarray
    value_limits: tuple[float, float]
    poses: np.ndarray
    low: np.ndarray
    high: np.ndarray
    total: int
    outside: int
    nonfinite: int

    @staticmethod
    def build(cloud: PointCloud, world_T_cam: np.ndarray, color_by: str) -> _Scene:
        poses = np.asarray(world_T_cam, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] != 7:
            raise InputError(f"world_T_cam must have shape (T, 7), found {poses.shape}")
        poses = poses[np.isfinite(poses).all(axis=1)]
        finite = cloud.points[cloud.finite_mask()].astype(np.float64)
        low, high = _robust_box(finite, poses[:, :3])
        inside = finite[((finite >= low) & (finite <= high)).all(axis=1)]
        drawn = inside[np.linspace(0, len(inside) - 1, min(len(inside), _MOST_POINTS)).astype(int)]
        axis, sign, _ = _COLORINGS[color_by]
        values = sign * drawn[:, axis]
        limits = np.percentile(values, (2, 98)) if len(values) else np.array([0.0, 1.0])
        if not limits[1] > limits[0]:
            limits = limits + np.array([-0.5, 0.5])
        return _Scene(drawn, values, (float(limits[0]), float(limits[1])), poses, low, high,
                      len(cloud), len(finite) - len(inside), len(cloud) - len(finite))

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal."""
        return float(np.linalg.norm(self.high - self.low))

    @property
    def point_size(self) -> float:
        """Marker area in square points: small where many points are drawn."""
        return float(np.clip(40_000 / max(len(self.points), 1), 1.2, 9.0))


def _robust_box(points: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box that is shown: all camera centres, and the points without their far tails."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    if len(points):
        p1, p10, p90, p99 = np.percentile(points, (1, 10, 90, 99), axis=0)
        reach = 0.4 * (p90 - p10)  # holds 99 % of a normal distribution
        low, high = np.maximum(p1, p10 - reach), np.minimum(p99, p90 + reach)
    if len(centers):
        low, high = np.minimum(low, centers.min(axis=0)), np.maximum(high, centers.max(axis=0))
    if not len(points) and not len(centers):
        low, high = np.full(3, -1.0), np.full(3, 1.0)
    margin = 0.06 * float((high - low).max()) or 1.0
    return low - margin, high + margin


def _frusta(scene: _Scene) -> np.ndarray:
    """`(F, 8, 2, 3)` world line segments of up to 14 camera pyramids, spread evenly over the trajectory."""
    count = min(14, len(scene.poses))
    poses = scene.poses[np.linspace(0, len(scene.poses) - 1, count).astype(int)]
    size = 0.03 * np.sqrt(scene.diagonal * np.median(scene.high - scene.low))  # smaller in long, narrow scenes
    x, y, z = size * np.array([1.0, 0.75, 1.5])
    tips = np.array([[0, 0, 0], [-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]])
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
    world = np.einsum("fij,pj->fpi", _rotations(poses[:, 3:]), tips) + poses[:, None, :3]
    return world[:, edges]


def _rotations(quat_xyzw: np.ndarray) -> np.ndarray:
    """`(N, 3, 3)` rotation matrices; a zero quaternion counts as no rotation."""
    norm = np.linalg.norm(quat_xyzw, axis=1, keepdims=True)
    unit = np.where(norm > 0, quat_xyzw / np.where(norm > 0, norm, 1.0), np.array([0.0, 0.0, 0.0, 1.0]))
    vector, scalar = unit[:, :3], unit[:, 3]
    cross = np.zeros((len(unit), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = vector
    cross[:, [1, 2, 0], [2, 0, 1]] = -vector
    return np.eye(3) + 2 * scalar[:, None, None] * cross + 2 * cross @ cross


def _view() -> np.ndarray:
    """Rows right, up and forward of the virtual camera in world axes; the world's y points down, as in an image."""
    forward = np.asarray(_LOOK) / np.linalg.norm(_LOOK)
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def _project(world: np.ndarray, scene: _Scene) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates (right, up) and relative distances (about 1) of world points in the perspective view."""
    away = 1.7 * scene.diagonal
    seen = (world - (scene.low + scene.high) / 2) @ _view().T + np.array([0.0, 0.0, away])
    distance = np.maximum(seen[..., 2], 1e-3 * away)
    return seen[..., :2] / distance[..., None], distance / away


def _stage(scene: _Scene) -> np.ndarray:
    """`(K, 2, 3)` world line segments: a grid on the floor and on the two walls behind the scene."""
    from matplotlib.ticker import MaxNLocator

    ticks = MaxNLocator(7, steps=(1, 2, 5, 10)).tick_values(0, float((scene.high - scene.low).max()))
    step = ticks[1] - ticks[0]
    segments = []
    for along in range(3):  # lines that run along this axis, on the two faces that contain it
        for across in {0, 1, 2} - {along}:
            stops = np.arange(np.ceil(scene.low[across] / step), np.floor(scene.high[across] / step) + 1) * step
            for stop in (scene.low[across], *stops, scene.high[across]):
                start, end = scene.high.copy(), scene.high.copy()
                start[across] = end[across] = stop
                start[along] = scene.low[along]
                segments.append((start, end))
    return np.array(segments)


def _draw_perspective(figure: Figure, scene: _Scene) -> None:
    from matplotlib.collections import LineCollection

    axes = figure.add_axes((0.02, 0.085, 0.575, 0.80))
    axes.set_axis_off()
    stage = _project(_stage(scene), scene)[0]
    axes.add_collection(LineCollection(list(stage), colors=_GRID, linewidths=0.6, alpha=0.8))
    image, distance = _project(scene.points, scene)
    order = np.argsort(-distance, kind="stable")
    axes.scatter(image[order, 0], image[order, 1], s=1.3 * scene.point_size / distance[order] ** 2,
                 c=scene.values[order], cmap=_color_map(), vmin=scene.value_limits[0], vmax=scene.value_limits[1],
                 linewidths=0, alpha=0.9)
    _draw_path(axes, scene, lambda world: _project(world, scene)[0])
    low, high = stage.min(axis=(0, 1)), stage.max(axis=(0, 1))
    _set_equal_limits(figure, axes, low, high)
    _draw_triad(figure)


def _draw_triad(figure: Figure) -> None:
    """The directions of the world axes as the perspective view shows them."""
    axes = figure.add_axes((0.028, 0.10, 0.0675, 0.12))  # square on the 16:9 figure
    axes.set_axis_off()
    axes.set_xlim(-1.4, 1.4)
    axes.set_ylim(-1.4, 1.4)
    for name, tip in zip("xyz", _view()[:2].T):
        axes.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": _FAINT, "shrinkA": 0, "shrinkB": 0})
        x, y = tip * (1 + 0.25 / max(float(np.linalg.norm(tip)), 0.3))
        axes.text(x, y, name, color=_FAINT, ha="center", va="center", fontsize=10)


def _draw_plane(
    figure: Figure, place: tuple[float, float, float, float], scene: _Scene, shown: tuple[int, int], name: str,
    unit: str,
) -> None:
    """One orthographic view; the axis y, which points down, is drawn downwards."""
    axes = figure.add_axes(place)
    axes.set_facecolor(_PANEL)
    axes.grid(True, color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_FAINT, labelsize=9, length=0)
    for spine in axes.spines.values():
        spine.set_color(_GRID)
    axes.set_xlabel(f"{'xyz'[shown[0]]} ({unit})", color=_FAINT, fontsize=10)
    axes.set_ylabel(f"{'xyz'[shown[1]]} ({unit})", color=_FAINT, fontsize=10)
    axes.set_title(name, color=_TEXT, fontsize=12, loc="left")
    axes.scatter(scene.points[:, shown[0]], scene.points[:, shown[1]], s=scene.point_size * 0.55, c=scene.values,
                 cmap=_color_map(), vmin=scene.value_limits[0], vmax=scene.value_limits[1], linewidths=0, alpha=0.75)
    _draw_path(axes, scene, lambda world: world[..., list(shown)])
    _set_equal_limits(figure, axes, scene.low[list(shown)], scene.high[list(shown)])
    if shown[1] == 1:
        axes.invert_yaxis()


def _set_equal_limits(figure: Figure, axes: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """Limits around a box with one scale for both directions, filling the axes' rectangle."""
    width, height = axes.get_position().size * figure.get_size_inches()
    center, extent = (low + high) / 2, (high - low) / 2
    scale = max(extent[0] / width, extent[1] / height)
    axes.set_xlim(center[0] - scale * width, center[0] + scale * width)
    axes.set_ylim(center[1] - scale * height, center[1] + scale * height)


def _draw_path(axes: Axes, scene: _Scene, project: Any) -> None:
    """Trajectory, camera pyramids, start and end, through a projection from world to image coordinates."""
    if not len(scene.poses):
        return
    from matplotlib.collections import LineCollection

    line = project(scene.poses[:, :3])
    segments = project(_frusta(scene)).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(segments, colors=_PATH, linewidths=0.9, alpha=0.65, zorder=3))
    axes.plot(line[:, 0], line[:, 1], color=_PATH, linewidth=1.8, solid_capstyle="round", zorder=4)
    axes.plot(*line[0], **_START_MARKER, zorder=5)
    axes.plot(*line[-1], **_END_MARKER, zorder=6)


def _color_map() -> Any:
    """Viridis without its darkest fifth, which the dark background would swallow."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["viridis"](np.linspace(0.2, 1.0, 256)))


def _draw_color_bar(figure: Figure, scene: _Scene, label: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = figure.add_axes((0.03, 0.04, 0.17, 0.012))
    mapping = ScalarMappable(Normalize(*scene.value_limits), _color_map())
    bar = figure.colorbar(mapping, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)  # type: ignore[operator]
    axes.tick_params(colors=_FAINT, labelsize=9, length=0)
    axes.set_title(label, color=_FAINT, fontsize=9, loc="left", pad=5)


def _write_texts(figure: Figure, scene: _Scene, title: str, unit: str) -> None:
    steps = np.linalg.norm(np.diff(scene.poses[:, :3], axis=0), axis=1)
    summary = (f"{_count(scene.total, 'point')}    {_count(len(scene.poses), 'pose')}    "
               f"path length {steps.sum():.3g} {'units' if unit == ARBITRARY else unit}")
    notes = ["monocular: arbitrary scale"] if unit == ARBITRARY else []
    notes += ["world frame = first camera (x right, y down, z forward)"]
    if scene.outside:
        notes.append(f"{_count(scene.outside, 'point')} outside the view")
    if scene.nonfinite:
        notes.append(f"{_count(scene.nonfinite, 'non-finite point')} left out")
    if len(scene.points) < scene.total - scene.outside - scene.nonfinite:
        notes.append(f"{len(scene.points):,} points drawn")
    headline = title or "Trajectory and point cloud"
    figure.text(0.03, 0.945, headline, color=_TEXT, fontsize=20, va="center", weight="bold", parse_math=False)
    figure.text(0.03, 0.908, summary, color=_FAINT, fontsize=12, va="center")
    figure.text(0.97, 0.025, "  |  ".join(notes), color=_FAINT, fontsize=9, ha="right", va="center")
    if len(scene.poses):
        from matplotlib.lines import Line2D

        handles = [Line2D([], [], color=_PATH, linewidth=1.8, label="camera path"),
                   Line2D([], [], **_START_MARKER, label="start"),
                   Line2D([], [], **_END_MARKER, label="end")]
        figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.97, 0.965), ncols=3, frameon=False,
                      labelcolor=_FAINT, fontsize=10)


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
