"""Render log intensity and inverse depth of plane scenes by analytic intersection, batched over poses.

For a camera at `c` with axes `R` (camera to world) and a plane piece with origin `o`, normal `n` and axes `e`, the
ray `r = (x, y, 1)` meets the plane at inverse depth `w = (R^T n / n.(o - c)) . r`, and the plane coordinate times that
inverse depth, `U = e.(c - o) w + (R^T e) . r`, is affine in `r` too. So each plane costs a few additions per pixel and
no division; only the nearest plane is divided out and looked up in the texture.
"""

from __future__ import annotations

import dataclasses

import torch

from utils.simulator.scenes import Planes
from utils.simulator.textures import mip_levels
from utils.simulator.trajectory import quaternion_to_matrix

FILTER_TILT = 0.75
"""Weight of foreshortening in the choice of the mip level: 0 looks at the distance only, 1 blurs the far axis fully."""


@dataclasses.dataclass(frozen=True)
class Rays:
    """Viewing rays `(x, y, 1)` of a camera: `(1, W)` and `(H, 1)` for a pinhole, `(H, W)` each with distortion."""

    x: torch.Tensor
    y: torch.Tensor
    focal: float

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return max(self.x.shape[0], self.y.shape[0]), max(self.x.shape[1], self.y.shape[1])

    def coarse(self, step: int) -> Rays:
        """Every `step`-th ray in both directions, starting in the middle of the first cell."""
        start = step // 2
        x = self.x[:, start::step] if self.x.shape[0] == 1 else self.x[start::step, start::step]
        y = self.y[start::step] if self.y.shape[1] == 1 else self.y[start::step, start::step]
        return Rays(x, y, self.focal)


def pinhole_rays(intrinsics: tuple[float, float, float, float], height: int, width: int,
                 device: torch.device | str = "cpu") -> Rays:
    """Rays of an undistorted camera with `fx fy cx cy` in pixels; integer pixels are pixel centres."""
    fx, fy, cx, cy = intrinsics
    x = (torch.arange(width, dtype=torch.float32, device=device) - cx) / fx
    y = (torch.arange(height, dtype=torch.float32, device=device) - cy) / fy
    return Rays(x[None], y[:, None], (fx * fy) ** 0.5)


@dataclasses.dataclass(frozen=True)
class _PlaneForms:
    """Affine forms `a x + b y + c` of every plane for M poses; the last dimension is `(a, b, c)`."""

    inverse_depth: torch.Tensor  # (M, P, 3)
    edge_u: torch.Tensor
    edge_v: torch.Tensor
    texture_u: torch.Tensor
    texture_v: torch.Tensor
    level: torch.Tensor  # (M, P) mip level at inverse depth 1
    bounded: torch.Tensor  # (P,) bool
    used: torch.Tensor  # (P,) bool


def _plane_forms(planes: Planes, world_T_cam: torch.Tensor, focal: float, tile: int) -> _PlaneForms:
    rotation = quaternion_to_matrix(world_T_cam[:, 3:])  # (M, 3, 3) camera to world
    centre = world_T_cam[:, :3]
    axes = torch.stack([planes.axis_u[0], planes.axis_v[0], planes.normal[0]])  # (3, P, 3)
    in_camera = torch.einsum("kpi,mij->kmpj", axes, rotation)
    from_origin = torch.einsum("kpi,mpi->kmp", axes, centre[:, None] - planes.origin[0])
    height = -from_origin[2]
    height = torch.where(height.abs() < 1e-6, torch.full_like(height, 1e-6), height)
    inverse = in_camera[2] / height[..., None]
    metric_u = in_camera[0] + from_origin[0][..., None] * inverse
    metric_v = in_camera[1] + from_origin[1][..., None] * inverse
    extent = planes.half_extent[0].clamp(min=1e-9)
    scale = planes.texture_scale[0][:, None]
    offset = planes.texture_offset[0]
    level = (planes.texture_scale[0] * (tile / focal)).clamp(min=1e-9).log2() - FILTER_TILT * height.abs().log2()
    used = planes.half_extent[0].amin(-1) > 0
    return _PlaneForms(
        inverse_depth=inverse,
        edge_u=metric_u / extent[:, :1],
        edge_v=metric_v / extent[:, 1:],
        texture_u=scale * metric_u + offset[:, :1] * inverse,
        texture_v=scale * metric_v + offset[:, 1:] * inverse,
        level=level,
        bounded=planes.half_extent[0].amin(-1) < 1e5,
        used=used,
    )


