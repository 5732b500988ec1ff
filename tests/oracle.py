"""A known scene, a known camera path, and a stand-in network that answers with the true flow.

The scene is a box seen from inside: three orthogonal walls at known distances, so a point lies on the scene exactly
when it lies on the nearest wall. Independent of the reference's oracle in `tests/data`.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from devo.devo import DEVO
from devo.lietorch import SE3

HEIGHT, WIDTH = 120, 160
INTRINSICS = torch.tensor([120.0, 118.0, 82.0, 58.0])
WALLS = torch.tensor([[0.0, 0.0, 1.0, 3.0], [0.6, 0.0, 0.8, 3.2], [0.0, 0.8, 0.6, 2.8]])  # normal, offset: n.X = d


class OracleScene:
    """Camera path and geometry; the first camera is the world frame.

    Args:
        frames: number of frames.
        step: distance between consecutive camera centres [scene units].
    """

    def __init__(self, frames: int, step: float) -> None:
        t = torch.arange(frames, dtype=torch.float64)
        centre = torch.stack([step * t, 0.12 * torch.sin(0.3 * t), 0.08 * torch.sin(0.2 * t)], dim=1)
        angle = torch.stack([0.03 * torch.sin(0.2 * t), -0.04 * torch.sin(0.15 * t), 0.02 * torch.sin(0.25 * t)], dim=1)
        world_T_cam = SE3(torch.cat([centre, torch.zeros(frames, 3), torch.ones(frames, 1)], dim=1).double())
        world_T_cam = world_T_cam * SE3.exp(torch.cat([torch.zeros(frames, 3), angle], dim=1))
        self.cam_T_world = world_T_cam.inv() * SE3(world_T_cam.data[:1].expand(frames, 7).clone())
        self.world_T_cam = self.cam_T_world.inv()

    def inv_depth(self, frame: Tensor, pixel: Tensor, intrinsics: Tensor) -> Tensor:
        """Inverse z-depth `(E,)` of pixels `(E,2)` in cameras `frame (E,)`: the nearest wall in front counts."""
        ray = torch.stack([(pixel[:, 0] - intrinsics[2]) / intrinsics[0], (pixel[:, 1] - intrinsics[3]) / intrinsics[1],
                           torch.ones(len(pixel), dtype=torch.float64)], dim=1)
        pose = self.world_T_cam.data[frame]
        rotation_only = torch.cat([torch.zeros(len(pose), 3, dtype=torch.float64), pose[:, 3:]], dim=1)
        direction, walls = SE3(rotation_only).act(ray), WALLS.double()
        return ((direction @ walls[:, :3].T) / (walls[:, 3] - pose[:, :3] @ walls[:, :3].T)).amax(dim=1)

    def distance(self, points: Tensor) -> Tensor:
        """Distance of world points `(K,3)` from the nearest wall [scene units]."""
        return (points @ WALLS[:, :3].double().T - WALLS[:, 3].double()).abs().amin(dim=1)

    def frames(self) -> Iterator[tuple[Tensor, Tensor, float]]:
        """A stream for the drivers: full voxels, since the oracle does not look at them."""
        for i in range(len(self.cam_T_world.data)):
            yield torch.ones(5, HEIGHT, WIDTH), INTRINSICS, 1e4 * i


class OracleNetwork(nn.Module):
    """The interface that the tracker uses of a network; `tracker` is set by `oracle_tracker`."""

    dim_inet = dim_fnet = dim = 8
    RES = 4.0
    P = 3
    tracker: DEVO

    def __init__(self, scene: OracleScene, noise_px: float = 0.0) -> None:
        super().__init__()
        self.scene, self.noise_px = scene, noise_px
        self.quarter = INTRINSICS.double() / 4

    def patchify(self, images: Tensor, patches_per_image: int = 80, **_: object) -> tuple:
        """Random patch centres, empty features."""
        height, width, M = images.shape[-2] // 4, images.shape[-1] // 4, patches_per_image
        centre = torch.stack([torch.randint(1, width - 1, (M,)), torch.randint(1, height - 1, (M,))], dim=1).float()
        offset = torch.arange(-1.0, 2.0)
        x = (centre[:, 0, None, None] + offset[None, None, :]).expand(M, 3, 3)
        y = (centre[:, 1, None, None] + offset[None, :, None]).expand(M, 3, 3)
        patches = torch.stack([x, y, torch.ones_like(x)], dim=1)[None]
        features = torch.zeros(1, 1, 8, height, width), torch.zeros(1, M, 8, 3, 3), torch.zeros(1, M, 8, 1, 1)
        return (*features, patches, None, torch.zeros(1, M, 1))

    def update(self, net: Tensor, inp: Tensor, corr: Tensor, flow: None, ii: Tensor, jj: Tensor, kk: Tensor) -> tuple:
        """The difference between true and current reprojection, with full confidence."""
        tracker = self.tracker
        newest = tracker.counter - 1
        stamps = tracker.tstamps_.clone()
        stamps[tracker.n] = newest  # the frame being probed is not counted in n yet
        host, seen = stamps[ii], stamps[jj]
        pixel = tracker.patches[0, kk, :2, 1, 1].double()
        inv_depth = self.scene.inv_depth(host, pixel, self.quarter)
        ray = torch.stack([(pixel[:, 0] - self.quarter[2]) / self.quarter[0],
                           (pixel[:, 1] - self.quarter[3]) / self.quarter[1], torch.ones_like(inv_depth)], dim=1)
        cameras = self.scene.cam_T_world.data
        moved = (SE3(cameras[seen]) * SE3(cameras[host]).inv()).act(ray / inv_depth[:, None])
        target = moved[:, :2] / moved[:, 2:] * self.quarter[:2] + self.quarter[2:]
        target = target + self.noise_px / 4 * torch.randn(target.shape, dtype=torch.float64)
        delta = target - tracker.reproject((ii, jj, kk))[0, :, :, 1, 1]
        return net, (delta[None].float(), torch.ones(1, len(kk), 2), None)


class OracleTracker(DEVO):
    """The real tracker; it only tells the oracle who it is."""

    def __init__(self, cfg: object, network: OracleNetwork, **options: object) -> None:
        super().__init__(cfg, network, **options)  # type: ignore[arg-type]
        network.tracker = self
