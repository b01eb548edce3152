"""Which left image belongs to which right image."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import TypeVar

T = TypeVar("T")


def pair(
    lefts: Iterator[T],
    rights: Iterator[T],
    lead: Callable[[T, T], Fraction],
    tolerance: Fraction = Fraction(0),
) -> Iterator[tuple[T, T]]:
    """Yield the left and right items that belong together, in order; each is used once at most.

    An item is passed over where the next one on its side is nearer to its partner.

    Args:
        lefts, rights: items in ascending order.
        lead: how much earlier the left item is than the right one; negative where it is later.
        tolerance: largest difference in a pair.
    """
    left, right = next(lefts, None), next(rights, None)
    while left is not None and right is not None:
        gap = lead(left, right)
        if gap > 0:
            later = next(lefts, None)
            if gap <= tolerance and (later is None or abs(lead(later, right)) >= gap):
                yield left, right
                right = next(rights, None)
            left = later
        elif gap < 0:
            later = next(rights, None)
            if -gap <= tolerance and (later is None or abs(lead(left, later)) >= -gap):
                yield left, right
                left = next(lefts, None)
            right = later
        else:
            yield left, right
            left, right = next(lefts, None), next(rights, None)
