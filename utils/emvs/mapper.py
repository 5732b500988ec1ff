"""The mapper: events and poses in, depth maps and one cloud out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import radius_outlier
from utils.emvs.depth_map import DepthMap, extract_depth
from utils.emvs.geometry import DepthPlanes, FloatArray, VirtualCamera, packet_rays, usable_packets
from utils.emvs.settings import DEFAULT_MAX_DEPTH, DEFAULT_MIN_DEPTH, EmvsSettings
from utils.emvs.views import PoseTrack, Span, choose_spans, common_span, depth_range_from_points, pose_vector
from utils.emvs.voting import block_packets, cast_votes
from utils.events.reader import EventReader
from utils.events.types import Events
from utils.trajectory_io import Trajectory

_READ_EVENTS = 1 << 18
_LEAST_DEPTH_RATIO = 1e-3  # a cloud's near end is not taken nearer than this share of its far end


@dataclass(frozen=True, eq=False)
class EventCamera:
    """Where the pixels of the event camera look.

    Attributes:
        rectify_map: `(H, W, 2)` float32 undistorted position of every sensor pixel, see `utils.undistort`.
        intrinsics: `fx fy cx cy` of the undistorted camera in pixels.
    """

    rectify_map: npt.NDArray[np.float32]
    intrinsics: FloatArray

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor."""
        return self.rectify_map.shape[1], self.rectify_map.shape[0]


@dataclass(eq=False)
class View:
    """One reference view and what was found in it.

    Attributes:
        world_T_view: `(4, 4)` float64 pose of the view.
        span: which events it is made of.
        camera: its virtual camera.
        planes: its depth planes.
        depth_map: confidence, mask, depth.
        dsi: `(Z, H, W)` float32 votes, kept on request.
        counts: events and packets used and dropped, mean square of the DSI, seconds.
        cloud: points in the frame of the view, after the radius filter.
    """

    world_T_view: FloatArray
    span: Span
    camera: VirtualCamera
    planes: DepthPlanes
    depth_map: DepthMap
    counts: dict[str, float]
    cloud: PointCloud
    dsi: Tensor | None = None

    def world_cloud(self, number: int = 0) -> PointCloud:
        """The cloud in the world frame, with the number of the view as a scalar."""
        points = self.cloud.points.astype(np.float64) @ self.world_T_view[:3, :3].T + self.world_T_view[:3, 3]
        scalars = {**self.cloud.scalars, "view": np.full(len(points), number, np.int32)}
        return PointCloud(points, scalars=scalars, metadata={**self.cloud.metadata, "frame": "world"})

    def describe(self) -> dict[str, Any]:
        """Plain values for reports."""
        return {
            "reference_us": self.span.reference_us, "start_us": self.span.start_us, "stop_us": self.span.stop_us,
            "world_T_view_xyz_quat_xyzw": pose_vector(self.world_T_view).tolist(),
            "camera": {"width": self.camera.width, "height": self.camera.height, "focal": self.camera.focal,
                       "cx": self.camera.cx, "cy": self.camera.cy},
            "min_depth": self.planes.near, "max_depth": self.planes.far, **self.counts,
        }


@dataclass(eq=False)
class EmvsMap:
    """All views, and their points in one cloud.

    Attributes:
        views: in order of time.
        cloud: world frame; scalars `depth`, `confidence`, `intensity` (1 / depth), `view`.
        counts: what was dropped before any view saw it.
    """

    views: list[View]
    cloud: PointCloud
    counts: dict[str, int] = field(default_factory=dict)


