"""Calibration files of other programs, read as data only.

A format is identified by its content, never by its name: a row of :data:`FORMATS` recognises and
reads it. The result is a :class:`~motionstereo_cli.types.Rig` for a rig file, or a
:class:`~motionstereo_cli.rig.cameras.Pair`. Readers open no files but those given.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_CALIBRATION_BYTES, as_text, read_bytes, read_head
from motionstereo_cli.rig import placed, plain
from motionstereo_cli.rig.cameras import Pair, of_rig
from motionstereo_cli.rig.devices import read_depthai, read_zed
from motionstereo_cli.rig.foreign import (
    refuse_foreign_bytes,
    refuse_foreign_text,
    refuse_foreign_values,
)
from motionstereo_cli.rig.maps import MAX_MAPS_BYTES, begins_maps, maps_in, parse_maps
from motionstereo_cli.rig.opencv import has_numbered_cameras, read_opencv
from motionstereo_cli.rig.rig_file import parse_rig
from motionstereo_cli.rig.ros_and_orbslam import (
    read_kalibr,
    read_orb_slam,
    read_ros,
    read_stella,
)
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Maps
    from motionstereo_cli.rig.structure import Values


@dataclass(frozen=True, slots=True)
class _Given:
    """Calibration files, and what else is known.

    Attributes:
        paths: one, or several that belong together.
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
        counts: of how many files a calibration consists, left first.
        knows: whether the first file is of this format.
        read: returns what the files say.
    """

    name: str
    counts: tuple[int, ...]
    knows: Callable[[str, Values], bool]
    read: Callable[[_Given], Rig | Pair]


def read_files(
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    pair: tuple[int, int] | None = None,
) -> Rig | Pair:
    """Read one calibration file, or several that belong together, the left camera's first.

    Args:
        paths: files in one of the :data:`FORMATS`.
        size: width and height of the recorded images in px, for files with a calibration for
            each of several sizes; None if unknown.
        pair: numbers of the left and right camera if a file has more than two (KITTI, and files
            of SLAM); None: 0 and 1, or 2 and 3 if there are only those.

    Raises:
        InputError: a file cannot be read, has another format, lacks a value, or has an invalid
            one.
    """
    if not 1 <= len(paths) <= _MOST_FILES:
        raise InputError(f"{len(paths)} calibration files are too many: give one, or a pair")
    contents = [read_bytes(path, "the rig", _most_bytes(path)) for path in paths]
    read = [_read(path, content) for path, content in zip(paths, contents, strict=True)]
    texts, values = [text for text, _ in read], [values for _, values in read]
    for at, each in enumerate(values):
        if (maps := maps_in(each)) is not None:
            return _mapped(paths[at], maps, each, [*paths[:at], *paths[at + 1 :]], size)
    given = _Given(paths, texts, values, size, pair)
    known = [each for each in FORMATS if each.knows(texts[0], values[0])]
    found = known[0]
    if len(paths) not in found.counts:
        if len(paths) > max(found.counts):
            others = " and ".join(str(path) for path in paths[max(found.counts) :])
            if found.counts == (1,):
                others = f"which says all: leave {others} out"
            else:
                others = f"of {max(found.counts)} files at most: leave {others} out"
            raise InputError(f"{paths[0]} is a {found.name} file, {others}")
        raise InputError(
            f"{paths[0]} is a {found.name} file of one camera: give those of both, the left "
            "camera's first"
        )
    if "ORB-SLAM" in found.name and has_numbered_cameras(values[0]):
        raise InputError(
            f"{paths[0]} holds two calibrations: {found.name}'s Camera, and OpenCV's K1 (or M1) "
            "to T of other images, as recorded ones are: delete the one that is not of these "
            "images (Camera is of rectified images where Camera.bf or Stereo.b stands with it)"
        )
    return found.read(given)


def _mapped(
    path: Path,
    maps: tuple[Maps, Maps],
    values: Values,
    others: Sequence[Path],
    size: tuple[int, int] | None,
) -> Pair:
    """Return the pair of remap tables, with what Q or another file says of the rectified images.

    Raises:
        InputError: there is no such file, or it is of recorded images.
    """
    height, width = maps[0][0].shape
    if not others:
        try:
            read: Rig | Pair = read_opencv(str(path), values)
        except InputError:
            raise InputError(
                f"{path} holds remap tables, which say neither focal length nor baseline: give "
                f"rig.yaml of the rectified images of {width}x{height} px as well (--rig "
                f"{path.name} --rig rig.yaml; its focal_px and cx, cy are in P1, its baseline_m is "
                "the distance between the cameras), or in place of the tables the calibration "
                "that they were made from (M1 D1 M2 D2 R T)"
            ) from None
    else:
        read = read_files(others, size)
    if isinstance(read, Rig):
        read = of_rig(read)
    if read.cameras is not None and not others:  # all that the tables were made from
        return read
    if read.cameras is not None:
        raise InputError(
            f"{' and '.join(map(str, others))} rectifies recorded images by itself: leave the "
            f"remap tables in {path} out"
        )
    if read.size not in (None, (width, height)):
        raise InputError(
            f"{path} has remap tables of {width}x{height} px, but the rig is of {read.size[0]}x"
            f"{read.size[1]}: give that of the images that the tables make"
        )
    return dataclasses.replace(read, maps=maps, size=(width, height))


def _most_bytes(path: Path) -> int:
    begin = as_text(read_head(path, _HEAD_BYTES))
    return MAX_MAPS_BYTES if begins_maps(begin) else MAX_CALIBRATION_BYTES


#: By so much of it a file of remap tables is known.
_HEAD_BYTES = 4096

#: The largest number of files of one calibration.
_MOST_FILES = 3


def _read(path: Path, content: bytes) -> tuple[str, Values]:
    refuse_foreign_bytes(path, content)
    if content.startswith(b"PK\3\4"):
        from motionstereo_cli.rig.structure import read_npz

        values = read_npz(path, content)
        refuse_foreign_values(path, values)
        return "", values
    text = as_text(content)
    if begins_maps(text[:_HEAD_BYTES]):
        values = parse_maps(path, text)
        if maps_in(values) is None:
            raise InputError(
                f"{path} holds remap tables, but not two of each camera under names such as "
                "stereoMapL_x, stereoMapL_y, stereoMapR_x and stereoMapR_y: give those of both "
                "cameras, or the calibration that they were made from (M1 D1 M2 D2 R T)"
            )
        return "", values
    refuse_foreign_text(path, text)
    if _is_plain(text):
        return text, {}
    from motionstereo_cli.rig.structure import read_structure

    values = read_structure(path, _as_yaml(text))
    refuse_foreign_values(path, values)
    return text, values


_RIG = re.compile(r"^(focal_px|baseline_m)\b", re.MULTILINE)

#: A line of rig.yaml, where nothing else says what a file is.
_OF_RIG = re.compile(r"^\s*(width|height|focal_px|baseline_m|cx|cy|doffs)\s*:", re.MULTILINE)

#: A camera model of mrcal: literals of Python.
_MRCAL = re.compile(r"^[{\s]*'lensmodel'\s*:", re.MULTILINE)


def _as_yaml(text: str) -> str:
    """Return a cameramodel of mrcal as YAML, and any other text as it is."""
    if not _MRCAL.search(text):
        return text
    # The optimisation's inputs, as encoded text, are left out.
    return "# mrcal\n" + re.sub(r"^\s*'optimization_inputs'\s*:.*$", "", text, flags=re.MULTILINE)


def _is_plain(text: str) -> bool:
    """Return whether a text has its own format, or is plain ``key: number`` lines."""
    patterns = (plain.MIDDLEBURY, plain.KITTI, plain.OST, _RIG)
    if any(pattern.search(text) for pattern in patterns):
        return True
    return not re.search(r"[\[{<]|^\s+\S|^\s*-\s|^Camera[\d]*[._]|:\s*[^\d\s#]", text, re.MULTILINE)


def _rig_or_rows(given: _Given) -> Rig | Pair:
    path, text = given.paths[0], given.texts[0]
    if not text.strip():
        raise InputError(f"{path} is empty: give the calibration")
    rows = ":" not in text or text.lstrip()[:1] in ("[", "{", "<")
    if rows or not _OF_RIG.search(text):
        if rows and (found := plain.read_rows(path, text)) is not None:
            return found
        raise InputError(
            f"{path} is no calibration of a form that is read: give one of those that "
            "'motionstereo rig --help' lists, or rig.yaml"
        )
    return parse_rig(path, text)


def _ost(given: _Given) -> Pair:
    cameras = [
        camera
        for path, text in zip(given.paths, given.texts, strict=True)
        for camera in plain.ost_cameras(path, text)
    ]
    if len(cameras) != 2:
        raise InputError(
            f"{given.name} has {len(cameras)} camera{'s' * (len(cameras) != 1)} of ROS's "
            "calibrator (ost.txt): give the two cameras of the rig in one file, or in two files, "
            "the left camera's first"
        )
    return read_ros(cameras)


def _has(*names: str) -> Callable[[str, Values], bool]:
    return lambda _, values: all(name in values for name in names)


def _has_cameras(*names: str) -> Callable[[str, Values], bool]:
    """Return a test for files with a list of cameras, the first of which has one of the names."""

    def knows(_: str, values: Values) -> bool:
        cameras = placed.cameras_in(values)
        return bool(cameras) and not cameras[0].keys().isdisjoint(names)

    return knows


def _is_kalibr(_: str, values: Values) -> bool:
    cameras = [values.get(name) for name in ("cam0", "cam1")]
    return all(isinstance(each, dict) and "intrinsics" in each for each in cameras) and not values[
        "cam1"
    ].keys().isdisjoint({"tcncnm1", "tcamimu", "timucam"})


def _is_stella(_: str, values: Values) -> bool:
    names = placed.joined({"camera": values.get("camera")} | dict(values))
    return "camerasetup" in names or "camerafocalxbaseline" in names


#: All formats; the first that recognises a file reads it.
FORMATS: tuple[Format, ...] = (
    Format(
        "Middlebury calib.txt",
        (1,),
        lambda text, _: bool(plain.MIDDLEBURY.search(text)),
        lambda g: plain.read_middlebury(g.paths[0], g.texts[0]),
    ),
    Format(
        "KITTI calib.txt",
        (1,),
        lambda text, _: bool(plain.KITTI.search(text)),
        lambda g: plain.read_kitti(g.paths[0], g.texts[0], g.pair, g.size),
    ),
    Format("ROS ost.txt", (1, 2), lambda text, _: bool(plain.OST.search(text)), _ost),
    Format("rig.yaml", (1,), lambda _, values: not values, _rig_or_rows),
    Format("stella_vslam", (1,), _is_stella, lambda g: read_stella(*g.files[0])),
    Format("OV2SLAM", (1,), _has("camerafxl"), lambda g: placed.read_ov2slam(*g.files[0], g.pair)),
    Format(
        "ORB-SLAM",
        (1,),
        lambda _, values: not values.keys().isdisjoint({"camerafx", "camera1fx"}),
        lambda g: read_orb_slam(*g.files[0]),
    ),
    Format(
        "VINS-Fusion",
        (1, 2, 3),
        lambda _, values: placed.is_camodocal(values) or "bodytcam0" in values,
        lambda g: placed.read_vins(g.files, g.pair),
    ),
    Format(
        "ROS camera_info",
        (2,),
        lambda _, values: "projectionmatrix" in values or values.keys() >= {"d", "k", "r", "p"},
        lambda g: read_ros(g.files),
    ),
    Format("EuRoC sensor.yaml", (2,), _has("tbs"), lambda g: placed.read_euroc(g.files)),
    Format("kalibr camchain", (1,), _is_kalibr, lambda g: read_kalibr(*g.files[0])),
    Format("OKVIS", (1,), _has_cameras("tsc"), lambda g: placed.read_okvis(*g.files[0], g.pair)),
    Format(
        "ncamera",
        (1,),
        _has_cameras("tbc", "tcb"),
        lambda g: placed.read_ncamera(*g.files[0], g.pair),
    ),
    Format(
        "RealSense T265",
        (1,),
        _has_cameras("focallengthpx"),
        lambda g: placed.read_t265(*g.files[0], g.pair),
    ),
    Format(
        "Basalt",
        (1,),
        lambda _, values: isinstance(values.get("value0"), dict) and "timucam" in values["value0"],
        lambda g: placed.read_basalt(*g.files[0], g.pair),
    ),
    Format("mrcal cameramodel", (2,), _has("lensmodel"), lambda g: placed.read_mrcal(g.files)),
    Format(
        "stereodemo",
        (1,),
        _has("fx", "cx0", "cx1"),
        lambda g: plain.read_stereodemo(*g.files[0]),
    ),
    Format(
        "PL-StVO",
        (1,),
        lambda _, values: isinstance(values.get("cam0"), dict) and "cambl" in values["cam0"],
        lambda g: plain.read_stvo(*g.files[0]),
    ),
    Format("DepthAI", (1,), _has("cameradata"), lambda g: read_depthai(*g.files[0], g.size)),
    Format(
        "ZED",
        (1,),
        lambda _, values: (
            isinstance(values.get("stereo"), dict)
            and any(name.startswith("leftcam") for name in values)
        ),
        lambda g: read_zed(*g.files[0], g.size),
    ),
    Format(
        "OpenCV",
        (1, 2),
        lambda _, __: True,
        lambda g: read_opencv(
            g.name, {key: value for each in g.values for key, value in each.items()}
        ),
    ),
)
