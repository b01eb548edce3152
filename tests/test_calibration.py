"""Calibration files of all kinds, and rectification: one made-up rig written in every format."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from motionstereo_cli.__main__ import main
from motionstereo_cli.commands import cli
from motionstereo_cli.errors import InputError
from motionstereo_cli.rig import read_rig, write_rig
from motionstereo_cli.rig.calibration import Calibration, read_calibration
from motionstereo_cli.rig.settings import RigSettings
from motionstereo_cli.types import Rig

SIZE = (320, 240)
BASELINE_M = 0.12
K1 = np.array([[260.0, 0, 158], [0, 258, 122], [0, 0, 1]])
K2 = np.array([[264.0, 0, 163], [0, 262, 117], [0, 0, 1]])
D1 = np.array([-0.12, 0.03, 0.001, -0.0005, 0.01])
D2 = np.array([-0.10, 0.02, -0.001, 0.0005, 0.0])
F1 = np.array([0.05, -0.02, 0.004, 0.0])
F2 = np.array([0.04, -0.01, 0.002, 0.0])
# The right camera is turned by 1 to 2 degrees about each axis, and sits 0.12 m to the right.
R = np.asarray(cv2.Rodrigues(np.array([0.02, -0.03, 0.025]))[0])
T = -R @ np.array([BASELINE_M, 0.002, -0.003])
LENGTH_M = float(np.linalg.norm(T))

POINTS_M = np.array(
    [[x * z, y * z, z] for z in (1.2, 2.0, 4.0) for x in (-0.35, 0.05, 0.3) for y in (-0.3, 0.2)]
)


def values(array: np.ndarray) -> str:
    return ", ".join(repr(float(value)) for value in array.ravel())


def matrix(name: str, array: np.ndarray, tag: str = "") -> str:
    rows, cols = np.atleast_2d(array).shape
    return f"{name}:{tag}\n  rows: {rows}\n  cols: {cols}\n  data: [{values(array)}]\n"


def opencv_file(path: Path, **changes: np.ndarray | float | str | None) -> Path:
    """An OpenCV file (YAML, XML or JSON by its name), some values replaced, or left out if None."""
    wanted = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": R, "T": T, **changes}
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in wanted.items():
        if value is not None:
            storage.write(name, value)
    storage.release()
    return path


def fisheye_file(path: Path) -> Path:
    return opencv_file(path, D1=F1, D2=F2, distortion_model="fisheye")


def euroc_files(folder: Path) -> list[Path]:
    body_from_left = np.eye(4)
    body_from_left[:3, :3] = cv2.Rodrigues(np.array([0.1, 1.2, -0.4]))[0]
    body_from_left[:3, 3] = [0.3, -0.2, 0.1]
    right_from_left = np.eye(4)
    right_from_left[:3, :3], right_from_left[:3, 3] = R, T
    poses = body_from_left, body_from_left @ np.linalg.inv(right_from_left)
    paths = []
    for number, (pose, k, d) in enumerate(zip(poses, (K1, K2), (D1, D2), strict=True)):
        path = folder / f"cam{number}_sensor.yaml"
        intrinsics = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
        path.write_text(
            "#General sensor definitions.\nsensor_type: camera\ncomment: cam (MT9M034)\n\n"
            + matrix("T_BS", pose)
            + f"\nrate_hz: 20\nresolution: [{SIZE[0]}, {SIZE[1]}]\ncamera_model: pinhole\n"
            f"intrinsics: [{values(intrinsics)}] #fu, fv, cu, cv\n"
            "distortion_model: radial-tangential\n"
            f"distortion_coefficients: [{values(d)}]\n"
        )
        paths.append(path)
    return paths


def ros_files(folder: Path, *, block_lists: bool = False) -> list[Path]:
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        K1, D1, K2, D2, SIZE, R, T.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )
    paths = []
    for side, k, d, r, p in (("left", K1, D1, r1, p1), ("right", K2, D2, r2, p2)):
        text = (
            f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\ncamera_name: rig/{side}\n"
            + matrix("camera_matrix", k)
            + "distortion_model: plumb_bob\n"
            + matrix("distortion_coefficients", d)
            + matrix("rectification_matrix", r)
            + matrix("projection_matrix", p)
        )
        if block_lists:  # as PyYAML dumps it
            text = re.sub(
                r"data: \[(.*)\]",
                lambda m: "data:\n" + "\n".join(f"  - {v}" for v in m[1].split(", ")),
                text,
            )
        path = folder / f"{side}.yaml"
        path.write_text(text)
        paths.append(path)
    return paths


def recorded(k: np.ndarray, d: np.ndarray, points_m: np.ndarray, *, fisheye: bool) -> np.ndarray:
    """The image of a camera that sees a bright dot at each point of its own frame."""
    if fisheye:
        zero = np.zeros(3)
        places = cv2.fisheye.projectPoints(points_m[:, None], zero, zero, k, d)[0]
    else:
        places = cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), k, d)[0]
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    image = np.zeros(x.shape)
    for px, py in places.reshape(-1, 2):
        image += 250 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 1.5**2))
    return np.rint(image.clip(0, 255)).astype(np.uint8)


def dots(image: np.ndarray) -> np.ndarray:
    """Centres of bright dots, (n, 2)."""
    _, labels = cv2.connectedComponents((image > 20).astype(np.uint8))
    y, x = np.indices(image.shape)
    weights = [np.where(labels == label, image, 0.0) for label in range(1, labels.max() + 1)]
    return np.array([[(w * x).sum() / w.sum(), (w * y).sum() / w.sum()] for w in weights])


def assert_rectifies(calibration: Calibration, *, fisheye: bool = False) -> None:
    """A dot at depth Z lies on one row in both views, and f B / Z apart."""
    d1, d2 = (F1, F2) if fisheye else (D1, D2)
    rig = calibration.rig
    rectify_left, rectify_right = calibration.rectifiers()
    for point in POINTS_M:
        left = recorded(K1, d1, point[None], fisheye=fisheye)
        right = recorded(K2, d2, (point @ R.T + T)[None], fisheye=fisheye)
        raw_off = abs(dots(left)[0, 1] - dots(right)[0, 1])
        (x_left, y_left), *_ = dots(rectify_left(left))
        (x_right, y_right), *_ = dots(rectify_right(right))
        assert y_left == pytest.approx(y_right, abs=0.1)
        assert raw_off > 1, "the scene must need rectification"
        disparity = x_left - x_right
        depth_m = rig.focal_px * rig.baseline_m / (disparity + rig.doffs)
        # Depth along the rectified axis, which is turned against the camera's by a few degrees.
        assert depth_m == pytest.approx(point[2], rel=0.05)


@pytest.mark.parametrize("suffix", ["yaml", "yml", "xml", "json"])
def test_opencv_file_rectifies(tmp_path: Path, suffix: str) -> None:
    calibration = read_calibration([opencv_file(tmp_path / f"stereo.{suffix}")], SIZE)
    assert suffix.replace("yml", "yaml").upper() in (cli.commands["rig"].help or "")
    assert calibration.warnings == ()
    assert calibration.rig.baseline_m == pytest.approx(LENGTH_M)
    assert calibration.rig.doffs == 0
    assert_rectifies(calibration)


def test_fisheye_rectifies(tmp_path: Path) -> None:
    calibration = read_calibration([fisheye_file(tmp_path / "stereo.yaml")], SIZE)
    assert calibration.model == "fisheye, 4 distortion coefficients"
    assert_rectifies(calibration, fisheye=True)


@pytest.mark.parametrize(
    ("m1", "d1", "m2", "d2"),
    [
        ("K1", "D1", "K2", "D2"),
        ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
        ("left_camera_matrix", "left_dist_coeffs", "right_camera_matrix", "right_dist_coeffs"),
        ("camera_matrix_left", "dist_left", "camera_matrix_right", "dist_right"),
    ],
)
def test_usual_names(tmp_path: Path, m1: str, d1: str, m2: str, d2: str) -> None:
    renamed = {"M1": None, "D1": None, "M2": None, "D2": None, m1: K1, d1: D1, m2: K2, d2: D2}
    named = read_calibration([opencv_file(tmp_path / "named.yaml", **renamed)], SIZE)
    assert named.rig == read_calibration([opencv_file(tmp_path / "plain.yaml")], SIZE).rig


def test_every_format_says_the_same(tmp_path: Path) -> None:
    plain = read_calibration([opencv_file(tmp_path / "stereo.yaml")], SIZE)
    apart = [
        opencv_file(tmp_path / "intrinsics.yml", R=None, T=None),
        opencv_file(tmp_path / "extrinsics.yml", M1=None, D1=None, M2=None, D2=None),
    ]
    assert plain.maps is not None
    others = [apart, euroc_files(tmp_path), ros_files(tmp_path)]
    for paths in others:
        other = read_calibration(paths, SIZE)
        for name in ("focal_px", "baseline_m", "cx", "cy", "doffs"):
            wanted = getattr(plain.rig, name)
            assert getattr(other.rig, name) == pytest.approx(wanted, abs=1e-6), (paths, name)
        assert other.maps is not None
        np.testing.assert_allclose(other.maps, plain.maps, atol=1e-2)
    size_from_files = read_calibration(ros_files(tmp_path, block_lists=True))
    assert size_from_files.rig == read_calibration(ros_files(tmp_path)).rig


def test_projections_of_the_file_hold(tmp_path: Path) -> None:
    r1, r2, p1, p2, q, *_ = cv2.stereoRectify(
        K1, D1, K2, D2, SIZE, R, T.reshape(3, 1), flags=0, alpha=-1
    )
    given = {"R1": r1, "R2": r2, "P1": p1, "P2": p2, "Q": q}
    calibration = read_calibration([opencv_file(tmp_path / "stereo.yaml", **given)], SIZE)
    assert calibration.rig.focal_px == p1[0, 0]
    assert calibration.rig.doffs == p2[0, 2] - p1[0, 2] != 0
    assert_rectifies(calibration)
    # Without intrinsic matrices they describe images that are rectified, and so does Q alone.
    none = dict.fromkeys(["M1", "M2", "D1", "D2", "R", "T"])
    paths = [
        opencv_file(tmp_path / "p.yaml", **none, P1=p1, P2=p2),
        opencv_file(tmp_path / "q.yaml", **none, Q=q),
    ]
    for path in paths:
        rectified = read_calibration([path], SIZE)
        assert rectified.maps is None
        for name in ("focal_px", "baseline_m", "cx", "cy", "doffs"):
            wanted = getattr(calibration.rig, name)
            assert getattr(rectified.rig, name) == pytest.approx(wanted, abs=1e-6), (path, name)


KITTI = """P0: 718.856 0 607.1928 0 0 718.856 185.2157 0 0 0 1 0
P1: 718.856 0 607.1928 -386.1448 0 718.856 185.2157 0 0 0 1 0
P2: 718.856 0 607.1928 45.38225 0 718.856 185.2157 -0.1130887 0 0 1 0.003779761
P3: 718.856 0 607.1928 -337.2877 0 718.856 185.2157 2.369057 0 0 1 0.004915215
Tr: 1 0 0 0 0 1 0 0 0 0 1 0
"""


def test_kitti(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(KITTI)
    calibration = read_calibration([path], (1241, 376))
    assert calibration.rig == Rig(
        1241, 376, 718.856, pytest.approx(386.1448 / 718.856), 607.1928, 185.2157, 0.0
    )
    assert "four cameras" in calibration.warnings[0]
    colour = read_calibration([path], (1241, 376), pair=(2, 3))
    assert colour.rig.baseline_m == pytest.approx((45.38225 + 337.2877) / 718.856)
    assert colour.warnings == ()


def test_kitti_raw(tmp_path: Path) -> None:
    text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
    text += "S_02: 1392 512\nK_02: 9.6e+02 0 7e+02 0 9.6e+02 2.2e+02 0 0 1\n"
    for number, line in ((2, KITTI.splitlines()[2]), (3, KITTI.splitlines()[3])):
        text += f"S_rect_{number:02d}: 1.241000e+03 3.760000e+02\n"
        text += f"P_rect_{number:02d}: {line[4:]}\n"
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(text)
    rig = read_calibration([path]).rig
    assert (rig.width, rig.height) == (1241, 376)
    assert rig.baseline_m == pytest.approx((45.38225 + 337.2877) / 718.856)
    # P of images of twice the size, but for its focal length: what was measured counts.
    turn = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    for measured_m, baseline_m in ((0.266, 0.266), (0.53, 0.5323)):
        shift = turn @ [-measured_m, 0.0, 0.0]
        placed = f"R_02: {values(np.eye(3))}\nT_02: 0 0 0\nR_03: {values(turn)}\n"
        placed = f"{placed}T_03: {values(shift)}\n".replace(",", " ")
        path.write_text(text + placed)
        calibration = read_calibration([path])
        assert calibration.rig.baseline_m == pytest.approx(baseline_m, rel=1e-3)
        assert any("T is taken" in line for line in calibration.warnings) == (measured_m < 0.5)


def test_kitti_raw_rectifies_images_as_they_were_recorded(tmp_path: Path) -> None:
    """The same place is in one row of both rectified images."""
    size, matrix = (640, 480), np.array([[500.0, 0, 320], [0, 505, 236], [0, 0, 1]])
    bent, poses = np.array([-0.3, 0.1, 1e-3, -5e-4, 0]), []
    text = f"P_rect_02: {KITTI.splitlines()[2][4:]}\nP_rect_03: {KITTI.splitlines()[3][4:]}\n"
    for number, shift_m, axis in ((2, 0.06, (0.01, 0.02, 0)), (3, -0.48, (-0.02, 0.01, 0.01))):
        turn, shift = cv2.Rodrigues(np.array(axis))[0], np.array([shift_m, 0.004, -0.002])
        poses.append((turn, shift))
        text += f"S_{number:02d}: 640 480\nS_rect_{number:02d}: 600 400\n"
        for name, array in (("K", matrix), ("D", bent), ("R", turn), ("T", shift)):
            text += f"{name}_{number:02d}: {' '.join(map(str, np.ravel(array)))}\n"
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(text)
    calibration = read_calibration([path], size)
    rig, maps = calibration.rig, calibration.maps
    assert (rig.width, rig.height) == size
    places = [-turn.T @ shift for turn, shift in poses]
    assert rig.baseline_m == pytest.approx(np.linalg.norm(places[1] - places[0]))
    assert maps is not None
    for place in ((0.2, -0.3, 4.0), (-1.0, 0.5, 6.0)):
        found = []
        for (turn, shift), (x, y) in zip(poses, maps, strict=True):
            axis, _ = cv2.Rodrigues(turn)
            at, _ = cv2.projectPoints(np.array([place]), axis, shift, matrix, bent)
            off = np.hypot(x - at[0, 0, 0], y - at[0, 0, 1])
            found.append(np.unravel_index(off.argmin(), off.shape))
        (row, left), (other_row, right) = found
        assert abs(row - other_row) <= 1
        depth_m = rig.depth_m(np.float64(left - right))
        assert depth_m == pytest.approx(place[2], rel=0.05)
    assert read_calibration([path], (600, 400)).maps is None


MIDDLEBURY = """cam0=[3997.684 0 1176.728; 0 3997.684 1011.728; 0 0 1]
cam1=[3997.684 0 1307.839; 0 3997.684 1011.728; 0 0 1]
doffs=131.111
baseline=193.001
width=2964
height=1988
ndisp=280
"""


def test_middlebury(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(MIDDLEBURY)
    calibration = read_calibration([path])
    assert calibration.warnings == ()
    assert calibration.rig == Rig(
        2964, 1988, 3997.684, pytest.approx(0.193001), 1176.728, 1011.728, pytest.approx(131.111)
    )


def test_rig_file(tmp_path: Path) -> None:
    rig = Rig(640, 480, 500.0, 0.1, 320.0, 240.0, 3.0)
    write_rig(tmp_path / "rig.yaml", rig)
    calibration = read_calibration([tmp_path / "rig.yaml"], (640, 480))
    assert (calibration.rig, calibration.maps) == (rig, None)


# Units.


@pytest.mark.parametrize(
    ("factor", "unit", "warned"),
    [(1, None, False), (1000, None, True), (1000, "mm", False), (100, "cm", False)],
)
def test_unit_of_length(tmp_path: Path, factor: float, unit: str | None, *, warned: bool) -> None:
    path = opencv_file(tmp_path / "stereo.yaml", T=T * factor)
    calibration = read_calibration([path], SIZE, settings=RigSettings(baseline_unit=unit or "auto"))
    assert calibration.rig.baseline_m == pytest.approx(LENGTH_M)
    assert bool(calibration.warnings) == warned
    assert all("--baseline-unit" in line for line in calibration.warnings)


def test_middlebury_in_metres_is_guessed(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(MIDDLEBURY.replace("193.001", "0.193001"))
    calibration = read_calibration([path])
    assert calibration.rig.baseline_m == pytest.approx(0.193001)
    assert "taken to be in m:" in calibration.warnings[0]


def test_a_long_baseline_of_a_rig_file_is_kept_and_warned_about(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.yaml", Rig(640, 480, 500.0, 120.0, 320.0, 240.0))
    calibration = read_calibration([tmp_path / "rig.yaml"])
    assert calibration.rig.baseline_m == 120
    assert "--baseline-unit mm" in calibration.warnings[0]
    unit = read_calibration([tmp_path / "rig.yaml"], settings=RigSettings(baseline_unit="mm"))
    assert unit.rig.baseline_m == pytest.approx(0.12)


# Bad input: one line that names file and value.


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        *[({name: None}, f"{name}.* is missing") for name in ("M1", "M2", "D1", "D2", "R", "T")],
        ({"M1": np.zeros((3, 3))}, "M1 .* has focal lengths 0 and 0 px"),
        ({"M1": np.full((3, 3), np.nan)}, "M1 .* not finite"),
        ({"M2": np.eye(2)}, "M2 .* is not 3x3 numbers"),
        ({"M2": K2 * 4}, "last row of M2"),
        ({"M2": K2 @ np.diag([1, 1, 1]) + [[0, 0, 4000], [0] * 3, [0] * 3]}, "principal point"),
        ({"D1": np.zeros(7)}, "D1 .* is not 4 or 5 or 8 .* but 7"),
        ({"R": np.ones((3, 3))}, "R is not a rotation"),
        ({"R": -np.eye(3)}, "R is not a rotation"),
        ({"T": np.zeros(3)}, "T is zero"),
        ({"T": -T}, r"second camera stands left of the first .*R transposed and -R\^T T"),
        ({"T": T[::-1].copy()}, "do not stand side by side"),
        ({"T": "here"}, "T is not 3 numbers"),
        ({"image_width": 640.0, "image_height": 480.0}, "is for 640x480 but .* 320x240"),
        ({"R": np.asarray(cv2.Rodrigues(np.array([0.0, 1.5, 0.0]))[0])}, "would be left|not|do"),
    ],
)
def test_spoilt_value_is_named(tmp_path: Path, changes: dict, complaint: str) -> None:
    path = opencv_file(tmp_path / "stereo.yaml", **changes)
    with pytest.raises(InputError, match=complaint) as caught:
        read_calibration([path], SIZE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "is empty"),
        ("M1: [1, 2\nK: 3", "not a calibration file that can be read"),
        ("M1: !!python/object/apply:os.system ['exit']\n", "M1 .* is not 3x3 numbers"),
        ("<?xml version='1.0'?><opencv_storage><M1>", "not a calibration file"),
        ("people: [anna, bert]\n", r"no calibration of a form .*first names are people"),
        ("P0: 1 2 3\nP1: 4\n", "P0 is not 3x4 numbers"),
        (MIDDLEBURY.replace("doffs=131.111", "doffs=5"), "doffs is 5 but"),
        (MIDDLEBURY.replace("baseline", "base"), "baseline is missing"),
        (MIDDLEBURY.replace("193.001", "0"), "baseline is 0"),
        (MIDDLEBURY.replace("0 3997.684 1011", "0 399.7684 1011"), "focal lengths"),
    ],
)
def test_spoilt_file_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "calibration"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint) as caught:
        read_calibration([path], SIZE if "width" not in text else None)
    assert str(path) in str(caught.value)


def test_pairs_of_files(tmp_path: Path) -> None:
    left, right = ros_files(tmp_path)
    with pytest.raises(InputError, match="of one camera: give those of both"):
        read_calibration([left])
    with pytest.raises(InputError, match="give that file first"):
        read_calibration([right, left])
    right.write_text(right.read_text().replace("320", "640"))
    with pytest.raises(InputError, match="are of 320x240 and 640x240 px"):
        read_calibration([left, right])
    right.write_text(right.read_text().replace("projection_matrix", "pm"))
    with pytest.raises(InputError, match="projection_matrix is missing"):
        read_calibration([left, right])
    with pytest.raises(InputError, match=r"of 2 files at most: leave .*right\.yaml out"):
        read_calibration([left, left, right])
    with pytest.raises(InputError, match="4 calibration files are too many"):
        read_calibration([left, left, right, right])


def test_size_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give --size"):
        read_calibration([opencv_file(tmp_path / "stereo.yaml")])


# The command.


def test_rig_command_converts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = opencv_file(tmp_path / "stereo.yaml", T=T * 1000)
    out = tmp_path / "rig.yaml"
    assert main(["rig", str(path), "--size", "320x240", "-o", str(out)]) == 0
    said = capsys.readouterr()
    assert said.out == ""
    assert "rectification:   needed" in said.err
    assert "taken to be in mm" in said.err
    wanted = read_calibration([path], SIZE).rig
    assert read_rig(out) == wanted

    assert main(["rig", str(path), "--size", "320x240", "--baseline-unit", "mm"]) == 0
    said = capsys.readouterr()
    out.write_text(said.out)
    assert read_rig(out) == wanted
    assert "warning" not in said.err


def test_rig_command_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = opencv_file(tmp_path / "stereo.yaml", T=None)
    assert main(["rig", str(path), "--size", "320"]) == 2
    assert "--size cannot be '320'" in capsys.readouterr().err
    assert main(["rig", str(path), "--size", "320x240"]) == 1
    assert capsys.readouterr().err == f"error: {path}: T is missing: add it, or give another file\n"


@pytest.mark.parametrize(("focal", "warned"), [("3.6", True), ("300", False), ("9000", True)])
def test_a_focal_length_that_is_hardly_in_px_is_named(
    tmp_path: Path, focal: str, warned: bool
) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        f"width: 320\nheight: 240\nfocal_px: {focal}\nbaseline_m: 0.1\ncx: 160\ncy: 120\n"
    )
    said = " ".join(read_calibration([path]).warnings)
    assert ("degrees: see that it is in px" in said) == warned


def test_a_principal_point_outside_the_images_is_named(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(KITTI)
    said = " ".join(read_calibration([path], (320, 240)).warnings)
    assert "principal point 607, 185 lies outside the images of 320x240 px" in said
