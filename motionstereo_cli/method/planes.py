"""Smooth surfaces, where grey tells little: planes through the disparity of what lies around.

On a smooth wall the noise of a video decides which disparity costs least, and a trail is right
only as long as the wall has not gone on. What lies around decides, in this order:

1. Whether trails tell the same as the matching nearby: then they are taken where it is smooth.
2. A plane through the known disparities nearby that have about the same grey.
3. A plane through textured pixels alone, farther away and of any grey, if the camera or the wall
   moves: old trails on a wall keep the disparity of the edge that made them, while the wall goes
   on. What is painted on a wall tells more of it than what has its grey.
4. The same nearby, of what is far away: there a small error is a large share of the disparity.

What has its partner beyond the left view's border cannot be matched, smooth or not: a plane through
sure matches beside it, if there is one, tells where it is.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import around, checked_array, reused
from motionstereo_cli.compiled import planes as loops

Reals = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: A pixel is smooth if no slope of grey in this window, px and rows, has so many levels per px; it
#: is textured if its own has more.
_WINDOW, _SMOOTH, _TEXTURED = (9, 3), 0.7, 1.0

#: Trails are believed where this share of them in a window agrees with the matching within so many
#: px.
_AGREEING, _AGREE_PX, _AGREEMENT_WINDOW = 0.8, 1.5, (65, 33)

#: Samples of one surface are not independent: a plane's error is as large as if there were fewer of
#: them by this factor.
_DEPENDENT = 11.0

#: Largest error in px of the planes through textured pixels: where things move; far away, and there
#: up to which disparity in px; and beyond the left view's border, of smooth and of other pixels.
_MAX_ERROR_PX, _MAX_FAR_ERROR_PX, _FAR_PX = 0.5, 0.17, 6.0
_MAX_SMOOTH_ERROR_PX, _MAX_UNSEEN_ERROR_PX = 0.15, 1.1

#: A match of this margin is sure enough to tell of what lies beyond the left view's border.
_SURE = 500.0

#: By so many px at most such a plane changes what the matching nearby says: else it is another
#: surface. Where things move, and far away.
_MAX_CHANGE_PX, _MAX_FAR_CHANGE_PX = 6.0, 3.0

#: An area is at rest if this share of the textured pixels around has not moved for so many frames,
#: and there are enough of them.
_RESTING, _REST_FRAMES, _REST_WINDOW, _REST_PIXELS = 0.5, 2, (161, 65), 20

_NEARBY, _AFAR, _FAR, _BESIDE = (
    loops.Window(*values, _DEPENDENT**0.5)  # type: ignore[call-arg]  # mypy does not know its dataclasses
    for values in (
        (32, 16, 4, 4, 1, 8, 4, 6.0, 2.0, 3, 0.6, 0.6),
        (240, 60, 12, 6, 5, 16, 8, 255.0, 1.0, 4, 0.8, 1.0),
        (24, 12, 3, 3, 1, 8, 4, 12.0, 1.0, 3, 0.8, 1.0),
        (90, 16, 6, 4, 2, 8, 4, 64.0, 1.0, 5, 0.8, 0.9),
    )
)
_ALL = np.inf
_DECIDES, _WHERE_MOVING, _WHERE_FAR, _WHERE_UNSEEN = (
    loops.Rule(*values)  # type: ignore[call-arg]
    for values in (
        (True, _ALL, _ALL, _ALL, _ALL, False, False),
        (False, _ALL, _MAX_ERROR_PX, _MAX_CHANGE_PX, _ALL, True, False),
        (False, 4 * _FAR_PX, _MAX_FAR_ERROR_PX, _MAX_FAR_CHANGE_PX, _FAR_PX, False, False),
        (False, 0.0, _MAX_UNSEEN_ERROR_PX, _ALL, _ALL, False, True),
    )
)


class Surface(NamedTuple):
    """Properties of each pixel by grey and charge, (rows, width) each.

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
        """Return where grey is smooth and where it is textured."""
        blurred = cv2.GaussianBlur(grey, (0, 0), 1)
        slope = np.abs(cv2.Sobel(blurred, cv2.CV_32F, 1, 0, scale=1 / 8))
        steep = (slope >= _SMOOTH).view(np.uint8)
        smooth = cv2.dilate(steep, np.ones(_WINDOW[::-1], np.uint8)) == 0
        return cls(grey, smooth, slope > _TEXTURED, wanted, age_frames)


def with_planes(
    disparity_px: Reals, margin: Reals, trails_px: Reals, surface: Surface, max_disparity: int
) -> tuple[Reals, Reals]:
    """Return disparity with planes on smooth surfaces, and the inliers' share, (rows, width).

    Both are float32, NaN = unknown; the share is NaN where no plane decided.

    Args:
        disparity_px: of the matching, (rows, width) float32, NaN = unknown.
        margin: of the matching, by how much the second best disparity costs more, likewise.
        trails_px: of trails, likewise.
        surface: what is smooth, and what is wanted.
        max_disparity: px.
    """
    shape = disparity_px.shape
    smooth, textured, wanted = (
        checked_array(mask, np.bool_, shape).view(np.uint8)
        for mask in (surface.smooth, surface.textured, surface.wanted)
    )
    disparity_px = checked_array(disparity_px, np.float32)
    trails_px = checked_array(trails_px, np.float32, shape)
    grey = checked_array(surface.grey, np.float32, shape)
    age = checked_array(surface.age_frames, np.uint8, shape)
    need, moving, weight = smooth & wanted, np.empty(shape, np.uint8), np.empty(shape, np.uint8)
    source = np.empty_like(disparity_px)
    counts = around.Counts(shape[1], *(side // 2 for side in _AGREEMENT_WINDOW))
    around.believe(*(disparity_px, trails_px, smooth, _AGREE_PX, _AGREEING, counts, source, weight))
    # A trail's disparity between whole px may exceed the range a little.
    samples = reused(loops.Samples, *shape, max_disparity + 1)
    result, (share, error) = source.copy(), np.full((2, *shape), np.nan, np.float32)
    found = result, share, error
    loops.fit(source, weight, grey, need, _NEARBY, _DECIDES, samples, *found)
    counts = around.Counts(shape[1], *(side // 2 for side in _REST_WINDOW))
    rest = _REST_FRAMES, _RESTING, _REST_PIXELS
    around.find_moving(textured, age, need, *rest, counts, moving)
    weight = 2 * (1 - smooth)
    loops.fit(disparity_px, weight, grey, moving, _AFAR, _WHERE_MOVING, samples, *found)
    loops.fit(disparity_px, weight, grey, need, _FAR, _WHERE_FAR, samples, *found)
    # A partner beyond the left view's border is not visible: only a reliable plane gives it.
    around.forget_unseen(error, _MAX_SMOOTH_ERROR_PX, result, share)
    need = wanted * (1 - smooth)
    need[:, : max(shape[1] - 1 - max_disparity, 0) // _BESIDE.block_x * _BESIDE.block_x] = 0
    weight *= checked_array(margin, np.float32, shape) >= _SURE
    loops.fit(result, weight, grey, need, _BESIDE, _WHERE_UNSEEN, samples, *found)
    return result, share
