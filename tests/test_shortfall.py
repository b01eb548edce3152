"""Why little is matched, on views spoilt in a known way."""

import cv2
import numpy as np
import pytest

from motionstereo_cli.check.shortfall import falls_short, shortfall


def views(disparity):
    white = np.random.default_rng(5).standard_normal((160, 400)).astype(np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), 1.5)
    wall = (120 + 35 * smooth / smooth.std()).clip(0, 255).astype(np.uint8)
    return wall[:, 80:], wall[:, 80 - disparity : 400 - disparity]


def reason(right, left, reach=32):
    return shortfall(0.5, 0.05, right, left, reach)


def test_enough_is_no_reason_to_speak():
    assert [falls_short(0.5, matched) for matched in (0.3, 0.05)] == [False, True]
    assert not falls_short(0.001, 0.0)


def test_swapped_views_are_told():
    right, left = views(12)
    assert "only 10%" in reason(left, right)
    assert "swapped" in reason(left, right)


def test_a_range_that_is_too_short_is_told():
    assert "nearer than --max-disparity 32 reaches: try 64" in reason(*views(50))


@pytest.mark.parametrize("shape", [(13, 17), (24, 32)])
def test_a_range_that_is_too_short_is_told_of_tiny_images(shape):
    height, width = shape
    cropped = (view[:height, :width] for view in views(3))
    assert "nearer than --max-disparity 2 reaches: try 4" in reason(*cropped, reach=2)


@pytest.mark.parametrize(("rows", "where"), [(-4, "4 px too high"), (8, "8 px too low")])
def test_rows_that_are_off_are_told(rows, where):
    right, left = views(12)
    assert where in reason(right, np.roll(left, rows, axis=0))


def test_brightness_is_told_where_nothing_else_is_wrong():
    right, left = views(12)
    assert "the left view is 20 grey levels brighter" in reason(right, left + np.uint8(20))
    assert "look right" in reason(right, left)
