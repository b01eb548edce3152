"""The two sides of a stereo source: the images of each, and what became of them."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from motionstereo_cli.sources.recording import Recording, images

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Something moves where this share of an image changes by more than this many grey levels. A still
#: scene may look the same twice to one camera, and through its encoder, and not to the other.
_MOVING_SHARE = 0.01
_MOTION_GREY = 12


class Loss(NamedTuple):
    """What a stream has lost up to some image.

    It goes along with the image, because the decoding thread is ahead by a varying number.
    """

    lost: int
    flawed: int
    damage: tuple[str, ...]

    @classmethod
    def of(cls, stream: Recording) -> Loss:
        """Return what a recording has lost so far."""
        return cls(stream.lost, stream.flawed, tuple(stream.damage))


class SideImage(NamedTuple):
    """One image of a recording, ready to be paired.

    Attributes:
        order: how many images came before it.
        number, pts: as in :class:`~motionstereo_cli.sources.recording.Image`.
        time_s: pts in s, None where there is no time.
        views: the view, or the two views, in it.
        repeats: the image is that before it, byte for byte.
        loss: what was lost before it.
        colours: the view whose colours are asked for, (height, width, 3) uint8 RGB; else None.
    """

    order: int
    number: int
    pts: int
    time_s: Fraction | None
    views: tuple[Grey, ...]
    repeats: bool
    loss: Loss
    colours: NDArray[np.uint8] | None = None


def bare(stream: Recording) -> Iterator[SideImage]:
    """Yield the images of a recording, not decoded, to be paired; none where it cannot tell."""
    for order, (number, pts) in enumerate(stream.outline()):
        time_s = None if stream.time_base is None else pts * stream.time_base
        yield SideImage(order, number, pts, time_s, (), repeats=False, loss=Loss(0, 0, ()))


class Side:
    """One camera: its stream, which half of its images is meant, and what became of them.

    Attributes:
        paired: images used in pairs.
        early: images that came before the first of those.
        repeated: images used that were the one before, while objects moved in the other view.
        loss: what was lost up to the last image that came.
        begin: images passed over that are not decoded.
    """

    def __init__(self, stream: Recording, half: int = 0) -> None:
        self.stream, self.half = stream, half
        self.paired = self.early = self.repeated = 0
        self.loss = Loss(0, 0, ())
        self.begin = 0
        self._came = 0
        self._last_used = -1
        self._ended = False

    def follow(self, feed: Iterator[SideImage | Loss]) -> Iterator[SideImage]:
        """Pass the images on, and count them."""
        for item in feed:
            if isinstance(item, Loss):
                self.loss, self._ended = item, True
                return
            self._came, self.loss = self._came + 1, item.loss
            yield item

    def begin_with(self, shot: SideImage) -> None:
        """Count all images before one as come."""
        self.begin = self._came = shot.order

    def use(self, shot: SideImage) -> None:
        """Note that an image has a partner."""
        if not self.paired:
            self.early = shot.order
        self.paired += 1
        self._last_used = shot.order

    @property
    def late(self) -> int:
        """Images that came after the last pair, if there was one."""
        return self._came - 1 - self._last_used if self.paired else 0

    @property
    def between(self) -> int:
        """Images without partner between those that have one."""
        return self._came - self.paired - self.early - self.late if self.paired else 0

    @property
    def left_over(self) -> int:
        """About how many images come after the last pair."""
        return self.late + (self.counts["unread"] or 0)

    def unused(self, early: int, late: int) -> list[str]:
        """Return what of the images was not used, or is not new, one line each.

        Args:
            early, late: images before the first pair and after the last that should have partners.
        """
        name, dropped = self.stream.name, self.between + early
        lines = {
            f"{images(dropped)} dropped: no partner on the other side": dropped,
            f"{images(self.repeated)} repeated while the other side moves": self.repeated,
            f"about {images(late)} longer than the other side: only the common part was "
            "processed": late,
        }
        return [f"{name}: {line}" for line, count in lines.items() if count > 0]

    @property
    def counts(self) -> dict[str, int | None]:
        """See :attr:`StereoSource.counts`."""
        read = self._came + self.loss.lost
        expected = self.stream.expected_images
        unread = 0 if self._ended else expected and max(expected - read, 0)
        return {
            "read": read,
            "paired": self.paired,
            "unpaired": self._came - self.paired,
            "damaged": self.loss.lost,
            "flawed": self.loss.flawed,
            "repeated": self.repeated,
            "unread": unread,
        }


def same(one: Grey, other: Grey) -> bool:
    """Return whether two images, (height, width) uint8, are equal."""
    # A few rows tell most that are not.
    return np.array_equal(one[::32], other[::32]) and np.array_equal(one, other)


def moves(shot: SideImage, last: SideImage) -> bool:
    """Return whether objects move from one image to the next of the same camera."""
    changed = cv2.absdiff(shot.views[-1], last.views[-1]) > _MOTION_GREY
    return not shot.repeats and float(np.mean(changed)) > _MOVING_SHARE
