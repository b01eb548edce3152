"""Where results go.

:data:`SAVES` names every output of a run; a sink's module loads when the output is asked for.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from fractions import Fraction
    from pathlib import Path

    from motionstereo_cli.types import FrameResult, Rig


class Sink(Protocol):
    """Takes in the results of a run one by one; each method may raise OutputError."""

    def write(self, result: FrameResult) -> None:
        """Take in the result of the next frame."""

    def close(self) -> None:
        """Complete the output and give it its final name."""

    def abandon(self, *, keep: bool) -> None:
        """End early: complete a stream under its ``.part`` name or, without ``keep``, remove it.

        Whole files written so far stay. After :meth:`close` this does nothing.
        """


@dataclass(frozen=True, slots=True)
class Stream:
    """What sinks know of a run before its first frame.

    Attributes:
        time_base: seconds per unit of the frames' time stamps.
        max_disparity: largest disparity looked for, in px.
        rig: the camera; None where nobody knows.
    """

    time_base: Fraction
    max_disparity: int
    rig: Rig | None


@dataclass(frozen=True, slots=True)
class Save:
    """An output that ``--save`` can ask for.

    Attributes:
        path: where it lies under the output folder; ``{:06d}`` is the number of the frame.
        what: what it holds, with units.
        sink: module and function that make the sink from its path and the stream.
        needs_rig: it cannot be had without a rig.
    """

    path: str
    what: str
    sink: str
    needs_rig: bool = False

    @property
    def shown(self) -> str:
        """The path as told to users: a folder for numbered files."""
        return self.path.partition("{")[0]

    def open(self, out: Path, stream: Stream) -> Sink:
        """Return the sink of a run into the folder ``out``.

        Raises:
            OutputError: the output cannot be written.
        """
        module, function = self.sink.split(".")
        factory = getattr(importlib.import_module(f"{__name__}.{module}"), function)
        sink: Sink = factory(out / self.path, stream)
        return sink


SAVES = {
    "steering": Save(
        "steering.csv",
        "one row a frame; time_s in s, steer -1..1 and steer_rad in rad with positive = left, "
        "depth_m and nearest_m in m, charged and matched as shares of the image; "
        "empty = unknown",
        "steering.steering_file",
    ),
    "depth": Save(
        "depth/{:06d}.png",
        "uint16 depth in mm, right view; 0 = unknown or over 65.535 m",
        "images.depth_images",
        needs_rig=True,
    ),
    "disparity": Save(
        "disparity/{:06d}.png",
        "uint16 disparity in 1/256 px, right view; 0 = unknown, a known 0 is stored as 1",
        "images.disparity_images",
    ),
    "age": Save(
        "age/{:06d}.png",
        "uint8 frames since something moved there, right view; 255 = forgotten",
        "images.age_images",
    ),
    "confidence": Save(
        "confidence/{:06d}.png",
        "uint8 chance that the disparity is right within 1 px, in 1/255, right view; "
        "0 = no disparity",
        "images.confidence_images",
    ),
    "charge": Save(
        "charge.mp4", "right permanency memory, charge as grey", "previews.charge_video"
    ),
    "depth-video": Save(
        "depth.mp4",
        "depth in colour, red = near, blue = far, black = unknown; "
        "log scale of the disparity from 1 px to max_disparity",
        "previews.depth_video",
    ),
}

DEFAULT_SAVES = ("steering", "depth", "charge", "depth-video")


def available(save: Sequence[str], *, rig: bool) -> tuple[str, ...]:
    """Return the outputs to write, each once; without a rig, disparity takes depth's place."""
    return tuple(
        dict.fromkeys("disparity" if SAVES[name].needs_rig and not rig else name for name in save)
    )
