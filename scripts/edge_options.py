"""Options of the two edge clouds, shared by the commands that make them."""

from __future__ import annotations

import argparse
from dataclasses import fields

from utils.edge_clouds.settings import FOCUS_EDGES, EdgeSettings, FocusSettings

EDGE_TEXTS = {
    "downsample": "event images are averaged over squares of this side [px]",
    "topk": "at most this many edge pixels per frame",
    "border": "pooled pixels along the border that are no edges",
    "knn": "patch centres that vote on the depth of an edge pixel",
    "max_dist": "how near all of them must be [quarter-resolution px]",
    "legacy_pixels": "place pooled pixels as the published tool did, off by (s-1)/(2s)",
}
FOCUS_TEXTS = {
    **EDGE_TEXTS,
    "edges": "pixels on the ridges of the event image, or on their flanks as published",
    "support": "event images looked into on each side",
    "support_stride": "distance between them [images]; raise it for slow motion",
    "rho_samples": "inverse depths tried per pixel",
    "rho_rel": "half-width of the tried band, relative to the first guess",
    "rho_abs": "half-width in inverse depth, instead of the relative one",
    "patch_radius": "the largest value within this distance counts [pooled px]",
    "guard": "samples beside the peak that are no rivals",
    "min_peak_ratio": "peak over strongest rival that is needed",
    "min_score": "height of the peak that is needed",
    "min_baseline": "nearer cameras are not used [trajectory units]",
    "keyframe_stride": "refine every n-th frame",
    "max_keyframes": "refine at most this many frames, 0 = all",
}


def add_edge_options(group: argparse._ArgumentGroup, names: tuple[str, ...] = tuple(EDGE_TEXTS)) -> None:
    """Add `--edge_*`: which pixels are edges and how they get a first depth."""
    _add(group, "edge", EdgeSettings, {name: EDGE_TEXTS[name] for name in names})


def add_focus_options(group: argparse._ArgumentGroup) -> None:
    """Add `--focus_*`: the edge options and how depths are refined."""
    _add(group, "focus", FocusSettings, FOCUS_TEXTS)


def _add(group: argparse._ArgumentGroup, prefix: str, kind: type[EdgeSettings], texts: dict[str, str]) -> None:
    """One flag per text, with the default of the settings."""
    defaults = {field.name: field.default for field in fields(kind)}
    for name, text in texts.items():
        flag, default = f"--{prefix}_{name}", defaults[name]
        if isinstance(default, bool):
            group.add_argument(flag, action="store_true", help=text)
        elif name == "edges":
            group.add_argument(flag, choices=FOCUS_EDGES, default=default, help=text)
        else:
            group.add_argument(flag, type=float if default is None else type(default), default=default, help=text)
