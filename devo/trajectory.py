"""From keyframes and relative poses to one pose per accepted frame, and the per-frame structure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from devo.errors import InputError
from devo.lietorch import SE3

if TYPE_CHECKING:
    from devo.devo import DEVO

FRAME_MODES = ("final", "online")


def camera_poses(tracker: DEVO) -> Tensor:
    """`cam_T_world` of every accepted frame, `(T,7)`.

    A frame without keyframe hangs on an earlier frame by a relative pose, which may hang on another one. The chains
    are shortened by pointer doubling, so thousands of consecutive dropped frames cost only a few passes.
    """
    count = tracker.counter
    parent = torch.arange(count, device=tracker.device)
    relative = torch.zeros(count, 7, device=tracker.device)
    relative[:, 6] = 1.0
    if tracker.delta:
        frames = torch.tensor(list(tracker.delta), device=tracker.device)
        parent[frames] = torch.tensor([parent_id for parent_id, _ in tracker.delta.values()], device=tracker.device)
        relative[frames] = torch.stack([pose for _, pose in tracker.delta.values()])
    while not torch.equal(parent, parent[parent]):
        relative = (SE3(relative) * SE3(relative[parent])).data
        parent = parent[parent]
    keyframe_pose = torch.full((count, 7), float("nan"), device=tracker.device)
    keyframe_pose[tracker.tstamps_[:tracker.n]] = tracker.poses_[:tracker.n]
    poses = (SE3(relative) * SE3(keyframe_pose[parent])).data
    if getattr(tracker.cfg, "STILL_FRAMES", "hold") == "interpolate":
        poses = _between_neighbours(poses, tracker.still_frames, tracker.tlist)
    return poses


def _between_neighbours(cam_T_world: Tensor, still: list[int], t_us: list[float]) -> Tensor:
    """Poses `(T,7)` with those of the frames in `still` interpolated in time between the nearest other frames.

    The camera moves from a to b along the geodesic `exp(s log(T_b T_a^-1)) T_a`. Frames after the last other frame stay
    as they are. The first frame is never still.
    """
    if not still:
        return cam_T_world
    moving = np.setdiff1d(np.arange(len(t_us)), still)
    after = np.searchsorted(moving, still)
    inside = after < len(moving)
    frame, a, b = np.asarray(still)[inside], moving[after[inside] - 1], moving[after[inside]]
    time = np.asarray(t_us)
    span = time[b] - time[a]
    share = np.divide(time[frame] - time[a], span, out=np.zeros(len(frame)), where=span > 0)
    start, stop = SE3(cam_T_world[a].double()), SE3(cam_T_world[b].double())
    tangent = (stop * start.inv()).log() * torch.from_numpy(share).to(cam_T_world.device)[:, None]
    poses = cam_T_world.clone()
    poses[frame] = (SE3.exp(tangent) * start).data.to(poses.dtype)
    return poses


def full_trajectory(tracker: DEVO) -> np.ndarray:
    """`world_T_cam` of every accepted frame, `(T,7)` float32; the first frame is the identity."""
    return SE3(camera_poses(tracker)).inv().data.cpu().numpy().astype(np.float32)


def backproject(cam_T_world: Tensor, patches: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """World points of patches hosted in one camera.

    Args:
        cam_T_world: `(7,)` or `(K,7)`. patches: `(K,3,P,P)`. intrinsics: `(4,)` or `(K,4)`, quarter resolution.

    Returns:
        points `(K,3)`, inverse depths `(K,)`, patch centres `(K,2)` in quarter-resolution px.
    """
    centre = patches.shape[-1] // 2
    x, y, inv_depth = patches[:, :, centre, centre].unbind(dim=1)
    fx, fy, cx, cy = intrinsics.unbind(dim=-1)
    in_camera = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], dim=1) / inv_depth[:, None]
    poses = cam_T_world.expand(len(patches), 7)
    return SE3(poses).inv().act(in_camera), inv_depth, torch.stack([x, y], dim=1)


@dataclass
class _Snapshot:
    """One recorded frame as it looked right after it was tracked."""

    frame_id: int
    timestamp: float
    pose: Tensor
    intrinsics: Tensor
    patches: Tensor


class FrameRecorder:
    """Remembers every frame after initialisation, for the per-frame structure at the end."""

    def __init__(self, tracker: DEVO) -> None:
        self.tracker = tracker
        self.snapshots: list[_Snapshot] = []

    def record(self, timestamp: float) -> None:
        """Note the newest keyframe slot of the tracker."""
        tracker, slot = self.tracker, self.tracker.n - 1
        self.snapshots.append(_Snapshot(tracker.counter - 1, float(timestamp), tracker.poses_[slot].clone(),
                                        tracker.intrinsics_[slot].clone(), tracker.patch_centers(slot).clone()))

    def collect(self, mode: str = "final") -> list[dict[str, Any]]:
        """One dictionary per recorded frame.

        Keys: `frame_id` (index into the poses), `timestamp` (us), `pose (7,)` **cam_T_world**, `intrinsics (4,)` at
        quarter resolution, `points (K,3)` world, `depths (K,)` z-depths, `inv_depths (K,)`, `centers (K,2)`
        quarter-resolution px; only rows with finite points. `final` rebuilds every entry from the final poses and
        depths (for frames removed by keyframing: their last depths and the final pose of the keyframe they hang on);
        `online` gives what was known right after the frame was tracked.

        Raises:
            InputError: an unknown mode.
        """
        if mode not in FRAME_MODES:
            raise InputError(f"frame_mode is {mode!r}; expected one of {', '.join(FRAME_MODES)}")
        if mode == "online":
            return [self._entry(s, s.pose, s.patches) for s in self.snapshots]
        tracker = self.tracker
        poses = camera_poses(tracker)
        slots = {int(counter): slot for slot, counter in enumerate(tracker.tstamps_[:tracker.n].tolist())}
        dropped = {frame.counter: frame.patches for frame in tracker.dropped_frames}
        return [self._entry(s, poses[s.frame_id],
                            tracker.patches_[slots[s.frame_id]] if s.frame_id in slots else dropped[s.frame_id])
                for s in self.snapshots]

    def _entry(self, snapshot: _Snapshot, cam_T_world: Tensor, patches: Tensor) -> dict[str, Any]:
        points, inv_depths, centers = backproject(cam_T_world, patches, snapshot.intrinsics)
        finite = torch.isfinite(points).all(dim=1)
        points, inv_depths, centers = points[finite].cpu(), inv_depths[finite].cpu(), centers[finite].cpu()
        return {
            "frame_id": snapshot.frame_id, "timestamp": snapshot.timestamp, "pose": cam_T_world.cpu().numpy().copy(),
            "intrinsics": snapshot.intrinsics.cpu().numpy().copy(), "points": points.numpy(),
            "depths": (1.0 / inv_depths).numpy(), "inv_depths": inv_depths.numpy(), "centers": centers.numpy()}


def accumulated_map(tracker: DEVO) -> tuple[np.ndarray, np.ndarray]:
    """All structure the run ever had: the points of the keyframes and the last estimate of every removed keyframe.

    Bounded by frames times patches. Returns points `(K,3)` float32 (world) and colours `(K,3)` uint8; only finite
    rows.

    Raises:
        InputError: the tracker was not told to `accumulate_map`.
    """
    if not tracker.keep_dropped_frames:
        raise InputError("no accumulated map was kept; construct DEVO with accumulate_map=True")
    poses = camera_poses(tracker)
    dropped = tracker.dropped_frames
    counters = [int(counter) for counter in tracker.tstamps_[:tracker.n].tolist()]
    patches = torch.cat([tracker.patch_centers(slice(tracker.n)), *(frame.patches[None] for frame in dropped)])
    intrinsics = torch.cat([tracker.intrinsics_[:tracker.n], *(frame.intrinsics[None] for frame in dropped)])
    colors = torch.cat([tracker.colors_[:tracker.n], *(frame.colors[None] for frame in dropped)]).flatten(0, 1)
    hosts = torch.tensor(counters + [frame.counter for frame in dropped], device=tracker.device)
    hosts = hosts.repeat_interleave(tracker.M)
    rows = intrinsics.repeat_interleave(tracker.M, dim=0)
    points, _, _ = backproject(poses[hosts], patches.flatten(0, 1), rows)
    finite = torch.isfinite(points).all(dim=1)
    return points[finite].cpu().numpy(), colors[finite].cpu().numpy()
