"""What the colour of a point says: one of its coordinates, its time, its own colour, or any per-point value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.clouds.cloud import PointCloud

ARBITRARY = "arbitrary units"
"""What one unit of a monocular reconstruction is."""

OWN_COLORS = "rgb"
NO_COLOR = "none"
_COORDINATES: dict[str, tuple[int, float, str]] = {
    "depth": (2, 1.0, "depth: z of the first camera"),
    "height": (1, -1.0, "height: -y of the first camera"),
    "x": (0, 1.0, "x"), "y": (1, 1.0, "y"), "z": (2, 1.0, "z"),
}
_SCALAR_LABELS = {
    "inv_depth": "inverse depth", "inv_depth_sigma": "standard deviation of the inverse depth",
    "observations": "observing frames", "mean_weight": "mean weight", "residual_px": "reprojection residual [px]",
    "parallax_deg": "parallax [deg]", "host_frame": "host frame", "confidence": "confidence",
}
_LIMITS_PERCENT = (2.0, 98.0)


@dataclass(frozen=True, eq=False)
class Coloring:
    """One value per point and the range that the colours span.

    Attributes:
        name: what the user asked for.
        label: for a colour bar, with unit; empty if there is nothing to say (`none`, `rgb`).
        values: `(N,)` float64, NaN where unknown; zeros for `none` and `rgb`.
        limits: 2nd and 98th percentile of the finite values, widened where they coincide.
    """

    name: str
    label: str
    values: npt.NDArray[np.float64]
    limits: tuple[float, float]

    @property
    def has_scale(self) -> bool:
        """Whether the colour stands for a number."""
        return bool(self.label)


def colorings_of(cloud: PointCloud) -> list[str]:
    """Names that `color_cloud` accepts for this cloud, the most telling first."""
    names = ["depth", "height"]
    names += ["time"] if "t_us" in cloud.scalars else []
    names += ["intensity", OWN_COLORS] if cloud.colors is not None else []
    return names + [name for name in cloud.scalars if name not in ("t_us", "depth")] + ["x", "y", "z", NO_COLOR]


def color_cloud(cloud: PointCloud, name: str, unit: str = ARBITRARY) -> Coloring:
    """Value of every point for one way of colouring.

    Args:
        cloud: any.
        name: `depth`, `height`, `x`, `y`, `z` (world coordinates); `time` (scalar `t_us`, from the first point on);
            `intensity` (mean of red, green and blue); `rgb`; `none`; or the name of a per-point value.
        unit: what one unit of length is.

    Raises:
        InputError: the cloud has nothing of that name.
    """
    if name in (NO_COLOR, OWN_COLORS) and name in colorings_of(cloud):
        return Coloring(name, "", np.zeros(len(cloud)), (0.0, 1.0))
    if name in _COORDINATES:
        axis, sign, label = _COORDINATES[name]
        return _scaled(name, f"{label} ({unit})", sign * cloud.points[:, axis].astype(np.float64))
    if name not in colorings_of(cloud):
        raise InputError(f"there is no {name!r} to colour the points by; choose from {', '.join(colorings_of(cloud))}")
    special: dict[str, Callable[[], Coloring]] = {"time": lambda: _time(cloud), "intensity": lambda: _intensity(cloud)}
    if name in special:
        return special[name]()
    return _scaled(name, _SCALAR_LABELS.get(name, name), cloud.scalars[name].astype(np.float64))


def _time(cloud: PointCloud) -> Coloring:
    t_us = cloud.scalars["t_us"].astype(np.float64)
    finite = t_us[np.isfinite(t_us)]
    return _scaled("time", "time since the first point [s]", (t_us - (finite.min() if len(finite) else 0.0)) * 1e-6)


def _intensity(cloud: PointCloud) -> Coloring:
    return _scaled("intensity", "intensity (0..255)", np.asarray(cloud.colors).mean(axis=1, dtype=np.float64))


def _scaled(name: str, label: str, values: npt.NDArray[np.float64]) -> Coloring:
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, _LIMITS_PERCENT).tolist() if len(finite) else (0.0, 1.0)
    if not high > low:
        low, high = low - 0.5, high + 0.5
    return Coloring(name, label, values, (low, high))
