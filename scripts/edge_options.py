"""Options of the two edge clouds, shared by the commands that make them."""

from __future__ import annotations

import argparse


def add_edge_options(group: argparse._ArgumentGroup, prefix: str) -> None:
    """Add which pixels are edges and how they get a first depth: `--<prefix>_topk`, ..."""
    def add(name: str, default: float, text: str) -> None:
        group.add_argument(f"--{prefix}_{name}", type=type(default), default=default, help=text)

    add("downsample", 4, "event images are averaged over squares of this side [px]")
    add("topk", 6000, "at most this many edge pixels per frame")
    add("border", 2, "pooled pixels along the border that are no edges")
    add("knn", 4, "patch centres that vote on the depth of an edge pixel")
    add("max_dist", 6.0, "how near all of them must be [quarter-resolution px]")
    group.add_argument(f"--{prefix}_legacy_pixels", action="store_true",
                       help="place pooled pixels as the published tool did, off by (s-1)/(2s)")


def add_focus_options(group: argparse._ArgumentGroup) -> None:
    """Add `--focus_*`: the edge options and how depths are refined."""
    add_edge_options(group, "focus")
    add = group.add_argument
    add("--focus_edges", choices=("ridge", "sobel"), default="ridge",
        help="pixels on the ridges of the event image, or on their flanks as published")
    add("--focus_support", type=int, default=4, help="event images looked into on each side")
    add("--focus_support_stride", type=int, default=1, help="distance between them [images]; raise it for slow motion")
    add("--focus_rho_samples", type=int, default=25, help="inverse depths tried per pixel")
    add("--focus_rho_rel", type=float, default=0.2, help="half-width of the tried band, relative to the first guess")
    add("--focus_rho_abs", type=float, help="half-width in inverse depth, instead of the relative one")
    add("--focus_patch_radius", type=int, default=1, help="the largest value within this distance counts [pooled px]")
    add("--focus_guard", type=int, default=2, help="samples beside the peak that are no rivals")
    add("--focus_min_peak_ratio", type=float, default=1.2, help="peak over strongest rival that is needed")
    add("--focus_min_score", type=float, default=0.0, help="height of the peak that is needed")
    add("--focus_min_baseline", type=float, default=0.0, help="nearer cameras are not used [trajectory units]")
    add("--focus_keyframe_stride", type=int, default=1, help="refine every n-th frame")
    add("--focus_max_keyframes", type=int, default=0, help="refine at most this many frames, 0 = all")
