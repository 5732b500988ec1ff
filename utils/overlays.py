"""Do the points of a run lie on the events? Event images around its frames with the points projected into them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.array_files import save_arrays
from utils.atomic import atomic_path
from utils.datasets.registry import Recording
from utils.edge_clouds.images import RES, crop_of
from utils.events.reader import EventReader
from utils.events.types import Events
from utils.frame_bundle import FrameBundle
from utils.trajectory_io import rotation_matrices
from utils.voxel_grid import to_voxel_grid

LONE_FRAME_US = 70_000.0
"""Length of the event window of a bundle with a single frame."""

_OWN_BGR, _OTHER_BGR = (60, 60, 255), (255, 200, 60)
_BRIGHTEST = 99.0  # percentile of the filled pixels that is drawn white
_AROUND_PX = 3  # side of the square under a point that counts as its place
_SHEET_WIDTH = 1600


@dataclass(frozen=True, eq=False)
class Overlay:
    """One frame with the points of the run in it.

    Attributes:
        frame_id, t_us: of the frame. event_image: `(H,W)` float32 events per pixel in the window, undistorted.
        own: `(N,2)` pixels of the points that the frame hosts; others: `(M,2)` of those that neighbouring frames host.
        points_cam: `(N,3)` the frame's own points in its camera.
        own_score, others_score: event density under the points over the mean density; NaN without points. Points
            scattered at random score 1. The score of the others depends on poses and depths, the own one hardly.
        events: the undistorted events `x y t p` of the window.
    """

    frame_id: int
    t_us: float
    event_image: npt.NDArray[np.float32]
    own: npt.NDArray[np.float64]
    others: npt.NDArray[np.float64]
    points_cam: npt.NDArray[np.float64]
    own_score: float
    others_score: float
    events: dict[str, npt.NDArray[Any]]


def build_overlays(recording: Recording, bundle: FrameBundle, *, window_us: float | None = None,
                   max_frames: int = 0, neighbors: int = 4, res_scale: float = RES) -> Iterator[Overlay]:
    """Overlays of the frames of a bundle, in time order; frames without events around them are left out.

    Events of `[t - window/2, t + window/2)` belong to the frame at time t. Points are projected with `cam_T_world`:
    `u = fx X/Z + cx`, with the intrinsics of the bundle times `res_scale` plus the columns and rows that the tracker
    cropped.

    Args:
        recording: with raw events, on the clock of the bundle.
        bundle: poses, points and intrinsics.
        window_us: length of the windows; None for the median distance of the frames.
        max_frames: at most this many, evenly spaced; 0 for all.
        neighbors: points of so many frames on each side are projected as well.
        res_scale: from the intrinsics of the bundle to full resolution.

    Raises:
        InputError: an empty bundle, senseless arguments, or no event around any frame.
    """
    if not len(bundle):
        raise InputError("the frame bundle holds no frame; the run was never initialised")
    if window_us is None:
        window_us = float(np.median(np.diff(bundle.t_us))) if len(bundle) > 1 else LONE_FRAME_US
    for name, value, lowest in (("window_us", window_us, 1), ("max_frames", max_frames, 0), ("neighbors", neighbors, 0),
                                ("res_scale", res_scale, 1e-3)):
        if not lowest <= value < np.inf:
            raise InputError(f"{name} is {value}; expected at least {lowest}")
    count = min(max_frames or len(bundle), len(bundle))
    chosen = np.unique(np.linspace(0, len(bundle) - 1, count).round().astype(int))
    found = 0
    with recording.open_events() as reader:
        for i in chosen:
            overlay = _overlay(recording, reader, bundle, int(i), window_us, neighbors, res_scale)
            if overlay is not None:
                found += 1
                yield overlay
        if not found:
            first, last = reader.time_range_us()
            raise InputError(f"no event lies within {window_us / 2:.0f} us of one of the {len(chosen)} frames, which "
                             f"span {bundle.t_us[0]:.0f} us to {bundle.t_us[-1]:.0f} us; the events span {first} us to "
                             f"{last} us, so the bundle belongs to another recording")


def _overlay(recording: Recording, reader: EventReader, bundle: FrameBundle, i: int, window_us: float, neighbors: int,
             res_scale: float) -> Overlay | None:
    t_us = float(bundle.t_us[i])
    events = reader.read(t_us - window_us / 2, t_us + window_us / 2)
    if not len(events):
        return None
    columns = undistorted(recording, events)
    image = event_histogram(columns["x"], columns["y"], recording.height, recording.width)
    frames = np.arange(max(i - neighbors, 0), min(i + neighbors + 1, len(bundle)))
    other_points = [bundle.points[bundle.rows(int(j))] for j in frames if j != i]
    own, points_cam = _project(recording, bundle, i, bundle.points[bundle.rows(i)], res_scale)
    others, _ = _project(recording, bundle, i, np.concatenate([*other_points, np.zeros((0, 3))]), res_scale)
    return Overlay(int(bundle.frame_ids[i]), t_us, image, own, others, points_cam, density_score(image, own),
                   density_score(image, others), columns)


def undistorted(recording: Recording, events: Events) -> dict[str, npt.NDArray[Any]]:
    """Columns `x y t p` of events in pixels of the voxel grids: undistorted and scaled as those are."""
    map_xy = getattr(recording, "rectify_map", None)
    position = np.stack([events.x, events.y], axis=1).astype(np.float64)
    if map_xy is not None:
        position = np.asarray(map_xy, np.float64)[events.y, events.x]
    width, height = recording.sensor_size
    scale = np.array([recording.width / width, recording.height / height])
    position = (position + 0.5) * scale - 0.5  # pixel centres at whole numbers, as `resize_voxel` has them
    keep = np.isfinite(position).all(axis=1)
    return {"x": position[keep, 0], "y": position[keep, 1], "t": events.t_us[keep], "p": events.p[keep]}


def event_histogram(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], height: int,
                    width: int) -> npt.NDArray[np.float32]:
    """Events per pixel `(H,W)` float32, each counted at the nearest pixel; those outside are left out."""
    column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    counts = np.bincount(row[inside] * width + column[inside], minlength=height * width)
    return counts.reshape(height, width).astype(np.float32)


def _project(recording: Recording, bundle: FrameBundle, i: int, points: npt.NDArray[Any],
             res_scale: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Full-resolution pixels `(N,2)` of the world points that frame `i` sees, and all points in its camera `(K,3)`."""
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    pose = bundle.cam_T_world[i]
    seen = points @ rotation_matrices(pose[3:]).T + pose[:3]
    fx, fy, cx, cy = bundle.intrinsics[i].astype(np.float64) * res_scale
    top, left = crop_of(recording.height, recording.width)
    front = seen[seen[:, 2] > 0]
    pixel = np.column_stack([fx * front[:, 0] / front[:, 2] + cx + left, fy * front[:, 1] / front[:, 2] + cy + top])
    inside = (pixel >= 0).all(axis=1) & (pixel[:, 0] <= recording.width - 1) & (pixel[:, 1] <= recording.height - 1)
    return pixel[inside], seen


