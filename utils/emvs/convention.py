"""A guard against poses that are the inverse of what they should be.

World-to-camera poses read as camera-to-world give a cloud that looks like one and is wrong. Rays of the right poses
meet more often, so both readings are tried on a sample of the events.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from utils.emvs.geometry import DepthPlanes
from utils.emvs.mapper import EventCamera, View, ViewVoter, mean_square
from utils.emvs.settings import EmvsSettings
from utils.emvs.views import PoseTrack
from utils.events.types import Events

_MOST_PACKETS = 64
_MOST_PLANES = 50
_CLEARLY = 1.1


@dataclass(frozen=True)
class ConventionCheck:
    """How sharp the DSI of a sample of the events is with the poses as given and with their inverses.

    Attributes:
        given, inverted: mean number of votes that a vote finds in its voxel; higher = sharper.
    """

    given: float
    inverted: float

    @property
    def suspicious(self) -> bool:
        """Whether the inverse poses are clearly sharper."""
        return self.inverted > _CLEARLY * self.given


class PacketSample:
    """Keeps evenly spaced packets of a stream of unknown length, at most 64 of them; same stream, same sample."""

    def __init__(self, packet_size: int) -> None:
        self._size = packet_size
        self._every = 1
        self._seen = 0
        self._packets: list[Events] = []

    def add(self, events: Events) -> None:
        """Look at the next piece of the stream; its incomplete last packet is passed over."""
        for first in range(0, len(events) - self._size + 1, self._size):
            if self._seen % self._every == 0:
                chosen = events[first:first + self._size]  # copied, so that the rest of the piece can be freed
                self._packets.append(Events(chosen.x.copy(), chosen.y.copy(), chosen.t_us.copy(), chosen.p.copy()))
                if len(self._packets) > _MOST_PACKETS:
                    self._packets = self._packets[::2]
                    self._every *= 2
            self._seen += 1

    @property
    def events(self) -> Events:
        """The sample as one list of events."""
        return Events.concatenate(self._packets)


def check_convention(view: View, events: Events, track: PoseTrack, event_camera: EventCamera, settings: EmvsSettings,
                     device: torch.device) -> ConventionCheck | None:
    """Compare the sharpness of both readings in one view; None without events of that view.

    Args:
        view: a finished view, for its depth range and reference time.
        events: a sample of the events, whole packets.
        track: poses as given.
        event_camera, settings, device: as for the map.
    """
    inside = events.between(view.span.start_us, view.span.stop_us)
    if not len(inside):
        return None
    planes = DepthPlanes(view.planes.near, view.planes.far, min(view.planes.count, _MOST_PLANES), view.planes.spacing)
    sharpness = []
    for candidate in (track, track.inverted()):
        voter = ViewVoter(candidate(view.span.reference_us)[0], view.camera, planes, event_camera, candidate,
                          replace(settings, event_stride=1), device)
        voter.add(inside)
        voter.finish()
        total = float(voter.dsi.sum(dtype=torch.float64))
        squares = mean_square(voter.dsi) * voter.dsi.numel()
        sharpness.append(squares / total if total > 0 else 0.0)
    return ConventionCheck(*sharpness)
