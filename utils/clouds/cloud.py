"""The point cloud that every reader returns and every writer takes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from devo.errors import InputError

_SCALAR_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
RESERVED_NAMES = frozenset({"x", "y", "z", "rgb", "rgba", "red", "green", "blue", "points", "colors", "metadata", "_"})
"""Names that a per-point scalar may not have, because the file formats give them a meaning of their own."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with optional colours, named per-point values and text about the whole.

    Attributes:
        points: `(N, 3)` float32, xyz in the frame and unit that `metadata` names (clouds of the odometry: world
            frame = first camera, OpenCV axes, arbitrary scale). Non-finite rows are allowed, see `finite_mask`.
        colors: `(N, 3)` uint8 red, green, blue, or None.
        scalars: name -> `(N,)` array of a boolean, integer or float type, for example `host_frame`, `t_us`, `depth`.
        metadata: text -> text, kept as comments by PLY and PCD.

    Raises:
        InputError: a shape, type or name does not fit.
    """

    points: np.ndarray
    colors: np.ndarray | None = None
    scalars: Mapping[str, np.ndarray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        points = np.asarray(self.points)
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "biuf":
            raise InputError(f"points must be a real array of shape (N, 3), found {_describe(points)}")
        with np.errstate(over="ignore"):  # what exceeds float32 becomes inf, which finite_mask reports
            points = np.ascontiguousarray(points, dtype=np.float32)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "colors", _checked_colors(self.colors, len(points)))
        object.__setattr__(self, "scalars", {n: _checked_scalar(n, v, len(points)) for n, v in self.scalars.items()})
        object.__setattr__(self, "metadata", _checked_metadata(self.metadata))

    def __len__(self) -> int:
        return len(self.points)

    def finite_mask(self) -> np.ndarray:
        """`(N,)` bool, True where all three coordinates are finite; colours and scalars are not looked at."""
        return np.isfinite(self.points).all(axis=1)

    def select(self, rows: np.ndarray | Sequence[int] | slice) -> PointCloud:
        """The cloud of the chosen rows, with their colours and scalars.

        Args:
            rows: `(N,)` bool mask, an array of integer row numbers (any order, repeats allowed), or a slice.

        Raises:
            InputError: a mask of another length, or a row number that does not exist.
        """
        if not isinstance(rows, slice):
            rows = np.asarray(rows)
            if rows.size == 0 and rows.dtype != bool:
                rows = rows.astype(np.int64)
            if rows.ndim != 1 or rows.dtype.kind not in "biu":
                raise InputError(f"rows must be a mask or integer row numbers, found {_describe(rows)}")
            if rows.dtype == bool and len(rows) != len(self):
                raise InputError(f"the mask has {len(rows)} entries, the cloud has {len(self)} points")
            if rows.dtype != bool and rows.size and (rows.min() < -len(self) or rows.max() >= len(self)):
                raise InputError(f"row numbers {rows.min()}..{rows.max()} do not fit a cloud of {len(self)} points")
        return replace(
            self,
            points=self.points[rows],
            colors=None if self.colors is None else self.colors[rows],
            scalars={name: values[rows] for name, values in self.scalars.items()},
        )

    @staticmethod
    def concat(clouds: Sequence[PointCloud]) -> PointCloud:
        """All points of all clouds, in order; metadata keeps the entries on which all agree.

        Raises:
            InputError: the clouds differ in which scalars they have, or only some have colours.
        """
        if not clouds:
            return PointCloud(np.empty((0, 3), np.float32))
        first = clouds[0]
        for number, cloud in enumerate(clouds):
            if set(cloud.scalars) != set(first.scalars) or (cloud.colors is None) != (first.colors is None):
                raise InputError(
                    f"cloud {number} has {_columns(cloud)}, cloud 0 has {_columns(first)}; "
                    "concatenate clouds with the same columns only"
                )
        shared = {key: value for key, value in first.metadata.items()
                  if all(cloud.metadata.get(key) == value for cloud in clouds)}
        return PointCloud(
            points=np.concatenate([cloud.points for cloud in clouds]),
            colors=None if first.colors is None else np.concatenate([np.asarray(cloud.colors) for cloud in clouds]),
            scalars={name: np.concatenate([cloud.scalars[name] for cloud in clouds]) for name in first.scalars},
            metadata=shared,
        )


def _describe(array: np.ndarray) -> str:
    return f"{array.dtype} of shape {array.shape}"


def _columns(cloud: PointCloud) -> str:
    names = (["colors"] if cloud.colors is not None else []) + sorted(cloud.scalars)
    return ", ".join(names) if names else "points only"


def _checked_colors(colors: np.ndarray | None, count: int) -> np.ndarray | None:
    if colors is None:
        return None
    colors = np.ascontiguousarray(colors)
    if colors.dtype != np.uint8 or colors.shape != (count, 3):
        raise InputError(f"colors must be uint8 of shape ({count}, 3), found {_describe(colors)}; "
                         "multiply colours in 0..1 by 255 and round")
    return colors


def _checked_scalar(name: str, values: np.ndarray, count: int) -> np.ndarray:
    if not _SCALAR_NAME.fullmatch(name) or name.lower() in RESERVED_NAMES:
        raise InputError(f"{name!r} is no name for a per-point value: use letters, digits and '_', and none of "
                         f"{', '.join(sorted(RESERVED_NAMES))}")
    values = np.ascontiguousarray(values)
    if values.shape != (count,) or values.dtype.kind not in "biuf":
        raise InputError(f"{name} must be a real array of shape ({count},), found {_describe(values)}")
    return values


def _checked_metadata(metadata: Mapping[str, str]) -> dict[str, str]:
    for key, value in metadata.items():
        if not isinstance(key, str) or not isinstance(value, str) or not key:
            raise InputError(f"metadata maps text to text, found {key!r}: {value!r}")
    return dict(metadata)
