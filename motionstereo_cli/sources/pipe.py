"""Standard input as a file that is read once, from front to back."""

from __future__ import annotations

import hashlib
import os
import select
import sys
import threading

from motionstereo_cli.errors import InputError

#: How often a wait for data looks whether it should end, in s.
_GLANCE_S = 0.2


class Pipe:
    """What FFmpeg reads standard input through; it hashes as it goes.

    Attributes:
        bytes_read: bytes read so far.
        ended: the other end has closed.
        interrupted: a wait for data was, by the user.

    Raises:
        InputError: standard input is closed or a terminal.
    """

    def __init__(self) -> None:
        if sys.stdin is None or sys.stdin.closed:
            raise InputError("standard input is closed: pipe a video into it, or name a file")
        self._descriptor = sys.stdin.fileno()
        if os.isatty(self._descriptor):
            raise InputError("standard input is a terminal: pipe a video into it, or name a file")
        self._sums = hashlib.sha256()
        self._stopped = threading.Event()
        self.bytes_read = 0
        self.ended = self.interrupted = False

    def __str__(self) -> str:
        return "standard input"

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes; none at the end, or once stopped."""
        try:
            while not self._stopped.is_set():
                if select.select([self._descriptor], [], [], _GLANCE_S)[0]:
                    break
            else:
                return b""
        except KeyboardInterrupt:  # it does not find its way through FFmpeg
            self.interrupted = True
            self.stop()
            return b""
        content = os.read(self._descriptor, size)
        self._sums.update(content)
        self.bytes_read += len(content)
        self.ended = not content
        return content

    def stop(self) -> None:
        """Let a read that waits for data end now, as if there were no more."""
        self._stopped.set()

    @property
    def sha256(self) -> str | None:
        """SHA-256 of all that came, None before the end."""
        return self._sums.hexdigest() if self.ended else None
