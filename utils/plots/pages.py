"""Whole pictures in one file: a plane of the cloud, the cloud in perspective, the trajectory over time."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.plots.draw import (
    draw_color_bar,
    draw_perspective,
    draw_plane,
    new_figure,
    write_texts,
)
from utils.plots.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "svg", "pdf")
PLANES: dict[str, tuple[int, int]] = {"xy": (0, 1), "xz": (0, 2), "yz": (2, 1)}
"""World axes that go right and up; `yz` is seen from the side, with z to the right."""
_DPI = 150


def save_page(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG, SVG or PDF by the ending of the name, completely or not at all.

    The file holds no date, so the same input gives the same bytes.

    Raises:
        InputError: an unknown ending.
        OutputError: the file cannot be written.
    """
    import matplotlib

    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        raise InputError(f"{os.fspath(path)}: pictures end in {', '.join('.' + name for name in FORMATS)}, found "
                         f"{'.' + suffix if suffix else 'no ending'}")
    metadata = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[suffix]
    with atomic_path(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "devo"}):
        figure.savefig(temporary, format=suffix, facecolor=figure.get_facecolor(), metadata=metadata)


def plot_plane(path: str | os.PathLike[str], scene: Scene, plane: str, *, title: str = "",
               point_size: float | None = None) -> None:
    """Draw the cloud as seen along one world axis, with equal scales.

    Args:
        path: picture file.
        scene: cloud and path.
        plane: `xy` (front), `xz` (top) or `yz` (side).
        title: headline.
        point_size: marker area in square points; None chooses one by the number of points.

    Raises:
        InputError: an unknown plane or ending of the file name.
        OutputError: the file cannot be written.
    """
    if plane not in PLANES:
        raise InputError(f"plane must be one of {', '.join(PLANES)}, found {plane!r}")
    shown = PLANES[plane]
    extent = (scene.high - scene.low)[list(shown)]
    height = float(np.clip(9.5 * extent[1] / extent[0], 4.5, 10.0))  # inches of the axes; the margins come on top
    figure = new_figure(11, height + 2.3, _DPI)
    place = (0.085, 1.25 / (height + 2.3), 0.89, height / (height + 2.3))
    draw_plane(figure, place, scene, shown, "", point_size, path_alpha=0.5 if plane == "xy" else 1.0)
    draw_color_bar(figure, (0.085, 0.48 / (height + 2.3), 0.25, 0.12 / (height + 2.3)), scene)
    write_texts(figure, scene, title, left=0.085, right=0.975)
    save_page(figure, path)


def plot_perspective(path: str | os.PathLike[str], scene: Scene, *, elevation_deg: float = 15.0,
                     azimuth_deg: float = -60.0, title: str = "", point_size: float | None = None) -> None:
    """Draw the cloud in perspective.

    Args:
        path, scene, title, point_size: as for `plot_plane`.
        elevation_deg: how far above the horizon (the plane of x and z) the observer stands.
        azimuth_deg: where: -90 is behind the first camera, looking along its z; 0 is at its right.

    Raises:
        InputError: angles that are not finite, or an unknown ending of the file name.
        OutputError: the file cannot be written.
    """
    look = look_direction(elevation_deg, azimuth_deg)
    figure = new_figure(12.8, 9, _DPI)
    draw_perspective(figure, (0.03, 0.09, 0.94, 0.79), scene, look, point_size)
    draw_color_bar(figure, (0.03, 0.045, 0.21, 0.012), scene)
    write_texts(figure, scene, title)
    save_page(figure, path)


def look_direction(elevation_deg: float, azimuth_deg: float) -> npt.NDArray[np.float64]:
    """Viewing direction in world axes (y down) of an observer at the given elevation and azimuth.

    Raises:
        InputError: angles that are not finite.
    """
    if not np.isfinite([elevation_deg, azimuth_deg]).all():
        raise InputError(f"elevation {elevation_deg} and azimuth {azimuth_deg} must be finite degrees")
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    across = np.cos(elevation)
    return np.array([-across * np.cos(azimuth), np.sin(elevation), -across * np.sin(azimuth)])