class Renderer:
    """Draws one scene from many poses.

    Args:
        planes: one scene (leading dimension 1).
        atlas: textures of its P pieces as built by `textures.build_atlas`.
        rays: the camera.
        empty: log intensity where no surface is hit.
    """

    def __init__(self, planes: Planes, atlas: torch.Tensor, rays: Rays, empty: float = 0.0) -> None:
        self.planes, self.atlas, self.rays, self.empty = planes, atlas, rays, empty
        count = planes.origin.shape[1]
        self.tile = atlas.shape[-2] // count - 2 if atlas.numel() else 4
        self.levels = mip_levels(self.tile)
        self.corners = torch.stack(torch.broadcast_tensors(
            torch.stack([rays.x.min(), rays.x.max()])[:, None],
            torch.stack([rays.y.min(), rays.y.max()])[None],
            torch.ones(2, 2, device=rays.x.device)), -1).reshape(4, 3)

    def render(self, world_T_cam: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Log intensity and inverse z-depth `(M, H, W)` float32 seen from `(M, 7)` camera-to-world poses.

        Pixels that no surface covers have inverse depth 0 and log intensity `empty`.
        """
        forms = _plane_forms(self.planes, world_T_cam, self.rays.focal, self.tile)
        nearest, u, v, index = self._nearest(forms)
        return self._shade(forms, nearest, u, v, index), nearest

    def inverse_depth(self, world_T_cam: torch.Tensor) -> torch.Tensor:
        """Inverse z-depth `(M, H, W)` alone; 0 where nothing is hit."""
        forms = _plane_forms(self.planes, world_T_cam, self.rays.focal, self.tile)
        return self._nearest(forms, textured=False)[0]

    def _form(self, coefficients: torch.Tensor) -> torch.Tensor:
        a, b, c = (coefficients[:, k, None, None] for k in range(3))
        return a * self.rays.x + (b * self.rays.y + c)

    def _visible(self, forms: _PlaneForms) -> list[int]:
        """Pieces that may cover a pixel of at least one pose: each affine test is decided at the image corners."""
        inverse = forms.inverse_depth @ self.corners.T  # (M, P, 4)
        hidden = (inverse <= 0).all(-1)
        for edge in (forms.edge_u, forms.edge_v):
            value = edge @ self.corners.T
            hidden |= forms.bounded & ((value > inverse).all(-1) | (-value > inverse).all(-1))
        return torch.nonzero((~hidden).any(0) & forms.used).flatten().tolist()

    def _nearest(self, forms: _PlaneForms, textured: bool = True) -> tuple[torch.Tensor, ...]:
        height, width = self.rays.size
        shape = (forms.level.shape[0], height, width)
        best = torch.zeros(shape, device=forms.level.device)
        u, v, index = (torch.zeros_like(best) for _ in range(3))
        mask = torch.empty_like(best)  # comparisons into a float buffer and lerp are far cheaper than torch.where
        bounded = forms.bounded.tolist()
        for piece in self._visible(forms):
            inverse = self._form(forms.inverse_depth[:, piece])
            if bounded[piece]:
                edge = torch.maximum(self._form(forms.edge_u[:, piece]).abs_(),
                                     self._form(forms.edge_v[:, piece]).abs_())
                inverse.mul_(torch.le(edge, inverse, out=mask))
            if textured:
                torch.gt(inverse, best, out=mask)
                u.lerp_(self._form(forms.texture_u[:, piece]), mask)
                v.lerp_(self._form(forms.texture_v[:, piece]), mask)
                index.lerp_(torch.full_like(mask[:1, :1, :1], piece).expand_as(mask), mask)
            best = torch.maximum(best, inverse)
        return best, u, v, index

    def _shade(self, forms: _PlaneForms, nearest: torch.Tensor, u: torch.Tensor, v: torch.Tensor,
               index: torch.Tensor) -> torch.Tensor:
        poses, pieces = forms.level.shape
        depth = nearest.clamp(min=1e-6).reciprocal_()
        flat = index.long().add_(torch.arange(poses, device=index.device)[:, None, None] * pieces)
        level = forms.level.reshape(-1).index_select(0, flat.view(-1)).view_as(depth)
        level = level.add_(depth.log2(), alpha=1.0 + FILTER_TILT).clamp_(0.0, self.levels - 1.001)
        u, v = _mirror(u * depth), _mirror(v * depth)
        row = index * float(self.tile + 2)
        lower = level.floor()
        fine = self._sample(u, v, row, lower)
        coarse = self._sample(u, v, row, lower + 1.0)
        hit = torch.gt(nearest, 0.0, out=torch.empty_like(nearest))
        shaded = fine.lerp_(coarse, level - lower)
        return shaded.mul_(hit) if self.empty == 0.0 else shaded.sub_(self.empty).mul_(hit).add_(self.empty)

    def _sample(self, u: torch.Tensor, v: torch.Tensor, row: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
        """Bilinear atlas look-up; see `build_atlas` for the layout."""
        side = (-level).exp2_().mul_(self.tile)
        x = ((u - 2.0).mul_(side)).add_(level, alpha=2.0).add_(2.0 * self.tile + 0.5)
        y = (v * side).add_(row).add_(0.5)
        rows, columns = self.atlas.shape[-2:]
        grid = torch.empty((*x.shape, 2), device=x.device)
        torch.sub(x.mul_(2.0 / (columns - 1)), 1.0, out=grid[..., 0])
        torch.sub(y.mul_(2.0 / (rows - 1)), 1.0, out=grid[..., 1])
        flat = grid.view(1, -1, x.shape[-1], 2)
        return torch.nn.functional.grid_sample(self.atlas, flat, mode="bilinear", padding_mode="border",
                                               align_corners=True).view_as(u)


def _mirror(coordinate: torch.Tensor) -> torch.Tensor:
    """Fold a tile coordinate into 0..1 by reflection at the integers."""
    return coordinate.sub_((coordinate * 0.5).round_(), alpha=2.0).abs_()


def render_in_chunks(renderer: Renderer, poses: torch.Tensor) -> torch.Tensor:
    """Log intensity `(M, H, W)` of many poses, a cache-sized part at a time on the CPU."""
    height, width = renderer.rays.size
    budget = 100_000 if poses.device.type == "cpu" else 8_000_000
    size = max(1, budget // (height * width))
    return torch.cat([renderer.render(poses[k : k + size])[0] for k in range(0, len(poses), size)])
