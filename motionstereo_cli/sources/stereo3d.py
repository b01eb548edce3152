"""What Matroska, MP4 or the codec say of how both views lie in an image."""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from motionstereo_cli.files.stills import Stated

if TYPE_CHECKING:
    import av

#: Kinds of FFmpeg's AVStereo3D, and the shape of a pixel from which on views are squeezed.
_STEREO3D = {1: "side-by-side", 2: "top-bottom"}
_SQUEEZED = 1.5


def stated_by(
    frame: av.VideoFrame, aspect: Fraction | None
) -> tuple[Stated | None, tuple[str, ...]]:
    """Return how an image says that it holds both views, and what to warn of.

    Squeezed views show in pixels twice as wide or high as others.

    Args:
        frame: a decoded image.
        aspect: width of a pixel as a share of its height; None = unknown.
    """
    said: Any = frame.side_data.get("STEREO3D")
    if said is None:
        return None, ()
    kind, flags = struct.unpack("=ii", bytes(said)[:8])
    if kind not in _STEREO3D:
        note = (
            "says that it holds two views in a way that is not read: convert it to views side by "
            "side",
        )
        return None, note if kind else ()
    aspect = aspect or Fraction(1)
    squeezed = aspect > _SQUEEZED if kind == 1 else aspect < 1 / _SQUEEZED
    return Stated(_STEREO3D[kind] + "-half" * squeezed, swapped=bool(flags & 1)), ()
