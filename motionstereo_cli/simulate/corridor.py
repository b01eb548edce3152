"""The paper's scene: a square corridor that a robot drives round, turning left at each corner.

Walls, floor and ceiling are smooth. The outer walls, on the robot's right, have windows and doors,
the inner ones only doors. The only light is a lamp at the rig's middle, so remote parts are
darker, and both cameras see one grey for one point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, SceneCamera, View
from motionstereo_cli.simulate.settings import STRAIGHT_SHARE, TURN_SHARE

#: Frames to one side of the square: 100 straight, 25 turning.
FRAMES_PER_SIDE = 125

HEIGHT_M = 2.6

TEXEL_M = 0.02
_TEXELS_UP = round(HEIGHT_M / TEXEL_M)
#: Grey of walls, floor and ceiling.
WALL = 185.0
FLOOR = 115.0
CEILING = 215.0
#: Distance at which the lamp's light has fallen to a half.
LAMP_M = 11.0

# Walls 0..3 are the outer ones, 4..7 the inner ones, each in the order in which the robot passes
# them; a wall's own coordinate runs the way the robot drives.
_OUTWARD = np.tile([[0, -1], [1, 0], [0, 1], [-1, 0]], (2, 1)).astype(float)
_ALONG = np.tile([[1, 0], [0, 1], [-1, 0], [0, -1]], (2, 1)).astype(float)


@dataclass(frozen=True, slots=True)
class Opening:
    """A door or window.

    Attributes:
        wall: 0..3 for the outer walls, 4..7 for the inner ones, in driving order.
        kind: ``door`` or ``window``.
        start_m, stop_m: its extent along the wall, from the corner behind.
    """

    wall: int
    kind: str
    start_m: float
    stop_m: float


class Corridor:
    """The corridor and its paint. The middle of the square is the origin.

    Args:
        width_m: distance from inner to outer wall.
        length_m: the robot's path along one side, turn included.
        seed: seed of doors and windows.
        lamp_m: distance at which the lamp's light has fallen to a half.

    Attributes:
        outer_m, inner_m: half the side of the outer and of the inner square: free space is where
            inner_m < max(abs(x), abs(y)) < outer_m.
        openings: all doors and windows.
    """

    def __init__(
        self,
        width_m: float = 3.0,
        length_m: float = 20.0,
        seed: int = 0,
        lamp_m: float = LAMP_M,
    ) -> None:
        self.width_m = width_m
        self.length_m = length_m
        self.lamp_m = lamp_m
        self._half_straight_m = length_m * STRAIGHT_SHARE / 2
        self._radius_m = length_m * TURN_SHARE / (math.pi / 2)
        self.outer_m = self._half_straight_m + self._radius_m + width_m / 2
        self.inner_m = self.outer_m - width_m
        self._half_m = np.repeat([self.outer_m, self.inner_m], 4)
        self._corners_m = self._half_m[:, None] * (_OUTWARD + _ALONG)
        rng = np.random.default_rng([seed, 0])
        self.openings = [opening for wall in range(8) for opening in self._place(wall, rng)]
        texels_along = math.ceil(2 * self.outer_m / TEXEL_M)
        paint = np.full((8, texels_along, _TEXELS_UP), WALL)
        for opening in self.openings:
            draw = paint_door if opening.kind == "door" else paint_window
            draw(paint[opening.wall], opening, rng)
        #: Paint of each wall summed along it up to each texel's beginning.
        self._paint_sum = np.pad(paint.cumsum(axis=1), ((0, 0), (1, 0), (0, 0)))

    def path(self, frame: float) -> FloorPose:
        """Return the path of the paper's robot: 125 frames to a side, endless.

        In frames 0..99 of a side it drives straight along the middle of the corridor, in frames
        100..124 through a quarter circle to the left, at the same speed.
        """
        side, frame = divmod(frame, FRAMES_PER_SIDE)
        way_m = frame / FRAMES_PER_SIDE * self.length_m
        half_m = self._half_straight_m
        turn = max(0.0, way_m - 2 * half_m) / self._radius_m
        x_m = min(way_m, 2 * half_m) - half_m + self._radius_m * math.sin(turn)
        y_m = -half_m - self._radius_m * math.cos(turn)
        for _ in range(int(side) % 4):
            x_m, y_m = -y_m, x_m
        yaw_rad = math.remainder(side * math.pi / 2 + turn, 2 * math.pi)
        return FloorPose(x_m, y_m, yaw_rad)

    def along_wall(self, wall: int, places_m: tuple[float, ...]) -> list[tuple[float, float]]:
        """Return the floor places (x, y) in m that lie so far along a wall."""
        start = self._corners_m[wall] - 2 * self._half_m[wall] * _ALONG[wall]
        return [(float(x), float(y)) for x, y in (start + m * _ALONG[wall] for m in places_m)]

    def render(self, pose: FloorPose, camera: SceneCamera, time_s: float = 0.0) -> View:
        """Return what ``camera`` sees from ``pose``, which must be inside; time does not matter.

        Columns are halved, and cut where a corner passes through them, so that each piece sees
        one wall at nearly one depth. Its paint is then averaged exactly: along the wall by a
        running sum, upward by a second one.
        """
        edges = np.arange(camera.width + 1, dtype=np.float64) - 0.5
        corners = camera.project(pose, self._corners_m)
        corners = corners[(corners > edges[0]) & (corners < edges[-1])]
        # Rounding excludes pieces of no width.
        cuts = np.unique(np.concatenate([edges, edges[:-1] + 0.5, corners.round(6)]))
        middles = (cuts[:-1] + cuts[1:]) / 2
        eye = camera.eye(pose)
        wall, wall_depth = self._cast(eye, camera.rays(pose, middles))
        cut_rays = camera.rays(pose, cuts)
        paint = self._mean_paint(
            wall, self._along(eye, cut_rays[:-1], wall), self._along(eye, cut_rays[1:], wall)
        )

        row_edges = np.arange(camera.height + 1, dtype=np.float64) - 0.5
        up = (EYE_HEIGHT_M + wall_depth[:, None] * camera.upward(row_edges)) / TEXEL_M
        on_wall = up.clip(0, _TEXELS_UP)
        below = np.minimum(on_wall.astype(np.intp), _TEXELS_UP - 1)
        paint_below = np.pad(paint.cumsum(axis=1), ((0, 0), (1, 0)))
        piece = np.arange(len(wall))[:, None]
        paint_sum = paint_below[piece, below] + (on_wall - below) * paint[piece, below]
        # Up shrinks from row to row, and so do the sums: the signs cancel.
        pixel = np.diff(up)
        rows = np.arange(camera.height, dtype=float)
        flat = np.where(camera.upward(rows) > 0, CEILING, FLOOR)
        reflected = (np.diff(paint_sum) + (pixel - np.diff(on_wall)) * flat) / pixel

        flat_depth = _flat_depth(camera)
        depth = np.minimum(wall_depth[:, None], flat_depth)
        leftward = depth * camera.leftward(middles)[:, None] + camera.left_m
        distance2 = depth**2 + leftward**2 + (depth * camera.upward(rows)) ** 2
        grey = reflected / (1 + distance2 / self.lamp_m**2)
        share = np.diff(cuts)[:, None]
        columns = np.add.reduceat(grey * share, np.searchsorted(cuts, edges[:-1]), axis=0)

        _, centre_depth = self._cast(eye, camera.rays(pose, edges[:-1] + 0.5))
        return View(
            columns.T.astype(np.float32, order="C"),
            np.minimum(centre_depth, flat_depth[:, None]).astype(np.float32),
        )

    def _cast(
        self, eye: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return number and depth (n,) of the first wall that each of the rays (n, 2) meets."""
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self._half_m - _OUTWARD @ eye) / (rays @ _OUTWARD.T)
            along = _ALONG @ eye + depth * (rays @ _ALONG.T)
            hit = (depth > 0) & (np.abs(along) <= self._half_m + 1e-6)
        depth = np.where(hit, depth, np.inf)
        return depth.argmin(axis=1), depth.min(axis=1)

    def _along(
        self, eye: NDArray[np.float64], rays: NDArray[np.float64], wall: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Return how far along its wall (n,) each of the rays (n, 2) meets it, in texels."""
        half, outward, along = self._half_m[wall], _OUTWARD[wall], _ALONG[wall]
        depth = (half - outward @ eye) / (rays * outward).sum(axis=1)
        texels: NDArray[np.float64] = (
            half + along @ eye + depth * (rays * along).sum(axis=1)
        ) / TEXEL_M
        return texels

    def _mean_paint(
        self, wall: NDArray[np.intp], start: NDArray[np.float64], stop: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the mean paint (n, texels up) of walls (n,) between places (n,) in texels."""

        def running_sum(place: NDArray[np.float64]) -> NDArray[np.float64]:
            before = np.minimum(place.astype(np.intp), self._paint_sum.shape[1] - 2)
            low, high = self._paint_sum[wall, before], self._paint_sum[wall, before + 1]
            total: NDArray[np.float64] = low + (place - before)[:, None] * (high - low)
            return total

        return (running_sum(stop) - running_sum(start)) / (stop - start)[:, None]

    def _place(self, wall: int, rng: np.random.Generator) -> list[Opening]:
        """Place doors and windows along one wall at irregular distances."""
        outer = wall < 4
        placed: list[Opening] = []
        # An outer wall begins with a door, in the middle of the view along the corridor before it.
        start = self.width_m / 2 + rng.uniform(-0.7, -0.3) if outer else rng.uniform(0.5, 1.5)
        kind = "door"
        while True:
            stop = start + (rng.uniform(0.9, 1.1) if kind == "door" else rng.uniform(0.9, 1.9))
            if stop > 2 * self._half_m[wall] - 0.3:
                return placed
            placed.append(Opening(wall, kind, start, stop))
            start = stop + (rng.uniform(0.5, 1.3) if outer else rng.uniform(1.2, 2.8))
            kind = "window" if outer and rng.random() < 0.6 else "door"


def _flat_depth(camera: SceneCamera) -> NDArray[np.float64]:
    """Return the depth (height,) at which each row meets the floor or the ceiling."""
    up = camera.upward(np.arange(camera.height, dtype=float))
    with np.errstate(divide="ignore"):
        return np.where(up > 0, HEIGHT_M - EYE_HEIGHT_M, EYE_HEIGHT_M) / np.abs(up)


def _fill(
    paint: NDArray[np.float64],
    along_m: tuple[float, float],
    up_m: tuple[float, float],
    grey: float,
) -> None:
    along, up = (slice(*(round(m / TEXEL_M) for m in span)) for span in (along_m, up_m))
    paint[along, up] = grey


def paint_door(paint: NDArray[np.float64], door: Opening, rng: np.random.Generator) -> None:
    """Paint a door on a wall (along, up), in place, both in texels of :data:`TEXEL_M`."""
    start, stop, top = door.start_m, door.stop_m, rng.uniform(1.98, 2.14)
    leaf, split = rng.uniform(110, 140), rng.uniform(0.85, 1.1)
    _fill(paint, (start, stop), (0, top), rng.uniform(30, 60))
    _fill(paint, (start + 0.1, stop - 0.1), (0, top - 0.1), leaf)
    for panel in ((0.2, split - 0.08), (split + 0.08, top - 0.24)):
        _fill(paint, (start + 0.24, stop - 0.24), panel, leaf - rng.uniform(40, 60))
    _fill(paint, (stop - 0.22, stop - 0.12), (split - 0.04, split + 0.04), 240)  # the handle


def paint_window(paint: NDArray[np.float64], window: Opening, rng: np.random.Generator) -> None:
    """Paint a window on a wall (along, up), in place, both in texels of :data:`TEXEL_M`."""
    start, stop = window.start_m, window.stop_m
    low, high = rng.uniform(0.8, 1.0), rng.uniform(1.9, 2.2)
    _fill(paint, (start, stop), (low, high), rng.uniform(235, 250))
    transom = low + rng.uniform(0.6, 0.75) * (high - low)
    for left, right in pairwise(np.linspace(start, stop, 3 if stop - start < 1.4 else 4)):
        for bottom, top in pairwise((low, transom, high)):
            pane = rng.uniform(20, 80)
            _fill(paint, (left + 0.06, right - 0.06), (bottom + 0.06, top - 0.06), pane)
