"""The interface of streams of images from one camera."""

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
from motionstereo_cli.sources.stereo3d import ViewMetadata

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey


class Image(NamedTuple):
    """One image of one camera.

    Attributes:
        number: number in the recording, from 0; numbers of lost images are skipped.
        pts: presentation time stamp in units of the stream's time base.
        grey: (height, width) uint8 grey levels 0..255; not to be written to.
        colour: returns (height, width, 3) uint8 RGB, or None without colour.
    """

    number: int
    pts: int
    grey: Grey
    colour: Callable[[], NDArray[np.uint8] | None] | None = None


class Recording(ABC):
    """Images of one camera, all of one size; can be iterated once.

    Attributes:
        name: the recording, for messages.
        width, height: size of the delivered images in px.
        time_base: seconds per unit of pts, None if images have no times.
        frame_rate: mean images per second; None if unknown.
        expected_images: estimated number of images, with lost ones; None if unknown.
        begin_pts: time stamp of the first image.
        numbered: time stamps are numbers from file names, which pair images better than
            positions.
        stamped: time stamps are the camera's, which pair images better, too.
        timed: time stamps are the container's, written as images arrived.
        clock_ahead_s: how far the clock of its time stamps is ahead of the recorder's, which
            recorded both cameras; None if unknown.
        clock: origin of its time stamps, by a name: those of one name are comparable.
        begin_s: time of the first image, 0 without times.
        timeless: times follow only from a given rate and the images' numbers.
        names: the images' names without suffix by number, if they are files.
        stated: the layout of both views that it states, None if none.
        unread: a stated layout that is not read, and what to do; empty if none.
        metadata: what its first image states about its views.
        multiview: it is one view of a multiview stream (MV-HEVC).
        sphere: the angles of its rows and columns; None if it is flat.
        rereadable: whether another process can read it again.
        warnings: what looks wrong at the outset, one line each.
        camera_info: calibration recorded with the images, the fields of
            ``sensor_msgs/CameraInfo`` as JSON; None if there is none.
        calibration_note: what to know about the calibration if none is given; empty = nothing.
        rectified: whether that calibration is of rectified images.
        frame_id: the optical frame of ROS that its images are in, empty if unknown.
        holes: which of these attributes shows that images are missing, empty if none does.
        likely_white: likely white level, if deep images use a small part of their range, such
            as 12 bits of 16; 0 = that of their bits.
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
    metadata: ViewMetadata = ViewMetadata()
    multiview: bool = False
    sphere: Sphere | None = None
    rereadable: bool = True
    _images: Iterator[Image]
    _pixel_format: str
    warnings: tuple[str, ...] = ()
    camera_info: str | None = None
    calibration_note: str = ""
    rectified: bool = False
    frame_id: str = ""
    holes: str = ""
    likely_white: int = 0

    def __iter__(self) -> Iterator[Image]:
        return self._images

    def place_of(self, number: int) -> int:
        """Return the place that an image has in the whole recording, where some may be missing."""
        return number

    def _start(self, images: Iterator[Image], name: object, advice: str = "") -> None:
        """Set the images to deliver, and the size by the first.

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
        """Note and warn if the first image uses a small part of its range."""
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
        """Images missing so far."""

    @property
    def flawed(self) -> int:
        """Images with visible errors so far."""
        return 0

    @property
    @abstractmethod
    def damage(self) -> list[str]:
        """Missing and flawed images in words, one line for each kind of damage."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Describe the recording, as JSON-able values."""

    def _described(
        self,
        path: object,
        kind: str,
        codec: str,
        *,
        levels: str = "full",
        rotation_deg: int = 0,
        **more: Any,
    ) -> dict[str, Any]:
        """Return what :meth:`describe` says of every recording; ``more`` follows the path."""
        return {
            "path": str(path),
            **more,
            "kind": kind,
            "codec": codec,
            "pixel_format": self._pixel_format,
            "range": levels,
            "rotation_deg": rotation_deg,
            "width": self.width,
            "height": self.height,
            "frame_rate": str(self.frame_rate) if self.frame_rate else None,
            "images": self.expected_images,
        }

    @abstractmethod
    def fingerprint(self) -> dict[str, Any]:
        """Return the recording's size in ``bytes`` and its ``sha256``; reads all of it.

        Of a pipe it is the data so far; the hash is None before the end.
        """

    def outline(self) -> Sequence[tuple[int, int]]:
        """Return numbers and time stamps of all images, without decoding; empty if unknown.

        Images that cannot be decoded are included.
        """
        return ()

    def key_before(self, number: int) -> int:
        """Return the last image up to some number with which decoding can begin, if that is known.

        Else the number itself.
        """
        return number

    def skip_to(self, number: int) -> bool:
        """Begin the iteration with the first image that has this number or a later one.

        To be called before the iteration. The same images are delivered as without it, to the byte;
        earlier losses may stay unknown.

        Returns:
            Whether it seeks; otherwise all earlier images are decoded and dropped.
        """
        self._images = itertools.dropwhile(lambda image: image.number < number, self._images)
        return False

    def count(self) -> int | None:
        """Count the images, if necessary by reading all; None if unknown."""
        return self.expected_images

    @property
    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """The files and folders that are read."""

    def stop(self) -> None:  # noqa: B027 (files never wait)
        """End an iteration that waits for data in another thread."""

    @abstractmethod
    def close(self) -> None:
        """Close what is open."""


class StillsRecording(Recording):
    """The common part of recordings from files of still images."""

    _path: Path
    _white: int

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _look_at(self, pixels: NDArray[Any]) -> None:
        """Note what the first image's pixels tell about all."""
        self._pixel_format = pixel_format(pixels)
        if pixels.dtype == np.uint16 and not self._white:
            self._judge_depth(self._path, int(pixels.max()), 16)


def images(count: int) -> str:
    """Return ``count`` images in words."""
    return "1 image" if count == 1 else f"{count} images"
