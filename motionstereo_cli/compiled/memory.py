"""Motion and the permanency memory in one pass: the loop of :mod:`motionstereo_cli.memory`."""

import cython


def permanency(
    grey: cython.const[cython.uchar][:, ::1],
    grey_before: cython.const[cython.uchar][:, ::1],
    band: cython.const[cython.uchar][:, ::1],
    band_before: cython.const[cython.uchar][:, ::1],
    charge_before: cython.const[cython.uchar][:, ::1],
    min_jump: cython.int,
    charge_max: cython.uchar,
    charge_min: cython.int,
    leak: cython.int,
    moved: cython.uchar[:, ::1],
    charge: cython.uchar[:, ::1],
) -> None:
    """Fill in where something moved, 0 or 1, and the charge: equations (3) and (2).

    Args:
        grey, grey_before, band, band_before: of this image and of the last, (height, width).
        charge_before: charge after the last.
        min_jump: least change in grey levels.
        charge_max, charge_min, leak: Chmax, Chmin and D.
        moved, charge: (height, width) uint8.
    """
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(grey.shape[0]):
            for x in range(grey.shape[1]):
                one: cython.int = cython.cast(cython.int, grey[y, x])
                other: cython.int = cython.cast(cython.int, grey_before[y, x])
                far: cython.bint = abs(one - other) >= min_jump
                moves: cython.bint = (band[y, x] != band_before[y, x]) & far
                rest: cython.int = cython.cast(cython.int, charge_before[y, x]) - leak
                rest = rest if rest > charge_min else charge_min
                moved[y, x] = moves
                charge[y, x] = charge_max if moves else rest
