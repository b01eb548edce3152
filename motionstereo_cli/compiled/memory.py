"""Bands, motion and permanency: loops of :mod:`motionstereo_cli.method`.

All numbers are bytes, so that compilers make vectors of 16 or 32 of them.
"""

import cython


def bands(
    grey: cython.const[cython.uchar][::1],
    low: cython.uchar,
    high: cython.uchar,
    factor: cython.ushort,
    band: cython.uchar[::1],
) -> None:
    """Fill in the band of each pixel, 1 + floor((grey - low) * factor / 65536), equation (4).

    Args:
        grey: all pixels.
        low, high: GLmin and GLmax; what is beyond counts as they do.
        factor: n / (GLmax - GLmin + 1), in units of 1 / 65536, rounded up.
        band: of all pixels.
    """
    with cython.nogil:
        fill_bands(grey, low, high, factor, band)


# Compilers vectorise a loop that writes bytes only if they know that arrays do not overlap.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def fill_bands(
    grey: cython.const[cython.uchar][::1],
    low: cython.uchar,
    high: cython.uchar,
    factor: cython.ushort,
    band: cython.uchar[::1],
) -> cython.void:
    """Fill in the bands."""
    i: cython.Py_ssize_t
    for i in range(grey.shape[0]):
        level: cython.uchar = grey[i]
        level = level if level > low else low
        level = level if level < high else high
        above: cython.ushort = level - low
        band[i] = (cython.cast(cython.uint, above) * factor >> 16) + 1


def permanency(
    grey: cython.const[cython.uchar][::1],
    grey_before: cython.const[cython.uchar][::1],
    band: cython.const[cython.uchar][::1],
    band_before: cython.const[cython.uchar][::1],
    charge_before: cython.const[cython.uchar][::1],
    min_jump: cython.uchar,
    charge_max: cython.uchar,
    charge_min: cython.uchar,
    leak: cython.uchar,
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


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def move(
    grey: cython.const[cython.uchar][::1],
    grey_before: cython.const[cython.uchar][::1],
    band: cython.const[cython.uchar][::1],
    band_before: cython.const[cython.uchar][::1],
    min_jump: cython.uchar,
    moved: cython.uchar[::1],
) -> cython.void:
    """Fill in where something moved, 0 or 1."""
    i: cython.Py_ssize_t
    for i in range(grey.shape[0]):
        now: cython.uchar = grey[i]
        before: cython.uchar = grey_before[i]
        larger: cython.uchar = now if now > before else before
        smaller: cython.uchar = before if now > before else now
        jump: cython.uchar = larger - smaller
        moved[i] = (band[i] != band_before[i]) & (jump >= min_jump)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def recharge(
    moved: cython.const[cython.uchar][::1],
    charge_before: cython.const[cython.uchar][::1],
    charge_max: cython.uchar,
    charge_min: cython.uchar,
    leak: cython.uchar,
    charge: cython.uchar[::1],
) -> cython.void:
    """Fill in the charge."""
    i: cython.Py_ssize_t
    lost: cython.uchar = min(leak, 255 - charge_min)  # more leaves no more than Chmin either
    least: cython.uchar = charge_min + lost
    for i in range(charge.shape[0]):
        rest: cython.uchar = charge_before[i]
        rest = (rest if rest > least else least) - lost
        charge[i] = charge_max if moved[i] else rest
