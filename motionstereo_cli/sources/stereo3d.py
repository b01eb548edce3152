"""What Matroska, MP4 or the codec state about the views in an image."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from fractions import Fraction
from typing import Any, NamedTuple

import av
from av.sidedata.sidedata import Type

from motionstereo_cli.files.stills import Stated
from motionstereo_cli.sources.sphere import Sphere

#: Kinds of FFmpeg's AVFrameSideDataType.
_STEREO3D, _SPHERICAL, _VIEW_ID = 2, 13, 29

#: Kinds of FFmpeg's AVStereo3D that are read, and the pixel aspect ratio from which views are
#: squeezed.
_LAYOUTS = {1: "side-by-side", 2: "top-bottom"}
_SQUEEZED = 1.5

#: Kinds that are not read: what they are, and their names in FFmpeg's filter stereo3d, left view
#: first and right view first; empty if it does not read them.
_UNREAD = {
    3: ("one after the other, frame by frame", ("al", "ar")),
    4: ("as a checkerboard", ("", "")),
    5: ("side by side as a checkerboard (quincunx)", ("", "")),
    6: ("in alternate rows", ("irl", "irr")),
    7: ("in alternate columns", ("icl", "icr")),
}

#: How Matroska's stereo modes begin that FFmpeg has no kind for: views in different colours.
_ANAGLYPH = "anaglyph"

#: The kind of files with two views in an unspecified layout.
_SOMEHOW = 8

#: Views of FFmpeg's AVStereo3D.
_EYES = {1: "left", 2: "right"}

#: Kinds of FFmpeg's AVSphericalMapping whose rows and columns are angles, and how many degrees
#: they span across.
_EQUIRECTANGULAR = {0: 360, 2: 360, 3: 180}
_CUBE = 1


def _unnamed(kinds: Any, value: int) -> Type:
    """Return an enum member for a kind of side data that PyAV has no name for.

    Without it, PyAV raises for an image with such data, and none of its side data can be read.
    """
    kind = object.__new__(kinds)
    kind._name_, kind._value_ = f"KIND_{value}", value
    found: Type = kind
    return found


Type._missing_ = classmethod(_unnamed)  # type: ignore[method-assign, assignment]


class ViewMetadata(NamedTuple):
    """What an image states about its views.

    Attributes:
        stated: the layout of both views, None if it has one view.
        unread: a layout that is not read, and what to do; empty if none.
        sphere: the angles of its rows and columns; None if it is flat.
        eye: ``left`` or ``right`` if it is a view of one eye, else empty.
        baseline_m: distance between the cameras; 0 = unknown.
        width_deg: angle that the image spans; 0 = unknown.
    """

    stated: Stated | None = None
    unread: str = ""
    sphere: Sphere | None = None
    eye: str = ""
    baseline_m: float = 0.0
    width_deg: float = 0.0


def view_metadata(frame: av.VideoFrame, aspect: Fraction | None) -> ViewMetadata:
    """Return what an image states about its views.

    Squeezed views have pixels that are twice as wide or high as others.

    Args:
        frame: a decoded image.
        aspect: width of a pixel as a share of its height; None = unknown.
    """
    found = _side_data(frame)
    metadata = ViewMetadata(sphere=_sphere(found[_SPHERICAL]) if _SPHERICAL in found else None)
    if _STEREO3D not in found:
        return metadata
    kind, flags, view, _, baseline_um, _, _, degrees, divisor = struct.unpack(
        "=iiiiIiiii", found[_STEREO3D][:36].ljust(36, b"\0")
    )
    metadata = metadata._replace(
        eye=_EYES.get(view, ""),
        baseline_m=baseline_um / 1e6,
        width_deg=degrees / divisor if divisor > 0 else 0.0,
    )
    swapped = bool(flags & 1)
    if kind in _UNREAD and not metadata.eye:  # a view of one eye is a stream of its own
        how, filters = _UNREAD[kind]
        convert = f"ffmpeg -i IN -vf stereo3d={filters[swapped]}:sbsl OUT makes"
        advice = f"{convert if filters[swapped] else 'convert them to'} views side by side"
        return metadata._replace(unread=f"both views lie {how}, which is not read: {advice}")
    if kind not in _LAYOUTS:
        if kind == _SOMEHOW and not metadata.eye:
            metadata = metadata._replace(
                unread="it holds both views, and only one is in it: another program may have lost "
                "the other one: give the original file"
            )
        return metadata
    aspect = aspect or Fraction(1)
    squeezed = aspect > _SQUEEZED if kind == 1 else aspect < 1 / _SQUEEZED
    return metadata._replace(stated=Stated(_LAYOUTS[kind] + "-half" * squeezed, swapped=swapped))


def anaglyph(metadata: Mapping[str, str]) -> str:
    """Return why a video is not read whose container says that it is an anaglyph; else nothing."""
    if not metadata.get("stereo_mode", "").startswith(_ANAGLYPH):
        return ""
    return (
        "both views lie in the colours of one image (anaglyph), which is not read: give a "
        "recording that has each view whole"
    )


def view_id(frame: av.VideoFrame) -> int | None:
    """Return the view of a multiview stream (MV-HEVC) that an image is, None in other streams."""
    found = _side_data(frame).get(_VIEW_ID)
    return None if found is None else int.from_bytes(found[:4], "little", signed=True)


def _side_data(frame: av.VideoFrame) -> dict[int, bytes]:
    found: Any = frame.side_data  # the type stub has it as a mapping
    return {each.type.value: bytes(each) for each in found}


def _sphere(data: bytes) -> Sphere | None:
    """Return the angles of FFmpeg's AVSphericalMapping; None if the image is flat."""
    kind, _, _, _, left, top, right, bottom, _ = struct.unpack("=iiiiIIIII", data[:36])
    if kind == _CUBE:
        return Sphere("a cube", 0, 0, 0, 0)
    if kind not in _EQUIRECTANGULAR:
        return None
    across = _EQUIRECTANGULAR[kind]
    edges = [each / 2**32 for each in (left, right, top, bottom)]
    return Sphere(
        "equirectangular",
        across * (edges[0] - 0.5),
        across * (0.5 - edges[1]),
        180 * (edges[2] - 0.5),
        180 * (0.5 - edges[3]),
    )
