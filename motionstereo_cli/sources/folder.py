"""One camera from a folder of images."""

from __future__ import annotations

import hashlib
import itertools
import operator
import re
import statistics
import warnings
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import imageio.v3 as iio
import numpy as np
from PIL import Image as Pillow

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MOST_TABLE_BYTES, read_text, sha256_of
from motionstereo_cli.settings import MOST_PIXELS
from motionstereo_cli.sources.recording import Image, Recording, images

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

#: Files with these suffixes are images; all others are passed over.
SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp"})

# Pillow warns of large images, which are refused here, and of notes in images that do not matter.
warnings.filterwarnings("ignore", module=r"PIL\.")

#: Beside a folder ``data``: the images' time stamps in ns and names, as EuRoC lays them.
STAMPS = "data.csv"

#: Beside KITTI's folders ``image_0`` and the like: the time of each image in s, a line each.
TIMES = "times.txt"

#: What Pillow raises on damaged images.
_DAMAGE = (OSError, ValueError, SyntaxError)

#: Of a time stamp in ns: those of 64 bits.
_MOST_DIGITS = 19


class FolderRecording(Recording):
    """Images of one folder in natural order: frame2 before frame10.

    Colour becomes BT.601 luma, alpha is dropped, 16 bits are scaled to 8, and the orientation
    that a camera noted is obeyed. An image that cannot be read is counted and its number left
    out.

    The time stamp of an image is the number in its file name, where the names differ in one
    number alone and count in steps; otherwise its place. Only ``frame_rate`` makes a time of it.
    Where a ``data.csv`` lies beside a folder ``data``, as EuRoC has it, or a ``times.txt`` beside a
    folder ``image_0``, as KITTI has it, the time stamps are there.

    Args:
        path: an existing folder, or a glob pattern for the messages.
        files: the images, where not those of the folder.
        frame_rate: images per second, 0 = unknown.
        max_pixels: largest width times height of an image.

    Raises:
        InputError: there is no readable image; while iterating: an image is too large, or differs
            from the first in size.
    """

    def __init__(
        self,
        path: Path,
        files: Iterable[Path] | None = None,
        frame_rate: float = 0.0,
        *,
        max_pixels: int = MOST_PIXELS,
    ) -> None:
        self._path = path
        self._max_pixels = max_pixels
        self._unreadable: list[str] = []
        stamps_ns: list[int] = []
        try:
            if files is None and (path.parent / STAMPS).is_file() and path.name == "data":
                self._files, stamps_ns = _stamped(path)
            else:
                found = path.iterdir() if files is None else files
                self._files = sorted(
                    (file for file in found if file.suffix.lower() in SUFFIXES),
                    key=lambda file: natural_key(str(file)),
                )
                times = path.parent / TIMES
                if files is None and path.name.startswith("image_") and times.is_file():
                    stamps_ns = _timed(times, self._files)
        except OSError as error:
            raise InputError(f"cannot read the folder {path}: {error.strerror}") from error
        if not self._files:
            raise InputError(f"{path} has no images: put {', '.join(sorted(SUFFIXES))} files in it")
        self.expected_images = len(self._files)
        self.time_base: Fraction | None = None
        if stamps_ns:
            self._pts, self.time_base, self.stamped = stamps_ns, Fraction(1, 10**9), True
            if len(stamps_ns) > 1:
                # The median: lost images do not count.
                period_ns = statistics.median(map(operator.sub, stamps_ns[1:], stamps_ns[:-1]))
                self.frame_rate = Fraction(10**9) / Fraction(period_ns)
        else:
            numbers = file_numbers([file.stem for file in self._files])
            self.numbered = numbers is not None
            self._pts = numbers or list(range(len(self._files)))
            self.warnings = tuple(f"{path}: {gap}" for gap in _gaps(self._pts))
            if frame_rate:
                self.frame_rate = Fraction(str(frame_rate))
                self.time_base = 1 / self.frame_rate
        self._start(self._read(), path)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    @property
    def lost(self) -> int:
        """Images that could not be read so far."""
        return len(self._unreadable)

    @property
    def damage(self) -> list[str]:
        """One line that counts the unreadable images and names the first."""
        if not self._unreadable:
            return []
        count, first = images(self.lost), self._unreadable[0]
        return [f"{self._path}: {count} could not be read, the first is {first}"]

    def describe(self) -> dict[str, Any]:
        """Return what the images are, as JSON-able values."""
        return {
            "path": str(self._path),
            "kind": "images",
            "codec": ", ".join(sorted({file.suffix.lower()[1:] for file in self._files})),
            "pixel_format": self._pixel_format,
            "range": "full",
            "rotation_deg": 0,
            "width": self.width,
            "height": self.height,
            "frame_rate": str(self.frame_rate) if self.frame_rate else None,
            "images": self.expected_images,
        }

    def fingerprint(self) -> dict[str, Any]:
        """Return the size of all images in bytes, and a SHA-256.

        That is the hash of the text which ``sha256sum`` prints for the images by bare name, in
        their order.
        """
        sums, size = hashlib.sha256(), 0
        for path in self._files:
            if path.is_file():
                sums.update(f"{sha256_of(path)}  {path.name}\n".encode())
                size += path.stat().st_size
        return {"bytes": size, "sha256": sums.hexdigest()}

    def _read(self) -> Iterator[Image]:
        shape: tuple[int, ...] | None = None
        for number, (pts, file) in enumerate(zip(self._pts, self._files, strict=True)):
            try:
                with Pillow.open(file) as head:
                    if head.width * head.height > self._max_pixels:
                        raise self._too_large(file, f" ({head.width}x{head.height} px)")
                # Pillow by name: otherwise imageio tries its video plugins on damaged files.
                pixels = iio.imread(file, plugin="pillow", index=0, rotate=True)
            except Pillow.DecompressionBombError:
                raise self._too_large(file) from None
            except _DAMAGE:
                self._unreadable.append(file.name)
                continue
            grey = _grey(pixels, file)
            if shape is None:
                shape = grey.shape
                self._pixel_format = _pixel_format(pixels)
            if grey.shape != shape:
                raise InputError(
                    f"{file} is {grey.shape[1]}x{grey.shape[0]} but the images before it are "
                    f"{shape[1]}x{shape[0]}: make all images of a folder the same size"
                )
            yield Image(number, pts, grey)

    def _too_large(self, file: Path, size: str = "") -> InputError:
        return InputError(
            f"{file} is larger than --max-pixels {self._max_pixels}{size}: "
            "raise it if the image is to be trusted"
        )


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that counts digits as numbers: frame2 comes before frame10."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)]


