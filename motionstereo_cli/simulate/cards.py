"""Textured cards that cross, approach and recede before a textured wall.

The rig stands at the origin and looks along x, still or panning. Wall and cards are upright planes
across x; the nearest wins. The grain of the textures is resolved at every distance of the scene,
so that they do not shimmer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, SceneCamera, View

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

WALL_M = 7.0

#: Where a card's shadow falls, to the left and down per m that it is before the wall; how dark.
_SUN = 0.2, 0.1
_SHADE = 0.5

#: Panning: a sine of this amplitude and period.
_PAN_RAD = math.radians(8)
_PAN_S = 4.0

#: Standard deviation of the Gaussian that smooths the noise: in pixels where the surface is
#: farthest, and in texels. Above 0.8 px next to nothing is left to alias.
_GRAIN_PX = 0.9
_GRAIN_TEXELS = 2.5
_WALL_TILE_M = 4.0
_WALL_GREY = 128.0
_CONTRAST = 95.0
#: Maximum size of a texture, for long focal lengths; it then repeats every 700 px.
_MAX_TEXELS = 2048


@dataclass(frozen=True, slots=True)
class Card:
    """A card that shuttles along one axis at constant speed.

    Attributes:
        name: what it does, for messages.
        axis: 0 to move along x (depth), 1 along y (leftward).
        low_m, high_m: where it turns round on that axis.
        start_m: where it is at time 0.
        speed_m_s: its velocity at time 0, positive = away (axis 0) or left (axis 1).
        fixed_m: its place on the other axis.
        up_m: height of its middle above the cameras.
        width_m, height_m: its size.
        grey: mean grey level of its texture.
    """

    name: str
    axis: int
    low_m: float
    high_m: float
    start_m: float
    speed_m_s: float
    fixed_m: float
    up_m: float
    width_m: float
    height_m: float
    grey: float

    @property
    def farthest_m(self) -> float:
        """The largest depth it reaches."""
        return self.high_m if self.axis == 0 else self.fixed_m


#: At 480 px width, focal 0.87 x width and baseline 0.12 m: disparities of 10 to 33 px, on a wall
#: of 7 px.
CARDS = (
    Card("crossing far", 1, -2.6, 2.6, 1.6, -1.2, 5.0, 0.35, 1.3, 1.1, 155),
    Card("crossing left", 1, -1.6, 1.6, -1.0, 0.9, 3.0, -0.45, 0.7, 0.8, 100),
    Card("crossing right", 1, -1.1, 1.1, 0.9, -0.6, 2.2, 0.5, 0.5, 0.45, 160),
    Card("approaching", 0, 1.5, 4.0, 4.0, -0.5, 0.55, -0.05, 0.55, 0.55, 95),
    Card("receding", 0, 1.6, 4.2, 1.6, 0.7, -0.6, -0.1, 0.5, 0.6, 150),
)


@dataclass(frozen=True, slots=True)
class CardState:
    """Place and velocity of a card: the truth for tracking.

    Attributes:
        x_m, y_m, z_m: its middle in the world.
        closing_m_s: how fast its distance ahead shrinks; negative = it recedes.
        leftward_m_s: its speed to the left.
    """

    x_m: float
    y_m: float
    z_m: float
    closing_m_s: float
    leftward_m_s: float


def card_state(card: Card, time_s: float) -> CardState:
    """Return where ``card`` is at ``time_s`` and its velocity just after."""
    span_m = card.high_m - card.low_m
    # The path there and back, unfolded, is a circle of twice the span.
    start_m = (
        card.start_m - card.low_m
        if card.speed_m_s >= 0
        else 2 * span_m - (card.start_m - card.low_m)
    )
    way_m = (start_m + abs(card.speed_m_s) * time_s) % (2 * span_m)
    back = way_m >= span_m
    place_m = card.low_m + (2 * span_m - way_m if back else way_m)
    speed_m_s = -abs(card.speed_m_s) if back else abs(card.speed_m_s)
    z_m = EYE_HEIGHT_M + card.up_m
    if card.axis == 0:
        return CardState(place_m, card.fixed_m, z_m, -speed_m_s, 0.0)
    return CardState(card.fixed_m, place_m, z_m, 0.0, speed_m_s)


def pan_pose(time_s: float) -> FloorPose:
    """Return the panning rig's pose: it turns about its middle, first to the left."""
    return FloorPose(0.0, 0.0, _PAN_RAD * math.sin(2 * math.pi * time_s / _PAN_S))


