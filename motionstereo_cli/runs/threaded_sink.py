"""Sinks that write in threads of their own."""

from __future__ import annotations

from concurrent.futures import Future
from queue import Queue
from threading import Thread
from typing import Any

from motionstereo_cli.sinks.sink import Sink
from motionstereo_cli.types import FrameImages, Step

#: Frames that may wait for a sink; beyond that the stream waits for the slowest sink.
_WAITING = 2


class Threaded:
    """A sink that writes in a thread of its own, in order.

    An error of the sink is raised by the next :meth:`write`, or by :meth:`close`.
    """

    def __init__(self, sink: Sink[Any]) -> None:
        self._sink = sink
        self._queue: Queue[FrameImages | Step | Future[object] | None] = Queue(_WAITING)
        self._error: Exception | None = None
        self._closed = False
        self._thread = Thread(target=self._work, name=type(sink).__name__, daemon=True)
        self._thread.start()

    def write(self, given: FrameImages | Step) -> None:
        """Hand over the next frame."""
        if self._error is not None:
            raise self._error
        self._queue.put(given)

    def checkpoint(self) -> Future[object]:
        """Return the sink's checkpoint after the frames so far, once it has made it."""
        made: Future[object] = Future()
        self._queue.put(made)
        return made

    def close(self) -> None:
        """Wait until all is written, then complete the output."""
        self._finish()
        if self._error is not None:
            raise self._error
        self._sink.close()
        self._closed = True

    def abandon(self, *, keep: bool) -> None:
        """Wait until all is written, then end the output early."""
        if not self._closed:
            self._finish()
            self._sink.abandon(keep=keep)

    def _finish(self) -> None:
        if self._thread.is_alive():
            self._queue.put(None)
        self._thread.join()

    def _work(self) -> None:
        # After an error the queue is still drained, so that no thread waits for room in it.
        while (item := self._queue.get()) is not None:
            try:
                if self._error is not None:
                    raise self._error
                if isinstance(item, Future):
                    item.set_result(self._sink.checkpoint())
                else:
                    self._sink.write(item)
            except Exception as error:
                self._error = error
                if isinstance(item, Future):
                    item.set_exception(error)
