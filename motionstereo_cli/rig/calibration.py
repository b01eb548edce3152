"""Read calibration files as a rig, and rectify recorded images."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.files.reading import MAX_PIXELS
from motionstereo_cli.rig.beside import calibration_beside
from motionstereo_cli.rig.cameras import SHAPES, Pair
from motionstereo_cli.rig.formats import read_files
from motionstereo_cli.rig.lenses import maps_of
from motionstereo_cli.rig.rectify import (
    LONGEST_BASELINE_M,
    check_centres,
    inside,
    max_moved_px,
    rig_of,
    transforms_of,
)
from motionstereo_cli.rig.ros_and_orbslam import read_ros
from motionstereo_cli.rig.settings import NO_RIG, RigSettings
from motionstereo_cli.rig.turned import is_vertical, turned
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from motionstereo_cli.rig.cameras import Camera, Maps, Matrix
    from motionstereo_cli.sources import StereoSource
    from motionstereo_cli.types import Grey

    Rectifier = Callable[[Grey], Grey]

#: Images that would move by less than this, in px, are not rectified.
_NEGLIGIBLE_PX = 0.05

#: Plausible focal lengths in px, as shares of the width: a view of 143 degrees or more cannot be
#: rectified, and no stereo camera has one of 3 degrees or less.
_FOCAL_SHARES = (1 / 6, 20)

#: If rectified images keep less than this share of the recorded ones, the file is wrong.
_MIN_COVERAGE = 0.3


@dataclass(frozen=True, slots=True)
class Calibration:
    """A stereo camera, and the rectification of its images.

    Attributes:
        rig: the camera of the rectified images.
        kind: format of the files.
        model: the lenses of the recorded images, in words.
        maps: for the left and the right camera, where each rectified pixel lies in the recorded
            image: x and y, (height, width) float32, in px. None where images are rectified.
        coverage: share of the rectified pixels, 0..1, that both recorded images have.
        warnings: assumptions, one line each.
        body_from_left: (4, 4), takes points of the rectified left camera's optical frame to that
            of the body of EuRoC's and kalibr's files, in m; None where the files have none.
        found: the files, if they were found beside the recording.
        origin: where it comes from, in words: its files, or the recording.
    """

    rig: Rig
    kind: str
    model: str
    maps: tuple[Maps, Maps] | None = None
    coverage: float = 1.0
    warnings: tuple[str, ...] = ()
    body_from_left: Matrix | None = None
    found: tuple[Path, ...] = ()
    origin: str = ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user, one line each: which files were found."""
        if not self.found:
            return ()
        names = " and ".join(str(path) for path in self.found)
        return (f"the calibration is that of {names} ({self.kind}): --rig none goes without",)

    def rectifiers(self) -> tuple[Rectifier, Rectifier]:
        """Return functions that rectify left and right images.

        Each takes and returns (height, width) uint8; it interpolates linearly, and what the
        recorded image does not show is black.
        """
        if self.maps is None:
            return _as_it_is, _as_it_is
        left, right = self.maps
        return functools.partial(_remapped, maps=left), functools.partial(_remapped, maps=right)

    def describe(self) -> str:
        """Describe the calibration, as lines of text."""
        rig = self.rig
        facts = {
            "format": self.kind,
            "size": f"{rig.width}x{rig.height} px",
            "lenses": self.model,
            "focal length": f"{rig.focal_px:.2f} px",
            "principal point": f"{rig.cx:.2f}, {rig.cy:.2f} px, doffs {rig.doffs:z.2f} px",
            "baseline": f"{rig.baseline_m * 1000:.4g} mm",
            "rectification": "not needed",
        }
        if self.maps is not None:
            x, y = np.meshgrid(np.arange(rig.width), np.arange(rig.height))
            max_px = max(float(np.hypot(mx - x, my - y).max()) for mx, my in self.maps)
            facts["rectification"] = (
                f"needed: moves pixels by up to {max_px:.1f} px, "
                f"{self.coverage:.0%} of the rectified image is filled"
            )
        return "".join(f"{name + ':':<17}{fact}\n" for name, fact in facts.items())


