"""What a source of training clips hands to the trainer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from devo.errors import InputError

QUANTILE_SAMPLES = 1 << 14


@dataclass(frozen=True)
class TrainingClips:
    """B clips of n frames with perfect ground truth.

    Attributes:
        voxels: (B,n,5,H,W) float32 voxel grids of adjacent time windows, not normalised; pose i belongs to the middle
            of window i.
        world_T_cam: (B,n,7) float32 camera -> world, `tx ty tz qx qy qz qw`.
        inv_depths: (B,n,H,W) float32 inverse z-depth in the unit of the poses.
        intrinsics: (B,n,4) float32 fx fy cx cy in full-resolution pixels.
    """

    voxels: Tensor
    world_T_cam: Tensor  # noqa: N815 - names carry their frames
    inv_depths: Tensor
    intrinsics: Tensor

    def check(self) -> TrainingClips:
        """Return self.

        Raises:
            InputError: the four tensors do not fit together or hold values that are not finite.
        """
        clips, frames, _, height, width = self.voxels.shape
        for name, expected in (
            ("world_T_cam", (clips, frames, 7)),
            ("inv_depths", (clips, frames, height, width)),
            ("intrinsics", (clips, frames, 4)),
        ):
            found = tuple(getattr(self, name).shape)
            if found != expected:
                raise InputError(
                    f"training clips: {name} has shape {found}, expected {expected} beside voxels "
                    f"{tuple(self.voxels.shape)}"
                )
        for name, value in vars(self).items():
            if not bool(torch.isfinite(value).all()):
                raise InputError(f"training clips: {name} holds values that are not finite; the sample is corrupt")
        return self

    def frames(self, index: Tensor) -> TrainingClips:
        """Keep the frames `index` (k,) of every clip."""
        return TrainingClips(*(value.index_select(1, index) for value in self.tensors()))

    def clips(self, index: Tensor) -> TrainingClips:
        """Keep the clips `index` (k,)."""
        return TrainingClips(*(value.index_select(0, index) for value in self.tensors()))

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The four tensors in the order of the attributes."""
        return self.voxels, self.world_T_cam, self.inv_depths, self.intrinsics

    def to(self, device: torch.device | str) -> TrainingClips:
        """Copy to a device, as float32."""
        return TrainingClips(*(value.to(device, torch.float32) for value in self.tensors()))

    @staticmethod
    def join(parts: list[TrainingClips]) -> TrainingClips:
        """Concatenate clips of equal length and size along the batch axis."""
        return TrainingClips(*(torch.cat(values) for values in zip(*(part.tensors() for part in parts))))

    def with_unit_depth(self) -> TrainingClips:
        """Scale each clip so that 0.7 of the 98 % quantile of its inverse depths becomes 1, as published."""
        flat = self.inv_depths.flatten(1)
        flat = flat[:, :: max(1, flat.shape[1] // QUANTILE_SAMPLES)]
        scale = (0.7 * torch.quantile(flat, 0.98, dim=1)).clamp(min=1e-6)
        poses = torch.cat([self.world_T_cam[..., :3] * scale[:, None, None], self.world_T_cam[..., 3:]], dim=-1)
        return replace(self, inv_depths=self.inv_depths / scale[:, None, None, None], world_T_cam=poses)


class ClipSource(Protocol):
    """A deterministic stream of training batches: the same step always gives the same batch."""

    def batch(self, step: int) -> TrainingClips:
        """Batch of training step `step`; may wait for a background process."""
        ...

    def close(self) -> None:
        """Stop background work."""
        ...
