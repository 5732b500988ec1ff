"""Batches made while the device is busy with the one before."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from devo.data_readers.base import ClipSource, TrainingClips


class BatchesAhead:
    """The batches of another source, the next one made in a thread of its own while the present one is in use.

    Batches depend on their step only, so this changes no result. Worth it where the trainer waits for a GPU.

    Args:
        source: the batches. stride: steps between two batches of this process.
    """

    def __init__(self, source: ClipSource, stride: int = 1) -> None:
        self.source, self.stride = source, stride
        self._thread = ThreadPoolExecutor(1, "batches")
        self._next: tuple[int, Future[TrainingClips]] | None = None

    @property
    def waited_seconds(self) -> float:
        """How long simulated clips were waited for, at most: part of it passed while the device worked."""
        return float(getattr(self.source, "waited_seconds", 0.0))

    def batch(self, step: int) -> TrainingClips:
        """Batch of training step `step`."""
        if self._next is not None and self._next[0] == step:
            clips = self._next[1].result()
        else:
            clips = self._thread.submit(self.source.batch, step).result()
        following = step + self.stride
        self._next = following, self._thread.submit(self.source.batch, following)
        return clips

    def close(self) -> None:
        """Stop the thread and the source."""
        self._thread.shutdown(wait=True, cancel_futures=True)
        self.source.close()
