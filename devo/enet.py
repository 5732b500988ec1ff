"""eVONet: the event network (voxel grids of 5 bins)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from devo.normalize import check_sequence_mode, normalize_sequence
from devo.patchifier import EVENT_BINS, Patchifier
from devo.update import Update

__all__ = ["Patchifier", "Update", "eVONet"]


class eVONet(nn.Module):  # noqa: N801 - published name
    """Event odometry network: `patchify` (encoders, patch selection) and `update` (recurrent update operator).

    `bins` is the number of input channels, `RES` the ratio of full to feature resolution.

    Args:
        P: patch side.
        use_viewer: ignored, kept for the published signature.
        dim_inet: channels of context features and hidden state.
        dim_fnet: channels of matching features.
        dim: width of the first encoder stage.
        patch_selector: `scorer`, `gradient` or `random`.
        norm: voxel normalisation in training, see `devo.normalize.normalize_sequence`.
        randaug: augment voxel grids in training.
    """

    RES = 4.0
    bins = EVENT_BINS

    def __init__(
        self,
        P: int = 3,
        use_viewer: bool = False,
        dim_inet: int = 384,
        dim_fnet: int = 128,
        dim: int = 32,
        patch_selector: str = "scorer",
        norm: str = "std2",
        randaug: bool = False,
    ) -> None:
        super().__init__()
        self.P = P
        self.dim_inet = dim_inet
        self.dim_fnet = dim_fnet
        self.dim = dim
        self.patch_selector = patch_selector.lower()
        self.norm = check_sequence_mode(norm)
        self.randaug = randaug
        self.patchify = Patchifier(P, dim_inet, dim_fnet, dim, patch_selector, channels=EVENT_BINS)
        self.update = Update(P, dim_inet)

    def normalize(self, images: Tensor) -> Tensor:
        """Normalise voxel clips `(B, n, 5, H, W)` for training, according to `norm`."""
        return normalize_sequence(images, self.norm)

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
        plot_patches: bool = False,
        patches_per_image: int = 80,
    ) -> Any:
        """Unroll the odometry over raw training clips, see `devo.unroll.unroll`.

        `M`, `P` and `plot_patches` are ignored; they are kept for the published signature.
        """
        from devo.unroll import unroll  # late: the tracker needs none of the training code

        options: dict[str, Any] = {"STEPS": STEPS, "structure_only": structure_only}
        return unroll(self, images, poses, disps, intrinsics, patches_per_image=patches_per_image, **options)
