"""Prophesee RAW: two real recordings, literal encoders, wraps of the time counters, and damage of every kind."""

from __future__ import annotations

import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from tests.utils.event_samples import random_events, same
from tests.utils.prophesee_encoder import (
    HEADER_EVT2,
    HEADER_EVT3,
    as_events,
    decode_evt3,
    encode_evt2,
    encode_evt3,
    encode_evt21,
    write_raw,
)
from utils.events import Events, open_events, prophesee
from utils.events.prophesee import RawEventReader

SPARSE_US = 3_000_000  # between two events, so that a stream soon wraps its 24-bit counter


def read(path: Path) -> tuple[Events, dict[str, int]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with open_events(path) as reader:
            assert isinstance(reader, RawEventReader)
            events = Events.concatenate(list(reader.chunks()))
            assert len(reader) == len(events)
            assert reader.time_range_us() == (events.t_us[0], events.t_us[-1])
            return events, reader.losses


def read_whole(path: Path) -> Events:
    events, losses = read(path)
    assert losses == {}
    return events


@pytest.fixture
def raw_folder(shared_data: Path) -> Path:
    folder = shared_data / "prophesee_raw"
    if not folder.is_dir():
        pytest.skip(f"real recordings not found at {folder}")
    return folder


def body(path: Path) -> tuple[bytes, bytes]:
    """Header and words of a RAW file."""
    content = path.read_bytes()
    size = prophesee.read_raw_header(path).size
    return content[:size], content[size:]


# --- real recordings ----------------------------------------------------------------------------------------


def test_real_evt3(raw_folder: Path) -> None:
    """Pixels and polarities are those of the reference; its stamps add 4096 us at each fall of TIME_LOW.

    The decoder that wrote the reference counts each fall of TIME_LOW as an overflow, also those that TIME_HIGH
    already tells (2) and stray words of the camera (9). Without this the stamps are equal, and they agree with
    TIME_HIGH, which spans 3 counts of 4096 us in this file, not the 14 of the reference.
    """
    path = raw_folder / "evt3_sample.raw"
    reference = np.load(raw_folder / "evt3_sample.npy")
    events = read_whole(path)
    assert len(events) == 219_596
    with open_events(path) as reader:
        assert (reader.format_name, reader.sensor_size) == ("Prophesee RAW EVT3", (1280, 720))
    np.testing.assert_array_equal(events.x, reference["x"])
    np.testing.assert_array_equal(events.y, reference["y"])
    np.testing.assert_array_equal(events.p, reference["p"])

    words = np.frombuffer(body(path)[1], "<u2")
    kind = words >> 12
    low = (words & 0xFFF).astype(int)[kind == 6]
    falls = np.concatenate([[0], np.cumsum(low[1:] < low[:-1])])
    falls_before_word = falls[np.maximum(np.cumsum(kind == 6) - 1, 0)]
    bits = np.where(kind == 2, 1, np.where(np.isin(kind, (4, 5)), np.bitwise_count(words & 0xFFF), 0))
    surplus = 4096 * np.repeat(falls_before_word, bits)
    assert surplus[-1] == 11 * 4096
    np.testing.assert_array_equal(events.t_us, reference["t"] - surplus)
    assert np.unique(events.t_us >> 12).tolist() == np.unique(words[kind == 8] & 0xFFF).tolist() == [2861, 2862, 2863]


def test_real_evt3_against_the_literal_decoder(raw_folder: Path) -> None:
    path = raw_folder / "evt3_sample.raw"
    header, words = body(path)
    part = words[:200_000]
    assert same(read_whole(path)[:len(decode_evt3(part))], decode_evt3(part))


def test_real_evt2(raw_folder: Path) -> None:
    path = raw_folder / "evt2_sample.raw"
    events = read_whole(path)
    with open_events(path) as reader:
        assert (reader.format_name, reader.sensor_size) == ("Prophesee RAW EVT2", (640, 480))
    assert len(events) == 539_481
    assert (events.t_us[0], events.t_us[-1]) == (1_317_888, 1_367_888)
    words = np.frombuffer(body(path)[1], "<u4")
    is_event = words >> 28 <= 1
    np.testing.assert_array_equal(events.x, words[is_event] >> 11 & 0x7FF)
    np.testing.assert_array_equal(events.y, words[is_event] & 0x7FF)
    np.testing.assert_array_equal(events.p, words[is_event] >> 28)
    np.testing.assert_array_equal(events.t_us & 63, words[is_event] >> 22 & 63)
    highs_before = np.cumsum(words >> 28 == 8)[is_event]
    np.testing.assert_array_equal(events.t_us >> 6, (words[words >> 28 == 8] & 0xFFFFFFF)[highs_before - 1])


@pytest.mark.parametrize("name", ["evt3_sample.raw", "evt2_sample.raw"])
def test_the_size_of_blocks_does_not_matter(name: str, raw_folder: Path, tmp_path: Path,
                                            monkeypatch: pytest.MonkeyPatch) -> None:
    header, words = body(raw_folder / name)
    path = write_raw(tmp_path / "part.raw", header, words[:20_000])
    expected = read_whole(path)
    for size in (64, 1000, 4096):
        monkeypatch.setattr(prophesee, "_BLOCK_BYTES", size)
        assert same(read_whole(path), expected)


# --- literal encoders ---------------------------------------------------------------------------------------


def rows_of_pixels(seed: int, gap_us: int = 40) -> Events:
    """Groups of events of one stamp, row and polarity at growing columns."""
    rng = np.random.default_rng(seed)
    rows, t = [], 0
    for _ in range(150):
        t += int(rng.integers(0, gap_us))
        y, p, start = int(rng.integers(48)), int(rng.integers(2)), int(rng.integers(20))
        columns = np.flatnonzero(rng.random(44) < rng.choice([0.05, 0.5, 1.0])) + start
        rows += [(int(x), y, t, p) for x in columns]
    return as_events(rows)


def evt3(events: Events) -> tuple[bytes, bytes]:
    return HEADER_EVT3, encode_evt3(events, repeat_time_high=16)


def evt3_sparse(events: Events) -> tuple[bytes, bytes]:
    return HEADER_EVT3, encode_evt3(events)


def evt3_vectors(events: Events) -> tuple[bytes, bytes]:
    return HEADER_EVT3, encode_evt3(events, vectors=True)


def evt2(events: Events) -> tuple[bytes, bytes]:
    return HEADER_EVT2, encode_evt2(events, repeat_time_high=16)


def evt21(events: Events) -> tuple[bytes, bytes]:
    return b"% format EVT21;endianness=little;height=48;width=64\n% end\n", encode_evt21(events, legacy=False)


def evt21_legacy(events: Events) -> tuple[bytes, bytes]:
    return b"% format EVT21;endianness=legacy;height=48;width=64\n% end\n", encode_evt21(events, legacy=True)


def evt21_unsaid(events: Events) -> tuple[bytes, bytes]:
    return b"% evt 2.1\n% geometry 64x48\n", encode_evt21(events, legacy=True)


Encoding = Callable[[Events], tuple[bytes, bytes]]
ENCODINGS: list[Encoding] = [evt3, evt3_sparse, evt3_vectors, evt2, evt21, evt21_legacy, evt21_unsaid]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("events", [random_events(3000, seed=1), random_events(500, seed=2, start_us=2**24 - 5000),
                                    random_events(200, seed=3, longest_gap_us=100_000), rows_of_pixels(4)],
                         ids=["dense", "wrap", "quiet", "rows"])
def test_encoded_events_come_back(encoding: Encoding, events: Events, tmp_path: Path) -> None:
    header, words = encoding(events)
    path = write_raw(tmp_path / "e.raw", header, words)
    found = read_whole(path)
    # the counters of EVT3 only know the time since the last wrap before the recording
    offset = int(events.t_us[0]) >> 24 << 24 if header == HEADER_EVT3 else 0
    assert same(found, Events(events.x, events.y, events.t_us - offset, events.p))
    with open_events(path) as reader:
        assert reader.sensor_size == (64, 48)


@pytest.mark.parametrize("encoding", [evt3, evt3_sparse, evt3_vectors])
@pytest.mark.parametrize("block", [64, 1 << 18])
def test_evt3_counter_wraps_three_times(encoding: Encoding, block: int, tmp_path: Path,
                                        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prophesee, "_BLOCK_BYTES", block)
    events = random_events(60, seed=5, longest_gap_us=SPARSE_US)
    assert events.t_us[-1] > 3 * 2**24
    assert same(read_whole(write_raw(tmp_path / "e.raw", *encoding(events))), events)


def test_evt2_counter_wraps_three_times(tmp_path: Path) -> None:
    events = random_events(40, seed=6, longest_gap_us=2**32)
    assert events.t_us[-1] > 3 * 2**34
    assert same(read_whole(write_raw(tmp_path / "e.raw", *evt2(events))), events)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 120), gap=st.sampled_from([0, 1, 50, 5000, SPARSE_US]),
       block=st.sampled_from([2, 32, 4096]), number=st.integers(0, len(ENCODINGS) - 1))
