"""A recording in several files: chapters of action cameras, parts of dashcams, numbered pieces."""

from __future__ import annotations

import bisect
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import sha256_of, sha256_of_all
from motionstereo_cli.sources.names import file_numbers, gaps, natural_key
from motionstereo_cli.sources.recording import Image, Recording
from motionstereo_cli.sources.video import VideoRecording

#: Suffixes of videos that may be parts of one recording.
SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg"}
    | {".wmv", ".3gp", ".flv", ".h264", ".264", ".hevc", ".h265", ".265", ".mjpeg", ".mjpg"}
)

#: GoPro's names: the chapter precedes the number of the recording; the first chapter of older
#: cameras has none.
_GOPRO = re.compile(r"G[A-Z](?P<chapter>\d\d)(?P<recording>\d{4})|GOPR(?P<first>\d{4})", re.I)

#: Tolerance of creation times in s: they are whole seconds, and earlier than the first image.
_CREATED_WITHIN_S = Fraction(5, 2)

#: Tolerance of times that continue from file to file, in s.
_LONGEST_GAP_S = 3600


def parts_of(name: str, files: Sequence[Path]) -> list[Path]:
    """Return the videos among files in the order of recording.

    Raises:
        InputError: they belong to several recordings, or their order is unknown.
    """
    videos = [each for each in files if each.suffix.lower() in SUFFIXES and each.is_file()]
    chapters = {video: _GOPRO.fullmatch(video.stem) for video in videos}
    recordings = {found["recording"] or found["first"] for found in chapters.values() if found}
    if len(recordings) > 1:
        listed = ", ".join(sorted(recordings))
        raise InputError(
            f"{name} holds several recordings, of the numbers {listed}: give the chapters of one, "
            f"as a pattern such as 'G???{min(recordings)}.MP4'; if these are of the two "
            "cameras, those of each as LEFT and RIGHT"
        )
    forms = {
        re.sub(r"\d+", "#", each.stem) + each.suffix.lower(): each.name for each in sorted(videos)
    }
    if len(forms) > 1 and not all(chapters.values()):
        examples = ", ".join(sorted(forms.values()))
        raise InputError(
            f"{name} holds videos whose names are not of one form ({examples}): "
            "give those that follow one another, as a quoted pattern"
        )
    return sorted(videos, key=lambda video: natural_key(_in_order(video)))


def _in_order(video: Path) -> str:
    """Return a sort key that puts the first chapter of older GoPros before the others."""
    return re.sub(r"^GOPR(?=\d{4}$)", "GP00", video.stem, flags=re.I)


def next_chapter(path: Path) -> Path | None:
    """Return the next chapter of a GoPro recording, if it exists beside this one."""
    found = _GOPRO.fullmatch(path.stem)
    if found is None:
        return None
    chapter = int(found["chapter"] or 0) + 1
    number, letters = found["recording"] or found["first"], path.stem[:2]
    following = path.with_name(f"{letters}{chapter:02d}{number}{path.suffix}")
    if found["first"]:
        following = path.with_name(f"GP{chapter:02d}{number}{path.suffix}")
    return following if following.is_file() else None


def missing_files(files: Sequence[Path]) -> list[str]:
    """Return a line that names the gaps in the numbers of files."""
    found = [_GOPRO.fullmatch(file.stem) for file in files]
    if all(found):
        chapters = [int(each["chapter"] or 0) for each in found if each]
        # With one before them: two files alone do not show that numbers count by 1.
        lines = gaps([chapters[0] - 1, *chapters])
        begin = 0 if files[0].stem.upper().startswith("GP") else 1
        if chapters[0] > begin:
            lines.insert(0, f"begins with {files[0].name}: the chapters before it are not there")
        return lines
    return gaps(file_numbers([file.stem for file in files]) or [0])


class _Part(NamedTuple):
    """One of the files: its metadata, and the shift of its times.

    Attributes:
        path: the file.
        time_base: seconds per unit of its time stamps, None if it has none.
        shift_s: added to its times.
        begin_s, end_s: times of its first image, and of the end of its last, in the recording.
        created: creation time, None if unknown.
    """

    path: Path
    time_base: Fraction | None
    shift_s: Fraction
    begin_s: Fraction
    end_s: Fraction
    created: datetime | None


