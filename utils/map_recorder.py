"""Write what the map looks like while a run goes on: one cloud per frame, the combined and the accumulated map."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import torch

from devo.devo import DEVO
from devo.lietorch import SE3
from devo.trajectory import accumulated_map
from utils.array_files import save_array
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import voxel_downsample
from utils.clouds.io import write_cloud

COMBINED_MAP = "combined_map.ply"


class MapRecorder:
    """Callbacks for `utils.eval_utils.track`; every output is optional and nothing foreign is ever deleted.

    Args:
        frame_folder: where `cloud_%05d.ply` (number = accepted frames so far) and `combined_map.ply` go; None for none.
        voxel_size: edge length of the combined map's voxels, trajectory units.
        full_map_out, full_map_color_out: array files for the accumulated map and its colours.
        keep: which of the clouds per frame stay: `all`, only the `last` one, or `none` (they are not written at all).

    Attributes:
        written: files other than the clouds per frame.
        frame_clouds: how many clouds per frame were written.
    """

    def __init__(self, frame_folder: Path | None = None, voxel_size: float = 0.05,
                 full_map_out: str | PathLike[str] | None = None,
                 full_map_color_out: str | PathLike[str] | None = None, keep: str = "all") -> None:
        self.frame_folder, self.voxel_size, self.keep = frame_folder, voxel_size, keep
        self.full_map_out, self.full_map_color_out = full_map_out, full_map_color_out
        self.written: list[Path] = []
        self.frame_clouds = 0
        self._previous: Path | None = None

    @property
    def wants_map(self) -> bool:
        """Whether the tracker has to keep removed keyframes."""
        return self.frame_folder is not None or bool(self.full_map_out or self.full_map_color_out)

    def on_frame(self, tracker: DEVO) -> None:
        """Write the current map after a frame; nothing before initialisation, when depths are still random.

        Every file is complete or absent, so what a crash leaves behind can be used.
        """
        if self.frame_folder is None or self.keep == "none" or not tracker.is_initialized:
            return
        points = tracker.world_points()
        finite = torch.isfinite(points).all(dim=1)
        hosts = tracker.tstamps_[tracker.ix[:tracker.m]][finite].cpu().numpy()
        path = self.frame_folder / f"cloud_{tracker.counter:05d}.ply"
        write_cloud(path, PointCloud(points[finite].cpu().numpy(), None, {"host_frame": hosts.astype(np.int32)},
                                     frame_metadata(tracker)))
        if self.keep == "last" and self._previous is not None and self._previous != path:
            self._previous.unlink(missing_ok=True)  # written by this run
        self._previous = path
        self.frame_clouds += 1

    def on_end(self, tracker: DEVO) -> None:
        """Write the combined and the accumulated map; an uninitialised run has none."""
        if not self.wants_map or not tracker.is_initialized:
            return
        points, colors = accumulated_map(tracker)
        if self.frame_folder is not None:
            everything = PointCloud(points, colors)
            kept, _ = voxel_downsample(everything, voxel_size=self.voxel_size)
            write_cloud(self.frame_folder / COMBINED_MAP, everything.select(kept))
            self.written.append(self.frame_folder / COMBINED_MAP)
        for path, values in ((self.full_map_out, points), (self.full_map_color_out, colors)):
            if path is not None:
                self.written.append(save_array(path, values))


def frame_metadata(tracker: DEVO) -> dict[str, str]:
    """What a cloud per frame says about its moment: frame, time stamp, newest camera, keyframes."""
    world_T_cam = SE3(tracker.poses_[tracker.n - 1].double()).inv().data.tolist()
    return {"frame_id": str(tracker.counter - 1), "t_us": f"{tracker.tlist[-1]:.3f}", "keyframes": str(tracker.n),
            "world_T_cam": " ".join(f"{value:.9g}" for value in world_T_cam), "scale": "arbitrary"}
