"""The geometry of rectification: from calibrated cameras to projections, maps and a rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.cameras import Pair, checked_intrinsics, intrinsic_matrix
from motionstereo_cli.rig.lenses import middle_focal_px
from motionstereo_cli.rig.settings import LENGTHS_M
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.rig.cameras import Camera, Maps, Matrix, Rectified

#: Plausible baselines: the minimum and maximum in m, the maximum for files without a unit, and the
#: maximum for formats whose unit is m.
LONGEST_BASELINE_M = 2.0
_SHORTEST_BASELINE_MM = 2.0
_USUAL_BASELINE_M = 0.8
_LONGEST_IN_M, _SHORTEST_USUAL_MM = 10.0, 20.0

#: The widest view in degrees of rectified images of wide lenses, unless the user chooses one:
#: beyond it, most of an image shows little of the scene.
_WIDEST_VIEW_DEG = 120.0

#: A principal point is near the middle. If it is at the middle of another size, scaled by at least
#: this in both axes and both images, the calibration is for that size; both axes agree within this
#: share.
_OTHER_SIZE, _SIZES_AGREE = 1.3, 0.15

#: Tolerances of rectified cameras: focal lengths, as a share, and rows of principal points, in px.
_FOCAL_TOLERANCE = 0.005
_ROW_TOLERANCE_PX = 0.5


def check_centres(
    name: str,
    matrices: Sequence[Matrix],
    size: tuple[int, int],
    *,
    stated: bool,
    outside: bool = False,
) -> None:
    """Check that principal points fit images of a size.

    Args:
        name: for messages.
        matrices: intrinsic matrices or projections, left and right.
        size: width and height of the images in px.
        stated: the file states the size, so that an off-centre point is intended.
        outside: a principal point may be outside the image, as with rectified ones.

    Raises:
        InputError: they do not.
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


def transforms_of(
    name: str, pair: Pair, size: tuple[int, int], fov_deg: float = 0.0
) -> tuple[Rectified, Rectified]:
    """Return rotations and projections into the rectified images, left and right.

    Args:
        name: for messages.
        pair: has cameras, and their poses or their rectification.
        size: of the images.
        fov_deg: horizontal view of the rectified images; 0: the file's own, or chosen by the
            lenses.

    Raises:
        InputError: the cameras cannot be rectified.
    """
    assert pair.cameras is not None
    left, right = pair.cameras
    rotation, translation = _right_from_left(pair)
    if pair.rectified is not None and not fov_deg:
        if pair.translation is not None and is_reversed(pair):
            raise _second_on_the_left(name, translation)
        return pair.rectified
    if left.model != right.model:
        raise InputError(
            f"{name}: the lenses have different models, {left.model} and {right.model}: give both "
            "the same"
        )
    if not np.linalg.norm(translation) > 0:
        raise InputError(f"{name}: T is zero, so the baseline is: check the file")
    _check_direction(name, translation)
    if translation[0] > 0:
        raise _second_on_the_left(name, translation)
    if left.model != "pinhole" or fov_deg:
        return _centred(pair.cameras, rotation, translation, size, fov_deg)
    # OpenCV wants them whole in memory, and T as a column.
    whole = np.ascontiguousarray
    lenses = (
        *(whole(left.matrix), whole(left.distortion)),
        *(whole(right.matrix), whole(right.distortion)),
    )
    try:
        r1, r2, p1, p2, *_ = cv2.stereoRectify(
            *(*lenses, size, whole(rotation), whole(translation).reshape(3, 1)),
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=0,
        )
    except cv2.error as error:
        raise InputError(f"{name} cannot be rectified by: {error.err}: check its values") from None
    left_matrices, right_matrices = (
        (np.asarray(turn, np.float64), np.asarray(projection, np.float64))
        for turn, projection in ((r1, p1), (r2, p2))
    )
    return left_matrices, right_matrices


def is_reversed(pair: Pair) -> bool:
    """Return whether both T and the projections have the second camera on the left."""
    if pair.rectified is None or pair.translation is None:
        return False
    (_, left), (_, right) = pair.rectified
    tx, ty, _ = pair.translation
    return bool(tx > abs(ty) and right[0, 3] > left[0, 3])


def _second_on_the_left(name: str, translation: Matrix) -> InputError:
    return InputError(
        f"{name}: T says that the second camera stands left of the first "
        f"(T[0] is {translation[0]:g}; OpenCV's T[0] is negative for a right camera). "
        "Either the cameras are in the wrong order: exchange both cameras, and the recordings "
        "stay; or R and T are given the other way round, as the right camera's place in the "
        "left one's frame: give R transposed and -R^T T; or only the sign of T is wrong: give "
        "-T. With the right one, motionstereo check finds that rows agree"
    )


