"""VONet: the frame network (three colour channels)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from devo.errors import InputError
from devo.normalize import normalize_frames
from devo.patchifier import Patchifier
from devo.update import Update

__all__ = ["Patchifier", "Update", "VONet"]


class VONet(nn.Module):
    """Frame odometry network with the layout of the published RGB weights; it has no scorer.

    Args:
        use_viewer: ignored, kept for the published signature.
        dim_inet: channels of context features and hidden state (also readable as `DIM`).
        dim_fnet: channels of matching features.
        dim: width of the first encoder stage.
        patch_selector: `random` or `gradient`.
        P: patch side.
    """

    RES = 4
    bins = 3

    def __init__(
        self,
        use_viewer: bool = False,
        dim_inet: int = 384,
        dim_fnet: int = 128,
        dim: int = 32,
        patch_selector: str = "random",
        P: int = 3,
    ) -> None:
        super().__init__()
        if patch_selector.lower() == "scorer":
            raise InputError("the frame network has no scorer; expected patch_selector 'random' or 'gradient'")
        self.P = P
        self.DIM = dim_inet
        self.dim_inet = dim_inet
        self.dim_fnet = dim_fnet
        self.dim = dim
        self.patch_selector = patch_selector.lower()
        self.patchify = Patchifier(P, dim_inet, dim_fnet, dim, patch_selector, channels=self.bins)
        self.update = Update(P, dim_inet)

    def normalize(self, images: Tensor) -> Tensor:
        """Map frames 0..255 to [-0.5, 1.5]."""
        return normalize_frames(images)

    def forward(
        self,
        images: Tensor,
        poses: Any,
        disps: Tensor,
        intrinsics: Tensor,
        M: int = 1024,
        STEPS: int = 12,
        P: int = 1,
        structure_only: bool = False,
        rescale: bool = False,
        patches_per_image: int = 80,
    ) -> Any:
        """Unroll the odometry over raw training clips, see `devo.unroll.unroll`.

        `M`, `P` and `rescale` are ignored; they are kept for the published signature.
        """
        from devo.unroll import unroll  # late: the tracker needs none of the training code

        options: dict[str, Any] = {"STEPS": STEPS, "structure_only": structure_only}
        network: Any = self
        return unroll(network, images, poses, disps, intrinsics, patches_per_image=patches_per_image, **options)
