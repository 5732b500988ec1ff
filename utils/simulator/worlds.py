"""The scenes of simulated recordings, in metres, and the paths on which a hand could carry a camera through them.

The world frame has OpenCV axes (x right, y down, z forward); the camera moves around the origin and looks towards +z.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from utils.simulator.layouts import PlaneList, tilted
from utils.simulator.scenes import Planes
from utils.simulator.textures import (
    SYMBOLS,
    draw_symbol,
    image_textures,
    log_reflectance,
    random_texture,
    value_noise,
)

BOARD_TILE = 2048
SURFACE_TILE = 512
UNIQUE_SURFACES = 16
EMPTY_GREY = 0.35
WayPoints = Callable[[np.random.Generator], Iterator[np.ndarray]]
"""Draws endless way points `(6,)`: position in metres, then yaw (right), pitch (up) and roll in radians."""


@dataclasses.dataclass(frozen=True)
class World:
    """A scene with its textures and the region of the camera.

    Attributes:
        kind: `board`, `room`, `planes` or `corridor`.
        planes: one scene, metres.
        names: what each of the P pieces is.
        draw_tiles: paints the textures, `(P, T, T)` float32 log reflectance; the same each time.
        way_points: where a hand could carry the camera.
        empty: log intensity where nothing is hit.
    """

    kind: str
    planes: Planes
    names: list[str]
    draw_tiles: Callable[[], torch.Tensor]
    way_points: WayPoints
    empty: float = float(np.log(EMPTY_GREY))


def build_world(kind: str, focal: float, seed: int, background: bool = False, textures: Path | None = None) -> World:
    """Build a world; the same arguments, the same world.

    Args:
        kind: one of `WORLDS`.
        focal: focal length in pixels; textures get a detail that suits it.
        seed: decides geometry, textures and way points.
        background: put a slanted textured plane behind the board (other scenes are closed anyway).
        textures: folder of images that cover the surfaces instead of procedural textures; the board shows one of them.

    Raises:
        InputError: a folder of textures without usable images (when the tiles are drawn).
    """
    rng = np.random.default_rng([seed, list(WORLDS).index(kind)])
    if kind == "board":
        return _board_world(focal, seed, rng, background, textures)
    collected = PlaneList(focal, SURFACE_TILE, rng, sharpness=(0.2, 0.5))
    way_points = WORLDS[kind](collected)
    tile_seed = [seed, list(WORLDS).index(kind), 1]
    return World(kind, collected.planes(), collected.names,
                 lambda: _surfaces(len(collected.names), tile_seed, textures), way_points)


def _surfaces(count: int, seed: list[int], textures: Path | None) -> torch.Tensor:
    """Tiles `(count, T, T)` of at most `UNIQUE_SURFACES` patterns, each piece with its own contrast and brightness."""
    rng = np.random.default_rng(seed)
    patterns = [log_reflectance(image) for image in _paint(min(count, UNIQUE_SURFACES), SURFACE_TILE, rng, textures)]
    picks = np.concatenate([rng.permutation(len(patterns)) for _ in range(-(-count // len(patterns)))])[:count]
    tiles = [patterns[pick] * rng.uniform(0.5, 1.0) + rng.normal(0, 0.2) for pick in picks]
    return torch.from_numpy(np.stack(tiles).astype(np.float32))


def _paint(count: int, size: int, rng: np.random.Generator, textures: Path | None) -> list[np.ndarray]:
    if textures is not None:
        return image_textures(textures, count, size, rng)
    return [random_texture(size, rng) for _ in range(count)]


def _board_world(
    focal: float, seed: int, rng: np.random.Generator, background: bool, textures: Path | None
) -> World:
    collected = PlaneList(focal, BOARD_TILE, rng, sharpness=(0.05, 0.12))
    distance, half_width, half_height = 0.9, 0.8, 0.6
    collected.add(np.array([0, 0, distance]), tilted(rng, 12), half_width, half_height, spin=_upright(rng),
                  whole_tile=True, name="board")
    if background:
        collected.add(np.array([0, 0, distance + rng.uniform(0.7, 1.2)]), tilted(rng, 20), name="background")

    def draw_tiles() -> torch.Tensor:
        painter = np.random.default_rng([seed, 1])
        images = [] if textures else [printed_board(BOARD_TILE, half_height / half_width, painter)]
        images += _paint(1 + background - len(images), BOARD_TILE, painter, textures)
        return torch.from_numpy(np.stack([log_reflectance(image) for image in images]))

    way_points = _wander((0.30, 0.22, 0.22), (0, 0, distance), (0.3, 0.2, 0.0))
    return World("board", collected.planes(), collected.names, draw_tiles, way_points)


def _upright(rng: np.random.Generator) -> float:
    return float(np.pi + rng.uniform(-0.1, 0.1))  # the first axis of a piece that faces the camera points to the left


def printed_board(size: int, aspect: float, rng: np.random.Generator) -> np.ndarray:
    """Reflectance `(size, size)` of a printed calibration board that fills the full width and the middle rows.

    Args:
        size: texels.
        aspect: height over width of the board.
        rng: decides letters, order and small variations.
    """
    paper = 0.86 - 0.04 * value_noise(size, rng, coarsest=4, octaves=3)
    canvas = np.round(paper * 255).astype(np.uint8)
    columns, rows = 8, 6
    cell = size / columns
    top = 0.5 * size * (1 - aspect)
    names = [name for name in SYMBOLS if name != "letter"]
    letters = list(rng.permutation(list("ABEFGHKMNPRSTXYZ2357")))
    order: list[str] = []
    while len(order) < columns * rows:
        order += list(rng.permutation([*names, "letter", "letter"]))
    for row in range(rows):
        for column in range(columns):
            centre = np.array([(column + 0.5) * cell, top + (row + 0.5) * cell]) + rng.uniform(-0.06, 0.06, 2) * cell
            name = order[row * columns + column]
            angle = float(rng.choice((0.0, 0.0, 0.0, 30.0, 45.0))) if name in ("square", "triangle", "cross") else 0.0
            letter = letters[(row * columns + column) % len(letters)]
            draw_symbol(canvas, name, centre, cell * rng.uniform(0.24, 0.34), 0.06, angle, letter)
    _print_marks(canvas, cell, top, columns, rows)
    edge = round(0.012 * size)
    cv2.rectangle(canvas, (edge, round(top) + edge), (size - 1 - edge, round(size - top) - 1 - edge), 15,
                  max(2, round(0.006 * size)), cv2.LINE_AA)
    return cv2.GaussianBlur(canvas, (0, 0), 0.8).astype(np.float32) / 255.0


def _print_marks(canvas: np.ndarray, cell: float, top: float, columns: int, rows: int) -> None:
    """Small registration marks where four cells meet: dots, plus signs and tiny squares in turn."""
    for row in range(1, rows):
        for column in range(1, columns):
            centre = np.array([column * cell, top + row * cell])
            draw_symbol(canvas, ("circle", "cross", "square")[(row + column) % 3], centre, 0.06 * cell, 0.1)


def _wander(region: tuple[float, float, float], target: tuple[float, float, float],
            spread: tuple[float, float, float], roll: float = 0.07) -> WayPoints:
    """Way points inside a box around the origin, each looking at a random point around a target."""

    def draw(rng: np.random.Generator) -> Iterator[np.ndarray]:
        while True:
            position = rng.uniform(-1, 1, 3) * region * 1.3  # the spline stays well inside its way points
            towards = np.array(target) + rng.uniform(-1, 1, 3) * spread - position
            yield _look(position, towards, rng.uniform(-roll, roll))

    return draw


def _look(position: np.ndarray, towards: np.ndarray, roll: float) -> np.ndarray:
    yaw = np.arctan2(towards[0], towards[2])
    pitch = -np.arctan2(towards[1], np.hypot(towards[0], towards[2]))
    return np.array([*position, yaw, pitch, roll])


def _planes_world(planes: PlaneList) -> WayPoints:
    rng = planes.rng
    planes.add(np.array([0, 0, rng.uniform(3.2, 4.2)]), tilted(rng, 18), name="background")
    for number, depth in enumerate(np.sort(rng.uniform(1.2, 3.0, int(rng.integers(6, 10))))[::-1]):
        middle = np.array([*(rng.uniform(-0.75, 0.75, 2) * depth * (1.0, 0.75)), depth])
        half_u, half_v = depth * rng.uniform(0.1, 0.22, 2)
        planes.add(middle, tilted(rng, 40), half_u, half_v, name=f"panel {number}")
    return _wander((0.45, 0.3, 0.3), (0, 0, 2.4), (0.5, 0.35, 0.2))


def _room_world(planes: PlaneList) -> WayPoints:
    rng = planes.rng
    half = np.array([rng.uniform(2.2, 2.8), rng.uniform(1.2, 1.5), rng.uniform(2.2, 2.8)])
    _add_walls(planes, half, None)
    for number, angle in enumerate(np.linspace(-1.1, 1.1, 4) + rng.uniform(-0.15, 0.15, 4)):
        distance = rng.uniform(1.5, 1.9)
        size = np.array([rng.uniform(0.18, 0.35), rng.uniform(0.3, 0.75), rng.uniform(0.18, 0.35)])
        centre = np.array([np.sin(angle) * distance, half[1] - size[1], np.cos(angle) * distance])
        _add_box(planes, centre, size, rng.uniform(0, np.pi), f"box {number}")
    return _wander((0.45, 0.25, 0.45), (0, 0.25, 2.2), (1.8, 0.5, 0.2))


def _corridor_world(planes: PlaneList) -> WayPoints:
    rng = planes.rng
    half = np.array([rng.uniform(0.9, 1.2), rng.uniform(0.9, 1.1), 12.0])
    _add_walls(planes, half, 1.5)
    for number, depth in enumerate(np.arange(-8.0, 11.0, 2.5) + rng.uniform(-0.6, 0.6, 8)):
        size = np.array([rng.uniform(0.12, 0.22), rng.uniform(0.2, 0.6), rng.uniform(0.12, 0.3)])
        side = float(rng.choice((-1.0, 1.0)))
        _add_box(planes, np.array([side * (half[0] - size[0]), half[1] - size[1], depth]), size, 0.0, f"box {number}")

    def draw(generator: np.random.Generator) -> Iterator[np.ndarray]:
        advance = 0.0
        for _ in itertools.count():
            advance += generator.uniform(0.15, 0.45)
            depth = 8.0 - abs(advance % 32.0 - 16.0)  # forth and back between -8 and 8 metres
            position = np.array([generator.uniform(-0.25, 0.25), generator.uniform(-0.3, 0.2), depth])
            towards = np.array([generator.uniform(-0.5, 0.5), generator.uniform(-0.3, 0.4), 2.0])
            yield _look(position, towards, generator.uniform(-0.1, 0.1))

    return draw


def _add_walls(planes: PlaneList, half: np.ndarray, seen_from: float | None) -> None:
    """The six inner sides of a box around the origin."""
    for axis, names in enumerate((("left wall", "right wall"), ("ceiling", "floor"), ("back wall", "front wall"))):
        for side, name in zip((-1.0, 1.0), names):
            direction = np.eye(3)[axis] * side
            planes.add(direction * half[axis], -direction, spin=float(planes.rng.choice(4)) * np.pi / 2,
                       seen_from=seen_from, name=name)


def _add_box(planes: PlaneList, centre: np.ndarray, half: np.ndarray, yaw: float, name: str) -> None:
    """Four sides and the top of a box that stands on the floor (y points down)."""
    along = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    across = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    for direction, reach, width in ((along, half[0], half[2]), (across, half[2], half[0])):
        for side in (-1.0, 1.0):
            planes.add(centre + side * reach * direction, side * direction, width, half[1], spin=0.0,
                       name=f"{name} side")
    planes.add(centre - np.array([0, half[1], 0]), np.array([0.0, -1.0, 0.0]), half[0], half[2],
               spin=np.pi / 2 - yaw, name=f"{name} top")


WORLDS: dict[str, Callable[[PlaneList], WayPoints]] = {
    "board": lambda planes: _wander((0, 0, 0), (0, 0, 1), (0, 0, 0)),
    "room": _room_world, "planes": _planes_world, "corridor": _corridor_world,
}
