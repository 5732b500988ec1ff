"""The vectorised text parser against exact decimals, and everything text files may contain beside events."""

from __future__ import annotations

from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from utils.events import open_events
from utils.events.text_parser import BadLineError, _parse_lines, _parse_plain, parse_block

WHOLE = st.integers(0, 10**10).map(str)
DECIMALS = st.text("0123456789", min_size=1, max_size=18)
STAMPS = st.one_of(WHOLE, st.builds(lambda whole, part: f"{whole}.{part}", WHOLE, DECIMALS))
ROWS = st.lists(st.tuples(STAMPS, st.integers(0, 99999), st.integers(0, 99999), st.sampled_from(["0", "1", "-1"])),
                min_size=1, max_size=20)
PER_UNIT = {"s": Decimal(10**6), "ms": Decimal(10**3), "us": Decimal(1), "ns": Decimal("0.001")}


def exact(stamp: str, unit: str) -> int:
    if unit == "ns":  # only the whole part decides, half up
        return (int(Decimal(stamp)) + 500) // 1000
    return int((Decimal(stamp) * PER_UNIT[unit]).to_integral_value(ROUND_HALF_UP))


@settings(max_examples=200, deadline=None)
@given(rows=ROWS, unit=st.sampled_from(["s", "ms", "us", "ns"]))
def test_every_number_is_exact(rows: list[tuple[str, int, int, str]], unit: str) -> None:
    block = "".join(f"{t} {x} {y} {p}\n" for t, x, y, p in rows).encode()
    columns = parse_block(block, unit)  # type: ignore[arg-type]
    assert columns.t_us.tolist() == [exact(t, unit) for t, *_ in rows]
    assert columns.x.tolist() == [row[1] for row in rows]
    assert columns.y.tolist() == [row[2] for row in rows]
    assert columns.p.tolist() == [int(row[3]) for row in rows]


@settings(max_examples=100, deadline=None)
@given(rows=ROWS.filter(lambda rows: len({"." in row[0] for row in rows}) == 1))
def test_plain_lines_take_the_fast_path_and_agree_with_the_slow_one(rows: list[tuple[str, int, int, str]]) -> None:
    block = "".join(f"{t} {x} {y} {p}\n" for t, x, y, p in rows).encode()
    fast = _parse_plain(block, "s")
    assert fast is not None
    for one, other in zip(fast, _parse_lines(block, "s")):
        assert np.array_equal(one, other)


@settings(max_examples=300, deadline=None)
@given(block=st.text(alphabet="0123456789 .-\n\t#e,nai\r\x00", max_size=60).map(str.encode))
def test_fast_and_slow_paths_agree_on_anything(block: bytes) -> None:
    """What the fast path accepts, the exact one accepts with the same values; it never invents events."""
    try:
        columns = parse_block(block, "s")
    except BadLineError:
        return
    translated = block.replace(b"\r\n", b"\n").replace(b",", b" ")
    for one, other in zip(columns, _parse_lines(translated, "s")):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("text", [
    "0.5 1 2 1\n0.6 3 4 0\n",
    "0.5 1 2 1\n0.6 3 4 0",
    "0.5 1 2 1\r\n0.6 3 4 0\r\n",
    "0.5,1,2,1\n0.6,3,4,0\n",
    "0.5, 1, 2, 1\n0.6, 3, 4, 0\n",
    "0.5\t1\t2\t1\n0.6\t3\t4\t0\n",
    "  0.5   1 2 1  \n\n\n0.6 3 4 0\n\n",
    "# t x y p\n0.5 1 2 1\n# a remark\n0.6 3 4 0\n",
    "t x y p\n0.5 1 2 1\n0.6 3 4 0\n",
    "timestamp,x,y,polarity\n0.5,1,2,1\n0.6,3,4,-1\n",
    "5e-1 1 2 1\n6.0e-1 3 4 -1\n",
    "5.000000e-01 1.000000e+00 2.0 1\n0.6 3.0 4.0 0.0\n",
    "+0.5 1 2 +1\n0.6 3 4 -1\n",
    "500000 1 2 1\n600000 3 4 0\n",
    "# timestamp[us] x y polarity\n500000.0 1 2 1\n600000.2 3 4 0\n",
    "# t_ns x y p\n500000000 1 2 1\n600000499 3 4 0\n",
    "240 180\n0.5 1 2 1\n0.6 3 4 0\n",
    "0.5 1 2 1\n0.59999950000 3 4 0\n",
    "0.5 1 2 1\n0.6000004999999999999999 3 4 0\n",
])
def test_spellings_of_the_same_two_events(text: str, tmp_path: Path) -> None:
    (tmp_path / "e.txt").write_bytes(text.encode())
    with open_events(tmp_path / "e.txt") as reader:
        events = reader.read(0, 10**9)
    assert events.t_us.tolist() == [500_000, 600_000]
    assert events.x.tolist() == [1, 3]
    assert events.y.tolist() == [2, 4]
    assert events.p.tolist() == [1, 0]


