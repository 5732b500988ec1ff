"""A recording on another clock: the same events with a constant added to their stamps."""

from __future__ import annotations

from utils.events.reader import EventReader
from utils.events.types import Events


class ShiftedReader(EventReader):
    """The events of another reader with `shift_us` added to every stamp; closing it closes the other reader.

    Args:
        reader: the recording.
        shift_us: whole microseconds, negative to bring a recording to an earlier clock.
    """

    def __init__(self, reader: EventReader, shift_us: int) -> None:
        super().__init__(reader.path, reader.sensor_size, reader.order)
        self.format_name = reader.format_name
        self._reader = reader
        self._shift_us = shift_us

    def __len__(self) -> int:
        return len(self._reader)

    @property
    def losses(self) -> dict[str, int]:
        """What the other reader left out."""
        return self._reader.losses

    def time_range_us(self) -> tuple[int, int]:
        """Return the stamps of the first and of the last event in microseconds, on the new clock."""
        first_us, last_us = self._reader.time_range_us()
        return first_us + self._shift_us, last_us + self._shift_us

    def close(self) -> None:
        """Release the file."""
        super().close()
        self._reader.close()

    def _decode(self, block: int) -> Events | None:
        events = self._reader._block(block)
        return None if events is None else Events(events.x, events.y, events.t_us + self._shift_us, events.p)

    def _first_block_reaching(self, start_us: float) -> int:
        return self._reader._first_block_reaching(start_us - self._shift_us)
