"""The rig of test_calibration.py in the formats of other programs, and what files must not do."""

from __future__ import annotations

import json
import math
import pickle
import re
import sys
import zipfile
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from test_calibration import (
    BASELINE_M,
    D1,
    D2,
    F1,
    F2,
    K1,
    K2,
    KITTI,
    LENGTH_M,
    MIDDLEBURY,
    POINTS_M,
    SIZE,
    R,
    T,
    euroc_files,
    matrix,
    opencv_file,
    ros_files,
    values,
)

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError
from motionstereo_cli.rig import format_rig, read_rig
from motionstereo_cli.rig.calibration import Calibration, read_calibration
from motionstereo_cli.rig.cameras import Camera, Pair
from motionstereo_cli.rig.formats import FORMATS, read_files
from motionstereo_cli.rig.turned import turned
from motionstereo_cli.sources.settings import InputSettings, adapted_rig

RIGHT_FROM_LEFT = np.vstack([np.column_stack([R, T]), [0, 0, 0, 1]])
RVEC = cv2.Rodrigues(R)[0].ravel()


def row(array: np.ndarray) -> str:
    return f"[{values(array)}]"


def block(array: np.ndarray) -> str:
    """A matrix as PyYAML and kalibr write it, a row a line."""
    return "".join(f"\n  - {row(line)}" for line in array)


def focal_and_centre(k: np.ndarray) -> np.ndarray:
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])


def kalibr(folder: Path, *, imu: bool = False) -> Path:
    text = ""
    for number, (k, d) in enumerate(((K1, D1[:4]), (K2, D2[:4]))):
        text += f"cam{number}:\n  camera_model: pinhole\n  cam_overlaps: [{1 - number}]\n"
        text += f"  intrinsics: {row(focal_and_centre(k))}\n  resolution: [320, 240]\n"
        text += f"  distortion_model: radtan\n  distortion_coeffs: {row(d)}\n"
        if imu:
            text += f"  T_cam_imu:{block(RIGHT_FROM_LEFT if number else np.eye(4))}\n"
        elif number:
            text += f"  T_cn_cnm1:{block(RIGHT_FROM_LEFT)}\n"
        text += f"  rostopic: /cam{number}/image_raw\n"
    path = folder / "camchain.yaml"
    path.write_text(text)
    return path


def orb_slam_3(folder: Path) -> Path:
    text = '%YAML:1.0\n\nFile.version: "1.0"\n\nCamera.type: "PinHole"\n'
    for number, (k, d) in enumerate(((K1, D1), (K2, D2)), 1):
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        numbers = [*focal_and_centre(k), *d]
        for name, value in zip(names, numbers, strict=True):
            text += f"Camera{number}.{name}: {float(value)!r}\n"
    text += matrix("Stereo.T_c1_c2", np.linalg.inv(RIGHT_FROM_LEFT), " !!opencv-matrix")
    text += "Camera.width: 320\nCamera.height: 240\nCamera.fps: 20\nStereo.ThDepth: 60.0\n"
    path = folder / "orb.yaml"
    path.write_text(text)
    return path


def orb_slam_2(folder: Path) -> Path:
    left, right = ros_files(folder)
    text = "%YAML:1.0\nCamera.fx: 1.0\nCamera.fy: 1.0\nCamera.cx: 1.0\nCamera.cy: 1.0\n"
    text += "Camera.bf: 47.9\n"
    names = {
        "camera_matrix": "K",
        "distortion_coefficients": "D",
        "rectification_matrix": "R",
        "projection_matrix": "P",
    }
    for side, file in (("LEFT", left), ("RIGHT", right)):
        kept = file.read_text()
        body = kept[kept.index("camera_matrix") :].replace("distortion_model: plumb_bob\n", "")
        for name, short in names.items():
            body = body.replace(f"{name}:", f"{side}.{short}: !!opencv-matrix")
        text += f"{side}.height: 240\n{side}.width: 320\n{body}"
    path = folder / "orb2.yaml"
    path.write_text(text)
    return path


