"""Point clouds as PLY."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.robot.mapper import camera_points
from motionstereo_cli.sinks.images import known_depth_m
from motionstereo_cli.sinks.writers import FilesMark, NumberedFiles
from motionstereo_cli.types import FrameImages

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext
    from motionstereo_cli.types import Grey

_PLY_TYPES = {np.dtype(np.float32): "float", np.dtype(np.float64): "double"}


def encode_ply(points_m: NDArray[np.floating[Any]], look: Grey, comment: str) -> bytes:
    """Return points as a binary little-endian PLY file: x, y, z and red, green, blue.

    Args:
        points_m: (n, 3) float32 or float64, which is the type in the file.
        look: their grey, (n,) uint8, or colour, (n, 3) uint8 RGB.
        comment: one line, ASCII.
    """
    kind = points_m.dtype
    places = [(name, kind.newbyteorder("<")) for name in ("x", "y", "z")]
    colours = [(name, np.uint8) for name in ("red", "green", "blue")]
    table = np.empty(len(points_m), [*places, *colours])
    for axis, (name, _) in enumerate(places):
        table[name] = points_m[:, axis]
    for channel, (name, _) in zip(np.broadcast_to(look.T, (3, len(look))), colours, strict=True):
        table[name] = channel
    head = [
        *("ply", "format binary_little_endian 1.0", f"comment {comment}"),
        f"element vertex {len(table)}",
        *(f"property {_PLY_TYPES[kind]} {name}" for name, _ in places),
        *(f"property uchar {name}" for name, _ in colours),
        "end_header\n",
    ]
    return "\n".join(head).encode("ascii") + table.tobytes()


class NumberedClouds(NumberedFiles):
    """PLY files, one per frame: all pixels with a depth, in the camera's frame.

    Args:
        path: see :class:`~motionstereo_cli.sinks.writers.NumberedFiles`.
        stream: the run's context; it has a rig.
        since: continue from this checkpoint.
    """

    def __init__(self, path: Path, stream: RunContext, since: FilesMark | None = None) -> None:
        super().__init__(path, since)
        self._stream = stream
        camera = stream.settings.reference
        self._comment = f"m, optical frame of the {camera} camera: x right, y down, z forward"

    def write(self, images: FrameImages) -> None:
        """Write the points of a frame."""
        assert self._stream.rig is not None
        depth_m, camera = known_depth_m(images), self._stream.settings.reference
        everywhere = np.ones(depth_m.shape, np.bool_)
        points_m, grey = camera_points(depth_m, images.look, everywhere, camera, self._stream.rig)
        self.add(images.time.index, encode_ply(points_m.astype(np.float32), grey, self._comment))