def read_calibration(
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    settings: RigSettings | None = None,
    *,
    pair: tuple[int, int] | None = None,
    max_pixels: int = MAX_PIXELS,
    turned_deg: int = 0,
) -> Calibration:
    """Read the calibration of a stereo camera.

    If the files contain the rectification (R1, R2, P1, P2), it is used unless a view is chosen.
    Otherwise both principal points coincide (doffs = 0): for pinhole lenses as
    cv2.stereoRectify places them, without empty borders; for wide ones in the middle of the image,
    with the focal length of the lens's middle.

    Args:
        paths: files as :func:`~motionstereo_cli.rig.formats.read_files` takes them.
        size: width and height of the recorded images in px, None if unknown.
        settings: unit of length in the files, and view of the rectified images; None: the
            defaults.
        pair: numbers of the left and right camera, for KITTI.
        max_pixels: largest width times height of the images.
        turned_deg: the clockwise rotation of the images after recording, 90 or 270; the calibration
            of cameras one above the other is then turned as well.

    Raises:
        InputError: a file cannot be read, lacks a value or has an invalid one, is for another size,
            or the size is not known.
    """
    s, name = settings or RigSettings(), " and ".join(str(path) for path in paths)
    read = read_files(paths, size, pair)
    if isinstance(read, Rig):
        return _judged(_of_rig(read, name, size, s, max_pixels), name)
    recorded = read.size or (size and (size[1], size[0]))
    if turned_deg in (90, 270) and recorded and is_vertical(read):
        read = turned(name, read, recorded, turned_deg)
    return _judged(_of_pair(read, name, size, s, max_pixels), name)


def _judged(calibration: Calibration, name: str) -> Calibration:
    """Return a calibration, with a warning if its view is implausible."""
    rig, focal_px, width = calibration.rig, calibration.rig.focal_px, calibration.rig.width
    if not (0 <= rig.cx <= rig.width and 0 <= rig.cy <= rig.height):
        warning = (
            f"{name}: the principal point {rig.cx:.0f}, {rig.cy:.0f} lies outside the images of "
            f"{rig.width}x{rig.height} px: see that the calibration is of images of this size"
        )
        calibration = dataclasses.replace(calibration, warnings=(*calibration.warnings, warning))
    if _FOCAL_SHARES[0] < focal_px / width < _FOCAL_SHARES[1]:
        return calibration
    degrees = 2 * math.degrees(math.atan(width / 2 / focal_px))
    warning = (
        f"{name}: a focal length of {focal_px:.4g} px in images {width} px wide is a view of "
        f"{degrees:.3g} degrees: see that it is in px, not in mm, and of images of this size"
    )
    return dataclasses.replace(calibration, warnings=(*calibration.warnings, warning))


def _of_pair(
    read: Pair,
    name: str,
    size: tuple[int, int] | None,
    settings: RigSettings,
    max_pixels: int,
) -> Calibration:
    stated, size = read.size, _agreed_size(name, read.size, size, max_pixels)
    cameras = read.cameras
    if cameras is not None:
        check_centres(name, [camera.matrix for camera in cameras], size, stated=bool(stated))
    elif read.rectified is not None:
        matrices = [projection for _, projection in read.rectified]
        check_centres(name, matrices, size, stated=bool(stated), outside=True)
    transforms = read.rectified
    if cameras is not None:
        transforms = transforms_of(name, read, size, settings.fov)
    assert transforms is not None
    (_, first), (_, second) = transforms
    rig, warnings = rig_of(name, (first, second), size, read.unit, settings.length_m)
    calibration = Calibration(rig, read.kind, "rectified images", warnings=read.notes + warnings)
    if cameras is None and read.maps is None:
        return _without_view(calibration, name, settings)
    if cameras is None:
        assert read.maps is not None
        calibration = _without_view(calibration, name, settings)
        left, right = read.maps
    else:
        left, right = (
            maps_of(camera, rotation, projection, size)
            for camera, (rotation, projection) in zip(cameras, transforms, strict=True)
        )
    coverage = float((inside(left, size) & inside(right, size)).mean())
    if coverage < _MIN_COVERAGE:
        raise InputError(
            f"{name}: rectified, only {coverage:.0%} of the image would be left: "
            "check that the calibration is of this camera and in this order; of wide lenses, "
            "--fov 100 chooses another view"
        )
    needed = max(max_moved_px(left), max_moved_px(right)) > _NEGLIGIBLE_PX
    return dataclasses.replace(
        calibration,
        model=_model(cameras) if cameras else "remap tables",
        maps=(left, right) if needed else None,
        coverage=coverage,
        body_from_left=_body_from_rectified(read, transforms[0][0], rig.baseline_m),
    )


def _without_view(calibration: Calibration, name: str, settings: RigSettings) -> Calibration:
    """Return the calibration of images that are rectified already; their view cannot be chosen."""
    if not settings.fov:
        return calibration
    warning = f"{name} is of rectified images: --fov is not used"
    return dataclasses.replace(calibration, warnings=(*calibration.warnings, warning))


def _body_from_rectified(pair: Pair, turn: Matrix, baseline_m: float) -> Matrix | None:
    if pair.body_from_left is None or pair.translation is None:
        return None
    body = pair.body_from_left.copy()
    body[:3, :3] = body[:3, :3] @ turn.T
    body[:3, 3] *= baseline_m / np.linalg.norm(pair.translation)
    return body


