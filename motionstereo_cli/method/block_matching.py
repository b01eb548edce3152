"""OpenCV's matchers, for comparison: block matching and semi-global block matching."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Grey = NDArray[np.uint8]
    Real = NDArray[np.float32]

_STEPS_PER_PX = 16  # of cv2's fixed-point disparities

#: Sides of the windows: the best of 9, 15, 21, 31 and of 3, 5, 7, 11 by the share of pixels with a
#: right disparity on rendered scenes.
_BM_BLOCK_PX = 21
_SGBM_BLOCK_PX = 11

#: Sides of the windows of the consensus, and by how many px its two results may differ.
_CONSENSUS_BLOCKS_PX, _CONSENSUS_PX = (5, _SGBM_BLOCK_PX), 1.0


def stereo_bm(right: Grey, left: Grey, max_disparity: int, *, filtered: bool = False) -> Real:
    """Return cv2.StereoBM's disparity of the right view.

    Args:
        right, left: (height, width) uint8.
        max_disparity: disparities 0 to this, rounded up to a multiple of 16, less 1.
        filtered: with left-right check (1 px) and speckle filter (100 px).

    Returns:
        (height, width) float32 px, NaN = unknown.
    """
    return _right_view(bm_matcher(max_disparity), right, left, filtered=filtered)


def stereo_sgbm(right: Grey, left: Grey, max_disparity: int, *, filtered: bool = False) -> Real:
    """Return cv2.StereoSGBM's disparity of the right view: five paths, P1 and P2 as cv2 advises.

    Arguments and result as for :func:`stereo_bm`.
    """
    return _right_view(sgbm_matcher(max_disparity), right, left, filtered=filtered)


def consensus(right: Grey, left: Grey, max_disparity: int, *, filtered: bool = False) -> Real:
    """Return what cv2.StereoSGBM finds with a small and with a large window alike.

    With paths from all eight sides, so that it does not share the bias of fewer paths on slanted
    ground. Arguments and result as for :func:`stereo_bm`.
    """
    small, large = (
        _right_view(sgbm_matcher(max_disparity, block, paths=8), right, left, filtered=filtered)
        for block in _CONSENSUS_BLOCKS_PX
    )
    return np.where(np.abs(small - large) <= _CONSENSUS_PX, (small + large) / 2, np.float32(np.nan))


def bm_matcher(max_disparity: int) -> cv2.StereoMatcher:
    """Return the cv2.StereoBM of :func:`stereo_bm`."""
    return cv2.StereoBM.create(_range(max_disparity), _BM_BLOCK_PX)


def sgbm_matcher(
    max_disparity: int, block_px: int = _SGBM_BLOCK_PX, paths: int = 5
) -> cv2.StereoMatcher:
    """Return the cv2.StereoSGBM of :func:`stereo_sgbm`, or one with eight paths."""
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=_range(max_disparity),
        blockSize=block_px,
        P1=8 * block_px**2,
        P2=32 * block_px**2,
        disp12MaxDiff=-1,
        uniquenessRatio=10,
        preFilterCap=63,
        mode=cv2.StereoSGBM_MODE_HH if paths == 8 else cv2.StereoSGBM_MODE_SGBM,
    )


def _range(max_disparity: int) -> int:
    return -(-max_disparity // 16) * 16


def _right_view(matcher: cv2.StereoMatcher, right: Grey, left: Grey, *, filtered: bool) -> Real:
    if min(right.shape) <= _BM_BLOCK_PX:  # cv2 takes no image smaller than its window
        return np.full(right.shape, np.nan, np.float32)
    if filtered:
        matcher.setDisp12MaxDiff(1)
        matcher.setSpeckleWindowSize(100)
        matcher.setSpeckleRange(2)
    # Mirrored, the right view is the left one of a rig. cv2 gives no result in as many columns
    # as there are disparities, where a partner might lie outside the image. An added strip takes
    # their place: on rendered scenes this adds 0.10 of coverage at no more error.
    strip = matcher.getNumDisparities()
    views = [
        cv2.copyMakeBorder(cv2.flip(view, 1), 0, 0, strip, 0, cv2.BORDER_REPLICATE)
        for view in (right, left)
    ]
    steps = cv2.flip(np.ascontiguousarray(matcher.compute(*views)[:, strip:]), 1)
    disparity = steps.astype(np.float32) / np.float32(_STEPS_PER_PX)
    disparity[steps < 0] = np.nan
    return disparity
