"""Whole pictures: overview, one plane, perspective, and the trajectory over time."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.plots.draw import (
    AXIS_COLORS,
    FAINT,
    dark_axes,
    draw_color_bar,
    draw_perspective,
    draw_plane,
    new_figure,
    point_size_of,
    write_texts,
)
from utils.plots.scene import FloatArray, Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "svg", "pdf")
PLANES: dict[str, tuple[int, int]] = {"xy": (0, 1), "xz": (0, 2), "yz": (2, 1)}
"""World axes that go right and up; `yz` is seen from the side, with z to the right."""
_NAMES = {"xz": "top view", "yz": "side view", "xy": "front view"}
_DPI = 150


def picture_path(asked: str | None, default: Path, wanted: str = "auto") -> Path:
    """Where the picture goes.

    Args:
        asked: the name that the user gave, None takes `default` (without ending).
        default: used where nothing was asked.
        wanted: `auto` or one of `FORMATS`; a name that says otherwise is an error.

    Raises:
        InputError: name and format contradict each other, or the ending is unknown.
    """
    suffix = "png" if wanted == "auto" else wanted
    path = Path(asked) if asked else default.with_name(f"{default.name}.{suffix}")
    found = path.suffix.lower().removeprefix(".")
    if found not in FORMATS or (wanted != "auto" and found != wanted):
        expected = ", ".join(f".{name}" for name in FORMATS) if wanted == "auto" else f".{wanted}"
        raise InputError(f"{path}: pictures end in {expected}, found {path.suffix or 'no ending'}")
    return path


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG, SVG or PDF by the ending of the name, completely or not at all.

    The file holds no date, so the same input gives the same bytes.

    Raises:
        InputError: an unknown ending.
        OutputError: the file cannot be written.
    """
    import matplotlib

    suffix = picture_path(os.fspath(path), Path()).suffix.lower().removeprefix(".")
    metadata = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[suffix]
    with atomic_path(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "devo"}):
        figure.savefig(temporary, format=suffix, facecolor=figure.get_facecolor(), metadata=metadata)


def overview_page(scene: Scene, *, title: str = "", point_size: float | None = None, dpi: int = 120) -> Figure:
    """Perspective, top, side and front view with equal axes.

    Args:
        scene: cloud and path.
        title: headline.
        point_size: marker area in square points; None chooses one by the number of points.
        dpi: pixels per inch of the 16 x 9 inch page.
    """
    figure = new_figure(16, 9, dpi)
    draw_perspective(figure, (0.02, 0.085, 0.575, 0.80), scene, size=point_size)
    size = 0.55 * point_size_of(scene) if point_size is None else point_size
    for row, (plane, name) in enumerate(_NAMES.items()):
        place = (0.645, 0.6875 - 0.30 * row, 0.325, 0.205)
        # seen from the front the path lies over the structure and would hide it
        draw_plane(figure, place, scene, PLANES[plane], name, size, path_alpha=0.45 if plane == "xy" else 1.0)
    draw_color_bar(figure, (0.03, 0.04, 0.17, 0.012), scene)
    write_texts(figure, scene, title)
    return figure


def plane_page(scene: Scene, plane: str, *, title: str = "", point_size: float | None = None) -> Figure:
    """The cloud as seen along one world axis, with equal scales.

    Args:
        scene, title, point_size: as for `overview_page`.
        plane: `xy` (front), `xz` (top) or `yz` (side).

    Raises:
        InputError: an unknown plane.
    """
    if plane not in PLANES:
        raise InputError(f"plane must be one of {', '.join(PLANES)}, found {plane!r}")
    shown = PLANES[plane]
    extent = (scene.high - scene.low)[list(shown)]
    height = float(np.clip(9.5 * extent[1] / extent[0], 4.5, 10.0))  # inches of the axes; the margins come on top
    page = height + 2.3
    figure = new_figure(11, page, _DPI)
    alpha = 0.5 if plane == "xy" else 1.0
    draw_plane(figure, (0.085, 1.25 / page, 0.89, height / page), scene, shown, "", point_size, path_alpha=alpha)
    draw_color_bar(figure, (0.085, 0.48 / page, 0.25, 0.12 / page), scene)
    write_texts(figure, scene, title, left=0.085, right=0.975)
    return figure


def perspective_page(scene: Scene, elevation_deg: float = 15.0, azimuth_deg: float = -60.0, *, title: str = "",
                     point_size: float | None = None) -> Figure:
    """The cloud in perspective.

    Args:
        scene, title, point_size: as for `overview_page`.
        elevation_deg: how far above the horizon (the plane of x and z) the observer stands.
        azimuth_deg: where: -90 is behind the first camera, looking along its z; 0 is at its right.

    Raises:
        InputError: angles that are not finite.
    """
    look = look_direction(elevation_deg, azimuth_deg)
    figure = new_figure(12.8, 9, _DPI)
    draw_perspective(figure, (0.03, 0.09, 0.94, 0.79), scene, look, point_size)
    draw_color_bar(figure, (0.03, 0.045, 0.21, 0.012), scene)
    write_texts(figure, scene, title)
    return figure


def look_direction(elevation_deg: float, azimuth_deg: float) -> FloatArray:
    """Viewing direction in world axes (y down) of an observer at the given elevation and azimuth.

    Raises:
        InputError: angles that are not finite.
    """
    if not np.isfinite([elevation_deg, azimuth_deg]).all():
        raise InputError(f"elevation {elevation_deg} and azimuth {azimuth_deg} must be finite degrees")
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    across = np.cos(elevation)
    return np.array([-across * np.cos(azimuth), np.sin(elevation), -across * np.sin(azimuth)])


def trajectory_page(scene: Scene, t_us: npt.ArrayLike | None = None, *, title: str = "") -> Figure:
    """The path in perspective and from above, and its coordinates and speed over time.

    Args:
        scene: at least one pose; points are drawn faintly behind the path.
        t_us: `(T,)` microseconds of the poses; None counts frames.
        title: headline.
    """
    figure = new_figure(16, 9)
    draw_perspective(figure, (0.02, 0.085, 0.48, 0.80), scene, faint_points=True)
    draw_plane(figure, (0.55, 0.555, 0.42, 0.335), scene, PLANES["xz"], "top view", 0.55 * point_size_of(scene))
    if t_us is None:
        time, label = np.arange(len(scene.poses), dtype=np.float64), "frame"
    else:
        time, label = (np.asarray(t_us, dtype=np.float64) - np.asarray(t_us, dtype=np.float64)[0]) * 1e-6, "time [s]"
    centers = scene.poses[:, :3]
    position = dark_axes(figure, (0.55, 0.325, 0.42, 0.135), "position", "", f"({scene.unit})")
    for axis, color in enumerate(AXIS_COLORS):
        position.plot(time, centers[:, axis], color=color, linewidth=1.4, label="xyz"[axis])
    position.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, frameon=False, labelcolor=FAINT, fontsize=9)
    position.tick_params(labelbottom=False)
    per = "s" if t_us is not None else "frame"
    speed = dark_axes(figure, (0.55, 0.105, 0.42, 0.135), f"speed [{scene.unit} / {per}]", label, "")
    elapsed = np.diff(time)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    speed.plot((time[1:] + time[:-1]) / 2, steps / np.where(elapsed > 0, elapsed, np.nan), color="#d2a8ff",
               linewidth=1.2)
    speed.set_ylim(bottom=0)
    speed.set_xlim(position.get_xlim())
    draw_color_bar(figure, (0.03, 0.04, 0.17, 0.012), scene)
    write_texts(figure, scene, title)
    return figure
