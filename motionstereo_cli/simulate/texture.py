"""Periodic pictures, prefiltered so that they do not shimmer at any distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

#: Texels of the neighbouring period around each level, for linear interpolation.
_PAD = 1


@dataclass(frozen=True, slots=True)
class Texture:
    """A periodic grey picture, averaged over blocks of 2^i x 2^j texels for all i and j (a ripmap).

    A surface at a grazing angle needs blocks much longer than wide.

    Attributes:
        levels: float32, all levels side by side.
        rows, columns: where each level begins in ``levels``, in texels.
        height, width: size of the picture in texels, powers of two.
        solid: (height, width) bool, where the picture is not a hole; None if it has none.
    """

    levels: Real
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
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

    @property
    def holes(self) -> NDArray[np.bool_]:
        """(height, width), True where there is a hole; (0, 0) where there is none."""
        return np.zeros((0, 0), bool) if self.solid is None else ~self.solid


def _begins(size: int) -> NDArray[np.intp]:
    """Return where the levels of a side begin, their own first texel."""
    sizes = [2 * _PAD + (size >> level) for level in range(size.bit_length())]
    return np.cumsum([0, *sizes[:-1]]).astype(np.intp) + _PAD


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
        rng: random generator.
        shape: rows and columns.
        finest, coarsest: range of its wavelengths in texels.
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
