"""Open inputs by name: videos, images, standard input, folders of both cameras.

What only some kinds of recordings need is imported where it is one of them.
"""

from __future__ import annotations

import dataclasses
import functools
import glob
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple

from motionstereo_cli.errors import InputError, SettingsError, is_damage, opening
from motionstereo_cli.files.stills import SUFFIXES, page_count, shown
from motionstereo_cli.sources.bag_topics import bags_in, image_topics_of, stereo_topics
from motionstereo_cli.sources.joined import SUFFIXES as VIDEO_SUFFIXES
from motionstereo_cli.sources.joined import JoinedRecording, missing_files, next_chapter, parts_of
from motionstereo_cli.sources.names import right_of
from motionstereo_cli.sources.pipe import Pipe
from motionstereo_cli.sources.recording import Recording
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.stereo import SIDES, StereoSource
from motionstereo_cli.sources.video import VideoRecording

#: The name of standard input. A file of that name is ``./-``.
STDIN = "-"

#: The suffix of a ZED's recordings, and those of files that may hold several still images.
_SVO, _PAGED = ".svo2", frozenset({".tif", ".tiff", ".png", ".webp"})

#: FFmpeg's addresses: a protocol and a colon. A single letter is a drive of Windows.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.,-]+:")

#: Subfolders of the left and right images in folders of a whole recording. Of KITTI's two pairs of
#: cameras the grey one comes first: it needs no conversion.
PAIRS = (
    ("image_0", "image_1"),  # KITTI odometry
    ("image_00/data", "image_01/data"),  # KITTI raw
    ("image_2", "image_3"),
    ("image_02/data", "image_03/data"),
    ("image_00/data_rect", "image_01/data_rect"),  # KITTI-360
    ("cam0/data", "cam1/data"),  # EuRoC
    ("mav0/cam0/data", "mav0/cam1/data"),
)


class LoneRecordingError(SettingsError):
    """A recording was given alone, and does not state that it holds both views.

    Attributes:
        described: its description, as JSON-able values.
        warnings: what looks wrong with it, one line each.
    """

    def __init__(self, recording: Recording) -> None:
        super().__init__(_alone(recording.name))
        self.described, self.warnings = recording.describe(), recording.warnings


def open_stereo(
    left: str | Path, right: str | Path | None = None, settings: InputSettings | None = None
) -> StereoSource:
    """Open a left and a right recording, or one that holds both views.

    Args:
        left: a video file, a folder or a glob pattern of images, or of videos that follow one
            another, or ``-`` for standard input; without ``right`` also a KITTI or EuRoC folder,
            or a ROS bag. With ``allow_network`` in the settings also an address.
        right: the same for the right view; None if ``left`` has both.
        settings: layout of the views, pairing of images, and selection of frames.

    Raises:
        InputError: a recording is missing, cannot be decoded or has no images; both are the
            same; or their images differ in size.
        SettingsError: the settings do not fit the recordings.
    """
    settings = settings or InputSettings()
    names = named(left, right, settings)
    with opening(" or ".join(names)), ExitStack() as opened:
        topics = topics_of(names, settings)
        streams = [
            opened.enter_context(closing(open_recording(name, settings, track, topic)))
            for name, track, topic in zip(names, settings.tracks, topics, strict=False)
        ]
        if len(streams) == 1 and settings.layout == "two" and streams[0].multiview:
            from motionstereo_cli.sources.multiview import add_nominal_rig, eyes_in

            if not streams[0].rereadable:
                raise InputError(
                    f"{names[0]} brings spatial video, which is read twice: give a file"
                )
            track = settings.tracks[0]
            eyes = eyes_in(streams[0].files[0], settings, track)
            streams[0].close()
            streams = [
                opened.enter_context(
                    closing(open_recording(names[0], settings, track, view=eyes[eye]))
                )
                for eye in SIDES
            ]
            add_nominal_rig(names[0], *streams)
        for stream in streams:
            _check_read(stream, settings)
        settings, notes = _laid_out(streams, settings)
        if settings.frame_rate and not any(each.timeless for each in streams):
            raise SettingsError(
                f"--frame-rate is for what has no times, but {streams[0].name} has time stamps: "
                "leave it out"
            )
        source = StereoSource(streams, settings)
        source.warnings += notes
        opened.pop_all()
    return source


