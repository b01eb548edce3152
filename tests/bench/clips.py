"""Recordings to measure on: rendered, encoded, and as long as need be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path

import av

from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.rig import write_rig
from motionstereo_cli.simulate.scenes import SceneFrame, render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.types import Rig, StereoFrame


@dataclass(frozen=True, slots=True)
class Clip:
    """A stereo recording in a folder of its own.

    Attributes:
        folder: where it is.
        rig: its camera.
        count: number of frames.
    """

    folder: Path
    rig: Rig
    count: int

    @property
    def paths(self) -> tuple[Path, Path]:
        """The left and the right video."""
        return self.folder / "left.mp4", self.folder / "right.mp4"

    @property
    def rig_file(self) -> Path:
        """The rig, as ``--rig`` takes it."""
        return self.folder / "rig.yaml"

    def frames(self, most: int) -> list[StereoFrame]:
        """Return its first frames, decoded, at most so many."""
        return first_frames(*self.paths, most)


def first_frames(left: Path, right: Path, most: int) -> list[StereoFrame]:
    """Return the first frames of two videos, at most so many.

    Raises:
        InputError: they cannot be read.
    """
    with open_stereo(left, right) as source:
        return list(islice(source, most))


def rendered(folder: Path, settings: SimulateSettings, *, back: bool = False) -> Clip:
    """Render a recording into a new folder.

    Args:
        folder: where to.
        settings: what to render.
        back: after the last frame go back to the second, frame by frame, so that the recording
            can be put end to end without a jump.
    """
    shots = [(shot.left, shot.right) for shot in render_scene(settings)]
    if back:
        shots += shots[-2:0:-1]
    clip = _new(folder, settings.rig, len(shots))
    for path, images in zip(clip.paths, zip(*shots, strict=True), strict=True):
        video = VideoWriter(path, Fraction(1, 30))
        for index, image in enumerate(images):
            video.write(image, index)
        video.close()
    return clip


def repeated(clip: Clip, folder: Path, times: int) -> Clip:
    """Put a recording end to end so many times into a new folder, without encoding it again."""
    longer = _new(folder, clip.rig, times * clip.count)
    for source, target in zip(clip.paths, longer.paths, strict=True):
        _repeat(source, target, times)
    return longer


def _new(folder: Path, rig: Rig, count: int) -> Clip:
    folder.mkdir()
    clip = Clip(folder, rig, count)
    write_rig(clip.rig_file, rig)
    return clip


def _repeat(source: Path, target: Path, times: int) -> None:
    with av.open(str(source)) as old, av.open(str(target), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        packets = [packet for packet in old.demux(video=0) if packet.size]
        stamps = sorted(packet.pts or 0 for packet in packets)
        period = len(stamps) * (stamps[1] - stamps[0])
        for turn in range(times):
            for packet in packets:
                again = av.Packet(bytes(packet))
                again.pts = (packet.pts or 0) + turn * period
                again.dts = (packet.dts or 0) + turn * period
                again.time_base, again.duration = packet.time_base, packet.duration
                again.is_keyframe, again.stream = packet.is_keyframe, stream
                new.mux(again)


def recorded(settings: SimulateSettings, left: Path, right: Path) -> Iterator[SceneFrame]:
    """Render a recording into two videos, and yield what is shown; they are whole at the end."""
    rate = Fraction(1 / settings.frame_rate).limit_denominator(1000)
    videos = [VideoWriter(path, rate, quality=settings.crf) for path in (left, right)]
    for index, shot in enumerate(render_scene(settings)):
        for video, grey in zip(videos, (shot.left, shot.right), strict=True):
            video.write(grey, index)
        yield shot
    for video in videos:
        video.close()
