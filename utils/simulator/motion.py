"""Random camera motion with a prescribed amount of image motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from utils.simulator.renderer import Rays, Renderer
from utils.simulator.scenes import Planes
from utils.simulator.trajectory import Spline, induced_flow

KINDS = ("translate", "orbit", "rotate", "forward", "shake")
CLEARANCE = 0.15
"""Smallest distance between camera and surfaces, relative to the typical depth."""


@dataclasses.dataclass(frozen=True)
class MotionRequest:
    """A wish: kind of motion, number of frame intervals, mean image motion per frame interval in pixels."""

    kind: str
    frames: int
    mean_flow_px: float


@dataclasses.dataclass(frozen=True)
class CalibratedMotion:
    """A pose curve over `0 .. frames` frame intervals and the image motion it really causes.

    Attributes:
        kind: one of `KINDS`.
        spline: world_T_cam, time in frame intervals.
        mean_flow_px: mean over pixels and frame intervals; may be below the request in tight scenes.
        window_flow_px: per window, an upper bound (97 % quantile with a margin) of the image path length.
    """

    kind: str
    spline: Spline
    mean_flow_px: float
    window_flow_px: list[float]


def calibrated_motion(request: MotionRequest, planes: Planes, rays: Rays, rng: np.random.Generator) -> CalibratedMotion:
    """Draw a curve, scale it to the wanted image motion and shrink it until the camera stays clear of surfaces."""
    coarse = rays.coarse(max(4, min(rays.size) // 12))
    renderer = Renderer(planes, torch.zeros(1, 1, 0, 0), coarse)
    anchor = torch.tensor([0.0, 0, 0, 0, 0, 0, 1])
    depth = 1.0 / float(renderer.inverse_depth(anchor[None]).clamp(min=1e-3).median())
    spline = Spline(anchor, *_random_knots(request, depth, rng))
    for part in ((1.0, 0.0), (0.0, 1.0)) if request.kind in ("translate", "rotate", "forward", "shake") else ():
        flow, _ = _mean_flow(spline.scaled(*part), renderer, request.frames)
        share = _rotation_share(request.kind, rng)
        wanted = request.mean_flow_px * (share if part[1] else 1 - share)
        factor = wanted / max(flow, 1e-6)
        spline = spline.scaled(*(factor if p else 1.0 for p in part))
    for _ in range(3):
        flow, _ = _mean_flow(spline, renderer, request.frames)
        factor = float(np.clip(request.mean_flow_px / max(flow, 1e-6), 0.05, 20.0))
        spline = spline.scaled(factor, factor)
    for _ in range(12):
        if _is_free(spline, renderer, depth):
            break
        spline = spline.scaled(0.7, 0.7)
    flow, windows = _mean_flow(spline, renderer, request.frames)
    if flow < 0.5 * request.mean_flow_px and request.kind != "rotate":  # no room for so much translation
        return calibrated_motion(dataclasses.replace(request, kind="rotate"), planes, rays, rng)
    return CalibratedMotion(request.kind, spline, flow, windows)


def _rotation_share(kind: str, rng: np.random.Generator) -> float:
    low, high = {"translate": (0.05, 0.4), "rotate": (0.7, 0.95), "forward": (0.05, 0.3), "shake": (0.2, 0.8)}[kind]
    return float(rng.uniform(low, high))


def _random_knots(request: MotionRequest, depth: float, rng: np.random.Generator) -> tuple[torch.Tensor, float]:
    """Control values `(K, 6)` of an unscaled curve and the knot spacing in frame intervals."""
    spacing = float(rng.uniform(0.7, 1.3) if request.kind == "shake" else rng.uniform(2.0, 4.0))
    count = int(np.ceil(request.frames / spacing)) + 3
    pace = np.exp(rng.normal(0, 0.35, count))
    if rng.random() < 0.2:  # a pause: the hand rests for a while
        start = rng.integers(0, count)
        pace[start : start + max(1, round(2 / spacing))] *= rng.uniform(0.0, 0.15)
    progress = np.cumsum(pace)
    progress = (progress - progress[count // 2])[:, None] * spacing
    direction, axis = rng.normal(size=3), rng.normal(size=3)
    direction *= (0.25, 0.25, 1.0) if request.kind == "forward" else (1.0, 1.0, 0.3)
    axis *= (1.0, 1.0, 0.7)
    direction, axis = direction / np.linalg.norm(direction), axis / np.linalg.norm(axis)
    wobble = 3.0 if request.kind == "shake" else float(rng.uniform(0.1, 0.7))
    translation = progress * direction + wobble * spacing * 0.5 * rng.normal(size=(count, 3))
    rotation = progress * axis + wobble * spacing * 0.5 * rng.normal(size=(count, 3))
    if request.kind == "orbit":  # turn towards a point in front, so that only parallax remains
        towards = np.stack([translation[:, 1], -translation[:, 0], np.zeros(count)], 1) / depth
        rotation = towards * rng.uniform(0.6, 1.1) + 0.03 * spacing * rng.normal(size=(count, 3)) / depth
    knots = np.concatenate([translation, rotation], 1)
    return torch.from_numpy(knots.astype(np.float32)), spacing


def _mean_flow(spline: Spline, renderer: Renderer, frames: int) -> tuple[float, list[float]]:
    """Mean image motion per frame interval, and per window a bound of the image path length."""
    poses = spline.poses(torch.arange(2 * frames + 1, dtype=torch.float64) / 2)  # borders and middles of the windows
    inverse = renderer.inverse_depth(poses[:-1])
    rays = renderer.rays
    halves = induced_flow(inverse, rays.x, rays.y, poses[:-1], poses[1:], rays.focal)
    steps = torch.quantile(halves.flatten(1), 0.97, dim=1).view(frames, 2)
    bounds = (2.0 * steps.amax(1) * 1.1).tolist()
    if frames == 1:
        return float(halves.mean() * 2), bounds
    between = induced_flow(inverse[1:-1:2], rays.x, rays.y, poses[1:-2:2], poses[3::2], rays.focal)
    return float(between.mean()), bounds


def _is_free(spline: Spline, renderer: Renderer, depth: float) -> bool:
    """Whether the camera keeps its distance from every surface and always sees a surface."""
    times = torch.linspace(0, spline.duration, 33, dtype=torch.float64)
    poses = spline.poses(times)
    if float(renderer.planes.distance_to_surface(poses[None, :, :3]).min()) < CLEARANCE * depth:
        return False
    inverse = renderer.inverse_depth(poses)
    return float((inverse > 0.02 / depth).float().mean((1, 2)).min()) > 0.99
