"""Hand-held camera paths of any length with controlled image motion: way points, pauses, fast turns and a tremor."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import torch

from utils.simulator.renderer import Rays, Renderer
from utils.simulator.trajectory import (
    compose,
    induced_flow,
    invert,
    quaternion_multiply,
    rotation_vector_to_quaternion,
    spline_weights,
)
from utils.simulator.worlds import World


@dataclasses.dataclass(frozen=True)
class MotionPreset:
    """How a hand moves.

    Attributes:
        speed_px_s: typical mean image motion in pixels per second of a 240 pixels wide image; wider images scale it.
        variation: standard deviation of the logarithm of the speed.
        pauses_per_s: how often the hand rests.
        bursts_per_s: how often it makes a fast turn.
        tremor_px: amplitude of the tremor in pixels of a 240 pixels wide image.
    """

    speed_px_s: float
    variation: float
    pauses_per_s: float
    bursts_per_s: float
    tremor_px: float


PRESETS = {
    "slow": MotionPreset(60.0, 0.25, 0.05, 0.0, 0.15),
    "normal": MotionPreset(120.0, 0.35, 0.12, 0.08, 0.3),
    "fast": MotionPreset(240.0, 0.4, 0.08, 0.25, 0.5),
}
TREMOR_HZ = 7.0
_GRID_US = 1000.0


def spline_at(knots: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Uniform cubic B-spline through `(K, C)` control values at `(N,)` positions `0 .. K - 3`; float64 `(N, C)`."""
    first = np.clip(np.floor(position), 0, len(knots) - 4).astype(int)
    weights = spline_weights(torch.from_numpy(position - first), 4).numpy()
    return np.einsum("nk,nkc->nc", weights, knots[first[:, None] + np.arange(4)])


def way_point_poses(values: np.ndarray) -> torch.Tensor:
    """Camera-to-world poses `(N, 7)` float64 from `(N, 6)` position, yaw (to the right), pitch (up) and roll."""
    angles = torch.from_numpy(values[:, 3:])
    zero = torch.zeros_like(angles[:, 0])
    yaw = rotation_vector_to_quaternion(torch.stack([zero, angles[:, 0], zero], -1))
    pitch = rotation_vector_to_quaternion(torch.stack([angles[:, 1], zero, zero], -1))
    roll = rotation_vector_to_quaternion(torch.stack([zero, zero, angles[:, 2]], -1))
    turn = quaternion_multiply(quaternion_multiply(yaw, pitch), roll)
    return torch.cat([torch.from_numpy(values[:, :3]), turn], -1)


