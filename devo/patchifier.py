"""Feature maps of frames and the patches cut out of them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devo.altcorr import patchify
from devo.device import random_home
from devo.errors import InputError
from devo.extractor import BasicEncoder4, channels_last_frames
from devo.selector import PatchSelector, Scorer, event_gradient

SELECTORS = ("scorer", "gradient", "random")
FEATURE_SCALE = 4.0
EVENT_BINS = 5
CANDIDATE_FACTOR = 3

PatchifierOutput = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]


class Patchifier(nn.Module):
    """Encodes frames and cuts patches at positions that a selector chooses.

    Args:
        patch_size: patch side P.
        dim_inet: channels of the context features.
        dim_fnet: channels of the matching features.
        dim: width of the first encoder stage.
        patch_selector: `scorer`, `gradient` or `random`.
        channels: 5 voxel bins or 3 colours.
    """

    def __init__(
        self,
        patch_size: int = 3,
        dim_inet: int = 384,
        dim_fnet: int = 128,
        dim: int = 32,
        patch_selector: str = "scorer",
        channels: int = EVENT_BINS,
    ) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.channels = channels
        self.patch_selector = patch_selector.lower()
        if self.patch_selector not in SELECTORS:
            raise InputError(f"unknown patch selector {patch_selector!r}; expected one of {', '.join(SELECTORS)}")
        self.fnet = BasicEncoder4(channels, output_dim=dim_fnet, dim=dim, norm_fn="instance")
        self.inet = BasicEncoder4(channels, output_dim=dim_inet, dim=dim, norm_fn="none")
        if self.patch_selector == "scorer":
            self.scorer = Scorer(channels)

    def forward(
        self,
        images: Tensor,
        patches_per_image: int = 80,
        disps: Tensor | None = None,
        return_color: bool = False,
        scorer_eval_mode: str = "multi",
        scorer_eval_use_grid: bool = True,
        scorer_eval_pixel: str = "shifted",
        coords: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> PatchifierOutput:
        """Encode frames and cut patches.

        Args:
            images: `(B, n, C, H, W)` normalised frames; several clips (B > 1) count as one clip of B*n frames.
            patches_per_image: number M of patches per frame.
            disps: `(B, n, h, w)` inverse depth at quarter resolution, ones if omitted.
            return_color: in evaluation mode, sample colours as the sixth output.
            scorer_eval_mode: `PatchSelector` method in evaluation mode (selectors `scorer` and `gradient`).
            scorer_eval_use_grid: spread evaluation patches evenly over the four quadrants.
            scorer_eval_pixel: how the pixel of a cell is chosen, see `PatchSelector`.
            coords: `(B*n, M, 2)` integer-valued quarter-resolution pixels (x, y) in [1, w-2] x [1, h-2], which
                replace the selection.
            generator: source of randomness, the global one if omitted.

        Returns:
            Always six items, with N = B*n, h = ceil(H/4), w = ceil(W/4): `fmap` (1, N, dim_fnet, h, w), `gmap`
            (1, N*M, dim_fnet, P, P), `imap` (1, N*M, dim_inet, 1, 1), `patches` (1, N*M, 3, P, P) float32 with
            channels (x, y, inverse depth), `index` (N*M,) int64 frame of each patch, and the scores (N, M) in training
            with the scorer, the colours (1, N*M, 1 or 3) in evaluation with `return_color`, else None.

        Raises:
            InputError: wrong number of channels, frames too small, `disps` of another size or misplaced `coords`.
        """
        if images.dim() != 5 or images.shape[2] != self.channels:
            raise InputError(
                f"images have shape {tuple(images.shape)}; this network expects (B, n, {self.channels}, H, W)"
            )
        clips = images.shape[:2]
        images = channels_last_frames(images)
        fmap = self.fnet.encode(images) / FEATURE_SCALE
        frames, _, height, width = fmap.shape
        if disps is not None and disps.shape != (*clips, height, width):
            expected = (*clips, height, width)
            raise InputError(f"inverse depths disps have shape {tuple(disps.shape)}; expected {expected}")
        if coords is None:
            selector = PatchSelector(scorer_eval_mode, scorer_eval_use_grid, scorer_eval_pixel)
            x, y, scores = self._select(images, (height, width), patches_per_image, selector, generator)
            coords = torch.stack((x, y), dim=-1).float()
        else:
            coords = self._checked(coords, (frames, height, width))
            scores = self._scores_at(images, coords) if self.training and self.patch_selector == "scorer" else None
        radius = self.patch_size // 2
        gmap = patchify(fmap, coords, radius).flatten(0, 1)[None]
        # the last convolution of inet is pointwise: only the pixels of the patches need it
        context = patchify(self.inet.trunk(images), coords, 0).flatten(0, 1)
        imap = self.inet.conv2(context)[None] / FEATURE_SCALE
        patches = patchify(self._grid(fmap, disps), coords, radius).flatten(0, 1)[None]
        index = torch.arange(frames, device=images.device).repeat_interleave(coords.shape[1])
        last = scores
        if not self.training:
            last = self._colors(images, coords) if return_color else None
        return fmap[None], gmap, imap, patches, index, last

    @staticmethod
    def _checked(coords: Tensor, size: tuple[int, int, int]) -> Tensor:
        frames, height, width = size
        limit = torch.tensor([width - 2, height - 2], device=coords.device)
        fits = coords.dim() == 3 and coords.shape[0] == frames and coords.shape[2] == 2
        if not fits or bool(((coords < 1) | (coords > limit)).any()):
            raise InputError(
                f"coords have shape {tuple(coords.shape)}; expected ({frames}, M, 2) inside "
                f"[1, {width - 2}] x [1, {height - 2}]"
            )
        return coords.float()

    @staticmethod
    def _grid(fmap: Tensor, disps: Tensor | None) -> Tensor:
        """Column, row and inverse depth of every feature pixel, `(N, 3, h, w)` float32."""
        frames, _, height, width = fmap.shape
        grid = torch.ones(frames, 3, height, width, device=fmap.device)
        grid[:, 0] = torch.arange(width, device=fmap.device)
        grid[:, 1] = torch.arange(height, device=fmap.device)[:, None]
        if disps is not None:
            grid[:, 2] = disps.reshape(frames, height, width)
        return grid

    def _select(
        self,
        images: Tensor,
        size: tuple[int, int],
        count: int,
        selector: PatchSelector,
        generator: torch.Generator | None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Positions (x, y), each (N, count) int64, and the scores (N, count) of training with the scorer."""
        height, width = size
        if min(height, width) < 3:
            found = f"{images.shape[-1]}x{images.shape[-2]} pixels"
            raise InputError(f"frames of {found} are too small; expected at least 9x9 (3x3 feature pixels)")
        frames, home = images.shape[0], random_home(generator)
        if self.patch_selector == "random":
            x = torch.randint(1, width - 1, (frames, count), generator=generator, device=home)
            y = torch.randint(1, height - 1, (frames, count), generator=generator, device=home)
            return x.to(images.device), y.to(images.device), None
        if self.patch_selector == "gradient":
            selector = PatchSelector("3xrandom") if self.training else selector
            x, y = selector(event_gradient(images), count, generator)
            return x.clamp(1, width - 2), y.clamp(1, height - 2), None
        scores = torch.sigmoid(self.scorer.rate(images).float())
        if not self.training:
            x, y = selector(scores, count, generator)
            return x + 1, y + 1, None
        rows, columns = scores.shape[-2:]
        candidates = (frames, CANDIDATE_FACTOR * count)
        x = torch.randint(0, columns, candidates, generator=generator, device=home).to(images.device)
        y = torch.randint(0, rows, candidates, generator=generator, device=home).to(images.device)
        value = scores.flatten(1).gather(1, y * columns + x)
        keep = value.argsort(dim=1, stable=True)[:, -count:]
        return x.gather(1, keep) + 1, y.gather(1, keep) + 1, value.gather(1, keep)

    def _scores_at(self, images: Tensor, coords: Tensor) -> Tensor:
        scores = torch.sigmoid(self.scorer.rate(images).float())
        cell = (coords.long() - 1).clamp(min=0)
        rows, columns = scores.shape[-2:]
        x, y = cell[..., 0].clamp(max=columns - 1), cell[..., 1].clamp(max=rows - 1)
        return scores.flatten(1).gather(1, y * columns + x)

    def _colors(self, images: Tensor, coords: Tensor) -> Tensor:
        """Brightness of each patch centre, sampled at full-resolution pixel 4x+2: (1, N*M, 1 or 3)."""
        events = self.channels == EVENT_BINS
        source = images.float()
        if events:
            source = source.abs().sum(dim=1, keepdim=True)
        colors = patchify(source, FEATURE_SCALE * (coords + 0.5), 0).flatten(0, 1)[None, ..., 0, 0]
        return colors.clamp(0, 255) if events else colors
