"""Textures of a street: noise with the statistics of photographs, and shapes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.texture import Texture, noise

_FRONTS, _CROWNS = 4, 3

Picture = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Paints:
    """All textures of a street; of several, one is taken at random."""

    asphalt: Texture
    slabs: Texture
    grass: Texture
    stone: Texture
    line: Texture
    shade: Texture
    hedge: Texture
    bark: Texture
    metal: Texture
    tiles: Texture
    woods: Texture
    sky: Texture
    fronts: tuple[Texture, ...]
    crowns: tuple[Texture, ...]
    car_side: Texture
    car_end: Texture
    car_glass: Texture
    car_top: Texture


def paints(rng: np.random.Generator) -> Paints:
    """Return the textures of a seed."""

    def plain(size: int, tone: float, contrast: float, **kind: float) -> Texture:
        return Texture.of(_toned(noise(rng, (size, size), **kind), tone, contrast))

    return Paints(
        asphalt=Texture.of(_asphalt(rng)),
        slabs=Texture.of(_slabs(rng)),
        grass=plain(512, 95, 60, finest=2.5, slope=0.7),
        stone=plain(128, 165, 40, finest=2.5, slope=0.8),
        line=plain(128, 215, 30, finest=3),
        shade=Texture.of(_toned(noise(rng, (256, 256)), 48, 22), noise(rng, (256, 256)) > -0.2),
        hedge=plain(256, 70, 60, finest=2.5, slope=0.8),
        bark=plain(128, 75, 50, finest=2.5, slope=0.8),
        metal=plain(128, 110, 30, finest=4),
        tiles=Texture.of(_tiles(rng)),
        woods=_woods(rng),
        sky=Texture.of(_sky(rng)),
        fronts=tuple(Texture.of(_front(rng)) for _ in range(_FRONTS)),
        crowns=tuple(_crown(rng) for _ in range(_CROWNS)),
        car_side=Texture.of(_car_side(rng)),
        car_end=Texture.of(_car_end(rng)),
        car_glass=Texture.of(_car_glass(rng)),
        car_top=plain(128, 120, 25, finest=20, slope=1.5),
    )


def _toned(grain: Picture, tone: float, contrast: float) -> Picture:
    """Return grain as grey levels about a tone; none is far beyond ``contrast`` from it."""
    toned: Picture = (tone + contrast * np.tanh(grain / 2)).clip(0, 255)
    return toned


def _asphalt(rng: np.random.Generator) -> Picture:
    grey = _toned(noise(rng, (512, 512), finest=2.5, slope=0.6), 105, 45)
    grey += 18 * np.tanh(noise(rng, (512, 512), finest=20, slope=1.5))
    # Cracks run where another noise is near 0.
    cracks = np.abs(noise(rng, (512, 512), finest=6, slope=1.8)) < 0.012
    grey[cracks] -= 35
    return grey.clip(0, 255)


def _slabs(rng: np.random.Generator) -> Picture:
    """Return slabs of 32 texels with joints."""
    tones = np.kron(rng.uniform(-14, 14, (16, 16)), np.ones((32, 32)))
    grey = _toned(noise(rng, (512, 512), finest=2.5, slope=0.8), 150, 30) + tones
    joint = np.arange(512) % 32 < 2
    grey[joint] -= 50
    grey[:, joint] -= 50
    return grey.clip(0, 255)


def _tiles(rng: np.random.Generator) -> Picture:
    """Return a roof: rows of 16 texels, darker at their lower end."""
    rows = np.arange(256)[:, None] % 16
    grain = _toned(noise(rng, (256, 256), finest=2.5, slope=0.8), 100, 40)
    grain += 6 * (rows < 3) - 30 * (rows > 12)
    return grain.clip(0, 255)


def _front(rng: np.random.Generator) -> Picture:
    """Return a house's front, 512 x 1024 texels: plaster or bricks, windows, a door."""
    grey = _toned(noise(rng, (512, 1024), finest=2.2, slope=0.9), rng.uniform(120, 190), 32)
    if rng.random() < 0.5:
        rows = np.arange(512)[:, None]
        shift = (rows // 8 % 2) * 12
        joint = (rows % 8 < 1) | ((np.arange(1024) + shift) % 24 < 1)
        grey -= 32 * joint
        grey += np.kron(rng.uniform(-16, 16, (64, 64)), np.ones((8, 16)))
    count = int(rng.integers(3, 6))
    pitch, wide = 1024 / count, int(rng.uniform(0.35, 0.6) * 1024 / count)
    door = int(rng.integers(count))
    for number in range(count):
        left = int((number + 0.5) * pitch - wide / 2)
        _window(grey, rng, left, 70, wide, 130)
        if number == door:
            grey[300:512, left : left + 76] = rng.uniform(35, 90)
            grey[312:500, left + 10 : left + 66] += 40 * np.tanh(noise(rng, (188, 56)))
        else:
            _window(grey, rng, left, 300, wide, 130)
    return grey.clip(0, 255)


def _window(
    grey: Picture, rng: np.random.Generator, left: int, top: int, wide: int, high: int
) -> None:
    """Paint a window and its reflection, in place."""
    grey[top - 8 : top + high + 8, left - 8 : left + wide + 8] = 225
    pane = noise(rng, (high, wide), finest=6, slope=1.3)
    grey[top : top + high, left : left + wide] = _toned(pane, rng.uniform(40, 80), 45)
    grey[top : top + high, left + wide // 2 - 3 : left + wide // 2 + 3] = 215
    grey[top + high + 8 : top + high + 14, left - 12 : left + wide + 12] = 80


def _crown(rng: np.random.Generator) -> Texture:
    """Return a tree's crown: leaves with gaps in the shape of a ball."""
    v, u = (np.mgrid[:256, :256] - 127.5) / 128
    ragged = np.hypot(u, v) + 0.16 * noise(rng, (256, 256), finest=16, slope=1.2)
    gaps = noise(rng, (256, 256), finest=5, slope=0.8) > -1.1
    leaves = noise(rng, (256, 256), finest=2.5, slope=0.7)
    return Texture.of(_toned(leaves - 0.8 * v, 88, 70), (ragged < 0.85) & gaps)


def _woods(rng: np.random.Generator) -> Texture:
    """Return a row of trees far from the road, ragged above."""
    grain = noise(rng, (256, 512), finest=2.5, slope=0.9)
    top = 60 + 35 * noise(rng, (1, 512), finest=24, slope=1)[0]
    return Texture.of(_toned(grain, 75, 55), np.arange(256)[:, None] > top)


def _sky(rng: np.random.Generator) -> Picture:
    """Return a quarter of the horizon, 512 x 1024 texels: hills below, clouds above."""
    down = np.linspace(0, 1, 512)[:, None]
    clouds = noise(rng, (512, 1024), finest=12, slope=1.3)
    grey = 205 + 45 * down + 30 * clouds
    height = 12 + 5 * noise(rng, (1, 1024), finest=30, slope=1.2)[0]
    hills = np.arange(512)[:, None] > 512 - height
    grey[hills] = _toned(noise(rng, (512, 1024), finest=3), 135, 25)[hills]
    return grey.clip(0, 255)


def _car_side(rng: np.random.Generator) -> Picture:
    """Return the lower half of a car from the side, 64 x 512 texels, with its wheels."""
    down = np.linspace(0, 1, 64)[:, None]
    grey = 140 - 50 * down + 12 * noise(rng, (64, 512), finest=20, slope=1.3)
    grey[:, [150, 151, 270, 271, 380]] -= 70  # doors
    grey[14:18, [*range(170, 190), *range(290, 310)]] += 50  # handles
    grey[54:] = 25
    for middle in (95, 420):
        cv2.circle(grey, (middle, 46), 34, 12.0, -1)
        cv2.circle(grey, (middle, 46), 20, 120.0, -1)
        cv2.circle(grey, (middle, 46), 7, 60.0, -1)
    return grey.clip(0, 255)


def _car_end(rng: np.random.Generator) -> Picture:
    """Return the lower half of a car from behind, 64 x 128 texels: lights, plate, bumper."""
    grey = 130 + 12 * noise(rng, (64, 128), finest=16, slope=1.3)
    for left in (4, 104):
        grey[8:24, left : left + 20] = 60
        grey[11:21, left + 4 : left + 12] = 200
    grey[24:36, 44:84] = 225
    grey[27:33, 48:80:4] = 30
    grey[42:48] -= 50
    grey[56:] = 25
    return grey.clip(0, 255)


def _car_glass(rng: np.random.Generator) -> Picture:
    """Return a car's windows from any side, 64 x 128 texels: frame and glass."""
    grey = np.full((64, 128), 120.0)
    glass = _toned(noise(rng, (64, 128), finest=8, slope=1.3), 55, 50)
    grey[8:60, 8:60], grey[8:60, 68:120] = glass[8:60, 8:60], glass[8:60, 68:120]
    return grey
