"""Write a rendered recording with its truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

from msgspec import UNSET

from motionstereo_cli.files.atomic import check_free, write_whole
from motionstereo_cli.files.encode import encode_png
from motionstereo_cli.files.folders import make_folder
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.rig import write_rig
from motionstereo_cli.rig.poses import HEAD as POSES_HEAD
from motionstereo_cli.rig.poses import format_pose
from motionstereo_cli.runs.folder import RunFolder
from motionstereo_cli.runs.folder_files import FolderKind
from motionstereo_cli.simulate.scenes import SceneFrame, render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sinks.images import disparity_png
from motionstereo_cli.sinks.objects_table import HEADER, object_row
from motionstereo_cli.sinks.records import Counts, FolderRecord
from motionstereo_cli.sinks.writers import TableFile


def simulate(
    out: Path,
    settings: SimulateSettings,
    *,
    overwrite: bool = False,
    inputs: Iterable[Path] = (),
    progress: Callable[[SceneFrame], object] = lambda _: None,
) -> None:
    """Render a recording into a folder; the same settings give the same bytes.

    Writes, with frames numbered from 0 whatever their numbers in the scene:

    - left.mp4, right.mp4 (H.264), or left.mkv, right.mkv (FFV1) if ``lossless``;
    - disparity/000000.png: exact disparity of the right view as KITTI has it, uint16 in 1/256 px,
      for every pixel (0 where it exceeds the format's 65535/256 px);
    - movers/000000.png, of cards and street: uint8 number of what moves by itself in the right
      view, 0 = nothing;
    - objects.csv, of the same: a row for each of them in each frame, as ``run`` writes it, with its
      true box, depth and speeds;
    - rig.yaml;
    - poses.txt: TUM format, one line a frame, for the rig's middle. World: x and y on the floor,
      z up, in m. Orientation: the robot frame, x forward, y left, z up (REP 103). Time begins
      at 0 with the recording.

    On failure or interruption no file remains.

    Args:
        out: the folder, made if missing.
        settings: what to render.
        overwrite: replace an earlier simulation in ``out``; other files are never touched.
        inputs: files that must not be written to.
        progress: called after each frame, with it.

    Raises:
        OutputError: ``out`` is not empty, or cannot be written.
    """
    suffix = "mkv" if settings.lossless else "mp4"
    time_base = 1 / Fraction(settings.frame_rate).limit_denominator(1001)
    poses = []
    with RunFolder(
        *(out, tuple(_KIND.outputs), _KIND),
        frames=len(settings.frame_range),
        overwrite=overwrite,
        inputs=inputs,
    ) as folder:
        make_folder(out / "disparity")
        objects = None
        if settings.scene in _MOVING:
            make_folder(out / "movers")
            objects = folder.own(TableFile(out / _OBJECTS, HEADER))
        videos = [
            folder.own(VideoWriter(out / f"{side}.{suffix}", time_base, quality=settings.crf))
            for side in ("left", "right")
        ]
        for number, shot in enumerate(render_scene(settings)):
            for video, image in zip(videos, (shot.left, shot.right), strict=True):
                video.write(image, number)
            truth = out / _DISPARITY.format(number)
            check_free(truth)
            write_whole(truth, encode_png(disparity_png(shot.disparity_px)))
            if shot.mover is not None and objects is not None:
                movers = out / _MOVERS.format(number)
                check_free(movers)
                write_whole(movers, encode_png(shot.mover))
                objects.add(object_row(number, each) for each in shot.objects)
            poses.append(format_pose(number / settings.frame_rate, shot.pose.rig_pose))
            progress(shot)
        folder.close()
        write_rig(out / "rig.yaml", settings.rig)
        folder.complete(poses=poses)


_DISPARITY = "disparity/{:06d}.png"
_MOVERS = "movers/{:06d}.png"
_OBJECTS = "objects.csv"
#: Scenes that say what moves by itself.
_MOVING = ("cards", "street")


#: How the line begins that lists what belongs to the poses.
_LIST = "# of "


class _Poses(FolderRecord, kw_only=True, frozen=True):
    """``poses.txt``, by its lines."""

    poses: tuple[str, ...] | list[str] = ()


def _format(record: _Poses) -> bytes:
    files = " ".join(record.outputs or ())
    return "".join([POSES_HEAD, f"{_LIST}{files}\n", *record.poses]).encode()


def _parse(content: bytes) -> _Poses:
    head, files, *poses = content.decode().splitlines(keepends=True)
    if head != POSES_HEAD or not files.startswith(_LIST):
        raise ValueError("not from a simulation")
    outputs = tuple(files.removeprefix(_LIST).split())
    counts = Counts(written=len(poses)) if poses else UNSET
    return _Poses(program=_KIND.program, outputs=outputs, counts=counts)


#: The poses are the record: they are written last, and there are as many as images.
_KIND = FolderKind(
    program="motionstereo simulate",
    record="poses.txt",
    outputs={
        name: (name,)
        for name in (
            *("left.mp4", "right.mp4", "left.mkv", "right.mkv", "rig.yaml"),
            _DISPARITY,
            _MOVERS,
            _OBJECTS,
        )
    },
    kind=_Poses,
    format=_format,
    parse=_parse,
)
