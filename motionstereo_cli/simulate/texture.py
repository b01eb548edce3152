"""Periodic pictures, averaged beforehand so that no camera distance makes them shimmer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

#: Texels of the neighbouring period around each level, for linear interpolation.
_PAD = 1
_FOLD = 1024


@dataclass(frozen=True, slots=True)
class Texture:
    """A periodic grey picture, averaged over blocks of 2^i x 2^j texels for all i and j (a ripmap).

    A surface that is seen at a grazing angle needs blocks much longer than wide.

    Attributes:
        levels: float32, all levels side by side.
        rows, columns: where each level begins in ``levels``, in texels.
        height, width: size of the picture in texels, powers of two.
        solid: (height, width) bool, where the picture is not a hole; None if it has none.
    """

    levels: Real
    rows: NDArray[np.float64]
    columns: NDArray[np.float64]
    height: int
    width: int
    solid: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, grey: NDArray[np.floating], solid: NDArray[np.bool_] | None = None) -> Texture:
        """Return the texture of a picture whose sides are powers of two."""
        height, width = grey.shape
        across: list[Real] = [grey.astype(np.float32)]
        while across[-1].shape[1] > 1:
            across.append(np.float32(0.5) * (across[-1][:, ::2] + across[-1][:, 1::2]))
        strip = np.hstack([np.pad(level, ((0, 0), (_PAD, _PAD)), mode="wrap") for level in across])
        down: list[Real] = [strip]
        while len(down[-1]) > 1:
            down.append(np.float32(0.5) * (down[-1][::2] + down[-1][1::2]))
        levels = np.vstack([np.pad(level, ((_PAD, _PAD), (0, 0)), mode="wrap") for level in down])
        return cls(levels, _begins(height), _begins(width), height, width, solid)

    def look_up(
        self,
        right: NDArray[np.float64],
        down: NDArray[np.float64],
        right_size: NDArray[np.float64],
        down_size: NDArray[np.float64],
    ) -> Real:
        """Return the mean grey (n,) of blocks.

        Args, each (n,):
            right, down: middles of the blocks in texels.
            right_size, down_size: their sizes in texels.
        """
        total = np.zeros(right.shape, np.float32)
        for column, across, share_across in self._neighbours(right, right_size, self.columns):
            for row, along, share_along in self._neighbours(down, down_size, self.rows):
                seen = _sampled(self.levels, across + column, along + row)
                total += share_across * share_along * seen
        return total

    @staticmethod
    def _neighbours(
        place: NDArray[np.float64], size: NDArray[np.float64], begins: NDArray[np.float64]
    ) -> list[tuple[Real, Real, Real]]:
        """Return beginning, place in it and share of the two levels next to a size."""
        last = len(begins) - 1
        level = np.log2(size.clip(1, 2.0**last))
        lower = np.minimum(level.astype(np.intp), max(last - 1, 0))
        share = (level - lower).astype(np.float32)
        wrapped = place % 2.0**last
        return [
            (
                begins[index].astype(np.float32),
                (wrapped / 2.0**index - 0.5).astype(np.float32),
                weight,
            )
            for index, weight in (
                (lower, 1 - share),
                (np.minimum(lower + 1, last), share),
            )
        ]

    def is_solid(self, right: NDArray[np.float64], down: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return where places in texels are not in a hole."""
        if self.solid is None:
            return np.ones(right.shape, bool)
        row = np.floor(down % self.height).astype(np.intp) % self.height
        column = np.floor(right % self.width).astype(np.intp) % self.width
        found: NDArray[np.bool_] = self.solid[row, column]
        return found


def _sampled(picture: Real, x: Real, y: Real) -> Real:
    """Return a picture (n,) at places (n,), interpolated linearly."""
    # cv2 takes no more than 32766 places in a row.
    folded = -(-len(x) // _FOLD), _FOLD
    seen = cv2.remap(picture, np.resize(x, folded), np.resize(y, folded), cv2.INTER_LINEAR)
    return seen.ravel()[: len(x)]  # type: ignore[return-value]


def _begins(size: int) -> NDArray[np.float64]:
    """Return where the levels of a side begin, their own first texel."""
    sizes = [2 * _PAD + (size >> level) for level in range(size.bit_length())]
    return np.cumsum([0, *sizes[:-1]]).astype(np.float64) + _PAD


def noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    *,
    finest: float = 2.0,
    coarsest: float = math.inf,
    slope: float = 1.0,
) -> NDArray[np.float64]:
    """Return periodic noise of mean 0 and standard deviation 1.

    Args:
        rng: decides on it.
        shape: rows and columns.
        finest, coarsest: its waves are about so long, in texels.
        slope: amplitude falls with frequency to this power: 1 as in photographs (each octave has
            the same contrast), 0 for white noise.
    """
    waves = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1]))
    waves[0, 0] = 1
    gain = waves**-slope * np.exp(-((waves * finest) ** 2) / 2)
    gain *= 1 - np.exp(-((waves * coarsest) ** 2) / 2) if math.isfinite(coarsest) else 1
    gain[0, 0] = 0
    made = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * gain, shape)
    normed: NDArray[np.float64] = made / made.std()
    return normed
