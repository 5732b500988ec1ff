"""Random scene layouts in front of a camera at the origin that looks along +z (OpenCV axes: x right, y down)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch

from utils.simulator.scenes import UNBOUNDED, Planes


@dataclasses.dataclass
class PlaneList:
    """Collects plane pieces; `focal` (pixels) and `tile` (texels) decide how large a texture tile appears."""

    focal: float
    tile: int
    rng: np.random.Generator
    sharpness: tuple[float, float] = (0.18, 0.9)
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, np.ndarray]] = dataclasses.field(
        default_factory=list)
    names: list[str] = dataclasses.field(default_factory=list)

    def add(self, origin: np.ndarray, normal: np.ndarray, half_u: float = UNBOUNDED, half_v: float = UNBOUNDED,
            seen_from: float | None = None, spin: float | None = None, whole_tile: bool = False,
            name: str = "surface") -> None:
        """Add a piece with a random texture crop, so that a texel covers a random number of pixels at a distance.

        Args:
            origin: `(3,)` centre, scene units.
            normal: `(3,)`, any length.
            half_u: half width, scene units.
            half_v: half height, scene units.
            seen_from: distance at which the texture has its nominal size; by default the distance of `origin`.
            spin: rotation of the piece in its plane in radians; random by default.
            whole_tile: let the texture tile span the width of the piece exactly, instead of a random crop.
            name: what the piece is.
        """
        normal = np.asarray(normal, float) / np.linalg.norm(normal)
        helper = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        across = np.cross(helper, normal)
        across /= np.linalg.norm(across)
        down = np.cross(normal, across)
        angle = self.rng.uniform(0, 2 * np.pi) if spin is None else spin
        axis_u = np.cos(angle) * across + np.sin(angle) * down
        axis_v = np.cross(axis_u, normal)  # to a viewer in front, u points right and v down, as in an image
        distance = float(np.linalg.norm(origin)) if seen_from is None else seen_from
        pixels_per_texel = float(np.exp(self.rng.uniform(*np.log(self.sharpness))))
        scale = self.focal / (self.tile * pixels_per_texel * max(distance, 0.05))
        offset = self.rng.uniform(0, 2, 2)
        if whole_tile:
            scale, offset = 0.5 / half_u, np.array([0.5, 0.5])
        self.rows.append((np.asarray(origin, float), axis_u, axis_v, np.array([half_u, half_v]), scale, offset))
        self.names.append(name)

    def planes(self) -> Planes:
        """The collected pieces as one scene of float32 tensors on the CPU."""
        columns = [torch.from_numpy(np.array(column, np.float32))[None] for column in zip(*self.rows)]
        return Planes(*columns)


def tilted(rng: np.random.Generator, largest_deg: float) -> np.ndarray:
    """A unit normal that points at the camera, tilted by up to `largest_deg` in a random direction."""
    tilt, direction = np.deg2rad(rng.uniform(0, largest_deg)), rng.uniform(0, 2 * np.pi)
    return np.array([np.sin(tilt) * np.cos(direction), np.sin(tilt) * np.sin(direction), -np.cos(tilt)])


def board_layout(planes: PlaneList, half_view: tuple[float, float]) -> None:
    """One board in front of one slanted background."""
    rng = planes.rng
    distance = rng.uniform(0.8, 1.6)
    size = distance * half_view[1] * rng.uniform(0.6, 1.1)
    shift = rng.uniform(-0.25, 0.25, 2) * distance * np.array(half_view)
    planes.add(np.array([*shift, distance]), tilted(rng, 35), size * rng.uniform(1.0, 1.5), size,
               spin=rng.uniform(-0.3, 0.3))
    planes.add(np.array([0, 0, distance * rng.uniform(1.4, 3.0)]), tilted(rng, 28))


def planes_layout(planes: PlaneList, half_view: tuple[float, float]) -> None:
    """Several slanted pieces at different depths that hide one another, before a background."""
    rng = planes.rng
    back = rng.uniform(2.0, 4.5)
    planes.add(np.array([0, 0, back]), tilted(rng, 28))
    for depth in np.sort(rng.uniform(0.8, 0.9 * back, rng.integers(3, 8)))[::-1]:
        reach = 1.3 * depth * np.array(half_view)
        half = depth * rng.uniform(0.1, 0.4, 2)
        planes.add(np.array([*(rng.uniform(-1, 1, 2) * reach), depth]), tilted(rng, 50), *half)


def room_layout(planes: PlaneList, half_view: tuple[float, float]) -> None:
    """The inside of a box, turned about the vertical, with up to two free-standing panels."""
    rng = planes.rng
    _box_walls(planes, np.array([rng.uniform(1.2, 2.5), rng.uniform(0.9, 1.5), rng.uniform(1.5, 3.0)]),
               yaw=rng.uniform(-0.8, 0.8), pitch=rng.uniform(-0.2, 0.2))
    _panels(planes, half_view, int(rng.integers(0, 3)), 0.8, 1.4)


def corridor_layout(planes: PlaneList, half_view: tuple[float, float]) -> None:
    """A long box seen along its axis, with up to two panels."""
    rng = planes.rng
    _box_walls(planes, np.array([rng.uniform(0.6, 1.3), rng.uniform(0.6, 1.1), rng.uniform(5.0, 10.0)]),
               yaw=rng.uniform(-0.25, 0.25), pitch=rng.uniform(-0.12, 0.12))
    _panels(planes, half_view, int(rng.integers(0, 3)), 1.0, 3.0)


def _box_walls(planes: PlaneList, half: np.ndarray, yaw: float, pitch: float) -> None:
    rng = planes.rng
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    centre = turn @ (rng.uniform(-0.35, 0.35, 3) * half * np.array([1, 1, 0.5]))
    for axis in range(3):
        for side in (-1.0, 1.0):
            direction = turn[:, axis] * side
            planes.add(centre + direction * half[axis], -direction, spin=rng.choice(4) * np.pi / 2,
                       seen_from=max(0.6, half[axis] * 0.8))


def _panels(planes: PlaneList, half_view: tuple[float, float], count: int, near: float, far: float) -> None:
    rng = planes.rng
    for _ in range(count):
        depth = rng.uniform(near, far)
        middle = np.array([*(rng.uniform(-1, 1, 2) * depth * np.array(half_view) * 0.8), depth])
        planes.add(middle, tilted(rng, 45), *(depth * rng.uniform(0.1, 0.3, 2)))


LAYOUTS: dict[str, Callable[[PlaneList, tuple[float, float]], None]] = {
    "board": board_layout, "planes": planes_layout, "room": room_layout, "corridor": corridor_layout,
}
