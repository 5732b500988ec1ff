"""What a run returns, with names: status, trajectory, sparse structure, counters and timings."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from devo.observables import Observables

INITIAL_KEYFRAMES = 8
MIN_EVENT_SHARE = 0.02  # of voxel cells; emptier voxels cannot start a run
LOST_AFTER = 16  # frames over which tracking must fail before a run is called lost


class TrackingStatus(enum.Enum):
    """How a run ended; everything but `TRACKED` means that the trajectory must not be used as it is."""

    TRACKED = "tracked"
    NOT_INITIALIZED = "not initialized"
    LOST = "lost"
    EMPTY_STREAM = "empty stream"


@dataclass
class TrackingResult:
    """Result of one run.

    Attributes:
        poses: `(T,7)` float32 `world_T_cam` (tx ty tz qx qy qz qw) of every accepted frame; the first accepted camera
            is the world frame, the scale is arbitrary. NaN where the run was never initialised.
        tstamps: `(T,)` float64, microseconds, as the iterator gave them.
        status: how the run ended.
        message: one sentence for people: what was found, what was expected, what to try.
        observables: the sparse structure, `None` if it was not asked for.
        frame_data: one dictionary per tracked frame, `None` if it was not asked for.
        flowdata: per frame edges and reprojections for visualisation, `None` if it was not asked for.
        counters: frames read, accepted, skipped; keyframes kept and dropped; bundle adjustment failures, ...
        timings: seconds spent per stage.
        tracked_share: share of the frames after initialisation whose measurements the geometry explains.
    """

    poses: np.ndarray
    tstamps: np.ndarray
    status: TrackingStatus
    message: str
    observables: Observables | None = None
    frame_data: list[dict[str, Any]] | None = None
    flowdata: dict[int, dict[str, Any]] | None = None
    counters: dict[str, int] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=dict)
    tracked_share: float = 0.0

    @property
    def ok(self) -> bool:
        """Whether the trajectory is usable."""
        return self.status is TrackingStatus.TRACKED

def explain(status: TrackingStatus, counters: dict[str, int], keyframes: int) -> str:
    """One sentence for people about the outcome of a run: what was found, what was expected, what to try."""
    accepted, read = counters["frames_accepted"], counters["frames_read"]
    if status is TrackingStatus.EMPTY_STREAM:
        return (f"no usable frame: {read} read, {counters['frames_too_empty']} of them with fewer than "
                f"{MIN_EVENT_SHARE:.0%} non-zero cells; try longer windows (--window_ms, --window_events)")
    if status is TrackingStatus.NOT_INITIALIZED:
        return (f"not initialised: {keyframes} of {INITIAL_KEYFRAMES} keyframes with enough motion in {accepted} "
                "frames; try longer windows, a longer recording, a lower PROBE_FLOW (--opts PROBE_FLOW 1) or trained "
                "weights")
    if status is TrackingStatus.LOST:
        return (f"lost: the geometry no longer explains the measurements of the last {LOST_AFTER} of {accepted} frames "
                f"({counters['ba_failures']} failed solves); try shorter windows or check the intrinsics")
    return f"tracked {accepted} frames with {keyframes} keyframes"
