"""Lens models against the inverse that their papers give, and wide pairs rectified."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.rig.calibration import Calibration, read_calibration
from motionstereo_cli.rig.cameras import Camera, intrinsic_matrix
from motionstereo_cli.rig.lenses import maps_of, middle_focal_px, project, widest_rad
from motionstereo_cli.rig.settings import RigSettings

WIDTH, HEIGHT = SIZE = (240, 200)
BASELINE_M, DEPTH_M = 0.08, 0.6


# Directions of pixels at focal length 1, as the papers of the models have them.


def of_fisheye(x: np.ndarray, y: np.ndarray, k: np.ndarray) -> np.ndarray:
    radius = np.hypot(x, y)
    theta = radius.copy()
    for _ in range(60):  # Newton on theta + k1 theta^3 + ... = radius
        powers = [theta ** (2 * n) for n in range(5)]
        value = theta * sum(c * p for c, p in zip([1, *k], powers, strict=True))
        slope = sum(
            (2 * n + 1) * c * p for n, (c, p) in enumerate(zip([1, *k], powers, strict=True))
        )
        theta = theta - (value - radius) / slope
    scale = np.divide(np.sin(theta), radius, out=np.ones_like(radius), where=radius > 0)
    return np.stack([x * scale, y * scale, np.cos(theta)], axis=-1)


def of_omni(x: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    xi, square = p[0], x**2 + y**2  # no distortion
    scale = (xi + np.sqrt(1 + (1 - xi**2) * square)) / (1 + square)
    return np.stack([scale * x, scale * y, scale - xi], axis=-1)


def of_ds(x: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    (xi, alpha), square = p, x**2 + y**2
    z = (1 - alpha**2 * square) / (alpha * np.sqrt(1 - (2 * alpha - 1) * square) + 1 - alpha)
    scale = (z * xi + np.sqrt(z**2 + (1 - xi**2) * square)) / (z**2 + square)
    return np.stack([scale * x, scale * y, scale * z - xi], axis=-1)


def of_eucm(x: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    (alpha, beta), square = p, x**2 + y**2
    root = np.sqrt(1 - (2 * alpha - 1) * beta * square)
    return np.stack([x, y, (1 - beta * alpha**2 * square) / (alpha * root + 1 - alpha)], axis=-1)


def of_fov(x: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    radius = np.hypot(x, y)
    undone = np.sin(radius * p[0]) / (2 * math.tan(p[0] / 2))
    scale = np.divide(undone, radius, out=np.ones_like(radius), where=radius > 0)
    return np.stack([x * scale, y * scale, np.cos(radius * p[0])], axis=-1)


#: Parameters that lenses of these models have, and the inverse.
MODELS: dict[str, tuple[list[float], Callable[..., np.ndarray]]] = {
    "fisheye": ([-0.01, 0.02, -0.012, 0.002], of_fisheye),
    "omni": ([1.4, 0, 0, 0, 0], of_omni),
    "ds": ([-0.2, 0.59], of_ds),
    "eucm": ([0.63, 1.05], of_eucm),
    "fov": ([0.95], of_fov),
}


def seen_at(camera: Camera, points: np.ndarray) -> np.ndarray:
    return np.column_stack(project(camera, *points.T))


def lens(model: str, view_deg: float, centre: tuple[float, float]) -> Camera:
    """A camera whose lens sees an angle over the width of the image."""
    camera = Camera(intrinsic_matrix(1, 1, 0, 0), np.array(MODELS[model][0]), model)
    half = math.radians(view_deg / 2)
    edge = seen_at(camera, np.array([[math.sin(half), 0, math.cos(half)]]))[0, 0]
    focal_px = WIDTH / 2 / edge
    return Camera(intrinsic_matrix(focal_px, focal_px, *centre), camera.distortion, model)


def directions(camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    k = camera.matrix
    flat = (x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1]
    with np.errstate(all="ignore"):
        return MODELS[camera.model][1](*flat, camera.distortion)


@pytest.mark.parametrize("model", MODELS)
@given(x=st.floats(0, WIDTH - 1), y=st.floats(0, HEIGHT - 1))
def test_a_lens_and_its_inverse(model: str, x: float, y: float) -> None:
    camera = lens(model, 170, (118.0, 101.0))
    there = directions(camera, np.array([x]), np.array([y]))
    if np.isfinite(there).all() and there[0, 2] > math.cos(math.radians(84)):
        np.testing.assert_allclose(seen_at(camera, there), [[x, y]], atol=1e-6)


def test_fisheye_is_that_of_opencv() -> None:
    camera = lens("fisheye", 170, (118.0, 101.0))
    points = np.random.default_rng(1).normal([0, 0, 2.5], size=(50, 3))
    zero = np.zeros(3)
    wanted = cv2.fisheye.projectPoints(
        points[:, None], zero, zero, camera.matrix, camera.distortion
    )
    np.testing.assert_allclose(seen_at(camera, points), wanted[0].reshape(-1, 2), atol=1e-6)


def test_distortion_of_the_mirror_is_that_of_the_pinhole() -> None:
    """With xi = 0, Mei's model is OpenCV's pinhole."""
    coefficients = np.array([-0.2, 0.05, 0.001, -0.002])
    flat = Camera(intrinsic_matrix(200, 210, 118, 101), coefficients)
    mirror = Camera(flat.matrix, np.append(0.0, coefficients), "omni")
    points = np.random.default_rng(1).uniform([-1, -1, 1.5], [1, 1, 3.5], (50, 3))
    np.testing.assert_allclose(seen_at(mirror, points), seen_at(flat, points), atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_the_middle_of_a_lens(model: str) -> None:
    camera = lens(model, 170, (118.0, 101.0))
    x, y = np.array([118.0, 119.0]), np.array([101.0, 101.0])
    middle, beside = directions(camera, x, y)
    angle = math.atan2(beside[0], beside[2]) - math.atan2(middle[0], middle[2])
    assert middle_focal_px(camera) == pytest.approx(1 / angle, rel=1e-3)


def test_a_polynomial_that_turns_back_is_not_followed() -> None:
    """Beyond 1 / sqrt(0.6) rad, theta - 0.2 theta^3 falls and would show the middle again."""
    camera = Camera(intrinsic_matrix(60, 60, 120, 100), np.array([-0.2, 0, 0, 0]), "fisheye")
    assert widest_rad(camera) == pytest.approx(1 / math.sqrt(0.6), abs=0.003)
    view = np.column_stack([intrinsic_matrix(30, 30, 119.5, 99.5), np.zeros(3)])
    x, _ = maps_of(camera, np.eye(3), view, SIZE)
    angles = np.arctan(np.hypot(np.arange(WIDTH) - 119.5, 0.5) / 30)
    within, beyond = angles < 1 / math.sqrt(0.6) - 0.01, angles > 1 / math.sqrt(0.6) + 0.01
    assert beyond.any()
    assert (x[99, beyond] == -1).all()
    assert (np.diff(x[99, within]) > 0).all()


# Wide pairs.


def camchain(folder: Path, cameras: tuple[Camera, Camera], half: np.ndarray) -> Path:
    """A pair as kalibr writes it: half of the turn between the cameras leads to rectified ones."""
    text = ""
    right_from_left = np.eye(4)
    right_from_left[:3, :3] = half @ half
    right_from_left[:3, 3] = half @ [-BASELINE_M, 0, 0]
    for number, camera in enumerate(cameras):
        k, p = camera.matrix, camera.distortion
        pinhole = camera.model in ("fisheye", "fov")
        count = {"omni": 1, "ds": 2, "eucm": 2}.get(camera.model, 0)
        intrinsics = [*p[:count], k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
        names = {"fisheye": "equidistant", "fov": "fov", "omni": "radtan"}
        text += (
            f"cam{number}:\n"
            f"  camera_model: {'pinhole' if pinhole else camera.model}\n"
            f"  distortion_model: {names.get(camera.model, 'none')}\n"
            f"  intrinsics: {json.dumps([float(n) for n in intrinsics])}\n"
            f"  distortion_coeffs: {json.dumps([float(n) for n in p[count:]])}\n"
            f"  resolution: [{WIDTH}, {HEIGHT}]\n"
        )
        if number:
            text += f"  T_cn_cnm1: {json.dumps(right_from_left.tolist())}\n"
    path = folder / "camchain.yaml"
    path.write_text(text)
    return path


def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The grey of a plane at a place in m: waves of 2 cm and more."""
    waves = [(80, 13, 0.3), (23, -94, 1.1), (-61, 47, 2.0), (35, 38, 0.7), (140, 150, 0.2)]
    return 128 + 22 * sum(np.sin(a * x + b * y + c) for a, b, c in waves)


