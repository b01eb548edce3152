"""From calibration files to a rig, and from recorded images to rectified ones."""

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
from motionstereo_cli.rig.cameras import Pair, checked_intrinsics
from motionstereo_cli.rig.formats import read_files
from motionstereo_cli.rig.slam import read_ros
from motionstereo_cli.rig.structure import read_structure
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.rig.cameras import Camera, Matrix, Rectified
    from motionstereo_cli.sources import StereoSource
    from motionstereo_cli.types import Grey, Real

    Maps = tuple[Real, Real]
    Rectifier = Callable[[Grey], Grey]

BASELINE_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}

#: Baselines beyond these are hardly in the unit that a file has or seems to have.
_LONGEST_BASELINE_M = 2.0
_SHORTEST_BASELINE_MM = 2.0

#: Images that move by less than this need no rectification.
_NEGLIGIBLE_PX = 0.05

#: Rectified images that keep less than this share of the recorded ones come from a wrong file.
_MIN_COVERAGE = 0.3

#: A principal point lies about in the middle. One that lies, in both axes and both images, as if
#: the size were this many times another is of a calibration for that other size; both axes agree
#: within this share.
_OTHER_SIZE, _SIZES_AGREE = 1.3, 0.15

#: Focal lengths, as shares, and rows of the principal points, in px, that rectified cameras share.
_FOCAL_TOLERANCE = 0.005
_ROW_TOLERANCE_PX = 0.5


@dataclass(frozen=True, slots=True)
class Calibration:
    """A stereo camera, and how its images become rectified.

    Attributes:
        rig: the camera that the rectified images seem to come from.
        kind: format of the files.
        model: the recorded images' lenses in words.
        maps: for the left and the right camera, where each rectified pixel lies in the recorded
            image: x and y, (height, width) float32, in px. None where images are rectified.
        coverage: share of the rectified pixels, 0..1, that both recorded images have.
        warnings: what was guessed, one line each.
        body_from_left: (4, 4), takes points of the rectified left camera's optical frame to that
            of the body of EuRoC's and kalibr's files, in m; None where the files have none.
    """

    rig: Rig
    kind: str
    model: str
    maps: tuple[Maps, Maps] | None = None
    coverage: float = 1.0
    warnings: tuple[str, ...] = ()
    body_from_left: Matrix | None = None

    def rectifiers(self) -> tuple[Rectifier, Rectifier]:
        """Return what rectifies the left and the right images.

        Each takes and returns (height, width) uint8; it interpolates linearly, and leaves black
        what the recorded image does not have.
        """
        if self.maps is None:
            return _as_it_is, _as_it_is
        left, right = self.maps
        return functools.partial(_remapped, maps=left), functools.partial(_remapped, maps=right)

    def describe(self) -> str:
        """Return what was understood, as lines of text."""
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
    *,
    baseline_unit: str | None = None,
    pair: tuple[int, int] | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Calibration:
    """Read the calibration of a stereo camera.

    Where the files say how images are to be rectified (R1, R2, P1, P2), that holds; otherwise
    cv2.stereoRectify finds it, with the principal points at one place (doffs = 0) and no empty
    borders.

    Args:
        paths: files as :func:`~motionstereo_cli.rig.formats.read_files` takes them.
        size: width and height of the recorded images in px, None if unknown.
        baseline_unit: unit of length in the files, ``m``, ``cm`` or ``mm``; None is what the format
            says, or a guess where that gives an unlikely baseline.
        pair: numbers of the left and right camera, for KITTI.
        max_pixels: largest width times height of the images.

    Raises:
        InputError: a file cannot be read, lacks or spoils a value, is for another size, or does not
            say the size and neither does the caller.
    """
    name = " and ".join(str(path) for path in paths)
    read = read_files(paths, size, pair)
    if isinstance(read, Rig):
        return _of_rig(read, name, size, baseline_unit, max_pixels)
    return _of_pair(read, name, size, baseline_unit, max_pixels)


