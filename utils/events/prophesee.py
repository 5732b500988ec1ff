"""Prophesee RAW recordings: a text header, then a stream of EVT2, EVT2.1 or EVT3 words."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devo.errors import InputError
from utils.events.losses import LossyReader
from utils.events.prophesee_decoders import Decoded, Decoder, Evt2Decoder, Evt3Decoder, Evt21Decoder, State, Words
from utils.events.types import Events
from utils.events.validate import Order, TimeUnit

_BLOCK_BYTES = 1 << 18  # the work arrays of one block stay in the processor's cache
_LONGEST_HEADER = 1 << 16
_OUTSIDE = "events outside the sensor"
_CUT_OFF = "incomplete words"
_LARGEST_SENSOR = (2048, 2048)  # all encodings have 11 bits for columns and rows
# Older headers name the camera but not its size.
_SENSOR_OF_PLUGIN = (("gen41", (1280, 720)), ("gen4", (1280, 720)), ("imx636", (1280, 720)),
                     ("genx320", (320, 320)), ("gen3", (640, 480)))


class RawHeader(NamedTuple):
    """What the header of a RAW file says.

    Attributes:
        size: bytes of the header.
        encoding: "EVT2", "EVT2.1" or "EVT3".
        legacy: order of the halves of EVT2.1 words, None if not said.
        sensor_size: (width, height) in pixels, None if neither said nor known from the camera's name.
    """

    size: int
    encoding: str
    legacy: bool | None
    sensor_size: tuple[int, int] | None


def read_raw_header(path: Path) -> RawHeader:
    """Read the header of a Prophesee RAW file.

    Raises:
        InputError: no such header, or an encoding that is not known.
    """
    with path.open("rb") as stream:
        head = stream.read(_LONGEST_HEADER)
    size, entries = 0, {}
    while head[size:size + 1] == b"%":
        end = head.find(b"\n", size)
        if end < 0:
            raise InputError(f"{path}: the header of the Prophesee recording has no end; the file is damaged")
        key, _, value = head[size + 1:end].decode("latin-1").strip().partition(" ")
        entries[key.lower()] = value.strip()
        size = end + 1
        if key == "end":
            break
    if "Data file containing" in " ".join(f"{key} {value}" for key, value in entries.items()) or "data" in entries:
        raise InputError(f"{path} is a Prophesee DAT file, which is not read; convert the RAW recording instead")
    encoding, options = _encoding(entries, path)
    endianness = options.get("endianness")
    return RawHeader(size, encoding, None if endianness is None else endianness == "legacy",
                     _sensor_size(entries, options, path))


def _encoding(entries: dict[str, str], path: Path) -> tuple[str, dict[str, str]]:
    name, *options = entries.get("format", "").split(";")
    version = entries.get("evt", "")
    encoding = {"EVT3": "EVT3", "EVT21": "EVT2.1", "EVT2.1": "EVT2.1", "EVT2": "EVT2",
                "3.0": "EVT3", "2.1": "EVT2.1", "2.0": "EVT2"}.get(name.strip().upper() or version)
    if encoding is None:
        said = f"says {name or version!r}" if name or version else "names no encoding"
        raise InputError(f"{path}: the header of the Prophesee recording {said}, expected '% evt 2.0', '2.1' or "
                         "'3.0', or '% format EVT2', 'EVT21' or 'EVT3'")
    pairs = (option.partition("=") for option in options)
    return encoding, {key.strip().lower(): value.strip().lower() for key, _, value in pairs}


def _sensor_size(entries: dict[str, str], options: dict[str, str], path: Path) -> tuple[int, int] | None:
    text = entries.get("geometry")
    if {"width", "height"} <= options.keys():
        text = f"{options['width']}x{options['height']}"
    if text is not None:
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
        size = (int(match[1]), int(match[2])) if match else (0, 0)
        if not (0 < size[0] <= 65536 and 0 < size[1] <= 65536):
            raise InputError(f"{path}: the header of the Prophesee recording says a sensor of {text!r} pixels")
        return size
    camera = " ".join(entries.get(key, "") for key in ("plugin_name", "sensor_name")).lower()
    return next((size for name, size in _SENSOR_OF_PLUGIN if name in camera), None)


class RawEventReader(LossyReader):
    """Stream of events in a Prophesee RAW file, decoded block by block in bounded memory.

    The time counters of the camera (24 bits in EVT3, 34 in EVT2) are unwrapped; stamps count from the wrap before
    the first event. Damaged words cost the events around them, which `losses` counts; events outside the sensor are
    left out and counted too. Arguments as in `open_events`; stamps are always microseconds.

    Raises:
        InputError: the header is unusable, or time runs backwards for longer than a damaged word explains.
    """

    format_name = "Prophesee RAW"

    def __init__(self, path: Path, sensor_size: tuple[int, int] | None, time_unit: TimeUnit | None,
                 order: Order) -> None:
        if time_unit not in (None, "us"):
            raise InputError(f"{path}: Prophesee RAW stamps are microseconds, time_unit={time_unit!r} makes no sense")
        header = read_raw_header(path)
        super().__init__(path, sensor_size if sensor_size is not None else header.sensor_size, order)
        self.format_name = f"Prophesee RAW {header.encoding}"
        self._file = path.open("rb")
        self._decoder = self._choose_decoder(header)
        self._starts = [(header.size, State())]

    def close(self) -> None:
        """Close the file."""
        super().close()
        self._file.close()

    def _choose_decoder(self, header: RawHeader) -> Decoder:
        if header.encoding == "EVT3":
            return Evt3Decoder()
        if header.encoding == "EVT2":
            return Evt2Decoder()
        if header.legacy is not None:
            return Evt21Decoder(header.legacy)
        # Not said: the half with the types is the one whose types exist and whose time words have an empty other half.
        self._file.seek(header.size)
        data = self._file.read(1 << 16)
        halves = np.frombuffer(data[:len(data) // 8 * 8], "<u4").reshape(-1, 2)
        known = np.isin(halves >> 28, (0, 1, 8, 10, 14, 15)).sum(axis=0)
        lone_times = ((halves >> 28 == 8) & (halves[:, ::-1] == 0)).sum(axis=0)
        first, second = known + lone_times
        return Evt21Decoder(legacy=bool(first > second))

    def _decode(self, block: int) -> Events | None:
        start, state = self._starts[block]
        self._file.seek(start)
        words, next_ticks, cut_off = self._words()
        if not len(words) and not cut_off:
            return None
        decoded = self._decoder.decode(words, state, next_ticks)
        lost = decoded.lost
        if cut_off:
            lost[_CUT_OFF] += 1
        events = self._inside(decoded, lost)
        if block + 1 == len(self._starts):
            self._starts.append((start + words.nbytes + cut_off, decoded.state))
        self._note_losses(block, lost, f"in bytes {start} to {start + words.nbytes + cut_off}")
        return self._check(*events, block, lambda i: f"{self.path}: event {self._rows_before(block) + i}")

    def _words(self) -> tuple[Words, int | None, int]:
        """Return the next words up to a coarse time word, the raw counter in it, and the bytes of a cut-off word."""
        dtype = self._decoder.word_dtype
        data = self._file.read(_BLOCK_BYTES)
        words = np.frombuffer(data, dtype, count=len(data) // dtype.itemsize)
        if len(data) < _BLOCK_BYTES:
            return words, None, len(data) % dtype.itemsize
        # The word behind the block tells whether the last time word of the block can be trusted.
        last = self._decoder.last_coarse_word(words)
        return (words[:last], self._decoder.ticks_of(words[last]), 0) if last else (words, None, 0)

    def _inside(self, decoded: Decoded, lost: Counter[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the columns of the events inside the sensor."""
        columns = decoded.x, decoded.y, decoded.t_us, decoded.p
        if not len(decoded.x):
            return columns
        width, height = self.sensor_size or _LARGEST_SENSOR
        if int(decoded.x.max()) < width and int(decoded.y.max()) < height:
            return columns
        inside = (decoded.x < width) & (decoded.y < height)
        lost[_OUTSIDE] += len(inside) - int(np.count_nonzero(inside))
        return decoded.x[inside], decoded.y[inside], decoded.t_us[inside], decoded.p[inside]