def depthai(folder: Path, size: tuple[int, int] = SIZE) -> Path:
    def camera(k: np.ndarray, d: np.ndarray, extrinsics: dict[str, Any]) -> dict[str, Any]:
        return {
            "cameraType": 0,
            "distortionCoeff": [*d, *[0.0] * (14 - len(d))],
            "extrinsics": extrinsics,
            "height": size[1],
            "width": size[0],
            "intrinsicMatrix": k.tolist(),
            "lensPosition": 0,
        }

    def to(socket: int, rotation: np.ndarray, translation: np.ndarray) -> dict[str, Any]:
        return {
            "rotationMatrix": rotation.tolist(),
            "specTranslation": {"x": 0.0, "y": 0.0, "z": 0.0},
            "toCameraSocket": socket,
            "translation": dict(zip("xyz", (100 * translation).tolist(), strict=True)),
        }

    nothing = to(-1, np.zeros((3, 3)), np.zeros(3))
    content = {
        "boardName": "OAK",
        "cameraData": [
            [0, camera(K1, D1, nothing)],
            [1, camera(K1, D1, to(2, R, T))],
            [2, camera(K2, D2, to(0, np.eye(3), np.array([0.03, 0, 0])))],
        ],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2},
        "version": 7,
    }
    path = folder / "depthai.json"
    path.write_text(json.dumps(content, indent=4))
    return path


def zed(folder: Path) -> Path:
    """The rig with a T straight along x, as nearly all have it, and twice the size as HD."""
    text = ""
    for name, scale in (("HD", 4.0), ("VGA", 2.1)):
        for side, k, d in (("LEFT", K1, D1), ("RIGHT", K2, D2)):
            text += f"[{side}_CAM_{name}]\n"
            numbers = [*(scale * focal_and_centre(k)), *d]
            names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
            for key, value in zip(names, numbers, strict=True):
                text += f"{key}={float(value)!r}\n"
            text += "\n"
    text += "[STEREO]\n"
    for name, length in zip(("Baseline", "TY", "TZ"), -1000 * T, strict=True):
        text += f"{name}={float(length)!r}\n"
    for axis, turn in zip(("RX", "CV", "RZ"), RVEC, strict=True):
        text += f"{axis}_HD={float(turn)!r}\n{axis}_VGA={float(turn)!r}\n"
    path = folder / "SN1234.conf"
    path.write_text(text)
    return path


def nested_json(folder: Path) -> Path:
    def camera(k: np.ndarray, d: np.ndarray) -> dict[str, Any]:
        return {"camera_matrix": k.tolist(), "dist_coeffs": d.tolist()}

    content = {
        "image_size": list(SIZE),
        "left": camera(K1, D1),
        "right": camera(K2, D2),
        "stereo": {"R": R.tolist(), "T": T[:, None].tolist()},
        "comment": None,
        "ok": True,
    }
    path = folder / "stereo.json"
    path.write_text(json.dumps(content))
    return path


def nested_parts(folder: Path) -> Path:
    """Cameras by their parts, each with its own pose from the world."""
    turned = np.asarray(cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0])
    moved = np.array([0.5, 0.1, -2.0])
    cameras = {}
    for name, k, d, r, t in (
        ("camera_left", K1, D1, turned, moved),
        ("camera_right", K2, D2, R @ turned, R @ moved + T),
    ):
        parts = dict(zip(("fx", "fy", "cx", "cy"), focal_and_centre(k).tolist(), strict=True))
        lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), d.tolist(), strict=True))
        cameras[name] = {"intrinsics": parts, "distortion": lens, "R": r.tolist(), "t": t.tolist()}
    path = folder / "parts.json"
    path.write_text(json.dumps({"cameras": cameras}))
    return path


def npz(folder: Path) -> Path:
    path = folder / "stereo.npz"
    arrays = {"mtxL": K1, "distL": D1[None], "mtxR": K2, "distR": D2[None], "R": R, "T": T[:, None]}
    np.savez(path, **arrays, img_size=np.array(SIZE), who=np.array({"a": 1}, dtype=object))
    return path