def file_numbers(stems: list[str]) -> list[int] | None:
    """Return the number in each of a folder's file names without suffix, given in order.

    None unless the names differ in that number alone and count in steps of one size, gaps
    allowed: time stamps, several numbers and words tell nothing.
    """
    split = [re.split(r"([0-9]+)", stem) for stem in stems]
    if len({len(parts) for parts in split}) > 1:
        return None
    columns = [
        [parts[i] if i % 2 == 0 else int(parts[i]) for parts in split] for i in range(len(split[0]))
    ]
    varying = [(i, column) for i, column in enumerate(columns) if len(set(column)) > 1]
    if len(varying) != 1 or varying[0][0] % 2 == 0:
        return None
    numbers = [int(number) for number in varying[0][1]]
    steps = list(map(operator.sub, numbers[1:], numbers[:-1]))
    least = min(steps)
    return numbers if least > 0 and not any(step % least for step in steps) else None


def _gaps(numbers: list[int]) -> list[str]:
    """Return a line that names the gaps in a numbering, if there are any."""
    steps = list(map(operator.sub, numbers[1:], numbers[:-1]))
    pairs = zip(itertools.pairwise(numbers), steps, strict=True)
    gaps = [f"{before} and {after}" for (before, after), step in pairs if step > min(steps)]
    if not gaps:
        return []
    more = f" and in {len(gaps) - 1} other places" if len(gaps) > 1 else ""
    return [f"numbers are missing between {gaps[0]}{more}: check that no images are lost"]


def _stamped(path: Path) -> tuple[list[Path], list[int]]:
    """Return the images of a EuRoC camera and their time stamps in ns, in the order of time."""
    table = path.parent / STAMPS
    rows = []
    text = read_text(table, "the time stamps", MOST_TABLE_BYTES)
    for number, line in enumerate(text.splitlines(), 1):
        stamp, comma, name = (part.strip() for part in line.partition(","))
        if not line.strip() or stamp.startswith("#"):
            continue
        named = comma and Path(name).name == name
        if not (named and stamp.isascii() and stamp.isdigit() and len(stamp) <= _MOST_DIGITS):
            raise InputError(f"{table}, line {number}: give 'time stamp in ns,file name'")
        rows.append((int(stamp), path / name))
    rows.sort()
    for (before, _), (after, _) in itertools.pairwise(rows):
        if before == after:
            raise InputError(f"{table} has the time stamp {after} twice: keep one line for it")
    return [file for _, file in rows], [stamp for stamp, _ in rows]


def _timed(table: Path, files: list[Path]) -> list[int]:
    """Return the time stamps in ns of images whose numbers are those of the lines, from 0."""
    try:
        times_s = [float(line) for line in read_text(table, "the times", MOST_TABLE_BYTES).split()]
        numbers = [int(file.stem) for file in files]
        stamps_ns = [round(times_s[number] * 1e9) for number in numbers]
    except (ValueError, OverflowError, IndexError):
        raise InputError(
            f"{table} does not fit the images in {files[0].parent}: give a time in s a line, the "
            "first for 000000, or take it away"
        ) from None
    if any(after <= before for before, after in itertools.pairwise(stamps_ns)):
        raise InputError(f"{table}: the times do not rise: mend it, or take it away")
    return stamps_ns


def _grey(pixels: NDArray[Any], file: Path) -> Grey:
    if pixels.dtype == np.bool_:
        pixels = pixels * np.uint8(255)
    elif pixels.dtype in (np.uint16, np.int32):  # Pillow reads 16-bit PGM as int32
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif pixels.dtype != np.uint8:
        raise InputError(f"{file} has {pixels.dtype} pixels: give 8-bit or 16-bit images")
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] < 3:  # grey with alpha
        return np.ascontiguousarray(pixels[:, :, 0])
    rgb = np.ascontiguousarray(pixels[:, :, :3])
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _pixel_format(pixels: NDArray[Any]) -> str:
    channels = {1: "grey", 2: "grey+alpha", 3: "rgb", 4: "rgba"}
    count = 1 if pixels.ndim == 2 else pixels.shape[2]
    bits = {"bool": 1, "uint8": 8}.get(pixels.dtype.name, 16)
    return f"{channels[count]} {bits} bit"
