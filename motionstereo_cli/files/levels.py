"""Grey levels of video whose luma is of limited range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.compiled import pictures as loops

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey


def full_range(luma: Grey, width: int) -> Grey:
    """Return grey levels 0..255, 255 / 219 (luma - 16), rounded and limited.

    Args:
        luma: rows of at least that width, uint8; 16..235 is black to white.
        width: of the result in px.
    """
    grey = np.empty((len(luma), width), np.uint8)
    loops.full_range(luma, grey)
    return grey
