"""The map of the surroundings: a point cloud, and the floor plane as ROS's map_server has it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.files.atomic import part_of, write_whole
from motionstereo_cli.files.encode import encode_png
from motionstereo_cli.files.lettering import LIGHT, colour_key, length_bar, titled
from motionstereo_cli.files.records import restored
from motionstereo_cli.robot.mapper import Floor, Mapper, Surroundings
from motionstereo_cli.sinks.points import encode_ply
from motionstereo_cli.types import Step

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.sink import RunContext

_FREE = 254
_OCCUPIED = 0
_UNKNOWN = 205

#: The sheet: approximate length of its longer side, and its minimum width, in px.
_SHEET_PX, _MIN_SHEET_PX = 640, 420
_TITLE = "The map from above: x to the right, y upward"
_MEANINGS = {_OCCUPIED: "occupied", _FREE: "free", _UNKNOWN: "unknown"}


def map_png(floor: Floor) -> NDArray[np.uint8]:
    """Return the floor plane as a picture: 0 occupied, 254 free, 205 unknown.

    Returns:
        (ny, nx) uint8: to the right the world's x grows, and upward its y.
    """
    cells = np.where(floor.occupied, _OCCUPIED, np.where(floor.free, _FREE, _UNKNOWN))
    return np.ascontiguousarray(cells.T[::-1].astype(np.uint8))


def map_sheet(floor: Floor) -> NDArray[np.uint8]:
    """Return the floor plane as a sheet, RGB: enlarged, with a title, legend and scale."""
    picture = map_png(floor)
    times = max(1, _SHEET_PX // max(picture.shape))
    picture = picture.repeat(times, 0).repeat(times, 1)
    spare = max(_MIN_SHEET_PX - picture.shape[1], 0)
    sides = ((0, 0), (spare // 2, spare - spare // 2))
    picture = np.pad(picture, sides, constant_values=_UNKNOWN)
    entries = [((grey,) * 3, text) for grey, text in _MEANINGS.items()]
    width = picture.shape[1]
    return np.concatenate(
        [
            titled([np.stack([picture] * 3, axis=-1)], [_TITLE], LIGHT),
            colour_key(width, entries, LIGHT),
            length_bar(width, times / floor.cell_m, LIGHT),
        ]
    )


def map_yaml(floor: Floor, image: str) -> str:
    """Return the metadata of the picture ``image`` for map_server.

    The free threshold is that of ROS 1: with Nav2's 0.25, unknown cells (205, a chance of 0.196)
    would be read as free.
    """
    return (
        f"image: {image}\n"
        "mode: trinary\n"
        f"resolution: {floor.cell_m!r}\n"
        f"origin: [{floor.x_m:.6f}, {floor.y_m:.6f}, 0]\n"
        "negate: 0\n"
        "occupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )


class MapFiles:
    """The map, written at the end: .ply and, with the same name, .png, .yaml and -sheet.png.

    Args:
        path: name of the point cloud.
        stream: the run's context; it has a rig, and its steps have poses and points.
        since: continue from this checkpoint: the map so far.

    Attributes:
        mapper: makes the map.
    """

    def __init__(self, path: Path, stream: RunContext, since: Surroundings | None = None) -> None:
        assert stream.rig is not None
        self._path = path
        self.mapper = Mapper(stream.settings, stream.rig, stream.output.map_cell_m)
        self.mapper.known = restored(since, Surroundings | None)
        self._closed = False

    def write(self, step: Step) -> None:
        """Add a frame to the map."""
        assert step.points is not None
        assert step.pose is not None
        self.mapper.add(*step.points, step.pose)

    def checkpoint(self) -> Surroundings | None:
        """Return the map so far."""
        return self.mapper.known

    def close(self) -> None:
        """Write the map."""
        for path, content in self._files():
            write_whole(path, content)
        self._closed = True

    def abandon(self, *, keep: bool) -> None:
        """Write the map so far under ``.part`` names or, without ``keep``, nothing."""
        if keep and not self._closed:
            for path, content in self._files():
                write_whole(part_of(path), content)

    def _files(self) -> Iterator[tuple[Path, bytes]]:
        points_m, grey = self.mapper.points()
        floor = self.mapper.floor()
        picture, yaml = self._path.with_suffix(".png"), self._path.with_suffix(".yaml")
        yield self._path, encode_ply(points_m, grey, "m, in the world of the poses")
        yield picture, encode_png(map_png(floor))
        sheet = self._path.with_name(f"{self._path.stem}-sheet.png")
        yield sheet, encode_png(map_sheet(floor)[..., ::-1])
        yield yaml, map_yaml(floor, picture.name).encode()
