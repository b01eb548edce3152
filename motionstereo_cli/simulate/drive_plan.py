"""The plan of a drive: walls, the cells that the robot has seen, its path, and the walkers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.files.lettering import LIGHT, colour_key, length_bar, titled
from motionstereo_cli.simulate.drive_world import GOAL_M, RobotWorld
from motionstereo_cli.simulate.settings import ROBOT_RADIUS_M
from motionstereo_cli.simulate.walkers import RADIUS_M

if TYPE_CHECKING:
    from motionstereo_cli.robot.mapper import Floor

_PX_PER_M = 32
_MARGIN_M = 0.8

# RGB
_PAPER = (225, 225, 225)
_FLOOR = (255, 255, 255)
_WALL = (120, 120, 120)
_DOOR = (176, 112, 48)
_WINDOW = (64, 150, 230)
_SEEN = (0, 0, 0)
_PATH = (20, 90, 200)
_WALKER = (240, 150, 30)
_TOUCH = (220, 0, 0)
_WALKED = (250, 225, 180)
_GOAL = (30, 150, 60)
_HANGING = (205, 190, 235)


def plan_sheet(picture: NDArray[np.uint8], world: RobotWorld) -> NDArray[np.uint8]:
    """Return a plan of a world with title, legend and scale bar, RGB."""
    width = picture.shape[1]
    kinds = {kind for _, kind in world.outlines()} | {kind for kind, _ in world.openings()}
    meanings = (
        (_SEEN, "what the map holds as occupied", True),
        (_WALL, "wall or object", True),
        (_DOOR, "door", "door" in kinds),
        (_WINDOW, "window", "window" in kinds),
        (_HANGING, "hangs over the way", "hangs" in kinds),
        (_PATH, "path of the robot, and its heading", True),
        (_WALKER, "walker", world.walkers),
        (_WALKED, "where walkers were", world.walkers),
        (_GOAL, "goal", world.goal is not None),
        (_TOUCH, "touch", _touched(world)),
    )
    entries = [(colour, text) for colour, text, there in meanings if there]
    return np.concatenate(
        [
            titled([picture], ["The drive from above"], LIGHT),
            colour_key(width, entries, LIGHT),
            length_bar(width, _PX_PER_M, LIGHT),
        ]
    )


def _touched(world: RobotWorld) -> bool:
    return bool(world.ended and world.ended.startswith("touched"))


class Plan:
    """The picture, updated frame by frame.

    Args:
        world: the world; it is not changed.
    """

    def __init__(self, world: RobotWorld) -> None:
        self._world = world
        corners = np.concatenate([corners for corners, _ in world.outlines()])
        (self._left_m, low_m), (right_m, self._top_m) = (
            (float(x), float(y))
            for x, y in (corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M)
        )
        self._width = math.ceil((right_m - self._left_m) * _PX_PER_M)
        self._height = math.ceil((self._top_m - low_m) * _PX_PER_M)
        self._floor = self._empty()

    def add_walkers(self) -> None:
        """Add the present places of the walkers."""
        for walker in self._world.walkers:
            self._disc(self._floor, walker.x_m, walker.y_m, RADIUS_M, _WALKED)

    def draw(self, seen: Floor) -> NDArray[np.uint8]:
        """Return the present picture, (height, width, 3) uint8 RGB.

        Args:
            seen: the map so far, of which the occupied cells are shown.
        """
        picture = self._floor.copy()
        x_m = (np.arange(self._width) + 0.5) / _PX_PER_M + self._left_m
        y_m = self._top_m - (np.arange(self._height) + 0.5) / _PX_PER_M
        column = np.floor((x_m - seen.x_m) / seen.cell_m).astype(np.intp)
        row = np.floor((y_m - seen.y_m) / seen.cell_m).astype(np.intp)
        columns, rows = seen.occupied.shape
        x, y = (column >= 0) & (column < columns), (row >= 0) & (row < rows)
        picture[np.ix_(y, x)] = np.where(
            seen.occupied[np.ix_(column[x], row[y])].T[..., None], _SEEN, picture[np.ix_(y, x)]
        )
        world = self._world
        for kind, ends in world.openings():
            start, stop = (self._px(*end) for end in ends)
            cv2.line(picture, start, stop, _DOOR if kind == "door" else _WINDOW, 2, cv2.LINE_AA)
        if world.goal is not None:
            at, radius = self._px(*world.goal), round(GOAL_M * _PX_PER_M)
            cv2.circle(picture, at, radius, _GOAL, 2, cv2.LINE_AA)
        path = np.array([self._px(*place) for place in world.path], np.int32)
        cv2.polylines(picture, [path], False, _PATH, 2, cv2.LINE_AA)
        for walker in world.walkers:
            self._disc(picture, walker.x_m, walker.y_m, RADIUS_M, _WALKER)
        robot = world.robot
        self._disc(picture, robot.x_m, robot.y_m, ROBOT_RADIUS_M, _PATH)
        nose = robot.x_m + 0.5 * robot.forward[0], robot.y_m + 0.5 * robot.forward[1]
        cv2.line(picture, self._px(robot.x_m, robot.y_m), self._px(*nose), _PATH, 2, cv2.LINE_AA)
        if _touched(world):
            middle = self._px(robot.x_m, robot.y_m)
            cv2.drawMarker(picture, middle, _TOUCH, cv2.MARKER_TILTED_CROSS, 40, 4, cv2.LINE_AA)
        return picture

    def _empty(self) -> NDArray[np.uint8]:
        picture = np.full((self._height, self._width, 3), _PAPER, np.uint8)
        colours = {"free": _FLOOR, "stands": _PAPER, "hangs": _HANGING}
        for corners, kind in self._world.outlines():
            outline = [np.array([self._px(*corner) for corner in corners], np.int32)]
            cv2.fillPoly(picture, outline, colours[kind])
            cv2.polylines(picture, outline, True, _WALL)
        return picture

    def _disc(
        self,
        picture: NDArray[np.uint8],
        x_m: float,
        y_m: float,
        radius_m: float,
        colour: tuple[int, int, int],
    ) -> None:
        cv2.circle(
            picture, self._px(x_m, y_m), round(radius_m * _PX_PER_M), colour, -1, cv2.LINE_AA
        )

    def _px(self, x_m: float, y_m: float) -> tuple[int, int]:
        return (
            round((x_m - self._left_m) * _PX_PER_M),
            round((self._top_m - y_m) * _PX_PER_M),
        )
