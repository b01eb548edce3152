"""Charge of each pixel, equations (1) and (2) of the paper."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_LEVELS = np.arange(256)


def permanency(
    charge: NDArray[np.uint8],
    moved: NDArray[np.bool_],
    *,
    charge_max: int = 255,
    charge_min: int = 0,
    leak: int = 16,
) -> NDArray[np.uint8]:
    """Return the permanency memory one frame later, (height, width) uint8.

    Equation (2): Ch = Chmax where Mov = 1, else max(Ch - D, Chmin). Everything is forgotten
    ceil((Chmax - Chmin) / D) frames after the last motion.

    Args:
        charge: permanency memory of the frame before, (height, width) uint8, Chmin..Chmax.
        moved: where something moved, (height, width) bool.
        charge_max, charge_min, leak: Chmax, Chmin and D, 0..255.
    """
    recharged = moved.view(np.uint8) * np.uint8(charge_max)
    memory: NDArray[np.uint8] = np.maximum(recharged, _leaked(charge, charge_min, leak))
    return memory


def age(
    charge: NDArray[np.uint8], *, charge_max: int = 255, charge_min: int = 0, leak: int = 16
) -> NDArray[np.uint8]:
    """Return the frames since something moved, (height, width) uint8; 255 = forgotten.

    The inverse of the permanency memory: (Chmax - Ch) / D.

    Args:
        charge: permanency memory, (height, width) uint8.
        charge_max, charge_min, leak: Chmax, Chmin and D of the memory.
    """
    frames = np.clip((charge_max - _LEVELS) // leak, 0, 254)
    table = np.where(charge_min < _LEVELS, frames, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(charge, table), np.uint8)


def accumulate(
    charge: NDArray[np.uint8],
    moved: NDArray[np.bool_],
    *,
    charge_max: int = 255,
    charge_min: int = 0,
    gain: int = 64,
    leak: int = 16,
) -> NDArray[np.uint8]:
    """Return the charge of the general model one frame later, (height, width) uint8.

    Equation (1): Ch = min(Ch + C, Chmax) where the property (motion) holds, else
    max(Ch - D, Chmin). Unlike the permanency memory it may never forget.

    Args:
        charge: charge of the frame before, (height, width) uint8, Chmin..Chmax.
        moved: where something moved, (height, width) bool.
        charge_max, charge_min, gain, leak: Chmax, Chmin, C and D, 0..255.
    """
    gained = np.minimum(_LEVELS + gain, charge_max).astype(np.uint8)
    risen = np.asarray(cv2.LUT(charge, gained), np.uint8)
    return np.where(moved, risen, _leaked(charge, charge_min, leak))


def _leaked(charge: NDArray[np.uint8], charge_min: int, leak: int) -> NDArray[np.uint8]:
    table = np.maximum(_LEVELS - leak, charge_min).astype(np.uint8)
    return np.asarray(cv2.LUT(charge, table), np.uint8)
