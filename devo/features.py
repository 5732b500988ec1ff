"""The ring of network features: matching maps, matching patches and context of the newest keyframes."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


class FeatureRing:
    """Features of the last `mem` keyframes; keyframe `f` lives in slot `f % mem`.

    Buffers: `imap_ (mem,M,dim_inet)`, `gmap_ (mem,M,dim_fnet,P,P)`, `fmap1_ (1,mem,dim_fnet,h,w)` and
    `fmap2_ (1,mem,dim_fnet,h//4,w//4)`, the 4x4 average-pooled map. The maps are stored channels last, because the
    correlation gathers whole (pixel, channel) rows.
    """

    def __init__(self, mem: int, patches_per_frame: int, patch_size: int, dim_inet: int, dim_fnet: int,
                 height: int, width: int, device: torch.device, dtype: torch.dtype) -> None:
        self.mem = mem

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(mem, *shape, device=device, dtype=dtype)

        self.imap_ = zeros(patches_per_frame, dim_inet)
        self.gmap_ = zeros(patches_per_frame, dim_fnet, patch_size, patch_size)
        self.fmap1_ = zeros(height, width, dim_fnet).permute(0, 3, 1, 2)[None]
        self.fmap2_ = zeros(height // 4, width // 4, dim_fnet).permute(0, 3, 1, 2)[None]

    def store(self, keyframe: int, fmap: Tensor, gmap: Tensor, imap: Tensor) -> None:
        """Write the features of one keyframe.

        Args:
            keyframe: index of the keyframe.
            fmap: `(1,1,dim_fnet,h,w)`. gmap: `(1,M,dim_fnet,P,P)`. imap: `(1,M,dim_inet,1,1)`.
        """
        slot = keyframe % self.mem
        self.imap_[slot] = imap.view(self.imap_.shape[1:])
        self.gmap_[slot] = gmap.view(self.gmap_.shape[1:])
        self.fmap1_[0, slot] = fmap[0, 0]
        self.fmap2_[0, slot] = F.avg_pool2d(fmap[0], 4, 4)[0]

    def drop_keyframe(self, k: int, n: int) -> None:
        """Move the features of keyframes `k+1 .. n-1` down by one slot."""
        source = torch.arange(k + 1, n, device=self.imap_.device)
        to, source = (source - 1) % self.mem, source % self.mem
        for buffer in (self.imap_, self.gmap_, self.fmap1_[0], self.fmap2_[0]):
            buffer[to] = buffer[source]

    @property
    def pyramid(self) -> tuple[Tensor, Tensor]:
        """The two levels that are correlated, `(1,mem,C,h,w)` and `(1,mem,C,h//4,w//4)`."""
        return self.fmap1_, self.fmap2_

    def matching_patches(self) -> Tensor:
        """All matching patches, `(1, mem*M, dim_fnet, P, P)`."""
        return self.gmap_.flatten(0, 1)[None]

    def context(self, patch_ids: Tensor) -> Tensor:
        """Context vectors `(1,E,dim_inet)` of patches `patch_ids (E,)` (absolute numbering)."""
        rows = self.imap_.flatten(0, 1)
        return rows[patch_ids % len(rows)][None]
