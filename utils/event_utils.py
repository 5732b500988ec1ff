"""The event helpers under the module name that users of DEVO know; the code lives in `utils.events` and beside it."""

from __future__ import annotations

from utils.events.reader import open_events
from utils.events.slicing import EventSlicer
from utils.events.types import Events
from utils.events.writers import EventH5Writer, compute_ms_to_idx, write_events_h5, write_evs_arr_to_h5
from utils.undistort import read_rectify_map, rectify_map, write_rectify_map
from utils.voxel_grid import VoxelRectifier, remove_hot_pixels, to_voxel_grid

__all__ = [
    "EventH5Writer",
    "EventSlicer",
    "Events",
    "VoxelRectifier",
    "compute_ms_to_idx",
    "open_events",
    "read_rectify_map",
    "rectify_map",
    "remove_hot_pixels",
    "to_voxel_grid",
    "write_events_h5",
    "write_evs_arr_to_h5",
    "write_rectify_map",
]
