"""Synthetic scenes with known poses and depths, and slow, obvious reference solutions, for the geometry tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devo import projective_ops as pops
from devo.lietorch import SE3


@dataclass
class World:
    """Frames that look at random points, every patch seen by every frame; pixel size of a 160 x 120 feature map."""

    poses: Tensor  # (1,N,7) truth, world->camera
    patches: Tensor  # (1,N*M,3,3,3) truth
    intrinsics: Tensor  # (1,N,4)
    ii: Tensor
    jj: Tensor
    kk: Tensor
    target: Tensor  # (1,E,2) exact projections
    weight: Tensor  # (1,E,2)

    @property
    def edges(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.ii, self.jj, self.kk

    @property
    def bounds(self) -> list[float]:
        """Those that the fast solver takes from the principal point."""
        cx, cy = self.intrinsics[0, 0, 2:].tolist()
        return [-64.0, -64.0, 2 * cx + 64, 2 * cy + 64]

    def disturbed(self, pose_noise: float, depth_noise: float, fixed: int, seed: int) -> tuple[Tensor, Tensor]:
        """Poses and patches away from the truth, the first `fixed` poses exact."""
        generator = torch.Generator().manual_seed(seed)
        frames, count = self.poses.shape[1], self.patches.shape[1]
        noise = torch.randn(1, frames, 6, generator=generator, dtype=torch.float64) * pose_noise
        noise[:, :fixed] = 0
        poses = SE3(self.poses.double()).retr(noise).data.to(self.poses.dtype)
        poses[:, :fixed] = self.poses[:, :fixed]
        patches = self.patches.clone()
        factor = torch.randn(1, count, 1, 1, generator=generator, dtype=torch.float64) * depth_noise
        patches[:, :, 2] *= torch.exp(factor).to(patches.dtype)
        return poses, patches


def make_world(
    seed: int = 0,
    frames: int = 5,
    per_frame: int = 6,
    dtype: torch.dtype = torch.float64,
    intrinsics: tuple[float, float, float, float] = (85.0, 80.0, 80.0, 60.0),
    jitter_intrinsics: float = 0.0,
) -> World:
    """A random scene: cameras move by about 0.2 and turn by about 3 degrees, depths lie between 1 and 4."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64) * 2 - 1

    tangent = torch.cat((uniform(1, frames, 3) * 0.2, uniform(1, frames, 3) * 0.05), -1)
    tangent[:, 0] = 0
    poses = SE3.exp(tangent).data
    cameras = torch.tensor(intrinsics, dtype=torch.float64).repeat(1, frames, 1)
    cameras = cameras * (1 + jitter_intrinsics * uniform(1, frames, 4))
    count = frames * per_frame
    centre = torch.stack((80 + 50 * uniform(count), 60 + 35 * uniform(count)), 1).round()
    offset = torch.stack(torch.meshgrid(torch.arange(-1, 2), torch.arange(-1, 2), indexing="xy"))
    patches = torch.empty(1, count, 3, 3, 3, dtype=torch.float64)
    patches[0, :, :2] = centre[:, :, None, None] + offset
    patches[0, :, 2] = (0.625 + 0.375 * uniform(count))[:, None, None]
    kk = torch.arange(count).repeat_interleave(frames)
    jj = torch.arange(frames).repeat(count)
    order = torch.randperm(len(kk), generator=generator)
    kk, jj = kk[order], jj[order]
    ii = kk // per_frame
    target = pops.transform(SE3(poses), patches, cameras, ii, jj, kk)[:, :, 1, 1]
    weight = 0.6 + 0.4 * uniform(1, len(kk), 2)
    floats = [tensor.to(dtype) for tensor in (poses, patches, cameras, target, weight)]
    return World(floats[0], floats[1], floats[2], ii, jj, kk, floats[3], floats[4])


def join_worlds(worlds: list[World]) -> World:
    """Worlds of equal size as one block-diagonal problem, clip by clip."""
    frames, count = worlds[0].poses.shape[1], worlds[0].patches.shape[1]
    step = {"ii": frames, "jj": frames, "kk": count}
    labels = {
        name: torch.cat([getattr(world, name) + step[name] * clip for clip, world in enumerate(worlds)])
        for name in step
    }
    floats = {
        name: torch.cat([getattr(world, name) for world in worlds], 1)
        for name in ("poses", "patches", "intrinsics", "target", "weight")
    }
    return World(**floats, **labels)


def centre_pixels(poses: Tensor, inv_depth: Tensor, world: World) -> Tensor:
    """Projections (E,2) of the patch centres by 4x4 matrices, in float64; K of the source and the target frame."""
    matrices = SE3(poses.double()).matrix()[0]
    relative = matrices[world.jj] @ torch.linalg.inv(matrices[world.ii])
    x, y = world.patches[0, world.kk, :2, 1, 1].double().unbind(1)
    source, target = world.intrinsics[0, world.ii].double(), world.intrinsics[0, world.jj].double()
    ray = torch.stack(
        (
            (x - source[:, 2]) / source[:, 0],
            (y - source[:, 3]) / source[:, 1],
            torch.ones_like(x),
            inv_depth[world.kk].double(),
        ),
        1,
    )
    point = (relative @ ray[:, :, None])[:, :3, 0]
    return target[:, :2] * point[:, :2] / point[:, 2:] + target[:, 2:]


def dense_step(
    world: World, poses: Tensor, inv_depth: Tensor, free: list[int], ep: float, lmbda: float = 1e-4, lm: float = 1e-4
) -> tuple[Tensor, Tensor]:
    """One damped Gauss-Newton step (pose tangents (n,6), depths) by a numeric Jacobian and the full dense system."""
    frames, count = poses.shape[1], inv_depth.numel()
    size = 6 * len(free)

    def residual(x: Tensor) -> Tensor:
        tangent = torch.zeros(1, frames, 6, dtype=torch.float64)
        tangent[0, free] = x[:size].view(-1, 6)
        moved = SE3(poses.double()).retr(tangent).data
        return (world.target[0].double() - centre_pixels(moved, inv_depth.double() + x[size:], world)).flatten()

    step = 1e-6
    columns = []
    for unknown in range(size + count):
        x = torch.zeros(size + count, dtype=torch.float64)
        x[unknown] = step
        columns.append((residual(x) - residual(-x)) / (2 * step))
    J = -torch.stack(columns, 1)  # derivative of the projection
    w = world.weight[0].double().flatten()
    H, g = J.T @ (w[:, None] * J), J.T @ (w * residual(torch.zeros(size + count, dtype=torch.float64)))
    H[range(size, size + count), range(size, size + count)] += lmbda
    C, E = H[size:, size:], H[:size, size:]
    S = H[:size, :size] - E @ torch.linalg.solve(C, E.T)
    S = S + torch.diag(ep + lm * S.diagonal())
    dx = torch.linalg.solve(S, g[:size] - E @ torch.linalg.solve(C, g[size:]))
    return dx.view(-1, 6), torch.linalg.solve(C, g[size:] - E.T @ dx)
