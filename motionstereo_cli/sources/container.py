"""A video file opened with FFmpeg: only that file, and the track of the recording."""

from __future__ import annotations

import functools
import logging
import re
from collections import Counter
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.logging
from av.format import Flags
from av.stream import Disposition

from motionstereo_cli.errors import InputError, SettingsError, is_damage, words_of
from motionstereo_cli.files.reading import HeldFile, open_regular
from motionstereo_cli.sources.pipe import PATIENCE_S, Pipe
from motionstereo_cli.sources.seeking import CodedImage

_PIPE_ADVICE = "pipe yuv4mpegpipe, Matroska, or MP4 with its index in front (-movflags +faststart)"

#: Protocols that a file may make FFmpeg open, if the network is allowed.
_NETWORK = "file,crypto,data,http,https,httpproxy,tls,tcp,udp,rtp"

#: FFmpeg's default rate of streams without times, which is not one that they state.
_FILLER = Fraction(7919, 331)

#: The flag of formats without time stamps.
_NO_TIME: int = Flags.no_timestamps.value  # type: ignore[assignment]

#: Flags of tracks that are pictures, and the number of packets by which a picture is detected.
_PICTURES = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
_PROBED_PACKETS = 200

#: Bare HEVC of several views (MV-HEVC) is not detected by its content.
_BARE_HEVC = frozenset({".hevc", ".h265", ".265"})

#: No recording was made before this year.
_NO_CLOCK = 1980

#: The head of yuv4mpegpipe that states a rate.
_Y4M_RATE = re.compile(rb"YUV4MPEG2[^\n]* F0*[1-9]")


#: Decodes the views of a multiview stream one after the other.
ALL_VIEWS = -1