class ViewVoter:
    """Collects the votes of events, handed over piece by piece, in the DSI of one reference view.

    Packets are cut from the stream of events as a whole, so that the result does not depend on the pieces.

    Args:
        world_T_view: `(4, 4)` reference view.
        camera: virtual camera of that view.
        planes: depth planes.
        event_camera: where sensor pixels look.
        track: poses that cover all events.
        settings: packet size, stride, kind of vote.
        device: where the DSI lives.
    """

    def __init__(self, world_T_view: FloatArray, camera: VirtualCamera, planes: DepthPlanes, event_camera: EventCamera,
                 track: PoseTrack, settings: EmvsSettings, device: torch.device) -> None:
        self.camera, self.planes, self.track, self.settings = camera, planes, track, settings
        self.dsi = torch.zeros(planes.count, camera.height, camera.width, device=device)
        self.counts: dict[str, int] = {"events": 0, "packets": 0, "dropped_packets": 0, "event_plane_votes": 0}
        self._view_T_world = np.linalg.inv(world_T_view)
        self._depths = planes.depths
        self._event_camera = event_camera
        self._positions = torch.from_numpy(event_camera.rectify_map.reshape(-1, 2)).to(device)
        self._block = block_packets(settings.packet_size, camera.width * camera.height, device) * settings.packet_size
        self._waiting = Events.empty()
        self._skip = 0

    def add(self, events: Events) -> None:
        """Vote with the events; those behind the last full block wait for more."""
        thinned = events[self._skip::self.settings.event_stride] if self.settings.event_stride > 1 else events
        self._skip = (self._skip - len(events)) % self.settings.event_stride
        rest = Events.concatenate([self._waiting, thinned])
        full = len(rest) // self._block * self._block
        for first in range(0, full, self._block):
            self._vote(rest[first:first + self._block])
        self._waiting = rest[full:]

    def finish(self) -> None:
        """Vote with the events that still wait, an incomplete last packet included."""
        if len(self._waiting):
            self._vote(self._waiting)
        self._waiting = Events.empty()

    def _vote(self, events: Events) -> None:
        size, count = self.settings.packet_size, len(events)
        packets = -(-count // size)
        first = np.arange(packets) * size
        middle = (first + np.minimum(first + size, count)) // 2
        view_T_ev = self._view_T_world @ self.track(events.t_us[middle])
        usable = usable_packets(view_T_ev, self._depths[0])
        width, height = self._event_camera.size
        if int(events.x.max()) >= width or int(events.y.max()) >= height:
            raise InputError(f"an event lies at ({events.x.max()}, {events.y.max()}), outside the sensor of "
                             f"{width}x{height} pixels that the calibration is for")
        sensor_pixel = np.zeros(packets * size, np.int64)
        sensor_pixel[:count] = events.y.astype(np.int64) * width + events.x
        pixels = self._positions[torch.from_numpy(sensor_pixel).to(self.dsi.device)].view(packets, size, 2)
        valid = torch.arange(packets * size, device=self.dsi.device).view(packets, size) < count
        keep = torch.from_numpy(usable).to(self.dsi.device)
        rays = packet_rays(pixels[keep], valid[keep], view_T_ev[usable], self._event_camera.intrinsics, self.camera,
                           self._depths)
        cast_votes(self.dsi, rays, self.settings.vote)
        used = int(valid[keep].sum())
        for name, number in (("events", used), ("packets", int(usable.sum())),
                             ("dropped_packets", int((~usable).sum())), ("event_plane_votes", used * len(self.dsi))):
            self.counts[name] += number


def map_events(reader: EventReader, trajectory: Trajectory, event_camera: EventCamera,
               settings: EmvsSettings | None = None, *, start_us: float | None = None, stop_us: float | None = None,
               sparse_points: npt.ArrayLike | None = None, device: torch.device | str = "cpu", keep_dsi: bool = False,
               on_events: Callable[[Events], None] | None = None) -> EmvsMap:
    """Build depth maps and a cloud from events with known poses.

    Time without poses is left out and counted. Memory: one DSI of dimZ x dimY x dimX float32 and a few blocks of
    events. The same input gives the same bytes on the CPU; on CUDA the order of additions varies, and with it the last
    digit.

    Args:
        reader: the events.
        trajectory: camera to world; any unit of length.
        event_camera: undistortion and intrinsics.
        settings: None means the defaults.
        start_us, stop_us: use only events with `start_us <= t < stop_us`.
        sparse_points: `(N, 3)` world points that give the depth range where the settings do not.
        device: where to vote.
        keep_dsi: keep the votes of every view.
        on_events: called with every piece of events that was voted with, for progress bars.

    Raises:
        InputError: poses and events do not overlap, the camera does not move, no events, a cloud that gives no
            depth range.
    """
    settings = settings or EmvsSettings()
    device = torch.device(device)
    track = PoseTrack(trajectory)
    start, stop, counts = _window(reader, track, start_us, stop_us)
    camera = VirtualCamera.of(settings, event_camera.size, event_camera.intrinsics)
    points = _checked_points(sparse_points)
    middle_planes = _choose_planes(settings, points, track((start + stop) / 2)[0], camera)
    spans, counts["views_without_parallax"] = choose_spans(
        track, start, stop, settings, float(np.sqrt(middle_planes.near * middle_planes.far)))
    views = []
    for span in spans:
        world_T_view = track(span.reference_us)[0]
        planes = _choose_planes(settings, points, world_T_view, camera, fallback=middle_planes)
        voter = ViewVoter(world_T_view, camera, planes, event_camera, track, settings, device)
        began = time.perf_counter()
        for events in _events_of(reader, span, stop):
            voter.add(events)
            if on_events is not None:
                on_events(events)
        voter.finish()
        if voter.counts["events"]:
            views.append(_finish_view(voter, world_T_view, span, keep_dsi, time.perf_counter() - began))
    if not views:
        raise InputError(f"{reader.path}: no events between {start:.0f} us and {stop:.0f} us, where there are poses; "
                         "check the window")
    cloud = PointCloud.concat([view.world_cloud(number) for number, view in enumerate(views)])
    return EmvsMap(views, cloud, counts)


def _window(reader: EventReader, track: PoseTrack, start_us: float | None,
            stop_us: float | None) -> tuple[float, float, dict[str, int]]:
    """The span with events and poses, and how much time of the wanted window has events but no poses."""
    recorded = reader.time_range_us()
    first = recorded[0] if start_us is None else max(recorded[0], start_us)
    last = recorded[1] if stop_us is None else min(recorded[1], stop_us)
    if not first <= last:
        raise InputError(f"{reader.path}: events span {recorded[0]} us to {recorded[1]} us, none lies in the window "
                         f"from {start_us} us to {stop_us} us")
    start, stop = common_span(track, first, last)
    return start, stop, {"us_before_first_pose": round(start - first), "us_after_last_pose": round(last - stop)}


def _events_of(reader: EventReader, span: Span, last_us: float) -> Iterator[Events]:
    """Events of a span, but none behind the last pose."""
    return reader.chunks(_READ_EVENTS, start_us=span.start_us, stop_us=min(span.stop_us, np.floor(last_us) + 1))


def _checked_points(points: npt.ArrayLike | None) -> FloatArray | None:
    if points is None:
        return None
    array = np.asarray(points, np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all(axis=1).any():
        raise InputError(f"the sparse cloud has shape {array.shape} and "
                         f"{int(np.isfinite(array).sum() // 3) if array.ndim == 2 else 0} finite rows; expected (N, 3) "
                         "with at least one finite point to take the depth range from")
    return array


def _choose_planes(settings: EmvsSettings, points: FloatArray | None, world_T_view: FloatArray, camera: VirtualCamera,
                   fallback: DepthPlanes | None = None) -> DepthPlanes:
    """Depth range as given; what was not given from the cloud, else the defaults.

    A later view that sees no point of the cloud takes the range of `fallback`.
    """
    low, high = settings.min_depth, settings.max_depth
    if points is not None and (low is None or high is None):
        try:
            from_cloud = depth_range_from_points(points, world_T_view, camera.focal, (camera.width, camera.height))
        except InputError:
            if fallback is None:
                raise
            from_cloud = fallback.near, fallback.far
        high = from_cloud[1] if high is None else high
        low = max(from_cloud[0], _LEAST_DEPTH_RATIO * high) if low is None else low
    low = DEFAULT_MIN_DEPTH if low is None else low
    high = DEFAULT_MAX_DEPTH if high is None else high
    return DepthPlanes(low, high, settings.dimZ, settings.depth_spacing)


def _finish_view(voter: ViewVoter, world_T_view: FloatArray, span: Span, keep_dsi: bool, seconds: float) -> View:
    depth_map = extract_depth(voter.dsi, voter.planes, voter.settings)
    raw = depth_cloud(depth_map, voter.camera)
    cloud = filter_cloud(raw, voter.settings)
    counts: dict[str, float] = {
        **voter.counts, "votes_in_view": float(voter.dsi.sum(dtype=torch.float64)),
        "dsi_mean_square": mean_square(voter.dsi), "points_before_radius_filter": len(raw), "points": len(cloud),
        "read_and_vote_s": round(seconds, 3),
    }
    return View(world_T_view, span, voter.camera, voter.planes, depth_map, counts, cloud,
                voter.dsi.cpu() if keep_dsi else None)


def mean_square(dsi: Tensor) -> float:
    """Mean of the squared votes: the more rays meet in few voxels, the larger it is."""
    return float(torch.linalg.vector_norm(dsi, dtype=torch.float64)) ** 2 / dsi.numel()


def depth_cloud(depth_map: DepthMap, camera: VirtualCamera) -> PointCloud:
    """Points of all pixels in the mask, in the frame of the view; scalars depth, confidence, intensity = 1 / depth."""
    rows, columns = np.nonzero(depth_map.mask)
    depth = depth_map.depth[rows, columns].astype(np.float64)
    points = camera.points(columns.astype(np.float64), rows.astype(np.float64), depth)
    return PointCloud(points, scalars={"depth": depth.astype(np.float32), "intensity": (1 / depth).astype(np.float32),
                                       "confidence": depth_map.confidence[rows, columns]},
                      metadata={"frame": "reference view (x right, y down, z forward)"})


def filter_cloud(cloud: PointCloud, settings: EmvsSettings) -> PointCloud:
    """Drop points with too few others within the search radius."""
    if not settings.min_num_neighbors or not len(cloud):
        return cloud
    keep, _ = radius_outlier(cloud, radius=settings.radius_search, min_neighbors=settings.min_num_neighbors,
                             backend="scipy")
    return cloud.select(keep)
