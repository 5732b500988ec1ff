"""AEDAT4: a real recording, a literal writer, several cameras, missing packages, and damage."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from devo.errors import InputError
from tests.utils.aedat_encoder import compress, cut, event_packet, write_aedat4
from tests.utils.event_samples import random_events, same
from utils.events import Events, aedat4, open_events
from utils.events.aedat4 import Aedat4EventReader

pytest.importorskip("lz4.frame", reason="most AEDAT4 recordings need the optional package lz4")


def read(path: Path, **options: object) -> tuple[Events, dict[str, int]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with open_events(path, **options) as reader:  # type: ignore[arg-type]
            assert isinstance(reader, Aedat4EventReader)
            events = Events.concatenate(list(reader.chunks()))
            assert len(reader) == len(events)
            assert reader.time_range_us() == (events.t_us[0], events.t_us[-1])
            return events, reader.losses


@pytest.fixture
def real(shared_data: Path) -> Path:
    path = shared_data / "aestream_davis346" / "davis.aedat4"
    if not path.is_file():
        pytest.skip(f"real recording not found at {path}")
    return path


def test_real_recording(real: Path) -> None:
    events, losses = read(real)
    assert losses == {}
    assert len(events) == 117_667
    with open_events(real) as reader:
        assert reader.sensor_size == (346, 260)
    assert (events.t_us[0], events.t_us[-1]) == (1_633_953_690_975_950, 1_633_953_691_105_949)
    assert (events.x.max(), events.y.max()) == (345, 259)
    # the first packet, decompressed by hand: 16-byte records behind 32 bytes of flatbuffer
    import lz4.frame

    content = real.read_bytes()
    start = content.index(b"\x04\x22\x4d\x18", 3226)
    packet = lz4.frame.decompress(content[start:start + 76_994])
    count = int.from_bytes(packet[28:32], "little")
    records = np.frombuffer(packet, "<i8", 2 * count, 32).reshape(count, 2)
    np.testing.assert_array_equal(events.t_us[:count], records[:, 0])
    np.testing.assert_array_equal(events.x[:count], records[:, 1] & 0xFFFF)
    np.testing.assert_array_equal(events.y[:count], records[:, 1] >> 16 & 0xFFFF)
    np.testing.assert_array_equal(events.p[:count], records[:, 1] >> 32 & 1)


@pytest.mark.parametrize("compression", ["none", "lz4", "lz4_high", "zstd", "zstd_high"])
@pytest.mark.parametrize("closed", [True, False])
def test_written_events_come_back(compression: str, closed: bool, tmp_path: Path,
                                  monkeypatch: pytest.MonkeyPatch) -> None:
    if compression.startswith("zstd"):
        pytest.importorskip("backports.zstd")
    monkeypatch.setattr(aedat4, "_BYTES_PER_BLOCK", 2000)
    events = random_events(1000, seed=1, start_us=1_600_000_000_000_000)
    parts = [*cut(events, 9), Events.empty()]
    path = write_aedat4(tmp_path / "e.aedat4", parts, compression=compression, closed=closed)
    found, losses = read(path)
    assert same(found, events)
    assert losses == {}
    with open_events(path) as reader:
        assert reader.sensor_size == (64, 48)
        first = int(events.t_us[0])
        for start, stop in ((15_000, 16_000), (0, 300), (7000, 7001)):  # forwards and back
            assert same(reader.read(first + start, first + stop), events.between(first + start, first + stop))


def test_one_of_two_cameras(tmp_path: Path) -> None:
    left, right = random_events(50, seed=2), random_events(60, seed=3)
    path = write_aedat4(tmp_path / "e.aedat4", [left], second=[right], size=None)
    with pytest.raises(InputError, match=r"several event streams \(0 left, 2 right\)"):
        open_events(path)
    assert same(read(path, stream="left")[0], left)
    assert same(read(path, stream="2 right")[0], right)
    with open_events(path, stream="left", sensor_size=(70, 60)) as reader:
        assert reader.sensor_size == (70, 60)


def test_a_packet_that_is_damaged_is_left_out(tmp_path: Path) -> None:
    events = random_events(900, seed=4)
    parts = cut(events, 9)
    content = write_aedat4(tmp_path / "e.aedat4", parts).read_bytes()
    packet = compress(event_packet(parts[4]), "lz4")
    place = content.index(packet)
    (tmp_path / "e.aedat4").write_bytes(content[:place] + bytes(len(packet)) + content[place + len(packet):])
    with pytest.warns(UserWarning, match="1 damaged packets left out in bytes"), \
            open_events(tmp_path / "e.aedat4") as reader:
        found = Events.concatenate(list(reader.chunks()))
    assert same(found, Events.concatenate(parts[:4] + parts[5:]))


@pytest.mark.parametrize("closed", [True, False])
def test_truncation_is_reported(closed: bool, tmp_path: Path) -> None:
    """Complete packets are read; an open recording cut between two packets looks like one that ended there."""
    events = random_events(600, seed=5)
    path = write_aedat4(tmp_path / "e.aedat4", cut(events, 6), closed=closed)
    content = path.read_bytes()
    end = len(content) - (len(compress(b"FTAB: where the packets are", "lz4")) if closed else 0)
    for length in range(15, end, 41):
        path.write_bytes(content[:length])
        try:
            found, losses = read(path)
        except InputError as error:
            assert "header" in str(error) or "no events" in str(error)
        else:
            assert same(found, events[:len(found)])
            assert len(found) == len(events) or losses == {"incomplete packets": 1}


def test_500_flipped_bytes(tmp_path: Path) -> None:
    """A clear error, a reported loss, or values that passed all checks: LZ4 frames of this format have no checksum."""
    events = random_events(200, seed=6)
    path = write_aedat4(tmp_path / "e.aedat4", cut(events, 4))
    content = path.read_bytes()
    rng = np.random.default_rng(7)
    outcomes = {"error": 0, "loss": 0, "read": 0}
    for position, value in zip(rng.integers(0, len(content), 500), rng.integers(1, 256, 500)):
        damaged = bytearray(content)
        damaged[position] ^= int(value)
        path.write_bytes(damaged)
        try:
            _, losses = read(path)
        except InputError as error:
            assert "\n" not in str(error)
            assert "e.aedat4" in str(error)
            outcomes["error"] += 1
        else:
            outcomes["loss" if losses else "read"] += 1
    assert min(outcomes.values()) > 0


def test_flipped_bytes_of_the_real_recording(real: Path, tmp_path: Path) -> None:
    content = real.read_bytes()[:100_000]  # the first packet of events is complete, the rest cut off
    path = tmp_path / "e.aedat4"
    rng = np.random.default_rng(8)
    for position, value in zip(rng.integers(0, 83_000, 100), rng.integers(1, 256, 100)):
        damaged = bytearray(content)
        damaged[position] ^= int(value)
        path.write_bytes(damaged)
        try:
            read(path)
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(("content", "message"), [
    (b"#!AER-DAT2.0\r\n# events\r\n", "AEDAT version '2.0', expected 4.0"),
    (b"#!AER-DAT4.0\r\n", "header of the AEDAT4 recording is damaged"),
    (b"#!AER-DAT4.0\r\n\xff\xff\xff\x7fabc", "ends inside the header"),
    (b"#!AER-DAT4.0\r\n\x10\0\0\0" + bytes(16), "expected a IOHE record"),
])
def test_headers_that_cannot_be_read(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "e.aedat4").write_bytes(content)
    with pytest.raises(InputError, match=message):
        open_events(tmp_path / "e.aedat4")


def test_no_events_and_wrong_options(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no events"):
        open_events(write_aedat4(tmp_path / "a.aedat4", []))
    path = write_aedat4(tmp_path / "b.aedat4", [random_events(4)])
    with pytest.raises(InputError, match="stamps are microseconds"):
        open_events(path, time_unit="ns")
    with pytest.raises(InputError, match="no event stream is called 'top'"):
        open_events(path, stream="top")
    content = path.read_bytes().replace(b"EVTS</attr>", b"XXXX</attr>")
    path.write_bytes(content)
    with pytest.raises(InputError, match="no stream with events"):
        open_events(path)


@pytest.mark.parametrize(("compression", "modules", "package"), [
    ("lz4", ["lz4.frame"], "lz4"), ("zstd", ["compression.zstd", "backports.zstd", "zstandard"], "backports.zstd")])
def test_what_to_install(compression: str, modules: list[str], package: str, tmp_path: Path,
                         monkeypatch: pytest.MonkeyPatch) -> None:
    if compression == "zstd":
        pytest.importorskip("backports.zstd")
    path = write_aedat4(tmp_path / "e.aedat4", [random_events(4)], compression=compression)
    for name in modules:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=f"compressed with {compression}.*pip install {package}"):
        open_events(path)
