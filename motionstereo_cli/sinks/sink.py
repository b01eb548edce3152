"""What every sink does, and what it knows of a run before the first frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Protocol, TypeVar

from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.types import FrameImages, Step

if TYPE_CHECKING:
    from motionstereo_cli.method.settings import Settings
    from motionstereo_cli.types import Rig


#: Time from frame to frame in the videos, in s, where the source has no time.
DEFAULT_TIME_BASE = Fraction(1, 25)

#: Times in s that begin beyond this count from an epoch; no player waits for that long.
EPOCH_S = 86_400

_Input_contra = TypeVar("_Input_contra", FrameImages, Step, contravariant=True)


class Sink(Protocol[_Input_contra]):
    """Takes what becomes of a run's frames, one by one; each method may raise OutputError.

    What shows one frame takes its images, what follows from frame to frame takes its step.
    """

    def write(self, given: _Input_contra, /) -> None:
        """Take the next frame."""

    def checkpoint(self) -> object:
        """Make sure that all results so far are on the disk.

        Returns what a sink of the same output, opened ``since`` then, needs to go on from here.
        """

    def close(self) -> None:
        """Complete the output and give it its final name."""

    def abandon(self, *, keep: bool) -> None:
        """End early: complete a stream under its ``.part`` name or, without ``keep``, remove it.

        Whole files written so far stay. After :meth:`close` this does nothing.
        """


@dataclass(frozen=True, slots=True)
class RunContext:
    """What sinks know of a run before its first frame.

    Attributes:
        time_base: seconds per unit of the frames' time stamps.
        settings: parameters of the processing.
        rig: the camera; None if unknown.
        output: parameters of the output.
    """

    time_base: Fraction
    settings: Settings
    rig: Rig | None
    output: OutputSettings = field(default_factory=OutputSettings)
