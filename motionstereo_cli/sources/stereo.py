"""Two streams as one stream of pairs."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

from motionstereo_cli.errors import InputError
from motionstereo_cli.sources.folder import FolderStream
from motionstereo_cli.sources.prefetch import prefetch
from motionstereo_cli.sources.stream import Image, Stream, images
from motionstereo_cli.sources.video import VideoStream
from motionstereo_cli.types import StereoFrame

#: Images decoded ahead on each side: enough to even out key frames, little memory.
_DEPTH = 4


class StereoSource:
    """The stereo frames of two recordings; to be iterated once, inside a ``with`` block.

    Images are paired by their number in the recording. A stream leaves the numbers of lost
    images out, so the partner of a lost image is dropped and the streams stay in step. Where
    one recording is longer, the common part is processed.

    Each side decodes in a thread of its own, a few images ahead.

    Attributes:
        width, height: size of the images in px.
        time_base: seconds per unit of pts (the right stream's), None where images have no time.
        expected_frames: how many pairs there seem to be, None where nobody knows.
        counts: for ``left`` and ``right``: images ``read``, ``damaged`` (corrupt or lost) and
            ``unpaired`` (not used because their partner is lost or was never there).
        damage: what was lost, one line each; complete after the iteration.
    """

    def __init__(self, left: Path, right: Path) -> None:
        self._paths = {"left": left, "right": right}
        self._streams: dict[str, Stream] = {}
        self._read = dict.fromkeys(self._paths, 0)
        self._dropped = dict.fromkeys(self._paths, 0)
        self._longer = dict.fromkeys(self._paths, 0)
        self._pairs: Generator[StereoFrame] | None = None
        try:
            for side, path in self._paths.items():
                self._streams[side] = _open_stream(path)
            self._check_sizes()
        except BaseException:
            self.close()
            raise
        first, second = self._streams.values()
        self.width, self.height = second.width, second.height
        self.time_base: Fraction | None = second.time_base
        expected = [
            each.expected_images for each in (first, second) if each.expected_images is not None
        ]
        self.expected_frames: int | None = min(expected, default=None)

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
        """Close both recordings, after ending an iteration that is still under way."""
        if self._pairs is not None:
            self._pairs.close()  # its threads read from what is closed next
        for stream in self._streams.values():
            stream.close()

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Images read, damaged and unpaired on each side so far."""
        return {
            side: {
                "read": self._read[side],
                "damaged": stream.damaged,
                "unpaired": self._dropped[side] + self._longer[side],
            }
            for side, stream in self._streams.items()
        }

    @property
    def damage(self) -> list[str]:
        """What was lost so far, one line each."""
        lines = [line for stream in self._streams.values() for line in stream.damage]
        for side, path in self._paths.items():
            if self._dropped[side]:
                lines.append(
                    f"{path}: {images(self._dropped[side])} dropped: lost on the other side"
                )
            if self._longer[side]:
                lines.append(
                    f"{path}: about {images(self._longer[side])} longer than the other side: "
                    "only the common part was processed"
                )
        return lines

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return what the ``left`` and ``right`` recordings are, as JSON-able values.

        Reads both recordings wholly for their SHA-256.
        """
        return {side: stream.describe() for side, stream in self._streams.items()}

    def __iter__(self) -> Iterator[StereoFrame]:
        self._pairs = self._pair()
        return self._pairs

    def _pair(self) -> Generator[StereoFrame]:
        left_stream, right_stream = self._streams.values()
        with (
            closing(prefetch(left_stream, _DEPTH)) as lefts,
            closing(prefetch(right_stream, _DEPTH)) as rights,
        ):
            index = 0
            left, right = self._next("left", lefts), self._next("right", rights)
            while left is not None and right is not None:
                if left.number < right.number:
                    self._dropped["left"] += 1
                    left = self._next("left", lefts)
                elif right.number < left.number:
                    self._dropped["right"] += 1
                    right = self._next("right", rights)
                else:
                    yield self._frame(index, left, right)
                    index += 1
                    left, right = self._next("left", lefts), self._next("right", rights)
            self._note_leftover("left", left)
            self._note_leftover("right", right)

    def _next(self, side: str, stream: Iterator[Image]) -> Image | None:
        image = next(stream, None)
        self._read[side] += image is not None
        return image

    def _frame(self, index: int, left: Image, right: Image) -> StereoFrame:
        time_s = None if self.time_base is None else float(right.pts * self.time_base)
        return StereoFrame(index, right.pts, time_s, left.grey, right.grey)

    def _note_leftover(self, side: str, image: Image | None) -> None:
        # How much more there is, is looked up and not decoded: it may be hours.
        if image is None:
            return
        self._longer[side] = max((self._streams[side].expected_images or 0) - image.number, 1)

    def _check_sizes(self) -> None:
        left, right = self._streams.values()
        if (left.width, left.height) != (right.width, right.height):
            raise InputError(
                f"{self._paths['left']} is {left.width}x{left.height} but {self._paths['right']} "
                f"is {right.width}x{right.height}: give two recordings of the same size"
            )


def open_stereo(left: Path, right: Path) -> StereoSource:
    """Open a left and a right recording, each a video file or a folder of images.

    Raises:
        InputError: one is missing, cannot be decoded or has no images; both are the same; or
            their images differ in size.
    """
    for path in (left, right):
        if not path.exists():
            raise InputError(f"there is no file or folder {path}: check the path")
    if left.samefile(right):
        raise InputError(
            f"{left} and {right} are the same recording: give those of two different cameras"
        )
    return StereoSource(left, right)


def _open_stream(path: Path) -> Stream:
    return FolderStream(path) if path.is_dir() else VideoStream(path)