class JoinedRecording(Recording):
    """The images of several videos, one after the other, as one recording.

    Numbers continue from file to file, and so do times: if those of a file do not begin after the
    previous file, they are shifted to its end. A file that cannot be opened is skipped and
    counted as damage.

    Args:
        name: the folder or pattern that was given.
        files: the files, in order.
        opened: opens one of them.

    Raises:
        InputError: none can be opened, or their images differ in size.
    """

    def __init__(
        self, name: str, files: Sequence[Path], opened: Callable[[Path], VideoRecording]
    ) -> None:
        self.name, self._given, self._opened = name, tuple(files), opened
        self._damage: list[str] = []
        self._lost = self._flawed = 0
        self._current: VideoRecording | None = None
        self._parts: list[_Part] = []
        self._firsts: list[int] = []  # number of the first image of each, once known
        places: list[int | None] = []
        for file in files:
            try:
                recording = opened(file)
            except InputError as error:
                self._damage.append(f"{file} is left out: {error}")
                continue
            with closing(recording):
                if not self._parts:
                    self._take_over(recording)
                self._append(file, recording)
                places.append(recording.expected_images)
        if not self._parts:
            raise InputError(self._damage[0])
        self.expected_images = sum(n or 0 for n in places) if all(places) else None
        if missing := missing_files(files):
            self.warnings += tuple(f"{name}: {line}" for line in missing)
            self.holes = self.warnings[-1]
        self._images = self._read()

    def _take_over(self, first: VideoRecording) -> None:
        """Take over the properties of the first file."""
        self.width, self.height = first.width, first.height
        self.time_base, self.frame_rate = first.time_base, first.frame_rate
        self.begin_pts, self.begin_s = first.begin_pts, first.begin_s
        self.timed, self.clock, self.timeless = first.timed, first.clock, first.timeless
        self.metadata, self.stated, self.unread = first.metadata, first.stated, first.unread
        self.multiview, self.sphere = first.multiview, first.sphere
        self.likely_white, self.warnings = first.likely_white, first.warnings
        self._first_said = first.describe()

    def _append(self, file: Path, recording: VideoRecording) -> None:
        """Append a file, and note what is missing before it."""
        size = recording.width, recording.height
        if size != (self.width, self.height) or recording.timeless != self.timeless:
            raise InputError(
                f"{file} is {size[0]}x{size[1]} but {self._parts[0].path} is {self.width}x"
                f"{self.height}: the files of one recording are alike: give those, as a pattern"
            )
        begin_s, length_s, shift_s = recording.begin_s, recording.length_s, Fraction(0)
        if self._parts:
            last = self._parts[-1]
            period_s = 1 / self.frame_rate if self.frame_rate else Fraction(0)
            missing_s = begin_s - last.end_s
            if not -period_s / 2 <= missing_s <= _LONGEST_GAP_S:
                shift_s = -missing_s
                missing_s = Fraction(0)
                if last.created and recording.created:
                    apart_s = (recording.created - last.created).total_seconds()
                    missing_s = Fraction(apart_s) - (last.end_s - last.begin_s)
            if missing_s > max(period_s, _CREATED_WITHIN_S if shift_s else 0):
                how = "by their creation times: times go on without them" if shift_s else ""
                self.warnings += (
                    f"about {float(missing_s):.1f} s are missing between {last.path} and {file} "
                    f"{how}".rstrip(),
                )
        begin_s += shift_s
        self._parts.append(
            _Part(
                file, recording.time_base, shift_s, begin_s, begin_s + length_s, recording.created
            )
        )

    @property
    def lost(self) -> int:
        """Images not decodable or missing so far."""
        return self._lost + (self._current.lost if self._current else 0)

    @property
    def flawed(self) -> int:
        """Images decoded with errors so far."""
        return self._flawed + (self._current.flawed if self._current else 0)

    @property
    def damage(self) -> list[str]:
        """What was damaged so far, one line for each kind and file."""
        return [*self._damage, *(self._current.damage if self._current else ())]

    @property
    def files(self) -> tuple[Path, ...]:
        """All files."""
        return self._given

    def describe(self) -> dict[str, Any]:
        """Describe the recording, as JSON-able values: its first file, and the number of files."""
        more = {"path": self.name, "files": len(self._given), "images": self.expected_images}
        return self._first_said | more

    def fingerprint(self) -> dict[str, Any]:
        """Return the size of all files in bytes, and their SHA-256, see :func:`sha256_of_all`."""
        return {
            "bytes": sum(file.stat().st_size for file in self._given),
            "sha256": sha256_of_all((sha256_of(file), file.name) for file in self._given),
        }

    def count(self) -> int | None:
        """Count the images of the files, by their indices or by reading them."""
        total = 0
        for part in self._parts:
            with closing(self._opened(part.path)) as recording:
                counted = recording.count()
            if counted is None:
                return None
            total += counted
        return total

    def outline(self) -> Sequence[tuple[int, int]]:
        """Return numbers and time stamps, by reading all files."""
        found: list[tuple[int, int]] = []
        firsts = []
        for part in self._parts:
            firsts.append(found[-1][0] + 1 if found else 0)
            with closing(self._opened(part.path)) as recording:
                outline = recording.outline()
            if not outline:
                return ()
            found += [(firsts[-1] + n, self._pts(part, pts, firsts[-1])) for n, pts in outline]
        self._firsts = firsts
        return found

    def skip_to(self, number: int) -> bool:
        """Begin with an image, by seeking in its file."""
        if not self._firsts and not self.outline():
            return super().skip_to(number)
        index = bisect.bisect_right(self._firsts, number) - 1
        self._images = self._read(index, number)
        return True

    def close(self) -> None:
        """Close the file that is being read."""
        if self._current is not None:
            self._current.close()

    def _pts(self, part: _Part, pts: int, first: int) -> int:
        """Convert a time stamp of a file to the recording's."""
        if self.time_base is None or part.time_base is None or self.timeless:
            return first + pts
        if part.time_base == self.time_base:
            return pts + round(part.shift_s / self.time_base)
        return round((pts * part.time_base + part.shift_s) / self.time_base)

    def _read(self, index: int = 0, number: int = 0) -> Iterator[Image]:
        """Yield the images from a number on, which is in the file with an index."""
        first = self._firsts[index] if index else 0
        for part in self._parts[index:]:
            with closing(self._opened(part.path)) as recording:
                self._current = recording
                if number > first:
                    recording.skip_to(number - first)
                last, lost = -1, 0
                for image in recording:
                    last, lost = image.number, recording.lost
                    pts = self._pts(part, image.pts, first)
                    yield Image(first + image.number, pts, image.grey, image.colour)
                first += last + 1 + recording.lost - lost
                self._current = None
                self._damage += recording.damage
                self._lost += recording.lost
                self._flawed += recording.flawed
