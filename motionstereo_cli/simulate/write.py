"""A rendered recording as files, with its truth."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import reported, write_whole
from motionstereo_cli.files.images import encode_png
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.rig import write_rig
from motionstereo_cli.rig.poses import HEAD, format_pose
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sinks.images import disparity_png


def simulate(
    out: Path,
    settings: SimulateSettings,
    *,
    overwrite: bool = False,
    progress: Callable[[], object] = lambda: None,
) -> None:
    """Render a recording into a folder; the same settings give the same bytes.

    Writes, with frames numbered from 0 wherever in the scene they begin:

    - left.mp4, right.mp4 (H.264), or left.mkv, right.mkv (FFV1) if ``lossless``;
    - disparity/000000.png: exact disparity of the right view as KITTI has it, uint16 in 1/256 px,
      for every pixel (0 where it exceeds the format's 65535/256 px);
    - rig.yaml;
    - poses.txt: TUM format, one line a frame, for the rig's middle. World: x and y on the floor,
      z up, in m. Orientation: the robot frame, x forward, y left, z up (REP 103). Time begins
      at 0 with the recording.

    When it fails or is interrupted, no file is left behind.

    Args:
        out: the folder, made if need be.
        settings: what to render.
        overwrite: replace a former simulation in ``out``; other files are never touched.
        progress: called after each frame.

    Raises:
        OutputError: ``out`` is not empty, or cannot be written.
    """
    suffix = "mkv" if settings.lossless else "mp4"
    sides = [out / f"left.{suffix}", out / f"right.{suffix}"]
    truths = _disparities(out, len(settings.frame_range))
    targets = [*sides, *truths, out / "rig.yaml", out / "poses.txt"]
    _prepare(out, targets, overwrite=overwrite)
    time_base = 1 / Fraction(settings.frame_rate).limit_denominator(1001)
    videos: list[VideoWriter] = []
    poses = [HEAD]
    try:
        for path in sides:
            videos.append(VideoWriter(path, time_base, quality=settings.crf))
        for number, shot in enumerate(render_scene(settings)):
            for video, image in zip(videos, (shot.left, shot.right), strict=True):
                video.write(image, number)
            write_whole(truths[number], encode_png(disparity_png(shot.disparity_px)))
            poses.append(format_pose(number / settings.frame_rate, shot.pose.rig_pose))
            progress()
        for video in videos:
            video.close()
        write_rig(out / "rig.yaml", settings.rig)
        write_whole(out / "poses.txt", "".join(poses).encode())
    except BaseException:
        for video in videos:
            with contextlib.suppress(OutputError):
                video.close(keep=False)
        with contextlib.suppress(OSError):
            _remove(out, targets)
        raise


def _disparities(out: Path, count: int) -> list[Path]:
    return [out / "disparity" / f"{number:06d}.png" for number in range(count)]


def _prepare(out: Path, targets: list[Path], *, overwrite: bool) -> None:
    """Make an empty ``out``, or one in which none of ``targets`` exists."""
    with reported(out):
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            if not overwrite:
                raise OutputError(f"{out} is not empty: give another folder, or --overwrite")
            _remove(out, _former(out))
        (out / "disparity").mkdir(exist_ok=True)
    for path in targets:
        if path.exists():
            raise OutputError(
                f"{path} is in the way and no poses.txt says that a simulation wrote it: "
                "move it or give another folder"
            )


def _former(out: Path) -> list[Path]:
    """Return what a former simulation wrote: as many images as its poses.txt has poses."""
    poses = out / "poses.txt"
    if not poses.is_file() or not poses.read_bytes().startswith(HEAD.encode()):
        return []
    videos = [out / f"{side}.{suffix}" for side in ("left", "right") for suffix in ("mp4", "mkv")]
    images = _disparities(out, len(poses.read_bytes().splitlines()) - 1)
    # The poses go last: until then the rest can still be told from other files.
    return [*videos, *images, out / "rig.yaml", poses]


def _remove(out: Path, paths: list[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # other files are in it
        (out / "disparity").rmdir()
