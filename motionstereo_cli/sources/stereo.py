"""Two streams, or two views of one, as one stream of stereo frames."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.sources import layout
from motionstereo_cli.sources.given import GivenDisparity
from motionstereo_cli.sources.pairing import need_time, pair, pairing
from motionstereo_cli.sources.prefetch import prefetch
from motionstereo_cli.sources.recording import Recording
from motionstereo_cli.sources.selection import Selected, chosen, place_near
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.sides import Loss, Side, SideImage, bare, moves, same
from motionstereo_cli.sources.sphere import Pinhole
from motionstereo_cli.types import StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey

#: Images decoded ahead on each side: enough to even out key frames, in little memory; and the
#: memory that they may take, in bytes, but for the first.
_AHEAD, _AHEAD_BYTES = 4, 1 << 23

#: Plausible images per second; beyond these the unit of time stamps is likely wrong.
_LIKELY_RATES = (0.05, 5000)

SIDES = ("left", "right")


class StereoSource:
    """The stereo frames of two recordings, or of one that holds both views.

    To be iterated once, inside a ``with`` block. Images are paired by
    :func:`~motionstereo_cli.sources.pairing.pairing`. A recording skips the numbers of lost
    images, so the partner of a lost image is dropped and the sides stay in step. If one side is
    longer, the common part is processed.

    Each recording is decoded in its own thread, a few images ahead; views are split, rectified,
    cropped and scaled there.

    Args:
        streams: the left and the right recording, or the one with both views; closed with this.
        settings: pairing, and selection of frames.

    Attributes:
        settings: as given.
        view_width, view_height: size of the whole views in px, before crop and scale.
        width, height: size of the images delivered in px.
        time_base: seconds per unit of pts (the right stream's), None where images have no time.
        frame_rate: frames delivered per second, a mean; None if unknown.
        expected_frames: their estimated number, None if unknown.
        paths: files and folders that are read.
        recorded: the first file or folder of each recording, left then right, without tables of
            times, which ``paths`` includes.
        ahead: images decoded ahead on each side; where few are read, fewer are decoded in vain.
        first_pts: time stamp of frame 0, once a frame was delivered.
        warnings: what looks wrong at the outset, one line each.

    Raises:
        InputError: the views differ in size or cannot be split; while iterating: no frame is left.
        SettingsError: the settings need times that the recordings do not have, or the crop
            goes beyond the views.
    """

    def __init__(
        self,
        streams: Sequence[Recording],
        settings: InputSettings | None = None,
    ) -> None:
        self.settings = s = settings or InputSettings()
        self._streams = list(streams)
        self.paths = tuple(dict.fromkeys(path for stream in streams for path in stream.files))
        self.recorded = tuple(stream.files[0] for stream in streams if stream.files)
        if len(self._streams) == 1:
            self._sides = [Side(self._streams[0], half) for half in (0, 1)]
        else:
            self._sides = [Side(stream) for stream in self._streams]
        if s.swap:
            self._sides.reverse()
        self._rectify: tuple[Callable[[Grey], Grey], ...] | None = None
        self._frames: Generator[StereoFrame] | None = None
        self._skipped = self._first_frame = 0
        self._begin = Selected(0, 0, None)
        self._to_the_end = self._placed = False
        self._coloured = -1  # the view whose colours are requested: 0 left, 1 right
        self._given: GivenDisparity | None = None
        self.first_pts = 0
        lines = (line for stream in self._streams for line in stream.warnings)
        self.warnings = list(dict.fromkeys(lines))  # a table of both sides is named once

        self._pinholes = [self._pinhole(side) for side in self._sides]
        self.view_width, self.view_height = whole = self._common_size()
        self.width, self.height = s.delivered(*whole)
        self.ahead = max(1, min(_AHEAD, _AHEAD_BYTES // (self.width * self.height)))
        self._box = s.box(*whole)
        for width, height in (whole, (self.width, self.height)):
            if width * height > s.max_pixels:
                raise InputError(
                    f"views of {width}x{height} px are more than --max-pixels {s.max_pixels}: "
                    "raise it, or give a smaller --scale"
                )
        if s.strict and (holes := [stream.holes for stream in self._streams if stream.holes]):
            raise self._stopped(holes[0])
        left, right = (side.stream for side in self._sides)
        self.time_base, rate = right.time_base, right.frame_rate
        self.frame_rate = rate / s.every if rate else None
        if rate and not _LIKELY_RATES[0] <= rate <= _LIKELY_RATES[1]:
            self.warnings.append(
                f"{right.name} has {float(rate):.4g} images per second by its times: see "
                "that they are in the unit that belongs to its format"
            )
        for flag, place in (("--start", s.first), ("--end", s.stop)):
            if isinstance(place, Fraction):
                need_time(flag, right)
        self._pairing = pairing(left, right, s)
        self.warnings += [self._pairing.warning] if self._pairing.warning else []
        self.expected_frames = self._expected()

    def __enter__(self) -> StereoSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the recordings, after ending a running iteration."""
        if self._frames is not None:
            self._frames.close()  # its threads read from what is closed next
        if self._given is not None:
            self._given.close()
        for stream in self._streams:
            stream.close()

    @property
    def rereadable(self) -> bool:
        """Whether another process can read them again: not from standard input."""
        return all(stream.rereadable for stream in self._streams)

    @property
    def projected_focal_px(self) -> float | None:
        """Focal length of the pinhole image of a spherical view, before scale; None for others."""
        return None if self._pinholes[0] is None else self._pinholes[0].focal_px

    @property
    def likely_white(self) -> int:
        """Likely white level, if deep images are dark; 0 = that of their bits."""
        return max(stream.likely_white for stream in self._streams)

    def keep_colours(self, camera: str) -> None:
        """Add the colours of a view to frames; to be called before the iteration.

        Args:
            camera: ``left`` or ``right``; empty for none.
        """
        self._coloured = SIDES.index(camera) if camera else -1

    def bring_disparity(self, folder: Path, view: str, scale: float, camera: str) -> GivenDisparity:
        """Have frames bring the disparity that a folder has; to be called before the iteration.

        Args:
            folder: maps of the rectified images, whole or as they are delivered.
            view: the camera that they are of, ``left`` or ``right``.
            scale: what they have for 1 px; 0: values are only scaled with the images.
            camera: in whose view frames bring it.

        Raises:
            InputError: there are no maps, or their numbers cannot be told.
            SettingsError: they do not belong to these images, by their size or number.
        """
        if self._given is not None:
            self._given.close()
        self._given = GivenDisparity(
            *(folder, self._sides[SIDES.index(view)].stream, view, scale, camera),
            box=self._box,
            whole=(self.view_width, self.view_height),
            size=(self.width, self.height),
            max_pixels=self.settings.max_pixels,
        )
        if scale:
            self.settings = dataclasses.replace(
                self.settings, disparity_view=view, disparity_scale=scale
            )
        return self._given

    @property
    def given(self) -> GivenDisparity | None:
        """The disparity that frames bring; None where it is to be matched."""
        return self._given

    def rectify(self, left: Callable[[Grey], Grey], right: Callable[[Grey], Grey]) -> None:
        """Apply a function to each full view; to be called before the iteration.

        The functions take and return (view_height, view_width) uint8; they are called in the
        decoding threads, each in one thread.
        """
        self._rectify = (left, right)

    @property
    def numbers(self) -> tuple[int, int | None]:
        """Approximate numbers of the first and the last delivered right image in the recording.

        None for the last if unknown.
        """
        right, s = self._sides[1].stream, self.settings
        first = place_near(s.first, right.frame_rate)
        if not (self._pairing.by_time or right.numbered):
            first += max(s.offset or 0, 0)
        expected = self.expected_frames
        return first, first + (expected - 1) * s.every if expected else None

    @property
    def span_s(self) -> tuple[float | None, float | None]:
        """Approximate times of the first and the last delivered right image, in s.

        None for both without times, and for the last if unknown.
        """
        (first, last), begin_s = self.numbers, self.begin_s
        rate = self._sides[1].stream.frame_rate
        if begin_s is None:
            return None, None
        if not rate:
            return begin_s, None
        return begin_s + float(first / rate), None if last is None else begin_s + float(last / rate)

    @property
    def begin_s(self) -> float | None:
        """Time of the first right image of the whole recording, in s; None without times."""
        right = self._sides[1].stream
        return None if right.time_base is None else float(right.begin_pts * right.time_base)

    @property
    def last_number(self) -> int | None:
        """Approximate number of the last right image of the whole recording; None if unknown."""
        images = self._sides[1].stream.expected_images
        return None if images is None else images - 1

    @property
    def last_s(self) -> float | None:
        """Approximate time of that image, in s; None if unknown."""
        rate, last, begin_s = self._sides[1].stream.frame_rate, self.last_number, self.begin_s
        return None if begin_s is None or not rate or last is None else begin_s + float(last / rate)

    @property
    def counts(self) -> dict[str, Any]:
        """Counts of images, up to the stereo frames delivered so far.

        ``skipped``: pairs left out by --start, --end and --every. For ``left`` and ``right``:
        ``read`` = ``paired`` + ``unpaired`` + ``damaged``, where damaged images are missing ones;
        ``flawed``: used despite visible errors; ``repeated``: used, but equal to the previous image
        while objects moved in the other view; ``unread``: approximate number of images that
        follow, None if unknown.
        """
        sides = {name: side.counts for name, side in zip(SIDES, self._sides, strict=True)}
        return {"skipped": self._skipped, **sides}

    @property
    def damage(self) -> list[str]:
        """Losses so far, one line each; complete after the iteration."""
        shown = self._sides[: len(self._streams)]
        lines = list(dict.fromkeys(line for side in shown for line in side.loss.damage))
        offset = 0 if self._pairing.by_time else self.settings.offset or 0
        left, right = self._sides
        # Images without partners because of an offset, or of a later start, are not damage.
        for side, over_first, over_last in ((left, -offset, offset), (right, offset, -offset)):
            early = 0 if self._pairing.by_time else max(side.early - max(over_first, 0), 0)
            late = side.left_over - max(over_last, 0) if self._to_the_end else 0
            if self._pairing.thinned is side.stream:  # most of its images have no partner
                early, late = early - side.between, 0
            lines += side.unused(early, late)
        return lines + (self._given.damage if self._given else [])

    def describe(self, *, fingerprint: bool = True) -> dict[str, dict[str, Any]]:
        """Describe the recordings, as JSON-able values: ``left`` and ``right``, or ``both``.

        With ``fingerprint``, reads all files for their size and SHA-256.
        """
        names = SIDES if len(self._streams) > 1 else ("both",)
        streams = [side.stream for side in self._sides[: len(self._streams)]]
        return {
            name: stream.describe() | (stream.fingerprint() if fingerprint else {})
            for name, stream in zip(names, streams, strict=True)
        }

    @property
    def camera_infos(self) -> tuple[tuple[str, str], ...]:
        """Name and calibration of the left and the right recording, empty if one lacks it."""
        found = [(side.stream.name, side.stream.camera_info) for side in self._sides]
        given = tuple((name, info) for name, info in found if info is not None)
        return given if len(given) == len(found) else ()

    @property
    def calibration_notes(self) -> tuple[str, ...]:
        """Notes on the calibration if none is given, one line each."""
        notes = (stream.calibration_note for stream in self._streams)
        return tuple(dict.fromkeys(filter(None, notes)))

    @property
    def rectified(self) -> bool:
        """Whether that calibration is of rectified images."""
        return all(side.stream.rectified for side in self._sides)

    def frame_id(self, camera: str) -> str:
        """Return the optical frame of ROS of the ``left`` or ``right`` images, empty if unknown.

        A frame that both recordings have is that of the left camera, as image_proc wants it.
        """
        left, right = (side.stream.frame_id for side in self._sides)
        return left if camera == "left" else right if right != left else ""

    def count(self) -> None:
        """Replace estimated numbers of images by counts; may read all of the files."""
        for stream in self._streams:
            stream.expected_images = stream.count()
        self.expected_frames = self._expected()

    @property
    def length_s(self) -> float | None:
        """Approximate duration of the shorter recording, in s; None if unknown."""
        ends = [side.stream.expected_images for side in self._sides]
        rate = self._sides[1].stream.frame_rate
        return float(min(n or 0 for n in ends) / rate) if all(ends) and rate else None

    def unpaired(self, view: int) -> Iterator[tuple[int, Grey]]:
        """Yield all images of the left (0) or the right (1) view, instead of the iteration.

        Each comes with its number: the one in its file name, if both sides have such, or its
        number in the recording.
        """
        side = self._sides[view]
        numbered = all(each.stream.numbered for each in self._sides)
        for shot in self._shots(side):
            if not isinstance(shot, Loss):
                grey = shot.views[side.half if len(self._streams) == 1 else 0]
                yield (shot.pts if numbered else shot.number), grey

    def __iter__(self) -> Iterator[StereoFrame]:
        self._frames = self._strictly() if self.settings.strict else self._deliver()
        return self._frames

    def _strictly(self) -> Generator[StereoFrame]:
        with closing(self._deliver()) as frames:
            for frame in frames:
                if damage := self.damage:  # up to and with this frame
                    raise self._stopped(damage[0])
                yield frame
        if damage := self.damage:
            raise self._stopped(damage[0])

    @staticmethod
    def _stopped(damage: str) -> InputError:
        return InputError(f"{damage}: stopped there, as --strict says")

    def begin_at(self, frame: int) -> bool:
        """Begin the iteration with some frame; the frames are the same to the byte.

        To be called before the iteration. If the recordings have the times of all images, they are
        paired without decoding, and begin at the key frames before. Otherwise all is decoded, and
        earlier frames are dropped. In the first case, earlier damage is not counted, and each
        earlier image that cannot be decoded shifts the frames by one.

        Returns:
            Whether it was the first case.
        """
        self._placed = True
        if not frame and not self.settings.first:
            return False
        if not self._passed_over(frame):
            self._forget()
            self._first_frame = frame
            return False
        return True

    def key_before(self, frame: int) -> int:
        """Return the last frame up to some frame with which decoding can begin in both views.

        The frame itself where that is not known. To be called before :meth:`begin_at`.
        """
        passed = []
        for place, left, right in self._pairs(*self._bare()):
            if place.frame is not None:
                passed.append((place.frame, left.number, right.number))
                if place.frame >= frame:
                    break
        self._forget()
        if not passed:
            return frame
        keys = [
            side.stream.key_before(number)
            for side, number in zip(self._sides, passed[-1][1:], strict=True)
        ]
        return next(first for first, *here in passed if here[0] >= keys[0] and here[1] >= keys[1])

    def _forget(self) -> None:
        """Count no image as read."""
        self._sides = [Side(side.stream, side.half) for side in self._sides]
        self._pairing = pairing(self._sides[0].stream, self._sides[1].stream, self.settings)
        self._skipped = 0

    def _bare(self) -> Sequence[Iterator[SideImage]]:
        """Return the images of both views as their recordings list them, not decoded."""
        if len(self._streams) == 1:
            return itertools.tee(bare(self._streams[0]))
        return [bare(side.stream) for side in self._sides]

    def _passed_over(self, frame: int) -> bool:
        """Count images before a frame as read, and make the recordings begin there."""
        one = len(self._streams) == 1
        for place, left, right in self._pairs(*self._bare()):
            if place.frame == frame:
                if one and left.number != right.number:
                    return False  # one recording has one beginning
                self._begin = place
                for side, shot in zip(self._sides, (left, right), strict=True):
                    side.begin_with(shot)
                    if not one or side is self._sides[0]:
                        side.stream.skip_to(shot.number)
                return True
            self._note(place, left, right)
        return False

    def _pairs(
        self, lefts: Iterator[SideImage], rights: Iterator[SideImage]
    ) -> Iterator[tuple[Selected, SideImage, SideImage]]:
        how, begin_s = self._pairing, self._sides[1].stream.begin_s
        pairs = pair(lefts, rights, how.lead, how.tolerance)
        return chosen(pairs, self._begin, self.settings, begin_s)

    def _note(self, place: Selected, left: SideImage, right: SideImage) -> None:
        self._pairing.note(left, right)
        for side, shot in zip(self._sides, (left, right), strict=True):
            side.use(shot)
        self._skipped += place.frame is None
        if place.frame == 0:
            self.first_pts = right.pts

    def _deliver(self) -> Generator[StereoFrame]:
        if not self._placed:
            self.begin_at(0)
        with ExitStack() as stack:
            feeds: list[Iterator[SideImage | Loss]] = [
                stack.enter_context(
                    closing(prefetch(self._shots(side), self.ahead, side.stream.stop))
                )
                for side in self._sides[: len(self._streams)]
            ]
            if len(feeds) == 1:
                feeds = list(itertools.tee(feeds[0]))
            left_side, right_side = self._sides
            last, place = None, None
            for place, left, right in self._pairs(
                left_side.follow(feeds[0]), right_side.follow(feeds[1])
            ):
                self._note(place, left, right)
                if last is not None:
                    left_side.repeated += left.repeats and moves(right, last[1])
                    right_side.repeated += right.repeats and moves(left, last[0])
                last = left, right
                if place.frame is not None and place.frame >= self._first_frame:
                    time_s = None if right.time_s is None else float(right.time_s)
                    grey = left.views[left_side.half], right.views[right_side.half]
                    seen = (left, right)[self._coloured].colours if self._coloured >= 0 else None
                    found = None
                    if self._given is not None:
                        of_left = self._given.view == "left"
                        found = self._given.of((left if of_left else right).number)
                    number = right_side.stream.place_of(right.number)
                    yield StereoFrame(
                        *(place.frame, right.pts, time_s, *grey, number, seen, found),
                    )
            self._to_the_end = place is None or not place.is_last
        if place is None or place.begun is None:
            raise InputError(self._nothing(0 if place is None else place.number + 1))

    def _shots(self, side: Side) -> Iterator[SideImage | Loss]:
        """Yield the results of a decoding thread, and finally the total loss."""
        s, stream = self.settings, side.stream
        views = range(2) if len(self._streams) == 1 else [self._sides.index(side)]
        if len(self._streams) == 1 and s.swap:
            views = views[::-1]
        last: Grey | None = None
        for order, image in enumerate(stream, side.begin):
            repeats, last = last is not None and same(image.grey, last), image.grey
            parts = layout.split(image.grey, s.layout)
            cut = (self._made(part, view) for part, view in zip(parts, views, strict=True))
            seen = None
            if self._coloured in views and image.colour is not None:
                whole = image.colour()
                if whole is not None:
                    part = layout.split(whole, s.layout)[list(views).index(self._coloured)]
                    seen = self._made(part, self._coloured)
            time_s = None if stream.time_base is None else image.pts * stream.time_base
            loss = Loss.of(stream)
            yield SideImage(
                *(order, image.number, image.pts, time_s, tuple(cut), repeats, loss, seen)
            )
        yield Loss.of(stream)

    def _made(self, part: Grey, view: int) -> Grey:
        """Turn, rectify, crop and scale the left or the right view."""
        degrees, mirrored = self.settings.turns[view]
        if (pinhole := self._pinholes[view]) is not None:
            part = pinhole(part)
        whole = layout.turned(part, degrees, mirrored=mirrored)
        if self._rectify is not None:
            whole = self._rectify[view](np.ascontiguousarray(whole))
        return layout.cut(whole, self._box, self.width, self.height)

    def _common_size(self) -> tuple[int, int]:
        """Return width and height in px of both whole views.

        Raises:
            InputError: they differ.
        """
        left, right = (
            self._view_size(side, degrees)
            for side, (degrees, _) in zip(self._sides, self.settings.turns, strict=True)
        )
        if left != right:
            one, other = (f"{width}x{height}" for width, height in (left, right))
            raise InputError(
                f"the left view, {self._sides[0].stream.name}, is {one} but the right one, "
                f"{self._sides[1].stream.name}, is {other}: give two recordings of the same size"
                + (", or turn one with --rotate-right 90" if left == right[::-1] else "")
            )
        return left

    def _view_size(self, side: Side, degrees: int) -> tuple[int, int]:
        each = side.stream
        size = layout.view_size(each.width, each.height, self.settings.layout, each.name)
        if (pinhole := self._pinholes[self._sides.index(side)]) is not None:
            size = pinhole.size
        return size[::-1] if degrees % 180 else size

    def _pinhole(self, side: Side) -> Pinhole | None:
        each, s = side.stream, self.settings
        if each.sphere is None or not s.project:
            return None
        return Pinhole(each.sphere, *layout.view_size(each.width, each.height, s.layout, each.name))

    def _expected(self) -> int | None:
        left, right = (side.stream for side in self._sides)
        s, rate = self.settings, right.frame_rate
        offset = s.offset or 0
        ends = [
            stream.expected_images - max(over, 0)
            for stream, over in ((left, -offset), (right, offset))
            if stream.expected_images is not None
        ]
        if s.stop is not None:
            ends.append(place_near(s.stop, rate))
        if not ends or (rate is None and Fraction in (type(s.first), type(s.stop))):
            return None
        return len(range(place_near(s.first, rate), min(ends), s.every))

    def _nothing(self, pairs: int) -> str:
        left, right = (side.stream.name for side in self._sides)
        if pairs:
            return (
                f"--start {self.settings.start} lies behind the last of {pairs} frames: give an "
                "earlier one"
            )
        return (
            f"{left} and {right} have no images that belong together: check that they are whole, "
            "their numbers, and --sync-offset and --sync-tolerance if given"
        )
