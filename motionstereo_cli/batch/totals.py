"""Sums over the frames of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from motionstereo_cli.types import FrameResult


@dataclass(frozen=True, slots=True)
class Totals:
    """Sums over the frames so far.

    Attributes:
        frames: how many there were.
        charged, matched: sums of the shares of the image with charge and with a disparity.
    """

    frames: int = 0
    charged: float = 0.0
    matched: float = 0.0

    def plus(self, result: FrameResult) -> Totals:
        """Return the sums with a further frame."""
        return replace(
            self,
            frames=self.frames + 1,
            charged=self.charged + result.charged,
            matched=self.matched + result.matched,
        )
