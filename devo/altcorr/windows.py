"""Windows around subpixel positions: integer base, bilinear fraction, pixel rows, zero padding, blending.

Throughout this package a window of radius R has D = 2R+2 pixels a side; blending its four shifted (D-1, D-1)
sub-windows bilinearly gives the (2R+1, 2R+1) values at the shifts -R..R of a subpixel position.
"""

from __future__ import annotations

import torch
from torch import Tensor

from devo.errors import InputError

FAR = 1 << 20
"""Integer pixel that stands for 'outside of every map'; larger, infinite and NaN coordinates are clamped to it."""


def check_edges(caller: str, coords: Tensor, kk: Tensor, jj: Tensor, patch: int) -> None:
    """Raise `InputError` unless positions (1, E, 2, P, P) float32 or float64 and the edge lists (E,) fit together."""
    precise = coords.dtype in (torch.float32, torch.float64)
    if not precise or kk.dim() != 1 or kk.shape != jj.shape or coords.shape != (1, len(kk), 2, patch, patch):
        found = f"coords {tuple(coords.shape)} {coords.dtype} for edges {tuple(kk.shape)} and {tuple(jj.shape)}"
        raise InputError(f"{caller} got {found}; expected (1, E, 2, {patch}, {patch}) float32, (E,) and (E,)")


def split_coords(coords: Tensor) -> tuple[Tensor, Tensor]:
    """Split positions into their integer pixel and the fraction beyond it.

    Args:
        coords: positions in pixels, any shape, floating point.

    Returns:
        `base`, floor of the position in the dtype of `coords`, clamped to +-`FAR` (NaN becomes `-FAR`) so that a cast
        to an integer type is safe and exact, and `fraction` in [0, 1); NaN and infinite positions have the fraction
        NaN, so whatever is blended with it is NaN.
    """
    floor = coords.floor()
    return floor.nan_to_num(nan=-FAR, posinf=FAR, neginf=-FAR).clamp_(-FAR, FAR), coords - floor


def window_rows(
    base_x: Tensor, base_y: Tensor, frame: Tensor, size: tuple[int, int], radius: int
) -> tuple[Tensor, Tensor]:
    """Row numbers of the window pixels in a list of all pixels of all frames.

    Args:
        base_x: (N,) int64, integer column of each position.
        base_y: (N,) int64, integer row of each position.
        frame: (N,) int64, map that each position refers to.
        size: height and width of the maps.
        radius: R of the window.

    Returns:
        `rows` (N, D*D) int64 into the (F*H*W) pixels, 0 where the pixel is outside, and `inside` (N, D*D) bool.
    """
    height, width = size
    shift = torch.arange(-radius, radius + 2, device=base_x.device)
    x, y = base_x[:, None] + shift, base_y[:, None] + shift
    inside = ((y >= 0) & (y < height))[:, :, None] & ((x >= 0) & (x < width))[:, None, :]
    rows = ((frame[:, None] * height + y) * width)[:, :, None] + x[:, None, :]
    return rows.masked_fill_(~inside, 0).flatten(1), inside.flatten(1)


def blend(window: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """Bilinear interpolation inside windows.

    Args:
        window: (..., D, D) values, rows then columns.
        dx: (...) fraction along the columns, in the dtype of `window`.
        dy: (...) fraction along the rows.

    Returns:
        (..., D-1, D-1) values at the shifted positions.
    """
    along_x = torch.lerp(window[..., :-1], window[..., 1:], dx[..., None, None])
    return torch.lerp(along_x[..., :-1, :], along_x[..., 1:, :], dy[..., None, None])


def spread(grad: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """Transpose of `blend`: distribute (N, D-1, D-1) gradients over the (N, D, D) window, given (N,) fractions."""
    side = grad.shape[-1] + 1
    # flattened, with a zero behind every row and a zero row at the end, the neighbours are found by shifting
    padded = torch.nn.functional.pad(grad, (0, 1, 0, 1)).flatten(1)
    dx, dy = dx[:, None], dy[:, None]
    rows = padded * (1 - dy)
    rows[:, side:].addcmul_(padded[:, :-side], dy)
    window = rows * (1 - dx)
    window[:, 1:].addcmul_(rows[:, :-1], dx)
    return window.view(-1, side, side)


def pixel_rows(maps: Tensor) -> Tensor:
    """View maps (F, C, H, W) as pixels (F*H*W, C); a copy unless the maps are stored channels-last."""
    return maps.permute(0, 2, 3, 1).reshape(-1, maps.shape[1])
