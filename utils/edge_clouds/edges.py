"""The edge cloud: edge pixels of every frame's events with depths borrowed from the frame's tracked patches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from devo.devo import DEVO
from devo.lietorch import SE3
from utils.clouds.cloud import PointCloud
from utils.clouds.io import write_cloud
from utils.edge_clouds.images import (
    camera_rays,
    crop_of,
    edge_pixels,
    event_image,
    full_resolution,
    interpolate_inv_depths,
    pooled_to_qres,
)
from utils.edge_clouds.settings import EdgeSettings
from utils.eval_utils import Frame
from utils.frame_bundle import FrameBundle


class EdgeRecorder:
    """Notes the edge pixels of every tracked frame; depths come at the end, when they are as good as they get.

    Pass the stream through `tap` and `on_frame` to `utils.eval_utils.track`. Kept are 8 bytes per edge pixel.
    """

    def __init__(self, settings: EdgeSettings) -> None:
        self.settings = settings
        self.crop = (0, 0)
        self._voxel: Tensor | None = None
        self._pixels: dict[int, Tensor] = {}

    def tap(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The same stream; the frame on its way is remembered."""
        for frame in frames:
            self._voxel = frame[0]
            yield frame

    def on_frame(self, tracker: DEVO) -> None:
        """Note the edge pixels of the frame just tracked; nothing before initialisation, as there are no depths."""
        if self._voxel is None or not tracker.is_initialized:
            return
        self.crop = crop_of(*self._voxel.shape[-2:])
        image = event_image(self._voxel, self.settings.downsample)
        pixels = edge_pixels(image, self.settings.topk, self.settings.border)
        self._pixels[tracker.counter - 1] = pixels.to("cpu", torch.int32)

    def cloud(self, bundle: FrameBundle) -> PointCloud:
        """The edge points of all frames of the bundle that were seen, one after the other."""
        parts = []
        for i in range(len(bundle)):
            pixels = self._pixels.get(int(bundle.frame_ids[i]))
            if pixels is not None:
                xy = pooled_to_qres(pixels, self.settings)
                rows, inv_depths = interpolate_inv_depths(xy, *bundle.seeds(i), self.settings)
                parts.append(points_of_frame(bundle, i, xy[rows], inv_depths, self.crop))
        return PointCloud.concat(parts)

    def write(self, out: str | PathLike[str], frame_data: Sequence[dict[str, Any]]) -> None:
        """Write the cloud of `TrackingResult.frame_data`; a missing suffix becomes `.npy`.

        Raises:
            InputError: an unknown suffix.
            OutputError: the file cannot be written.
        """
        target = Path(out)
        write_cloud(target if target.suffix else target.with_name(target.name + ".npy"),
                    self.cloud(FrameBundle.from_frames(frame_data)))


def points_of_frame(bundle: FrameBundle, i: int, xy: Tensor, inv_depths: Tensor, crop: tuple[int, int],
                    **scalars: Tensor) -> PointCloud:
    """World points of pixels `xy (N,2)` (qres px) with inverse depths `(N,)` in the camera of frame `i`.

    `X_w = world_T_cam (1/rho) ((x-cx)/fx, (y-cy)/fy, 1)`. The cloud says for each point: host frame, time stamp,
    full-resolution pixel, depth, inverse depth, and the given `scalars (N,)`.
    """
    intrinsics = torch.from_numpy(bundle.intrinsics[i]).to(xy.device)
    cam_T_world = torch.from_numpy(bundle.cam_T_world[i]).to(xy.device, torch.float64)[None]
    in_camera = camera_rays(xy.double(), intrinsics.double()) / inv_depths.double()[:, None]
    points = SE3(cam_T_world).inv().act(in_camera)
    pixels = full_resolution(xy, crop)
    count = len(xy)
    return PointCloud(points.cpu().numpy().astype(np.float32), None, {
        "host_frame": np.full(count, bundle.frame_ids[i], np.int32), "t_us": np.full(count, bundle.t_us[i]),
        "pixel_x": pixels[:, 0], "pixel_y": pixels[:, 1], "depth": (1.0 / inv_depths).cpu().numpy(),
        "inv_depth": inv_depths.cpu().numpy(), **{name: values.cpu().numpy() for name, values in scalars.items()}})
