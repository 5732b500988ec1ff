"""Event recordings: read any supported file in pieces, cut it into windows, write it again."""

from __future__ import annotations

from utils.events.reader import EventReader, MemoryEventReader, open_events, open_events_as_stored
from utils.events.slicing import (
    CountWindows,
    EventSlicer,
    EventWindow,
    StampWindows,
    TimeWindows,
    WindowRule,
)
from utils.events.types import Events
from utils.events.validate import make_events
from utils.events.writers import (
    EventH5Writer,
    compute_ms_to_idx,
    write_events_h5,
    write_events_npz,
    write_events_text,
    write_evs_arr_to_h5,
)

__all__ = [
    "CountWindows",
    "EventH5Writer",
    "EventReader",
    "EventSlicer",
    "EventWindow",
    "Events",
    "MemoryEventReader",
    "StampWindows",
    "TimeWindows",
    "WindowRule",
    "compute_ms_to_idx",
    "make_events",
    "open_events",
    "open_events_as_stored",
    "write_events_h5",
    "write_events_npz",
    "write_events_text",
    "write_evs_arr_to_h5",
]
