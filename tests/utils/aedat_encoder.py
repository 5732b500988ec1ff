"""A literal writer of AEDAT4: flatbuffers assembled by hand, one field at a time."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from utils.events import Events

COMPRESSIONS = {"none": 0, "lz4": 1, "lz4_high": 2, "zstd": 3, "zstd_high": 4}


def compress(data: bytes, compression: str) -> bytes:
    if compression.startswith("lz4"):
        import lz4.frame

        return bytes(lz4.frame.compress(data))
    if compression.startswith("zstd"):
        from backports import zstd

        return bytes(zstd.compress(data))
    return data


def event_packet(events: Events) -> bytes:
    """Size, then a flatbuffer whose root table has one field: a vector of 16-byte records."""
    records = b"".join(struct.pack("<qhh?3x", t, x, y, bool(p)) for x, y, t, p in
                       zip(*(getattr(events, name).tolist() for name in ("x", "y", "t_us", "p"))))
    vtable = struct.pack("<HHH", 6, 8, 4) + bytes(2)
    table = struct.pack("<iI", 8, 4)  # the vtable lies 8 bytes before the table, the vector 4 behind its field
    body = struct.pack("<I", 16) + b"EVTS" + vtable + table + struct.pack("<I", len(events)) + records
    return struct.pack("<I", len(body)) + body


def header(compression: str, data_end: int, description: str) -> bytes:
    """The flatbuffer IOHE: compression (int32), position of the table behind the data (int64), description."""
    text = description.encode()
    vtable = struct.pack("<HHHHH", 10, 24, 4, 8, 16) + bytes(2)
    # table at 20: soffset, compression, data_end, offset of the string
    table = struct.pack("<iiqI4x", 12, COMPRESSIONS[compression], data_end, 8)
    body = struct.pack("<I", 20) + b"IOHE" + vtable + table + struct.pack("<I", len(text)) + text + b"\0"
    return struct.pack("<I", len(body)) + body


def describe(streams: Sequence[tuple[int, str, str]], size: tuple[int, int] | None) -> str:
    """XML of the streams (number, identifier, name)."""
    info = "" if size is None else (f'<node name="info"><attr key="sizeX" type="int">{size[0]}</attr>'
                                    f'<attr key="sizeY" type="int">{size[1]}</attr></node>')
    nodes = "".join(f'<node name="{number}"><attr key="typeIdentifier">{kind}</attr>'
                    f'<attr key="originalOutputName">{name}</attr>{info}</node>' for number, kind, name in streams)
    return f'<dv version="2.0"><node name="outInfo">{nodes}</node></dv>'


def write_aedat4(path: Path, parts: Sequence[Events], *, compression: str = "lz4", closed: bool = True,
                 size: tuple[int, int] | None = (64, 48), second: Sequence[Events] = ()) -> Path:
    """Write events in packets, with packets of a second camera (stream 2) and of an IMU (stream 1) in between."""
    streams = [(0, "EVTS", "left"), (1, "IMUS", "imu")] + [(2, "EVTS", "right")] * bool(len(second))
    packets = b""
    for number, part in [(0, part) for part in parts] + [(2, part) for part in second]:
        data = compress(event_packet(part), compression)
        other = compress(b"not events", compression)
        packets += struct.pack("<ii", number, len(data)) + data + struct.pack("<ii", 1, len(other)) + other
    magic = b"#!AER-DAT4.0\r\n"
    text = describe(streams, size)
    start = len(magic) + len(header(compression, 0, text))
    table = compress(b"FTAB: where the packets are", compression)
    content = magic + header(compression, start + len(packets) if closed else -1, text) + packets
    path.write_bytes(content + table * closed)
    return path


def cut(events: Events, count: int) -> list[Events]:
    """Cut into `count` packets of equal length."""
    borders = np.linspace(0, len(events), count + 1).astype(int).tolist()
    return [events[first:last] for first, last in zip(borders, borders[1:])]
