"""AEDAT4, the recordings of DV: a header, then packets of several streams, each packet compressed on its own.

The container is small: `#!AER-DAT4.0`, a flatbuffer with the compression and an XML list of streams, packets with an
8-byte head (stream, size), and behind the last packet a table that is not needed for reading in order. An event packet
is a flatbuffer whose only field is a vector of 16-byte records.
"""

from __future__ import annotations

import contextlib
import importlib
import struct
import xml.etree.ElementTree
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.events.losses import LossyReader
from utils.events.streams import choose_stream
from utils.events.types import Events
from utils.events.validate import Order, TimeUnit

_MAGIC = b"#!AER-DAT4.0\r\n"
_PACKET_HEAD = 8
_BYTES_PER_BLOCK = 1 << 20
_RECORD = np.dtype({"names": ["t", "x", "y", "p"], "formats": ["<i8", "<i2", "<i2", "u1"],
                    "offsets": [0, 8, 10, 12], "itemsize": 16})
_COMPRESSIONS = ("none", "lz4", "lz4", "zstd", "zstd")
_DAMAGED = "damaged packets"
_CUT_OFF = "incomplete packets"


class _Stream(NamedTuple):
    number: int
    name: str
    sensor_size: tuple[int, int] | None


class _Header(NamedTuple):
    """What stands before the packets; `data_end` is -1 if the recording was not closed."""

    size: int
    compression: str
    data_end: int
    streams: dict[int, _Stream]
    numbers: frozenset[int]


class Aedat4EventReader(LossyReader):
    """Stream of the events of one camera in an AEDAT4 recording, read packet by packet.

    A packet that cannot be decompressed, or that the end of the file cuts off, is left out and counted in `losses`.
    Stamps are microseconds, as the camera's clock gave them. Arguments as in `open_events`; `stream` picks the output
    (name or number) where there are several.

    Raises:
        InputError: the header or the chain of packets is damaged, or a package for decompression is missing.
    """

    format_name = "AEDAT4"

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, time_unit: TimeUnit | None, order: Order,
                 stream: str | None = None) -> None:
        if time_unit not in (None, "us"):
            raise InputError(f"{path}: AEDAT4 stamps are microseconds, time_unit={time_unit!r} makes no sense")
        super().__init__(path, sensor_size, order)
        self._header = _read_header(path)
        names = {entry.name: entry for entry in self._header.streams.values()}
        if not names:
            raise InputError(f"{path}: the AEDAT4 recording has no stream with events")
        self._stream = names[choose_stream(list(names), stream, str(path))]
        self.sensor_size = sensor_size if sensor_size is not None else self._stream.sensor_size
        self._decompressor = _decompressor(self._header.compression, path)
        self._file = path.open("rb")
        self._size = path.stat().st_size
        self._starts = [self._header.size]

    def close(self) -> None:
        """Close the file."""
        super().close()
        self._file.close()

    def _decode(self, block: int) -> Events | None:
        offset = start = self._starts[block]
        parts: list[np.ndarray] = []
        lost: Counter[str] = Counter()
        taken = 0
        while taken < _BYTES_PER_BLOCK and (packet := self._next_packet(offset, lost)) is not None:
            number, data, offset = packet
            if number == self._stream.number:
                taken += len(data)
                parts += self._events_in(data, lost)
        if not parts and not lost:
            return None
        if lost[_CUT_OFF]:
            offset = max(self._size, self._header.data_end)
        if block + 1 == len(self._starts):
            self._starts.append(offset)
        self._note_losses(block, +lost, f"in bytes {start} to {offset}")
        records = np.concatenate(parts) if parts else np.empty(0, _RECORD)
        return self._check(records["x"], records["y"], records["t"].astype(np.int64), records["p"], block,
                           lambda i: f"{self.path}: event {self._rows_before(block) + i}")

    def _next_packet(self, offset: int, lost: Counter[str]) -> tuple[int, bytes, int] | None:
        """Return stream, data (of the wanted stream only) and end of the packet at `offset`, None behind the last."""
        data_end = self._header.data_end
        if offset == data_end or offset >= max(self._size, data_end):
            return None
        self._file.seek(offset)
        head = self._file.read(_PACKET_HEAD)
        if len(head) == _PACKET_HEAD:
            number, size = struct.unpack("<ii", head)
            behind = offset + _PACKET_HEAD + size
            if number not in self._header.numbers or size < 0 or 0 <= data_end < behind:
                raise InputError(f"{self.path}: the packet at byte {offset} names stream {number} and {size} bytes, "
                                 "which cannot be; the recording is damaged there")
            if behind <= self._size:
                return number, self._file.read(size) if number == self._stream.number else b"", behind
        lost[_CUT_OFF] += 1
        return None

    def _events_in(self, data: bytes, lost: Counter[str]) -> list[np.ndarray]:
        try:
            return [_event_records(self._decompressor.run(data))]
        except (ValueError, EOFError, MemoryError, struct.error, self._decompressor.error):
            lost[_DAMAGED] += 1
            return []


