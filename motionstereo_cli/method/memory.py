"""The memory of one camera, and its update by the next image: equations (2) to (4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.compiled import checked_array
from motionstereo_cli.compiled import memory as loops
from motionstereo_cli.errors import InputError
from motionstereo_cli.method.bands import bands, blur
from motionstereo_cli.method.charge import accumulate, age, permanency
from motionstereo_cli.method.contrast import contrast
from motionstereo_cli.method.match_keys import match_keys
from motionstereo_cli.method.motion import motion
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.method.steady import in_parts

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey, MatchKeys, Real, Rig, StereoFrame

_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Memory:
    """The memory of one camera after an image.

    Attributes:
        grey: the image, (height, width) uint8.
        contrast: input of the bands: the image or its local contrast, blurred.
        bands: its grey-level bands 1..n, (height, width) uint8, or uint16 for 256 bands.
        moved: where the band has just changed, (height, width) bool.
        charge: charge of each pixel, (height, width) uint8.
    """

    # Annotations of what checkpoints keep have to exist at run time.
    grey: NDArray[np.uint8]
    contrast: NDArray[np.uint8]
    bands: NDArray[np.uint8 | np.uint16]
    moved: NDArray[np.bool_]
    charge: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Sighting:
    """What later frames need of a frame.

    Attributes:
        parts: disparity of this frame alone, (height, width), as :func:`in_parts` gives it.
        grey: mean of 3 x 3 pixels of the reference view, (height, width) uint8.
    """

    parts: NDArray[np.uint16]
    grey: NDArray[np.uint8]

    @classmethod
    def of(cls, disparity_px: Real, view: Grey) -> Sighting:
        """Return the sighting of a disparity and its view."""
        return cls(in_parts(disparity_px), np.asarray(cv2.blur(view, (3, 3)), np.uint8))


def checked_views(frame: StereoFrame, before: Memory | None, rig: Rig | None) -> tuple[Grey, Grey]:
    """Return the right and the left view of a frame, contiguous in memory.

    Args:
        frame: the frame.
        before: the right memory before it, of the same size; None at the first frame.
        rig: its camera; None if unknown.

    Raises:
        InputError: they are not grey images of one size, that of the memory and of the rig.
    """
    size = None if rig is None else (rig.height, rig.width)
    if before is not None:
        size = before.grey.shape
    try:
        right = checked_array(frame.right, np.uint8, size)
        return right, checked_array(frame.left, np.uint8, right.shape)
    except InputError as error:
        raise InputError(f"frame {frame.index}: {error}") from None


def see(memory: Memory | None, image: Grey, settings: Settings) -> Memory:
    """Return the memory after the next image; at the first, nothing has moved and all is at rest.

    In permanency mode, everything is forgotten ceil((Chmax - Chmin) / D) frames later.

    Args:
        memory: the memory before; None at the first image.
        image: (height, width) uint8.
        settings: parameters of bands, motion and charge.
    """
    s = settings
    local = blur(contrast(image, s.contrast_px, s.contrast_floor), s.blur_px)
    banded = bands(local, s.bands, s.grey_min, s.grey_max)
    if memory is None:
        at_rest = np.full_like(image, s.charge_min)
        return Memory(image, local, banded, np.zeros(image.shape, np.bool_), at_rest)
    if s.charge_mode == "permanency" and banded.dtype == np.uint8:
        return Memory(image, local, banded, *_moved_and_charge(memory, local, banded, s))
    moved = motion(banded, memory.bands, local, memory.contrast, s.min_jump)
    limits = {"charge_max": s.charge_max, "charge_min": s.charge_min}
    if s.charge_mode == "permanency":
        charge = permanency(memory.charge, moved, leak=s.charge_leak, **limits)
    else:
        gains = {"gain": s.charge_gain, "leak": s.charge_leak}
        charge = accumulate(memory.charge, moved, **gains, **limits)
    return Memory(image, local, banded, moved, charge)


def glance(memory: Memory | None, image: Grey, settings: Settings) -> Memory:
    """Return the memory of a view of which only the image is looked at: all is at rest.

    Args:
        memory, image, settings: as of :func:`see`, which takes five times as long.
    """
    s = settings
    local = blur(contrast(image, s.contrast_px, s.contrast_floor), s.blur_px)
    if memory is not None:
        return replace(memory, grey=image, contrast=local)
    nothing = np.full_like(image, s.charge_min)
    return Memory(image, local, np.ones_like(image), np.zeros(image.shape, np.bool_), nothing)


def _moved_and_charge(
    memory: Memory, local: Grey, banded: NDArray[np.uint8 | np.uint16], settings: Settings
) -> tuple[NDArray[np.bool_], Grey]:
    """Return :func:`motion` and :func:`permanency` in one pass."""
    s = settings
    moved, charge = np.empty(local.shape, np.bool_), np.empty(local.shape, np.uint8)
    before = (memory.contrast, memory.bands, memory.charge)
    grey_before, band_before, charge_before, grey, band = (
        np.ravel(each) for each in (*before, local, banded)
    )
    loops.permanency(
        *(grey, grey_before, band, band_before, charge_before),
        *(s.min_jump, s.charge_max, s.charge_min, s.charge_leak),
        *(moved.view(np.uint8).ravel(), charge.ravel()),
    )
    return moved, charge


def charged(charge: Grey | None, moved: NDArray[np.bool_], settings: Settings) -> NDArray[np.uint8]:
    """Return a permanency memory one frame later, equation (2).

    Args:
        charge: that of the frame before, (height, width) uint8; None at the first frame.
        moved: where something moved, (height, width) bool.
        settings: parameters of the charge.
    """
    s = settings
    if charge is None:
        charge = np.full(moved.shape, s.charge_min, np.uint8)
    limits = {"charge_max": s.charge_max, "charge_min": s.charge_min}
    return permanency(charge, moved, leak=s.charge_leak, **limits)


def age_of(memory: Memory, settings: Settings) -> Grey:
    """Return the frames since something moved, (height, width) uint8, 255 = forgotten.

    0 in the general mode, which does not know.
    """
    s = settings
    if s.charge_mode == "general":
        return np.where(memory.charge > s.charge_min, np.uint8(0), np.uint8(255))
    limits = {"charge_max": s.charge_max, "charge_min": s.charge_min}
    return age(memory.charge, leak=s.charge_leak, **limits)


def keys_of(memory: Memory, settings: Settings) -> MatchKeys:
    """Return the match keys, (height, width) uint16; 0 = at rest."""
    by_band = settings.match_on == "charge-band"
    return match_keys(memory.charge, settings.charge_min, memory.bands if by_band else None)


def blurred(memory: Memory, settings: Settings) -> Grey:
    """Return the image, blurred, (height, width) uint8."""
    if settings.contrast_px == 0:
        return memory.contrast
    return blur(memory.grey, settings.blur_px)


def in_mirror(memory: Memory) -> Memory:
    """Return the memory mirrored left to right."""
    return Memory(
        mirrored(memory.grey),
        mirrored(memory.contrast),
        mirrored(memory.bands),
        mirrored(memory.moved),
        mirrored(memory.charge),
    )


def mirrored(image: NDArray[_T]) -> NDArray[_T]:
    """Return an image with left and right exchanged, (height, width)."""
    return np.ascontiguousarray(image[:, ::-1])