def test_any_events_in_any_blocks(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, gap: int,
                                  block: int, number: int) -> None:
    events = random_events(count, seed, longest_gap_us=gap)
    path = write_raw(tmp_path_factory.mktemp("raw") / "e.raw", *ENCODINGS[number](events))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prophesee, "_BLOCK_BYTES", max(block, 8))
        assert same(read_whole(path), events)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0, 2, 3, 4, 5, 7, 10, 14, 15]), st.integers(0, 0xFFF)), min_size=1,
                max_size=60))
def test_words_in_any_order_as_the_literal_decoder_reads_them(tmp_path_factory: pytest.TempPathFactory,
                                                              words: list[tuple[int, int]]) -> None:
    data = np.array([0x8001, 0x0003, 0x2001] + [kind << 12 | value for kind, value in words], "<u2").tobytes()
    expected = decode_evt3(data)
    inside = expected.x < 2048  # bases at the right edge let vectors leave the 11 bits
    path = write_raw(tmp_path_factory.mktemp("raw") / "e.raw", b"% evt 3.0\n", data)
    found, losses = read(path)
    assert same(found, Events(*(getattr(expected, name)[inside] for name in ("x", "y", "t_us", "p"))))
    assert losses.get("events outside the sensor", 0) == np.count_nonzero(~inside)


