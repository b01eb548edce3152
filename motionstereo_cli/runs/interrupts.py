"""Ctrl-C and SIGTERM, deferred to a safe moment."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def children_ignoring_interrupts() -> Iterator[None]:
    """Make processes started in the block ignore Ctrl-C, which a terminal sends to all of them."""
    former = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)


@contextlib.contextmanager
def finishing() -> Iterator[None]:
    """Defer interrupts until the block ends; a second one is not deferred.

    Only the main thread gets signals: in other threads this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    former = {number: signal.getsignal(number) for number in _SIGNALS}

    def restore() -> None:
        for number, handler in former.items():
            signal.signal(number, handler)

    def hold(number: int, _: FrameType | None) -> None:
        caught.append(number)
        restore()

    for number in _SIGNALS:
        signal.signal(number, hold)
    try:
        yield
    finally:
        restore()
    if caught:
        signal.raise_signal(caught[0])
