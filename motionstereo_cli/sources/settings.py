"""Parameters of the input: how it is laid out, paired and cut, and what that does to the rig."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple, TypeVar

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.files.reading import MAX_PIXELS, PILLOW_MAX_PIXELS
from motionstereo_cli.params import checked, param
from motionstereo_cli.types import Rig

#: A place in the stream: an int is the number of a frame, a Fraction a time in s.
Place = int | Fraction
T = TypeVar("T", int, float)

#: One image in a quarter of an hour, in frames per second.
_MIN_RATE = 0.001

#: What stands for an offset that is measured; the largest of disparity, and of time.
MEASURED = "auto"
_MAX_OFFSET_PX = 100
_MAX_IMAGES, _MAX_SHIFT_S = 10**9, 10**10

_TIME = re.compile(r"(?:(?:(\d+):)?(\d+):)?(\d+(?:\.\d*)?)(s?)", re.ASCII)


class Box(NamedTuple):
    """A part of an image in px; x, y is its upper left corner."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class InputSettings:
    """How the two views lie in the input, which images belong together, and what of them is used.

    Raises:
        SettingsError: a value is out of range, or two values contradict each other.
    """

    layout: str = param(
        "two",
        "Where the two views are. two: in LEFT and RIGHT, or in a KITTI or EuRoC folder; in all "
        "others one recording holds both, the left view at the left or on top; -half: each view "
        "was squeezed to half its width or height, and is stretched back; tracks: in the first two "
        "video tracks.",
        choices=(
            *("two", "side-by-side", "side-by-side-half", "top-bottom", "top-bottom-half"),
            "tracks",
        ),
        common=True,
    )
    track: str = param(
        "",
        "Video track to use where a file has several, from 1; LEFT,RIGHT for those of the two "
        "views (none given: the first, with --layout tracks 1,2).",
    )
    topics: str = param(
        "",
        "Topics of the left and the right camera in a ROS bag, as LEFT,RIGHT (none given: found by "
        "name).",
    )
    project: bool = param(
        False,
        "Of spherical video (VR180, 360 degrees; equirectangular), take the pinhole image of 90 "
        "degrees straight ahead. The rig, --crop and --rotate-left are of that image; info prints "
        "its size and focal length.",
    )
    swap: bool = param(False, "Exchange the left and the right view, for cross-eyed recordings.")
    rotate_left: int = param(
        0,
        "Turn the left view clockwise, by 90, 180 or 270; before it is rectified.",
        unit="degrees",
        low=0,
        high=270,
    )
    rotate_right: int = param(
        0, "Turn the right view, in the same way.", unit="degrees", low=0, high=270
    )
    mirror_left: bool = param(
        False, "Exchange left and right in the left view, before it is turned."
    )
    mirror_right: bool = param(False, "Exchange left and right in the right view likewise.")
    sync_offset: str = param(
        "",
        "Pair left image n with right image n + N. N > 0 if the right recording began N images "
        "earlier. auto: measured by the sound in both, or else by motion (none given: as the "
        "recordings' times, names and numbers say).",
        unit="images",
    )
    sync_tolerance: float = param(
        0.0,
        "Pair each image with the nearest by time stamp, at most this far apart (0 = as the "
        "recordings' times, names and numbers say).",
        unit="s",
        low=0,
        high=3600,
    )
    sync_shift: str = param(
        "",
        "How much later the clock of the right recording is than that of the left one. Images are "
        "then paired by time (0: both have one clock).",
        unit="s",
    )
    frame_rate: float = param(
        0.0,
        "Frame rate of what has no times, such as image folders and bare H.264 (0 = unknown).",
        unit="frames per second",
        low=0,
        high=100_000,
    )
    start: str = param(
        "",
        "First frame used: its number from 0 (100) or its time since the first (12.5s, 0:12.5).",
        common=True,
    )
    end: str = param("", "First frame not used any more, as number or time.", common=True)
    every: int = param(
        1,
        "Use every N-th frame. Motion is what changes between the frames used.",
        unit="frames",
        low=1,
        high=1_000_000,
    )
    crop: str = param(
        "",
        "Part of each view that is used: X,Y,WIDTH,HEIGHT from its upper left corner.",
        unit="px",
    )
    scale: float = param(
        1.0,
        "Factor to the size of the views, after --crop. Disparity grows with it, depth does not.",
        low=0.01,
        high=8,
    )
    disparity_offset: str = param(
        "0",
        "Constant that is added to disparity for depth, as a small turn between the cameras takes "
        f"it away: -{_MAX_OFFSET_PX} to {_MAX_OFFSET_PX}, or auto: measured before the run from "
        "how things move while the rig moves.",
        unit="px",
        only_with="--rig",
        group="Calibration",
    )
    disparity_view: str = param(
        "auto",
        "Camera whose view the maps of --disparity are in. auto: found from the images.",
        choices=("auto", "left", "right"),
        only_with="--disparity",
    )
    disparity_scale: float = param(
        0.0,
        "What the maps of --disparity have for 1 px: 256 in KITTI's PNG, 16 in OpenCV's whole "
        "numbers, -1 where signs are exchanged (0 = found from the images).",
        low=-65_536,
        high=65_536,
        only_with="--disparity",
    )
    white: int = param(
        0,
        "Level that becomes white in images of more than 8 bits, as 4095 where a camera puts 12 "
        "bits into 16 (0 = the largest that the bits can say).",
        low=0,
        high=65535,
    )
    strict: bool = param(
        False,
        "End with an error at the first damage in the input, instead of counting it.",
        group="Robustness",
    )
    max_pixels: int = param(
        MAX_PIXELS,
        "Maximum size of an image. Larger ones are refused before they are decoded, because they "
        "would fill the memory.",
        unit="px",
        low=1,
        high=PILLOW_MAX_PIXELS,
        group="Robustness",
    )
    allow_network: bool = param(
        False,
        "Read from network addresses too, given as LEFT or RIGHT or in a playlist. Without it a "
        "recording cannot make the program read anything else.",
        group="Robustness",
    )

    def __post_init__(self) -> None:
        checked(self)
        _ = self.crop_box, self.rate, self.tracks, self.disparity_offset_px, self.shift_s
        first, stop = self.first, self.stop
        comparable = type(stop) is type(first) or not self.start
        if stop is not None and comparable and stop <= first:
            raise SettingsError(f"--end {self.end} does not come after --start {self.start or 0}")
        for flag, degrees in (
            ("--rotate-left", self.rotate_left),
            ("--rotate-right", self.rotate_right),
        ):
            if degrees % 90:
                raise SettingsError(f"{flag} cannot be {degrees}: give 90, 180 or 270 degrees")
        by_number = self.offset is not None or self.measures_offset
        for flag, given in (
            ("--sync-tolerance", self.sync_tolerance),
            ("--sync-shift", self.sync_shift),
        ):
            if by_number and given:
                raise SettingsError(
                    f"--sync-offset pairs by number and {flag} by time: give one of them"
                )

    @property
    def disparity_offset_px(self) -> float | None:
        """What is added to disparity for depth; None where that is to be measured."""
        if self.disparity_offset == MEASURED:
            return None
        advice = f"{MEASURED}, or -{_MAX_OFFSET_PX} to {_MAX_OFFSET_PX} px"
        return _number("--disparity-offset", self.disparity_offset, float, _MAX_OFFSET_PX, advice)

    @property
    def measures_offset(self) -> bool:
        """Whether the offset between the recordings is to be measured."""
        return self.sync_offset == MEASURED

    @property
    def offset(self) -> int | None:
        """What is added to a left image's number; None where none is given, or not yet known."""
        if not self.sync_offset or self.measures_offset:
            return None
        advice = f"{MEASURED}, or a whole number of images"
        return _number("--sync-offset", self.sync_offset, int, _MAX_IMAGES, advice)

    @property
    def shift_s(self) -> Fraction | None:
        """By how much the right clock is later, None where that is not given."""
        if not self.sync_shift:
            return None
        shift_s = _number("--sync-shift", self.sync_shift, float, _MAX_SHIFT_S, "a number of s")
        return Fraction(str(shift_s))

    @property
    def rate(self) -> Fraction | None:
        """The rate that was given, None if none was; FFmpeg's numbers hold it and its inverse."""
        if not self.frame_rate:
            return None
        if self.frame_rate < _MIN_RATE:
            raise SettingsError(
                f"--frame-rate cannot be {self.frame_rate:g}: give {_MIN_RATE} to 100,000 frames "
                "per second, or 0 where it is unknown"
            )
        # 29.97002997 is 30000/1001.
        return Fraction(str(self.frame_rate)).limit_denominator(10_000)

    @property
    def tracks(self) -> tuple[int, int]:
        """The video tracks of the left and the right view, from 1; 0 = none was chosen."""
        if not self.track:
            return (1, 2) if self.layout == "tracks" else (0, 0)
        found = re.fullmatch(r"([1-9]\d?)(?:,([1-9]\d?))?", self.track.replace(" ", ""), re.ASCII)
        if found is None or (self.layout == "tracks" and not found[2]):
            raise SettingsError(
                f"--track cannot be {self.track!r}: give the number of a video track, from 1, or "
                "LEFT,RIGHT for those of the two views"
            )
        return int(found[1]), int(found[2] or found[1])

    @property
    def turns(self) -> tuple[tuple[int, bool], tuple[int, bool]]:
        """By how many degrees each view is turned clockwise, and whether it is mirrored before."""
        return (self.rotate_left, self.mirror_left), (self.rotate_right, self.mirror_right)

    @property
    def first(self) -> Place:
        """Where the frames that are used begin."""
        return _place("--start", self.start) if self.start else 0

    @property
    def stop(self) -> Place | None:
        """The first place behind the frames that are used, None = the end of the input."""
        return _place("--end", self.end) if self.end else None

    @property
    def crop_box(self) -> Box | None:
        """The part of each view to use, None = all of it."""
        if not self.crop:
            return None
        parts = [part.strip() for part in self.crop.split(",")]
        if len(parts) != 4 or not all(part.isascii() and part.isdigit() for part in parts):
            raise SettingsError(f"--crop cannot be {self.crop!r}: give X,Y,WIDTH,HEIGHT in px")
        box = Box(*map(int, parts))
        if not (box.width and box.height):
            raise SettingsError(f"--crop cannot be {self.crop!r}: give a width and height above 0")
        return box

    def box(self, width: int, height: int) -> Box:
        """Return the part that is used of views of a size in px.

        Raises:
            SettingsError: the views are too small for it.
        """
        box = self.crop_box or Box(0, 0, width, height)
        if box.x + box.width > width or box.y + box.height > height:
            raise SettingsError(f"--crop {self.crop} goes beyond views of {width}x{height} px")
        return box

    def delivered(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height in px that views of a size have after crop and scale."""
        box = self.box(width, height)
        return max(1, round(box.width * self.scale)), max(1, round(box.height * self.scale))


def adapted_rig(rig: Rig, settings: InputSettings) -> Rig:
    """Return the rig of what is delivered from the rig of the whole views.

    A disparity offset that is known goes into doffs; one that is to be measured does not yet.

    A pixel's centre has whole coordinates, so a view that is scaled by s has what was at x at
    s (x + 0.5) - 0.5. Depth stays the same: focal length, disparity and doffs all grow with s.

    Raises:
        SettingsError: the crop goes beyond the rig's images.
    """
    box = settings.box(rig.width, rig.height)
    width, height = settings.delivered(rig.width, rig.height)
    across, down = width / box.width, height / box.height
    adapted = dataclasses.replace(
        rig,
        width=width,
        height=height,
        focal_px=rig.focal_px * across,
        cx=(rig.cx - box.x + 0.5) * across - 0.5,
        cy=(rig.cy - box.y + 0.5) * down - 0.5,
        doffs=rig.doffs * across,
        focal_y_px=None if rig.focal_y_px is None else rig.focal_y_px * down,
    )
    return adapted.with_disparity_offset(settings.disparity_offset_px or 0.0)


def _number(flag: str, text: str, kind: Callable[[str], T], most: float, advice: str) -> T:
    """Return the number that an option is, at most so large either way."""
    with contextlib.suppress(ValueError):
        number = kind(text)
        if abs(number) <= most:
            return number
    raise SettingsError(f"{flag} cannot be {text!r}: give {advice}")


def _place(flag: str, text: str) -> Place:
    found = _TIME.fullmatch(text.strip())
    if found is None or (not found[2] and not found[4] and not found[3].isdigit()):
        raise SettingsError(
            f"{flag} cannot be {text!r}: give a frame number (100) or a time (12.5s, 1:02.5)"
        )
    hours, minutes, seconds, unit = found.groups()
    if not minutes and not unit:
        return int(seconds)
    return 3600 * int(hours or 0) + 60 * int(minutes or 0) + Fraction(seconds.rstrip("."))
