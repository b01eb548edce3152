"""Standard input or a FIFO, as a file that is read once from beginning to end."""

from __future__ import annotations

import hashlib
import os
import selectors
import sys
import threading
import time
from pathlib import Path

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import open_fifo

#: Unlike select(), poll() takes descriptors over 1,023, which a process with many files has; unlike
#: epoll(), it takes regular files, to which standard input may be redirected.
_Waiting = getattr(selectors, "PollSelector", selectors.SelectSelector)

#: Interval in s at which a wait for data checks whether it should end.
_GLANCE_S = 0.2

#: Timeout of a FIFO, in s, because no program may be writing to it.
PATIENCE_S = 10.0


class Pipe:
    """A stream of bytes for FFmpeg, hashed as it is read.

    Args:
        fifo: the FIFO to read, with a timeout; None for standard input.

    Attributes:
        bytes_read: bytes read so far.
        head: the first of them.
        ended: the other end has closed.
        interrupted: the user interrupted a wait for data.
        silent: the timeout passed without data.

    Raises:
        InputError: the FIFO cannot be opened; standard input is closed or a terminal.
    """

    def __init__(self, fifo: Path | None = None) -> None:
        self._fifo = fifo
        self._descriptor = _standard_input() if fifo is None else _opened(fifo)
        self._sums = hashlib.sha256()
        self._stopped = threading.Event()
        self.bytes_read = 0
        self.head = b""
        self.ended = self.interrupted = self.silent = False

    def __str__(self) -> str:
        return "standard input" if self._fifo is None else str(self._fifo)

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes; none at the end, once stopped, or after the timeout."""
        try:
            if not self._wait():
                return b""
        except KeyboardInterrupt:  # it does not propagate through FFmpeg
            self.interrupted = True
            self.stop()
            return b""
        content = os.read(self._descriptor, size)
        self.head = self.head or content[:256]
        self._sums.update(content)
        self.bytes_read += len(content)
        self.ended = not content
        return content

    def _wait(self) -> bool:
        begun_s = time.monotonic()
        with _Waiting() as waiting:
            waiting.register(self._descriptor, selectors.EVENT_READ)
            while not self._stopped.is_set():
                if waiting.select(_GLANCE_S):
                    return True
                if self._fifo is not None and time.monotonic() - begun_s > PATIENCE_S:
                    self.silent = True
                    self.stop()
        return False

    def stop(self) -> None:
        """End a read that waits for data, as if there were no more."""
        self._stopped.set()

    def close(self) -> None:
        """Close the FIFO; standard input stays as it is."""
        self.stop()
        if self._fifo is not None and self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    @property
    def sha256(self) -> str | None:
        """SHA-256 of all data, None before the end."""
        return self._sums.hexdigest() if self.ended else None


def _standard_input() -> int:
    if sys.stdin is None or sys.stdin.closed:
        raise InputError("standard input is closed: pipe a video into it, or name a file")
    descriptor = sys.stdin.fileno()
    if os.isatty(descriptor):
        raise InputError("standard input is a terminal: pipe a video into it, or name a file")
    return descriptor


def _opened(fifo: Path) -> int:
    try:
        descriptor = open_fifo(fifo)
    except OSError as error:
        raise InputError(f"cannot read {fifo}: {error.strerror}") from error
    os.set_blocking(descriptor, True)
    return descriptor
