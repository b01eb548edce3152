"""Two streams, or the two halves of one, as one stream of pairs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources import layout
from motionstereo_cli.sources.folder import FolderRecording
from motionstereo_cli.sources.opening import STDIN, is_address, named, open_recording
from motionstereo_cli.sources.pairing import pair
from motionstereo_cli.sources.prefetch import prefetch
from motionstereo_cli.sources.recording import Recording, images
from motionstereo_cli.sources.settings import InputSettings, Place
from motionstereo_cli.types import StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.types import Grey

#: Images decoded ahead on each side: enough to even out key frames, little memory.
_DEPTH = 4

#: Something moves where this share of an image changes by more than so many grey levels. A still
#: scene may look the same twice to one camera, and through its encoder, and not to the other.
_MOVING_SHARE = 0.01
_MOTION_GREY = 12

SIDES = ("left", "right")


class StereoSource:
    """The stereo frames of two recordings, or of one that holds both views.

    To be iterated once, inside a ``with`` block. Images are paired by their number in the
    recording (that in the file name where both sides have it), or by time. A stream leaves the
    numbers of lost images out, so the partner of a lost image is dropped and the sides stay in
    step. Where one side is longer, the common part is processed.

    Each recording decodes in a thread of its own, a few images ahead; views are taken apart,
    rectified, cut and scaled there.

    Args:
        streams: the left and the right recording, or the one with both views; closed with this.
        settings: how to pair them, and what to use of them.

    Attributes:
        settings: as given.
        view_width, view_height: size of the whole views in px, before crop and scale.
        width, height: size of the images delivered in px.
        time_base: seconds per unit of pts (the right stream's), None where images have no time.
        frame_rate: frames delivered per second, a mean; None where nobody knows.
        expected_frames: how many there seem to be, None where nobody knows.
        paths: files and folders that are read.
        warnings: what looks wrong at the outset, one line each.

    Raises:
        InputError: the views differ in size or cannot be taken apart; while iterating: no frame
            is left.
        SettingsError: the settings need a time that the recordings do not have, or the crop
            goes beyond the views.
    """

    def __init__(
        self,
        streams: Sequence[Recording],
        settings: InputSettings | None = None,
        paths: Sequence[Path] = (),
    ) -> None:
        self.settings = s = settings or InputSettings()
        self.paths = tuple(paths)
        self._streams = list(streams)
        if len(self._streams) == 1:
            self._sides = [_Side(self._streams[0], half) for half in (0, 1)]
        else:
            self._sides = [_Side(stream) for stream in self._streams]
        if s.swap:
            self._sides.reverse()
        self._rectify: tuple[Callable[[Grey], Grey], ...] | None = None
        self._frames: Generator[StereoFrame] | None = None
        self._skipped = 0
        self._to_the_end = False
        self.warnings = [line for stream in self._streams for line in stream.warnings]

        right = self._sides[1]
        sizes = [
            layout.view_size(each.width, each.height, s.layout, each.name) for each in self._streams
        ]
        if sizes[0] != sizes[-1]:
            one, other = (f"{width}x{height}" for width, height in sizes)
            raise InputError(
                f"{self._streams[0].name} is {one} but {self._streams[1].name} is {other}: "
                "give two recordings of the same size"
            )
        self.view_width, self.view_height = sizes[0]
        self.width, self.height = s.delivered(*sizes[0])
        self._box = s.box(*sizes[0])
        for width, height in (sizes[0], (self.width, self.height)):
            if width * height > s.max_pixels:
                raise InputError(
                    f"views of {width}x{height} px are more than --max-pixels {s.max_pixels}: "
                    "raise it, or give a smaller --scale"
                )
        if s.strict and self.warnings:
            raise self._stopped(self.warnings[0])
        self.time_base = right.stream.time_base
        rate = right.stream.frame_rate
        self.frame_rate = rate / s.every if rate else None
        for flag, place in (("--start", s.first), ("--end", s.stop)):
            if isinstance(place, Fraction):
                self._need_time(flag, right.stream)
        self._lead, self._tolerance = self._pairing()
        self.expected_frames = self._expected()

    def __enter__(self) -> StereoSource:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the recordings, after ending an iteration that is still under way."""
        if self._frames is not None:
            self._frames.close()  # its threads read from what is closed next
        for stream in self._streams:
            stream.close()

    @property
    def rereadable(self) -> bool:
        """Whether another process can read the same again: not from standard input."""
        return len(self.paths) == len(self._streams)

    def rectify(self, left: Callable[[Grey], Grey], right: Callable[[Grey], Grey]) -> None:
        """Have each whole view go through a function; to be called before the iteration.

        The functions take and return (view_height, view_width) uint8; they are called in the
        decoding threads, each in one thread alone.
        """
        self._rectify = (left, right)

    @property
    def numbers(self) -> tuple[int, int | None]:
        """About which places the first and the last right image delivered have in the recording.

        None for the last where nobody knows.
        """
        right, s = self._sides[1].stream, self.settings
        first = _frame(s.first, right.frame_rate)
        if not (self._tolerance or right.numbered):
            first += max(s.sync_offset, 0)
        expected = self.expected_frames
        return first, first + (expected - 1) * s.every if expected else None

    @property
    def span_s(self) -> tuple[float | None, float | None]:
        """About when the first and the last right image delivered were taken, in s.

        None for both where images have no time, and for the last where nobody knows.
        """
        right, (first, last) = self._sides[1].stream, self.numbers
        if right.time_base is None:
            return None, None
        begin_s, rate = float(right.begin_pts * right.time_base), right.frame_rate
        if not rate:
            return begin_s, None
        return begin_s + float(first / rate), None if last is None else begin_s + float(last / rate)

    @property
    def counts(self) -> dict[str, Any]:
        """What became of the images, as far as the stereo frames delivered so far go.

        ``skipped``: pairs left out by --start, --end and --every. For ``left`` and ``right``:
        ``read`` = ``paired`` + ``unpaired`` + ``damaged``, where damaged images are those that
        should have come and did not; ``flawed``: came with visible errors, and were used;
        ``repeated``: were the image before once more while things moved in the other view, and
        were used;
        ``unread``: about how many follow, None where nobody knows.
        """
        sides = {name: side.counts for name, side in zip(SIDES, self._sides, strict=True)}
        return {"skipped": self._skipped, **sides}

    @property
    def damage(self) -> list[str]:
        """What was lost so far, one line each; complete after the iteration."""
        shown = self._sides[: len(self._streams)]
        lines = [line for side in shown for line in side.loss.damage]
        offset = 0 if self._tolerance else self.settings.sync_offset
        left, right = self._sides
        # What an offset makes stand over is no damage, nor that streams begin apart in time.
        for side, over_first, over_last in ((left, -offset, offset), (right, offset, -offset)):
            early = 0 if self._tolerance else max(side.early - max(over_first, 0), 0)
            if dropped := side.between + early:
                lines.append(
                    f"{side.stream.name}: {images(dropped)} dropped: no partner on the other side"
                )
            if side.repeated:
                lines.append(
                    f"{side.stream.name}: {images(side.repeated)} repeated while the other side "
                    "moves"
                )
            longer = side.late + (side.counts["unread"] or 0) - max(over_last, 0)
            if self._to_the_end and longer > 0:
                lines.append(
                    f"{side.stream.name}: about {images(longer)} longer than the other side: "
                    "only the common part was processed"
                )
        return lines

    def describe(self, *, fingerprint: bool = True) -> dict[str, dict[str, Any]]:
        """Return what the recordings are, as JSON-able values: ``left`` and ``right``, or ``both``.

        With ``fingerprint``, reads all files for their size and SHA-256.
        """
        names = SIDES if len(self._streams) > 1 else ("both",)
        streams = [side.stream for side in self._sides[: len(self._streams)]]
        return {
            name: stream.describe() | (stream.fingerprint() if fingerprint else {})
            for name, stream in zip(names, streams, strict=True)
        }

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

    def _deliver(self) -> Generator[StereoFrame]:
        s = self.settings
        index, begun = 0, None
        with ExitStack() as stack:
            feeds: list[Iterator[_Shot | _Loss]] = [
                stack.enter_context(closing(prefetch(self._shots(side), _DEPTH, side.stream.stop)))
                for side in self._sides[: len(self._streams)]
            ]
            if len(feeds) == 1:
                feeds = list(itertools.tee(feeds[0]))
            left_side, right_side = self._sides
            pairs = pair(
                left_side.follow(feeds[0]), right_side.follow(feeds[1]), self._lead, self._tolerance
            )
            number, last = -1, None
            for number, (left, right) in enumerate(itertools.islice(pairs, _whole(s.stop))):
                left_side.use(left)
                right_side.use(right)
                if last is not None:
                    left_side.repeated += left.repeats and _moves(right, last[1])
                    right_side.repeated += right.repeats and _moves(left, last[0])
                last = left, right
                if s.stop is not None and self._reached(s.stop, number, right):
                    self._skipped += 1
                    break
                if begun is None and self._reached(s.first, number, right):
                    begun = number
                if begun is None or (number - begun) % s.every:
                    self._skipped += 1
                    continue
                time_s = None if right.time_s is None else float(right.time_s)
                grey = left.views[left_side.half], right.views[right_side.half]
                yield StereoFrame(index, right.pts, time_s, *grey, right.number)
                index += 1
            else:
                self._to_the_end = number + 1 != _whole(s.stop)
        if index == 0:
            raise InputError(self._nothing(number + 1))

    def _shots(self, side: _Side) -> Iterator[_Shot | _Loss]:
        """Yield what a decoding thread makes, and at last what was lost in all."""
        s, stream = self.settings, side.stream
        rectify = self._rectify
        if rectify and len(self._streams) > 1:
            rectify = (rectify[self._sides.index(side)],)
        elif rectify and s.swap:
            rectify = rectify[::-1]
        last: Grey | None = None
        for order, image in enumerate(stream):
            repeats, last = last is not None and _same(image.grey, last), image.grey
            parts = layout.split(image.grey, s.layout)
            if rectify:
                parts = tuple(each(part) for each, part in zip(rectify, parts, strict=True))
            cut = (layout.cut(part, self._box, self.width, self.height) for part in parts)
            time_s = None if stream.time_base is None else image.pts * stream.time_base
            loss = _Loss.of(stream)
            yield _Shot(order, image.number, image.pts, time_s, tuple(cut), repeats, loss)
        yield _Loss.of(stream)

    def _pairing(self) -> tuple[Callable[[_Shot, _Shot], Fraction], Fraction]:
        """Return how much earlier a left image is than a right one, and how much may be."""
        left, right = (side.stream for side in self._sides)
        tolerance, offset = Fraction(str(self.settings.sync_tolerance)), self.settings.sync_offset
        if tolerance:
            self._need_time("--sync-tolerance", left)
            self._need_time("--sync-tolerance", right)
        elif left.stamped and right.stamped and not offset and left.frame_rate and right.frame_rate:
            tolerance = 1 / (2 * max(left.frame_rate, right.frame_rate))
        if tolerance:
            return _time_lead, tolerance
        if left.numbered and right.numbered:
            return lambda one, other: Fraction(other.pts - offset - one.pts), tolerance
        return lambda one, other: Fraction(other.number - offset - one.number), tolerance

    def _expected(self) -> int | None:
        left, right = (side.stream for side in self._sides)
        s, rate = self.settings, right.frame_rate
        ends = [
            stream.expected_images - max(over, 0)
            for stream, over in ((left, -s.sync_offset), (right, s.sync_offset))
            if stream.expected_images is not None
        ]
        if s.stop is not None:
            ends.append(_frame(s.stop, rate))
        if not ends or (rate is None and Fraction in (type(s.first), type(s.stop))):
            return None
        return len(range(_frame(s.first, rate), min(ends), s.every))

    def _reached(self, place: Place, number: int, shot: _Shot) -> bool:
        if isinstance(place, int):
            return number >= place
        return shot.time_s is not None and shot.time_s - self._sides[1].begin_s >= place

    def _need_time(self, flag: str, stream: Recording) -> None:
        if stream.time_base is None:
            raise SettingsError(f"{flag}: {stream.name} has no time stamps: give --frame-rate")

    def _nothing(self, pairs: int) -> str:
        left, right = (side.stream.name for side in self._sides)
        if pairs:
            return f"--start {self.settings.start} lies behind the last of {pairs} frames"
        return (
            f"{left} and {right} have no images that belong together: check that they are whole, "
            "their numbers, and --sync-offset and --sync-tolerance if given"
        )


class _Loss(NamedTuple):
    """What a stream has lost up to some image.

    It goes along with the image, for the thread that decodes is ahead by no fixed number.
    """

    lost: int
    flawed: int
    damage: tuple[str, ...]

    @classmethod
    def of(cls, stream: Recording) -> _Loss:
        return cls(stream.lost, stream.flawed, tuple(stream.damage))


class _Shot(NamedTuple):
    """One image of a recording, ready to be paired.

    Attributes:
        order: how many images came before it.
        number, pts: as in :class:`~motionstereo_cli.sources.recording.Image`.
        time_s: pts in s, None where there is no time.
        views: the view, or the two views, in it.
        repeats: the image is that before it, byte for byte.
        loss: what was lost before it.
    """

    order: int
    number: int
    pts: int
    time_s: Fraction | None
    views: tuple[Grey, ...]
    repeats: bool
    loss: _Loss


class _Side:
    """One camera: its stream, which half of its images is meant, and what became of them.

    Attributes:
        paired: images used in pairs.
        early: images that came before the first of those.
        repeated: images used that were the one before, while things moved in the other view.
        loss: what was lost up to the last image that came.
        begin_s: time of the first image.
    """

    def __init__(self, stream: Recording, half: int = 0) -> None:
        self.stream, self.half = stream, half
        self.paired = self.early = self.repeated = 0
        self.loss = _Loss(0, 0, ())
        self.begin_s = Fraction(0)
        self._came = 0
        self._last_used = -1
        self._ended = False

    def follow(self, feed: Iterator[_Shot | _Loss]) -> Iterator[_Shot]:
        """Pass the images on, and count them."""
        for item in feed:
            if isinstance(item, _Loss):
                self.loss, self._ended = item, True
                return
            if not self._came:
                self.begin_s = item.time_s or Fraction(0)
            self._came, self.loss = self._came + 1, item.loss
            yield item

    def use(self, shot: _Shot) -> None:
        """Note that an image has a partner."""
        if not self.paired:
            self.early = shot.order
        self.paired += 1
        self._last_used = shot.order

    @property
    def late(self) -> int:
        """Images that came after the last pair, if there was one."""
        return self._came - 1 - self._last_used if self.paired else 0

    @property
    def between(self) -> int:
        """Images without partner between those that have one."""
        return self._came - self.paired - self.early - self.late if self.paired else 0

    @property
    def counts(self) -> dict[str, int | None]:
        """See :attr:`StereoSource.counts`."""
        read = self._came + self.loss.lost
        expected = self.stream.expected_images
        unread = 0 if self._ended else expected and max(expected - read, 0)
        return {
            "read": read,
            "paired": self.paired,
            "unpaired": self._came - self.paired,
            "damaged": self.loss.lost,
            "flawed": self.loss.flawed,
            "repeated": self.repeated,
            "unread": unread,
        }


def _same(one: Grey, other: Grey) -> bool:
    """Return whether two images are equal; a few rows tell most that are not."""
    return np.array_equal(one[::32], other[::32]) and np.array_equal(one, other)


def _moves(shot: _Shot, last: _Shot) -> bool:
    """Return whether things move from one image to the next of the same camera."""
    changed = cv2.absdiff(shot.views[-1], last.views[-1]) > _MOTION_GREY
    return not shot.repeats and float(np.mean(changed)) > _MOVING_SHARE


def _time_lead(one: _Shot, other: _Shot) -> Fraction:
    return (other.time_s or Fraction(0)) - (one.time_s or Fraction(0))


def _frame(place: Place, rate: Fraction | None) -> int:
    """Return about which frame stands at a place."""
    return place if isinstance(place, int) else round(place * (rate or 0))


def _whole(place: Place | None) -> int | None:
    """Return a place that is the number of a frame, or None."""
    return place if isinstance(place, int) else None


def open_stereo(
    left: str | Path, right: str | Path | None = None, settings: InputSettings | None = None
) -> StereoSource:
    """Open a left and a right recording, or one that holds both views.

    Args:
        left: a video file, a folder of images, a glob pattern of images, or ``-`` for standard
            input; without ``right`` also a KITTI or EuRoC folder. With ``allow_network`` in the
            settings also an address.
        right: the like; None where ``left`` has both views.
        settings: how the views lie, which images belong together, and what to use of them.

    Raises:
        InputError: a recording is missing, cannot be decoded or has no images; both are the
            same; or their images differ in size.
        SettingsError: the settings do not fit the recordings.
    """
    settings = settings or InputSettings()
    names = named(left, right, settings)
    with ExitStack() as opened:
        streams = [opened.enter_context(closing(open_recording(name, settings))) for name in names]
        timeless = (isinstance(each, FolderRecording) and not each.stamped for each in streams)
        if settings.frame_rate and not any(timeless):
            raise SettingsError(
                f"--frame-rate is for image folders, but {names[0]} has time stamps: leave it out"
            )
        files = [Path(name) for name in names if name != STDIN and not is_address(name)]
        source = StereoSource(streams, settings, files)
        opened.pop_all()
    return source
