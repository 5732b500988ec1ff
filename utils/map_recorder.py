"""Write what the map looks like while a run goes on: one cloud per frame, the combined and the accumulated map."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import torch

from devo.devo import DEVO
from devo.trajectory import accumulated_map
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
    """

    def __init__(self, frame_folder: Path | None = None, voxel_size: float = 0.05,
                 full_map_out: str | PathLike[str] | None = None,
                 full_map_color_out: str | PathLike[str] | None = None) -> None:
        self.frame_folder, self.voxel_size = frame_folder, voxel_size
        self.full_map_out, self.full_map_color_out = full_map_out, full_map_color_out
        self.written: list[Path] = []

    @property
    def wants_map(self) -> bool:
        """Whether the tracker has to keep removed keyframes."""
        return self.frame_folder is not None or bool(self.full_map_out or self.full_map_color_out)

    def on_frame(self, tracker: DEVO) -> None:
        """Write the current map after a frame; nothing before initialisation, when depths are still random."""
        if self.frame_folder is None or not tracker.is_initialized:
            return
        points = tracker.world_points()
        finite = points[torch.isfinite(points).all(dim=1)]
        path = self.frame_folder / f"cloud_{tracker.counter:05d}.ply"
        write_cloud(path, PointCloud(finite.cpu().numpy()))
        self.written.append(path)

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


def save_array(path: str | PathLike[str], values: np.ndarray) -> Path:
    """Save one array as `.npy`, completely or not at all; a missing suffix is added, as NumPy does.

    Raises:
        OutputError: the file cannot be written.
    """
    from utils.atomic import atomic_path

    target = Path(path)
    if target.suffix != ".npy":
        target = target.with_name(target.name + ".npy")
    with atomic_path(target) as temporary:
        np.save(temporary, values, allow_pickle=False)
    return target
