"""The structure per frame as one file, `frames.npz`: poses, intrinsics, patch centres, depths and points.

| key | shape, dtype | meaning |
|---|---|---|
| `frame_ids` | `(F,)` int64 | row of the frame in the trajectory |
| `timestamps` | `(F,)` float64 | microseconds |
| `poses` | `(F,7)` float32 | `cam_T_world` (world to camera), `tx ty tz qx qy qz qw` |
| `intrinsics` | `(F,4)` float32 | `fx fy cx cy` at quarter resolution, of the cropped image |
| `counts`, `offsets` | `(F,)` int32, int64 | points per frame and where they begin |
| `points` | `(K,3)` float32 | world frame |
| `depths`, `inv_depths` | `(K,)` float32 | z-depth in the frame's camera and its inverse |
| `centers` | `(F, max(counts), 2)` float32 | patch centres, quarter-resolution px, NaN-padded |
| `keyframe` | `(F,)` bool | whether the frame is still a keyframe at the end |
| `pose_convention`, `depths_convention` | text | `T_cam_world`, `z-depth` |

Files of the published tool lack the last three rows and hold inverse depths as `depths`; the reader knows that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from devo.errors import InputError
from devo.poses import invert_poses_numpy, normalize_poses_numpy
from utils.array_files import save_arrays
from utils.clouds.arrays import load_arrays
from utils.clouds.table import reject

_NEEDED = {"timestamps": 1, "poses": 2, "intrinsics": 2, "counts": 1, "offsets": 1, "depths": 1, "centers": 3}


@dataclass(frozen=True, eq=False)
class FrameBundle:
    """The frames of a run, in time order.

    Attributes:
        frame_ids: `(F,)` int64. t_us: `(F,)` float64. cam_T_world: `(F,7)` float64. intrinsics: `(F,4)` float32, qres.
        offsets: `(F+1,)` int64; the patches of frame i are the rows `offsets[i]:offsets[i+1]` of what follows.
        centers: `(K,2)` float32, qres px. inv_depths: `(K,)` float32. points: `(K,3)` float32, world frame.
        keyframe: `(F,)` bool.
    """

    frame_ids: np.ndarray
    t_us: np.ndarray
    cam_T_world: np.ndarray  # noqa: N815 - the frame notation of the project
    intrinsics: np.ndarray
    offsets: np.ndarray
    centers: np.ndarray
    inv_depths: np.ndarray
    points: np.ndarray
    keyframe: np.ndarray

    def __len__(self) -> int:
        return len(self.frame_ids)

    @classmethod
    def from_frames(cls, frame_data: Sequence[dict[str, Any]], keyframe_ids: np.ndarray | None = None) -> FrameBundle:
        """The bundle of `TrackingResult.frame_data`; `keyframe_ids` are the frames that are keyframes at the end."""
        def stacked(key: str, columns: int, kind: type) -> np.ndarray:
            return np.array([frame[key] for frame in frame_data], dtype=kind).reshape(-1, columns)

        def joined(key: str, shape: tuple[int, ...]) -> np.ndarray:
            parts = [np.zeros((0, *shape), np.float32), *(frame[key] for frame in frame_data)]
            return np.concatenate(parts).astype(np.float32)

        ids = np.array([frame["frame_id"] for frame in frame_data], dtype=np.int64)
        counts = [len(frame["inv_depths"]) for frame in frame_data]
        return cls(
            frame_ids=ids, t_us=np.array([frame["timestamp"] for frame in frame_data], dtype=np.float64),
            cam_T_world=stacked("pose", 7, np.float64), intrinsics=stacked("intrinsics", 4, np.float32),
            offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), centers=joined("centers", (2,)),
            inv_depths=joined("inv_depths", ()), points=joined("points", (3,)),
            keyframe=np.isin(ids, [] if keyframe_ids is None else keyframe_ids))

    def rows(self, i: int) -> slice:
        """Where the patches of frame `i` are."""
        return slice(int(self.offsets[i]), int(self.offsets[i + 1]))

    def seeds(self, i: int, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
        """Patch centres `(n,2)` (qres px) and inverse depths `(n,)` of frame `i`, float32."""
        rows = self.rows(i)
        return (torch.from_numpy(self.centers[rows]).to(device), torch.from_numpy(self.inv_depths[rows]).to(device))

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of the file, see the top of this module."""
        counts = np.diff(self.offsets)
        width = int(counts.max(initial=0))
        padded = np.full((len(self), width, 2), np.nan, dtype=np.float32)
        padded[np.arange(width) < counts[:, None]] = self.centers
        with np.errstate(divide="ignore"):
            depths = (1.0 / self.inv_depths).astype(np.float32)
        return {
            "frame_ids": self.frame_ids, "timestamps": self.t_us, "poses": self.cam_T_world.astype(np.float32),
            "intrinsics": self.intrinsics, "counts": counts.astype(np.int32), "offsets": self.offsets[:-1],
            "points": self.points, "depths": depths, "inv_depths": self.inv_depths, "centers": padded,
            "keyframe": self.keyframe, "pose_convention": np.array("T_cam_world"),
            "depths_convention": np.array("z-depth"),
        }


