"""Calibration files as other programs write them, read as data only.

Each format is told by its content, never by its name: a row of :data:`FORMATS` recognizes it and
reads it. What is read is a :class:`~motionstereo_cli.types.Rig`, of a rig file, or a
:class:`~motionstereo_cli.rig.cameras.Pair`. No reader opens another file than those it is given.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_CALIBRATION_BYTES, as_text, read_bytes
from motionstereo_cli.rig.cameras import Pair, rectified_pair
from motionstereo_cli.rig.devices import read_depthai, read_zed
from motionstereo_cli.rig.opencv import read_opencv
from motionstereo_cli.rig.rig_file import parse_rig
from motionstereo_cli.rig.ros_and_orbslam import read_euroc, read_kalibr, read_orb_slam, read_ros
from motionstereo_cli.rig.values import Source
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from motionstereo_cli.rig.structure import Values

#: Beginnings of files that hold calibrations elsewhere and are not read, and what to do.
_FOREIGN = {
    b"\x80": "is a Python pickle, which could run programs: save the arrays with numpy.savez",
    b"\x93NUMPY": "is one array: save all of them with numpy.savez",
    b"MATLAB": "is a MATLAB file: save the matrices as JSON, as M1 D1 M2 D2 R T",
    b"\x89HDF": "is an HDF5 file: save the matrices as JSON, as M1 D1 M2 D2 R T",
}


@dataclass(frozen=True, slots=True)
class _Given:
    """Calibration files, and what else is known.

    Attributes:
        paths: one, or two that belong together.
        texts: their content, empty for .npz.
        values: of each; empty where it is a text of its own format.
        size: width and height of the recorded images in px, None if unknown.
        pair: numbers of the left and the right camera, None if unknown.
    """

    paths: Sequence[Path]
    texts: Sequence[str]
    values: Sequence[Values]
    size: tuple[int, int] | None
    pair: tuple[int, int] | None

    @property
    def name(self) -> str:
        """What messages call the files."""
        return " and ".join(str(path) for path in self.paths)

    @property
    def files(self) -> list[tuple[Path, Values]]:
        """Paths with their values."""
        return list(zip(self.paths, self.values, strict=True))


@dataclass(frozen=True, slots=True)
class Format:
    """A format of calibrations.

    Attributes:
        name: what messages call it.
        files: of how many files a calibration consists, left first; 0 = one or two.
        knows: whether the first file is of this format.
        read: returns what the files say.
    """

    name: str
    files: int
    knows: Callable[[str, Values], bool]
    read: Callable[[_Given], Rig | Pair]


def read_files(
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    pair: tuple[int, int] | None = None,
) -> Rig | Pair:
    """Read one calibration file, or two that belong together, the left camera's first.

    Args:
        paths: files of one of the :data:`FORMATS`.
        size: width and height of the recorded images in px, for files that have a calibration
            for each of several sizes; None if unknown.
        pair: numbers of the left and right camera where a file has more than two (KITTI); 0 and
            1 if None, or 2 and 3 where only those are there.

    Raises:
        InputError: a file cannot be read, has another format, or lacks or spoils a value.
    """
    if not 1 <= len(paths) <= 2:
        raise InputError(f"{len(paths)} calibration files are too many: give one, or a pair")
    contents = [read_bytes(path, "the rig", MAX_CALIBRATION_BYTES) for path in paths]
    for path, content in zip(paths, contents, strict=True):
        for start, advice in _FOREIGN.items():
            if content.startswith(start):
                raise InputError(f"{path} {advice}")
    read = [_read(path, content) for path, content in zip(paths, contents, strict=True)]
    texts, values = [text for text, _ in read], [values for _, values in read]
    found = next(each for each in FORMATS if each.knows(texts[0], values[0]))
    if found.files == 1 and len(paths) > 1:
        raise InputError(f"{paths[0]} is a {found.name} file, which says all: leave {paths[1]} out")
    if found.files == 2 and len(paths) < 2:
        raise InputError(
            f"{paths[0]} is the {found.name} of one camera: give both, the left camera's first"
        )
    return found.read(_Given(paths, texts, values, size, pair))


def _read(path: Path, content: bytes) -> tuple[str, Values]:
    if content.startswith(b"PK\3\4"):
        from motionstereo_cli.rig.structure import read_npz

        return "", read_npz(path, content)
    text = as_text(content)
    if any(pattern.search(text) for pattern in (_MIDDLEBURY, _KITTI, _RIG)) or not _structured(
        text
    ):
        return text, {}
    from motionstereo_cli.rig.structure import read_structure

    return text, read_structure(path, text)


# Formats that are plain lines of text.

_MIDDLEBURY = re.compile(r"^\s*cam0\s*=", re.MULTILINE)
_KITTI = re.compile(r"^P(_rect_)?\d+[ \t]*:[ \t]*[-+.\d]", re.MULTILINE)
_RIG = re.compile(r"^(focal_px|baseline_m)\b", re.MULTILINE)


def _structured(text: str) -> bool:
    """Return whether there is anything but plain ``key: number`` lines, as in a rig file."""
    return bool(re.search(r"[\[{<]|^\s+\S|^\s*-\s|^Camera[\d]*[._]", text, re.MULTILINE))


def _kitti(given: _Given) -> Pair:
    path, pair = given.paths[0], given.pair
    values: dict[str, Any] = {}
    for line in given.texts[0].splitlines():
        key, colon, numbers = line.partition(":")
        if colon:
            values[key.strip()] = _floats(numbers)
    prefix = "P_rect_" if any(key.startswith("P_rect_") for key in values) else "P"
    digits = "02d" if prefix == "P_rect_" else "d"
    labels = {number: f"{prefix}{number:{digits}}" for number in range(4)}
    notes: tuple[str, ...] = ()
    if pair is None:
        pair = (2, 3) if labels[0] not in values or labels[1] not in values else (0, 1)
        if all(label in values for label in labels.values()):
            notes = (f"the file has four cameras: {pair[0]} and {pair[1]} are taken",)
    source = Source(path, values)
    left, right = (
        source.matrix((labels.get(n, f"{prefix}{n}"),), labels.get(n, f"{prefix}{n}"), (3, 4))
        for n in pair
    )
    size = source.size(f"S_rect_{pair[0]:02d}")
    return rectified_pair("KITTI", (left, right), size, "m", notes)


def _middlebury(given: _Given) -> Pair:
    path = given.paths[0]
    values: dict[str, Any] = {}
    for line in given.texts[0].splitlines():
        key, equals, numbers = line.partition("=")
        if equals:
            values[key.strip()] = _floats(numbers)
    source = Source(path, values)
    first, second = (source.intrinsics((name,), name) for name in ("cam0", "cam1"))
    baseline = source.number(("baseline",), "baseline")
    doffs = second[0, 2] - first[0, 2]
    if "doffs" in values:
        stated = source.number(("doffs",), "doffs")
        if abs(stated - doffs) > 0.01:
            raise InputError(
                f"{path}: doffs is {stated:g} but cam1 and cam0 differ by {doffs:g} px: "
                "check the file"
            )
    right = np.column_stack([second, [-second[0, 0] * baseline, 0, 0]])
    left = np.column_stack([first, np.zeros(3)])
    return rectified_pair("Middlebury", (left, right), source.size("width", "height"), "mm")


def _floats(text: str) -> list[float] | None:
    try:
        return [float(part) for part in re.split(r"[\s,;\[\]]+", text.strip()) if part]
    except ValueError:
        return None  # dates and names


#: All formats; the first that knows a file reads it.
FORMATS: tuple[Format, ...] = (
    Format("Middlebury calib.txt", 1, lambda text, _: bool(_MIDDLEBURY.search(text)), _middlebury),
    Format("KITTI calib.txt", 1, lambda text, _: bool(_KITTI.search(text)), _kitti),
    Format(
        "rig.yaml",
        1,
        lambda _, values: not values,
        lambda given: parse_rig(given.paths[0], given.texts[0]),
    ),
    Format(
        "ORB-SLAM",
        1,
        lambda _, values: not values.keys().isdisjoint({"camerafx", "camera1fx"}),
        lambda given: read_orb_slam(*given.files[0]),
    ),
    Format(
        "ROS camera_info",
        2,
        lambda _, values: "projectionmatrix" in values or values.keys() >= {"d", "k", "r", "p"},
        lambda given: read_ros(given.files),
    ),
    Format(
        "EuRoC sensor.yaml", 2, lambda _, values: "tbs" in values, lambda g: read_euroc(g.files)
    ),
    Format(
        "kalibr camchain",
        1,
        lambda _, values: (
            all(
                isinstance(values.get(cam), dict) and "intrinsics" in values[cam]
                for cam in ("cam0", "cam1")
            )
            and not values["cam1"].keys().isdisjoint({"tcncnm1", "tcamimu"})
        ),
        lambda given: read_kalibr(*given.files[0]),
    ),
    Format(
        "DepthAI",
        1,
        lambda _, values: "cameradata" in values,
        lambda given: read_depthai(*given.files[0], given.size),
    ),
    Format(
        "ZED",
        1,
        lambda _, values: (
            isinstance(values.get("stereo"), dict)
            and any(name.startswith("leftcam") for name in values)
        ),
        lambda given: read_zed(*given.files[0], given.size),
    ),
    Format(
        "OpenCV",
        0,
        lambda _, __: True,
        lambda given: read_opencv(
            given.name, {key: value for each in given.values for key, value in each.items()}
        ),
    ),
)