def _laid_out(streams: list[Recording], settings: InputSettings) -> tuple[InputSettings, list[str]]:
    """Return the settings with the layout that a recording states, and a warning of contradictions.

    Raises:
        SettingsError: a lone recording does not state that it holds both views.
    """
    stated = [(stream.name, stream.stated) for stream in streams if stream.stated]
    if len(streams) == 1 and settings.layout == "two":
        said = streams[0].stated
        if said is None:
            raise LoneRecordingError(streams[0])
        swap = settings.swap != said.swapped
        return dataclasses.replace(settings, layout=said.layout, swap=swap), []
    if not stated:
        return settings, []
    name, how = stated[0]
    if len(streams) == 2:
        return settings, [f"{name} says that it holds both views, {how.layout}: leave RIGHT out"]
    if settings.layout.removesuffix("-half") != how.layout.removesuffix("-half"):
        return settings, [f"{name} says that its views lie {how.layout}: leave --layout out"]
    return settings, []


def _check_read(stream: Recording, settings: InputSettings) -> None:
    """Check that the views of a recording can be read.

    Raises:
        InputError: their layout is not read, or they are spherical.
    """
    if stream.unread:
        raise InputError(stream.unread)
    sphere = stream.sphere
    if sphere is None:
        if settings.project:
            raise SettingsError(
                f"--project is for spherical video, and {stream.name} does not say that it is one"
            )
        return
    said = f"{stream.name} is spherical ({sphere})"
    if not sphere.projectable:
        raise InputError(f"{said}, which is not read: export it as flat video")
    if not settings.project:
        raise InputError(
            f"{said}: its rows and columns are angles, so depth would be wrong: give --project, or "
            "export it as flat video"
        )


def named(left: str | Path, right: str | Path | None, settings: InputSettings) -> list[str]:
    """Return the names of the recordings to open: left and right, or one that holds both.

    Raises:
        InputError: one is missing, or both are the same.
        SettingsError: they are too few or too many for the layout.
    """
    # As text: pathlib makes "./-" the same as "-".
    names = [str(left)] if right is None else [str(left), str(right)]
    layout = settings.layout
    for name in names:
        if is_address(name) and not settings.allow_network:
            raise InputError(
                f"there is no file {name}: if it is an address, --allow-network lets it be read"
            )
        if name != STDIN and not is_address(name) and not _files(name):
            raise InputError(f"there is no file or folder {name}: check the path")
    if layout != "two":
        if right is not None:
            raise SettingsError(f"--layout {layout} takes one recording: leave {right} out")
        return names * 2 if layout == "tracks" else names
    if right is None:
        return names * 2 if bags_in(names[0]) else _both_in(names[0])
    one, other = (Path(name) for name in names)
    same = names[0] == names[1] or (one.exists() and other.exists() and one.samefile(other))
    if same:
        raise InputError(
            f"{left} and {right} are the same recording: give those of two different cameras, "
            "or one with its --layout"
        )
    return names


class CameraTopic(NamedTuple):
    """The topic of a camera, and its bag or the parts of it."""

    files: tuple[Path, ...]
    name: str


def topics_of(
    names: Sequence[str], settings: InputSettings
) -> tuple[CameraTopic | None, CameraTopic | None]:
    """Return the topics of the left and the right camera, None without a bag.

    Two bags have one camera each, or are the parts of one bag.

    Raises:
        InputError: the bag does not have them.
        SettingsError: topics were given, and there is no bag or it does not have them.
    """
    bags = [bags_in(name) for name in dict.fromkeys(names)]
    if not all(bags):
        if settings.topics:
            raise SettingsError(f"--topics are those of a ROS bag, and {names[0]} is none")
        return None, None
    if len(bags) == 2 and not settings.topics:
        topics = [image_topics_of(files) for files in bags]
        if all(len(found) == 1 for found in topics):
            left, right = (
                CameraTopic(files, found[0].name) for files, found in zip(bags, topics, strict=True)
            )
            return left, right
    files = tuple(file for bag in bags for file in bag)
    left_name, right_name = stereo_topics(files, settings.topics)
    return CameraTopic(files, left_name), CameraTopic(files, right_name)