def _of_pair(
    read: Pair,
    name: str,
    size: tuple[int, int] | None,
    baseline_unit: str | None,
    max_pixels: int,
) -> Calibration:
    stated, size = read.size, _agreed_size(name, read.size, size, max_pixels)
    cameras = read.cameras
    if cameras is not None:
        _check_centres(name, [camera.matrix for camera in cameras], size, stated=bool(stated))
    elif read.rectified is not None:
        matrices = [projection for _, projection in read.rectified]
        _check_centres(name, matrices, size, stated=bool(stated), outside=True)
    transforms = read.rectified or _rectified(name, read, cameras, size)
    (_, first), (_, second) = transforms
    rig, warnings = _rig_of(name, (first, second), size, read.unit, baseline_unit)
    calibration = Calibration(rig, read.kind, "rectified images", warnings=read.notes + warnings)
    if cameras is None:
        return calibration
    left, right = (
        _maps(camera, rotation, projection, size)
        for camera, (rotation, projection) in zip(cameras, transforms, strict=True)
    )
    coverage = float((_inside(left, size) & _inside(right, size)).mean())
    if coverage < _MIN_COVERAGE:
        raise InputError(
            f"{name}: rectified, only {coverage:.0%} of the image would be left: "
            "check that the calibration is of this camera and in this order"
        )
    needed = max(_max_moved_px(left), _max_moved_px(right)) > _NEGLIGIBLE_PX
    return dataclasses.replace(
        calibration,
        model=_model(cameras),
        maps=(left, right) if needed else None,
        coverage=coverage,
        body_from_left=_body_from_rectified(read, transforms[0][0], rig.baseline_m),
    )


def _body_from_rectified(pair: Pair, turn: Matrix, baseline_m: float) -> Matrix | None:
    if pair.body_from_left is None or pair.translation is None:
        return None
    body = pair.body_from_left.copy()
    body[:3, :3] = body[:3, :3] @ turn.T
    body[:3, 3] *= baseline_m / np.linalg.norm(pair.translation)
    return body


def rectify_source(
    source: StereoSource, paths: Sequence[Path], baseline_unit: str | None = None
) -> Calibration | None:
    """Read the calibration of a source, and have the source rectify its images if necessary.

    Which of KITTI's cameras these are is told by the names of the recordings (image_2, image_03).

    Args:
        source: not yet iterated.
        paths: calibration files; None is returned where there is none.
        baseline_unit: as in :func:`read_calibration`.

    Raises:
        InputError: as in :func:`read_calibration`.
    """
    size = (source.view_width, source.view_height)
    if not paths and source.camera_infos:
        calibration = _recorded(source, size, baseline_unit)
        if calibration.maps is not None:
            source.rectify(*calibration.rectifiers())
        return calibration
    if not paths:
        return None
    numbers = [re.findall(r"image_0?(\d)", str(path)) for path in source.paths]
    pair = (
        (int(numbers[0][-1]), int(numbers[1][-1])) if len(numbers) == 2 and all(numbers) else None
    )
    calibration = read_calibration(
        paths,
        size,
        baseline_unit=baseline_unit,
        pair=pair,
        max_pixels=source.settings.max_pixels,
    )
    if calibration.maps is not None:
        source.rectify(*calibration.rectifiers())
    return calibration


def _recorded(
    source: StereoSource, size: tuple[int, int], baseline_unit: str | None
) -> Calibration:
    """Return the calibration that was recorded beside the images of a source."""
    files = [(Path(name), read_structure(Path(name), text)) for name, text in source.camera_infos]
    pair = read_ros(files)
    if source.rectified:
        pair = dataclasses.replace(pair, cameras=None)
    name = files[0][0].as_posix()
    return _of_pair(pair, name, size, baseline_unit, source.settings.max_pixels)


def _of_rig(
    rig: Rig,
    name: str,
    size: tuple[int, int] | None,
    baseline_unit: str | None,
    max_pixels: int,
) -> Calibration:
    _agreed_size(name, (rig.width, rig.height), size, max_pixels)
    rig = dataclasses.replace(rig, baseline_m=rig.baseline_m * BASELINE_UNITS[baseline_unit or "m"])
    warnings: tuple[str, ...] = ()
    if rig.baseline_m > _LONGEST_BASELINE_M:
        warnings = (
            f"{name}: a baseline of {rig.baseline_m:g} m is long: "
            "if it is in mm, say --baseline-unit mm",
        )
    return Calibration(rig, "rig.yaml", "rectified images", warnings=warnings)


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
        raise InputError(f"{name} does not say how large the images are: give --size")
    if size[0] * size[1] > max_pixels:
        raise InputError(
            f"{name}: images of {size[0]:.7g}x{size[1]:.7g} px are far too large: check the file"
        )
    return size


