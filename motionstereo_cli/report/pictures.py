"""Pictures embedded in a page."""

from __future__ import annotations

import base64
import dataclasses
import math
import os
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

import av
import cv2
import numpy as np

from motionstereo_cli.files.reading import MAX_PIXELS, real
from motionstereo_cli.files.video import opened_result
from motionstereo_cli.sinks.scale import measured_ends

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.sinks.read_back import Maps
    from motionstereo_cli.sinks.scale import DepthScale

_JPEG_QUALITY = 80

#: Maximum number of images and columns of a histogram.
_MAX_IMAGES, _COLUMNS = 60, 48

#: About how many pixels are counted at most.
_MAX_COUNTED = 2_000_000


class Picture(NamedTuple):
    """A picture as data of the page.

    Attributes:
        uri: ``data:`` address of a JPEG or PNG.
        width, height: size in px.
    """

    uri: str
    width: int
    height: int


def poster(
    video: Path, within: Path, time_s: float | None, *, max_width: int, rows: int | None = None
) -> Picture | None:
    """Return the frame of a video at a time, None if it cannot be decoded.

    Args:
        video: the file.
        within: a folder that it has to lie in.
        time_s: the time; beyond the end the last frame is taken. None: the middle.
        max_width: maximum width in px; wider images are scaled down.
        rows: number of pixel rows to show, from the top; None = all.
    """
    try:
        image = _frame_at(video, within, time_s)
    except MemoryError:
        raise
    except Exception:  # whatever FFmpeg and PyAV make of a damaged one
        return None
    return None if image is None else encoded(image[:rows], max_width)


def address_of(file: Path, page: Path) -> str:
    """Return a file's address relative to the page."""
    try:
        relative = os.path.relpath(file, page.parent)
    except ValueError:  # another drive of Windows
        return real(file).as_uri()
    return quote(relative.replace(os.sep, "/"))


def encoded(image: NDArray[np.uint8], max_width: int, suffix: str = ".jpg") -> Picture:
    """Return an RGB or grey image as a picture of the page.

    Args:
        image: (height, width, 3) or (height, width) uint8.
        max_width: maximum width in px; wider images are scaled down.
        suffix: .jpg or .png.
    """
    height, width = image.shape[:2]
    if width > max_width:
        size = max_width, max(1, round(height * max_width / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    bgr = image[..., ::-1] if image.ndim == 3 else image
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if suffix == ".jpg" else []
    _, content = cv2.imencode(suffix, np.ascontiguousarray(bgr), quality)
    kind = {".jpg": "jpeg", ".png": "png"}[suffix]
    text = base64.b64encode(content.tobytes()).decode()
    return Picture(f"data:image/{kind};base64,{text}", image.shape[1], image.shape[0])


def height_of(video: Path, within: Path) -> int | None:
    """Return the height of a video in px, None if it cannot be opened; as :func:`poster`."""
    try:
        with opened_result(video, within) as container:
            return int(container.streams.video[0].height)
    except MemoryError:
        raise
    except Exception:  # whatever FFmpeg and PyAV make of a damaged one
        return None


def _frame_at(video: Path, within: Path, time_s: float | None) -> NDArray[np.uint8] | None:
    with opened_result(video, within) as container:
        stream = container.streams.video[0]
        if stream.width * stream.height > MAX_PIXELS:
            return None
        stream.codec_context.thread_count = 1
        base = stream.time_base or Fraction(1, 1)
        if time_s is None:
            time_s = (container.duration or 0) / av.time_base / 2
        wanted = round(Fraction(time_s) / base)
        container.seek(max(wanted, 0), stream=stream)
        last = None
        for frame in container.decode(stream):
            last = frame
            if frame.pts is not None and frame.pts >= wanted:
                break
        return None if last is None else np.asarray(last.to_ndarray(format="rgb24"), np.uint8)


class Histogram(NamedTuple):
    """A histogram of depth, or of disparity where there is no rig.

    Attributes:
        scale: its columns are of equal width on it; its ends fit what is counted.
        shares: of all known pixels in each column, 0..1, nearest first.
        images: how many were counted.
        median: of all known pixels, in the unit of the scale.
    """

    scale: DepthScale
    shares: list[float]
    images: int
    median: float


def histogram(maps: Maps, scale: DepthScale) -> Histogram | None:
    """Return the histogram of some images, None where no pixel is known.

    Args:
        maps: the images; of many, evenly spaced ones are counted, and of these some pixels.
        scale: that of the run.
    """
    numbers = sorted(maps.files)
    some = numbers[:: max(1, -(-len(numbers) // _MAX_IMAGES))]
    known = [np.empty(0, np.float32)]
    for number in some:
        values = maps.read(number)
        step = math.ceil(math.sqrt(values.size * len(some) / _MAX_COUNTED))
        values = values[::step, ::step]
        values = values[np.isfinite(values)]
        if maps.kind == "disparity":
            values = values + np.float32(scale.doffs)
        elif scale.px_m:
            values = np.float32(scale.px_m) / values
        known.append(values[values > 0])
    nearness_px = np.concatenate(known)
    ends = measured_ends(nearness_px, scale.px_m)
    if ends is None:
        return None
    px = [scale.px_m / end if scale.px_m else end for end in ends]
    own = dataclasses.replace(scale, near_px=px[0], far_px=px[1])
    counts = np.histogram(nearness_px, np.geomspace(px[1], px[0], _COLUMNS + 1))[0][::-1]
    median_px = float(np.median(nearness_px))
    return Histogram(
        own,
        (counts / nearness_px.size).tolist(),
        len(some),
        scale.px_m / median_px if scale.px_m else median_px,
    )