def density_score(image: npt.NDArray[np.float32], pixel: npt.NDArray[np.float64]) -> float:
    """Mean event density in the 3x3 pixels under the points over the mean density of the image; NaN without points."""
    mean = float(image.mean())
    if len(pixel) == 0 or mean == 0:
        return float("nan")
    density = cv2.blur(image, (_AROUND_PX, _AROUND_PX), borderType=cv2.BORDER_REPLICATE)
    column, row = np.rint(pixel).astype(int).T
    return float(density[row, column].mean() / mean)


def draw_overlay(overlay: Overlay, label: bool = True) -> npt.NDArray[np.uint8]:
    """The event image in grey with own points in red and those of neighbours in blue, `(H,W,3)` uint8 BGR."""
    filled = overlay.event_image[overlay.event_image > 0]
    white = float(np.percentile(filled, _BRIGHTEST)) if len(filled) else 1.0
    grey = (overlay.event_image / white * 255.0).clip(0, 255).astype(np.uint8)
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    for pixels, color in ((overlay.others, _OTHER_BGR), (overlay.own, _OWN_BGR)):
        column, row = np.rint(pixels).astype(int).T
        for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            inside = (column + dx >= 0) & (column + dx < grey.shape[1]) & (row + dy >= 0) & (row + dy < grey.shape[0])
            picture[row[inside] + dy, column[inside] + dx] = color
    if label:
        text = f"{overlay.frame_id}  {overlay.t_us * 1e-6:.3f} s  own {overlay.own_score:.1f}  " \
               f"others {overlay.others_score:.1f}"
        cv2.putText(picture, text, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1, cv2.LINE_AA)
    return picture  # type: ignore[return-value]


def contact_sheet(pictures: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """Pictures of equal size side by side in reading order, about 1600 px wide."""
    columns = int(np.ceil(np.sqrt(len(pictures))))
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    sheet = np.zeros((rows, columns, height, width, 3), np.uint8)
    sheet.reshape(-1, height, width, 3)[:len(pictures)] = pictures
    joined = sheet.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, 3)
    scale = _SHEET_WIDTH / joined.shape[1]
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return cv2.resize(joined, None, fx=scale, fy=scale, interpolation=how)  # type: ignore[return-value]


def write_png(path: Path, picture: npt.NDArray[np.uint8]) -> Path:
    """Write a BGR picture, completely or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    return path


def write_arrays(path: Path, overlay: Overlay, height: int, width: int) -> Path:
    """Write what an overlay is made of as `.npz`, with the voxel grid `(5,H,W)` of its events."""
    events = overlay.events
    voxel = to_voxel_grid(events["x"], events["y"], events["t"], events["p"], height, width).numpy()
    return save_arrays(path, {
        "frame_id": np.array(overlay.frame_id), "timestamp": np.array(overlay.t_us),
        "event_image": overlay.event_image, "voxel": voxel, "u": overlay.own[:, 0], "v": overlay.own[:, 1],
        "points_cam": overlay.points_cam}, compressed=True)
