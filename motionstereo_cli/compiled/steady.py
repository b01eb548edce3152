"""The average of disparities in time: the loop of :mod:`motionstereo_cli.method.steady`."""

import cython


def add(
    disparity: cython.const[cython.float][:, ::1],
    grey: cython.const[cython.uchar][:, ::1],
    age: cython.const[cython.uchar][:, ::1],
    earlier: cython.const[cython.float][:, ::1],
    earlier_grey: cython.const[cython.uchar][:, ::1],
    frames: cython.int,
    max_grey: cython.int,
    tolerance_px: cython.float,
    total: cython.float[:, ::1],
    count: cython.float[:, ::1],
) -> None:
    """Add an earlier result where it says the same of the same thing, and count it.

    Args:
        disparity, grey, age: of now, (height, width).
        earlier, earlier_grey: of ``frames`` frames ago.
        frames: how long ago.
        max_grey: largest change of grey in levels.
        tolerance_px: largest change of disparity.
        total, count: of disparities so far.
    """
    y: cython.Py_ssize_t
    x: cython.Py_ssize_t
    with cython.nogil:
        for y in range(disparity.shape[0]):
            for x in range(disparity.shape[1]):
                change: cython.float = earlier[y, x] - disparity[y, x]
                if (
                    abs(change) <= tolerance_px
                    and age[y, x] >= frames
                    and abs(cython.cast(cython.int, grey[y, x]) - earlier_grey[y, x]) <= max_grey
                ):
                    total[y, x] += earlier[y, x]
                    count[y, x] += 1
