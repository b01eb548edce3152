"""The map of the surroundings: a point cloud, and the floor plane as ROS's map_server has it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.files.atomic import part_of, write_whole
from motionstereo_cli.files.encode import encode_png
from motionstereo_cli.files.lettering import DARK, LIGHT, colour_key, length_bar, titled
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

#: The sheet: length of its longer side, about, and its minimum width, in px.
_SHEET_PX, _MIN_SHEET_PX = 960, 420
_TITLE = "The map from above: x to the right, y upward"
_MEANINGS = {_OCCUPIED: "occupied", _FREE: "free", _UNKNOWN: "unknown"}
#: Colour of the path, RGB; its width is this part of the picture, and at least so many px.
_PATH, _PATH_PART, _PATH_PX = (20, 90, 200), 240, 2


def map_png(floor: Floor) -> NDArray[np.uint8]:
    """Return the floor plane as a picture: 0 occupied, 254 free, 205 unknown.

    Returns:
        (ny, nx) uint8: to the right the world's x grows, and upward its y.
    """
    cells = np.where(floor.occupied, _OCCUPIED, np.where(floor.free, _FREE, _UNKNOWN))
    return np.ascontiguousarray(cells.T[::-1].astype(np.uint8))


def from_above(
    floor: Floor, path_m: NDArray[np.float64], size_px: int
) -> tuple[NDArray[np.uint8], float]:
    """Return the floor plane, RGB, with the path from ring to dot, and its px per m.

    Args:
        floor: the floor plane.
        path_m: where the rig was, (n, 2), x and y in m.
        size_px: length of its longer side at most. A cell has a whole number of px, or a px a
            whole number of cells; it then shows what is occupied in any of them.
    """
    cell_m = floor.cell_m
    # The path may leave what is known; its ring and dot have room, too.
    places = (path_m - (floor.x_m, floor.y_m)) / cell_m
    known = np.vstack([places, np.zeros(2), np.subtract(floor.occupied.shape, 1)])
    room = 1 + 4 * np.ptp(known, axis=0).max() * max(1 / _PATH_PART, _PATH_PX / size_px)
    ends = np.vstack([places - room, places + room, known])
    low, high = (np.floor(each).astype(int) for each in (ends.min(0), ends.max(0)))
    longer = int(max(high - low)) + 1
    cells, times = -(-longer // size_px), max(size_px // longer, 1)
    shape = -(-(high - low + 1) // cells) * cells
    grown = [
        np.pad(each, [(-low[n], shape[n] + low[n] - each.shape[n]) for n in (0, 1)])
        for each in (floor.occupied, floor.free)
    ]
    nx, ny = shape // cells
    occupied, free = (each.reshape(nx, cells, ny, cells).max(axis=3).max(axis=1) for each in grown)
    picture = map_png(replace(floor, occupied=occupied, free=free))
    picture = np.stack([picture.repeat(times, 0).repeat(times, 1)] * 3, axis=-1)
    if len(path_m):
        scale = times / cells
        x, y = (places - low).T * scale
        line = np.stack([x, len(picture) - y], axis=1).round().astype(np.int32)
        thick = max(_PATH_PX, round(max(picture.shape) / _PATH_PART))
        cv2.polylines(picture, [line], False, _PATH, thick, cv2.LINE_AA)
        begin, end = line[0].tolist(), line[-1].tolist()
        cv2.circle(picture, begin, 2 * thick, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(picture, begin, 2 * thick, _PATH, thick, cv2.LINE_AA)
        cv2.circle(picture, end, 2 * thick, _PATH, -1, cv2.LINE_AA)
    return picture, times / cells / cell_m


def map_sheet(floor: Floor, path_m: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the floor plane and the path as a sheet, RGB, with a title, legend and scale."""
    picture, px_per_m = from_above(floor, path_m, _SHEET_PX)
    spare = max(_MIN_SHEET_PX - picture.shape[1], 0)
    sides = ((0, 0), (spare // 2, spare - spare // 2), (0, 0))
    picture = np.pad(picture, sides, constant_values=_UNKNOWN)
    entries = [((grey,) * 3, text) for grey, text in _MEANINGS.items()]
    entries += [(_PATH, "path of the rig, from ring to dot")] if len(path_m) else []
    width = picture.shape[1]
    return np.concatenate(
        [
            titled([picture], [_TITLE], LIGHT),
            colour_key(width, entries, LIGHT),
            length_bar(width, px_per_m, LIGHT),
        ]
    )


def map_panel(mapper: Mapper, size_px: int) -> NDArray[np.uint8]:
    """Return the map so far, RGB, in the middle of a square of this size, with a scale."""
    bar = 2 * DARK.size_px
    picture, px_per_m = from_above(mapper.floor(), mapper.path_m, size_px - bar)
    height, width = picture.shape[:2]
    panel = np.full((size_px, size_px, 3), _UNKNOWN, np.uint8)
    top, left = (size_px - bar - height) // 2, (size_px - width) // 2
    panel[top : top + height, left : left + width] = picture
    panel[-bar:] = length_bar(size_px, px_per_m, DARK)
    return panel


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
        self._path, self._top_m = path, stream.output.map_top_m
        self.mapper = Mapper(stream.settings, stream.rig, stream.output.map_cell_m)
        self.mapper.known = restored(since, Surroundings | None)
        self._closed = False

    def write(self, step: Step) -> None:
        """Add a frame to the map."""
        self.mapper.see(step)

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
        points_m, grey = self.mapper.points(self._top_m)
        floor = self.mapper.floor()
        picture, yaml = self._path.with_suffix(".png"), self._path.with_suffix(".yaml")
        yield self._path, encode_ply(points_m, grey, "m, in the world of the poses")
        yield picture, encode_png(map_png(floor))
        sheet = self._path.with_name(f"{self._path.stem}-sheet.png")
        yield sheet, encode_png(map_sheet(floor, self.mapper.path_m)[..., ::-1])
        yield yaml, map_yaml(floor, picture.name).encode()
