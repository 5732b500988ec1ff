"""TartanAir clips: frame graph by induced flow, clip sampling, conversion of poses and depths; no files are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from devo.data_readers.base import TrainingClips
from devo.errors import InputError

DEPTH_SCALE = 5.0
INTRINSICS = (320.0, 320.0, 320.0, 240.0)
CELL = 16
FLOW_LIMIT = 100.0
GRAPH_LIMIT = 256.0
NED_TO_CAMERA = (1, 2, 0, 4, 5, 3, 6)


def camera_poses(rows: np.ndarray) -> np.ndarray:
    """Poses of `pose_left.txt` in OpenCV camera axes and network units.

    Args:
        rows: (N,7) `tx ty tz qx qy qz qw`, NED axes, camera -> world, metres.

    Returns:
        (N,7) float32 camera -> world, translations divided by 5.

    Raises:
        InputError: not seven columns.
    """
    if rows.ndim != 2 or rows.shape[1] != 7:
        raise InputError(f"TartanAir poses have shape {rows.shape}; expected (N, 7) rows 'tx ty tz qx qy qz qw'")
    poses = rows[:, NED_TO_CAMERA].astype(np.float32)
    poses[:, :3] /= DEPTH_SCALE
    return poses


def inverse_depth(depth_m: np.ndarray) -> np.ndarray:
    """Inverse depth (H,W) float32 in network units; infinite and invalid depths count as 1 unit, as published."""
    depth = depth_m.astype(np.float32) / DEPTH_SCALE
    usable = np.isfinite(depth) & (depth > 1e-3)
    return (1.0 / np.where(usable, depth, 1.0)).astype(np.float32)


def _induced_flow(relative: Tensor, disparity: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Flow magnitude and validity (K,h,w) of coarse grids under relative poses (K,4,4); disparity (K,h,w)."""
    rows, columns = disparity.shape[-2:]
    fx, fy, cx, cy = intrinsics
    y, x = torch.meshgrid(
        torch.arange(rows, dtype=torch.float32), torch.arange(columns, dtype=torch.float32), indexing="ij"
    )
    rays = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], dim=-1)
    moved = (
        torch.einsum("kij,hwj->khwi", relative[:, :3, :3], rays) + relative[:, None, None, :3, 3] * disparity[..., None]
    )
    z = moved[..., 2]
    near = torch.where(z < 0.1, torch.ones_like(z), z)
    flow = torch.stack([fx * moved[..., 0] / near + cx - x, fy * moved[..., 1] / near + cy - y], dim=-1)
    return flow.norm(dim=-1).clamp(max=FLOW_LIMIT), (z > 0.2).float()


def frame_graph(world_T_cam: np.ndarray, disparity: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Mean induced flow between all frames of a scene.

    Args:
        world_T_cam: (N,7) poses in network units.
        disparity: (N,30,40) inverse depth sampled at rows and columns 8::16 of the 480x640 maps.

    Returns:
        for each frame the frames closer than 256 px and their distances (full-resolution px, ascending by frame);
        a frame is its own neighbour with the flow of a small sideways motion.
    """
    from devo.lietorch import SE3

    poses = torch.from_numpy(np.asarray(world_T_cam, np.float32))
    depth = torch.from_numpy(np.asarray(disparity, np.float32))
    far = 1.0 / depth.clamp(min=1e-6)
    mean = torch.stack([d[d >= 0.01].mean() if bool((d >= 0.01).any()) else torch.tensor(1.0) for d in far])
    depth = 1.0 / torch.where(far < 0.01, mean[:, None, None], far)
    intrinsics = torch.tensor(INTRINSICS) / CELL
    cam_T_world = SE3(poses).inv().matrix()
    world = SE3(poses).matrix()
    sideways = torch.eye(4)
    sideways[0, 3] = -0.1
    graph = []
    for i in range(len(poses)):
        to_others = cam_T_world @ world[i]
        from_others = cam_T_world[i] @ world
        to_others[i] = from_others[i] = sideways
        there, seen_there = _induced_flow(to_others, depth[i].expand_as(depth), intrinsics)
        back, seen_back = _induced_flow(from_others, depth, intrinsics)
        seen = torch.stack([seen_there, seen_back]).flatten(2)
        flow = torch.stack([there, back]).flatten(2)
        share = seen.mean(dim=(0, 2))
        distance = CELL * (flow * seen).sum(dim=(0, 2)) / seen.sum(dim=(0, 2)).clamp(min=1)
        distance = torch.where(share < 0.7, torch.full_like(distance, torch.inf), distance)
        near = (distance < GRAPH_LIMIT).nonzero()[:, 0]
        graph.append((near.numpy(), distance[near].numpy()))
    return graph


def walk(
    graph: list[tuple[np.ndarray, np.ndarray]],
    start: int,
    frames: int,
    rng: np.random.Generator,
    flow_range: tuple[float, float] = (10.0, 75.0),
) -> list[int]:
    """Frame numbers of one clip: always on to a random later neighbour whose flow lies inside `flow_range` pixels."""
    chosen = [start]
    while len(chosen) < frames:
        i = chosen[-1]
        neighbours, distance = graph[i]
        fitting = neighbours[(distance > flow_range[0]) & (distance < flow_range[1])]
        later = fitting[fitting > i]
        if len(later):
            i = int(rng.choice(later))
        elif i + 1 < len(graph):
            i += 1
        elif len(fitting):
            i = int(rng.choice(fitting))
        chosen.append(i)
    return chosen


@dataclass(frozen=True)
class TartanScene:
    """One recording; voxel k belongs to pose and depth k (the recording's first frame has no voxel and is dropped).

    Attributes:
        name: scene string of the split files.
        world_T_cam: (N,7) network units.
        graph: see `frame_graph`.
        load: frame number -> voxel (5,H,W) and depth (H,W) in metres.
    """

    name: str
    world_T_cam: np.ndarray  # noqa: N815
    graph: list[tuple[np.ndarray, np.ndarray]]
    load: Callable[[int], tuple[np.ndarray, np.ndarray]]

    def starts(self, frames: int) -> np.ndarray:
        """Frames with more than `frames` neighbours: those a clip may start at."""
        return np.array([i for i, (neighbours, _) in enumerate(self.graph) if len(neighbours) > frames], dtype=np.int64)

    def clip(self, start: int, frames: int, rng: np.random.Generator) -> TrainingClips:
        """One clip (B = 1), not augmented.

        Raises:
            InputError: voxel and depth of a frame differ in size.
        """
        chosen = walk(self.graph, start, frames, rng)
        loaded = [self.load(i) for i in chosen]
        for i, (voxel, depth) in zip(chosen, loaded):
            if voxel.shape[-2:] != depth.shape:
                raise InputError(f"{self.name} frame {i}: voxel {voxel.shape} and depth {depth.shape} differ in size")
        voxels = torch.from_numpy(np.stack([voxel.astype(np.float32) for voxel, _ in loaded]))
        depths = torch.from_numpy(np.stack([inverse_depth(depth) for _, depth in loaded]))
        poses = torch.from_numpy(self.world_T_cam[chosen].astype(np.float32))
        intrinsics = torch.tensor(INTRINSICS).expand(frames, 4)
        return TrainingClips(voxels[None], poses[None], depths[None], intrinsics[None].contiguous())
