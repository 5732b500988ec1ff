"""Look-ahead: order, bounds, exceptions, Ctrl-C, and no thread left behind."""

from __future__ import annotations

import functools
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from devo.errors import InputError
from utils.datasets.prefetch import LOOK_AHEAD, prefetch, prefetch_tasks

ROOT = Path(__file__).resolve().parents[2]


def threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


@given(st.lists(st.integers(), max_size=20), st.integers(0, 5))
def test_the_same_items_in_the_same_order(items: list[int], look_ahead: int) -> None:
    assert list(prefetch(iter(items), look_ahead)) == items
    assert not threads()


@pytest.mark.parametrize("look_ahead", [1, 3])
def test_never_more_in_advance_than_allowed(look_ahead: int) -> None:
    made: list[int] = []

    def stream() -> Iterator[int]:
        for i in range(20):
            made.append(i)
            yield i

    for used, _ in enumerate(prefetch(stream(), look_ahead)):
        time.sleep(0.002)
        # waiting in the queue, one in the hands of the thread, and the one in use
        assert len(made) <= used + 1 + look_ahead + 1
    assert made == list(range(20))


@pytest.mark.parametrize("error", [InputError("line 7 is damaged"), KeyboardInterrupt(), SystemExit(3)])
def test_exceptions_come_in_their_place(error: BaseException) -> None:
    def stream() -> Iterator[int]:
        yield from range(3)
        raise error

    got = []
    with pytest.raises(type(error)) as caught:
        for item in prefetch(stream()):
            got.append(item)
    assert got == [0, 1, 2] and caught.value is error and not threads()


def test_leaving_early_closes_stream_and_thread() -> None:
    closed = threading.Event()

    def stream() -> Iterator[int]:
        try:
            yield from range(10**9)
        finally:
            closed.set()

    frames = prefetch(stream(), 2)
    assert next(frames) == 0 and threads()
    frames.close()
    assert closed.is_set() and not threads()
    for item in prefetch(stream(), 2):  # a loop that breaks drops the generator
        if item == 3:
            break
    del item
    assert not threads()


def test_nothing_starts_before_it_is_needed() -> None:
    frames = prefetch(iter([1]), 1)
    assert not threads()
    assert list(frames) == [1]


def test_negative_look_ahead_is_refused() -> None:
    with pytest.raises(InputError, match="look_ahead"):
        prefetch([], -1)


def test_tensors_arrive_untouched() -> None:
    voxels = [torch.randn(2, 8, 8, generator=torch.Generator().manual_seed(i)) for i in range(9)]
    for threaded, direct in zip(prefetch(iter(voxels), 2), voxels, strict=True):
        assert threaded.numpy().tobytes() == direct.numpy().tobytes()


def test_ctrl_c_while_waiting_for_a_slow_stream_ends_the_program_at_once() -> None:
    # a shell that starts tests in the background makes them, and their children, ignore Ctrl-C
    code = ("import signal, time\nfrom utils.datasets.prefetch import prefetch\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
            "def slow():\n    yield 1\n    time.sleep(0.3)\n    yield 2\n    time.sleep(0.3)\n    yield 3\n"
            "try:\n    for i in prefetch(slow()): print(i, flush=True)\n"
            "except KeyboardInterrupt: print('interrupted')\n")
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None and process.stdout.readline() == "1\n"
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=20)
    assert output == "interrupted\n" and process.returncode == 0


@pytest.mark.parametrize("workers", [0, 1, 3])
def test_results_of_tasks_come_in_order_however_long_they_take(workers: int) -> None:
    def task(i: int) -> int:
        time.sleep(0.004 if i % 3 == 0 else 0.0)
        return i

    tasks = (functools.partial(task, i) for i in range(20))
    assert list(prefetch_tasks(tasks, workers)) == list(range(20)) and not threads()


@pytest.mark.parametrize("workers", [0, 2])
def test_a_failing_task_raises_in_its_place(workers: int) -> None:
    def task(i: int) -> int:
        if i == 3:
            raise InputError("frame 3 is damaged")
        return i

    got = []
    with pytest.raises(InputError, match="frame 3"):
        for result in prefetch_tasks((functools.partial(task, i) for i in range(9)), workers):
            got.append(result)
    assert got == [0, 1, 2] and not threads()


def test_tasks_are_not_started_too_early_and_not_after_the_end() -> None:
    started: list[int] = []
    results = prefetch_tasks((functools.partial(started.append, i) for i in range(10**9)), 2)
    for _ in range(3):
        next(results)
    time.sleep(0.05)
    assert len(started) <= 3 + 2 + LOOK_AHEAD + 1
    results.close()
    count = len(started)
    time.sleep(0.02)
    assert len(started) == count and not threads()
    with pytest.raises(InputError, match="workers"):
        prefetch_tasks([], -1)
