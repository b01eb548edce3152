"""Compute items ahead in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable
from queue import SimpleQueue
from typing import TypeVar

T = TypeVar("T")


class _End:
    def __init__(self, error: BaseException | None) -> None:
        self.error = error


def prefetch(
    items: Iterable[T], depth: int, stop: Callable[[], object] = lambda: None
) -> Generator[T]:
    """Yield the items in order while a thread computes up to ``depth`` of them ahead.

    An error raised by ``items`` is raised here, after the items before it. The thread ends with
    the items, or when this generator is closed, which calls ``stop`` to end a wait in ``items``.
    """
    queue: SimpleQueue[T | _End] = SimpleQueue()
    room = threading.Semaphore(depth - 1)
    closed = threading.Event()

    def fill() -> None:
        error: BaseException | None = None
        try:
            for item in items:
                queue.put(item)
                room.acquire()
                if closed.is_set():
                    break
        except BaseException as caught:
            error = caught
        queue.put(_End(error))

    thread = threading.Thread(target=fill, name="prefetch", daemon=True)
    thread.start()
    try:
        while True:
            item = queue.get()
            if isinstance(item, _End):
                if item.error is not None:
                    raise item.error
                return
            room.release()
            yield item
    finally:
        closed.set()
        stop()
        room.release()
        thread.join()