class Container:
    """An open video.

    Only the file itself is read, whatever its content: FFmpeg gets it as an open file, and may
    open no other.

    Args:
        path: an existing file, a pipe, or a network address as text.
        max_pixels: largest width times height of an image.
        allow_network: let a playlist name files and network addresses.
        track: which of the video tracks, from 1; 0 = the first.
        view: which view of a multiview stream to decode, :data:`ALL_VIEWS`, or None = its base.

    Attributes:
        source: FFmpeg's container.
        stream: the track.
        track: its number, from 1.
        tracks: number of video tracks that are recordings.
        timeless: the container has no time stamps.

    Raises:
        InputError: it cannot be opened, has no such track, or is too large.
    """

    def __init__(
        self,
        path: Path | Pipe | str,
        *,
        max_pixels: int,
        allow_network: bool,
        track: int,
        view: int | None = None,
    ) -> None:
        self.path, self._view = path, view
        self._max_pixels, self._allow_network = max_pixels, allow_network
        self._held: HeldFile | None = None
        _keep_quiet()
        try:
            if isinstance(path, Path):
                self._held = HeldFile(path)
            self.source = self._opened()
        except Exception as error:
            self.close_file()
            if not is_damage(error):
                raise
            self.check()
            raise self._undecodable(error) from error
        try:
            tracks = self._tracks()
            self.tracks, self.track = len(tracks), track or 1
            if not tracks:
                raise InputError(f"{path} has no video stream: give a video file")
            if self.track > self.tracks:
                raise SettingsError(
                    f"{path} has no video track {track}: it has {self.tracks}, numbered from 1"
                )
            self.stream = tracks[self.track - 1]
            self._prepare()
        except BaseException as error:
            self.close()
            if not is_damage(error):
                raise
            raise self._undecodable(error) from error

    def _undecodable(self, error: BaseException) -> InputError:
        return InputError(
            f"{self.path} is not a video that can be decoded ({words_of(error)}): "
            f"{self.advice or 'give a whole video file, or a folder of images'}"
        )

    @property
    def advice(self) -> str:
        """What to do if it cannot be decoded, empty if nothing special."""
        return _PIPE_ADVICE if isinstance(self.path, Pipe) else ""

    @property
    def timeless(self) -> bool:
        """Whether it has no time stamps."""
        form = self.source.format
        if form.name == "yuv4mpegpipe":
            return _Y4M_RATE.match(self._head) is None
        return bool(form.flags & _NO_TIME)

    @property
    def clock(self) -> str:
        """The format, if its times are absolute; empty if they may begin anywhere."""
        name = self.source.format.name
        return name if name.startswith(("mov,", "matroska,")) else ""

    @property
    def stated_rate(self) -> Fraction | None:
        """The rate that a stream without time stamps states; known once it is decoded."""
        rate = self.stream.codec_context.framerate
        return rate if rate and rate != _FILLER else None

    @property
    def begin_s(self) -> Fraction:
        """Begin of the container, as it states it."""
        return Fraction(self.source.start_time or 0, av.time_base)

    @property
    def created(self) -> datetime | None:
        """Creation time of the file, None if unknown."""
        said = self.stream.metadata.get("creation_time") or self.source.metadata.get(
            "creation_time"
        )
        try:
            found = datetime.fromisoformat(said) if said else None
        except ValueError:
            return None
        # Clocks that are not set begin in 1904 or 1970.
        return found if found and found.tzinfo and found.year > _NO_CLOCK else None

    @property
    def timecode(self) -> str:
        """Time code of the first image (hours:minutes:seconds:frames), empty if it has none."""
        told = [self.stream.metadata, *(each.metadata for each in self.source.streams)]
        found = (each["timecode"] for each in (*told, self.source.metadata) if "timecode" in each)
        return next(found, "")

    @property
    def size_bytes(self) -> int | None:
        """Size in bytes, of a pipe so far; None for an address."""
        if isinstance(self.path, Pipe):
            return self.path.bytes_read
        return None if self._held is None else self._held.size_bytes

    @property
    def changed(self) -> bool:
        """Whether the file was written to since it was opened."""
        return self._held is not None and self._held.changed

    def fingerprint(self) -> dict[str, Any]:
        """Return size in bytes and SHA-256 of the open file, or of the pipe's data."""
        if isinstance(self.path, Pipe):
            return {"bytes": self.path.bytes_read, "sha256": self.path.sha256}
        if self._held is None:
            return {"bytes": None, "sha256": None}
        return {"bytes": self._held.size_bytes, "sha256": self._held.sha256()}

    def check(self) -> None:
        """Raise the reason why a wait for the pipe ended.

        Raises:
            InputError: no data came.
            KeyboardInterrupt: the user interrupted it.
        """
        if isinstance(self.path, Pipe):
            if self.path.interrupted:
                raise KeyboardInterrupt from None
            if self.path.silent:
                raise InputError(
                    f"{self.path}: nothing came for {PATIENCE_S:.0f} s: see that a program writes "
                    "a video to it"
                ) from None

    def stop(self) -> None:
        """End a wait for the pipe."""
        if isinstance(self.path, Pipe):
            self.path.stop()

    def close(self) -> None:
        """Close the file."""
        self.source.close()
        self.close_file()

    def close_file(self) -> None:
        """Close the file that FFmpeg was given."""
        if isinstance(self.path, Pipe):
            self.path.close()
        elif self._held is not None:
            self._held.close()

    def count(self) -> int | None:
        """Count the images of the track by reading the whole file; None for a pipe."""
        if self._held is None:
            return None
        try:
            with self._opened() as again:
                stream = again.streams[self.stream.index]
                return sum(packet.size > 0 for packet in again.demux(stream))
        except Exception as error:
            if not is_damage(error):
                raise
            return None

    def coded(self) -> list[CodedImage]:
        """Return all coded images of the track, by reading the whole file.

        Empty if that is impossible, or without times of presentation.
        """
        if self._held is None:
            return []
        try:
            with self._opened() as again:
                found = again.demux(again.streams[self.stream.index])
                packets = [(each.pts, each.is_keyframe) for each in found if each.size]
        except Exception as error:
            if not is_damage(error):
                raise
            return []
        told = [CodedImage(pts, is_key) for pts, is_key in packets if pts is not None]
        return told if len(told) == len(packets) else []

    def seek(self, pts: int) -> None:
        """Go to the key frame at a time stamp, or to one before.

        Raises:
            av.FFmpegError: the container cannot be seeked.
        """
        self.source.seek(pts, stream=self.stream, backward=True)

    def rewind(self) -> None:
        """Begin again; a damaged file that cannot be seeked is opened anew.

        Raises:
            InputError: it cannot be opened any more.
        """
        try:
            self.source.seek(0, backward=True, any_frame=False)
        except (av.FFmpegError, OSError):
            index = self.stream.index
            self.source.close()
            try:
                self.source = self._opened()
                again: Any = self.source.streams[index]
                self.stream = again
                self._prepare()
            except (av.FFmpegError, OSError, LookupError) as error:
                raise self._undecodable(error) from error

    @property
    def _head(self) -> bytes:
        if isinstance(self.path, Pipe):
            return self.path.head
        return self._held.head if self._held is not None else b""

    def _opened(self) -> av.container.InputContainer:
        limits = self._limits() | {"framerate": str(_FILLER)}
        # Metadata may be invalid text, and does not matter.
        opened = functools.partial(av.open, mode="r", metadata_errors="replace")
        path = self.path
        if isinstance(path, Pipe):
            return opened(path, options=limits | {"protocol_whitelist": "none"})
        if isinstance(path, str):
            return opened(path, options=limits, timeout=PATIENCE_S)
        if self._allow_network:
            # An absolute path: FFmpeg takes what precedes a colon for a protocol.
            options = limits | {"protocol_whitelist": _NETWORK, "allowed_extensions": "ALL"}
            return opened(str(path.absolute()), options=options, timeout=PATIENCE_S)
        with open_regular(path) as file:  # FFmpeg duplicates it
            if self._held is not None:
                self._held.check_same(file)
            options = limits | {"fd": str(file.fileno()), "protocol_whitelist": "fd"}
            try:
                return opened("fd:", options=options)
            except av.InvalidDataError:
                if path.suffix.lower() not in _BARE_HEVC:
                    raise
                file.seek(0)
                return opened("fd:", options=options, format="hevc")

    def _limits(self) -> dict[str, str]:
        # Twice, because coded images have a margin. This limits sizes that the header does not
        # state.
        return {"max_pixels": str(2 * self._max_pixels)}

    def _tracks(self) -> list[av.VideoStream]:
        """Return the video tracks that are recordings: no covers, thumbnails and posters."""
        tracks = [each for each in self.source.streams.video if not each.disposition & _PICTURES]
        if len(tracks) < 2 or self._held is None:
            return tracks
        counts: Counter[int] = Counter()
        with self._opened() as again:
            videos = list(again.streams.video)
            for number, packet in enumerate(again.demux(videos)):
                counts[packet.stream_index] += packet.size > 0
                if number == _PROBED_PACKETS:
                    break
        films = [each for each in tracks if counts[each.index] > 1]
        return films or tracks

    def _prepare(self) -> None:
        codec = self.stream.codec_context
        if codec is None:  # the type stub says otherwise
            raise InputError(f"{self.path} is in a format that cannot be decoded: convert it")
        if codec.width * codec.height > self._max_pixels:
            raise InputError(
                f"{self.path} is {codec.width}x{codec.height}: that is more than --max-pixels "
                f"{self._max_pixels}, raise it if the video is to be trusted"
            )
        if self.stream.time_base is None:
            raise InputError(f"{self.path} has no time base: convert it to MP4 or Matroska")
        codec.thread_count = 1
        # Only a multiview stream knows the option.
        views = {} if self._view is None else {"view_ids": str(self._view)}
        codec.options = self._limits() | views


def _keep_quiet() -> None:
    """Make FFmpeg's errors go only to those who capture them."""
    av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    logging.getLogger("libav").setLevel(logging.CRITICAL + 1)
