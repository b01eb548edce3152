"""A street that a car drives along: houses, trees, poles, kerbs, parked and moving cars, sky.

Places are given along the street, in m from the start, and to the left of its middle. It is made in
blocks, each from the seed and its number, so that it is endless.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.camera import FloorPose, SceneCamera, View
from motionstereo_cli.simulate.street_paint import paints
from motionstereo_cli.simulate.surfaces import Quadrangle, rectangle, render
from motionstereo_cli.simulate.texture import Texture

#: To the left of the middle: the lane driven in, the parked cars, kerb, inner edge of the pavement.
LANE_M = -1.5
_PARKED_M, _KERB_M, _PAVED_M = 3.9, 5.0, 7.5
_KERB_UP_M = 0.12

#: Length of a block, and the visible distance back and ahead.
_BLOCK_M, _PIECE_M = 20.0, 4.0
_BEHIND_M, _AHEAD_M = 12.0, 130.0
#: From one bend to the next but one.
_WAVE_M = 110.0
_STEP_M = 0.25
_SKY_M = 3000.0

_CAR_LONG_M, _CAR_WIDE_M = 4.2, 1.75
_ONCOMING_M, _ONCOMING_M_S = 75.0, 8.0
#: How high above the road a car's shadow lies.
_SHADOW_UP_M = 0.008

Vector = NDArray[np.float64]


class Street:
    """The street, its paint and its traffic.

    Args:
        length_m: its length.
        speed_m_s: speed of the rig.
        winding_rad: maximum angle to its first direction.
        seed: seed of everything else.
    """

    def __init__(
        self, length_m: float, speed_m_s: float = 8.0, winding_rad: float = 0.0, seed: int = 0
    ) -> None:
        self._seed = seed
        self._speed_m_s = speed_m_s
        rng = np.random.default_rng([seed, 0])
        self._paints = paints(rng)
        self._sun = np.array([math.cos(1), math.sin(1)]) * rng.choice((-1, 1))
        count = math.ceil((length_m + _AHEAD_M + 3 * _BLOCK_M) / _STEP_M)
        self._along_m = (np.arange(count) - 2 * _BLOCK_M / _STEP_M) * _STEP_M
        phase = rng.uniform(0, math.tau)
        self._yaw = winding_rad * np.sin(math.tau * self._along_m / _WAVE_M + phase)
        self._middle_m = np.cumsum([np.cos(self._yaw), np.sin(self._yaw)], axis=1) * _STEP_M
        self._leads_m = rng.uniform(13, 28) if rng.random() < 0.5 else 0.0
        self._oncoming_m = rng.uniform(0, _ONCOMING_M)
        self._block = lru_cache(maxsize=16)(self._make_block)

    def path(self, time_s: float) -> FloorPose:
        """Return where the rig is: in the middle of its lane."""
        along_m = self._speed_m_s * time_s
        x_m, y_m = self.at(along_m, LANE_M)
        return FloorPose(
            float(x_m), float(y_m), float(np.interp(along_m, self._along_m, self._yaw))
        )

    def at(self, along_m: float, left_m: float) -> Vector:
        """Return the floor place (2,) so far along the street and to the left of its middle."""
        yaw = float(np.interp(along_m, self._along_m, self._yaw))
        middle = [np.interp(along_m, self._along_m, axis) for axis in self._middle_m]
        return np.array(middle) + left_m * np.array([-math.sin(yaw), math.cos(yaw)])

    def render(self, pose: FloorPose, camera: SceneCamera, time_s: float) -> View:
        """Return what ``camera`` sees from ``pose``, which must be on the street, at ``time_s``."""
        along_m = self._speed_m_s * time_s
        first, last = (math.floor((along_m + reach) / _BLOCK_M) for reach in (-_BEHIND_M, _AHEAD_M))
        surfaces = [item for block in range(first, last + 1) for item in self._block(block)]
        surfaces += self._far(pose)
        surfaces += self._traffic(time_s)
        return render(surfaces, pose, camera)

    def _far(self, pose: FloorPose) -> Iterator[Quadrangle]:
        """Yield sky and fields, which move with the rig."""
        side, top = 2 * _SKY_M, 0.55 * _SKY_M
        for quarter in range(4):
            turn = quarter * math.pi / 2
            out = np.array([math.cos(turn), math.sin(turn), 0.0])
            right = np.array([math.sin(turn), -math.cos(turn), 0.0])
            corner = np.array([pose.x_m, pose.y_m, top]) + _SKY_M * out - _SKY_M * right
            yield rectangle(corner, side * right, (0, 0, -top - 1), self._paints.sky)
        x = np.array([-1, 1, 1, -1]) * 400 + pose.x_m
        y = np.array([-1, -1, 1, 1]) * 400 + pose.y_m
        yield _level(np.stack([x, y], axis=1), -0.03, self._paints.grass, 0.03)

    def places(self, time_s: float) -> dict[int, tuple[float, float]]:
        """Return where each car that drives is in m, by its number in the truth."""
        cars = self._driving(time_s).items()
        middles = {number: self.at(along_m, left_m) for number, (along_m, left_m, _) in cars}
        return {number: (float(x_m), float(y_m)) for number, (x_m, y_m) in middles.items()}

    def _driving(self, time_s: float) -> dict[int, tuple[float, float, float]]:
        """Return each car that drives: how far along and to the left in m, and its paint's gain."""
        here_m, cars = self._speed_m_s * time_s, {}
        if self._leads_m:
            gap_m = self._leads_m + 4 * math.sin(time_s / 2)
            cars[1] = here_m + gap_m, LANE_M, 0.9
        start_m = self._oncoming_m - _ONCOMING_M_S * time_s
        first = math.ceil((here_m - _BEHIND_M - start_m) / _ONCOMING_M)
        for number in (first, first + 1):
            along_m = start_m + number * _ONCOMING_M
            cars[2 + number % 250] = along_m, -LANE_M, 0.7 + number % 3 * 0.3
        return cars

    def _traffic(self, time_s: float) -> Iterator[Quadrangle]:
        """Yield the cars that drive."""
        for number, car in self._driving(time_s).items():
            yield from self._moving(number, self._car(*car))

    @staticmethod
    def _moving(number: int, surfaces: Iterator[Quadrangle]) -> Iterator[Quadrangle]:
        """Yield surfaces with the number of what moves by itself; its shadow has none."""
        for surface in surfaces:
            upright = float(surface.corners_m[:, 2].max()) > _SHADOW_UP_M
            yield replace(surface, mover=number) if upright else surface

    def _make_block(self, block: int) -> tuple[Quadrangle, ...]:
        rng = np.random.default_rng([self._seed, 2, block + 2])
        start_m = block * _BLOCK_M
        made = [*self._road(start_m, rng)]
        for side in (-1, 1):
            made += [*self._roadside(start_m, side), *self._planted(start_m, side, rng)]
            made += [*self._house(start_m, side, rng), *self._parked(start_m, side, rng)]
        return tuple(made)

    def _strip(self, start_m: float, stop_m: float, right_m: float, left_m: float) -> Vector:
        """Return the four floor corners (4, 2) of a piece of the street."""
        return np.array(
            [
                self.at(start_m, right_m),
                self.at(stop_m, right_m),
                self.at(stop_m, left_m),
                self.at(start_m, left_m),
            ]
        )

    def _pieces(self, start_m: float) -> Iterator[tuple[float, float]]:
        for piece_m in np.arange(start_m, start_m + _BLOCK_M, _PIECE_M):
            yield float(piece_m), float(piece_m + _PIECE_M)

    def _road(self, start_m: float, rng: np.random.Generator) -> Iterator[Quadrangle]:
        """Yield asphalt, lines on it, patches and shadows."""
        paint = self._paints
        for piece in self._pieces(start_m):
            yield _level(self._strip(*piece, -_KERB_M, _KERB_M), 0, paint.asphalt, 0.01)
        for dash_m in (start_m + 2, start_m + 12):
            for middle_m in (-3.0, 0.0, 3.0):
                dash = self._strip(dash_m, dash_m + 3, middle_m - 0.06, middle_m + 0.06)
                yield _level(dash, 0.004, paint.line, 0.01)
        for _ in range(3):
            along_m, left_m = start_m + rng.uniform(0, 18), rng.uniform(-3, 3)
            long_m, wide_m = rng.uniform(0.5, 3), rng.uniform(0.3, 1)
            patch = self._strip(along_m, along_m + long_m, left_m, left_m + wide_m)
            yield _level(patch, 0.002, paint.asphalt, 0.014, rng.uniform(0.55, 0.8))

    def _roadside(self, start_m: float, side: int) -> Iterator[Quadrangle]:
        """Yield kerb, pavement, grass and the woods behind."""
        paint = self._paints
        for piece in self._pieces(start_m):
            edges = sorted((side * _KERB_M, side * _PAVED_M))
            yield _level(self._strip(*piece, *edges), _KERB_UP_M, paint.slabs, 0.015)
            yield self._upright(*piece, side * _KERB_M, (0, _KERB_UP_M), paint.stone, 0.01)
        edges = sorted((side * _PAVED_M, side * 30.0))
        stop_m = start_m + _BLOCK_M
        yield _level(self._strip(start_m, stop_m, *edges), _KERB_UP_M - 0.01, paint.grass, 0.02)
        yield self._upright(start_m, stop_m, side * 26, (0, 9), paint.woods)

    def _upright(
        self,
        start_m: float,
        stop_m: float,
        left_m: float,
        up_m: tuple[float, float],
        texture: Texture,
        texel_m: float | None = None,
        gain: float = 1.0,
    ) -> Quadrangle:
        """Return a wall along the street."""
        start, stop = self.at(start_m, left_m), self.at(stop_m, left_m)
        return self._wall(start, stop, up_m, texture, texel_m, gain)

    def _wall(
        self,
        start: Vector,
        stop: Vector,
        up_m: tuple[float, float],
        texture: Texture,
        texel_m: float | None = None,
        gain: float = 1.0,
    ) -> Quadrangle:
        """Return a wall between two floor places, in the light of the sun."""
        along = (stop - start) / max(math.hypot(*(stop - start)), 1e-9)
        light = 0.85 + 0.3 * abs(float(along @ self._sun))
        down = (0, 0, up_m[0] - up_m[1])
        right = (*(stop - start), 0)
        return rectangle(
            (*start, up_m[1]), right, down, texture, texel_m=texel_m, gain=gain * light
        )

    def _house(self, start_m: float, side: int, rng: np.random.Generator) -> Iterator[Quadrangle]:
        """Yield a house, or none, and the hedge or fence before it."""
        paint = self._paints
        front_m = side * rng.uniform(8.5, 13)
        if rng.random() < 0.5:
            hedge_m, texel_m = rng.uniform(0.7, 1.7), 0.015
            yield self._upright(
                start_m, start_m + 14, side * 7.7, (0, hedge_m), paint.hedge, texel_m
            )
        if rng.random() < 0.2:
            return
        begin_m = start_m + rng.uniform(0, 4)
        end_m = begin_m + rng.uniform(11, 15.5)
        back_m, eaves_m = front_m + side * 9, rng.uniform(5.5, 8)
        front = paint.fronts[rng.integers(len(paint.fronts))]
        gain = rng.uniform(0.7, 1.1)
        fronts = self.at(begin_m, front_m), self.at(end_m, front_m)
        backs = self.at(begin_m, back_m), self.at(end_m, back_m)
        yield self._wall(*fronts, (0, eaves_m), front, None, gain)
        ridge = [(near + far) / 2 for near, far in zip(fronts, backs, strict=True)]
        for near, far, top in zip(fronts, backs, ridge, strict=True):
            wall = self._wall(near, far, (0, eaves_m), front, 0.016, gain)
            yield wall
            peak = np.array([*top, eaves_m + 3.5])
            yield replace(wall, corners_m=np.array([*wall.corners_m[:2], peak, peak]))
        right = np.array([*(fronts[1] - fronts[0]), 0])
        down = np.array([*(fronts[0] - ridge[0]), -3.5])
        corner = np.array([*ridge[0], eaves_m + 3.5])
        for slope in (down, down * (-1, -1, 1)):
            yield rectangle(corner, right, slope, paint.tiles, texel_m=0.02, gain=gain)

    def _planted(self, start_m: float, side: int, rng: np.random.Generator) -> Iterator[Quadrangle]:
        """Yield trees with their shadows, and a lamp post."""
        paint = self._paints
        for slot_m in (start_m + 3, start_m + 13):
            if rng.random() < 0.55:
                along_m, left_m = slot_m + rng.uniform(-2, 2), side * rng.uniform(5.7, 6.6)
                trunk_m, half_m = rng.uniform(2.2, 3.2), rng.uniform(1.4, 2.4)
                yield from self._post(
                    along_m, left_m, rng.uniform(0.2, 0.4), trunk_m + 1, paint.bark
                )
                crown = paint.crowns[rng.integers(len(paint.crowns))]
                yield from self._crown(along_m, left_m, trunk_m, half_m, crown, rng)
                edges = sorted((side * 1.5, side * 6))
                shadow = self._strip(along_m - half_m, along_m + half_m, *edges)
                yield _level(shadow, 0.006, paint.shade, 0.02)
        if rng.random() < 0.6:
            along_m = start_m + rng.uniform(7, 9)
            yield from self._post(along_m, side * 5.4, 0.13, 6.5, paint.metal)

    def _post(
        self, along_m: float, left_m: float, thick_m: float, high_m: float, texture: Texture
    ) -> Iterator[Quadrangle]:
        """Yield the two sides that one sees of an upright post."""
        a, b = self._strip(along_m, along_m + thick_m, left_m, left_m + thick_m)[[0, 3]]
        yield self._wall(a, b, (0, high_m), texture, 0.01)
        inner_m = left_m if left_m > 0 else left_m + thick_m
        yield self._upright(along_m, along_m + thick_m, inner_m, (0, high_m), texture, 0.01)

    def _crown(
        self,
        along_m: float,
        left_m: float,
        low_m: float,
        half_m: float,
        texture: Texture,
        rng: np.random.Generator,
    ) -> Iterator[Quadrangle]:
        """Yield a tree's crown: upright discs that cross, and further ones beside them."""
        middle = self.at(along_m, left_m)
        turn = rng.uniform(0, math.pi)
        for number in range(5):
            angle = turn + number * math.pi / 5
            arm = half_m * np.array([math.cos(angle), math.sin(angle)])
            off = rng.uniform(-0.3, 0.3, 2) * half_m * (number > 1)
            up_m = low_m + rng.uniform(-0.2, 0.4) * half_m * (number > 1)
            yield self._wall(
                middle + off - arm,
                middle + off + arm,
                (up_m, up_m + 2.2 * half_m),
                texture,
                None,
                rng.uniform(0.8, 1.15),
            )

    def _parked(self, start_m: float, side: int, rng: np.random.Generator) -> Iterator[Quadrangle]:
        for slot_m in np.arange(start_m + 3, start_m + 18, 6):
            if rng.random() < 0.4:
                along_m = float(slot_m) + rng.uniform(-0.5, 0.5)
                yield from self._car(along_m, side * _PARKED_M, rng.uniform(0.45, 1.5))

    def _car(self, along_m: float, left_m: float, gain: float) -> Iterator[Quadrangle]:
        """Yield a car: a box with wheels painted on, a narrower one of glass, its shadow."""
        paint = self._paints
        forward = self.at(along_m + 1, left_m) - self.at(along_m - 1, left_m)
        forward /= math.hypot(*forward)
        aside = np.array([-forward[1], forward[0]])
        middle = self.at(along_m, left_m)

        def corner(ahead_m: float, aside_m: float, up_m: float) -> Vector:
            return np.array([*(middle + ahead_m * forward + aside_m * aside), up_m])

        def quad(places: list[tuple[float, float, float]], texture: Texture) -> Quadrangle:
            corners = np.array([corner(*place) for place in places])
            # A trapezium takes the middle of the picture.
            right, down = corners[1] - corners[0], corners[3] - corners[0]
            down = down - right * (down @ right) / (right @ right)
            return Quadrangle(
                corners,
                corners[0],
                right / texture.width,
                down / texture.height,
                texture,
                gain,
            )

        long, wide = _CAR_LONG_M / 2, _CAR_WIDE_M / 2
        for end in (-long, long):
            yield quad(
                [(end, wide, 0.85), (end, -wide, 0.85), (end, -wide, 0.2), (end, wide, 0.2)],
                paint.car_end,
            )
        for flank in (-wide, wide):
            yield quad(
                [
                    (-long, flank, 0.85),
                    (long, flank, 0.85),
                    (long, flank, 0.0),
                    (-long, flank, 0.0),
                ],
                paint.car_side,
            )
        yield quad(
            [(-long, wide, 0.85), (-long, -wide, 0.85), (long, -wide, 0.85), (long, wide, 0.85)],
            paint.car_top,
        )
        back, front, roof = (-1.9, -1.5), (1.0, 0.3), 0.62
        for low, high in (back, front):
            yield quad(
                [
                    (high, roof, 1.42),
                    (high, -roof, 1.42),
                    (low, -wide + 0.05, 0.85),
                    (low, wide - 0.05, 0.85),
                ],
                paint.car_glass,
            )
        for sign in (-1, 1):
            yield quad(
                [
                    (back[1], sign * roof, 1.42),
                    (front[1], sign * roof, 1.42),
                    (front[0], sign * (wide - 0.05), 0.85),
                    (back[0], sign * (wide - 0.05), 0.85),
                ],
                paint.car_glass,
            )
        yield quad(
            [
                (back[1], roof, 1.42),
                (back[1], -roof, 1.42),
                (front[1], -roof, 1.42),
                (front[1], roof, 1.42),
            ],
            paint.car_top,
        )
        shadow = self._strip(along_m - 2.2, along_m + 2.2, left_m - 1, left_m + 1)
        yield _level(shadow, _SHADOW_UP_M, paint.asphalt, 0.01, 0.3)


def _level(
    corners_m: Vector, up_m: float, texture: Texture, texel_m: float, gain: float = 1.0
) -> Quadrangle:
    """Return a level piece between floor corners (4, 2); its texture lies fast in the world."""
    corners = np.column_stack([corners_m, np.full(4, up_m)])
    right, down = np.array([texel_m, 0, 0]), np.array([0, texel_m, 0])
    return Quadrangle(corners, np.array([0, 0, up_m]), right, down, texture, gain)
