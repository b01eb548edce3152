"""Where in a video an image is, so that decoding can begin at the key frame before it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from motionstereo_cli.sources.pace import Pace


class CodedImage(NamedTuple):
    """A packet of a file: its time stamp, and whether it needs no other to be decoded."""

    pts: int
    is_key: bool


class Entry(NamedTuple):
    """Where to begin, for an image that is asked for.

    Attributes:
        key_pts, key_number: of the key frame to begin at.
        pts, number: of the image.
    """

    key_pts: int
    key_number: int
    pts: int
    number: int


def numbered(coded: Sequence[CodedImage], pace: Pace) -> Iterator[tuple[int, int]]:
    """Yield numbers and time stamps of all images of a file, in the order of time.

    Nothing where time stamps do not tell one image from another.

    Args:
        coded: the images in the order of the file.
        pace: tells the holes in the numbering, from the first image on; it is always as the last
            image yielded leaves it.
    """
    stamps = sorted(each.pts for each in coded)
    if len(set(stamps)) < len(stamps):
        return
    last_pts, number = None, -1
    for pts in stamps:
        number += 1 + (0 if last_pts is None else pace.hole(last_pts, pts, 0, number))
        yield number, pts
        last_pts = pts


def entry(coded: Sequence[CodedImage], pace: Pace, number: int) -> Entry | None:
    """Return where to begin for the first image that has some number or a later one.

    Args:
        coded, pace: as in :func:`numbered`.
        number: that of the image, from 0.

    Returns:
        None where that cannot be told, or there is no such image.
    """
    keys, key = {each.pts for each in coded if each.is_key}, None
    for here, pts in numbered(coded, pace):
        if pts in keys:
            key = pts, here
        if here >= number:
            return Entry(*key, pts, here) if key else None
    return None