def test_first_line_may_give_the_sensor_size(tmp_path: Path) -> None:
    (tmp_path / "e.txt").write_text("240 180\n0.5 1 2 1\n")
    with open_events(tmp_path / "e.txt") as reader:
        assert reader.sensor_size == (240, 180)


@pytest.mark.parametrize(("text", "message"), [
    ("0.5 1 2\n0.6 3 4 1\n", r"line 1: 3 columns instead of 4"),
    ("0.5 1 2 1\n\n# x\n0.6 3 4\n0.7 1 1 1\n", r"line 4: 3 columns instead of 4 \(t x y p\): \"0.6 3 4\""),
    ("0.5 1 2 1\n0.6 3", r"line 2: 2 columns.*cut off there"),
    ("0.5 1 2 1 9\n", r"line 1: 5 columns"),
    ("0.5 1 2 1\n0.6 a 4 1\n", r"line 2: \"a\" is not a number"),
    ("0.5 1 2 1\nnan 3 4 1\n", r"line 2: \"nan\" is not a finite number"),
    ("nan 3 4 1\n", r"line 1: \"nan\" is not a finite number"),
    ("0.5 1 2 1\n1e400 3 4 1\n", r"line 2: a number is out of any range"),
    ("0.5 1 2 1\n0.6 3.5 4 1\n", r"line 2: x, y and p must be whole numbers"),
    ("0.5 1 2 1\n-0.6 3 4 1\n", r"event 1 \(line 2\).*not sorted"),
    ("-0.6 3 4 1\n", r"event 0 \(line 1\): negative time stamp -600000 us"),
    ("0.5 1 2 1\n0.6 3 4 2\n", r"event 1 \(line 2\): polarity is 2, expected 0/1 or -1/\+1"),
    ("0.5 1 2 1\n0.6 3 70000 1\n", r"event 1 \(line 2\): y = 70000 is outside any known sensor"),
    ("0.5 1 2 1\n0.6 -3 7 1\n", r"event 1 \(line 2\): x = -3 is outside"),
    ("# head\n0.5 1 2 1\n0.6 3 7 1\n0.55 3 7 1\n", r"event 2 \(line 4\): time stamps are not sorted, 550000 us"),
    ("4294.9 1 2 1\n4294.967 3 7 1\n0.001 3 7 1\n", r"event 2 \(line 3\).*32-bit microsecond counter wrapped"),
    ("# only\n# comments\n", r"no events, only comments"),
    ("\n\n", r"no events"),
    ("# x y t p\n1 2 0.5 1\n", r"header names the columns x y t p, expected t x y p"),
    ("x,y,p,t\n1,2,1,500\n", r"header names the columns x y p t"),
    ("12345678901234567890123 1 2 1\n", r"out of any range"),
    ("1_000 1 2 1\n", r"not a number"),
])
def test_what_is_wrong_is_said_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "e.txt").write_text(text)
    with pytest.raises(InputError, match=message) as caught, open_events(tmp_path / "e.txt") as reader:
        reader.read(0, 2**60)
    assert "\n" not in str(caught.value)
    assert "e.txt" in str(caught.value)


def test_line_numbers_are_right_far_into_the_file(tmp_path: Path) -> None:
    lines = ["# head", ""] + [f"{i / 1e4:.6f} 1 2 1" for i in range(60_000)]
    lines[50_001] = "5.0 1 2"
    (tmp_path / "e.txt").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=r"line 50002: 3 columns"), open_events(tmp_path / "e.txt") as reader:
        len(reader)


def test_time_range_reads_only_the_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [f"{i / 1e4:.6f} 1 2 1" for i in range(200_000)]
    (tmp_path / "e.txt").write_text("\n".join(lines) + "\n# the end\n")
    with open_events(tmp_path / "e.txt") as reader:
        monkeypatch.setattr(reader, "_index_until", lambda stop: pytest.fail("read the whole file"))
        assert reader.time_range_us() == (0, 19_999_900)
