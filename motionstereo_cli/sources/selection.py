"""Which pairs are delivered as frames: --start, --end and --every."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from motionstereo_cli.sources.settings import InputSettings, Place
    from motionstereo_cli.sources.sides import SideImage


class Selected(NamedTuple):
    """A pair's place among all pairs.

    Attributes:
        frame: number of the frame that it becomes, None where it is skipped.
        number: how many pairs came before it.
        begun: number of the first pair that is not before --start, None before that.
        is_last: --end comes next.
    """

    frame: int | None
    number: int
    begun: int | None
    is_last: bool = False


def chosen(
    pairs: Iterator[tuple[SideImage, SideImage]],
    begin: Selected,
    settings: InputSettings,
    begin_s: Fraction,
) -> Iterator[tuple[Selected, SideImage, SideImage]]:
    """Yield pairs and what they are, up to --end.

    Args:
        pairs: left and right images, from that of ``begin`` on.
        begin: what the first pair is.
        settings: which are delivered.
        begin_s: time of the first right image.
    """
    first, stop, every = settings.first, settings.stop, settings.every
    frame, begun = begin.frame or 0, begin.begun
    for number, (left, right) in enumerate(pairs, begin.number):
        if begun is None and _reached(first, number, right, begin_s):
            begun = number
        ended = stop is not None and _reached(stop, number, right, begin_s)
        if ended and isinstance(stop, int):
            return
        delivered = begun is not None and not ended and (number - begun) % every == 0
        is_last = ended or (isinstance(stop, int) and number + 1 == stop)
        yield Selected(frame if delivered else None, number, begun, is_last), left, right
        if is_last:
            return
        frame += delivered


def _reached(place: Place, number: int, shot: SideImage, begin_s: Fraction) -> bool:
    if isinstance(place, int):
        return number >= place
    return shot.time_s is not None and shot.time_s - begin_s >= place


def place_near(place: Place, rate: Fraction | None) -> int:
    """Return about which frame stands at a place."""
    return place if isinstance(place, int) else round(place * (rate or 0))
