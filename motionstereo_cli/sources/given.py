"""Disparity that another program found: a folder with a map for each image."""

from __future__ import annotations

import contextlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.maps import SUFFIXES, MapFile, numbered_files, read_map
from motionstereo_cli.files.reading import sha256_of, sha256_of_all
from motionstereo_cli.files.stills import DamagedImageError
from motionstereo_cli.sources.recording import Recording, images
from motionstereo_cli.sources.settings import Box

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Real

#: A gap between two disparities that differ by more than this, in px, is an edge.
_CRACK_PX = 1.0


class GivenDisparity:
    """The maps of a folder, as disparity in px of the frames of a source.

    A map belongs to the image whose file has the same name or, elsewhere, number: that in its
    name, or its place in the recording. Where the numbers are others and the maps are as many as
    the images, they belong together in order. A map that is missing or cannot be used is counted,
    and the frame has no disparity. One map is read ahead.

    Args:
        folder: the maps, as :data:`~motionstereo_cli.files.maps.SUFFIXES` says.
        stream: the recording of the camera whose view they are in.
        view: that camera, ``left`` or ``right``.
        scale: what the maps have for 1 px; 0: values are only scaled with the images.
        camera: in whose view disparity is to be.
        box: part of the whole view that frames show.
        whole, size: width and height in px of the whole view and of frames. Maps are of either.
        max_pixels: largest width times height of a map.

    Attributes:
        whole_numbers: whether the first map holds whole numbers.
        width: its width in px.

    Raises:
        InputError: there are no maps, or their numbers cannot be told.
        SettingsError: they do not belong to these images, by their size or number.
    """

    def __init__(
        self,
        folder: Path,
        stream: Recording,
        view: str,
        scale: float,
        camera: str,
        *,
        box: Box,
        whole: tuple[int, int],
        size: tuple[int, int],
        max_pixels: int,
    ) -> None:
        self._folder, self.view, self.scale, self._camera = folder, view, scale, camera
        self._box, self._whole, self._size = box, whole, size
        self._max_pixels = max_pixels
        self._files = _by_place(folder, stream)
        self._unusable: list[str] = []
        self._missing: list[int] = []
        self._sums: dict[Path, bytes] = {}
        self._changed = 0
        self._ahead: tuple[int, Future[MapFile]] | None = None
        self._last: int | None = None
        self._thread = ThreadPoolExecutor(1, "maps")
        self.whole_numbers, self.width = False, size[0]
        self._check_first()

    def _check_first(self) -> None:
        """Make sure that the first map which can be read is of the size of the images."""
        for path in self._files.values():
            try:
                values = read_map(path, self._max_pixels).values
            except DamagedImageError:
                continue
            if wrong := self._wrong_with(values):
                raise SettingsError(f"--disparity {self._folder}: {path.name} {wrong}")
            self.whole_numbers, self.width = values.dtype.kind in "iu", values.shape[1]
            return
        raise InputError(f"--disparity {self._folder}: none of its maps can be read")

    def _wrong_with(self, values: NDArray[Any]) -> str:
        """Return what is wrong with a map, empty if nothing is."""
        if values.ndim != 2 or values.dtype == np.bool_:
            return "has colours or one bit: give disparity itself, a number for each pixel"
        size = values.shape[::-1]
        if size in (self._whole, self._size):
            return ""
        known = dict.fromkeys(f"{w}x{h}" for w, h in (self._whole, self._size))
        return f"is {size[0]}x{size[1]} but the images are {' or '.join(known)}"

    @property
    def damage(self) -> list[str]:
        """What could not be used so far, one line each."""
        lines = []
        if self._unusable:
            count = images(len(self._unusable)).replace("image", "map")
            lines.append(f"{self._folder}: {count} could not be used, first {self._unusable[0]}")
        if self._missing:
            count = images(len(self._missing))
            lines.append(f"{self._folder}: {count} without a map, the first is {self._missing[0]}")
        if self._changed:
            count = images(self._changed).replace("image", "map")
            lines.append(f"{self._folder}: {count} changed while the run went on")
        return lines

    def sha256(self) -> str:
        """Return the SHA-256 of all maps that can be read, see :func:`sha256_of_all`."""
        for path in self._files.values():
            with contextlib.suppress(OSError):
                self._sums.setdefault(path, bytes.fromhex(sha256_of(path)))
        known = (path for path in self._files.values() if path in self._sums)
        return sha256_of_all((self._sums[path].hex(), path.name) for path in known)

    def of(self, number: int) -> Real:
        """Return the disparity of a frame in px, (height, width) float32, NaN = unknown.

        Args:
            number: place of the image of :attr:`view` in its recording.
        """
        path, ahead = self._files.get(number), self._ahead
        step = number - self._last if self._last is not None else 1
        self._last, self._ahead = number, None
        following = self._files.get(number + step)
        try:
            if path is None:
                self._missing.append(number)
                return self._nothing()
            if ahead is not None and ahead[0] == number:
                found = ahead[1].result()
            else:
                found = read_map(path, self._max_pixels)
        except DamagedImageError as error:
            self._unusable.append(f"{path.name if path else number} ({error})")
            return self._nothing()
        finally:
            if following is not None and step > 0:
                reading = self._thread.submit(read_map, following, self._max_pixels)
                self._ahead = number + step, reading
        self._changed += self._sums.setdefault(path, found.sha256) != found.sha256
        if wrong := self._wrong_with(found.values):
            self._unusable.append(f"{path.name}: it {wrong}")
            return self._nothing()
        return self._made(found.values)

    def close(self) -> None:
        """End what reads ahead."""
        self._thread.shutdown(cancel_futures=True)

    def _nothing(self) -> Real:
        return np.full(self._size[::-1], np.nan, np.float32)

    def _made(self, values: NDArray[Any]) -> Real:
        disparity = values.astype(np.float32)
        if self.scale:
            disparity /= np.float32(self.scale)
            disparity[~((disparity > 0) & np.isfinite(disparity))] = np.nan
        elif self.whole_numbers:
            disparity[values == 0] = np.nan
        width, height = self._size
        if disparity.shape != (height, width):
            box = self._box
            disparity = disparity[box.y : box.y + box.height, box.x : box.x + box.width]
            how = cv2.INTER_NEAREST
            disparity = np.asarray(cv2.resize(disparity, self._size, interpolation=how))
            disparity *= np.float32(width / box.width)
        return disparity if self._camera == self.view else in_other_view(disparity, self.view)


