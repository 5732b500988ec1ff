"""Recordings in which a few damaged words cost a few events: what was left out is counted and said."""

from __future__ import annotations

import warnings
from collections import Counter
from pathlib import Path

from utils.events.reader import SequentialReader
from utils.events.validate import Order


class LossyReader(SequentialReader):
    """A reader of streams that real cameras and cables damage: it goes on behind the damage and keeps accounts.

    The first loss is a `UserWarning` that names the file and the place, the rest is in `losses`.
    """

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, order: Order) -> None:
        super().__init__(path, sensor_size, order)
        self._lost_in_block: dict[int, Counter[str]] = {}

    @property
    def losses(self) -> dict[str, int]:
        """What was left out of the part read so far: reason -> count; empty for an undamaged file."""
        return dict(sum(self._lost_in_block.values(), Counter()))

    def _note_losses(self, block: int, found: Counter[str], place: str) -> None:
        """Record the losses of a block once, however often it is decoded."""
        if block in self._lost_in_block:
            return
        if found and not self.losses:
            listing = ", ".join(f"{count} {reason}" for reason, count in found.items())
            warnings.warn(f"{self.path}: {listing} left out {place}; the rest is read, see reader.losses for the sum",
                          UserWarning, stacklevel=2)
        self._lost_in_block[block] = found
