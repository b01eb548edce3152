"""The average of disparities in time: the loops of :mod:`motionstereo_cli.method.steady`."""

import cython

#: Disparity in parts of a px, of 16 bits: unknown, the largest, and parts of a px.
UNKNOWN = cython.declare(cython.ushort, 0)
MOST = cython.declare(cython.float, 65280)


def fill_parts(
    disparity: cython.const[cython.float][::1],
    per_px: cython.float,
    result: cython.ushort[::1],
) -> None:
    """Round disparities to parts of a px; 0 = unknown, and a known 0 becomes 1."""
    x: cython.Py_ssize_t
    with cython.nogil:
        for x in range(disparity.shape[0]):
            parts: cython.float = disparity[x] * per_px + cython.cast(cython.float, 0.5)
            parts = parts if parts > 1 else 1
            parts = parts if parts < MOST else MOST
            known: cython.bint = disparity[x] == disparity[x]
            result[x] = cython.cast(cython.ushort, cython.cast(cython.int, parts)) if known else 0


def add(
    disparity: cython.const[cython.ushort][::1],
    grey: cython.const[cython.uchar][::1],
    age: cython.const[cython.uchar][::1],
    earlier: cython.const[cython.ushort][::1],
    earlier_grey: cython.const[cython.uchar][::1],
    frames: cython.uchar,
    max_grey: cython.short,
    tolerance: cython.short,
    total: cython.short[::1],
    count: cython.uchar[::1],
) -> None:
    """Add the change since an earlier result where it agrees on the same surface, and count it.

    Args:
        disparity, grey, age: of now, of all pixels; disparity in parts of a px, 0 = unknown.
        earlier, earlier_grey: of ``frames`` frames ago.
        frames: how long ago.
        max_grey: largest change of grey in levels.
        tolerance: largest change of disparity in parts.
        total, count: of changes so far.
    """
    with cython.nogil:
        add_all(
            disparity,
            grey,
            age,
            earlier,
            earlier_grey,
            frames,
            max_grey,
            tolerance,
            total,
            count,
        )


# Compilers vectorise loops over arrays that are arguments of a separate function.


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def add_all(
    disparity: cython.const[cython.ushort][::1],
    grey: cython.const[cython.uchar][::1],
    age: cython.const[cython.uchar][::1],
    earlier: cython.const[cython.ushort][::1],
    earlier_grey: cython.const[cython.uchar][::1],
    frames: cython.uchar,
    max_grey: cython.short,
    tolerance: cython.short,
    total: cython.short[::1],
    count: cython.uchar[::1],
) -> cython.void:
    """Do what :func:`add` does."""
    x: cython.Py_ssize_t
    # Differences from -n to n are those that are at most 2 n when n is added, without a sign.
    steps: cython.uchar = cython.cast(cython.uchar, 2 * max_grey)
    changes: cython.ushort = cython.cast(cython.ushort, 2 * tolerance)
    for x in range(total.shape[0]):
        now: cython.int = cython.cast(cython.int, grey[x])
        before: cython.int = cython.cast(cython.int, earlier_grey[x])
        step: cython.uchar = cython.cast(cython.uchar, (now - before + max_grey) & 255)
        now = cython.cast(cython.int, disparity[x])
        before = cython.cast(cython.int, earlier[x])
        change: cython.ushort = cython.cast(cython.ushort, (before - now + tolerance) & 65535)
        rests: cython.uchar = (step <= steps) & (age[x] >= frames)
        counts: cython.ushort = (change <= changes) & (earlier[x] != UNKNOWN) & rests
        total[x] += cython.cast(cython.short, (change - tolerance) * counts)
        count[x] += cython.cast(cython.uchar, counts)


def divide(
    disparity: cython.const[cython.float][::1],
    parts: cython.const[cython.ushort][::1],
    per_px: cython.float,
    total: cython.const[cython.short][::1],
    count: cython.const[cython.uchar][::1],
    result: cython.float[::1],
) -> None:
    """Fill in means: of a disparity, and of those that are its parts and changes from them.

    Args:
        disparity: of now in px, NaN = unknown.
        parts: the same in parts of a px.
        per_px: parts of a px.
        total, count: of changes.
        result: gets the means in px.
    """
    x: cython.Py_ssize_t
    with cython.nogil:
        for x in range(result.shape[0]):
            n: cython.int = cython.cast(cython.int, count[x])
            earlier: cython.float = cython.cast(
                cython.float, cython.cast(cython.int, parts[x]) * n + total[x]
            )
            earlier /= per_px
            result[x] = (disparity[x] + earlier) / (n + 1)