def test_reading_a_window_equals_cutting_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prophesee, "_BLOCK_BYTES", 512)
    events = random_events(4000, seed=8)
    with open_events(write_raw(tmp_path / "e.raw", *evt3(events))) as reader:
        for start, stop in ((90_000, 95_000), (10, 500), (40_000, 40_001), (0, 10**9)):  # also backwards
            assert same(reader.read(start, stop), events.between(start, stop))


# --- headers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("header", "size"), [
    (b"% evt 3.0\n", None),
    (b"% format EVT3;height=720;width=1280\n% end\n", (1280, 720)),
    (b"% evt 3.0\n% geometry 320x320\n% end\n", (320, 320)),
    (b"% evt 3.0\r\n% plugin_name hal_plugin_imx636_evk4\r\n", (1280, 720)),
    (b"% format EVT3\n% sensor_name GENX320\n", (320, 320)),
])
def test_headers(header: bytes, size: tuple[int, int] | None, tmp_path: Path) -> None:
    events = random_events(50, seed=9)
    path = write_raw(tmp_path / "e.raw", header, encode_evt3(events))
    assert same(read_whole(path), events)
    with open_events(path) as reader:
        assert reader.sensor_size == size
    with open_events(path, sensor_size=(100, 90)) as reader:
        assert reader.sensor_size == (100, 90)


@pytest.mark.parametrize(("content", "message"), [
    (b"% evt 4.0\n\x00\x80", "says '4.0', expected"),
    (b"% Date today\n\x00\x80", "names no encoding"),
    (b"% evt 3.0", "has no end"),
    (b"% evt 3.0\n% geometry 0x10\n\x00\x80", "a sensor of '0x10' pixels"),
    (b"% Data file containing CD events.\n% Version 2\n\x0c\x08", "a Prophesee DAT file"),
    (b"% evt 3.0\n", "no events"),
    (b"% evt 3.0\n\x00\x80\x01\x60", "no events"),
])
def test_headers_that_cannot_be_read(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "e.raw").write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        open_events(tmp_path / "e.raw")
    assert "e.raw" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_options_that_make_no_sense(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "e.raw", *evt3(random_events(5)))
    with pytest.raises(InputError, match="stamps are microseconds"):
        open_events(path, time_unit="s")
    with pytest.raises(InputError, match="holds one event stream"):
        open_events(path, stream="left")