class Cards:
    """The cards and the wall with their textures.

    Args:
        focal_px: focal length of the cameras; determines the grain of the textures.
        seed: seed of the textures.
        shadows: whether the cards cast shadows on the wall.
    """

    def __init__(self, focal_px: float, seed: int = 0, *, shadows: bool = False) -> None:
        self._shadows = shadows
        rng = np.random.default_rng([seed, 0])
        self._wall = _Texture.noise(rng, focal_px, WALL_M, _WALL_TILE_M, _WALL_GREY)
        self._cards = [
            _Texture.noise(
                rng, focal_px, card.farthest_m, max(card.width_m, card.height_m), card.grey
            )
            for card in CARDS
        ]

    def places(self, time_s: float) -> dict[int, tuple[float, float]]:
        """Return where each card is on the floor in m, by its number in the truth."""
        states = (card_state(card, time_s) for card in CARDS)
        return {number: (state.x_m, state.y_m) for number, state in enumerate(states, 1)}

    def render(self, pose: FloorPose, camera: SceneCamera, time_s: float) -> View:
        """Return the view of ``camera`` from ``pose``, which must face the wall, at ``time_s``.

        Painted from far to near; a card covers a pixel by the share of its area.
        """
        wall = _Plane.seen(pose, camera, WALL_M)
        grey = self._wall.look_up(-wall.y_m, EYE_HEIGHT_M - wall.z_m)
        depth_m = np.broadcast_to(wall.depth_m, grey.shape).astype(np.float32)
        mover = np.zeros(grey.shape, np.uint8)
        states = [card_state(card, time_s) for card in CARDS]
        if self._shadows:
            for card, state in zip(CARDS, states, strict=True):
                before_m = WALL_M - state.x_m
                right_m = state.y_m + _SUN[0] * before_m - card.width_m / 2
                low_m = state.z_m - _SUN[1] * before_m - card.height_m / 2
                across = _cover(wall.y_edges_m, right_m, right_m + card.width_m)
                upward = _cover(wall.z_edges_m, low_m, low_m + card.height_m)
                grey *= 1 - np.float32(_SHADE) * (upward * across).astype(np.float32)
        for number, state, card, texture in sorted(
            zip(range(1, len(CARDS) + 1), states, CARDS, self._cards, strict=True),
            key=lambda item: -item[1].x_m,
        ):
            plane = _Plane.seen(pose, camera, state.x_m)
            left_m, top_m = state.y_m + card.width_m / 2, state.z_m + card.height_m / 2
            across = _cover(plane.y_edges_m, left_m - card.width_m, left_m)
            if not across.any():
                continue
            columns = _span(across)
            upward = _cover(plane.z_edges_m[:, columns], top_m - card.height_m, top_m)
            rows = _span(upward.max(axis=1))
            y_m, z_m = plane.y_m[columns], plane.z_m[rows, columns]
            paint = texture.look_up(left_m - y_m, top_m - z_m)
            area = rows, columns
            grey[area] += (across[columns] * upward[rows]).astype(np.float32) * (paint - grey[area])
            inside = (np.abs(y_m - state.y_m) <= card.width_m / 2) & (
                np.abs(z_m - state.z_m) <= card.height_m / 2
            )
            depth_m[area] = np.where(inside, plane.depth_m[columns], depth_m[area])
            mover[area][inside] = number
        return View(grey, depth_m, mover)


