"""What a run falls short of, and why: measured on its images, not guessed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey

#: A run that matches less of what is charged than this says so.
MIN_MATCHED_SHARE = 0.4

#: Charge on less of the image than this says nothing about the matching.
_MIN_CHARGED_SHARE = 0.01

#: Rows by which the views may be off one another, in px of images of at most this width.
_ROWS = (-8, -4, -2, 2, 4, 8)
_WIDTH = 640
#: Smaller images are enlarged to this shorter side in px; how they are reduced and enlarged.
_MIN_SIDE = 64
_SMOOTH = cv2.INTER_AREA, cv2.INTER_CUBIC

#: cv2.StereoBM counts what is certain; a cause has to give this many times more of it, and this
#: share of the image.
_BLOCK_PX, _UNIQUENESS, _TEXTURE = 15, 15, 20
_TIMES_MORE, _MIN_SURE_SHARE = 1.5, 0.03

#: Share of the matches at the limit of the range that is worth a word.
MIN_AT_LIMIT_SHARE = 0.02

#: Share of the frames without a heading that is worth a word, and the share of the image with a
#: disparity from which on this is not for want of matches.
_MAX_BLIND_SHARE, _SEEN_SHARE = 0.5, 0.05

#: Difference of brightness in grey levels that is worth a word.
_MIN_BRIGHTNESS = 5.0


def falls_short(charged: float, matched: float) -> bool:
    """Return whether few of the pixels with charge were matched, by mean shares, 0..1."""
    return charged >= _MIN_CHARGED_SHARE and matched < MIN_MATCHED_SHARE * charged


def shortfall(
    charged: float, matched: float, right: Grey, left: Grey, max_disparity: int, advised: int = 0
) -> str:
    """Return why few of the pixels with charge were matched, as a sentence.

    Other explanations are tried on one pair of images: swapped views, rows that are off, a larger
    range. The one under which most pixels find a certain partner is the reason, if these are many
    more than as the run is; else it may be the brightness.

    Args:
        charged, matched: mean shares of the image with charge and with a disparity, 0..1.
        right, left: a pair of images of the run, (height, width) uint8.
        max_disparity: as the run has it, px.
        advised: a larger one that a check has advised, px, which is then the reason; 0: none.
    """
    said = f"only {matched / charged:.0%} of what moved lately was matched"
    if advised:
        near = f"objects are nearer than --max-disparity {max_disparity} reaches"
        return f"{said}: {near}: try {advised}"
    height, width = right.shape
    # Blocks are of a fixed size: of a small image they would take most.
    scale = min(_WIDTH / width, max(1.0, _MIN_SIDE / min(height, width)))
    if scale != 1:
        right, left = (
            np.asarray(
                cv2.resize(view, None, fx=scale, fy=scale, interpolation=_SMOOTH[scale > 1]),
                np.uint8,
            )
            for view in (right, left)
        )
    reach = max(round(max_disparity * scale), 1)
    plain = max(_sure(right, left, reach), _MIN_SURE_SHARE)
    causes = {
        "left and right seem to be swapped: try --swap": _sure(left, right, reach),
        f"objects seem to be nearer than --max-disparity {max_disparity} reaches: "
        f"try {2 * max_disparity}": _sure(right, left, 2 * reach),
    }
    for rows in _ROWS:
        moved = np.roll(left, rows, axis=0)
        causes[
            f"the left image seems to be {abs(rows) / scale:.0f} px too "
            f"{'high' if rows > 0 else 'low'}: calibrate, or see `motionstereo check`"
        ] = _sure(right, moved, reach)
    cause = max(causes, key=lambda each: causes[each])
    if causes[cause] > _TIMES_MORE * plain:
        return f"{said}: {cause}"
    brighter = float(np.median(left)) - float(np.median(right))
    if abs(brighter) >= _MIN_BRIGHTNESS:
        which = "brighter" if brighter > 0 else "darker"
        return f"{said}; the left view is {abs(brighter):.0f} grey levels {which}"
    return f"{said}; rows, range, order and brightness of the views look right"


def unmoved(charged: float) -> str | None:
    """Return a warning if next to nothing moved, else None.

    Args:
        charged: mean share of the image with charge, 0..1.
    """
    if charged >= _MIN_CHARGED_SHARE:
        return None
    return (
        f"next to nothing moved ({charged:.1%} of the image): this method sees what moves, or what "
        "a moving camera passes; --depth-of all gives what stands still a depth, too"
    )


def without_heading(blind: float, matched: float) -> str | None:
    """Return why most frames have no heading, None if most have one.

    Args:
        blind: share of the frames without a heading, 0..1.
        matched: mean share of the image with a disparity, 0..1.
    """
    if blind <= _MAX_BLIND_SHARE:
        return None
    why = (
        "one level surface fills the view, as a floor does from above, or a wall, so that there is "
        "nowhere to steer to; depth and objects are found all the same"
        if matched > _SEEN_SHARE
        else "too little was matched to see a way"
    )
    return f"no heading is given in {blind:.0%} of the frames (status blind): {why}"


def lost_poses(frames: int, lost: int, first_lost: tuple[int, int] | None) -> str | None:
    """Return a warning if the rig's own motion is unknown in some frames, else None.

    Args:
        frames: how many frames there were.
        lost: in how many of them it is unknown.
        first_lost: first and last frame of the first stretch of these.
    """
    if first_lost is None:
        return None
    first, last = first_lost
    where = f"{first}" if first == last else f"{first} to {last}"
    return (
        f"own motion is unknown in {lost} of {frames} frames (first in {where}): there the path "
        "takes the likeliest motion or goes straight on, and from then on it is off by what was "
        "not seen; odometry.csv (--save odometry) tells which they are"
    )


def beyond_range(matched: float, at_limit: float, max_disparity: int) -> str | None:
    """Return a warning if much of the scene may be nearer than the range reaches, else None.

    Args:
        matched, at_limit: mean shares of the image with a disparity and at the limit, 0..1.
        max_disparity: as the run has it, px.
    """
    share = at_limit / max(matched + at_limit, 1e-9)
    if share < MIN_AT_LIMIT_SHARE:
        return None
    wider = 16 * math.ceil(1.5 * max_disparity / 16)
    return (
        f"{share:.0%} of the matches lie at the limit of the range and are left unknown, for they "
        f"may be nearer: try --max-disparity {wider}"
    )


def _sure(right: Grey, left: Grey, max_disparity: int) -> float:
    """Return the share of an image, 0..1, that finds a certain partner within the range."""
    disparities = -(-max_disparity // 16) * 16
    if min(right.shape) <= _BLOCK_PX or right.shape[1] <= disparities:
        return 0.0
    matcher = cv2.StereoBM.create(disparities, _BLOCK_PX)
    matcher.setUniquenessRatio(_UNIQUENESS)
    matcher.setTextureThreshold(_TEXTURE)
    matcher.setDisp12MaxDiff(1)
    matcher.setSpeckleWindowSize(50)
    matcher.setSpeckleRange(1)
    sixteenths = matcher.compute(left, right)
    return float(np.mean((sixteenths > 0) & (sixteenths <= 16 * max_disparity)))