@pytest.mark.parametrize(
    "written", [orb_slam_3, orb_slam_2, depthai, nested_json, nested_parts, npz, kalibr]
)
def test_formats_of_other_programs_say_the_same(
    tmp_path: Path, written: Callable[[Path], Path]
) -> None:
    d = {"D1": D1[:4], "D2": D2[:4]} if written is kalibr else {}
    plain = read_calibration([opencv_file(tmp_path / "plain.yaml", **d)], SIZE)
    other = read_calibration([written(tmp_path)], SIZE)
    for name in ("focal_px", "baseline_m", "cx", "cy", "doffs"):
        wanted = getattr(plain.rig, name)
        assert getattr(other.rig, name) == pytest.approx(wanted, abs=1e-6), name
    assert plain.maps is not None
    np.testing.assert_allclose(other.maps, plain.maps, atol=1e-2)
    assert other.warnings == ()


def test_kalibr_with_an_imu(tmp_path: Path) -> None:
    plain = read_calibration([kalibr(tmp_path)])
    with_imu = read_files([kalibr(tmp_path, imu=True)])
    assert read_calibration([tmp_path / "camchain.yaml"]).rig.baseline_m == pytest.approx(
        plain.rig.baseline_m
    )
    np.testing.assert_allclose(with_imu.body_from_left, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(("factor", "agrees"), [(1, True), (1.05, True), (2, False), (-1, False)])
def test_kalibr_that_contradicts_itself_is_refused(
    tmp_path: Path, factor: float, agrees: bool
) -> None:
    path = kalibr(tmp_path, imu=True)
    stated = RIGHT_FROM_LEFT.copy()
    stated[:3, 3] *= factor
    path.write_text(path.read_text() + f"  T_cn_cnm1:{block(stated)}\n")
    if agrees:
        assert read_calibration([path]).rig.baseline_m > 0
        return
    with pytest.raises(InputError, match="contradicts itself: T_cn_cnm1 places the cameras"):
        read_calibration([path])


def test_zed_by_size(tmp_path: Path) -> None:
    path = zed(tmp_path)
    calibration = read_calibration([path], (1280, 720))
    assert calibration.rig.baseline_m == pytest.approx(LENGTH_M)
    k1, k2 = K1 * 4, K2 * 4
    k1[2] = k2[2] = [0, 0, 1]
    same = opencv_file(tmp_path / "same.yaml", M1=k1, M2=k2)
    plain = read_calibration([same], (1280, 720))
    np.testing.assert_allclose(calibration.maps, plain.maps, atol=1e-2)
    with pytest.raises(InputError, match="for each of 1280x720, 672x376: give --size"):
        read_calibration([path])
    with pytest.raises(InputError, match="not for 640x480"):
        read_calibration([path], (640, 480))
    text = path.read_text()
    path.write_text(re.sub(r"(?s)\[\w+_CAM_VGA\].*?(?=\[|$)", "", text))
    assert read_calibration([path]).rig == calibration.rig


def test_depthai_at_another_size_is_scaled(tmp_path: Path) -> None:
    full = read_calibration([depthai(tmp_path)]).rig
    half = read_calibration([depthai(tmp_path)], (160, 120))
    assert half.rig.baseline_m == pytest.approx(full.baseline_m)
    assert half.rig.focal_px == pytest.approx(full.focal_px / 2, rel=0.02)
    assert "scaled to 160x120" in half.warnings[0]


def test_orb_slam_of_rectified_images(tmp_path: Path) -> None:
    path = tmp_path / "kitti.yaml"
    path.write_text(
        "%YAML:1.0\nCamera.fx: 718.856\nCamera.fy: 718.856\nCamera.cx: 607.1928\n"
        "Camera.cy: 185.2157\nCamera.k1: 0.0\nCamera.k2: 0.0\nCamera.p1: 0.0\nCamera.p2: 0.0\n"
        "Camera.width: 1241\nCamera.height: 376\nCamera.bf: 386.1448\nThDepth: 35\n"
    )
    calibration = read_calibration([path])
    assert calibration.maps is None
    assert calibration.rig.baseline_m == pytest.approx(386.1448 / 718.856)


def test_a_baseline_alone_stands_for_parallel_cameras(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    cameras = {s: {"K": K1.tolist(), "D": []} for s in ("left", "right")}
    path.write_text(json.dumps({**cameras, "baseline": 0.12}))
    calibration = read_calibration([path], SIZE)
    assert calibration.rig.baseline_m == pytest.approx(0.12)
    assert "parallel" in calibration.warnings[0]


# Lens models.


def fisheye(path: Path, **more: str | float | None) -> Path:
    return opencv_file(path, D1=F1[:, None], D2=F2[:, None], **more)


@pytest.mark.parametrize(
    "label",
    [
        *("equi", "equidistant", "kb4", "KannalaBrandt8", "kannala_brandt4", "OPENCV_FISHEYE"),
        *("Fisheye", "pinhole-equi"),
    ],
)
def test_names_of_the_fisheye_model(tmp_path: Path, label: str) -> None:
    wanted = read_calibration([fisheye(tmp_path / "w.yml", distortion_model="fisheye")], SIZE)
    assert wanted.model.startswith("fisheye")
    for key in ("distortion_model", "camera_model"):
        found = read_calibration([fisheye(tmp_path / "f.yml", **{key: label})], SIZE)
        assert (found.rig, found.model, found.warnings) == (wanted.rig, wanted.model, ())
    flagged = read_calibration([fisheye(tmp_path / "f.yml", fisheye_model=1)], SIZE)
    assert flagged.rig == wanted.rig


@pytest.mark.parametrize("label", ["ucm", "inverse_brown_conrady", "thin_prism_fisheye", "secret"])
def test_unknown_lens_models_are_refused_by_name(tmp_path: Path, label: str) -> None:
    with pytest.raises(InputError, match=f"lens model '{label}' is not known"):
        read_calibration([fisheye(tmp_path / "f.yml", distortion_model=label)], SIZE)
    left, right = euroc_files(tmp_path)
    for path in (left, right):
        path.write_text(path.read_text().replace("radial-tangential", label))
    with pytest.raises(InputError, match=f"lens model '{label}' is not known"):
        read_calibration([left, right])


def test_coefficients_that_do_not_fit_their_model(tmp_path: Path) -> None:
    column = read_calibration([fisheye(tmp_path / "f.yml")], SIZE)
    assert "four coefficients in a column" in column.warnings[0]
    assert "distortion_model: fisheye" in column.warnings[0]
    row_of_four = opencv_file(tmp_path / "r.yml", D1=D1[None, :4], D2=D2[None, :4])
    assert read_calibration([row_of_four], SIZE).warnings == ()
    rational = fisheye(tmp_path / "r.yml", distortion_model="rational_polynomial")
    assert "has 4 coefficients where" in read_calibration([rational], SIZE).warnings[0]
    with pytest.raises(InputError, match="'none' has no distortion, but"):
        read_calibration([fisheye(tmp_path / "n.yml", distortion_model="none")], SIZE)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_missing_coefficients_are_zeros(tmp_path: Path, count: int) -> None:
    given = {"left": K1, "right": K2}
    content: dict[str, Any] = {"R": R.tolist(), "T": T.tolist()}
    for side, k in given.items():
        content[side] = {"K": k.tolist(), "D": D1[:count].tolist()}
    path = tmp_path / "few.json"
    path.write_text(json.dumps(content))
    padded = np.append(D1[:count], np.zeros(4 - count))
    plain = opencv_file(tmp_path / "plain.yml", D1=padded, D2=padded)
    assert read_calibration([path], SIZE).rig == read_calibration([plain], SIZE).rig


def test_fisheye_in_euroc_files(tmp_path: Path) -> None:
    """T_BS gives T as a column of a larger matrix, which cv2.fisheye does not take."""
    paths = euroc_files(tmp_path)
    for path, d, f in zip(paths, (D1, D2), (F1, F2), strict=True):
        text = path.read_text().replace(values(d), values(f))
        path.write_text(text.replace("radial-tangential", "equidistant"))
    other = read_calibration(paths)
    plain = read_calibration([fisheye(tmp_path / "p.yml", distortion_model="fisheye")], SIZE)
    assert other.rig.focal_px == pytest.approx(plain.rig.focal_px)
    assert other.rig.baseline_m == pytest.approx(plain.rig.baseline_m)


# What the numbers say of themselves.


def spoilt(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def test_sign_of_the_right_projection(tmp_path: Path) -> None:
    left, right = ros_files(tmp_path)
    wanted = read_calibration([left, right])
    tx = cv2.stereoRectify(K1, D1, K2, D2, SIZE, R, T[:, None], flags=1024, alpha=0)[3][0, 3]
    spoilt(right, repr(float(tx)), repr(-float(tx)))
    found = read_calibration([left, right])
    assert found.rig == wanted.rig
    assert "its sign is taken to be the other way round" in found.warnings[0]
    with pytest.raises(InputError, match="give that file first"):
        read_calibration([right, left])
    kitti = tmp_path / "calib.txt"
    kitti.write_text(KITTI.replace("-386.1448", "386.1448"))
    reversed_sign = read_calibration([kitti], (1241, 376))
    assert reversed_sign.rig.baseline_m == pytest.approx(386.1448 / 718.856)
    assert any("other way round" in line for line in reversed_sign.warnings)


@pytest.mark.parametrize(
    ("translation", "complaint"),
    [
        ([0.001, -0.12, 0.0], "one above the other: turn both views, with --rotate-left 270"),
        ([0.0, 0.02, 0.12], "one behind the other"),
    ],
)
def test_cameras_that_do_not_stand_side_by_side(
    tmp_path: Path, translation: list[float], complaint: str
) -> None:
    path = opencv_file(tmp_path / "c.yml", R=np.eye(3), T=np.array(translation))
    with pytest.raises(InputError, match=complaint):
        read_calibration([path], SIZE)


def test_projections_of_cameras_above_each_other(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    p1 = "718.856 0 607.1928 0 0 718.856 185.2157 -386.1448 0 0 1 0"
    path.write_text(f"{KITTI.splitlines()[0]}\nP1: {p1}\n")
    with pytest.raises(InputError, match="one above the other"):
        read_calibration([path], (1241, 376))


@pytest.mark.parametrize("degrees", [90, 270])
@pytest.mark.parametrize("fisheye_lens", [False, True])
def test_a_turned_camera_sees_the_turned_image(degrees: int, fisheye_lens: bool) -> None:
    coefficients = F1 if fisheye_lens else np.array([*D1, 0.01, 0.02, 0.003, *D2[:4] / 10])
    camera = Camera(K1, coefficients, "fisheye" if fisheye_lens else "pinhole")
    pair = turned("x", Pair("x", (camera, camera)), SIZE, degrees)
    assert pair.cameras is not None
    project = cv2.fisheye.projectPoints if fisheye_lens else cv2.projectPoints
    axis = np.array([0, 0, math.radians(degrees)])

    def seen(one: Camera, turn: np.ndarray) -> np.ndarray:
        found = project(POINTS_M[:, None], turn, np.zeros(3), one.matrix, one.distortion)
        return np.asarray(found[0]).reshape(-1, 2)

    x, y = seen(camera, np.zeros(3)).T
    wanted = (SIZE[1] - 1 - y, x) if degrees == 90 else (y, SIZE[0] - 1 - x)
    np.testing.assert_allclose(seen(pair.cameras[0], axis).T, wanted, atol=1e-6)


@pytest.mark.parametrize("kind", ["opencv", "fisheye", "projections"])
def test_cameras_one_above_the_other_are_turned(tmp_path: Path, kind: str) -> None:
    """The upper camera is the first, so it is the left one where the top goes to the left."""
    below_m = np.array([0.001, -0.12, 0.002])
    if kind == "projections":
        path = tmp_path / "calib.txt"
        p1 = "718.856 0 607.1928 0 0 718.856 185.2157 -86.26272 0 0 1 0"
        path.write_text(f"{KITTI.splitlines()[0]}\nP1: {p1}\n")
        size = 1241, 376
    else:
        model = {"D1": F1, "D2": F2, "distortion_model": "fisheye"} if kind == "fisheye" else {}
        path = opencv_file(tmp_path / "c.yml", R=np.eye(3), T=below_m, **model)
        size = SIZE
    upright = size[1], size[0]
    found = read_calibration([path], upright, turned_deg=270)
    assert (found.rig.width, found.rig.height) == upright
    assert found.rig.baseline_m == pytest.approx(0.12, abs=1e-4)
    # Turned to the other side, the lower camera would be the left one.
    if kind == "projections":
        other = read_calibration([path], upright, turned_deg=90)
        assert any("the other way round" in line for line in other.warnings)
    else:
        with pytest.raises(InputError, match="stands left of the first"):
            read_calibration([path], upright, turned_deg=90)
    with pytest.raises(InputError):
        read_calibration([path], size)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_calibration_for_another_size_is_told_by_its_centre(tmp_path: Path, factor: float) -> None:
    path = opencv_file(tmp_path / "c.yml")
    size = round(SIZE[0] * factor), round(SIZE[1] * factor)
    with pytest.raises(InputError, match=r"that of images of about 32\dx24\d px"):
        read_calibration([path], size)
    kitti = tmp_path / "calib.txt"
    kitti.write_text(KITTI)
    with pytest.raises(InputError, match=r"that of images of about 1215x371 px"):
        read_calibration([kitti], (round(1241 * factor), round(376 * factor)))
    stated = {"image_width": float(size[0]), "image_height": float(size[1])}
    if factor > 1:  # cut from the middle of nothing, but its own file says so
        assert read_calibration([opencv_file(tmp_path / "s.yml", **stated)], size)


# Pixels that are not square.


def test_focal_lengths_that_differ(tmp_path: Path) -> None:
    p0 = "718.856 0 607.1928 0 0 790.7416 185.2157 0 0 0 1 0"
    p1 = "718.856 0 607.1928 -386.1448 0 790.7416 185.2157 0 0 0 1 0"
    path = tmp_path / "calib.txt"
    path.write_text(f"P0: {p0}\nP1: {p1}\n")
    rig = read_calibration([path], (1241, 376)).rig
    assert (rig.focal_px, rig.focal_y_px, rig.fy_px) == (718.856, 790.7416, 790.7416)
    (tmp_path / "rig.yaml").write_text(format_rig(rig))
    assert read_rig(tmp_path / "rig.yaml") == rig
    half = adapted_rig(rig, InputSettings(scale=0.5))
    assert half.focal_y_px == pytest.approx(790.7416 / 2)
    path.write_text(
        f"P0: {p0}\nP1: {p1}\n".replace(
            "790.7416 185.2157 0 0 0 1 0\nP1", "700 185.2157 0 0 0 1 0\nP1"
        )
    )
    with pytest.raises(InputError, match="differ in focal length"):
        read_calibration([path], (1241, 376))


def test_square_pixels_leave_rig_files_as_they_were(tmp_path: Path) -> None:
    rig = read_calibration([ros_files(tmp_path)[0], tmp_path / "right.yaml"]).rig
    assert rig.focal_y_px is None
    assert "focal_y_px" not in format_rig(rig)


# Hostile files: one clear line, and nothing else is opened.


def deep(kind: str, depth: int) -> str:
    return {
        "json": '{"M1": ' + "[" * depth + "]" * depth + "}",
        "yaml": "%YAML:1.0\n---\nM1: " + "[" * depth + "]" * depth,
        "yaml maps": "".join("  " * n + f"k{n}:\n" for n in range(min(depth, 2000))) + "- [1]",
        "yaml lists": "M1:\n  " + "- " * depth + "1",
        "xml": "<?xml version='1.0'?><opencv_storage>" + "<a>" * depth + "</a>" * depth,
        "yaml mappings": "M1: " + "{a: " * depth + "}" * depth,
    }[kind]


@pytest.mark.parametrize("depth", [200, 60_000])
@pytest.mark.parametrize(
    "kind", ["json", "yaml", "yaml maps", "yaml lists", "xml", "yaml mappings"]
)
def test_deep_files_end_in_a_line(tmp_path: Path, kind: str, depth: int) -> None:
    path = tmp_path / "deep"
    path.write_text(deep(kind, depth))
    with pytest.raises(InputError) as caught:
        read_calibration([path], SIZE)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "text",
    [
        "%YAML:1.0\n---\n" + "".join(f"k{i}: [ 1 ]\n" for i in range(110_000)),
        '{"a": [' + "1," * 400_000 + "1]}",
        "<opencv_storage><a>" + "1 " * 400_000 + "</a></opencv_storage>",
    ],
    ids=["yaml", "json", "xml"],
)
def test_files_with_too_many_values_end_in_a_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "many"
    path.write_text(text)
    with pytest.raises(InputError, match="more than 300,000 values"):
        read_calibration([path], SIZE)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: &x [1, 2]\nM1: *x\n", "reference .x is not followed"),
        (
            '<!DOCTYPE a [<!ENTITY x SYSTEM "/etc/hostname">]><opencv_storage><M1>&x;</M1>'
            "</opencv_storage>",
            "entities",
        ),
        ("K1: [1, 2]\nK1: [1, 3]\n", "K1 is given twice"),
        ('{"M1": [1], "M1": [2]}', "M1 is given twice"),
        ("M1: !!python/object/apply:os.system ['touch pwned']\n", "M1 .* is not"),
    ],
)
def test_what_files_may_not_do(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "hostile"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_calibration([path], SIZE)


def test_files_of_other_programs_are_named(tmp_path: Path) -> None:
    path = tmp_path / "calibration"
    for content, complaint in (
        (pickle.dumps({"K1": K1}), "a Python pickle, which could run programs"),
        (b"\x93NUMPY\1\0", "one array"),
        (b"MATLAB 5.0 MAT-file", "a MATLAB file"),
        (b"PK\3\4 cut off", "cannot be read as .npz"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=complaint):
            read_calibration([path], SIZE)


def test_npz_with_objects_or_too_large_arrays(tmp_path: Path) -> None:
    path = tmp_path / "stereo.npz"
    np.savez(path, M1=np.array([{"a": 1}], dtype=object), R=R)
    with pytest.raises(InputError, match=r"M1 .* is missing"):
        read_calibration([path], SIZE)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("M1.npy", bytes(50_000_000))
    with pytest.raises(InputError, match="no arrays of numbers"):
        read_calibration([path], SIZE)


@pytest.fixture(scope="module")
def opened() -> Any:
    """What Python opens, starts or connects to while a list is there to take it."""
    seen: list[Any] = []
    taking: list[bool] = []
    wanted = ("open", "os.system", "subprocess.Popen", "socket.connect", "os.posix_spawn")

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if taking and event in wanted and not isinstance(given[0], int):
            seen.append((event, str(given[0])))

    sys.addaudithook(hook)
    return seen, taking


def test_no_reader_opens_another_file(tmp_path: Path, opened: Any) -> None:
    seen, taking = opened
    one_file = [kalibr, orb_slam_3, depthai, zed, nested_json, npz]
    groups = [[write(tmp_path)] for write in one_file] + [euroc_files(tmp_path)]
    kitti, middlebury = tmp_path / "k.txt", tmp_path / "m.txt"
    kitti.write_text(KITTI)
    middlebury.write_text(MIDDLEBURY)
    groups += [[kitti], [middlebury], [opencv_file(tmp_path / "o.xml")]]
    read = [read_files(group, (1280, 720)) for group in groups]
    kinds = {each.kind for each in read}
    assert len(kinds) == 8, kinds
    assert len(FORMATS) == 21  # those of test_calibration_slam.py as well: add yours there
    for group in groups:
        seen.clear()
        taking.append(True)
        read_files(group, (1280, 720))
        taking.clear()
        assert {what for _, what in seen} <= {str(path) for path in group}


def test_rig_command_takes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rig", str(kalibr(tmp_path))]) == 0
    said = capsys.readouterr()
    assert "kalibr camchain" in said.err
    assert "baseline_m: 0.12" in said.out
    assert isinstance(read_calibration([npz(tmp_path)]), Calibration)
    assert abs(BASELINE_M - LENGTH_M) < 1e-3


def test_the_documentation_has_every_format() -> None:
    page = resources.files("motionstereo_cli") / "docs/calibration.md"
    rows = [line.lower() for line in page.read_text().splitlines() if line.startswith("|")]
    for known in FORMATS:
        words = re.findall(r"[\w.-]+", known.name.lower())
        assert any(all(word in row for word in words) for row in rows), known.name
