"""Cards, slanted and thin ones among them, that overlap at many depths before a smooth wall.

The seed determines places, sizes, slants, paths and textures. Textures are fine, coarse,
photograph-like or repetitive; that of the wall changes so slowly that only the memory tells its
place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, SceneCamera, View
from motionstereo_cli.simulate.surfaces import Quadrangle, rectangle, render
from motionstereo_cli.simulate.texture import Texture, noise

WALL_M = 6.5

_CARDS, _STICKS = 9, 3
#: Sizes and paths are shares of what the camera sees across at a card's depth.
_CARD_SHARES, _STICK_SHARES = (0.12, 0.34), (0.008, 0.02)
_NEAREST_M, _FARTHEST_M = 1.4, 5.0
_WALL_TEXELS = 512
#: A card's texels for each pixel of its size.
_TEXELS_PER_PX = 1.25


@dataclass(frozen=True, slots=True)
class _Card:
    """A card that swings about its place.

    Attributes:
        middle_m: (3,) the middle of its path.
        swing_m: (3,) from there to the end of its path.
        period_s: of the swing.
        phase_rad: of the swing at time 0.
        right_m, down_m: (3,) its sides.
        texture, texel_m: its picture.
    """

    middle_m: NDArray[np.float64]
    swing_m: NDArray[np.float64]
    period_s: float
    phase_rad: float
    right_m: NDArray[np.float64]
    down_m: NDArray[np.float64]
    texture: Texture
    texel_m: float

    def at(self, time_s: float) -> Quadrangle:
        """Return the card as it is at a time."""
        swing = math.sin(self.phase_rad + math.tau * time_s / self.period_s)
        corner = self.middle_m + swing * self.swing_m - (self.right_m + self.down_m) / 2
        return rectangle(corner, self.right_m, self.down_m, self.texture, texel_m=self.texel_m)


class Layers:
    """The cards and the wall.

    Args:
        camera: a camera of the rig: cards fit what it sees.
        seed: seed of everything.
    """

    def __init__(self, camera: SceneCamera, seed: int = 0) -> None:
        rng = np.random.default_rng([seed, 0])
        self._across = camera.width / camera.focal_px
        self._up = camera.height / camera.focal_px
        self._texel = 1 / camera.focal_px  # of one pixel, a metre away
        # The smallest power of two that the largest card does not repeat.
        self._texels = 1 << math.ceil(math.log2(_CARD_SHARES[1] * camera.width * _TEXELS_PER_PX))
        self._wall = self._make_wall(rng)
        near = np.linspace(1 / _FARTHEST_M, 1 / _NEAREST_M, _CARDS + _STICKS)
        shares = [_STICK_SHARES if i % 4 == 1 else _CARD_SHARES for i in range(len(near))]
        self._cards = [
            self._make_card(rng, 1 / nearness, sizes, kind)
            for nearness, sizes, kind in zip(near, shares, rng.permutation(len(near)), strict=True)
        ]

    def render(self, pose: FloorPose, camera: SceneCamera, time_s: float) -> View:
        """Return the view of ``camera`` from ``pose``, which must face the wall, at ``time_s``."""
        cards = [card.at(time_s) for card in self._cards]
        return render([self._wall, *cards], pose, camera)

    def _make_wall(self, rng: np.random.Generator) -> Quadrangle:
        smooth = noise(rng, (_WALL_TEXELS, _WALL_TEXELS), finest=32, slope=1.5)
        texture = Texture.of(130 + 85 * np.tanh(smooth / 2))
        yaw_rad = rng.uniform(-0.3, 0.3)
        right = 40 * np.array([math.sin(yaw_rad), -math.cos(yaw_rad), 0])
        middle = np.array([WALL_M, 0, EYE_HEIGHT_M])
        down = np.array([0, 0, -20.0])
        texel_m = WALL_M * self._texel
        return rectangle(middle - (right + down) / 2, right, down, texture, texel_m=texel_m)

    def _make_card(
        self, rng: np.random.Generator, depth_m: float, shares: tuple[float, float], kind: int
    ) -> _Card:
        across_m, up_m = self._across * depth_m, self._up * depth_m
        yaw_rad, roll_rad = rng.uniform(-0.9, 0.9) * (rng.random() < 0.5), rng.uniform(-0.5, 0.5)
        width_m = rng.uniform(*shares) * across_m
        height_m = rng.uniform(*_CARD_SHARES) * across_m
        level = np.array([math.sin(yaw_rad), -math.cos(yaw_rad), 0])
        upright = np.array([0, 0, -1.0])
        right = math.cos(roll_rad) * level + math.sin(roll_rad) * upright
        down = math.cos(roll_rad) * upright - math.sin(roll_rad) * level
        middle = np.array(
            [
                depth_m,
                rng.uniform(-0.4, 0.4) * across_m,
                EYE_HEIGHT_M + rng.uniform(-0.4, 0.4) * up_m,
            ]
        )
        swing = np.array([0, rng.uniform(0.15, 0.5) * across_m, rng.uniform(-0.1, 0.1) * up_m])
        if rng.random() < 0.3:
            swing = np.array([0.2 * depth_m, 0, 0])
        return _Card(
            middle_m=middle,
            swing_m=swing,
            period_s=rng.uniform(2.5, 6),
            phase_rad=rng.uniform(0, math.tau),
            right_m=width_m * right,
            down_m=height_m * down,
            texture=_paint(rng, kind, self._texels),
            texel_m=depth_m * self._texel / _TEXELS_PER_PX,
        )


def _paint(rng: np.random.Generator, kind: int, texels: int) -> Texture:
    """Return a texture: fine, coarse, as in photographs, or one that repeats itself."""
    shape = texels, texels
    if kind % 4 == 0:
        grain = noise(rng, shape, finest=3, coarsest=8, slope=0)
    elif kind % 4 == 1:
        grain = noise(rng, shape, finest=10, slope=1)
    elif kind % 4 == 2:
        grain = noise(rng, shape, finest=2.5, slope=1)
    else:
        period = min(2 ** int(rng.integers(4, 6)), texels)  # 13 or 26 px
        tile = noise(rng, (period, period), finest=4, slope=1)
        grain = np.tile(tile, (texels // period, texels // period))
        grain = grain + 0.25 * noise(rng, shape, finest=3, slope=1)
    return Texture.of(rng.uniform(95, 160) + 85 * np.tanh(grain / 2))
