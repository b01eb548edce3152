"""People-sized obstacles that walk in the corridor.

A walker is an upright cylinder painted with coarse noise. One half of them walk along the corridor,
against the robot's first direction; the other half cross it from wall to wall. They walk at
:data:`SPEEDS_M_S` and ignore one another. A walker stops close before the robot and after a while
turns round, so that every touch is a fault of the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, SceneCamera, View

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

RADIUS_M = 0.25
HEIGHT_M = 1.75
#: Slow to brisk walking pace.
SPEEDS_M_S = (0.6, 1.1)
#: Distance to the robot's edge ahead at which a walker stops.
_POLITE_M = 0.6
#: Frames that it stands before it turns round.
_PATIENCE_FRAMES = 20

#: Rays per pixel along a row and a column, which are averaged.
_ACROSS = 3
_DOWN = 2
_TEXEL_M = 0.05


@dataclass(frozen=True, slots=True)
class Walker:
    """A walker.

    Attributes:
        x_m, y_m: its middle.
        heading_rad: its direction, yaw in the world.
        speed_m_s: its speed.
        crosses: whether it walks from wall to wall, not along the corridor.
        stood_frames: number of frames that it has been standing.
    """

    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    crosses: bool
    stood_frames: int = 0

    def distance_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of its middle from a place."""
        return math.hypot(self.x_m - x_m, self.y_m - y_m)


def step(
    walker: Walker,
    robot: FloorPose,
    *,
    robot_radius_m: float,
    inner_m: float,
    outer_m: float,
    frame_s: float,
) -> Walker:
    """Return the walker a frame later.

    Args:
        walker: the walker.
        robot: where the robot is.
        robot_radius_m: its radius.
        inner_m, outer_m: half the sides of the inner and outer square of the corridor.
        frame_s: duration of a frame in s.
    """
    way_m = walker.speed_m_s * frame_s
    x_m = walker.x_m + way_m * math.cos(walker.heading_rad)
    y_m = walker.y_m + way_m * math.sin(walker.heading_rad)
    gap_m = math.hypot(x_m - robot.x_m, y_m - robot.y_m) - RADIUS_M - robot_radius_m
    nearer = math.hypot(x_m - robot.x_m, y_m - robot.y_m) < walker.distance_m(robot.x_m, robot.y_m)
    if gap_m < _POLITE_M and nearer:
        stood = walker.stood_frames + 1
        if stood < _PATIENCE_FRAMES:
            return replace(walker, stood_frames=stood)
        return replace(walker, heading_rad=walker.heading_rad + math.pi, stood_frames=0)
    square_m = max(abs(x_m), abs(y_m))
    if inner_m + RADIUS_M + 0.1 <= square_m <= outer_m - RADIUS_M - 0.1:
        return replace(walker, x_m=x_m, y_m=y_m, stood_frames=0)
    # At a wall one that crosses goes back; one that walks along takes the corner.
    turn = math.pi if walker.crosses else _corner_turn(walker, x_m, y_m)
    return replace(walker, heading_rad=walker.heading_rad + turn, stood_frames=0)


def place_walkers(
    count: int, width_m: float, inner_m: float, start: FloorPose, rng: np.random.Generator
) -> list[Walker]:
    """Return walkers spread over the corridor, none of them near the start.

    Args:
        count: how many.
        width_m, inner_m: width of the corridor, half the side of its inner square.
        start: where the robot starts.
        rng: random generator of places and speeds.
    """
    placed: list[Walker] = []
    room_m = width_m / 2 - RADIUS_M - 0.1
    clockwise = start.x_m * math.sin(start.yaw_rad) - start.y_m * math.cos(start.yaw_rad) < 0
    for number in range(count):
        while True:
            side = int(rng.integers(4))
            along_m = rng.uniform(-inner_m, inner_m)
            off_m = rng.uniform(-room_m, room_m) * 0.7
            x_m, y_m = along_m, -(inner_m + width_m / 2 + off_m)
            for _ in range(side):
                x_m, y_m = -y_m, x_m
            crosses = number % 2 == 1
            # Along a side, counter-clockwise, is side quarter turns from the x axis.
            heading = side * math.pi / 2 + (0 if clockwise else math.pi)
            if crosses:
                heading += rng.choice((-1, 1)) * (math.pi / 2 + rng.uniform(-0.3, 0.3))
            walker = Walker(x_m, y_m, heading, rng.uniform(*SPEEDS_M_S), crosses)
            if walker.distance_m(start.x_m, start.y_m) > 3.5:
                placed.append(walker)
                break
    return placed


