"""What an input given by name is: a video, images, standard input, a folder of both cameras."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sources.bag import BagRecording, is_bag, stereo_topics
from motionstereo_cli.sources.folder import FolderRecording
from motionstereo_cli.sources.pipe import Pipe
from motionstereo_cli.sources.recording import Recording
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.video import VideoRecording

#: The name of standard input. A file of that name is ``./-``.
STDIN = "-"

#: What FFmpeg takes for an address: a protocol and a colon. One letter is a drive of Windows.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.,-]+:")

#: Where the left and right images lie in folders that hold a whole recording. Of KITTI's two
#: pairs of cameras the grey one comes first: it needs no conversion.
PAIRS = (
    ("image_0", "image_1"),  # KITTI odometry
    ("image_00/data", "image_01/data"),  # KITTI raw
    ("image_2", "image_3"),
    ("image_02/data", "image_03/data"),
    ("image_00/data_rect", "image_01/data_rect"),  # KITTI-360
    ("cam0/data", "cam1/data"),  # EuRoC
    ("mav0/cam0/data", "mav0/cam1/data"),
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
        return names * 2 if is_bag(Path(names[0])) else _both_in(names[0])
    one, other = (Path(name) for name in names)
    same = names[0] == names[1] or (one.exists() and other.exists() and one.samefile(other))
    if same:
        raise InputError(
            f"{left} and {right} are the same recording: give those of two different cameras, "
            "or one with its --layout"
        )
    return names


def topics_of(names: Sequence[str], settings: InputSettings) -> tuple[str, str]:
    """Return the topics of the left and the right camera, empty where there is no bag.

    Raises:
        InputError: they are not to be found in the bag.
        SettingsError: topics were given, and there is no bag or it does not have them.
    """
    if is_bag(Path(names[0])):
        return stereo_topics(Path(names[0]), settings.topics)
    if settings.topics:
        raise SettingsError(f"--topics are those of a ROS bag, and {names[0]} is none")
    return "", ""


def open_recording(
    name: str, settings: InputSettings, track: int = 0, topic: str = ""
) -> Recording:
    """Open a recording.

    Args:
        name: of a file, folder, pattern, FIFO or address, or that of standard input.
        settings: what to make of it.
        track: which video track of it, from 1; 0 = the first.
        topic: which topic of it, where it is a ROS bag.

    Raises:
        InputError: it cannot be decoded or has no images.
    """
    path = Path(name)
    if topic:
        return BagRecording(path, topic, max_pixels=settings.max_pixels)
    if not (name == STDIN or is_address(name)) and (path.is_dir() or not path.exists()):
        files = None if path.is_dir() else _files(name)
        return FolderRecording(
            path, files, settings.rate, white=settings.white, max_pixels=settings.max_pixels
        )
    return VideoRecording(
        _openable(name),
        rate=settings.rate,
        track=track,
        white=settings.white,
        max_pixels=settings.max_pixels,
        allow_network=settings.allow_network,
    )


def _openable(name: str) -> Path | Pipe | str:
    """Return a video by its kind: file, pipe or address."""
    if name == STDIN:
        return Pipe()
    if is_address(name):
        return name
    path = Path(name)
    return Pipe(path) if path.is_fifo() else path


def is_address(name: str) -> bool:
    """Return whether a name is a network address, or the like, and no file."""
    return bool(_ADDRESS.match(name)) and not _files(name)


def _files(name: str) -> list[Path]:
    path = Path(name)
    return [path] if path.exists() else [Path(found) for found in glob.glob(name)]


def _both_in(name: str) -> list[str]:
    for pair in PAIRS:
        folders = [Path(name, part) for part in pair]
        if all(folder.is_dir() for folder in folders):
            return [str(folder) for folder in folders]
    what = "standard input" if name == STDIN else name
    known = f"no {' and '.join(PAIRS[0])}, {' and '.join(PAIRS[4])} or the like is in it: "
    raise SettingsError(
        f"{what} is one recording: {known if Path(name).is_dir() else ''}give RIGHT as well, "
        "or --layout side-by-side or top-bottom where it holds both views"
    )
