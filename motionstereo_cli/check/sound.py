"""By how much the clocks of two recordings differ, from the sound in both."""

from __future__ import annotations

from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import av
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.sources.container import Container

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Samples per second that are looked at, and for how long, in s.
_RATE = 8000
LISTENED_S = 120

#: The best lag stands out by this factor over all that are further away than this, in s.
_CLEARLY, _NEXT_S = 1.5, 0.02

#: Silence is weaker than this, as a share of full scale.
_SILENCE = 1e-4


class _Sound(NamedTuple):
    """Samples of one channel, (n,) float32, and the time of the first in s."""

    samples: NDArray[np.float32]
    begin_s: float


def sound_shift_s(left: Path, right: Path, max_pixels: int, from_s: float = 0) -> float | None:
    """Return how much later the right recording's times are than the left one's at one moment.

    The lag at which both sounds agree best, found by their generalised cross-correlation with the
    phase transform (PHAT): r = irfft(conj(X) Y / |X Y|).

    Args:
        left, right: the files.
        max_pixels: largest width times height of their images.
        from_s: where to begin to listen, in s from the beginning.

    Returns:
        None where one has no sound, or the sounds do not tell it.
    """
    heard = [_listen(path, max_pixels, from_s) for path in (left, right)]
    if heard[0] is None or heard[1] is None:
        return None
    one, other = heard[0], heard[1]
    if min(float(np.std(each.samples)) for each in (one, other)) < _SILENCE:
        return None
    n, m = len(one.samples), len(other.samples)
    size = 1 << (n + m).bit_length()
    cross = np.conj(np.fft.rfft(one.samples, size)) * np.fft.rfft(other.samples, size)
    agreement = np.fft.irfft(cross / np.maximum(np.abs(cross), 1e-12), size)
    lags = (np.arange(size) + n) % size - n
    best = int(agreement.argmax())
    further = agreement[np.abs(lags - lags[best]) > _NEXT_S * _RATE]
    if agreement[best] < _CLEARLY * further.max():
        return None
    return other.begin_s - one.begin_s + float(lags[best]) / _RATE


def _listen(path: Path, max_pixels: int, from_s: float) -> _Sound | None:
    """Return the sound of a file from some time on; None where it has none."""
    parts: list[NDArray[np.float32]] = []
    begin_s: float | None = None
    try:
        video = Container(path, max_pixels=max_pixels, allow_network=False, track=0)
    except InputError:
        return None
    with closing(video):
        source = video.source
        if not source.streams.audio:
            return None
        track = source.streams.audio[0]
        mono = av.AudioResampler(format="flt", layout="mono", rate=_RATE)
        try:
            if from_s:
                source.seek(round((Fraction(from_s) + video.begin_s) * av.time_base))
            count = 0
            for frame in source.decode(track):
                if begin_s is None:
                    begin_s = frame.time or 0.0
                made: list[Any] = mono.resample(frame)
                parts += [each.to_ndarray().reshape(-1) for each in made]
                count += sum(each.samples for each in made)
                if count >= LISTENED_S * _RATE:
                    break
        except (av.FFmpegError, OSError):
            pass  # what came before is enough, or it is not
    if begin_s is None or not parts:
        return None
    return _Sound(np.concatenate(parts).astype(np.float32), begin_s)