# --- damage -------------------------------------------------------------------------------------------------


def with_word(data: bytes, index: int, word: int) -> bytes:
    return data[:2 * index] + int(word).to_bytes(2, "little") + data[2 * index:]


def test_losses_are_counted_and_warned_about_once(tmp_path: Path) -> None:
    events = random_events(400, seed=11)
    data = encode_evt3(events, repeat_time_high=16)
    damaged = with_word(with_word(data, 300, 0x9123), 100, 0x1FFF)
    path = write_raw(tmp_path / "e.raw", HEADER_EVT3, damaged)
    with pytest.warns(UserWarning, match=r"e\.raw: 2 words of unknown type left out in bytes") as caught, \
            open_events(path) as reader:
        assert same(reader.read(0, 10**9), events)
        assert reader.losses == {"words of unknown type": 2}
    assert len(caught) == 1


@pytest.mark.parametrize("value", [0, 1, 7, 2047, 2048, 4095])
@pytest.mark.parametrize("encoding", [evt3, evt3_sparse])
def test_a_false_time_high_costs_nothing_but_itself(value: int, encoding: Encoding, tmp_path: Path) -> None:
    """The word before and after agree with each other, so the one between them is damaged."""
    events = random_events(3000, seed=12, start_us=100 << 12)
    header, data = encoding(events)
    path = write_raw(tmp_path / "e.raw", header, with_word(data, 4000, 0x8000 | value))
    found, losses = read(path)
    assert same(found, events)
    assert losses == {"time words that contradict their neighbours": 1}


def test_a_false_time_low_moves_at_most_its_own_events(tmp_path: Path) -> None:
    events = random_events(3000, seed=13, longest_gap_us=3)
    data = encode_evt3(events, repeat_time_high=16)
    for value in (0, 900, 4095):
        found, _ = read(write_raw(tmp_path / "e.raw", HEADER_EVT3, with_word(data, 4000, 0x6000 | value)))
        assert len(found) == len(events)
        assert np.count_nonzero(found.t_us != events.t_us) < 20
        assert np.abs(found.t_us - events.t_us).max() <= 3


def test_time_that_really_runs_backwards_is_an_error(tmp_path: Path) -> None:
    """A recording appended to a later one: an error, unless the caller sorts."""
    early, late = random_events(2000, seed=14), random_events(2000, seed=15, start_us=10**6)
    path = write_raw(tmp_path / "e.raw", HEADER_EVT3, encode_evt3(late) + encode_evt3(early))
    with pytest.raises(InputError, match=r"e\.raw: event 2000: time stamps are not sorted"):
        read(path)
    with open_events(path, on_unsorted="sort") as reader:
        assert len(reader) == 4000
        assert reader.time_range_us() == (early.t_us[0], late.t_us[-1])


def test_events_outside_the_sensor_are_left_out(tmp_path: Path) -> None:
    events = random_events(1000, seed=16)
    path = write_raw(tmp_path / "e.raw", b"% evt 3.0\n% geometry 60x40\n", encode_evt3(events))
    found, losses = read(path)
    inside = (events.x < 60) & (events.y < 40)
    assert losses == {"events outside the sensor": np.count_nonzero(~inside)}
    assert same(found, Events(events.x[inside], events.y[inside], events.t_us[inside], events.p[inside]))


def test_a_file_that_starts_in_the_middle(tmp_path: Path) -> None:
    """Events before the first time word have no time; those behind it are read."""
    events = random_events(2000, seed=17, start_us=5 << 12)
    for header, data, word in ((*evt3(events), 2), (*evt2(events), 4)):
        found, losses = read(write_raw(tmp_path / "e.raw", header, data[word * 700 + word * 3:]))
        lost = len(events) - len(found)
        assert losses["events before the first time word"] > 0
        assert 100 < lost < 800
        assert same(found, events[lost:])


def damage_is_local(found: Events, whole: Events, most: int) -> bool:
    """Whether all but `most` events are equal, counted from both ends."""
    def common(one: Events, other: Events, step: int) -> int:
        length = min(len(one), len(other))
        equal = np.ones(length, bool)
        for name in ("x", "y", "t_us", "p"):
            columns = [getattr(part, name)[::step][:length] for part in (one, other)]
            equal &= columns[0] == columns[1]
        return length if equal.all() else int(np.argmin(equal))

    head, tail = common(found, whole, 1), common(found, whole, -1)
    return head + tail >= max(len(found), len(whole)) - most


