"""Smooth surfaces, where grey tells little: planes through the disparity of what lies around.

On a smooth wall the noise of a video decides which disparity costs least, and a trail is right
only as long as the wall has not gone on. What lies around decides, in this order:

1. Whether trails tell the same as the matching nearby: then they are taken where it is smooth.
2. A plane through the known disparities nearby that have about the same grey.
3. A plane through textured pixels alone, farther away, if the camera or the wall moves: old trails
   on a wall keep the disparity of the edge that made them, while the wall goes on.
4. The same nearby, of what is far away: there a small error is a large share of the disparity.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array, reused
from motionstereo_cli.compiled import planes as loops

Reals = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: A pixel is smooth if no slope of grey in this window, px and rows, has so many levels per px; it
#: is textured if its own has more.
_WINDOW, _SMOOTH, _TEXTURED = (9, 3), 0.7, 1.0

#: Trails are believed where this share of them in a window agrees with the matching within so many
#: px.
_AGREEING, _AGREE_PX, _AGREEMENT_WINDOW = 0.8, 1.5, (65, 33)

#: What a smooth pixel weighs in a plane beside others.
_WEIGHT = 0.5

#: Samples of one surface are not independent: a plane's error is as large as if there were fewer of
#: them by this factor.
_DEPENDENT = 11.0

#: Largest error in px of the planes through textured pixels: where things move; far away, and there
#: up to which disparity in px; and beyond the left view's border.
_MAX_ERROR_PX, _MAX_FAR_ERROR_PX, _FAR_PX, _MAX_UNSEEN_ERROR_PX = 0.3, 0.17, 6.0, 0.15

#: By so many px at most such a plane changes what the matching nearby says: else it is another
#: surface of the same grey.
_MAX_CHANGE_PX = 3.0

#: A part rests if this share of the textured pixels around has not moved for so many frames, and
#: there are enough of them.
_RESTING, _REST_FRAMES, _REST_WINDOW, _REST_PIXELS = 0.5, 2, (161, 65), 20

_NEARBY, _AFAR, _FAR = (
    loops.Window(*values)  # type: ignore[call-arg]  # mypy does not know its dataclasses
    for values in (
        (32, 16, 4, 4, 8, 4, 6.0, 2.0, 3, 0.6, 0.6),
        (240, 60, 12, 6, 16, 8, 14.0, 1.5, 5, 0.8, 1.0),
        (24, 12, 3, 3, 8, 4, 12.0, 1.0, 5, 0.8, 1.0),
    )
)


class Surface(NamedTuple):
    """What grey and charge tell of each pixel, (rows, width) each.

    Attributes:
        grey: of the right view, float32.
        smooth: where grey is nearly the same around, bool.
        textured: where grey changes from pixel to pixel, bool.
        wanted: pixels that need a disparity, bool.
        age_frames: frames since something moved there, uint8, 255 = forgotten.
    """

    grey: Reals
    smooth: Mask
    textured: Mask
    wanted: Mask
    age_frames: NDArray[np.uint8]

    @classmethod
    def of(cls, grey: Reals, wanted: Mask, age_frames: NDArray[np.uint8]) -> Surface:
        """Find out where grey is smooth and where it is textured."""
        blurred = cv2.GaussianBlur(grey, (0, 0), 1)
        slope = np.abs(cv2.Sobel(blurred, cv2.CV_32F, 1, 0, scale=1 / 8))
        steep = (slope >= _SMOOTH).view(np.uint8)
        smooth = cv2.dilate(steep, np.ones(_WINDOW[::-1], np.uint8)) == 0
        return cls(grey, smooth, slope > _TEXTURED, wanted, age_frames)


def with_planes(
    disparity_px: Reals, trails_px: Reals, surface: Surface, max_disparity: int
) -> tuple[Reals, Reals]:
    """Return disparity with planes on what is smooth, and the inliers' share, (rows, width).

    Both are float32, NaN = unknown; the share is NaN where no plane decided.

    Args:
        disparity_px: of the matching, (rows, width) float32, NaN = unknown.
        trails_px: of trails, likewise.
        surface: what is smooth, and what is wanted.
        max_disparity: px.
    """
    need = surface.smooth & surface.wanted
    believed = surface.smooth & _agreeing(disparity_px, trails_px) & ~np.isnan(trails_px)
    source = np.where(believed, trails_px, disparity_px)
    weight = np.where(surface.smooth & ~believed, np.float32(_WEIGHT), np.float32(1))
    found, _, share = _fitted(source, weight, surface, need, _NEARBY, max_disparity)
    result = np.where(need, found, source)

    textured = np.where(surface.smooth, np.float32(0), np.float32(1))
    error_px = np.full_like(result, np.nan)
    moving = need & ~_resting(surface)
    if moving.any():
        found, error, inliers = _fitted(
            disparity_px, textured, surface, moving, _AFAR, max_disparity
        )
        sure = (error < _MAX_ERROR_PX) & ~(np.abs(found - result) > _MAX_CHANGE_PX)
        _take(found, inliers, sure, result, share)
        np.copyto(error_px, error, where=sure)
    far = need & ~(result >= 4 * _FAR_PX)
    if far.any():
        found, error, inliers = _fitted(disparity_px, textured, surface, far, _FAR, max_disparity)
        is_far = (result < _FAR_PX) | (found < _FAR_PX)
        sure = (error < _MAX_FAR_ERROR_PX) & ~(np.abs(found - result) > _MAX_CHANGE_PX)
        _take(found, inliers, is_far & sure, result, share)
    # A partner beyond the left view's border was not seen: only a sure plane tells of it.
    beyond = np.arange(result.shape[1]) + np.nan_to_num(result) > result.shape[1] - 1
    unsure = beyond & ~(error_px < _MAX_UNSEEN_ERROR_PX)
    result[unsure] = share[unsure] = np.nan
    return result, share


def _take(found: Reals, inliers: Reals, where: Mask, result: Reals, share: Reals) -> None:
    np.copyto(result, found, where=where)
    np.copyto(share, inliers, where=where)


def _fitted(
    disparity_px: Reals,
    weight: Reals,
    surface: Surface,
    where: Mask,
    window: loops.Window,
    max_disparity: int,
) -> Reals:
    """Return disparity, its error in px and the inliers' share, NaN where there is no plane."""
    shape = disparity_px.shape
    found = np.empty((3, *shape), np.float32)
    # A trail's disparity between whole px may exceed the range a little.
    samples = reused(loops.Samples, *shape, max_disparity + 1)
    loops.fit(
        checked_array(np.minimum(disparity_px, np.float32(max_disparity + 1)), np.float32),
        checked_array(weight, np.float32, shape),
        checked_array(surface.grey, np.float32, shape),
        checked_array(where, np.bool_, shape).view(np.uint8),
        *(window, samples, *found),
    )
    found[1] *= np.float32(_DEPENDENT**0.5)
    return found


def _agreeing(disparity_px: Reals, trails_px: Reals) -> Mask:
    """Return where most trails around say what the matching says."""
    both = ~np.isnan(disparity_px) & ~np.isnan(trails_px)
    agree = np.abs(disparity_px - trails_px) <= _AGREE_PX
    return _count(agree, _AGREEMENT_WINDOW) > _AGREEING * _count(both, _AGREEMENT_WINDOW)


def _resting(surface: Surface) -> Mask:
    """Return where most textured pixels around have not moved lately."""
    textured = _count(surface.textured, _REST_WINDOW)
    resting = _count(surface.textured & (surface.age_frames >= _REST_FRAMES), _REST_WINDOW)
    return (textured >= _REST_PIXELS) & (resting + 1 > _RESTING * (textured + 2))


def _count(mask: Mask, window: tuple[int, int]) -> Reals:
    return cv2.boxFilter(  # type: ignore[return-value]
        mask.view(np.uint8), cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
