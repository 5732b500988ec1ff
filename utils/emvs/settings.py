"""The parameters of the mapper with the defaults of the published implementation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from devo.errors import InputError

Vote = Literal["bilinear", "nearest"]
DepthSpacing = Literal["inverse", "linear"]
ReferenceRule = Literal["fixed", "baseline"]

DEFAULT_MIN_DEPTH = 0.3
DEFAULT_MAX_DEPTH = 5.0
_MOST_PLANES = 32_767  # plane numbers are kept as int16


@dataclass(frozen=True)
class EmvsSettings:
    """How events become a depth map and a cloud.

    Lengths are in the unit of the poses, which is arbitrary for poses of the odometry.

    Attributes:
        dimX, dimY: size of the reference view in pixels; 0 = that of the sensor.
        dimZ: number of depth planes.
        fov_deg: horizontal field of view of the reference view in degrees; below 10 = the camera's focal length.
        min_depth, max_depth: depth range; None = from a sparse cloud, if there is one, else 0.3 and 5.0.
        depth_spacing: planes equidistant in inverse depth, or in depth.
        adaptive_threshold_kernel_size: odd width of the Gaussian window in pixels.
        adaptive_threshold_c: how far (of 255) the confidence must exceed its surroundings; smaller = denser, noisier.
        median_filter_size: odd width of the median window in pixels.
        radius_search: radius of the outlier filter; None = 3 times the median nearest-neighbour distance.
        min_num_neighbors: other points needed within that radius; 0 turns the filter off.
        vote: share a vote between four pixels, or give it to the nearest one.
        subplane: refine the depth between planes with a parabola through the three votes around the maximum.
        packet_size: events that share one interpolated pose.
        event_stride: use every n-th event only.
        reference: one reference view for all events, or a new one whenever the camera has moved on.
        view_baseline: reference "baseline": move of the camera, relative to the mean depth, that ends a view.
        view_angle_deg: reference "baseline": rotation in degrees that ends a view.
        min_view_baseline: a view whose camera moves less than this share of the mean depth has no parallax; it is
            left out.

    Raises:
        InputError: a value out of range.
    """

    dimX: int = 0
    dimY: int = 0
    dimZ: int = 100
    fov_deg: float = 0.0
    min_depth: float | None = None
    max_depth: float | None = None
    depth_spacing: DepthSpacing = "inverse"
    adaptive_threshold_kernel_size: int = 5
    adaptive_threshold_c: float = 5.0
    median_filter_size: int = 5
    radius_search: float | None = 0.05
    min_num_neighbors: int = 3
    vote: Vote = "bilinear"
    subplane: bool = False
    packet_size: int = 1024
    event_stride: int = 1
    reference: ReferenceRule = "fixed"
    view_baseline: float = 0.3
    view_angle_deg: float = 20.0
    min_view_baseline: float = 0.005

    def __post_init__(self) -> None:
        checks = (
            ("dimX", self.dimX == 0 or 2 <= self.dimX <= 8192, "0 (the sensor's width) or 2 to 8192 pixels"),
            ("dimY", self.dimY == 0 or 2 <= self.dimY <= 8192, "0 (the sensor's height) or 2 to 8192 pixels"),
            ("dimZ", 2 <= self.dimZ <= _MOST_PLANES, f"2 to {_MOST_PLANES} planes"),
            ("fov_deg", 0 <= self.fov_deg < 180, "0 (the camera's) or 10 to 180 degrees"),
            ("depth_spacing", self.depth_spacing in ("inverse", "linear"), "inverse or linear"),
            ("adaptive_threshold_kernel_size", _odd(self.adaptive_threshold_kernel_size, 3), "an odd number from 3"),
            ("adaptive_threshold_c", math.isfinite(self.adaptive_threshold_c), "a finite number"),
            ("median_filter_size", _odd(self.median_filter_size, 1), "an odd number"),
            ("radius_search", self.radius_search is None or 0 < self.radius_search < math.inf, "a positive length"),
            ("min_num_neighbors", self.min_num_neighbors >= 0, "at least 0"),
            ("vote", self.vote in ("bilinear", "nearest"), "bilinear or nearest"),
            ("packet_size", 1 <= self.packet_size <= 1 << 20, "1 to 1048576 events"),
            ("event_stride", self.event_stride >= 1, "at least 1"),
            ("reference", self.reference in ("fixed", "baseline"), "fixed or baseline"),
            ("view_baseline", 0 < self.view_baseline < math.inf, "a positive share of the depth"),
            ("view_angle_deg", 0 < self.view_angle_deg <= 180, "above 0 and up to 180 degrees"),
            ("min_view_baseline", 0 <= self.min_view_baseline < self.view_baseline, "at least 0, below view_baseline"),
        )
        for name, good, expected in checks:
            if not good:
                raise InputError(f"{name} is {getattr(self, name)}, expected {expected}")
        for name in ("min_depth", "max_depth"):
            depth = getattr(self, name)
            if depth is not None and not 0 < depth < math.inf:
                raise InputError(f"{name} is {depth}, expected a positive finite depth")
        if self.min_depth is not None and self.max_depth is not None and not self.min_depth < self.max_depth:
            raise InputError(f"min_depth {self.min_depth:g} is not below max_depth {self.max_depth:g}")


def _odd(value: int, least: int) -> bool:
    return least <= value <= 255 and value % 2 == 1