def _check_centres(
    name: str,
    matrices: Sequence[Matrix],
    size: tuple[int, int],
    *,
    stated: bool,
    outside: bool = False,
) -> None:
    """Make sure that principal points are those of images of a size.

    Args:
        name: for messages.
        matrices: intrinsic matrices or projections, left and right.
        size: of the images.
        stated: the file says the size itself, so that a point out of the middle is meant.
        outside: a principal point may lie outside the image, as those of rectified ones do.
    """
    # The size that has these points in its middle.
    likely = [[2 * matrix[axis, 2] + 1 for axis in (0, 1)] for matrix in matrices]
    shares = np.array(likely) / size
    mean = float(shares.mean())
    elsewhere = (
        (shares > 0).all()
        and max(mean, 1 / mean) > _OTHER_SIZE
        and np.abs(shares / mean - 1).max() < _SIZES_AGREE
    )
    inside = all(0 < point[axis] < 2 * size[axis] for point in likely for axis in (0, 1))
    if (elsewhere and not stated) or not (inside or outside):
        side, matrix = next(
            (
                (side, matrix)
                for side, matrix, point in zip(("left", "right"), matrices, likely, strict=True)
                if not (0 < point[0] < 2 * size[0] and 0 < point[1] < 2 * size[1])
            ),
            ("left", matrices[0]),
        )
        width, height = (round(float(number)) for number in np.mean(likely, axis=0))
        of = f"is that of images of about {width}x{height} px" if elsewhere else "lies outside them"
        raise InputError(
            f"{name}: the images have {size[0]}x{size[1]} px, but the {side} principal point "
            f"{matrix[0, 2]:.0f}, {matrix[1, 2]:.0f} {of}: give the calibration for their size"
            + ("" if stated else " (if it is, state the size in the file: image_size)")
        )


def _rectified(
    name: str, pair: Pair, cameras: tuple[Camera, Camera] | None, size: tuple[int, int]
) -> tuple[Rectified, Rectified]:
    """Return rotations and projections into the rectified images, left and right."""
    assert cameras is not None
    assert pair.rotation is not None
    assert pair.translation is not None
    left, right = cameras
    if left.fisheye != right.fisheye:
        raise InputError(
            f"{name}: one lens is a fisheye and the other is not: give both the same lens model"
        )
    if not np.linalg.norm(pair.translation) > 0:
        raise InputError(f"{name}: T is zero, so the baseline is: check the file")
    _check_direction(name, pair.translation)
    if pair.translation[0] > 0:
        raise InputError(
            f"{name}: T says that the second camera stands left of the first "
            f"(T[0] is {pair.translation[0]:g}; OpenCV's T[0] is negative for a right camera). "
            "Either the cameras are in the wrong order: exchange both cameras, and the recordings "
            "stay; or R and T are given the other way round, as the right camera's place in the "
            "left one's frame: give R transposed and -R^T T"
        )
    # OpenCV wants them whole in memory, and T as a column.
    whole = np.ascontiguousarray
    lenses = (
        *(whole(left.matrix), whole(left.distortion)),
        *(whole(right.matrix), whole(right.distortion)),
    )
    rotation = whole(pair.rotation)
    translation = whole(pair.translation).reshape(3, 1)
    try:
        if left.fisheye:
            r1, r2, p1, p2, _ = cv2.fisheye.stereoRectify(
                *lenses, size, rotation, translation, cv2.CALIB_ZERO_DISPARITY
            )
        else:
            r1, r2, p1, p2, *_ = cv2.stereoRectify(
                *lenses, size, rotation, translation, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
            )
    except cv2.error as error:
        raise InputError(f"{name} cannot be rectified by: {error.err}: check its values") from None
    left_matrices, right_matrices = (
        (np.asarray(turn, np.float64), np.asarray(projection, np.float64))
        for turn, projection in ((r1, p1), (r2, p2))
    )
    return left_matrices, right_matrices


def _check_direction(name: str, translation: Matrix) -> None:
    tx, ty, tz = (float(each) for each in np.abs(translation))
    if tx >= max(ty, tz):
        return
    x, y, z = (float(each) for each in translation)
    stand = (
        "one above the other: turn both views (--rotate-left 270 --rotate-right 270 makes the "
        "upper camera the left one) and give the calibration of the turned images"
        if ty >= tz
        else "one behind the other, where stereo finds no depth: check the file"
    )
    raise InputError(
        f"{name}: the cameras do not stand side by side (T is {x:g}, {y:g}, {z:g}) but {stand}"
    )


def _wrong_order(name: str) -> InputError:
    return InputError(
        f"{name}: the first camera is to the right of the second: "
        "give the left camera's calibration first"
    )


