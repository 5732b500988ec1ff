"""One picture of a cloud and the camera's path: perspective, top, side and front view."""

from __future__ import annotations

import os

import numpy as np

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.plots.coloring import ARBITRARY, colorings_of
from utils.plots.pages import overview_page, save_figure
from utils.plots.scene import Scene

__all__ = ["ARBITRARY", "save_preview"]


def save_preview(
    path: str | os.PathLike[str],
    cloud: PointCloud,
    world_T_cam: np.ndarray,
    *,
    title: str = "",
    color_by: str = "depth",
    unit: str = ARBITRARY,
) -> None:
    """Draw the cloud and the trajectory into a PNG: perspective, top, side and front view with equal axes.

    The axes are those of the world frame (first camera: x right, y down, z forward); "top", "side" and "front" are
    meant relative to that camera, because gravity is unknown. The limits follow percentiles, so a few far outliers do
    not shrink the scene; how many points lie outside is written below the picture, as is the arbitrary scale.

    Args:
        path: PNG file, written completely or not at all.
        cloud: may be empty; points with non-finite coordinates are left out and counted.
        world_T_cam: `(T, 7)` camera-to-world poses `tx ty tz qx qy qz qw` in the unit of the cloud; T may be 0.
            Poses that are not finite are left out.
        title: headline.
        color_by: `depth` (world z), `height` (minus world y), or what else `utils.plots.coloring` offers.
        unit: what one unit of length is, for the labels; say `m` only of aligned or metric clouds.

    Raises:
        InputError: poses of another shape, or an unknown colouring.
        OutputError: the file cannot be written.
    """
    if color_by not in colorings_of(cloud):
        raise InputError(f"color_by must be one of {', '.join(colorings_of(cloud))}, found {color_by!r}")
    scene = Scene.build(cloud, world_T_cam, color_by, unit=unit)
    save_figure(overview_page(scene, title=title), path)
