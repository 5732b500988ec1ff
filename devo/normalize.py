"""Normalisation of network inputs: voxel grids (one at a time or whole clips) and frames."""

from __future__ import annotations

import torch
from torch import Tensor

from devo.errors import InputError

VOXEL_MODES = {"none": "none", "rescale": "rescale", "norm": "rescale", "standard": "std", "std": "std"}
SEQUENCE_MODES = {**VOXEL_MODES, "standard2": "std2", "std2": "std2"}
# below this share of the mean, the spread of the non-zero cells is rounding noise
RELATIVE_SIGMA_FLOOR = 1e-5


def _lookup(mode: str, table: dict[str, str]) -> str:
    kind = table.get(str(mode).lower())
    if kind is None:
        raise InputError(f"unknown voxel normalisation {mode!r}; expected one of {', '.join(table)}")
    return kind


def check_sequence_mode(mode: str) -> str:
    """Return `mode` in lower case; InputError if `normalize_sequence` does not know it."""
    _lookup(mode, SEQUENCE_MODES)
    return mode.lower()


def _standardise(groups: Tensor) -> Tensor:
    """(G, K) rows to zero mean and unit deviation over their non-zero cells; zero cells stay zero."""
    occupied = groups.abs().sign_()  # 0 or 1 as float: boolean masks cost several times as much on a CPU
    count = occupied.sum(dim=1, keepdim=True).clamp_(min=1)
    mean = groups.sum(dim=1, keepdim=True) / count
    result = torch.addcmul(groups, occupied, mean, value=-1)
    # the deviation is taken from the centred values: the difference of two large sums would lose it
    sigma = (torch.mul(result, result, out=occupied).sum(dim=1, keepdim=True) / count).sqrt_()
    constant = sigma <= RELATIVE_SIGMA_FLOOR * mean.abs()
    result.div_(sigma.masked_fill(constant, 1.0))
    return torch.where(constant, groups, result) if bool(constant.any()) else result


def _rescale(groups: Tensor) -> Tensor:
    """(G, K) rows: positive cells divided by their maximum, negative ones by the magnitude of their minimum."""
    positive, negative = groups.clamp(min=0), groups.clamp(max=0)
    up, down = positive.amax(dim=1, keepdim=True), -negative.amin(dim=1, keepdim=True)
    positive.div_(up.masked_fill(up == 0, 1.0))
    return positive.add_(negative.div_(down.masked_fill(down == 0, 1.0)))


def normalize_voxel(voxel: Tensor, mode: str) -> Tensor:
    """Normalise one voxel grid for the tracker.

    Args:
        voxel: (bins, H, W) floating point; never modified.
        mode: `none`; `rescale`/`norm`: positives divided by their maximum, negatives by |minimum| (a missing polarity
            is left alone); `standard`/`std`: zero mean and unit deviation over the non-zero cells, zeros stay zero.
            Case-insensitive. A grid without non-zero cells, and for `std` one whose non-zero cells are all
            equal, is returned unchanged.

    Returns:
        (bins, H, W) float32 (`none`: the very same values, not copied).

    Raises:
        InputError: unknown mode.
    """
    kind = _lookup(mode, VOXEL_MODES)
    voxel = voxel.float()
    if kind == "none":
        return voxel
    rows = voxel.reshape(1, -1)
    return (_standardise(rows) if kind == "std" else _rescale(rows)).view_as(voxel)


def normalize_sequence(voxels: Tensor, mode: str) -> Tensor:
    """Normalise clips of voxel grids for training.

    Args:
        voxels: (B, n, bins, H, W) floating point; never modified.
        mode: as in `normalize_voxel`, with `std` per voxel grid, and `rescale` as well as `standard2`/`std2` with
            statistics over each whole clip.

    Returns:
        (B, n, bins, H, W) float32.

    Raises:
        InputError: unknown mode.
    """
    kind = _lookup(mode, SEQUENCE_MODES)
    voxels = voxels.float()
    if kind == "none":
        return voxels
    if kind == "std":
        return _standardise(voxels.flatten(0, 1).flatten(1)).view_as(voxels)
    rows = voxels.flatten(1)
    return (_standardise(rows) if kind == "std2" else _rescale(rows)).view_as(voxels)


def normalize_frames(images: Tensor) -> Tensor:
    """Map colours 0..255 of any shape to float32 in [-0.5, 1.5]."""
    return images.float() * (2.0 / 255.0) - 0.5