def open_recording(
    name: str,
    settings: InputSettings,
    track: int = 0,
    topic: CameraTopic | None = None,
    view: int | None = None,
) -> Recording:
    """Open a recording.

    Args:
        name: of a file, folder, pattern, FIFO or address, or that of standard input.
        settings: parameters of the input.
        track: which of its video tracks, from 1; 0 = the first.
        topic: which of its topics, if it is a ROS bag.
        view: which of its views, if it is a multiview stream; None = the base view.

    Raises:
        InputError: it cannot be decoded or has no images.
    """
    path = Path(name)
    if path.suffix.lower() == _SVO and path.is_file():
        from motionstereo_cli.sources.svo import SvoRecording

        return SvoRecording(path, max_pixels=settings.max_pixels)
    if topic:
        from motionstereo_cli.sources.bag import BagRecording

        return BagRecording(
            topic.files, topic.name, white=settings.white, max_pixels=settings.max_pixels
        )
    if parts := _videos_of(name):
        return _of_parts(
            name, parts, functools.partial(_open_video, settings=settings, track=track, view=view)
        )
    is_still = path.suffix.lower() in SUFFIXES or not path.exists()
    if not (name == STDIN or is_address(name)) and (path.is_dir() or is_still):
        if path.is_file() and path.suffix.lower() in _PAGED and page_count(path) > 1:
            from motionstereo_cli.sources.pages import PagesRecording

            return PagesRecording(
                path, settings.rate, white=settings.white, max_pixels=settings.max_pixels
            )
        from motionstereo_cli.sources.folder import FolderRecording

        files = None if path.is_dir() else _files(name)
        return FolderRecording(
            path, files, settings.rate, white=settings.white, max_pixels=settings.max_pixels
        )
    video = _open_video(_openable(name), settings, track, view)
    if (following := next_chapter(path)) is not None:
        pattern = path.with_name(f"G???{path.stem[-4:]}{path.suffix}")
        video.warnings += (f"{name} goes on in {following}: to read both, give '{pattern}'",)
    return video


def _of_parts(
    name: str, parts: Sequence[Path], opened: Callable[[Path], VideoRecording]
) -> Recording:
    if len(parts) > 1:
        return JoinedRecording(name, parts, opened)
    video = opened(parts[0])
    video.warnings += tuple(f"{name}: {line}" for line in missing_files(parts))
    return video


def _open_video(
    path: Path | Pipe | str, settings: InputSettings, track: int = 0, view: int | None = None
) -> VideoRecording:
    try:
        return VideoRecording(
            path,
            rate=settings.rate,
            track=track,
            white=settings.white,
            max_pixels=settings.max_pixels,
            allow_network=settings.allow_network,
            view=view,
        )
    except InputError as error:
        if isinstance(path, Path) and (how := _how_to_convert(path.suffix)):
            raise InputError(f"{path} is {how}") from error
        raise
    except Exception as error:
        if not is_damage(error):
            raise
        raise InputError(
            f"{path} cannot be read ({type(error).__name__}: {error}): is it whole?"
        ) from error


def _videos_of(name: str) -> list[Path]:
    """Return the videos of a folder or a pattern, in order; nothing if it has images."""
    path = Path(name)
    if name == STDIN or is_address(name) or (path.exists() and not path.is_dir()):
        return []
    found = list(path.iterdir()) if path.is_dir() else _files(name)
    files = [each for each in found if not each.name.startswith(".")]
    return [] if shown(files, SUFFIXES) else parts_of(name, files)