def in_other_view(disparity_px: Real, view: str) -> Real:
    """Return the disparity of one view in that of the other, (height, width) float32.

    Where two points fall on one pixel, the nearer hides the other; what only the other camera sees
    is NaN.

    Args:
        disparity_px: x in the left view minus x in the right one, NaN = unknown.
        view: the camera it is of; in a mirror the right one is the left one.
    """
    if view == "right":
        return np.ascontiguousarray(in_other_view(disparity_px[:, ::-1], "left")[:, ::-1])
    width = disparity_px.shape[1]
    column = np.rint(np.arange(width, dtype=np.float32) - disparity_px)
    row, seen = np.nonzero((column >= 0) & (column < width))
    found = np.full(disparity_px.shape, np.nan, np.float32)
    # Of those that fall on one pixel the last is assigned: the rightmost is the nearest.
    found[row, column[row, seen].astype(np.intp)] = disparity_px[row, seen]
    before, after = found[:, :-2], found[:, 2:]
    crack = np.isnan(found[:, 1:-1]) & (np.abs(before - after) < _CRACK_PX)
    found[:, 1:-1][crack] = ((before + after) / 2)[crack]
    return found


def _by_place(folder: Path, stream: Recording) -> dict[int, Path]:
    """Return the maps by the place of their image in its recording.

    Raises:
        InputError: there are none, or their numbers cannot be told.
        SettingsError: they are not those of these images.
    """
    maps = numbered_files(folder, SUFFIXES)
    places = {name: place for place, name in enumerate(stream.names)}
    by_name = {places[path.stem]: path for path in maps.values() if path.stem in places}
    if by_name:
        return dict(sorted(by_name.items()))
    count = stream.expected_images
    if stream.numbered:
        numbers = {pts: place for place, pts in stream.outline()}
    else:
        numbers = {place: place for place in range(max(count or 0, max(maps) + 1))}
    if count is not None and not _fits(maps, numbers if stream.numbered else range(count)):
        count = stream.count()  # what containers say may be wrong
        known = numbers if stream.numbered else range(count or 0)
        if not _fits(maps, known):
            if len(maps) == count:
                return dict(enumerate(maps.values()))
            raise SettingsError(
                f"--disparity {folder} has {len(maps)} maps, {min(maps)} to {max(maps)}, and "
                f"{stream.name} has {images(count or 0)}, {min(known)} to {max(known)}: give each "
                "map the number or the name of its image"
            )
    return {numbers[number]: path for number, path in maps.items()}


def _fits(maps: dict[int, Path], numbers: dict[int, int] | range) -> bool:
    return all(number in numbers for number in maps)