def seen(camera: Camera, to_plane: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The image of a plane across the rectified view, each pixel by its own direction."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    there = directions(camera, x, y) @ to_plane
    with np.errstate(all="ignore"):
        scale = (DEPTH_M - place[2]) / there[..., 2]
        image = painted(there[..., 0] * scale + place[0], there[..., 1] * scale + place[1])
    image[~(there[..., 2] > 0.02) | ~np.isfinite(image)] = 0
    return np.rint(image.clip(0, 255)).astype(np.uint8)


def disparity_px(calibration: Calibration, left: np.ndarray, right: np.ndarray) -> float:
    """The disparity at which both rectified images agree best, by their middle."""
    rectify_left, rectify_right = calibration.rectifiers()
    left, right = rectify_left(left).astype(float), rectify_right(right).astype(float)
    rows, columns = slice(60, 140), slice(70, 170)
    found = []
    for disparity in range(1, 40):
        # The right image is the reference: x left = x right + disparity.
        moved = left[rows, columns.start + disparity : columns.stop + disparity]
        found.append(float(np.square(moved - right[rows, columns]).mean()))
    best = int(np.argmin(found))
    before, here, after = found[best - 1 : best + 2]
    return 1 + best + (before - after) / (2 * (before - 2 * here + after))


@pytest.mark.parametrize("view_deg", [150, 175, 200])
@pytest.mark.parametrize("model", MODELS)
def test_wide_pairs_are_rectified(tmp_path: Path, model: str, view_deg: float) -> None:
    """Most of the image is known, and depth is right within 1 %."""
    cameras = lens(model, view_deg, (113.0, 104.0)), lens(model, view_deg, (124.0, 97.0))
    # Both look ahead on average, so that the plane is across the rectified view.
    half = np.asarray(cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0])
    calibration = read_calibration([camchain(tmp_path, cameras, half)])
    rig = calibration.rig
    assert calibration.warnings == ()
    assert rig.baseline_m == pytest.approx(BASELINE_M)
    assert (rig.cx, rig.cy, rig.doffs) == (119.5, 99.5, 0)
    assert 85 < 2 * math.degrees(math.atan(WIDTH / 2 / rig.focal_px)) <= 120.1
    assert calibration.coverage > 0.7
    left = seen(cameras[0], half.T, np.zeros(3))
    right = seen(cameras[1], half, np.array([BASELINE_M, 0, 0]))
    found = disparity_px(calibration, left, right)
    assert rig.focal_px * rig.baseline_m / found == pytest.approx(DEPTH_M, rel=0.01)


def test_a_view_can_be_chosen(tmp_path: Path) -> None:
    cameras = lens("fisheye", 170, (113.0, 104.0)), lens("fisheye", 170, (124.0, 97.0))
    path = camchain(tmp_path, cameras, np.eye(3))
    narrow = read_calibration([path], settings=RigSettings(fov=70))
    assert narrow.rig.focal_px == pytest.approx(WIDTH / 2 / math.tan(math.radians(35)))
    assert narrow.coverage == 1
    with pytest.raises(SettingsError, match="--fov"):
        RigSettings(fov=170)
    with pytest.raises(SettingsError, match="--fov cannot be 2: give 5 to 150 degrees"):
        RigSettings(fov=2)


def test_lenses_that_do_not_fit(tmp_path: Path) -> None:
    cameras = lens("ds", 170, (113.0, 104.0)), lens("eucm", 170, (124.0, 97.0))
    path = camchain(tmp_path, cameras, np.eye(3))
    with pytest.raises(InputError, match="different models, ds and eucm"):
        read_calibration([path])
    path.write_text(path.read_text().replace("distortion_model: none", "distortion_model: equi"))
    with pytest.raises(InputError, match="ds and equi do not go together"):
        read_calibration([path])
