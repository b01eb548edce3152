"""Flat textured pieces in space, and what a camera sees of them.

Every pixel is divided into 3 x 3 samples. On each the nearest piece wins; a pixel's grey is the
mean of the pieces' textures by their shares, its depth that of the sample in its middle. Along an
image, the reciprocal of a plane's depth, its texture's coordinates over depth, and the side of an
edge on which a ray passes are all linear: see :class:`_Seen`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, Camera, FloorPose, View
from motionstereo_cli.simulate.texture import Texture

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

_SAMPLES = 3
#: What is nearer along the optical axis is not seen.
_NEAR_M = 0.05


@dataclass(frozen=True, slots=True)
class Surface:
    """A convex flat polygon with a texture.

    Attributes:
        corners_m: (n, 3) corners in order, in the world, in m.
        origin_m: (3,) where the texture's upper left corner is.
        right_m, down_m: (3,) from one texel to the next; at right angles.
        texture: its picture.
        gain: factor of the texture's grey, its light.
    """

    corners_m: Vector
    origin_m: Vector
    right_m: Vector
    down_m: Vector
    texture: Texture
    gain: float = 1.0


def rectangle(
    corner_m: Sequence[float] | Vector,
    right_m: Sequence[float] | Vector,
    down_m: Sequence[float] | Vector,
    texture: Texture,
    *,
    texel_m: float | None = None,
    gain: float = 1.0,
) -> Surface:
    """Return a rectangle.

    Args:
        corner_m: (3,) its upper left corner.
        right_m, down_m: (3,) its sides from there.
        texture: its picture, which fills it or, with ``texel_m``, is repeated.
        texel_m: size of a texel in m.
        gain: factor of the texture's grey.
    """
    corner, right, down = (np.asarray(v, float) for v in (corner_m, right_m, down_m))
    sides = np.linalg.norm(right), np.linalg.norm(down)
    if texel_m is None:
        texels: tuple[float, float] = texture.width, texture.height
    else:
        texels = float(sides[0]) / texel_m, float(sides[1]) / texel_m
    corners = np.array([corner, corner + right, corner + right + down, corner + down])
    return Surface(corners, corner, right / texels[0], down / texels[1], texture, gain)


def render(surfaces: Sequence[Surface], pose: FloorPose, camera: Camera) -> View:
    """Return what a camera sees of surfaces; black and endlessly far where there is none."""
    seen = [one for one in (_see(item, pose, camera) for item in surfaces) if one]
    height, width = camera.height, camera.width
    nearness = np.zeros((height * _SAMPLES, width * _SAMPLES))
    owner = np.full(nearness.shape, -1, np.int32)
    for number, one in enumerate(seen):
        one.enter(nearness, owner, number)
    grey = np.zeros((height, width), np.float32)
    for number in np.unique(owner):
        if number >= 0:
            seen[number].paint(grey, owner, number)
    middle = slice(_SAMPLES // 2, None, _SAMPLES)
    with np.errstate(divide="ignore"):
        depth_m = (1 / nearness[middle, middle]).astype(np.float32)
    return View(grey, depth_m)


@dataclass(frozen=True, slots=True)
class _Seen:
    """A surface before a camera. Linear forms are (a, b, c) for a + b * u + c * v, u and v in px.

    Attributes:
        surface: the surface.
        nearness: reciprocal of its plane's depth.
        right, down: its texture's coordinates, in texels, times ``nearness``.
        edges: one for each edge, positive on the polygon's side.
        rows, columns: pixels outside of which nothing of it is seen.
    """

    surface: Surface
    nearness: Vector
    right: Vector
    down: Vector
    edges: Vector
    rows: slice
    columns: slice

    def enter(self, nearness: NDArray[np.float64], owner: NDArray[np.int32], number: int) -> None:
        """Enter its samples that nothing nearer hides, in place."""
        u, v = (
            (np.arange(span.start * _SAMPLES, span.stop * _SAMPLES) + 0.5) / _SAMPLES - 0.5
            for span in (self.columns, self.rows)
        )
        area = _samples(self.rows), _samples(self.columns)
        near = _value(self.nearness, u, v)
        wins = near > nearness[area]
        for edge in self.edges:
            wins &= _value(edge, u, v) >= 0
        if self.surface.texture.solid is not None:
            row, column = np.nonzero(wins)
            there = near[row, column]
            right, down = (
                (form[0] + form[1] * u[column] + form[2] * v[row]) / there
                for form in (self.right, self.down)
            )
            wins[row, column] = self.surface.texture.is_solid(right, down)
        nearness[area][wins] = near[wins]
        owner[area][wins] = number

    def paint(self, grey: NDArray[np.float32], owner: NDArray[np.int32], number: int) -> None:
        """Add its share of each pixel's grey, in place."""
        mine = owner[_samples(self.rows), _samples(self.columns)] == number
        rows, columns = (side // _SAMPLES for side in mine.shape)
        share = mine.reshape(rows, _SAMPLES, columns, _SAMPLES).mean(axis=(1, 3))
        row, column = np.nonzero(share)
        u, v = column + self.columns.start, row + self.rows.start

        def at(form: Vector) -> NDArray[np.float64]:
            value: NDArray[np.float64] = form[0] + form[1] * u + form[2] * v
            return value

        near = np.maximum(at(self.nearness), 1e-6)
        places, sizes = [], []
        for form in (self.right, self.down):
            place = at(form) / near
            # The derivative of a ratio of linear forms.
            change = (form[i] - place * self.nearness[i] for i in (1, 2))
            places.append(place)
            sizes.append(np.hypot(*change) / near)
        seen = self.surface.texture.look_up(*places, *sizes)
        grey[v, u] += (self.surface.gain * share[row, column] * seen).astype(np.float32)


def _see(surface: Surface, pose: FloorPose, camera: Camera) -> _Seen | None:
    """Return a surface as a camera sees it; None if it does not."""
    eye = np.array([*camera.eye(pose), EYE_HEIGHT_M])
    axes = np.array([[*pose.forward, 0], [*pose.left, 0], [0, 0, 1]])
    corners = (surface.corners_m - eye) @ axes.T
    spans = _spans(corners, camera)
    if spans is None:
        return None
    right, down = axes @ surface.right_m, axes @ surface.down_m
    origin = axes @ (surface.origin_m - eye)
    normal = np.cross(right, down)
    distance = normal @ origin
    if abs(distance) < 1e-9 * np.linalg.norm(normal):
        return None  # edge-on
    # A pixel's ray, one metre ahead long, is linear in u and v.
    f = camera.focal_px
    ray = np.array([[1, 0, 0], [camera.cx / f, -1 / f, 0], [camera.cy / f, 0, -1 / f]])
    nearness = normal @ ray / distance

    def texels(axis: Vector) -> Vector:
        form: Vector = (axis @ ray - nearness * (origin @ axis)) / (axis @ axis)
        return form

    sides = np.cross(corners, np.roll(corners, -1, axis=0))
    sides *= np.sign(sides @ corners.mean(axis=0))[:, None]
    return _Seen(surface, nearness, texels(right), texels(down), sides @ ray, *spans)


def _spans(corners: Vector, camera: Camera) -> tuple[slice, slice] | None:
    """Return the rows and columns that a polygon may cover; None if none.

    Args:
        corners: (n, 3) in the camera's frame: ahead, left, up.
        camera: the camera.
    """
    following = np.roll(corners, -1, axis=0)
    ahead, after = corners[:, 0], following[:, 0]
    crosses = (ahead < _NEAR_M) != (after < _NEAR_M)
    share = ((_NEAR_M - ahead[crosses]) / (after - ahead)[crosses])[:, None]
    cut = corners[crosses] + share * (following - corners)[crosses]
    kept = np.vstack([corners[ahead >= _NEAR_M], cut])
    if not len(kept):
        return None
    spans = []
    for axis, centre, size in ((2, camera.cy, camera.height), (1, camera.cx, camera.width)):
        place = (centre - camera.focal_px * kept[:, axis] / kept[:, 0]).clip(-1, size)
        low, high = max(int(place.min()), 0), min(int(place.max()) + 2, size)
        if low >= high:
            return None
        spans.append(slice(low, high))
    return spans[0], spans[1]


def _samples(pixels: slice) -> slice:
    return slice(pixels.start * _SAMPLES, pixels.stop * _SAMPLES)


def _value(form: Vector, u: Vector, v: Vector) -> NDArray[np.float64]:
    value: NDArray[np.float64] = (form[0] + form[1] * u) + (form[2] * v)[:, None]
    return value