class HandheldPath:
    """A camera path through a world: `poses(t_us)` for `0 <= t_us <= duration_us`.

    The path in space is a spline through the way points of the world; how fast it is travelled follows from the wanted
    image motion, so rotation near a far wall and translation near a close one look equally fast.

    Args:
        world: scene and way points.
        rays: camera; its focal length and width scale the image motion.
        duration_us: microseconds.
        preset: how the hand moves.
        rng: decides path, pace and tremor.
    """

    def __init__(self, world: World, rays: Rays, duration_us: float, preset: MotionPreset,
                 rng: np.random.Generator) -> None:
        self.duration_us = duration_us
        scale = rays.size[1] / 240.0
        self._renderer = Renderer(world.planes, torch.zeros(1, 1, 0, 0), rays.coarse(max(2, min(rays.size) // 10)))
        grid = np.arange(0, duration_us + 2 * _GRID_US, _GRID_US)
        speed = preset.speed_px_s * scale * _pace(grid * 1e-6, preset, rng)
        self._knots, self._progress = self._travel(world, speed * _GRID_US * 1e-6, rng)
        tremors = rng.normal(size=(int(np.ceil(duration_us * 1e-6 * TREMOR_HZ)) + 5, 6))
        angle = preset.tremor_px * scale / rays.focal
        self._tremor = tremors * np.array([0.3 * angle] * 3 + [angle] * 3)

    def _travel(self, world: World, motion_px: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw way points until all the image motion `(G,)` of the grid is spent; progress of each grid time."""
        wanted = np.concatenate([[0.0], np.cumsum(motion_px)])[:-1]
        source = world.way_points(rng)
        knots = list(itertools.islice(source, 4))
        pieces, spent, per_knot = [np.zeros(1)], 0.0, 16
        between = np.arange(per_knot + 1) / per_knot
        while spent < wanted[-1]:
            poses = way_point_poses(spline_at(np.array(knots[-4:]), between)).float()
            pieces.append(spent + np.cumsum(self._effort(poses)))
            spent = float(pieces[-1][-1])
            knots.append(next(source))
        travelled = np.concatenate(pieces)
        return np.array(knots), np.interp(wanted, travelled, np.arange(len(travelled)) / per_knot)

    def _effort(self, poses: torch.Tensor) -> np.ndarray:
        """Mean image motion in pixels between successive poses, but at least a third of what turning plus moving could
        cause: where the two cancel, a hand does not become arbitrarily fast.
        """
        flow = self._flow(poses[:-1], poses[1:]).mean((1, 2))
        moved = (poses[1:, :3] - poses[:-1, :3]).norm(dim=-1)
        between = compose(invert(poses[:-1]), poses[1:])
        turned = 2 * between[:, 3:6].norm(dim=-1)
        nearness = self._renderer.inverse_depth(poses[:-1]).mean((1, 2))
        alone = self._renderer.rays.focal * (turned + moved * nearness)
        return torch.maximum(flow, 0.35 * alone).clamp(min=1e-6).double().numpy()

    def _flow(self, poses: torch.Tensor, later: torch.Tensor) -> torch.Tensor:
        rays = self._renderer.rays
        return induced_flow(self._renderer.inverse_depth(poses), rays.x, rays.y, poses, later, rays.focal)

    def poses(self, t_us: np.ndarray | torch.Tensor) -> torch.Tensor:
        """Camera-to-world poses `(N, 7)` float64 at `(N,)` times in microseconds."""
        times = np.asarray(t_us, float)
        grid = np.arange(len(self._progress)) * _GRID_US
        values = spline_at(self._knots, _smooth_interpolation(times, grid, self._progress))
        tremor = torch.from_numpy(spline_at(self._tremor, times * 1e-6 * TREMOR_HZ))
        local = torch.cat([tremor[:, :3], rotation_vector_to_quaternion(tremor[:, 3:])], -1)
        return compose(way_point_poses(values), local)

    def render_times(self, largest_step_px: float, longest_us: float = 10_000.0) -> np.ndarray:
        """Times in microseconds, from 0 to the end, between which no pixel moves further than the given distance."""
        grid = np.append(np.arange(0, self.duration_us, 5 * _GRID_US), self.duration_us)
        poses = self.poses(grid).float()
        moved = self._flow(poses[:-1], poses[1:]).flatten(1).amax(1).double().numpy() * 1.15
        counts = np.maximum(np.ceil(moved / largest_step_px), np.ceil(np.diff(grid) / longest_us)).astype(int)
        pieces = [start + np.arange(count) * (stop - start) / count
                  for start, stop, count in zip(grid[:-1], grid[1:], np.maximum(counts, 1))]
        return np.append(np.concatenate(pieces), self.duration_us)

    def mean_flow_px_s(self) -> float:
        """Mean image motion in pixels per second, over the image and the recording."""
        times = np.arange(0, self.duration_us - 10_000.0, 50_000.0)
        if not len(times):
            return 0.0
        moved = self._flow(self.poses(times).float(), self.poses(times + 10_000.0).float())
        return float(moved.mean()) * 100.0


def _smooth_interpolation(times: np.ndarray, grid: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Catmull-Rom interpolation on a uniform grid, so that the speed has no steps."""
    position = np.clip(times / (grid[1] - grid[0]), 0, len(values) - 1)
    cell = np.minimum(np.floor(position).astype(int), len(values) - 2)
    u = position - cell
    before, a, b, after = (values[np.clip(cell + k, 0, len(values) - 1)] for k in (-1, 0, 1, 2))
    return a + 0.5 * u * (b - before + u * (2 * before - 5 * a + 4 * b - after + u * (3 * (a - b) + after - before)))


def _pace(seconds: np.ndarray, preset: MotionPreset, rng: np.random.Generator) -> np.ndarray:
    """Smooth positive factor on the speed over time, with rests and bursts."""
    knots = rng.normal(0, preset.variation * 1.5, (int(np.ceil(seconds[-1] * 1.5)) + 5, 1))
    pace = np.exp(spline_at(knots, seconds * 1.5)[:, 0])
    for rate, level, length in ((preset.pauses_per_s, 0.04, (0.3, 0.8)), (preset.bursts_per_s, 2.2, (0.25, 0.5))):
        for _ in range(rng.poisson(rate * seconds[-1])):
            middle, width = rng.uniform(0, seconds[-1]), rng.uniform(*length)
            bump = np.exp(-(((seconds - middle) / (0.5 * width)) ** 4))
            pace *= 1 + (level - 1) * bump
    return pace
