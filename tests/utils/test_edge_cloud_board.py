"""The focus-refined edge cloud on a simulated board: with true poses the points move onto the board."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from devo.poses import invert_poses_numpy
from utils.clouds.cloud import PointCloud
from utils.datasets.registry import SequenceOptions, open_sequence
from utils.edge_clouds.focus import refine_edges
from utils.edge_clouds.images import edge_pixels, event_image
from utils.edge_clouds.settings import FocusSettings
from utils.frame_bundle import FrameBundle
from utils.simulator.dataset_folder import FolderOptions, write_recording
from utils.simulator.sequence import SequenceSettings, SimulatedSequence

WRONG = 0.1  # standard deviation of the error of a frame's depths, common to all its patches


@pytest.mark.slow
def test_points_move_onto_the_board(tmp_path: Path) -> None:
    settings = SequenceSettings(scene="board", seconds=2.0, seed=1)
    write_recording(tmp_path / "board", settings, FolderOptions(depth=False))
    frames = list(open_sequence("generic", tmp_path / "board", SequenceOptions()).voxels())
    simulated = SimulatedSequence(settings)
    depth = torch.cat([simulated.depth(np.array([t_us])) for _, _, t_us in frames])
    bundle = wrong_bundle(frames, simulated, depth)
    chosen = FocusSettings(downsample=2, support=6, support_stride=3, patch_radius=0, topk=1500, keyframe_stride=12)
    cloud = PointCloud.concat([
        PointCloud(part.points, None, part.scalars) for part in refine_edges(iter(frames), bundle, chosen)])
    values = cloud.scalars
    host = np.searchsorted(bundle.frame_ids, values["host_frame"])
    pixel = np.rint(np.stack([values["pixel_y"], values["pixel_x"]])).astype(int)
    truth = depth.numpy()[host, pixel[0].clip(0, 179), pixel[1].clip(0, 239)]
    on_board = truth > 0
    refined = np.median(np.abs(values["depth"] / truth - 1)[on_board])
    guessed = np.median(np.abs(1 / values["prior_inv_depth"] / truth - 1)[on_board])
    plane = simulated.world.planes
    normal, origin = plane.normal[0, 0].double().numpy(), plane.origin[0, 0].double().numpy()
    distance = np.median(np.abs((cloud.points - origin) @ normal)[on_board])
    figures = f"{len(cloud)} points, depth wrong by {guessed:.2%} before and {refined:.2%} after, {distance:.4f} m off"
    assert len(cloud) > 1000 and refined < 0.03 and refined < 0.5 * guessed and distance < 0.03, figures


def wrong_bundle(frames: list, simulated: SimulatedSequence, depth: torch.Tensor) -> FrameBundle:
    """True poses; patches at strong edges, the depths of each frame wrong by a common factor and a little noise."""
    generator = torch.Generator().manual_seed(0)
    poses = simulated.path.poses(np.array([t_us for _, _, t_us in frames])).numpy()
    data = []
    for i, (voxel, intrinsics, t_us) in enumerate(frames):
        pixels = edge_pixels(event_image(voxel, 4), 1500, 2)
        centers = pixels[torch.randperm(len(pixels), generator=generator)[:96]]
        z = depth[i][(4 * centers[:, 1]).clamp(max=179), (4 * centers[:, 0]).clamp(max=239)]
        centers, z = centers[z > 0].float(), z[z > 0]
        factor = torch.exp(WRONG * torch.randn(1, generator=generator))
        noise = torch.exp(0.02 * torch.randn(len(z), generator=generator))
        data.append({"frame_id": i, "timestamp": t_us, "pose": invert_poses_numpy(poses[i]),
                     "intrinsics": (intrinsics / 4).numpy(), "points": np.zeros((len(z), 3)),
                     "inv_depths": (factor * noise / z).numpy(), "centers": centers.numpy()})
    return FrameBundle.from_frames(data)
