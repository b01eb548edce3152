"""Where results go.

:data:`SAVES` names every output of a run; a sink's module loads when the output is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from fractions import Fraction
    from pathlib import Path

    from motionstereo_cli.types import FrameResult


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
class Save:
    """An output that ``--save`` can ask for.

    Attributes:
        path: where it lies under the output folder; ``{:06d}`` is the number of the frame.
        what: what it holds, with units.
        open: makes the sink from its path, the time base in s and the largest disparity in px.
        needs_rig: it cannot be had without a rig.
    """

    path: str
    what: str
    open: Callable[[Path, Fraction, int], Sink]
    needs_rig: bool = False

    @property
    def shown(self) -> str:
        """The path as told to users: a folder for numbered files."""
        return self.path.partition("{")[0]


def _steering(path: Path, time_base: Fraction, max_disparity: int) -> Sink:
    from motionstereo_cli.sinks.steering import SteeringFile

    return SteeringFile(path)


def _depth(path: Path, time_base: Fraction, max_disparity: int) -> Sink:
    from motionstereo_cli.sinks.images import depth_images

    return depth_images(path)


def _disparity(path: Path, time_base: Fraction, max_disparity: int) -> Sink:
    from motionstereo_cli.sinks.images import disparity_images

    return disparity_images(path)


def _age(path: Path, time_base: Fraction, max_disparity: int) -> Sink:
    from motionstereo_cli.sinks.images import age_images

    return age_images(path)


def _confidence(path: Path, time_base: Fraction, max_disparity: int) -> Sink:
    from motionstereo_cli.sinks.images import confidence_images

    return confidence_images(path)


def _charge_video(path: Path, time_base: Fraction, max_disparity: int) -> Sink:
    from motionstereo_cli.sinks.previews import charge_video

    return charge_video(path, time_base)


def _depth_video(path: Path, time_base: Fraction, max_disparity: int) -> Sink:
    from motionstereo_cli.sinks.previews import depth_video

    return depth_video(path, time_base, max_disparity)


SAVES = {
    "steering": Save(
        "steering.csv",
        "one row a frame; time_s in s, steer -1..1 and steer_rad in rad with positive = left, "
        "depth_m and nearest_m in m, charged and matched as shares of the image; "
        "empty = unknown",
        _steering,
    ),
    "depth": Save(
        "depth/{:06d}.png",
        "uint16 depth in mm, right view; 0 = unknown or over 65.535 m",
        _depth,
        needs_rig=True,
    ),
    "disparity": Save(
        "disparity/{:06d}.png",
        "uint16 disparity in 1/256 px, right view; 0 = unknown, a known 0 is stored as 1",
        _disparity,
    ),
    "age": Save(
        "age/{:06d}.png",
        "uint8 frames since something moved there, right view; 255 = forgotten",
        _age,
    ),
    "confidence": Save(
        "confidence/{:06d}.png",
        "uint8 chance that the disparity is right within 1 px, in 1/255, right view; "
        "0 = no disparity",
        _confidence,
    ),
    "charge": Save("charge.mp4", "right permanency memory, charge as grey", _charge_video),
    "depth-video": Save(
        "depth.mp4",
        "depth in colour, red = near, blue = far, black = unknown; "
        "log scale of the disparity from 1 px to max_disparity",
        _depth_video,
    ),
}

DEFAULT_SAVES = ("steering", "depth", "charge", "depth-video")


def available(save: Sequence[str], *, rig: bool) -> tuple[str, ...]:
    """Return the outputs to write, each once; without a rig, disparity takes depth's place."""
    return tuple(
        dict.fromkeys("disparity" if SAVES[name].needs_rig and not rig else name for name in save)
    )
