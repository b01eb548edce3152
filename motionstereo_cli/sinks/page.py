"""What is made of the other outputs, when these are complete."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import FrameResult


class Afterwards:
    """Stands for such an output among the others, and does nothing."""

    def write(self, result: FrameResult) -> None:
        """Do nothing."""

    def checkpoint(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def abandon(self, *, keep: bool) -> None:
        """Do nothing."""


def page(_path: Path, _context: RunContext, _since: None = None) -> Afterwards:
    """Return the stand-in of the report; the output folder writes it before its record."""
    return Afterwards()
