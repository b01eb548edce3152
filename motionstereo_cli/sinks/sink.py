"""The interface of sinks, and what they know of a run before its first frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Protocol, TypeVar

from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.types import FrameImages, Step

if TYPE_CHECKING:
    from motionstereo_cli.method.settings import Settings
    from motionstereo_cli.types import Rig


#: The optical frame of REP 103 where the input has none: x right, y down, z forward.
OPTICAL_FRAME = "camera_optical_frame"

#: Time between frames in videos, in s, if the source has no times.
DEFAULT_TIME_BASE = Fraction(1, 25)

#: Times in s that begin later than this count from an epoch; videos then begin at 0.
EPOCH_S = 3_600

_Input_contra = TypeVar("_Input_contra", FrameImages, Step, contravariant=True)


class Sink(Protocol[_Input_contra]):
    """Takes the results of a run, frame by frame; each method may raise OutputError.

    Sinks that show single frames take images; sinks of sequential results take steps.
    """

    def write(self, given: _Input_contra, /) -> None:
        """Take the next frame."""

    def checkpoint(self) -> object:
        """Sync all results so far to disk.

        Returns the checkpoint from which a sink of the same output, opened ``since`` it, continues
        or, where syncing takes long, a function that does it and returns that, for another thread.
        """

    def close(self) -> None:
        """Complete the output and give it its final name."""

    def abandon(self, *, keep: bool) -> None:
        """End early: complete a stream under its ``.part`` name or, without ``keep``, remove it.

        Complete files stay. After :meth:`close` this does nothing.
        """


@dataclass(frozen=True, slots=True)
class RunContext:
    """The context of a run, known before its first frame.

    Attributes:
        time_base: seconds per unit of the frames' time stamps.
        settings: parameters of the processing.
        rig: the calibration; None if unknown.
        output: parameters of the output.
        optical_frame: name of the reference camera's optical frame in bags.
        with_map: the map is among the outputs, so that steps have poses and points.
    """

    time_base: Fraction
    settings: Settings
    rig: Rig | None
    output: OutputSettings = field(default_factory=OutputSettings)
    optical_frame: str = OPTICAL_FRAME
    with_map: bool = False
