"""Decode and voxelise the next frames in other threads while the tracker works on the current one."""

from __future__ import annotations

import concurrent.futures
import contextlib
import queue
import threading
from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from devo.errors import InputError

Item = TypeVar("Item")

LOOK_AHEAD = 4
"""Frames that may wait, by default; with one in the making and one in use, memory holds `LOOK_AHEAD + 2`."""


class _End:
    """What the thread puts behind the last item: nothing, or the exception that ended the stream."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error


def prefetch(items: Iterable[Item], look_ahead: int = LOOK_AHEAD) -> Generator[Item, None, None]:
    """The same items in the same order, made in a thread of their own, at most `look_ahead` in advance.

    Whatever the stream raises, `KeyboardInterrupt` included, is raised here in its place, after the items before it.
    Closing the returned generator (or dropping it) stops the thread and closes the stream. Nothing starts before the
    first item is asked for.

    Args:
        items: the stream; used in the other thread only.
        look_ahead: at least 1, or 0 to do without a thread.

    Raises:
        InputError: look_ahead is negative.
    """
    if look_ahead < 0:
        raise InputError(f"look_ahead is {look_ahead}; expected 0 (no thread) or more")
    return _prefetch(items, look_ahead) if look_ahead else (item for item in items)


def prefetch_tasks(tasks: Iterable[Callable[[], Item]], workers: int) -> Generator[Item, None, None]:
    """The results of `tasks` in their order: one thread goes through the stream, `workers` threads run the tasks.

    At most `workers + LOOK_AHEAD` results or tasks wait. Exceptions and closing as for `prefetch`.

    Args:
        tasks: the stream, for example `Recording.voxel_tasks()`.
        workers: threads; 0 runs every task where its result is asked for.

    Raises:
        InputError: workers is negative.
    """
    if workers < 0:
        raise InputError(f"workers is {workers}; expected 0 (no thread) or more")
    return _run_ahead(tasks, workers) if workers else (task() for task in tasks)


def _run_ahead(tasks: Iterable[Callable[[], Item]], workers: int) -> Generator[Item, None, None]:
    pool = concurrent.futures.ThreadPoolExecutor(workers, thread_name_prefix="prefetch")
    futures = prefetch((pool.submit(task) for task in tasks), workers + LOOK_AHEAD)
    try:
        with contextlib.closing(futures):
            for future in futures:
                yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _prefetch(items: Iterable[Item], look_ahead: int) -> Generator[Item, None, None]:
    waiting: queue.Queue[Item | _End] = queue.Queue(look_ahead)
    stop = threading.Event()
    thread = threading.Thread(target=_produce, args=(items, waiting, stop), name="prefetch", daemon=True)
    thread.start()
    try:
        while not isinstance(item := waiting.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        stop.set()
        while thread.is_alive():  # it may wait for room in the queue
            _drain(waiting)
            thread.join(timeout=0.05)


def _produce(items: Iterable[Item], waiting: queue.Queue[Item | _End], stop: threading.Event) -> None:
    end = _End()
    try:
        stream = iter(items)
        try:
            for item in stream:
                waiting.put(item)
                del item  # the queue alone decides how long it lives
                if stop.is_set():
                    break
        finally:
            close = getattr(stream, "close", None)
            if close is not None:
                close()
    except BaseException as error:  # noqa: BLE001 - it is raised again where the items are used
        end = _End(error)
    waiting.put(end)


def _drain(waiting: queue.Queue[Item | _End]) -> None:
    try:
        while True:
            waiting.get_nowait()
    except queue.Empty:
        return
