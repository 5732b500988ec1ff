"""Events of dots on the walls of the oracle's scene: what a camera would see whose true path is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from devo.lietorch import SE3
from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleScene

FRAME_US = 10_000
DOTS_PER_VIEW = 400  # 2 % of the cells of a voxel grid have to be filled


def wall_points(scene: OracleScene, count: int, seed: int = 0, margin: float = 0.0, frame: int | None = None) -> Tensor:
    """World points `(count,3)` float64 on the walls.

    They are seen in a frame (default: the middle one), at least the share `margin` of its size off the border.
    """
    generator = torch.Generator().manual_seed(seed)
    frames = len(scene.cam_T_world.data)
    host = torch.full((count,), frames // 2 if frame is None else frame)
    share = margin + (1.0 - 2.0 * margin) * torch.rand(count, 2, generator=generator, dtype=torch.float64)
    pixel = share * torch.tensor([WIDTH, HEIGHT])
    inv_depth = scene.inv_depth(host, pixel, INTRINSICS.double())
    ray = torch.cat([(pixel - INTRINSICS[2:]) / INTRINSICS[:2], torch.ones(count, 1)], dim=1)
    return SE3(scene.world_T_cam.data[host]).act(ray / inv_depth[:, None])


def project(scene: OracleScene, points: Tensor, frame: int) -> Tensor:
    """Full-resolution pixels `(N,2)` of world points in a frame; NaN behind the camera."""
    seen = SE3(scene.cam_T_world.data[frame].expand(len(points), 7).clone()).act(points)
    pixel = seen[:, :2] / seen[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    return torch.where(seen[:, 2:] > 0, pixel, torch.nan)


def write_recording(path: Path, scene: OracleScene) -> Path:
    """An event file `(x y t p)` in which every dot fires in every time bin of every frame of `FRAME_US`."""
    frames, columns = len(scene.cam_T_world.data), []
    views = (0, frames // 3, 2 * frames // 3, frames - 1)
    points = torch.cat([wall_points(scene, DOTS_PER_VIEW, seed=view, frame=view) for view in views])
    for frame in range(frames):
        pixel = torch.round(project(scene, points, frame)).numpy()
        inside = (pixel >= 0).all(axis=1) & (pixel[:, 0] < WIDTH) & (pixel[:, 1] < HEIGHT)
        times = frame * FRAME_US + np.linspace(1, FRAME_US - 1, 6).astype(np.int64)
        columns.append(np.concatenate([np.column_stack([pixel[inside], np.full(inside.sum(), t)]) for t in times]))
    table = np.concatenate(columns).astype(np.int64)
    np.savez(path, x=table[:, 0].astype(np.uint16), y=table[:, 1].astype(np.uint16), t=table[:, 2],
             p=np.ones(len(table), np.uint8))
    return path
