"""What every stream of images from one camera offers, wherever the images come from."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.stills import Stated, pixel_format
from motionstereo_cli.sources.sphere import Sphere
from motionstereo_cli.sources.stereo3d import Said

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey


class Image(NamedTuple):
    """One image of one camera.

    Attributes:
        number: place in the recording, from 0; places of lost images are left out.
        pts: presentation time stamp in units of the stream's time base.
        grey: (height, width) uint8 grey levels 0..255; not to be written to.
        colour: returns (height, width, 3) uint8 RGB, or None where there is no colour.
    """

    number: int
    pts: int
    grey: Grey
    colour: Callable[[], NDArray[np.uint8] | None] | None = None


class Recording(ABC):
    """Images of one camera, all of one size; to be iterated once.

    Attributes:
        name: what to call the recording in messages.
        width, height: size in px of the images as delivered.
        time_base: seconds per unit of pts, None where images have no time.
        frame_rate: images per second, a mean; None if unknown.
        expected_images: how many places the recording seems to have, None if unknown.
        begin_pts: time stamp of the first image.
        numbered: the time stamps are numbers from file names, which tell better than places
            which images belong together.
        stamped: the time stamps were taken by the camera, and do so as well.
        timed: its time stamps are those of a container, which wrote them as images came.
        clock_ahead_s: by how much the clock of its time stamps is ahead of that of the recorder,
            which recorded both cameras; None if unknown.
        clock: what time stamps count from, by a name: those of one name may be compared.
        begin_s: time of the first image, 0 where there is no time.
        timeless: nothing but a rate given makes a time of the images' numbers.
        names: the images' names without suffix by their place, where they are files.
        stated: how it says that it holds both views, None if it does not.
        unread: how it holds both views, where that is not read, and what to do; empty elsewhere.
        said: what its first image says of its views.
        multiview: it is one view of a stream that holds more (MV-HEVC).
        sphere: the angles of its rows and columns; None where it is flat.
        rereadable: another process can read the same again.
        warnings: what looks wrong before anything is lost, one line each.
        camera_info: calibration that lies beside the images, the fields of
            ``sensor_msgs/CameraInfo`` as JSON; None where there is none.
        calibration_note: what to know of the calibration where none is given; empty = nothing.
        rectified: that calibration is of images that are rectified already.
        holes: the one of these that says that images are missing, empty if none does.
        likely_white: level that seems to be white, where deep images use a small part of their
            range, as 12 bits in 16 do; 0 = that of their bits.
    """

    name: str
    width: int
    height: int
    time_base: Fraction | None
    frame_rate: Fraction | None = None
    expected_images: int | None
    begin_pts: int
    numbered: bool = False
    stamped: bool = False
    timed: bool = False
    clock: str = ""
    clock_ahead_s: Fraction | None = None
    begin_s: Fraction = Fraction(0)
    timeless: bool = False
    names: Sequence[str] = ()
    stated: Stated | None = None
    unread: str = ""
    said: Said = Said()
    multiview: bool = False
    sphere: Sphere | None = None
    rereadable: bool = True
    _images: Iterator[Image]
    warnings: tuple[str, ...] = ()
    camera_info: str | None = None
    calibration_note: str = ""
    rectified: bool = False
    holes: str = ""
    likely_white: int = 0

    def __iter__(self) -> Iterator[Image]:
        return self._images

    def _start(self, images: Iterator[Image], name: object, advice: str = "") -> None:
        """Take the images to deliver, and the size from the first.

        Raises:
            InputError: there is none.
        """
        first = next(images, None)
        if first is None:
            advice = advice or "check that it is whole"
            raise InputError(f"{name}: none of its images can be decoded: {advice}")
        self.name = str(name)
        self.height, self.width = first.grey.shape
        self.begin_s = first.pts * (self.time_base or Fraction(0))
        self.begin_pts = first.pts
        self._images = itertools.chain([first], images)

    def _judge_depth(self, name: object, brightest: int, bits: int) -> None:
        """Note and say where the first image uses a small part of its range."""
        used = max(brightest, 1).bit_length()
        if used > bits - 2:
            return
        self.likely_white = 2 ** max(used, 8) - 1
        self.warnings += (
            f"{name} is dark: no level of its first image is over {brightest} of {2**bits - 1}: if "
            f"the camera gives {max(used, 8)} bits, give --white {self.likely_white}",
        )

    @property
    @abstractmethod
    def lost(self) -> int:
        """Images so far that should have come and did not."""

    @property
    def flawed(self) -> int:
        """Images so far that came with visible errors."""
        return 0

    @property
    @abstractmethod
    def damage(self) -> list[str]:
        """Both in words, one line for each kind of damage."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return what the recording is, as JSON-able values."""

    @abstractmethod
    def fingerprint(self) -> dict[str, Any]:
        """Return the recording's size in ``bytes`` and its ``sha256``; reads all of it.

        Where it came through a pipe, that is what came; the hash is None before the end.
        """

    def outline(self) -> Sequence[tuple[int, int]]:
        """Return numbers and time stamps of all images, without decoding any; none if unknown.

        One that cannot be decoded is among them.
        """
        return ()

    def skip_to(self, number: int) -> bool:
        """Begin the iteration with the first image that has this number or a later one.

        To be called before the iteration. What is delivered is what would be without it, to the
        byte; what was lost before may stay unknown.

        Returns:
            Whether that was by a seek; otherwise all images before are decoded and dropped.
        """
        self._images = itertools.dropwhile(lambda image: image.number < number, self._images)
        return False

    def count(self) -> int | None:
        """Return how many images there are, though it takes reading all; None if unknown."""
        return self.expected_images

    @property
    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """The files and folders that are read."""

    def stop(self) -> None:  # noqa: B027 (files never wait)
        """Let an iteration that waits for data in another thread end."""

    @abstractmethod
    def close(self) -> None:
        """Give back what is open."""


class StillsRecording(Recording):
    """What recordings from files of still images have in common."""

    _path: Path
    _white: int
    _pixel_format: str

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _look_at(self, pixels: NDArray[Any]) -> None:
        """Note what the pixels of the first image tell of all."""
        self._pixel_format = pixel_format(pixels)
        if pixels.dtype == np.uint16 and not self._white:
            self._judge_depth(self._path, int(pixels.max()), 16)

    def _described(self, kind: str, codec: str) -> dict[str, Any]:
        """Return what :meth:`describe` says."""
        return {
            "path": str(self._path),
            "kind": kind,
            "codec": codec,
            "pixel_format": self._pixel_format,
            "range": "full",
            "rotation_deg": 0,
            "width": self.width,
            "height": self.height,
            "frame_rate": str(self.frame_rate) if self.frame_rate else None,
            "images": self.expected_images,
        }


def images(count: int) -> str:
    """Return ``count`` images in words."""
    return "1 image" if count == 1 else f"{count} images"
