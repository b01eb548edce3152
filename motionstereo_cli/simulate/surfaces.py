"""Flat textured surfaces in space, and their rendering.

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

from motionstereo_cli.compiled import surfaces as loops
from motionstereo_cli.simulate.camera import EYE_HEIGHT_M, FloorPose, SceneCamera, View
from motionstereo_cli.simulate.texture import Texture

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

_SAMPLES = 3
#: Nearest visible depth along the optical axis.
NEAR_M = 0.05
#: A plane this close to the camera's centre is seen edge-on.
_EDGE_ON_M = 1e-9


@dataclass(frozen=True, slots=True)
class Quadrangle:
    """A convex flat quadrangle with a texture.

    Attributes:
        corners_m: (4, 3) corners in order, in the world, in m.
        origin_m: (3,) where the texture's upper left corner is.
        right_m, down_m: (3,) from one texel to the next; at right angles.
        texture: its picture.
        gain: factor of the texture's grey, its light.
        mover: number of what moves by itself that it is of, 0 = it stands.
    """

    corners_m: Vector
    origin_m: Vector
    right_m: Vector
    down_m: Vector
    texture: Texture
    gain: float = 1.0
    mover: int = 0


def rectangle(
    corner_m: Sequence[float] | Vector,
    right_m: Sequence[float] | Vector,
    down_m: Sequence[float] | Vector,
    texture: Texture,
    *,
    texel_m: float | None = None,
    gain: float = 1.0,
) -> Quadrangle:
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
    return Quadrangle(corners, corner, right / texels[0], down / texels[1], texture, gain)


def render(surfaces: Sequence[Quadrangle], pose: FloorPose, camera: SceneCamera) -> View:
    """Return the view of surfaces; black at infinite depth elsewhere."""
    seen = _see(surfaces, pose, camera)
    height, width = camera.height, camera.width
    nearness = np.zeros((height * _SAMPLES, width * _SAMPLES))
    owner = np.full(nearness.shape, -1, np.int32)
    for number, one in enumerate(seen):
        one.enter(nearness, owner, number)
    grey = np.zeros((height, width), np.float32)
    for number, samples in enumerate(np.bincount(owner.ravel() + 1, minlength=1)[1:]):
        if samples:
            seen[number].paint(grey, owner, number)
    middle = slice(_SAMPLES // 2, None, _SAMPLES)
    with np.errstate(divide="ignore"):
        depth_m = (1 / nearness[middle, middle]).astype(np.float32)
    numbers = np.array([0, *(one.surface.mover for one in seen)], np.uint8)
    return View(grey, depth_m, numbers[owner[middle, middle] + 1])


@dataclass(frozen=True, slots=True)
class _Seen:
    """A surface before a camera. Linear forms are (a, b, c) for a + b * u + c * v, u and v in px.

    Attributes:
        surface: the surface.
        nearness: reciprocal of its plane's depth.
        right, down: its texture's coordinates, in texels, times ``nearness``.
        edges: one for each edge, positive on the polygon's side.
        bounds: first row and column in which it may be seen, and those after the last, in px.
    """

    surface: Quadrangle
    nearness: Vector
    right: Vector
    down: Vector
    edges: Vector
    bounds: NDArray[np.intp]

    def enter(self, nearness: NDArray[np.float64], owner: NDArray[np.int32], number: int) -> None:
        """Enter its samples that are nearest, in place."""
        forms = self.nearness, self.right, self.down
        holes = self.surface.texture.holes.view(np.uint8)
        loops.enter(nearness, owner, number, self.bounds, *forms, self.edges, holes, 1 / NEAR_M)

    def paint(self, grey: NDArray[np.float32], owner: NDArray[np.int32], number: int) -> None:
        """Add its share of each pixel's grey, in place."""
        texture = self.surface.texture
        picture = texture.levels, texture.rows, texture.columns
        forms = self.nearness, self.right, self.down
        loops.paint(grey, owner, number, self.bounds, *forms, *picture, self.surface.gain)


def _see(surfaces: Sequence[Quadrangle], pose: FloorPose, camera: SceneCamera) -> list[_Seen]:
    """Return the surfaces that may be visible to a camera."""
    eye = np.array([*camera.eye(pose), EYE_HEIGHT_M])
    axes = np.array([[*pose.forward, 0], [*pose.left, 0], [0, 0, 1]])
    corners = (np.array([item.corners_m for item in surfaces]) - eye) @ axes.T
    origin = (np.array([item.origin_m for item in surfaces]) - eye) @ axes.T
    right = np.array([item.right_m for item in surfaces]) @ axes.T
    down = np.array([item.down_m for item in surfaces]) @ axes.T
    normal = np.cross(right, down)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = (normal * origin).sum(axis=1, keepdims=True)
    bounds = _bounds(corners, camera)
    faces = np.flatnonzero(
        (bounds[:, :2] < bounds[:, 2:]).all(axis=1) & (np.abs(distance[:, 0]) > _EDGE_ON_M)
    )

    # A pixel's ray, one metre ahead long, is linear in u and v.
    f = camera.focal_px
    ray = np.array([[1, 0, 0], [camera.cx / f, -1 / f, 0], [camera.cy / f, 0, -1 / f]])
    nearness = normal[faces] @ ray / distance[faces]

    def texels(axis: Vector) -> Vector:
        axis = axis[faces] / (axis[faces] ** 2).sum(axis=1, keepdims=True)
        form: Vector = axis @ ray - nearness * (axis * origin[faces]).sum(axis=1, keepdims=True)
        return form

    across, along = texels(right), texels(down)
    corners = corners[faces]
    sides = np.cross(corners, np.roll(corners, -1, axis=1))
    inward = np.sign(sides @ corners.mean(axis=1)[:, :, None])
    edges = (sides * inward) @ ray
    return [
        _Seen(
            surfaces[int(face)],
            nearness[number],
            across[number],
            along[number],
            edges[number],
            bounds[face],
        )
        for number, face in enumerate(faces)
    ]


def _bounds(corners: Vector, camera: SceneCamera) -> NDArray[np.intp]:
    """Return (n, 4) first row and column that quadrangles may cover, and those after the last.

    Args:
        corners: (n, 4, 3) in the camera's frame: ahead, left, up.
        camera: the camera.
    """
    following = np.roll(corners, -1, axis=1)
    ahead, after = corners[..., :1], following[..., :1]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Where an edge comes from behind the camera it is cut.
        cut = corners + (NEAR_M - ahead) / (after - ahead) * (following - corners)
        crosses = (ahead < NEAR_M) != (after < NEAR_M)
        points = np.concatenate([corners, cut], axis=1)
        kept = np.concatenate([ahead >= NEAR_M, crosses], axis=1)
        size = np.array([camera.height, camera.width])
        places = (
            np.array([camera.cy, camera.cx])
            - camera.focal_px * points[..., :0:-1] / points[..., :1]
        )
    low = np.where(kept, places, np.inf).min(axis=1).clip(0, size)
    high = (np.where(kept, places, -np.inf).max(axis=1) + 2).clip(0, size)
    return np.concatenate([low, high], axis=1).astype(np.intp)