class WalkerPaint:
    """Textures of the walkers.

    Args:
        count: how many.
        rng: random generator of the paint.
    """

    def __init__(self, count: int, rng: np.random.Generator) -> None:
        rows, columns = round(HEIGHT_M / _TEXEL_M), round(2 * math.pi * RADIUS_M / _TEXEL_M)
        self._paint: list[Real] = []
        for _ in range(count):
            white = rng.standard_normal((rows, columns)).astype(np.float32)
            # Three times around, so that the middle third closes on itself.
            grain = cv2.GaussianBlur(np.tile(white, 3), (0, 0), 1.5)[:, columns : 2 * columns]
            tone = np.full((rows, 1), rng.uniform(60, 190), np.float32)
            tone[: round(0.25 / _TEXEL_M)] = rng.uniform(150, 210)  # the head
            tone[round(0.85 / _TEXEL_M) :] = rng.uniform(30, 90)  # trousers
            paint = (tone + 88 * grain).clip(5, 245)
            self._paint.append(np.pad(paint, ((0, 0), (1, 1)), mode="wrap"))

    def render(
        self, view: View, walkers: list[Walker], pose: FloorPose, camera: SceneCamera, lamp_m: float
    ) -> View:
        """Return a view with the walkers in it.

        Args:
            view: what stands behind them.
            walkers: the walkers, as many as there are paints.
            pose, camera: who looks.
            lamp_m: distance at which the lamp's light has fallen to a half.
        """
        mover = np.zeros(view.grey.shape, np.uint8)
        view = View(view.grey.copy(), view.depth_m.copy(), mover)
        eye = camera.eye(pose)
        for number in np.argsort([-walker.distance_m(*eye) for walker in walkers]):
            self._paint_one(
                view,
                walkers[number],
                self._paint[number],
                int(number) + 1,
                pose=pose,
                camera=camera,
                lamp_m=lamp_m,
            )
        return view

    def _paint_one(
        self,
        view: View,
        walker: Walker,
        paint: Real,
        number: int,
        *,
        pose: FloorPose,
        camera: SceneCamera,
        lamp_m: float,
    ) -> None:
        """Paint a walker into a view, in place."""
        grey, depth_m, mover = view
        assert mover is not None
        offset = np.array([walker.x_m, walker.y_m]) - camera.eye(pose)
        ahead, left = float(offset @ pose.forward), float(offset @ pose.left)
        # The tangents from the eye to a circle, as slopes to the left per metre ahead.
        far = math.hypot(ahead, left)
        if ahead < -RADIUS_M or far <= RADIUS_M * 1.01:
            return
        half = math.asin(RADIUS_M / far)
        middle = math.atan2(left, ahead)
        edges = [math.tan(min(max(middle + s * half, -1.5), 1.5)) for s in (1, -1)]
        first, last = (camera.cx - camera.focal_px * edge for edge in edges)
        low, high = max(math.floor(first), 0), min(math.ceil(last) + 1, camera.width)
        if low >= high:
            return
        u = low + (np.arange((high - low) * _ACROSS) + 0.5) / _ACROSS - 0.5
        slope = camera.leftward(u)
        reach, angle = _meet(ahead, left, slope)
        # A level ray meets neither floor nor ceiling: walls hide what is behind them.
        walls = depth_m[round(camera.cy), low:high].astype(np.float64)
        reach[reach > np.repeat(walls, _ACROSS)] = np.nan
        up = (camera.cy - (np.arange(camera.height * _DOWN) + 0.5) / _DOWN + 0.5) / camera.focal_px
        z_m = EYE_HEIGHT_M + up[:, None] * reach
        hit = np.isfinite(reach) & (z_m <= HEIGHT_M) & (z_m >= 0)
        known = np.nan_to_num(reach, nan=1.0)
        angle += pose.yaw_rad - walker.heading_rad
        texel_x = (angle / math.tau % 1) * (paint.shape[1] - 2) + 0.5
        texel_y = (HEIGHT_M - EYE_HEIGHT_M - up[:, None] * known) / _TEXEL_M - 0.5
        colour = cv2.remap(
            paint,
            np.broadcast_to(texel_x, texel_y.shape).astype(np.float32),
            texel_y.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        distance2 = known**2 * (1 + slope**2 + up[:, None] ** 2)
        colour = colour / (1 + distance2 / lamp_m**2)
        shape = (camera.height, _DOWN, high - low, _ACROSS)
        share = hit.reshape(shape).mean(axis=(1, 3))
        mean = (np.where(hit, colour, 0).reshape(shape).mean(axis=(1, 3))).astype(np.float32)
        area = slice(None), slice(low, high)
        grey[area] = grey[area] * (1 - share).astype(np.float32) + mean

        centre, _ = _meet(ahead, left, camera.leftward(np.arange(low, high, dtype=float)))
        z_m = EYE_HEIGHT_M + camera.upward(np.arange(camera.height, dtype=float))[:, None] * centre
        inside = np.isfinite(centre) & (z_m <= HEIGHT_M) & (z_m >= 0)
        inside &= centre <= walls
        depth_m[area] = np.where(inside, centre, depth_m[area])
        mover[area][inside] = number


def _meet(
    ahead_m: float, left_m: float, slope: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return depth, NaN where it is missed, and angle on the cylinder, where rays meet it."""
    # |t (1, slope) - (ahead, left)| = radius, the smaller t.
    a = 1 + slope**2
    b = ahead_m + slope * left_m
    c = ahead_m**2 + left_m**2 - RADIUS_M**2
    with np.errstate(invalid="ignore"):
        depth = (b - np.sqrt(b**2 - a * c)) / a
    depth = np.where(depth > 0, depth, np.nan)
    angle = np.arctan2(depth * slope - left_m, depth - ahead_m)
    return depth, np.nan_to_num(angle)


def _corner_turn(walker: Walker, x_m: float, y_m: float) -> float:
    """Return the quarter turn that keeps it in the corridor: toward the square's next side."""
    left = (-math.sin(walker.heading_rad), math.cos(walker.heading_rad))
    return math.copysign(math.pi / 2, -(left[0] * x_m + left[1] * y_m))