@pytest.mark.parametrize(("name", "length"), [("evt3_sample.raw", 30_000), ("evt2_sample.raw", 40_000)])
def test_500_flipped_bytes_of_real_recordings(name: str, length: int, raw_folder: Path, tmp_path: Path) -> None:
    """Each flip is one clear error, or costs the events near it and nothing else."""
    header, words = body(raw_folder / name)
    words = words[:length]
    whole = read_whole(write_raw(tmp_path / "e.raw", header, words))
    rng = np.random.default_rng(18)
    errors = 0
    for position, value in zip(rng.integers(0, length, 500), rng.integers(1, 256, 500)):
        damaged = bytearray(words)
        damaged[position] ^= int(value)
        try:
            found, _ = read(write_raw(tmp_path / "e.raw", header, bytes(damaged)))
        except InputError as error:
            errors += 1
            assert "\n" not in str(error)
            assert "e.raw" in str(error)
        else:
            assert damage_is_local(found, whole, 1500), position
    assert errors < 25


@pytest.mark.parametrize("name", ["evt3_sample.raw", "evt2_sample.raw"])
def test_500_flipped_bytes_from_the_first_byte_on(name: str, raw_folder: Path, tmp_path: Path) -> None:
    """Headers and first words: an error in one line, or events."""
    content = (raw_folder / name).read_bytes()[:400]
    rng = np.random.default_rng(19)
    path = tmp_path / "e.raw"
    for position, value in zip(rng.integers(0, len(content), 500), rng.integers(1, 256, 500)):
        damaged = bytearray(content)
        damaged[position] ^= int(value)
        path.write_bytes(damaged)
        try:
            read(path)
        except InputError as error:
            assert "\n" not in str(error)
            assert "e.raw" in str(error)


@settings(max_examples=150, deadline=None)
@given(header=st.sampled_from([b"% evt 3.0\n", HEADER_EVT3, HEADER_EVT2, b"% evt 2.1\n"]),
       data=st.binary(min_size=1, max_size=600), block=st.sampled_from([8, 64, 1 << 18]))
def test_random_bytes_never_crash(tmp_path_factory: pytest.TempPathFactory, header: bytes, data: bytes,
                                  block: int) -> None:
    path = write_raw(tmp_path_factory.mktemp("raw") / "e.raw", header, data)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prophesee, "_BLOCK_BYTES", block)
        try:
            events, _ = read(path)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert np.all(np.diff(events.t_us) >= 0)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_truncation_anywhere(encoding: Encoding, tmp_path: Path) -> None:
    """What remains are the first events; a word that is cut in two is reported."""
    events = rows_of_pixels(20)
    header, words = encoding(events)
    size = 2 if header == HEADER_EVT3 else 4 if header == HEADER_EVT2 else 8
    for length in range(5, min(len(words), 6000), 67):
        path = write_raw(tmp_path / "e.raw", header, words[:length])
        try:
            found, losses = read(path)
        except InputError as error:
            assert length < 64
            assert "no events" in str(error)
        else:
            assert same(found, events[:len(found)])
            assert losses.get("incomplete words", 0) == (length % size != 0)


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    """The words of 100 ms, repeated with the coarse counter moved on: 2 s take as little memory as 0.2 s."""
    events = random_events(30_000, seed=21, longest_gap_us=6)
    words = np.frombuffer(encode_evt3(events, repeat_time_high=16), "<u2")
    is_high = words >> 12 == 8
    span = int(events.t_us[-1] >> 12) + 1
    peaks = []
    for repeats in (6, 60):
        parts = [np.where(is_high, words + np.uint16(i * span), words) for i in range(repeats)]
        path = write_raw(tmp_path / "e.raw", b"% evt 3.0\n", np.concatenate(parts).tobytes())
        with open_events(path) as reader:
            tracemalloc.start()
            count = sum(len(piece) for piece in reader.chunks())
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert count == repeats * len(events)
    assert peaks[1] < 1.2 * peaks[0]
