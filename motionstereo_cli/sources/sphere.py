"""Images whose rows and columns are angles, and the pinhole image in their middle."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Angle that the pinhole image spans, in degrees.
PINHOLE_DEG = 90


class Sphere(NamedTuple):
    """Which angles a view spans, in degrees: 0, 0 is straight ahead, right and down are positive.

    Attributes:
        kind: ``equirectangular`` (columns are longitudes, rows latitudes), or another, of which
            the angles are not told (all 0).
        left, right, top, bottom: longitudes and latitudes of the edges.
    """

    kind: str
    left: float
    right: float
    top: float
    bottom: float

    @property
    def projectable(self) -> bool:
        """Whether the view holds the whole pinhole image."""
        half = PINHOLE_DEG / 2
        return min(-self.left, self.right, -self.top, self.bottom) >= half

    def __str__(self) -> str:
        """Return it in words."""
        if not self.right > self.left:
            return self.kind
        across, down = self.right - self.left, self.bottom - self.top
        return f"{self.kind}, {across:.4g}x{down:.4g} degrees"


class Pinhole:
    """The pinhole image straight ahead in an equirectangular view, as sharp as that is there.

    A ray (x, y, 1) has longitude atan(x) and latitude atan(y / sqrt(x^2 + 1)).

    Args:
        sphere: which angles the view spans.
        width, height: size of the view in px.

    Attributes:
        size: width and height of the pinhole image in px.
        focal_px: its focal length in px; its principal point is its middle.
    """

    def __init__(self, sphere: Sphere, width: int, height: int) -> None:
        tangent = math.tan(math.radians(PINHOLE_DEG / 2))
        px_per_rad = width / math.radians(sphere.right - sphere.left)
        self.size = (2 * round(px_per_rad * tangent), 2 * round(px_per_rad * tangent))
        self.focal_px = self.size[0] / 2 / tangent
        middle = np.arange(self.size[0]) - (self.size[0] - 1) / 2
        x, y = np.meshgrid(middle / self.focal_px, middle / self.focal_px)
        across = np.degrees(np.arctan(x))
        down = np.degrees(np.arctan(y / np.sqrt(x**2 + 1)))
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] = (
            _place(across, sphere.left, sphere.right, width),
            _place(down, sphere.top, sphere.bottom, height),
        )

    def __call__(self, view: Grey) -> Grey:
        """Return the pinhole image of a view, (height, width) uint8."""
        return np.asarray(cv2.remap(view, *self._maps, cv2.INTER_LINEAR), np.uint8)


def _place(
    angle: NDArray[np.float64], begin: float, end: float, length: int
) -> NDArray[np.float32]:
    """Return the column or row, in px, at an angle between those of two edges."""
    return ((angle - begin) / (end - begin) * length - 0.5).astype(np.float32)
