"""The match key of each pixel: the loops of :mod:`motionstereo_cli.method.match_keys`."""

import cython


def by_charge(
    charge: cython.const[cython.uchar][:, ::1], charge_min: cython.int, key: cython.ushort[:, ::1]
) -> None:
    """Fill in match keys by charge, (height, width) uint16, 0 = at rest."""
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(charge.shape[0]):
            for x in range(charge.shape[1]):
                level: cython.int = cython.cast(cython.int, charge[y, x])
                key[y, x] = level * 256 if level > charge_min else 0


def by_charge_and_band(
    charge: cython.const[cython.uchar][:, ::1],
    charge_min: cython.int,
    band: cython.const[cython.uchar][:, ::1],
    key: cython.ushort[:, ::1],
) -> None:
    """Fill in match keys by charge and grey-level band; bands count from 0 here."""
    x: cython.Py_ssize_t
    y: cython.Py_ssize_t
    with cython.nogil:
        for y in range(charge.shape[0]):
            for x in range(charge.shape[1]):
                level: cython.int = cython.cast(cython.int, charge[y, x])
                own: cython.int = cython.cast(cython.int, band[y, x])
                key[y, x] = level * 256 + own if level > charge_min else 0