@dataclass(frozen=True, slots=True)
class _Texture:
    """Periodic grey noise.

    Attributes:
        grey: (size + 4, size + 4) float32 grey levels; on each side 2 texels come once more, for
            cubic interpolation.
        texel_m: size of a texel.
    """

    grey: Real
    texel_m: float

    @classmethod
    def noise(
        cls,
        rng: np.random.Generator,
        focal_px: float,
        farthest_m: float,
        tile_m: float,
        grey: float,
    ) -> _Texture:
        """Return noise of two grains: the finest that ``farthest_m`` allows, and 4 times that."""
        texel_m = _GRAIN_PX * farthest_m / focal_px / _GRAIN_TEXELS
        size = min(max(64, round(tile_m / texel_m)), _MAX_TEXELS)
        waves = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
        white = np.fft.rfft2(rng.standard_normal((size, size)))
        total = np.zeros((size, size))
        for grain in (_GRAIN_TEXELS, 4 * _GRAIN_TEXELS):
            smooth = np.fft.irfft2(
                white * np.exp(-2 * (math.pi * grain * waves) ** 2), (size, size)
            )
            total += smooth / smooth.std()
        tile = (grey + _CONTRAST * np.tanh(total / 3)).astype(np.float32)
        return cls(np.pad(tile, 2, mode="wrap"), texel_m)

    def look_up(self, right_m: NDArray[np.float64], down_m: NDArray[np.float64]) -> Real:
        """Return the grey (rows, columns) at places (columns,) and (rows, columns), in m."""
        size = len(self.grey) - 4
        down = ((down_m / self.texel_m - 0.5) % size + 2).astype(np.float32)
        right = ((right_m / self.texel_m - 0.5) % size + 2).astype(np.float32)
        right = np.broadcast_to(right, down.shape)
        return cv2.remap(self.grey, right, down, cv2.INTER_CUBIC)  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class _Plane:
    """Where a camera's pixels meet the plane x = const.

    Attributes:
        depth_m: (width,) depth of each column.
        y_m, y_edges_m: (width,) and (width + 1,) places of column centres and of their edges.
        z_m, z_edges_m: (height, width) and (height + 1, width) heights of rows and their edges.
    """

    depth_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    y_edges_m: NDArray[np.float64]
    z_m: NDArray[np.float64]
    z_edges_m: NDArray[np.float64]

    @classmethod
    def seen(cls, pose: FloorPose, camera: SceneCamera, x_m: float) -> _Plane:
        """Cast the rays of all columns and rows."""
        eye = camera.eye(pose)

        def cast(u_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            rays = camera.rays(pose, u_px)
            depth_m = (x_m - eye[0]) / rays[:, 0]
            return depth_m, eye[1] + depth_m * rays[:, 1]

        u_edges = np.arange(camera.width + 1, dtype=np.float64) - 0.5
        v_edges = np.arange(camera.height + 1, dtype=np.float64) - 0.5
        depth_m, y_m = cast(u_edges[:-1] + 0.5)
        return cls(
            depth_m=depth_m,
            y_m=y_m,
            y_edges_m=cast(u_edges)[1],
            z_m=EYE_HEIGHT_M + camera.upward(v_edges[:-1] + 0.5)[:, None] * depth_m,
            z_edges_m=EYE_HEIGHT_M + camera.upward(v_edges)[:, None] * depth_m,
        )


def _cover(edges_m: NDArray[np.float64], low_m: float, high_m: float) -> NDArray[np.float64]:
    """Return the share of each interval, between edges next on axis 0, that is in low..high."""
    share: NDArray[np.float64] = np.diff(edges_m.clip(low_m, high_m), axis=0) / np.diff(
        edges_m, axis=0
    )
    return share


def _span(covered: NDArray[np.float64]) -> slice:
    """Return the slice from the first to the last place that is covered at all."""
    places = np.flatnonzero(covered)
    return slice(int(places[0]), int(places[-1]) + 1) if len(places) else slice(0, 0)