def _rig_of(
    name: str,
    projections: tuple[Matrix, Matrix],
    size: tuple[int, int],
    unit: str | None,
    chosen_unit: str | None,
) -> tuple[Rig, tuple[str, ...]]:
    """Return the rig of two rectified projections (3, 4), and warnings."""
    left, right = projections
    for side, projection in (("left", left), ("right", right)):
        checked_intrinsics(name, f"the {side} projection", projection)
    (focal_px, focal_y_px), others = (left[0, 0], left[1, 1]), (right[0, 0], right[1, 1])
    if (
        max(abs(others[0] - focal_px), abs(others[1] - focal_y_px)) > _FOCAL_TOLERANCE * focal_px
        or abs(right[1, 2] - left[1, 2]) > _ROW_TOLERANCE_PX
    ):
        raise InputError(
            f"{name}: the projections differ in focal length or row ({focal_px:g} and "
            f"{right[0, 0]:g} px, {left[1, 2]:g} and {right[1, 2]:g} px), "
            "so they are of no rectified pair: check the file"
        )
    across = left[0, 3] / focal_px - right[0, 3] / right[0, 0]
    down = left[1, 3] / focal_y_px - right[1, 3] / right[1, 1]
    if abs(down) > abs(across):
        _check_direction(name, np.array([-across, -down, 0.0]))
    if across == 0:
        raise InputError(f"{name}: the baseline is 0: check the file")
    reversed_sign: tuple[str, ...] = ()
    if across < 0:
        # The left camera is the one that the other is measured from: its P[0,3] is 0.
        if left[0, 3] or not right[0, 3]:
            raise _wrong_order(name)
        reversed_sign = (
            f"{name}: P[0,3] of the right camera is {right[0, 3]:g}, but -fx * baseline is "
            "negative: its sign is taken to be the other way round. Should the check find left "
            "and right swapped, the files are in the wrong order instead",
        )
    baseline_m, warnings = _in_metres(name, abs(float(across)), unit, chosen_unit)
    rig = Rig(
        *size,
        focal_px=float(focal_px),
        baseline_m=baseline_m,
        cx=float(left[0, 2]),
        cy=float(left[1, 2]),
        doffs=float(right[0, 2] - left[0, 2]),
        focal_y_px=None if np.isclose(focal_y_px, focal_px, rtol=1e-6) else float(focal_y_px),
    )
    return rig, reversed_sign + warnings


def _in_metres(
    name: str, baseline: float, unit: str | None, chosen: str | None
) -> tuple[float, tuple[str, ...]]:
    if chosen is not None:
        return baseline * BASELINE_UNITS[chosen], ()
    likely = unit or "m"
    if likely == "m" and baseline > _LONGEST_BASELINE_M:
        likely = "mm"
    elif likely == "mm" and baseline < _SHORTEST_BASELINE_MM:
        likely = "m"
    elif unit is not None or baseline < _LONGEST_BASELINE_M:
        return baseline * BASELINE_UNITS[likely], ()
    warning = (
        f"{name}: a baseline of {baseline:g} is taken to be in {likely}: "
        "if it is not, say --baseline-unit"
    )
    return baseline * BASELINE_UNITS[likely], (warning,)


def _maps(camera: Camera, rotation: Matrix, projection: Matrix, size: tuple[int, int]) -> Maps:
    # Maps in float: cv2.remap is faster with them than with fixed-point ones since OpenCV 5.
    make = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
    x, y = make(camera.matrix, camera.distortion, rotation, projection[:, :3], size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def _inside(maps: Maps, size: tuple[int, int]) -> NDArray[np.bool_]:
    x, y = maps
    return (x >= 0) & (x <= size[0] - 1) & (y >= 0) & (y <= size[1] - 1)


def _max_moved_px(maps: Maps) -> float:
    x, y = maps
    height, width = x.shape
    moved = np.hypot(x - np.arange(width), y - np.arange(height)[:, None])
    most = float(moved.max())
    return most if math.isfinite(most) else math.inf


def _model(cameras: tuple[Camera, Camera]) -> str:
    left, right = (len(camera.distortion) for camera in cameras)
    name = "fisheye" if cameras[0].fisheye else "pinhole"
    count = f"{left}" if left == right else f"{left} and {right}"
    return f"{name}, {count} distortion coefficients"


def _remapped(grey: Grey, maps: Maps) -> Grey:
    return np.asarray(cv2.remap(grey, *maps, cv2.INTER_LINEAR), np.uint8)


def _as_it_is(grey: Grey) -> Grey:
    return grey