def _read_header(path: Path) -> _Header:
    with path.open("rb") as stream:
        magic = stream.read(len(_MAGIC))
        if magic != _MAGIC:
            version = magic[:12].decode("latin-1").removeprefix("#!AER-DAT")
            raise InputError(f"{path}: AEDAT version {version!r}, expected 4.0; convert it with the software of the "
                             "camera")
        try:
            (size,) = struct.unpack("<I", stream.read(4))
            data = stream.read(size)
            if len(data) < size:
                raise ValueError("it ends inside the header")
            table = _Table(data, b"IOHE")
            compression = table.number(0, "<i", 0)
            data_end = table.number(1, "<q", -1)
            streams, numbers = _streams(table.text(2))
        except (ValueError, struct.error, UnicodeDecodeError, xml.etree.ElementTree.ParseError) as error:
            raise InputError(f"{path}: the header of the AEDAT4 recording is damaged ({error})") from error
    if not 0 <= compression < len(_COMPRESSIONS):
        raise InputError(f"{path}: the AEDAT4 recording names compression {compression}, expected 0 to 4")
    return _Header(len(_MAGIC) + 4 + size, _COMPRESSIONS[compression], data_end, streams, numbers)


def _streams(text: str) -> tuple[dict[int, _Stream], frozenset[int]]:
    """Return the event streams and the numbers of all streams in the XML description."""
    found: dict[int, _Stream] = {}
    numbers: set[int] = set()
    for output in xml.etree.ElementTree.fromstring(text).findall("./node[@name='outInfo']/node"):
        number = int(output.get("name", ""))
        numbers.add(number)
        attributes = {item.get("key", ""): item.text or "" for item in output.iter("attr")}
        if attributes.get("typeIdentifier") != "EVTS":
            continue
        size = int(attributes.get("sizeX", 0)), int(attributes.get("sizeY", 0))
        name = f"{number} {attributes.get('originalOutputName', 'events')} {attributes.get('source', '')}".strip()
        found[number] = _Stream(number, name, size if min(size) > 0 and max(size) <= 65536 else None)
    return found, frozenset(numbers)


class _Table:
    """The root table of a flatbuffer, as little of it as this format needs; all positions are checked by `struct`."""

    def __init__(self, data: bytes, identifier: bytes) -> None:
        if data[4:8] != identifier:
            raise ValueError(f"expected a {identifier.decode()} record, found {data[4:8]!r}")
        self._data = data
        self._position = self._unpack("<I", 0)
        self._fields = self._position - self._unpack("<i", self._position)

    def _unpack(self, form: str, position: int) -> int:
        if position < 0:  # would count from the end
            raise ValueError("a position lies outside the record")
        return int(struct.unpack_from(form, self._data, position)[0])

    def place(self, field: int) -> int | None:
        """Return where a field is stored, None if it is absent."""
        if 4 + 2 * field >= self._unpack("<H", self._fields):
            return None
        offset = self._unpack("<H", self._fields + 4 + 2 * field)
        return self._position + offset if offset else None

    def number(self, field: int, form: str, default: int) -> int:
        """Return a number stored in the table."""
        place = self.place(field)
        return default if place is None else self._unpack(form, place)

    def vector(self, field: int, item_size: int) -> tuple[int, int]:
        """Return start and length of a vector; absent vectors are empty."""
        place = self.place(field)
        if place is None:
            return 0, 0
        start = place + self._unpack("<I", place)
        length = self._unpack("<I", start)
        if start + 4 + length * item_size > len(self._data):
            raise ValueError("a vector is longer than its record")
        return start + 4, length

    def text(self, field: int) -> str:
        """Return a string."""
        start, length = self.vector(field, 1)
        return self._data[start:start + length].decode("utf-8")


def _event_records(packet: bytes) -> npt.NDArray[np.void]:
    """Return the records of an event packet that carries its size in front.

    Raises:
        ValueError, struct.error: the packet is damaged.
    """
    (size,) = struct.unpack_from("<I", packet)
    if size != len(packet) - 4:
        raise ValueError("an event packet has another size than it says")
    start, count = _Table(packet[4:], b"EVTS").vector(0, _RECORD.itemsize)
    return np.frombuffer(packet, _RECORD, count, start + 4) if count else np.empty(0, _RECORD)


class _Decompressor(NamedTuple):
    """A decompression function and what it raises on damage."""

    run: Callable[[bytes], bytes]
    error: type[Exception]


def _decompressor(compression: str, path: Path) -> _Decompressor:
    candidates = {"none": (), "lz4": ("lz4.frame",), "zstd": ("compression.zstd", "backports.zstd", "zstandard")}
    for name in candidates[compression]:
        with contextlib.suppress(ImportError):
            module = importlib.import_module(name)
            return _Decompressor(module.decompress, getattr(module, "ZstdError", RuntimeError))
    if compression == "none":
        return _Decompressor(bytes, ValueError)
    package = {"lz4": "lz4", "zstd": "backports.zstd"}[compression]
    raise InputError(f"{path}: the AEDAT4 recording is compressed with {compression}; install the package that reads "
                     f"it with pip install {package}")
