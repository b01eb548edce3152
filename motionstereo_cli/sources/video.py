"""One camera from a video file, decoded with PyAV."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import av.logging
import numpy as np

from motionstereo_cli.errors import is_damage, words_of
from motionstereo_cli.files.reading import MAX_PIXELS
from motionstereo_cli.sources.container import Container
from motionstereo_cli.sources.h264 import SliceHeaders
from motionstereo_cli.sources.luma import (
    bits_of,
    brightest,
    colours,
    grey_levels,
    has_colour,
    is_full_range,
)
from motionstereo_cli.sources.pace import Pace, rhythm
from motionstereo_cli.sources.pipe import Pipe
from motionstereo_cli.sources.recording import Image, Recording, images
from motionstereo_cli.sources.seeking import CodedImage, Entry, entry, numbered
from motionstereo_cli.sources.stereo3d import anaglyph, view_id, view_metadata

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.types import Grey

    _Packet = av.Packet[av.VideoStream]

#: The decoder of this codec reports wrong checksums only in FFmpeg's log.
_TELLS_THE_LOG = "ffv1"

#: Decoders that use missing references without reporting it.
_SILENT = {
    *("mpeg1video", "mpeg2video", "mpeg4", "msmpeg4v2", "msmpeg4", "wmv1", "wmv2", "flv", "h263"),
    *("vp8", "vp9", "libvpx", "libvpx-vp9", "av1", "libdav1d", "libaom-av1", "theora", "vc1"),
}


class VideoRecording(Recording):
    """The grey images of a video file, in order of presentation.

    Grey is the luma plane, expanded to 0..255 where the stream is limited range; RGB streams
    give BT.601 luma. Time stamps are those of the file, not shifted to begin at 0; if the
    container has none, as bare H.264, times follow from the images' numbers and the stream's rate,
    or ``rate``. Rotation metadata is applied.

    Images with visible decoding errors are delivered and counted, and so are those decoded from
    them or in place of lost ones, until the next key frame. The number of an image that cannot be
    decoded is skipped, so that later numbers stay correct. The same holds for images missing from
    the file: its index lists more images than come, or time stamps have a gap at a constant rate.

    Decoding uses one thread: with more, FFmpeg decodes damaged files differently each time, and
    with slice threads it does not report the damage.

    Args:
        path: an existing file, a pipe, or a network address as text.
        rate: images per second if the container has no times; None = as the stream states.
        track: which of the video tracks, from 1; 0 = the first.
        white: level that becomes 255; 0 = the largest that the bits can say.
        max_pixels: largest width times height of an image.
        allow_network: let a playlist name files and network addresses.
        view: which view of a multiview stream (MV-HEVC), None = its base view.

    Raises:
        InputError: not a video, too large, or none of its images can be decoded.
        SettingsError: it has no such track.
    """

    def __init__(
        self,
        path: Path | Pipe | str,
        *,
        rate: Fraction | None = None,
        track: int = 0,
        white: int = 0,
        max_pixels: int = MAX_PIXELS,
        allow_network: bool = False,
        view: int | None = None,
    ) -> None:
        self._path, self._white = path, white
        self.rereadable = isinstance(path, Path)
        self._corrupt = self._undecodable = self._cut_off = 0
        self._failed: list[int] = []  # pts of packets without an image, not yet passed
        self._torn_from: int | None = None  # pts from which on references are missing
        self._packets = 0
        self._usual_ticks: int | None = None  # from packet to packet, where none is missing
        self._packet_end = 0  # in bytes from the beginning of the file
        self._end_error = ""
        self._changed = False
        self._file = Container(
            path, max_pixels=max_pixels, allow_network=allow_network, track=track, view=view
        )
        try:
            self._begin(rate)
            self._start(self._read(), path, self._file.advice)
            self._file.check()
        except BaseException:
            self._file.close()
            self._file.check()
            raise
        if self._file.tracks > 1 and not track:
            self.warnings += (
                f"{path} has {self._file.tracks} video tracks, of which the first is used: choose "
                "with --track, or --layout tracks where two are left and right",
            )

    def _begin(self, rate: Fraction | None) -> None:
        """Read numbers and times from the container."""
        stream = self._file.stream
        self._stream, self._tick_s = stream, stream.time_base or Fraction(1)
        self.timeless, self._listed = self._file.timeless, self._count_listed()
        if self.timeless:
            self.time_base, self.frame_rate = (1 / rate if rate else None), rate
            self.expected_images: int | None = None
            self._pace = Pace(None, self._tick_s, steady=False, places=None)
            return
        self.timed, self.clock = True, self._file.clock
        self.time_base = self._tick_s
        self.frame_rate = stream.average_rate or stream.guessed_rate
        self.expected_images = self._listed or stream.frames or self._count_by_length()
        steady = None
        if self._listed:
            found = rhythm([entry.timestamp for entry in stream.index_entries], self._tick_s)
            steady = found.rate is not None
            if found.places > self._listed:
                self.expected_images, self.frame_rate = found.places, found.rate
        self._places, self._steady = self.expected_images, steady
        self._pace = self._new_pace()

    def _new_pace(self) -> Pace:
        return Pace(self.frame_rate, self._tick_s, steady=self._steady, places=self._places)

    def outline(self) -> Sequence[tuple[int, int]]:
        """Return numbers and time stamps, by reading the whole file."""
        return () if self.timeless else list(numbered(self._coded, self._new_pace()))

    @functools.cached_property
    def _coded(self) -> list[CodedImage]:
        return self._file.coded()

    def key_before(self, number: int) -> int:
        """Return the number of the key frame before an image."""
        found = self._entry(number)
        return number if found is None else found[0].key_number

    def _entry(self, number: int) -> tuple[Entry, Pace] | None:
        """Return where to begin for an image, and the pace there; None if that is unknown."""
        if self.timeless:
            return None
        pace = self._new_pace()
        found = entry(self._coded, pace, number)
        return None if found is None else (found, pace)

    def skip_to(self, number: int) -> bool:
        """Begin with an image, by seeking to the key frame before it if the file has an index.

        Images that cannot be decoded count as well, so that numbers are the same.
        """
        if (entered := self._entry(number)) is None:
            return super().skip_to(number)
        found, pace = entered
        try:
            self._file.seek(found.key_pts)
            packets = self._file.source.demux(self._stream)
            first = next(packets)
            place = [each.pts for each in self._coded].index(first.pts or 0)
            if not first.is_keyframe or (first.pts or 0) > found.pts:
                raise ValueError
        except (av.FFmpegError, OSError, StopIteration, ValueError):
            self._file.rewind()
            self._stream = self._file.stream
            self._images = self._read()
            return super().skip_to(number)
        self._pace, self._packets = pace, place
        self._images = self._read(itertools.chain([first], packets), found)
        return place > 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def stop(self) -> None:
        """End a wait for a pipe."""
        self._file.stop()

    @property
    def files(self) -> tuple[Path, ...]:
        """The file; empty for a pipe or an address."""
        return (self._path,) if isinstance(self._path, Path) else ()

    @property
    def lost(self) -> int:
        """Images not decodable or missing so far."""
        return self._undecodable + self._pace.missing + self._cut_off

    @property
    def flawed(self) -> int:
        """Images decoded with errors so far."""
        return self._corrupt

    @property
    def damage(self) -> list[str]:
        """Damage so far, one line for each kind."""
        found = {
            "decoded with errors, or after errors and before a key frame": self._corrupt,
            "could not be decoded": self._undecodable,
            f"missing within the video{self._behind_holes}": self._pace.missing,
            "missing at its end": self._cut_off,
        }
        lines = [f"{self._path}: {images(n)} {what}" for what, n in found.items() if n]
        if self._pace.pause:
            lines.append(
                f"{self._path}: time stamps leap by {self._pace.pause[0]:.1f} s at "
                f"{self._pace.pause[1]:.1f} s: the recording paused, or images are missing"
            )
        if self._end_error:
            lines.append(f"{self._path}: reading stopped early: {self._end_error}")
        if self._changed:
            lines.append(f"{self._path} was written to while the run went on")
        return lines

    @property
    def _behind_holes(self) -> str:
        """A note on images after missing ones that may be wrong without a report."""
        name = self._stream.codec_context.name
        if name not in _SILENT:
            return ""
        return (
            f" (if the file lost them, those up to the next key frame may be wrong: {name} does "
            "not tell)"
        )

    def describe(self) -> dict[str, Any]:
        """Describe the video, as JSON-able values."""
        more: dict[str, Any] = {"track": self._file.track} if self._file.tracks > 1 else {}
        if self._file.created:
            more["created"] = self._file.created.isoformat()
        if self._file.timecode:
            more["timecode"] = self._file.timecode
        if self.multiview:
            more["view"] = self.metadata.eye or "base"
        if self.sphere is not None:
            more["projection"] = str(self.sphere)
        codec, levels = self._stream.codec_context.name, "full" if self._full_range else "limited"
        turn = 90 * self._quarters  # counter-clockwise
        said = self._described(
            *(self._path, "video", codec), levels=levels, rotation_deg=turn, **more
        )
        return said | {"images": self._listed or self.expected_images}

    def fingerprint(self) -> dict[str, Any]:
        """Return size in bytes and SHA-256 of the file, or of the pipe's data."""
        return self._file.fingerprint()

    def count(self) -> int | None:
        """Count the images of the file, by its index or by reading all of it."""
        return self._listed or self._file.count()

    def _count_listed(self) -> int | None:
        # Only the index of MP4 is reliable, not its frame count, which includes what the edit
        # list cuts away. AVI counts empty places. A fragmented MP4 has no index of the whole.
        if self._stream.frames and "mp4" in self._file.source.format.name:
            return len(self._stream.index_entries)
        return None

    def _count_by_length(self) -> int | None:
        length_s = self._stated_length_s()
        return round(length_s * self.frame_rate) if length_s and self.frame_rate else None

    def _stated_length_s(self) -> Fraction | None:
        if self._stream.duration is not None:
            return self._stream.duration * self._tick_s
        # Matroska states only the end of its longest stream.
        container = self._file.source
        if container.duration is not None and len(container.streams) == 1:
            return Fraction(container.duration, av.time_base) - self._file.begin_s
        return None

    @property
    def length_s(self) -> Fraction:
        """Time from the first image to the end of the last, if the file states it."""
        if (stated_s := self._stated_length_s()) is not None and not self.timeless:
            return stated_s
        return (
            Fraction(self.expected_images or 0) / self.frame_rate
            if self.frame_rate
            else Fraction(0)
        )

    @property
    def created(self) -> datetime | None:
        """Creation time of the file, None if unknown."""
        return self._file.created

    def _read(
        self, packets: Iterator[_Packet] | None = None, begin: Entry | None = None
    ) -> Iterator[Image]:
        number, last_pts = -1, None
        shape: tuple[int, ...] | None = (self.height, self.width) if begin else None
        flawed = False
        for frame, complained in self._decode(packets or self._file.source.demux(self._stream)):
            pts = self._pts(frame, last_pts)
            if shape is None:
                self._look_at(frame)
            grey = _rotated(grey_levels(frame, self._white), self._quarters)
            if shape is not None and grey.shape != shape:
                self._fail(pts)  # a damaged header, or a change that cannot be followed
                continue
            shape = grey.shape
            failed = self._failed_before(pts)
            if begin and pts > begin.pts and last_pts is None:  # that one cannot be decoded
                number, last_pts, failed = begin.number, begin.pts, 0
            lost = failed
            if last_pts is not None:
                lost += self._pace.hole(last_pts, pts, failed, number)
            # Errors of an image spread to all that are decoded from it.
            torn = self._torn_from is not None and pts >= self._torn_from
            inherited = (flawed or failed > 0 or torn) and not frame.key_frame
            if torn:
                self._torn_from = None
            flawed = frame.is_corrupt or complained or inherited
            if begin and pts < begin.pts:
                continue
            self._corrupt += flawed
            number = begin.number if begin and pts == begin.pts else number + 1 + lost
            last_pts = pts
            colour = functools.partial(_colours, frame, self._quarters) if self._coloured else None
            yield Image(number, number if self.timeless else pts, grey, colour)
        self._cut_off = self._lost_at_end(last_pts)
        self._changed = self._file.changed

    def _look_at(self, frame: av.VideoFrame) -> None:
        """Note what the first image tells about all."""
        self._quarters = round(frame.rotation / 90) % 4
        self._coloured = has_colour(frame)
        self._pixel_format, self._full_range = frame.format.name, is_full_range(frame)
        metadata = view_metadata(frame, self._stream.sample_aspect_ratio)
        self.metadata, self.stated, self.sphere = metadata, metadata.stated, metadata.sphere
        self.multiview = view_id(frame) is not None
        unread = metadata.unread or anaglyph(self._stream.metadata)
        self.unread = unread and f"{self._path} says that {unread}"
        if self.timeless and self.frame_rate is None:
            self.frame_rate = self._file.stated_rate
            self.time_base = 1 / self.frame_rate if self.frame_rate else None
        if self.timeless and not self.frame_rate:
            self.warnings += (f"{self._path} has no times: give its rate to --frame-rate",)
        if bits_of(frame) > 8 and not self._white:
            self._judge_depth(self._path, brightest(frame), bits_of(frame))

    def _decode(self, packets: Iterator[_Packet]) -> Iterator[tuple[av.VideoFrame, bool]]:
        """Yield the images, and whether the decoder reported errors only in its log."""
        codec = self._stream.codec_context
        heeded = codec.name == _TELLS_THE_LOG
        heads = SliceHeaders(codec.extradata or b"") if codec.name == "h264" else None
        last: _Packet | None = None
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                break
            except Exception as error:
                if not is_damage(error):
                    raise
                self._end_error = words_of(error)
                break
            if packet.size or packet.dts is not None:  # the last one is empty: it flushes
                self._packets += 1
            if packet.pos is not None:
                self._packet_end = max(self._packet_end, packet.pos + packet.size)
            if heads and last is not None and self._leaps(last, packet):
                self._look_for_references(heads, last, packet)
            last = packet
            try:
                with av.logging.Capture() as log:  # only of this thread
                    frames = packet.decode()
            except Exception as error:
                if not is_damage(error):
                    raise
                self._fail(packet.pts if packet.pts is not None else packet.dts)
                continue
            for frame in frames:
                yield frame, heeded and bool(log)
        if isinstance(self._path, Pipe) and self._path.silent:
            self._end_error = "nothing came any more"

    def _leaps(self, last: _Packet, packet: _Packet) -> bool:
        """Return whether images may be missing between two packets."""
        if last.dts is None or packet.dts is None or not self.frame_rate:
            return False
        ticks = packet.dts - last.dts
        if ticks == self._usual_ticks:
            return False
        leaps = ticks * self._tick_s * self.frame_rate > 1.5
        self._usual_ticks = None if leaps else ticks
        return bool(leaps)

    def _look_for_references(self, heads: SliceHeaders, last: _Packet, packet: _Packet) -> None:
        one, other = heads.read(bytes(last)), heads.read(bytes(packet))
        if one and other and not other.follows(one) and packet.pts is not None:
            self._torn_from = packet.pts

    def _fail(self, pts: int | None) -> None:
        self._undecodable += 1
        if pts is not None:
            self._failed.append(pts)

    def _failed_before(self, pts: int) -> int:
        """Return and reset the number of images before one that could not be decoded."""
        failed = sum(each < pts for each in self._failed)
        self._failed = [each for each in self._failed if each > pts]
        return failed

    def _pts(self, frame: av.VideoFrame, last_pts: int | None) -> int:
        if frame.pts is not None:
            return frame.pts
        if last_pts is None:
            return 0
        return last_pts + (round(1 / (self.frame_rate * self._tick_s)) if self.frame_rate else 1)

    def _lost_at_end(self, last_pts: int | None) -> int:
        if self._listed:
            return max(self._listed - self._packets, 0)
        if self._file.source.format.name == "yuv4mpegpipe":  # a remainder is a cut-off image
            return int((self._file.size_bytes or 0) > self._packet_end)
        # The header of these has the length; in others it is an estimate.
        headed = self._file.source.format.name in ("matroska,webm", "avi")
        if last_pts is None or not (headed and self._pace.steady and self.frame_rate):
            return 0
        last = round((last_pts * self._tick_s - self._file.begin_s) * self.frame_rate)
        return max((self._places or 0) - 1 - last - len(self._failed), 0)


def _colours(frame: av.VideoFrame, quarters: int) -> NDArray[np.uint8]:
    return _rotated(colours(frame), quarters)


def _rotated(grey: Grey, quarters: int) -> Grey:
    """Turn an image counter-clockwise by a number of right angles."""
    return np.ascontiguousarray(np.rot90(grey, quarters)) if quarters else grey
