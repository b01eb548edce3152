"""What moves by itself: change that the rig's own motion does not explain.

A pixel of the view of now is a place in space by its disparity, and by the rig's own motion that
place was somewhere in an earlier view. If it stands, its grey was there, or beside it; this is
asked of both cameras. What was hidden then is not asked for. Against the last frame anything
counts; against those before, which tell what is slow or far, only what came a short way across the
image. What counts has been seen moving in the frames before, nearby, and is of some size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import movers as loops

Grey = NDArray[np.uint8]
Real = NDArray[np.float32]
Reals = NDArray[np.float64]

#: Frames that a view is compared with the views before, and how far standing things may have come
#: across the image since, as a share of its width.
GAPS = 3
_WAYS = (1.0, 1 / 80, 1 / 80)
#: Smoothing before, standard deviation in px, and how far around a place its grey is looked for.
_BLUR_PX, _AROUND_PX = 1.0, 1
#: A smaller difference of grey is none.
_MIN_JUMP = 8
#: What was nearer then by more than the larger of these hid a place.
_HIDDEN_PX, _HIDDEN_SHARE = 1.5, 0.25

#: It has been seen moving in so many frames before, at most so far away.
_SEEN_BEFORE, _WITHIN_PX = 2, 12
#: Pixels so near are one thing; it has at least so many, and so much area as seen from the camera.
_TOGETHER_PX, _MIN_PIXELS, _MIN_AREA_M2 = 4, 20, 0.12

#: What it finds in a frame depends on so many frames before.
RUN_IN_FRAMES = GAPS + _SEEN_BEFORE

_OPEN = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class Eye:
    """The camera whose view it is.

    Attributes:
        focal_px: focal lengths along x and y.
        cx_px, cy_px: principal point.
        other_cx_px: that of the other camera.
        side: 1 where the other camera is at the left, -1 where it is at the right.
        focal_baseline: depth in m times nearness in px.
        doffs_px: nearness less disparity.
    """

    focal_px: tuple[float, float]
    cx_px: float
    cy_px: float
    other_cx_px: float
    side: int
    focal_baseline: float
    doffs_px: float


@dataclass(frozen=True, slots=True)
class Moment:
    """A frame that later ones are compared with.

    Attributes:
        view, other: grey of the camera and of the other one, smoothed.
        disparity_px: of the camera's view, NaN = unknown.
        before_from_now: (4, 4) takes places in the camera then to those in the one a frame before.
    """

    view: Grey
    other: Grey
    disparity_px: Real
    before_from_now: Reals


@dataclass(frozen=True, slots=True)
class Movers:
    """What is kept from frame to frame.

    Attributes:
        moments: the last frames, :data:`GAPS` at most, the last one last.
        found: where something moved by itself in the last frames, before it was seen again.
    """

    moments: tuple[Moment, ...] = ()
    found: tuple[Grey, ...] = ()


def smoothed(grey: Grey) -> Grey:
    """Return a view as it is compared."""
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), np.uint8)


def see(movers: Movers, now: Moment, eye: Eye) -> tuple[Movers, NDArray[np.bool_]]:
    """Return what is known after a frame, and where something moved by itself, (height, width).

    Args:
        movers: what was known before.
        now: the frame.
        eye: the camera.
    """
    found = np.zeros(now.view.shape, np.uint8)
    motion = np.eye(4)
    motions = [now.before_from_now, *(m.before_from_now for m in movers.moments[:0:-1])]
    for way, step, then in zip(_WAYS, motions, movers.moments[::-1], strict=False):
        motion = step @ motion
        found |= _changed(now, then, eye, motion, way * now.view.shape[1])
    found = np.asarray(cv2.morphologyEx(found, cv2.MORPH_OPEN, _OPEN))
    lasting = found
    for before in movers.found:
        lasting = lasting & _grown(before, _WITHIN_PX)
    if len(movers.found) < _SEEN_BEFORE:
        lasting = np.zeros_like(found)
    kept = _large(lasting, now.disparity_px, eye)
    after = Movers((*movers.moments, now)[-GAPS:], (*movers.found, found)[-_SEEN_BEFORE:])
    return after, kept


def _changed(now: Moment, then: Moment, eye: Eye, motion: Reals, way_px: float) -> Grey:
    """Return 1 where a view differs from an earlier one, 0 elsewhere."""
    result = np.empty(now.view.shape, np.uint8)
    around = np.ones((2 * _AROUND_PX + 1,) * 2, np.uint8)
    views: list[Any] = [
        loops.View(grey, cv2.erode(old, around), cv2.dilate(old, around))  # type: ignore[call-arg]
        for grey, old in ((now.view, then.view), (now.other, then.other))
    ]
    camera: Any = loops.Camera(  # type: ignore[call-arg]
        *(*eye.focal_px, eye.cx_px, eye.cy_px, eye.other_cx_px, eye.side),
        *(eye.focal_baseline, eye.doffs_px),
    )
    loops.unexplained(
        *(views[0], views[1], now.disparity_px, then.disparity_px, camera),
        *(np.ascontiguousarray(motion), way_px, _MIN_JUMP, _HIDDEN_PX, _HIDDEN_SHARE, result),
    )
    return np.minimum(result, np.uint8(1))


def _grown(mask: Grey, by_px: int) -> Grey:
    return np.asarray(cv2.dilate(mask, np.ones((2 * by_px + 1,) * 2, np.uint8)))


def _large(mask: Grey, disparity_px: Real, eye: Eye) -> NDArray[np.bool_]:
    """Return what is left of a mask without patches of few pixels or little area."""
    if not mask.any():
        return mask.astype(np.bool_)
    count, labels = cv2.connectedComponents(_grown(mask, _TOGETHER_PX))
    inside = np.nonzero(mask)
    label = labels[inside]
    metres = eye.focal_baseline / (disparity_px[inside] + eye.doffs_px).astype(np.float64)
    area_m2 = np.bincount(label, metres**2, count) / (eye.focal_px[0] * eye.focal_px[1])
    large = (area_m2 >= _MIN_AREA_M2) & (np.bincount(label, minlength=count) >= _MIN_PIXELS)
    kept = np.zeros(mask.shape, np.bool_)
    kept[inside] = large[label]
    return kept
