"""Write an HDF5 file completely or not at all, also when the disk is full."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from typing import NamedTuple

import h5py

from utils.atomic import atomic_path


class Hdf5Output(NamedTuple):
    """An HDF5 file that is being written, and a way to notice early that writing has failed."""

    file: h5py.File
    sink: _Sink

    def check(self) -> None:
        """Raise what has gone wrong so far.

        Raises:
            OSError: for example because the disk is full.
        """
        self.sink.raise_failure()


@contextlib.contextmanager
def create_hdf5(path: str | os.PathLike[str]) -> Iterator[Hdf5Output]:
    """Yield a new HDF5 file that appears at `path` when the block ends without an error.

    Raises:
        OutputError: the folder cannot be written or the disk is full.
    """
    with atomic_path(path) as temporary, io.FileIO(temporary, "w+") as stream:
        sink = _Sink(stream)
        # The newest metadata layout that HDF5 1.10 (2016) reads; unlike older ones it carries checksums.
        with h5py.File(sink, "w", libver=("v110", "v110")) as file:
            yield Hdf5Output(file, sink)
        sink.raise_failure()


class _Sink:
    """File for HDF5 that remembers a failed write instead of reporting it.

    HDF5 cannot close a file that it cannot write: told of a full disk, it keeps trying at every turn and in the end
    crashes the process. So it is told that all is well, and the writer raises what really happened.
    """

    def __init__(self, stream: io.FileIO) -> None:
        self._stream = stream
        self._position = 0
        self._failure: OSError | None = None

    def raise_failure(self) -> None:
        """Raise the first failure, if any.

        Raises:
            OSError: for example because the disk is full.
        """
        if self._failure is not None:
            raise self._failure

    def write(self, data: bytes) -> int:
        """Write until the first failure, then drop everything."""
        rest = memoryview(data)
        try:
            while len(rest) and self._failure is None:
                self._stream.seek(self._position)
                written = self._stream.write(rest) or 0
                self._position += written
                rest = rest[written:]
        except OSError as error:
            self._failure = error
        self._position += len(rest)
        return len(data)

    def read(self, count: int) -> bytes:
        """Read; what was dropped reads as zeros."""
        self._stream.seek(self._position)
        self._position += count
        return (self._stream.read(count) or b"").ljust(count, b"\0")

    def readinto(self, buffer: memoryview) -> int:
        """Fill a buffer; h5py reads through this method."""
        buffer[:] = self.read(len(buffer))
        return len(buffer)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the position."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position}.get(whence)
        self._position = offset + (self._stream.seek(0, os.SEEK_END) if base is None else base)
        return self._position

    def tell(self) -> int:
        """Return the position."""
        return self._position

    def truncate(self, size: int) -> int:
        """Set the size of the file."""
        if self._failure is None:
            try:
                self._stream.truncate(size)
            except OSError as error:
                self._failure = error
        return size

    def flush(self) -> None:
        """Do nothing: the stream has no buffer."""