def write_frame_bundle(path: str | PathLike[str], bundle: FrameBundle) -> Path:
    """Write the bundle as `.npz` without pickles, completely or not at all; a missing suffix is added.

    Raises:
        OutputError: the file cannot be written.
    """
    return save_arrays(path, bundle.arrays())


def read_frame_bundle(path: str | PathLike[str]) -> FrameBundle:
    """Read `frames.npz`, ours or one of the published tool.

    Raises:
        InputError: the file is missing or damaged, or its arrays do not fit together.
    """
    arrays = load_arrays(path)
    _check_shapes(path, arrays)
    frames = len(arrays["timestamps"])
    counts = arrays["counts"].astype(np.int64)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    total = int(offsets[-1])
    filled = np.arange(arrays["centers"].shape[1]) < counts[:, None]
    if not np.array_equal(arrays["offsets"], offsets[:-1]) or len(arrays["depths"]) != total or filled.sum() != total:
        reject(path, f"counts say {total} patches, found {len(arrays['depths'])} depths and other offsets or centers")
    try:
        poses = normalize_poses_numpy(arrays["poses"])
    except InputError as error:
        reject(path, str(error))
    if str(arrays.get("pose_convention", "T_cam_world")) == "T_world_cam":
        poses = invert_poses_numpy(poses)
    return FrameBundle(
        frame_ids=arrays.get("frame_ids", np.arange(frames)).astype(np.int64),
        t_us=arrays["timestamps"].astype(np.float64), cam_T_world=poses,
        intrinsics=arrays["intrinsics"].astype(np.float32), offsets=offsets,
        centers=arrays["centers"].astype(np.float32)[filled], inv_depths=_inverse_depths(arrays),
        points=arrays.get("points", np.full((total, 3), np.nan)).astype(np.float32),
        keyframe=arrays.get("keyframe", np.zeros(frames)).astype(bool))


def _check_shapes(path: str | PathLike[str], arrays: dict[str, np.ndarray]) -> None:
    missing = sorted(set(_NEEDED) - set(arrays))
    if missing:
        reject(path, f"is no frame bundle: {', '.join(missing)} missing, found {', '.join(sorted(arrays)) or 'nothing'}"
                     "; make one with export_pointcloud.py --export_frame_data")
    frames = len(np.atleast_1d(arrays["timestamps"]))
    total = len(np.atleast_1d(arrays["depths"]))
    wanted: dict[str, tuple[int, ...]] = {
        "timestamps": (frames,), "poses": (frames, 7), "intrinsics": (frames, 4), "counts": (frames,),
        "offsets": (frames,), "frame_ids": (frames,), "keyframe": (frames,), "depths": (total,),
        "inv_depths": (total,), "points": (total, 3)}
    for name, shape in wanted.items():
        if name in arrays and arrays[name].shape != shape:
            reject(path, f"{name} has shape {arrays[name].shape}, expected {shape}")
    if arrays["centers"].ndim != 3 or arrays["centers"].shape[::2] != (frames, 2):
        reject(path, f"centers have shape {arrays['centers'].shape}, expected ({frames}, n, 2)")
    if np.any(arrays["counts"] < 0) or int(arrays["counts"].max(initial=0)) > arrays["centers"].shape[1]:
        reject(path, "counts are negative or larger than the number of centers per frame")
    for name in ("timestamps", "poses", "intrinsics"):
        if arrays[name].dtype.kind not in "iuf" or not np.isfinite(arrays[name]).all():
            reject(path, f"{name} holds values that are not finite numbers")
    if np.any(np.diff(arrays["timestamps"]) <= 0):
        reject(path, "timestamps do not increase")


def _inverse_depths(arrays: dict[str, np.ndarray]) -> np.ndarray:
    if "inv_depths" in arrays:
        return arrays["inv_depths"].astype(np.float32)
    if str(arrays.get("depths_convention", "")).startswith("z-depth"):
        with np.errstate(divide="ignore"):
            return (1.0 / arrays["depths"]).astype(np.float32)
    return arrays["depths"].astype(np.float32)  # untagged files of the published tool call inverse depths so