def _openable(name: str) -> Path | Pipe | str:
    """Return a video in the form to open it: file, pipe or address."""
    if name == STDIN:
        return Pipe()
    if is_address(name):
        return name
    path = Path(name)
    return Pipe(path) if path.is_fifo() else path


def is_address(name: str) -> bool:
    """Return whether a name is a network address or the like, not a file."""
    return bool(_ADDRESS.match(name)) and not _files(name)


def _files(name: str) -> list[Path]:
    path = Path(name)
    return [path] if path.exists() else [Path(found) for found in glob.glob(name)]


def _both_in(name: str) -> list[str]:
    """Return both cameras' recordings in a folder, or the name if it may be one of both."""
    for pair in PAIRS:
        folders = [Path(name, part) for part in pair]
        if all(folder.is_dir() for folder in folders):
            return [str(folder) for folder in folders]
    if not Path(name).is_dir():
        return [name]
    inside = [each for each in Path(name).iterdir() if not each.name.startswith(".")]
    if not inside:
        raise InputError(f"{name} is empty: give a folder that holds recordings")
    if shown(inside, SUFFIXES):
        return [name]
    videos = [each.name for each in inside if each.suffix.lower() in VIDEO_SUFFIXES]
    # Two videos by these names are no parts of one recording.
    sides = videos if len(videos) == 2 else [each.name for each in inside if each.is_dir()]
    pairs = [(each, right) for each in sides if (right := right_of(each)) in sides]
    if len(pairs) == 1:
        return [str(Path(name, str(side))) for side in pairs[0]]
    if not _videos_of(name):
        raise SettingsError(_alone(name))
    return [name]


def _alone(name: str) -> str:
    if (whole := _whole_beside(Path(name))) is not None:
        return f"{name} is not the folder of both cameras, but {whole} is: give that"
    what, advice = "is one recording", "give RIGHT as well"
    if Path(name).is_dir():
        what = f"holds no {' and '.join(PAIRS[0])}, {' and '.join(PAIRS[5])} or the like"
        advice = "give the folder that holds both sides, or RIGHT as well"
    return (
        f"{name} {what}: {advice}, or --layout side-by-side or top-bottom where it holds both views"
    )


def _whole_beside(path: Path) -> Path | None:
    """Return a folder of both cameras, above or below this one; None if there is none."""
    if not path.is_dir():
        return None
    inside = sorted(each for form in ("*", "*/*") for each in path.glob(form) if each.is_dir())
    for folder in (*path.absolute().parents[:3], *inside):
        for pair in PAIRS:
            if all((folder / part).is_dir() for part in pair) and (
                folder in inside or path.absolute() in [folder / part for part in pair]
            ):
                return folder
    return None


#: Suffixes of other recordings, and how to convert them.
_ELSEWHERE = {
    (".svo",): "an older ZED recording: export it with ZED_SVO_Export as side-by-side AVI",
    (".npy", ".npz"): "NumPy's arrays: write each as an image, with cv2.imwrite",
    (".h5", ".hdf5", ".mat"): "a file of arrays: write each as an image, with cv2.imwrite",
    (".oni",): "an OpenNI recording: convert it with NiViewer or ffmpeg",
    (".heic", ".heif", ".avif"): "a HEIF image: convert it with heif-convert or magick",
    (".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw"): "a raw image: develop it to 16-bit TIFF",
    (".exr", ".hdr"): "an image of floating-point numbers: convert it to 16-bit PNG",
    (".insv", ".360"): "a spherical video: export it as flat video with its maker's program",
    (".braw", ".r3d"): "a raw video: export it as ProRes or FFV1 with its maker's program",
    (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar", ".zst"): "an archive: unpack it",
    (".yaml", ".yml", ".json", ".xml"): "no recording: a calibration goes to --rig",
}


def _how_to_convert(suffix: str) -> str | None:
    return next((how for known, how in _ELSEWHERE.items() if suffix.lower() in known), None)