def rectify_source(
    source: StereoSource, paths: Sequence[Path], settings: RigSettings | None = None
) -> Calibration | None:
    """Read the calibration of a source, and make the source rectify its images if necessary.

    For KITTI the names of the recordings (image_2, image_03) tell which cameras these are.

    Args:
        source: not yet iterated.
        paths: calibration files; if there are none, that of a bag or spatial video is used, or
            the files that :func:`~motionstereo_cli.rig.beside.calibration_beside` finds. Without
            any, or if the path is ``none``, None is returned.
        settings: as in :func:`read_calibration`.

    Raises:
        InputError: as in :func:`read_calibration`.
    """
    if tuple(paths) == (NO_RIG,):
        return None
    size = (source.view_width, source.view_height)
    if not paths and source.camera_infos:
        calibration = _recorded(source, size, settings or RigSettings())
        if calibration.maps is not None:
            source.rectify(*calibration.rectifiers())
        return calibration
    found = () if paths else calibration_beside(source.recorded)
    if not (paths or found):
        return None
    s = source.settings
    numbers = [re.findall(r"image_0?(\d)", str(path)) for path in source.recorded]
    pair = (
        (int(numbers[0][-1]), int(numbers[1][-1])) if len(numbers) == 2 and all(numbers) else None
    )
    try:
        calibration = read_calibration(
            paths or found,
            size,
            settings,
            pair=pair,
            max_pixels=s.max_pixels,
            turned_deg=s.rotate_left if s.rotate_left == s.rotate_right else 0,
        )
    except InputError as error:
        if not found:
            raise
        raise InputError(
            f"{error}; it was found beside the recording: give another to --rig, or --rig none"
        ) from None
    if calibration.maps is not None:
        source.rectify(*calibration.rectifiers())
    names = " and ".join(str(path) for path in paths or found)
    said = [calibration.kind] if calibration.kind not in names else []
    said += ["found beside the recording"] if found else []
    origin = f"{names} ({', '.join(said)})" if said else names
    return dataclasses.replace(calibration, found=found, origin=origin)


def _recorded(source: StereoSource, size: tuple[int, int], settings: RigSettings) -> Calibration:
    """Return the calibration that a source recorded with its images."""
    from motionstereo_cli.rig.structure import read_structure

    files = [(Path(name), read_structure(Path(name), text)) for name, text in source.camera_infos]
    pair = read_ros(files)
    if source.rectified:
        pair = dataclasses.replace(pair, cameras=None)
    name = files[0][0].as_posix()
    found = _of_pair(pair, name, size, settings, source.settings.max_pixels)
    return dataclasses.replace(
        found,
        warnings=(*source.calibration_notes, *found.warnings),
        origin=f"recorded with the images ({found.kind})",
    )


def _of_rig(
    rig: Rig,
    name: str,
    size: tuple[int, int] | None,
    settings: RigSettings,
    max_pixels: int,
) -> Calibration:
    _agreed_size(name, (rig.width, rig.height), size, max_pixels)
    rig = dataclasses.replace(rig, baseline_m=rig.baseline_m * (settings.length_m or 1.0))
    warnings: tuple[str, ...] = ()
    if rig.baseline_m > LONGEST_BASELINE_M:
        warnings = (
            f"{name}: a baseline of {rig.baseline_m:g} m is long: "
            "if it is in mm, say --baseline-unit mm",
        )
    calibration = Calibration(rig, "rig.yaml", "rectified images", warnings=warnings)
    return _without_view(calibration, name, settings)


def _agreed_size(
    name: str, stated: tuple[int, int] | None, given: tuple[int, int] | None, max_pixels: int
) -> tuple[int, int]:
    if stated is not None and given is not None and stated != given:
        raise InputError(
            f"the rig is for {stated[0]}x{stated[1]} but the recordings are "
            f"{given[0]}x{given[1]}: give the rig of these recordings"
        )
    size = stated or given
    if size is None:
        raise InputError(f"{name} does not say how large the images are: give --size WIDTHxHEIGHT")
    if size[0] * size[1] > max_pixels:
        raise InputError(
            f"{name}: images of {size[0]:.7g}x{size[1]:.7g} px are far too large: check the file"
        )
    return size


def _model(cameras: tuple[Camera, Camera]) -> str:
    model = cameras[0].model
    left, right = (len(each.distortion) - len(SHAPES.get(model, ())) for each in cameras)
    count = f"{left}" if left == right else f"{left} and {right}"
    name = {"omni": "omnidirectional (Mei)", "ds": "double sphere", "eucm": "extended unified"}
    return f"{name.get(model, model)}, {count} distortion coefficients"


def _remapped(grey: Grey, maps: Maps) -> Grey:
    return np.asarray(cv2.remap(grey, *maps, cv2.INTER_LINEAR), np.uint8)


def _as_it_is(grey: Grey) -> Grey:
    return grey
