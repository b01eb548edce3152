"""Match keys: pixels of both views correspond only if their keys are equal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.compiled import match_keys as loops


def match_keys(
    charge: NDArray[np.uint8],
    charge_min: int = 0,
    bands: NDArray[np.uint8 | np.uint16] | None = None,
) -> NDArray[np.uint16]:
    """Return the match key of each pixel, (height, width) uint16; 0 = at rest, never matches.

    Pixels of equal key may correspond. The key is the charge, as in the paper, or with ``bands``
    the charge and the grey-level band: on finely textured objects everything is fully charged, so
    the charge alone is ambiguous.

    Args:
        charge: charge of each pixel, (height, width) uint8.
        charge_min: the charge at rest.
        bands: bands 1..256, (height, width), or None.
    """
    charge = checked_array(charge, np.uint8)
    key = np.empty(charge.shape, np.uint16)
    if bands is None:
        loops.by_charge(charge, charge_min, key)
    else:
        kind = np.uint16 if bands.dtype == np.uint16 else np.uint8  # of 256 bands, of fewer
        band = checked_array(bands, kind, charge.shape)
        loops.by_charge_and_band(charge, charge_min, (band - 1).astype(np.uint8), key)
    return key
