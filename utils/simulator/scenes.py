"""Scenes made of textured plane pieces, so that depth and correspondence are exact."""

from __future__ import annotations

import dataclasses

import torch

UNBOUNDED = 1e6
"""Half extent, in scene units, that stands for an infinite plane."""


@dataclasses.dataclass(frozen=True)
class Planes:
    """P rectangular plane pieces of G scenes; unused pieces have zero extent.

    A point `x` of a piece has the plane coordinates `axis_u . (x - origin)` and `axis_v . (x - origin)` in scene
    units, is inside where both magnitudes stay below `half_extent`, and shows the texture coordinate
    `texture_scale * (u, v) + texture_offset`, where one unit is one texture tile, mirrored beyond.

    Attributes:
        origin: `(G, P, 3)` float32, world frame.
        axis_u: `(G, P, 3)` unit vector in the plane.
        axis_v: `(G, P, 3)` unit vector in the plane, orthogonal to `axis_u`.
        half_extent: `(G, P, 2)` scene units; `UNBOUNDED` for an infinite plane, 0 for none.
        texture_scale: `(G, P)` tiles per scene unit.
        texture_offset: `(G, P, 2)` tiles.
    """

    origin: torch.Tensor
    axis_u: torch.Tensor
    axis_v: torch.Tensor
    half_extent: torch.Tensor
    texture_scale: torch.Tensor
    texture_offset: torch.Tensor

    @property
    def normal(self) -> torch.Tensor:
        """Unit normals `(G, P, 3)`, towards the side from which u points right and v down."""
        return torch.linalg.cross(self.axis_v, self.axis_u)

    def to(self, device: torch.device | str) -> Planes:
        """The same scenes on another device."""
        return Planes(*(getattr(self, field.name).to(device) for field in dataclasses.fields(self)))

    def scene(self, index: int) -> Planes:
        """One of the G scenes, still with a leading dimension of one."""
        return Planes(*(getattr(self, field.name)[index : index + 1] for field in dataclasses.fields(self)))

    def distance_to_surface(self, points: torch.Tensor) -> torch.Tensor:
        """Euclidean distance of world points to the nearest plane piece.

        Args:
            points: `(G, N, 3)` scene units, world frame.

        Returns:
            `(G, N)` distances, scene units.
        """
        away = points[:, :, None] - self.origin[:, None]
        inside = torch.stack([(away * self.axis_u[:, None]).sum(-1), (away * self.axis_v[:, None]).sum(-1)], -1)
        beyond = (inside.abs() - self.half_extent[:, None]).clamp(min=0)
        height = (away * self.normal[:, None]).sum(-1)
        distance = (height.square() + beyond.square().sum(-1)).sqrt()
        unused = (self.half_extent.amin(-1) <= 0)[:, None]
        return distance.masked_fill(unused, float("inf")).amin(-1)


def stack_scenes(scenes: list[Planes]) -> Planes:
    """Join single scenes into one batch, padding with pieces of zero extent."""
    most = max(scene.origin.shape[1] for scene in scenes)

    def join(name: str) -> torch.Tensor:
        rows = [getattr(scene, name) for scene in scenes]
        return torch.cat([torch.nn.functional.pad(row, [0, 0] * (row.dim() - 2) + [0, most - row.shape[1]])
                          for row in rows])

    return Planes(*(join(field.name) for field in dataclasses.fields(Planes)))
