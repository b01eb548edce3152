"""Rendering of a floor plan, and its distance from a robot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, SceneCamera, View
from motionstereo_cli.simulate.corridor import (
    CEILING,
    FLOOR,
    TEXEL_M,
    WALL,
    Opening,
    paint_door,
    paint_window,
)
from motionstereo_cli.simulate.floor_plan import Prism
from motionstereo_cli.simulate.surfaces import Quadrangle, render
from motionstereo_cli.simulate.texture import Texture

#: Texels of a paint along a wall and up it.
_LONG, _HIGH = 512, 256
#: Size of a card, and of the paint of the cards, in texels.
_CARD = (8, 12)
_DARK = 70.0
#: How far beyond all that stands floor and ceiling go on.
_MARGIN_M = 50.0


class PlanScene:
    """Prisms on a level floor under a level ceiling, lit by a lamp at the rig's middle.

    Args:
        prisms: what stands.
        ceiling_m: height of the ceiling.
        seed: seed of the paint and the lamp.
    """

    def __init__(self, prisms: Sequence[Prism], ceiling_m: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 5])
        self._lamp_m = rng.uniform(7, 14)
        paints = _paints(rng)
        corners = np.concatenate([prism.corners_m for prism in prisms])
        self._surfaces = [
            *_level(corners.min(0) - _MARGIN_M, corners.max(0) + _MARGIN_M, 0.0, FLOOR),
            *_level(corners.min(0) - _MARGIN_M, corners.max(0) + _MARGIN_M, ceiling_m, CEILING),
        ]
        for number, prism in enumerate(prisms):
            self._surfaces += _sides(prism, paints[prism.paint], number)

    def render(self, pose: FloorPose, camera: SceneCamera) -> View:
        """Return what a camera sees."""
        grey, depth_m, _ = render(self._surfaces, pose, camera)
        u, v = np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)
        slant = 1 + camera.leftward(u) ** 2 + camera.upward(v)[:, None] ** 2
        with np.errstate(invalid="ignore"):
            light = 1 / (1 + slant * (depth_m.astype(np.float64) / self._lamp_m) ** 2)
        return View((grey * light).astype(np.float32), depth_m)


class Outlines:
    """How far prisms are from a place on the floor.

    Args:
        prisms: what stands.
    """

    def __init__(self, prisms: Sequence[Prism]) -> None:
        self.names = [prism.name for prism in prisms]
        corners = [prism.corners_m for prism in prisms]
        self._start = np.concatenate(corners)
        self._side = np.concatenate([np.roll(each, -1, axis=0) - each for each in corners])
        self._first = np.cumsum([0, *map(len, corners[:-1])])

    def nearest(self, x_m: float, y_m: float) -> tuple[float, str]:
        """Return the distance to the nearest prism, 0 or less inside of it, and its name."""
        off = np.array([x_m, y_m]) - self._start
        side, start = self._side, (off * self._side).sum(axis=1)
        along = (start / (side**2).sum(axis=1)).clip(0, 1)
        away = np.hypot(*(off - along[:, None] * side).T)
        # Left of all sides is inside.
        left = side[:, 0] * off[:, 1] - side[:, 1] * off[:, 0] >= 0
        inside = np.logical_and.reduceat(left, self._first)
        distance = np.where(inside, -1, 1) * np.minimum.reduceat(away, self._first)
        which = int(distance.argmin())
        return float(distance[which]), self.names[which]


def _paints(rng: np.random.Generator) -> dict[str, Texture]:
    """Return the paints by their name; along a wall to the right, and up it downward."""
    plain = np.full((_LONG, _HIGH), WALL)
    doors = plain.copy()
    start_m = rng.uniform(0.2, 0.6)
    for number in range(10):
        stop_m = start_m + (rng.uniform(0.9, 1.1) if number % 2 else rng.uniform(0.9, 1.6))
        if stop_m > _LONG * TEXEL_M - 0.2:
            break
        kind, paint = ("door", paint_door) if number % 2 else ("window", paint_window)
        paint(doors, Opening(0, kind, start_m, stop_m), rng)
        start_m = stop_m + rng.uniform(0.4, 1.0)
    cards = rng.uniform(60, 210, (_LONG // _CARD[0], _HIGH // _CARD[1] + 1))
    cards = cards.repeat(_CARD[0], 0).repeat(_CARD[1], 1)[:, :_HIGH]
    greys = {"plain": plain, "doors": doors, "cards": cards, "dark": np.full((1, 1), _DARK)}
    return {name: Texture.of(grey.T) for name, grey in greys.items()}


def _level(
    low_m: NDArray[np.float64], high_m: NDArray[np.float64], up_m: float, grey: float
) -> Iterator[Quadrangle]:
    (x0, y0), (x1, y1) = low_m, high_m
    corners = np.array([[x0, y0, up_m], [x1, y0, up_m], [x1, y1, up_m], [x0, y1, up_m]])
    yield _plain(corners, grey)


def _plain(corners_m: NDArray[np.float64], grey: float) -> Quadrangle:
    right, down = corners_m[1] - corners_m[0], corners_m[3] - corners_m[0]
    down = down - right * (down @ right) / (right @ right)
    return Quadrangle(corners_m, corners_m[0], right, down, Texture.of(np.full((1, 1), grey)))


def _sides(prism: Prism, paint: Texture, number: int) -> Iterator[Quadrangle]:
    """Yield the sides of a prism, and its top and bottom."""
    corners, up = prism.corners_m, np.array([0.0, 0.0, 1.0])
    around_m = 0.7 * number  # so that no two prisms look alike
    for start, stop in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length_m = math.hypot(*(stop - start))
        ends = np.array([[*start, prism.bottom_m], [*stop, prism.bottom_m]])
        above = ends + (prism.top_m - prism.bottom_m) * up
        ahead = (ends[1] - ends[0]) / length_m
        floor = np.array([*start, 0.0]) - around_m * ahead
        yield Quadrangle(
            np.array([ends[0], ends[1], above[1], above[0]]),
            *(floor, ahead * TEXEL_M, up * TEXEL_M, paint),
        )
        around_m += length_m
    seen = (prism.top_m < EYE_HEIGHT_M, prism.bottom_m > EYE_HEIGHT_M)
    for level_m in np.array([prism.top_m, prism.bottom_m])[list(seen)]:
        flat = np.column_stack([corners, np.full(len(corners), level_m)])
        for first in range(1, len(flat) - 2, 2):
            yield _plain(flat[[0, first, first + 1, first + 2]], float(paint.levels[-2, -2]))
