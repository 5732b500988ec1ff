"""Where patches are taken: the learned scorer, the event gradient map and the selection rules on score maps."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from devo.config import PIXELS
from devo.device import random_home
from devo.errors import InputError
from devo.extractor import channels_last_frames

GRID = 2
KERNEL_SIZE = 4
NMS_RADIUS = 1.5
NMS_IOU = 0.4
EPSILON = 1e-7
METHODS = ("multi", "topk", "nms", "3xrandom", "random")


class Scorer(nn.Module):
    """Small convolutional network that rates how well each quarter-resolution pixel would be tracked.

    Score cell s covers full-resolution pixels 4s+4..4s+7, which is quarter-resolution pixel s+1.
    """

    def __init__(self, bins: int = 5) -> None:
        super().__init__()
        self.scorer = nn.Sequential(
            nn.Conv2d(bins, 8, 3),
            nn.ReLU(inplace=True),
            nn.Conv2d(8, 16, 3),
            nn.ReLU(inplace=True),
            nn.Conv2d(16, 32, 3),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, 1, 3),
            nn.MaxPool2d(4, 4),
        )
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Tensor) -> Tensor:
        """Map `(B, n, bins, H, W)` to logits `(B, n, (H-8)//4, (W-8)//4)`; the sigmoid is left to the caller."""
        return self.rate(channels_last_frames(images)).unflatten(0, images.shape[:2])

    def rate(self, frames: Tensor) -> Tensor:
        """Map frames `(N, bins, H, W)`, channels last in memory, to logits `(N, (H-8)//4, (W-8)//4)`."""
        return self.scorer(frames)[:, 0]


def event_gradient(images: Tensor) -> Tensor:
    """Magnitude of the spatial gradient of the channel sum, averaged over 4x4 cells.

    Args:
        images: `(N, C, H, W)`.

    Returns:
        `(N, (H-1)//4, (W-1)//4)`; cell s covers full-resolution pixels 4s..4s+3, quarter-resolution pixel s.
    """
    total = images.float().sum(dim=1)
    dx = total[..., :-1, 1:] - total[..., :-1, :-1]
    dy = total[..., 1:, :-1] - total[..., :-1, :-1]
    return functional.avg_pool2d(torch.hypot(dx, dy), 4, 4)


class PatchSelector:
    """Draws patch positions from score maps; on maps with fewer cells than patches the cells take turns again.

    Methods: `multi` (multinomial over the 4x4 cells, then one of the 16 pixels of a cell; at most one patch per cell),
    `topk` (best cells by their maximum), `nms` (the same after non-maximum suppression of touching maxima),
    `3xrandom` (best third of uniform candidates, ascending), `random` (uniform).

    With `grid` the map is split into 2x2 quadrants which take turns (top-left, top-right, bottom-left, bottom-right):
    patch r*4+q is the r-th pick of quadrant q. When the number of patches is no multiple of 4, the remainder goes
    to the first quadrants of that order.

    Args:
        method: one of `METHODS`.
        grid: pick from the four quadrants evenly.
        pixel: `multi` only, how the pixel of a cell is chosen. `shifted`, as published: drawn with the score of its
            upper left neighbour as the weight; `drawn`: with its own score; `best`: the one with the highest score,
            which puts patches onto edges and clouds onto what is drawn in the scene.
    """

    def __init__(self, method: str = "multi", grid: bool = False, pixel: str = "shifted") -> None:
        method = method.lower()
        if method not in METHODS:
            raise InputError(f"unknown patch selection method {method!r}; expected one of {', '.join(METHODS)}")
        if pixel not in PIXELS:
            raise InputError(f"unknown choice of pixels {pixel!r}; expected one of {', '.join(PIXELS)}")
        self.method = method
        self.grid = grid
        self.pixel = pixel

    def __call__(self, scores: Tensor, ppi: int, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Pick `ppi` positions per map.

        Args:
            scores: `(..., h, w)` non-negative scores, one map per frame.
            ppi: patches per map.
            generator: source of randomness, the global one if omitted.

        Returns:
            x, y: each `(frames, ppi)` int64, in [0, w-1] and [0, h-1].
        """
        h, w = scores.shape[-2:]
        maps = scores.detach().reshape(-1, h, w).float()
        if self.method in ("random", "3xrandom"):
            x, y = self._uniform(maps, ppi, generator)
        else:
            x, y = self._by_cells(maps, ppi, generator)
        return x, y

    def _uniform(self, maps: Tensor, ppi: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Uniform candidates; `3xrandom` keeps the third with the highest scores in ascending order."""
        frames, h, w = maps.shape
        splits = GRID if self.grid else 1
        parts = splits * splits
        per_part = -(-ppi // parts)
        factor = 3 if self.method == "3xrandom" else 1
        size = (frames, parts, factor * per_part)
        # borders of the quadrants; a map too small to be split has empty quadrants, which borrow a pixel
        quadrant = torch.arange(parts, device=maps.device)[:, None]
        x0, x1 = _span(quadrant % splits, w, splits)
        y0, y1 = _span(quadrant // splits, h, splits)
        across, down = torch.rand(2, *size, generator=generator, device=random_home(generator)).to(maps.device)
        x = x0 + (across * (x1 - x0)).long().clamp(max=x1 - x0 - 1)
        y = y0 + (down * (y1 - y0)).long().clamp(max=y1 - y0 - 1)
        if factor > 1:
            value = maps.flatten(1).gather(1, (y * w + x).flatten(1)).view(size)
            keep = value.argsort(dim=2, stable=True)[..., -per_part:]
            x, y = x.gather(2, keep), y.gather(2, keep)
        return _interleave(x, ppi), _interleave(y, ppi)

    def _by_cells(self, maps: Tensor, ppi: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Methods that look at 4x4 cells: pad to whole cells (or whole quadrants of cells), pick, shift back."""
        h, w = maps.shape[-2:]
        unit = KERNEL_SIZE * (GRID if self.grid else 1)
        pad_h, pad_w = -h % unit, -w % unit
        top, left = pad_h // 2, pad_w // 2
        padded = functional.pad(maps, (left, pad_w - left, top, pad_h - top))
        if self.method == "multi":
            x, y = self._multinomial(padded, ppi, generator)
        else:
            x, y = self._maxima(padded, ppi)
        return (x - left).clamp(0, w - 1), (y - top).clamp(0, h - 1)

    def _multinomial(self, padded: Tensor, ppi: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        coarse = functional.avg_pool2d(padded[:, None], KERNEL_SIZE)[:, 0]
        weight = self._quadrants(coarse)
        count = self._picks_per_part(weight, ppi)
        # the published grid-less rule has no epsilon, but then needs as many non-zero cells as patches
        short = (weight > 0).sum(dim=2, keepdim=True) < count
        weight = torch.where(short, weight + EPSILON, weight) if not self.grid else weight + EPSILON
        chosen = self._cell_of(_draw(weight, count, generator), coarse.shape[-2:])
        cell = _interleave(chosen, ppi)
        columns = coarse.shape[-1]
        cell_y, cell_x = cell // columns, cell % columns
        shift = 1 if self.pixel == "shifted" else 0
        framed = functional.pad(padded, (shift, 0, shift, 0))
        offset = torch.arange(KERNEL_SIZE * KERNEL_SIZE, device=padded.device)
        rows = KERNEL_SIZE * cell_y[..., None] + offset // KERNEL_SIZE
        cols = KERNEL_SIZE * cell_x[..., None] + offset % KERNEL_SIZE
        fine = framed.flatten(1).gather(1, (rows * framed.shape[-1] + cols).flatten(1)).view(rows.shape) + EPSILON
        pick = _draw(fine, 1, generator)[..., 0]
        if self.pixel == "best":  # where cells take turns again, the later turns are drawn
            first_turn = torch.arange(ppi, device=padded.device) // weight.shape[1] < weight.shape[2]
            pick = torch.where(first_turn, fine.argmax(dim=-1), pick)
        return KERNEL_SIZE * cell_x + pick % KERNEL_SIZE, KERNEL_SIZE * cell_y + pick // KERNEL_SIZE

    def _maxima(self, padded: Tensor, ppi: int) -> tuple[Tensor, Tensor]:
        value, position = functional.max_pool2d(padded[:, None], KERNEL_SIZE, return_indices=True)
        value, position = value[:, 0], position[:, 0]
        parts = self._quadrants(value)
        count = self._picks_per_part(parts, ppi)
        order = parts.argsort(dim=2, descending=True, stable=True)
        rounds = -(-count // order.shape[2])  # small maps: the cells take turns again
        if self.method == "nms":
            kept = self._quadrants(suppress_neighbours(value, position, padded.shape[-1], self.grid))
            # suppressed cells follow the survivors, best first: they fill up where survivors are too few
            order = order.gather(2, kept.gather(2, order).byte().argsort(dim=2, descending=True, stable=True))
        cell = _interleave(self._cell_of(order.repeat(1, 1, rounds)[..., :count], value.shape[-2:]), ppi)
        pixel = position.flatten(1).gather(1, cell)
        return pixel % padded.shape[-1], pixel // padded.shape[-1]

    def _picks_per_part(self, parts: Tensor, ppi: int) -> int:
        return -(-ppi // parts.shape[1])

    def _quadrants(self, cells: Tensor) -> Tensor:
        """`(F, h1, w1)` to `(F, parts, cells per part)`."""
        if not self.grid:
            return cells.flatten(1)[:, None]
        frames, rows, columns = cells.shape
        split = cells.view(frames, GRID, rows // GRID, GRID, columns // GRID).transpose(2, 3)
        return split.reshape(frames, GRID * GRID, -1)

    def _cell_of(self, index: Tensor, size: torch.Size) -> Tensor:
        """Flat index into the whole cell map of `index` (F, parts, k), which counts inside each part."""
        if not self.grid:
            return index
        rows, columns = size[0] // GRID, size[1] // GRID
        part = torch.arange(GRID * GRID, device=index.device)[:, None]
        y = part // GRID * rows + index // columns
        x = part % GRID * columns + index % columns
        return y * size[1] + x


def _span(part: Tensor, size: int, splits: int) -> tuple[Tensor, Tensor]:
    start = (part * size // splits).clamp(max=size - 1)
    stop = (part + 1) * size // splits
    return start, torch.maximum(stop, start + 1)


def _interleave(picks: Tensor, ppi: int) -> Tensor:
    """`(F, parts, k)` to `(F, ppi)`: the parts take turns, the last round may be incomplete."""
    return picks.transpose(1, 2).flatten(1)[:, :ppi]


def _draw(weight: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """Draw `count` indices of the last axis without replacement, with probabilities proportional to `weight`.

    More draws than there are entries begin again with all of them.

    Exponential races: the largest weight/q with q ~ Exp(1), which is also what `torch.multinomial` does.
    """
    cells = weight.shape[-1]
    rounds = [min(cells, count - done) for done in range(0, count, cells)]
    picks = []
    for size in rounds:
        race = torch.empty_like(weight, device=random_home(generator)).exponential_(1.0, generator=generator)
        picks.append(torch.topk(weight / race.to(weight.device), size, dim=-1).indices)
    return picks[0] if len(picks) == 1 else torch.cat(picks, dim=-1)


def suppress_neighbours(value: Tensor, position: Tensor, width: int, grid: bool) -> Tensor:
    """Greedy non-maximum suppression between the maxima of 4x4 cells, all frames at once.

    Boxes of side 3 around each maximum (their corner clamped at 0) suppress lower ones above an IoU of 0.4. Such boxes
    overlap only between neighbouring cells, so each greedy round compares 8 shifted copies of the map; a round settles
    every maximum whose higher neighbours are settled.

    Args:
        value: `(F, h1, w1)` maximum of each cell.
        position: `(F, h1, w1)` int64 flat pixel index of the maximum in rows of `width` pixels.
        width: width of the pixel map.
        grid: maxima in different quadrants never suppress each other.

    Returns:
        `(F, h1, w1)` bool, True for survivors.
    """
    rows, columns = value.shape[-2:]
    side = 2 * NMS_RADIUS
    x0 = ((position % width).float() - NMS_RADIUS).clamp(min=0)
    y0 = (torch.div(position, width, rounding_mode="floor").float() - NMS_RADIUS).clamp(min=0)
    rank = value.flatten(1).argsort(dim=1, descending=True, stable=True).argsort(dim=1).view_as(position)
    part = torch.zeros(rows, columns, dtype=torch.int64, device=value.device)
    if grid:
        part[rows // GRID :] += GRID
        part[:, columns // GRID :] += 1
    part = part.expand_as(position)

    def around(x: Tensor, fill: float) -> Tensor:
        framed = functional.pad(x, (1, 1, 1, 1), value=fill)
        shifts = [(dy, dx) for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1)]
        return torch.stack([framed[:, dy : dy + rows, dx : dx + columns] for dy, dx in shifts])

    overlap_x = (side - (around(x0, -1e6) - x0).abs()).clamp(min=0)
    overlap_y = (side - (around(y0, -1e6) - y0).abs()).clamp(min=0)
    intersection = overlap_x * overlap_y
    clash = intersection / (2 * side * side - intersection) > NMS_IOU
    threat = clash & (around(rank, -1) < rank) & (around(part, -1) == part)
    kept = torch.zeros_like(value, dtype=torch.bool)
    open_ = torch.ones_like(kept)
    while bool(open_.any()):
        blocked = (threat & around(open_, False)).any(0)
        beaten = (threat & around(kept, False)).any(0)
        kept = kept | (open_ & ~blocked & ~beaten)
        open_ = open_ & ~kept & ~beaten
    return kept