def _right_from_left(pair: Pair) -> tuple[Matrix, Matrix]:
    """Return the rotation and translation from the left camera, also from the rectification."""
    if pair.rotation is not None and pair.translation is not None:
        return pair.rotation, pair.translation
    assert pair.rectified is not None
    (left_turn, _), (right_turn, projection) = pair.rectified
    across = np.array([projection[0, 3] / projection[0, 0], 0.0, 0.0])
    return right_turn.T @ left_turn, right_turn.T @ across


def _centred(
    cameras: tuple[Camera, Camera],
    rotation: Matrix,
    translation: Matrix,
    size: tuple[int, int],
    fov_deg: float,
) -> tuple[Rectified, Rectified]:
    """Return rotations and projections into images with the principal point in their middle.

    Each camera is rotated by half of the rotation between them, and both so that the baseline is
    along x (Bouguet). OpenCV's estimate of the focal length fails for lenses of 150 degrees and
    more; that of the lens's middle loses no detail there and leaves no empty border.
    """
    width, height = size
    half = np.asarray(cv2.Rodrigues(np.asarray(cv2.Rodrigues(rotation)[0]) / -2)[0], np.float64)
    along = half @ translation
    # The shortest rotation that takes the baseline to -x.
    axis = np.cross(along, [-1.0, 0.0, 0.0])
    length = float(np.linalg.norm(axis))
    angle = math.atan2(length, -along[0])
    level = np.asarray(cv2.Rodrigues(axis * (angle / length if length else 0.0))[0], np.float64)
    least = width / 2 / math.tan(math.radians(fov_deg or _WIDEST_VIEW_DEG) / 2)
    middle = float(np.mean([middle_focal_px(camera) for camera in cameras]))
    focal_px = least if fov_deg else max(middle, least)
    left = np.column_stack(
        [intrinsic_matrix(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2), np.zeros(3)]
    )
    right = left.copy()
    right[0, 3] = -focal_px * np.linalg.norm(translation)
    return (level @ half.T, left), (level @ half, right)


def _check_direction(name: str, translation: Matrix) -> None:
    tx, ty, tz = (float(each) for each in np.abs(translation))
    if tx >= max(ty, tz):
        return
    x, y, z = (float(each) for each in translation)
    stand = (
        "one above the other: turn both views, with --rotate-left 270 --rotate-right 270 where "
        "the first is the upper one and 90 where it is the lower one"
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


def rig_of(
    name: str,
    projections: tuple[Matrix, Matrix],
    size: tuple[int, int],
    unit: str | None,
    length_m: float | None,
) -> tuple[Rig, tuple[str, ...]]:
    """Return the rig of two rectified projections, and warnings.

    Args:
        name: for messages.
        projections: (3, 4) each, in px and the file's unit of length, left and right.
        size: width and height of the images in px.
        unit: the format's unit of length, None if it has none.
        length_m: the unit of length that the user states, in m; None if none.

    Raises:
        InputError: they are not those of one rectified pair, left then right.
    """
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
        # The left camera is the origin: its P[0,3] is 0.
        if left[0, 3] or not right[0, 3]:
            raise _wrong_order(name)
        reversed_sign = (
            f"{name}: P[0,3] of the right camera is {right[0, 3]:g}, but -fx * baseline is "
            "negative: its sign is taken to be the other way round. Should the check find left "
            "and right swapped, the files are in the wrong order instead",
        )
    baseline_m, warnings = _in_metres(name, abs(float(across)), unit, length_m)
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
    name: str, baseline: float, unit: str | None, length_m: float | None
) -> tuple[float, tuple[str, ...]]:
    if length_m is not None:
        return baseline * length_m, ()
    likely = unit or "m"
    if likely == "m" and baseline > (LONGEST_BASELINE_M if unit is None else _LONGEST_IN_M):
        likely = "mm"
    elif likely == "mm" and baseline < _SHORTEST_BASELINE_MM:
        likely = "m"
    elif unit in ("cm", "mm") or baseline < (LONGEST_BASELINE_M if unit else _USUAL_BASELINE_M):
        return baseline * LENGTHS_M[likely], ()
    short = likely == "mm" and baseline < _SHORTEST_USUAL_MM
    doubt = ", as few cameras but endoscopes have" if short else ""
    warning = (
        f"{name}: a baseline of {baseline:g} is taken to be in {likely}{doubt}: if it is in "
        "another unit, say --baseline-unit cm (or m, mm); if it is in squares of the calibration "
        "board, say the side of a square, as --baseline-unit 25mm"
    )
    return baseline * LENGTHS_M[likely], (warning,)


def inside(maps: Maps, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which rectified pixels the image of a size has, (height, width) bool."""
    x, y = maps
    return (x >= 0) & (x <= size[0] - 1) & (y >= 0) & (y <= size[1] - 1)


def max_moved_px(maps: Maps) -> float:
    """Return the maximum displacement of a pixel by rectification, in px."""
    x, y = maps
    height, width = x.shape
    moved = np.hypot(x - np.arange(width), y - np.arange(height)[:, None])
    most = float(moved.max())
    return most if math.isfinite(most) else math.inf
