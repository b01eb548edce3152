"""What moved by itself: the loop of :mod:`motionstereo_cli.robot.movers`."""

import cython
from cython.cimports.libc.math import fabs

#: Pixels that are nearer are beside the camera.
MIN_DEPTH = cython.declare(cython.double, 0.05)
HALF = cython.declare(cython.double, 0.5)


@cython.cclass
@cython.dataclasses.dataclass
class Camera:
    """A camera of a rig.

    Attributes:
        focal_x, focal_y, cx, cy: in px.
        other_cx: that of the other camera in px.
        side: 1 where the other camera is at the left, -1 where it is at the right.
        focal_baseline: depth in m times nearness in px.
        doffs: nearness less disparity in px.
    """

    focal_x: cython.double
    focal_y: cython.double
    cx: cython.double
    cy: cython.double
    other_cx: cython.double
    side: cython.int
    focal_baseline: cython.double
    doffs: cython.double


@cython.cclass
@cython.dataclasses.dataclass(eq=False)
class View:
    """One camera's view.

    Attributes:
        grey: of now.
        low, high: least and largest grey around each pixel of the earlier one.
    """

    grey: cython.const[cython.uchar][:, ::1]
    low: cython.const[cython.uchar][:, ::1]
    high: cython.const[cython.uchar][:, ::1]


def unexplained(
    view: View,
    other: View,
    disparity: cython.const[cython.float][:, ::1],
    disparity_then: cython.const[cython.float][:, ::1],
    camera: Camera,
    motion: cython.const[cython.double][:, ::1],
    max_way: cython.double,
    min_jump: cython.int,
    hidden_px: cython.double,
    hidden_share: cython.double,
    result: cython.uchar[:, ::1],
) -> None:
    """Fill in by how much grey differs from all that was around the same place in an earlier view.

    Args:
        view, other: of the camera, and of the other one, which has to differ as well.
        disparity, disparity_then: px, NaN = unknown.
        camera: the camera.
        motion: (4, 4) takes places in the camera of now to those in the earlier one.
        max_way: what stands there came at most so far across the image, px.
        min_jump: less is no difference.
        hidden_px, hidden_share: what was nearer by more than the larger of these hid the place.
        result: receives it: 0 = explained, hidden then, out of view then, or unknown.
    """
    x: cython.int
    y: cython.int
    height: cython.int = cython.cast(cython.int, view.grey.shape[0])
    width: cython.int = cython.cast(cython.int, view.grey.shape[1])
    with cython.nogil:
        for y in range(height):
            down: cython.double = (y - camera.cy) / camera.focal_y
            for x in range(width):
                result[y, x] = 0
                near: cython.double = disparity[y, x] + camera.doffs
                if not near > 0:  # nor where it is NaN
                    continue
                inverse: cython.double = near / camera.focal_baseline
                across: cython.double = (x - camera.cx) / camera.focal_x
                z: cython.double = (
                    motion[2, 0] * across
                    + motion[2, 1] * down
                    + motion[2, 2]
                    + motion[2, 3] * inverse
                )
                if z < MIN_DEPTH:
                    continue
                u: cython.double = camera.cx + camera.focal_x / z * (
                    motion[0, 0] * across
                    + motion[0, 1] * down
                    + motion[0, 2]
                    + motion[0, 3] * inverse
                )
                v: cython.double = camera.cy + camera.focal_y / z * (
                    motion[1, 0] * across
                    + motion[1, 1] * down
                    + motion[1, 2]
                    + motion[1, 3] * inverse
                )
                if not (u >= 1 and v >= 1 and u < width - 2 and v < height - 2):
                    continue
                if fabs(u - x) > max_way or fabs(v - y) > max_way:
                    continue
                column: cython.int = cython.cast(cython.int, u + HALF)
                row: cython.int = cython.cast(cython.int, v + HALF)
                here: cython.int = view.grey[y, x]
                off: cython.int = max(view.low[row, column] - here, here - view.high[row, column])
                if off <= min_jump:
                    continue
                # What the other camera sees there now, and would have seen then.
                place: cython.double = x + camera.side * disparity[y, x] + HALF
                u += camera.other_cx - camera.cx + camera.side * near / z
                if not (place >= 0 and place < width and u >= 1 and u < width - 2):
                    continue
                here = other.grey[y, cython.cast(cython.int, place)]
                column_then: cython.int = cython.cast(cython.int, u + HALF)
                off = min(
                    off,
                    max(other.low[row, column_then] - here, here - other.high[row, column_then]),
                )
                if off <= min_jump:
                    continue
                then: cython.double = near / z
                if disparity_then[row, column] + camera.doffs > then + max(
                    hidden_px, hidden_share * then
                ):
                    continue
                result[y, x] = cython.cast(cython.uchar, off)
