"""Procedural surface textures: reflectance maps with the edges, scales and contrasts of real surfaces."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from devo.errors import InputError

FloatImage = np.ndarray
Canvas = np.ndarray
LOG_FLOOR = 0.04
"""Reflectance added before the logarithm, so that black paper is black and not minus infinity."""

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ0123456789#&%@?+=*"
_SHIFT = 4  # cv2 draws with 1/16 pixel coordinates, which together with LINE_AA keeps edges smooth
# shapes are drawn into 8-bit canvases because cv2 smooths edges only there


def value_noise(size: int, rng: np.random.Generator, *, coarsest: int = 3, octaves: int = 6,
                persistence: float = 0.55) -> FloatImage:
    """Multi-octave smooth noise `(size, size)` float32 in 0..1."""
    total = np.zeros((size, size), np.float32)
    for octave in range(octaves):
        cells = coarsest * 2**octave
        if cells > size:
            break
        grid = rng.random((cells + 3, cells + 3), dtype=np.float32)
        wide = int(np.ceil(size * (cells + 3) / cells))
        total += persistence**octave * cv2.resize(grid, (wide, wide), interpolation=cv2.INTER_CUBIC)[:size, :size]
    return _stretch(total)


def _stretch(image: FloatImage) -> FloatImage:
    low, high = np.quantile(image, (0.01, 0.99))
    return np.clip((image - low) / max(high - low, 1e-6), 0.0, 1.0).astype(np.float32)


def _canvas(image: FloatImage) -> Canvas:
    return np.ascontiguousarray(np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8))


def _paper(size: int, grey: float) -> Canvas:
    return np.full((size, size), round(255 * grey), np.uint8)


def _reflectance(canvas: Canvas) -> FloatImage:
    return canvas.astype(np.float32) / 255.0


def _points(array: np.ndarray) -> np.ndarray:
    return np.round(np.asarray(array) * 2**_SHIFT).astype(np.int32)


def noise(size: int, rng: np.random.Generator) -> FloatImage:
    """Cloudy or patchy noise; half of the draws are cut into few grey levels, which gives sharp organic edges."""
    image = value_noise(size, rng, coarsest=int(rng.integers(2, 10)), persistence=rng.uniform(0.4, 0.8))
    if rng.random() < 0.6:
        levels = rng.integers(2, 6)
        flat = rng.random(levels + 1)[np.minimum((image * levels).astype(int), levels)]
        image = (0.8 * flat + 0.2 * image).astype(np.float32)
    return image


def dead_leaves(size: int, rng: np.random.Generator) -> FloatImage:
    """Occluding discs, boxes and ellipses with power-law sizes (the dead-leaves model of natural images)."""
    image = _paper(size, rng.random())
    count = int(rng.integers(150, 700))
    radii = np.sort(size * 0.012 / np.sqrt(rng.uniform(0.003, 1.0, count)))[::-1]
    shape = rng.integers(0, 3)
    for radius in radii:
        centre, grey = rng.uniform(0, size, 2), 255.0 * rng.beta(0.7, 0.7)
        angle, ratio = rng.uniform(0, 360), rng.uniform(0.3, 1.0)
        if shape == 0 or (shape == 2 and rng.random() < 0.5):
            axes = tuple(int(v) for v in _points(np.array([radius, radius * ratio])))
            middle = tuple(int(v) for v in _points(centre))
            cv2.ellipse(image, middle, axes, angle, 0, 360, grey, -1, cv2.LINE_AA, _SHIFT)
        else:
            box = cv2.boxPoints(((float(centre[0]), float(centre[1])), (2 * radius, 2 * radius * ratio), angle))
            cv2.fillConvexPoly(image, _points(box), grey, cv2.LINE_AA, _SHIFT)
    return _reflectance(image)


def polygons(size: int, rng: np.random.Generator) -> FloatImage:
    """Random star-shaped polygons on a plain or shaded ground."""
    image = _canvas(value_noise(size, rng, coarsest=2, octaves=2) * 0.4 + rng.random() * 0.6)
    for _ in range(int(rng.integers(12, 80))):
        corners = int(rng.integers(3, 8))
        angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
        radius = size * rng.uniform(0.03, 0.2) * rng.uniform(0.5, 1.0, corners)
        ring = np.stack([np.cos(angles), np.sin(angles)], 1) * radius[:, None] + rng.uniform(0, size, 2)
        cv2.fillPoly(image, [_points(ring)], 255.0 * rng.random(), cv2.LINE_AA, _SHIFT)
    return _reflectance(image)


def checker(size: int, rng: np.random.Generator) -> FloatImage:
    """A rotated grid of cells: two-coloured, or one random grey per cell, with optional joints."""
    cell = size * rng.uniform(0.03, 0.16)
    angle = rng.uniform(0, np.pi)
    rows, columns = np.mgrid[0:size, 0:size].astype(np.float32)
    along = (columns * np.cos(angle) + rows * np.sin(angle)) / cell + 100
    across = (rows * np.cos(angle) - columns * np.sin(angle)) / (cell * rng.uniform(0.4, 1.0)) + 100
    if rng.random() < 0.4:  # bricks: every second row is moved by half a cell
        along = along + 0.5 * (np.floor(across) % 2)
    i, j = np.floor(along).astype(int), np.floor(across).astype(int)
    if rng.random() < 0.4:
        dark, bright = rng.uniform(0, 0.4), rng.uniform(0.5, 1.0)
        image = np.where((i + j) % 2 == 0, dark, bright)
    else:
        image = rng.beta(0.8, 0.8, (512, 512))[i % 512, j % 512]
    if rng.random() < 0.4:
        joint = np.minimum(np.abs(along - np.round(along)), np.abs(across - np.round(across))) < rng.uniform(0.03, 0.1)
        image = np.where(joint, rng.random(), image)
    return cv2.GaussianBlur(image.astype(np.float32), (3, 3), 0.6)


def stripes(size: int, rng: np.random.Generator) -> FloatImage:
    """Lines of random direction, width and grey over a smooth gradient."""
    image = _canvas(value_noise(size, rng, coarsest=2, octaves=2))
    for _ in range(int(rng.integers(15, 90))):
        centre, angle = rng.uniform(0, size, 2), rng.uniform(0, np.pi)
        reach = size * rng.uniform(0.1, 1.0) * np.array([np.cos(angle), np.sin(angle)])
        ends = _points(np.stack([centre - reach, centre + reach]))
        cv2.line(image, tuple(map(int, ends[0])), tuple(map(int, ends[1])), 255.0 * rng.random(),
                 int(rng.integers(1, max(2, size // 50))), cv2.LINE_AA, _SHIFT)
    return _reflectance(image)


def printed_text(size: int, rng: np.random.Generator) -> FloatImage:
    """Lines of letters and digits in several sizes, dark on light or light on dark."""
    canvas = _canvas(1.0 - 0.15 * value_noise(size, rng, octaves=3))
    row = 0.0
    while row < size:
        height = size * rng.uniform(0.03, 0.16)
        scale, font = height / 22.0, int(rng.choice(_FONTS))
        text = "".join(rng.choice(list(_LETTERS), int(rng.integers(8, 40))))
        cv2.putText(canvas, text, (int(-rng.uniform(0, height)), int(row + height)), font, scale,
                    255.0 * rng.uniform(0, 0.5), max(1, int(height / rng.uniform(6, 12))), cv2.LINE_AA)
        row += height * rng.uniform(1.15, 2.0)
    image = np.rot90(_reflectance(canvas), int(rng.integers(0, 4)))
    return np.ascontiguousarray(1.0 - image if rng.random() < 0.3 else image)


def printed_shapes(size: int, rng: np.random.Generator) -> FloatImage:
    """Single dark or light symbols spread over a plain sheet: a poster, a calibration target."""
    canvas = _paper(size, rng.uniform(0.6, 1.0))
    cells = int(rng.integers(3, 8))
    step = size / cells
    for row in range(cells):
        for column in range(cells):
            centre = (np.array([column, row]) + 0.5 + rng.uniform(-0.12, 0.12, 2)) * step
            draw_symbol(canvas, str(rng.choice(SYMBOLS)), centre, step * rng.uniform(0.2, 0.42),
                        float(rng.uniform(0, 0.4)), rng.uniform(0, 360))
    image = _reflectance(canvas)
    return 1.0 - image if rng.random() < 0.25 else image


SYMBOLS = ("diamond", "square", "circle", "cross", "ring", "triangle", "star", "letter")


def draw_symbol(canvas: Canvas, name: str, centre: np.ndarray, radius: float, grey: float, angle: float = 0.0,
                letter: str = "R") -> None:
    """Draw one filled symbol into `canvas` (uint8, in place).

    Args:
        canvas: `(H, W)` uint8.
        name: one of `SYMBOLS`.
        centre: `(2,)` x and y in pixels.
        radius: pixels.
        grey: 0..1.
        angle: degrees; circles, rings and letters stay upright.
        letter: what a `letter` shows.

    Raises:
        ValueError: `name` is no symbol.
    """
    tone = 255.0 * grey
    turn = np.deg2rad(angle)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def fill(ring: list[tuple[float, float]]) -> None:
        cv2.fillPoly(canvas, [_points(np.array(ring) * radius @ rotation.T + centre)], tone, cv2.LINE_AA, _SHIFT)

    middle = tuple(int(v) for v in _points(centre))
    if name == "diamond":
        fill([(0, -1), (0.7, 0), (0, 1), (-0.7, 0)])
    elif name == "square":
        fill([(-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, 0.8)])
    elif name == "triangle":
        fill([(0, -1), (0.87, 0.6), (-0.87, 0.6)])
    elif name == "star":
        spokes = np.arange(10) * np.pi / 5
        reach = np.where(np.arange(10) % 2 == 0, 1.0, 0.42)
        fill([(float(r * np.sin(a)), float(-r * np.cos(a))) for r, a in zip(reach, spokes)])
    elif name == "cross":
        fill([(-1, -0.28), (1, -0.28), (1, 0.28), (-1, 0.28)])
        fill([(-0.28, -1), (0.28, -1), (0.28, 1), (-0.28, 1)])
    elif name == "circle":
        cv2.circle(canvas, middle, int(0.85 * radius * 2**_SHIFT), tone, -1, cv2.LINE_AA, _SHIFT)
    elif name == "ring":
        cv2.circle(canvas, middle, int(0.75 * radius * 2**_SHIFT), tone, max(1, int(0.3 * radius)), cv2.LINE_AA, _SHIFT)
    elif name == "letter":
        _draw_letter(canvas, letter, centre, radius, tone)
    else:
        raise ValueError(f"symbol {name!r} is unknown, expected one of {', '.join(SYMBOLS)}")


def _draw_letter(canvas: Canvas, letter: str, centre: np.ndarray, radius: float, tone: float) -> None:
    thickness = max(1, round(radius * 0.32))
    scale = radius / 11.5
    (width, height), _ = cv2.getTextSize(letter, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    corner = (int(centre[0] - width / 2), int(centre[1] + height / 2))
    cv2.putText(canvas, letter, corner, cv2.FONT_HERSHEY_SIMPLEX, scale, tone, thickness, cv2.LINE_AA)


KINDS: dict[str, Callable[[int, np.random.Generator], FloatImage]] = {
    "noise": noise, "dead_leaves": dead_leaves, "polygons": polygons, "checker": checker,
    "stripes": stripes, "text": printed_text, "shapes": printed_shapes,
}


def random_texture(size: int, rng: np.random.Generator, kind: str | None = None) -> FloatImage:
    """One reflectance map `(size, size)` float32 in 0..1 of a named or random kind, with grain and uneven light."""
    name = kind or str(rng.choice(list(KINDS), p=(0.16, 0.22, 0.16, 0.12, 0.1, 0.12, 0.12)))
    image = KINDS[name](size, rng)
    if rng.random() < 0.6:
        image = image + rng.uniform(0.02, 0.25) * (value_noise(size, rng, coarsest=16, octaves=4) - 0.5)
    shade = 1.0 - rng.uniform(0, 0.5) * value_noise(size, rng, coarsest=1, octaves=2)
    return np.clip(image * shade, 0.0, 1.0).astype(np.float32)


def image_textures(folder: Path, count: int, size: int, rng: np.random.Generator) -> list[FloatImage]:
    """Reflectance maps `(size, size)` float32 in 0..1 cut at random out of the images of a folder.

    Images are taken in random order, each once before any is taken again; grey values count as reflectance.

    Args:
        folder: images that OpenCV reads; other files are passed over by their ending.
        count: number of maps.
        size: texels per side.
        rng: decides order and crops.

    Raises:
        InputError: no image in the folder, or one that cannot be read.
    """
    from utils.datasets.files import IMAGE_SUFFIXES  # the package reads all data sets, training does not need it

    files = folder.iterdir() if folder.is_dir() else ()
    paths = sorted(path for path in files if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise InputError(f"{folder}: no images for textures, expected a folder with {', '.join(IMAGE_SUFFIXES)}")
    order = np.concatenate([rng.permutation(len(paths)) for _ in range(-(-count // len(paths)))])[:count]
    return [_square_crop(paths[index], size, rng) for index in order]


def _square_crop(path: Path, size: int, rng: np.random.Generator) -> FloatImage:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(f"cannot read texture {path}: the file is damaged or no image")
    side = int(min(image.shape) * rng.uniform(0.6, 1.0))
    top, left = (int(rng.integers(0, length - side + 1)) for length in image.shape)
    crop = image[top : top + side, left : left + side]
    method = cv2.INTER_AREA if side > size else cv2.INTER_CUBIC
    return np.clip(cv2.resize(crop, (size, size), interpolation=method).astype(np.float32) / 255.0, 0.0, 1.0)


def log_reflectance(image: FloatImage) -> FloatImage:
    """Natural logarithm of a 0..1 reflectance map, floored so that the darkest print stays about 1:25."""
    return np.log(LOG_FLOOR + (1.0 - LOG_FLOOR) * image).astype(np.float32)


@functools.lru_cache(maxsize=2)
def texture_bank(count: int, size: int, seed: int) -> torch.Tensor:
    """A bank of random textures `(count, size, size)` float32 in log reflectance; the same arguments, the same bank.

    The result is shared between callers and must not be written to.
    """
    rng = np.random.default_rng(seed)
    kinds = list(KINDS)
    images = [log_reflectance(random_texture(size, rng, kinds[i] if i < len(kinds) else None)) for i in range(count)]
    return torch.from_numpy(np.stack(images))


def build_atlas(tiles: torch.Tensor) -> torch.Tensor:
    """Stack log-reflectance tiles and their mip levels into one image that `grid_sample` can read.

    Each tile is one row of levels, largest first, each with a border of one replicated texel, so that bilinear
    look-ups of mirrored coordinates never mix neighbours. Averaging happens in linear reflectance.

    Args:
        tiles: `(P, T, T)` float32 log reflectance, T a power of two.

    Returns:
        `(1, 1, P * (T + 2), width)` float32; level l of tile p starts at row `p (T + 2)`, column `2T - 2T / 2^l + 2l`.
    """
    count, size, _ = tiles.shape
    levels = mip_levels(size)
    atlas = tiles.new_zeros(1, 1, count * (size + 2), 2 * size + 2 * levels)
    rows = atlas[0, 0].view(count, size + 2, -1)
    image, column = tiles[:, None], 0
    for level in range(levels):
        side = size >> level
        bordered = torch.nn.functional.pad(image, (1, 1, 1, 1), "replicate")
        rows[:, : side + 2, column : column + side + 2] = bordered[:, 0]
        column += side + 2
        if level + 1 < levels:
            image = torch.nn.functional.avg_pool2d(image.exp(), 2).log()
    return atlas


def mip_levels(size: int) -> int:
    """Number of mip levels of a tile of `size` texels, a power of two: down to a single texel."""
    return size.bit_length()
