"""Settings of the two edge clouds; the field names are those of the flags `--edge_*` and `--focus_*`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from devo.errors import InputError

FOCUS_EDGES = ("ridge", "sobel")


@dataclass(frozen=True)
class EdgeSettings:
    """Which pixels are edges and how they get a depth.

    Attributes:
        downsample: side of the squares over which event images are averaged [px].
        topk: at most this many edge pixels per frame, the strongest ones.
        border: pixels of the pooled image along its border that are never edges.
        knn: patch centres that vote on the depth of an edge pixel.
        max_dist: all of them must lie this near [quarter-resolution px].
        legacy_pixels: take pooled pixel u for the camera coordinate u, as the published tool does, instead of its
            centre u + (s-1)/(2s).

    Raises:
        InputError: a value that makes no sense.
    """

    downsample: int = 4
    topk: int = 6000
    border: int = 2
    knn: int = 4
    max_dist: float = 6.0
    legacy_pixels: bool = False

    def __post_init__(self) -> None:
        self._check("edge")

    def _check(self, prefix: str) -> None:
        self._at_least(prefix, downsample=1, topk=1, border=0, knn=1)
        if not (self.max_dist > 0 and math.isfinite(self.max_dist)):
            raise InputError(f"--{prefix}_max_dist is {self.max_dist}; expected a positive number")

    def _at_least(self, prefix: str, **lowest: int) -> None:
        for name, bound in lowest.items():
            if getattr(self, name) < bound:
                raise InputError(f"--{prefix}_{name} is {getattr(self, name)}; expected at least {bound}")

    @property
    def pixel_shift(self) -> float:
        """From the index of a pooled pixel to its place in the camera of the pooled size [pooled px]."""
        return 0.0 if self.legacy_pixels else (self.downsample - 1) / (2 * self.downsample)


@dataclass(frozen=True)
class FocusSettings(EdgeSettings):
    """How depths of edge pixels are refined: the right depth is the one at which neighbouring event images agree.

    Attributes:
        edges: `ridge` (where the event image is brightest) or `sobel` (where its gradient is largest, as published: the
            flanks of the ridges, which other images do not show at the same place).
        support: neighbouring images used on each side. support_stride: distance between them [images].
        rho_samples: inverse depths tried per pixel. rho_rel: half-width of the tried band relative to the prior.
        rho_abs: half-width in absolute inverse depth; replaces rho_rel if given.
        patch_radius: the largest value within this distance counts [pooled px].
        guard: samples on each side of the peak that do not count as its rivals.
        min_peak_ratio: peak over strongest rival needed. min_score: peak needed.
        min_baseline: neighbours nearer than this to the reference camera are not used [trajectory units].
        keyframe_stride: use every n-th frame as reference. max_keyframes: at most that many, 0 for all.

    Raises:
        InputError: a value that makes no sense.
    """

    edges: str = "ridge"
    support: int = 4
    support_stride: int = 1
    rho_samples: int = 25
    rho_rel: float = 0.2
    rho_abs: float | None = None
    patch_radius: int = 1
    guard: int = 2
    min_peak_ratio: float = 1.2
    min_score: float = 0.0
    min_baseline: float = 0.0
    keyframe_stride: int = 1
    max_keyframes: int = 0

    def __post_init__(self) -> None:
        self._check("focus")
        self._at_least("focus", support=1, support_stride=1, rho_samples=3, patch_radius=0, guard=0,
                       keyframe_stride=1, max_keyframes=0)
        if self.edges not in FOCUS_EDGES:
            raise InputError(f"--focus_edges is {self.edges!r}; expected one of {', '.join(FOCUS_EDGES)}")
        width = self.rho_rel if self.rho_abs is None else self.rho_abs
        name = "rho_rel" if self.rho_abs is None else "rho_abs"
        if not (width > 0 and math.isfinite(width)):
            raise InputError(f"--focus_{name} is {width}; expected a positive number")
        if self.rho_abs is None and self.rho_rel >= 1:
            raise InputError(f"--focus_rho_rel is {self.rho_rel}; expected less than 1, so that depths stay positive")
        if self.rho_samples < 2 * self.guard + 2:
            raise InputError(f"--focus_rho_samples {self.rho_samples} leaves no rival outside a guard band of "
                             f"{self.guard} samples; raise it to {2 * self.guard + 2} or lower --focus_guard")
        for name in ("min_peak_ratio", "min_score", "min_baseline"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"--focus_{name} is {getattr(self, name)}; expected a finite number")
