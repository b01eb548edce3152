"""Motion and permanency in one pass: the loop of :mod:`motionstereo_cli.method.memory`."""

import cython


def permanency(
    grey: cython.const[cython.uchar][::1],
    grey_before: cython.const[cython.uchar][::1],
    band: cython.const[cython.uchar][::1],
    band_before: cython.const[cython.uchar][::1],
    charge_before: cython.const[cython.uchar][::1],
    min_jump: cython.int,
    charge_max: cython.uchar,
    charge_min: cython.int,
    leak: cython.int,
    moved: cython.uchar[::1],
    charge: cython.uchar[::1],
) -> None:
    """Fill in where something moved, 0 or 1, and the charge: equations (3) and (2).

    Args:
        grey, grey_before, band, band_before: of this image and of the last, all pixels.
        charge_before: charge after the last.
        min_jump: least change in grey levels.
        charge_max, charge_min, leak: Chmax, Chmin and D.
        moved, charge: of all pixels, uint8.
    """
    with cython.nogil:
        move(grey, grey_before, band, band_before, min_jump, moved)
        recharge(moved, charge_before, charge_max, charge_min, leak, charge)


# Compilers vectorise a loop that writes bytes only if they know that arrays do not overlap.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def move(
    grey: cython.const[cython.uchar][::1],
    grey_before: cython.const[cython.uchar][::1],
    band: cython.const[cython.uchar][::1],
    band_before: cython.const[cython.uchar][::1],
    min_jump: cython.int,
    moved: cython.uchar[::1],
) -> cython.void:
    """Fill in where something moved, 0 or 1."""
    i: cython.Py_ssize_t
    for i in range(grey.shape[0]):
        one: cython.int = cython.cast(cython.int, grey[i])
        other: cython.int = cython.cast(cython.int, grey_before[i])
        moved[i] = (band[i] != band_before[i]) & (abs(one - other) >= min_jump)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def recharge(
    moved: cython.const[cython.uchar][::1],
    charge_before: cython.const[cython.uchar][::1],
    charge_max: cython.uchar,
    charge_min: cython.int,
    leak: cython.int,
    charge: cython.uchar[::1],
) -> cython.void:
    """Fill in the charge."""
    i: cython.Py_ssize_t
    for i in range(charge.shape[0]):
        rest: cython.int = cython.cast(cython.int, charge_before[i]) - leak
        rest = rest if rest > charge_min else charge_min
        charge[i] = charge_max if moved[i] else rest
