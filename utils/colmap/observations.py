"""Where the odometry measured its points: one row per point and keyframe, read from the tracker at the end of a run."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from utils.array_files import save_arrays
from utils.clouds.arrays import load_arrays
from utils.clouds.table import reject

if TYPE_CHECKING:
    from devo.devo import DEVO


@dataclass(frozen=True, eq=False)
class Observations:
    """Measurements of points in frames, sorted by point, then frame; no pair occurs twice.

    Attributes:
        points: how many points there are.
        point: `(E,)` int64 row of the raw cloud.
        frame: `(E,)` int64 row of the poses.
        pixel_xy: `(E, 2)` float32 full-resolution pixels of the undistorted image; (0, 0) is the centre of a pixel.
        weight: `(E,)` float32 confidence in 0..1; 1 in the host frame, where the point was chosen.
    """

    points: int
    point: npt.NDArray[np.int64]
    frame: npt.NDArray[np.int64]
    pixel_xy: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.point)

    def select(self, rows: npt.NDArray[np.bool_]) -> Observations:
        """The chosen rows."""
        return Observations(self.points, self.point[rows], self.frame[rows], self.pixel_xy[rows], self.weight[rows])

    @staticmethod
    def of_hosts(host_frame: npt.ArrayLike, pixel_xy: npt.ArrayLike) -> Observations:
        """Only the place where each point was chosen, in its host frame."""
        hosts = np.asarray(host_frame, np.int64)
        return Observations(len(hosts), np.arange(len(hosts)), hosts, np.asarray(pixel_xy, np.float32),
                            np.ones(len(hosts), np.float32))

    def joined(self, other: Observations) -> Observations:
        """Both; where a pair of point and frame occurs twice, this one's row counts."""
        point, frame = np.concatenate([self.point, other.point]), np.concatenate([self.frame, other.frame])
        pixel = np.concatenate([self.pixel_xy, other.pixel_xy])
        weight = np.concatenate([self.weight, other.weight])
        span = int(frame.max(initial=0)) + 1
        rows = np.unique(point * span + frame, return_index=True)[1]
        return Observations(self.points, point[rows], frame[rows], pixel[rows], weight[rows])


def observations_of(tracker: DEVO) -> Observations:
    """All measurements of the points of a run, in the order of its raw cloud.

    Call it where `Observables` are read: at the end, before the tracker is changed again.
    """
    import torch

    from devo.trajectory import backproject

    m = tracker.m
    hosts, patches = tracker.ix[:m], tracker.patches[0, :m]
    points, _, centers = backproject(tracker.poses_[hosts], patches, tracker.intrinsics_[hosts])
    finite = torch.isfinite(points).all(dim=1)
    row_of_patch = torch.where(finite, finite.long().cumsum(0) - 1, -1)
    crop = torch.tensor([tracker.crop_left, tracker.crop_top], device=tracker.device)
    edges = tracker.all_edges()
    edges = edges.select((edges.ii != edges.jj) & (edges.weight > 0).any(dim=1) & (row_of_patch[edges.kk] >= 0))

    def array(values: torch.Tensor, kind: type) -> np.ndarray:
        return values.cpu().numpy().astype(kind)

    seen = Observations(int(finite.sum()), array(row_of_patch[edges.kk], np.int64),
                        array(tracker.tstamps_[edges.jj], np.int64),
                        array(edges.target * tracker.RES + crop, np.float32),
                        array(edges.weight.mean(dim=1), np.float32))
    chosen = Observations.of_hosts(array(tracker.tstamps_[hosts[finite]], np.int64),
                                   array(centers[finite] * tracker.RES + crop, np.float32))
    return chosen.joined(seen)


def save_observations(path: str | os.PathLike[str], found: Observations) -> Path:
    """Write `<base>_observations.npz`.

    Raises:
        OutputError: the file cannot be written.
    """
    return save_arrays(Path(path), {
        "points": np.array(found.points), "point": found.point.astype(np.int32), "frame": found.frame.astype(np.int32),
        "pixel_xy": found.pixel_xy, "weight": found.weight})


def read_observations(path: str | os.PathLike[str]) -> Observations:
    """Read `<base>_observations.npz`.

    Raises:
        InputError: the file is missing or damaged, or its arrays do not fit together.
    """
    arrays = load_arrays(path)
    missing = [name for name in ("points", "point", "frame", "pixel_xy", "weight") if name not in arrays]
    if missing:
        reject(path, f"holds no observations: {', '.join(missing)} missing, found {', '.join(sorted(arrays))}")
    count = arrays["point"].size
    shapes = {"points": (), "point": (count,), "frame": (count,), "pixel_xy": (count, 2), "weight": (count,)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape or arrays[name].dtype.kind not in "iuf":
            reject(path, f"{name} is {arrays[name].dtype} of shape {arrays[name].shape}, expected numbers {shape}")
    total = int(arrays["points"])
    for name, end in (("point", total), ("frame", 2**31)):
        if count and not (arrays[name].min() >= 0 and arrays[name].max() < end):
            reject(path, f"{name} holds numbers that are negative or too large")
    return Observations(total, arrays["point"].astype(np.int64), arrays["frame"].astype(np.int64),
                        arrays["pixel_xy"].astype(np.float32), arrays["weight"].astype(np.float32))
