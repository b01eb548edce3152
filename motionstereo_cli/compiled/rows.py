"""From half the rows to all of them: the loops of :mod:`motionstereo_cli.method.rows`."""

import cython


def whole(
    disparity: cython.const[cython.float][:, ::1],
    half_grey: cython.const[cython.float][:, ::1],
    grey: cython.const[cython.uchar][:, ::1],
    tolerance_px: cython.float,
    nearer: cython.float,
    result: cython.float[:, ::1],
) -> None:
    """Fill in the disparity of each row from the two half rows nearest to it.

    Args:
        disparity: px, (rows, width), NaN = unknown.
        half_grey: grey of the same rows.
        grey: of all rows, (height, width).
        tolerance_px: half rows that differ by less are mixed.
        nearer: where they differ by more, a pixel takes the other half row's disparity if that is
            nearer to it in grey by so many levels.
        result: (height, width).
    """
    y: cython.int
    x: cython.int
    rows: cython.int = cython.cast(cython.int, disparity.shape[0])
    with cython.nogil:
        for y in range(cython.cast(cython.int, result.shape[0])):
            own: cython.int = y // 2
            other: cython.int = min(max(own + (1 if y % 2 else -1), 0), rows - 1)
            for x in range(cython.cast(cython.int, result.shape[1])):
                here: cython.float = disparity[own, x]
                there: cython.float = disparity[other, x]
                level: cython.float = grey[y, x]
                if abs(here - there) < tolerance_px:
                    here = 0.75 * here + 0.25 * there
                elif abs(level - half_grey[other, x]) + nearer < abs(level - half_grey[own, x]):
                    here = there
                result[y, x] = here
