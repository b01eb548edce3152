"""The rig of test_calibration.py in the files of SLAM systems, and files that are named instead."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
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
    LENGTH_M,
    SIZE,
    R,
    T,
    matrix,
    opencv_file,
    values,
)
from test_calibration_formats import orb_slam_2

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig import format_rig
from motionstereo_cli.rig.calibration import read_calibration
from motionstereo_cli.rig.settings import RigSettings

RIGHT_FROM_LEFT = np.vstack([np.column_stack([R, T]), [0, 0, 0, 1]])
BODY_FROM_LEFT = np.eye(4)
BODY_FROM_LEFT[:3, :3] = cv2.Rodrigues(np.array([0.1, 1.2, -0.4]))[0]
BODY_FROM_LEFT[:3, 3] = [0.3, -0.2, 0.1]
BODY_FROM_RIGHT = BODY_FROM_LEFT @ np.linalg.inv(RIGHT_FROM_LEFT)
CAMERAS = ((K1, D1[:4], BODY_FROM_LEFT), (K2, D2[:4], BODY_FROM_RIGHT))
FISHEYES = ((K1, F1, BODY_FROM_LEFT), (K2, F2, BODY_FROM_RIGHT))


def focal(k: np.ndarray) -> list[float]:
    return [float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])]


def rectified() -> tuple[np.ndarray, ...]:
    found = cv2.stereoRectify(
        K1, D1[:4], K2, D2[:4], SIZE, R, T.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )
    return found[:4]


def openvins(folder: Path) -> list[Path]:
    text = ""
    for number, (k, d, pose) in enumerate(CAMERAS):
        text += f"cam{number}:\n  T_imu_cam: {json.dumps(pose.tolist())}\n"
        text += f"  camera_model: pinhole\n  distortion_model: radtan\n  intrinsics: {focal(k)}\n"
        text += f"  distortion_coeffs: [{values(d)}]\n  resolution: {list(SIZE)}\n"
    (folder / "chain.yaml").write_text("%YAML:1.0\n\n" + text)
    return [folder / "chain.yaml"]


def stvo(folder: Path) -> list[Path]:
    text = "cam0:\n  cam_bl: 0.1\n  cam_model: Pinhole\n"
    text += f"  cam_width: {SIZE[0]}\n  cam_height: {SIZE[1]}\n"
    for side, k, d in (("l", K1, D1[:4]), ("r", K2, D2[:4])):
        text += f"  K{side}: {focal(k)}\n  D{side}: {d.tolist()}\n"
    text += f"  R: {R.ravel().tolist()}\n  t: {T.ravel().tolist()}\n"
    (folder / "stvo.yaml").write_text(f"{text}images_subfolder_l: image_l/\n")
    return [folder / "stvo.yaml"]


def vins(folder: Path, cameras: Any = CAMERAS) -> list[Path]:
    config = '%YAML:1.0\nimu: 0\nnum_of_cam: 2\ncam0_calib: "a.yaml"\n'
    paths = [folder / "config.yaml"]
    for number, (k, d, pose) in enumerate(cameras):
        config += matrix(f"body_T_cam{number}", pose, " !!opencv-matrix")
        text = "%YAML:1.0\n---\ncamera_name: camera\n"
        text += f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\n"
        if cameras is FISHEYES:
            names = ("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0")
            text += "model_type: KANNALA_BRANDT\nprojection_parameters:\n"
            text += lines(names, [*d, *focal(k)], "   ")
        else:
            text += "model_type: PINHOLE\ndistortion_parameters:\n"
            text += lines(("k1", "k2", "p1", "p2"), d, "   ") + "projection_parameters:\n"
            text += lines(("fx", "fy", "cx", "cy"), focal(k), "   ")
        paths.append(folder / f"cam{number}.yaml")
        paths[-1].write_text(text)
    paths[0].write_text(config)
    return paths


def vins_fisheye(folder: Path) -> list[Path]:
    return vins(folder, FISHEYES)


def lines(names: Any, numbers: Any, before: str = "") -> str:
    return "".join(f"{before}{n}: {float(v)!r}\n" for n, v in zip(names, numbers, strict=True))


def stella(folder: Path) -> list[Path]:
    r1, r2, p1, p2 = rectified()
    text = 'Camera:\n  setup: "stereo"\n  model: "perspective"\n'
    text += lines(("fx", "fy", "cx", "cy"), focal(p1), "  ")
    text += f"  cols: {SIZE[0]}\n  rows: {SIZE[1]}\n  focal_x_baseline: {float(-p2[0, 3])!r}\n"
    text += "StereoRectifier:\n"
    for side, k, d, r in (("left", K1, D1[:4], r1), ("right", K2, D2[:4], r2)):
        for name, each in (("K", k), ("D", d), ("R", r)):
            text += f"  {name}_{side}: [{values(each)}]\n"
    (folder / "stella.yaml").write_text(text)
    return [folder / "stella.yaml"]


def okvis(folder: Path) -> list[Path]:
    text = "%YAML:1.0\ncameras:\n"
    for k, d, pose in CAMERAS:
        f = focal(k)
        text += (
            f"     - {{T_SC:\n        [{values(pose)}],\n        image_dimension: {list(SIZE)},\n"
        )
        text += f"        distortion_coefficients: [{values(d)}],\n"
        text += "        distortion_type: radialtangential,\n"
        text += f"        focal_length: {f[:2]},\n        principal_point: {f[2:]}}}\n"
    (folder / "okvis.yaml").write_text(text)
    return [folder / "okvis.yaml"]


def ncamera(folder: Path, indent: str = "", head: str = 'label: "rig"\n') -> list[Path]:
    text = head + f"{indent}cameras:\n"
    for k, d, pose in CAMERAS:
        text += f"{indent}- camera:\n{indent}    image_height: {SIZE[1]}\n"
        text += f"{indent}    image_width: {SIZE[0]}\n{indent}    type: pinhole\n"
        text += f"{indent}    intrinsics:\n{indent}      cols: 1\n{indent}      rows: 4\n"
        text += f"{indent}      data: {focal(k)}\n{indent}    distortion:\n"
        text += f"{indent}      type: radial-tangential\n{indent}      parameters:\n"
        text += f"{indent}        cols: 1\n{indent}        rows: 4\n"
        text += f"{indent}        data: [{values(d)}]\n{indent}  T_B_C:\n{indent}    cols: 4\n"
        text += f"{indent}    rows: 4\n{indent}    data: [{values(pose)}]\n"
    (folder / "ncamera.yaml").write_text(text)
    return [folder / "ncamera.yaml"]


def maplab(folder: Path) -> list[Path]:
    head = "sensors:\n  - sensor_type: IMU\n    topic: /imu0\n  - sensor_type: NCAMERA\n"
    return ncamera(folder, "    ", head)


def quaternion(pose: np.ndarray) -> dict[str, float]:
    from motionstereo_cli.rig.pose_forms import quaternions

    names = ("px", "py", "pz", "qx", "qy", "qz", "qw")
    numbers = [*pose[:3, 3], *quaternions(pose[None, :3, :3])[0]]
    return dict(zip(names, map(float, numbers), strict=True))


def basalt(folder: Path) -> list[Path]:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    intrinsics = [
        {
            "camera_type": "pinhole-radtan8",
            "intrinsics": dict(zip(names, [*focal(k), *map(float, d), 0, 0, 0, 0], strict=True)),
        }
        for k, d, _ in CAMERAS
    ]
    content = {
        "T_imu_cam": [quaternion(pose) for _, _, pose in CAMERAS],
        "intrinsics": intrinsics,
        "resolution": [list(SIZE)] * 2,
    }
    (folder / "basalt.json").write_text(json.dumps({"value0": content}))
    return [folder / "basalt.json"]


def basalt_fisheye(folder: Path) -> list[Path]:
    (path,) = basalt(folder)
    content = json.loads(path.read_text())
    for camera, (k, f, _) in zip(content["value0"]["intrinsics"], FISHEYES, strict=True):
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
        numbers = [*focal(k), *map(float, f)]
        camera |= {"camera_type": "kb4", "intrinsics": dict(zip(names, numbers, strict=True))}
    path.write_text(json.dumps(content))
    return [path]


def t265(folder: Path) -> list[Path]:
    cameras = [
        {
            "size_px": list(SIZE),
            "center_px": focal(k)[2:],
            "focal_length_px": focal(k)[:2],
            "distortion": {"type": "kannalabrandt4", "k": f.tolist()},
            "extrinsics": {
                "T": pose[:3, 3].tolist(),
                "W": cv2.Rodrigues(pose[:3, :3])[0].ravel().tolist(),
            },
        }
        for k, f, pose in FISHEYES
    ]
    (folder / "t265.json").write_text(json.dumps({"cameras": cameras}))
    return [folder / "t265.json"]


def ov2slam(folder: Path) -> list[Path]:
    text = "%YAML 1.0\n---\n"
    for side, (k, d, pose) in zip(("left", "right"), CAMERAS, strict=True):
        text += f"Camera.model_{side}: pinhole\n"
        text += f"Camera.{side}_nwidth: {SIZE[0]}\nCamera.{side}_nheight: {SIZE[1]}\n"
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
        text += lines([f"Camera.{name}{side[0]}" for name in names], [*focal(k), *d])
        text += matrix(f"body_T_cam{'lr'.index(side[0])}", pose, " !!opencv-matrix")
    (folder / "ov2slam.yaml").write_text(text)
    return [folder / "ov2slam.yaml"]


def mrcal(folder: Path) -> list[Path]:
    paths = []
    for number, (k, d, pose) in enumerate(CAMERAS):
        from_body = np.linalg.inv(pose)
        rt = np.append(cv2.Rodrigues(from_body[:3, :3])[0].ravel(), from_body[:3, 3])
        paths.append(folder / f"{number}.cameramodel")
        paths[-1].write_text(
            "# generated\n{\n    'lensmodel': 'LENSMODEL_OPENCV4',\n\n    # fx,fy,cx,cy\n"
            f"    'intrinsics': [ {values(np.array([*focal(k), *d]))},],\n"
            f"    'extrinsics': [ {values(rt)},],\n    'imagersize': [ 320, 240,],\n"
            "    'optimization_inputs': b'1.{[}#a:,',\n}\n"
        )
    return paths


def ost(folder: Path) -> list[Path]:
    r1, r2, p1, p2 = rectified()
    text = f"# oST version 5.0 parameters\n\n[image]\n\nwidth\n{SIZE[0]}\n\nheight\n{SIZE[1]}\n\n"
    for side, k, d, r, p in (("left", K1, D1[:4], r1, p1), ("right", K2, D2[:4], r2, p2)):
        text += f"[narrow_stereo/{side}]\n\n"
        parts = {"camera matrix": k, "distortion": d[None], "rectification": r, "projection": p}
        for name, array in parts.items():
            rows = "\n".join(values(row).replace(",", "") for row in array)
            text += f"{name}\n{rows}\n\n"
    (folder / "ost.txt").write_text(text)
    return [folder / "ost.txt"]


@pytest.mark.parametrize(
    "written",
    [openvins, vins, stella, okvis, ncamera, maplab, basalt, ov2slam, mrcal, ost, stvo],
)
def test_pinhole_pairs_of_slam_systems(tmp_path: Path, written: Callable[..., list[Path]]) -> None:
    plain = read_calibration([opencv_file(tmp_path / "p.yaml", D1=D1[:4], D2=D2[:4])], SIZE)
    assert_same(plain, read_calibration(written(tmp_path)))


@pytest.mark.parametrize("written", [vins_fisheye, basalt_fisheye, t265])
def test_fisheye_pairs_of_slam_systems(tmp_path: Path, written: Callable[..., list[Path]]) -> None:
    fisheye = {"D1": F1, "D2": F2, "distortion_model": "fisheye"}
    plain = read_calibration([opencv_file(tmp_path / "p.yaml", **fisheye)], SIZE)
    assert_same(plain, read_calibration(written(tmp_path)))


@pytest.mark.parametrize(
    ("baseline_m", "k1", "said"), [(0.1, 0, ""), (1, 0, "RGB-D"), (0.1, 0.2, "of one camera")]
)
def test_rectified_pairs_of_stvo(tmp_path: Path, baseline_m: float, k1: float, said: str) -> None:
    path = tmp_path / "kitti.yaml"
    path.write_text(
        f"cam0:\n  cam_cx: 160.0\n  cam_cy: 120.0\n  cam_d0: {k1}\n  cam_d1: 0.0\n  cam_d2: 0.0\n"
        f"  cam_d3: 0.0\n  cam_fx: 300.0\n  cam_fy: 300.0\n  cam_bl: {baseline_m}\n"
        "  cam_height: 240\n  cam_model: Pinhole\n  cam_width: 320\n  tx: 0.0\n"
    )
    if k1:
        with pytest.raises(InputError, match=said):
            read_calibration([path])
        return
    found = read_calibration([path])
    assert found.maps is None
    assert (found.rig.focal_px, found.rig.cx) == (300, 160)
    assert found.rig.baseline_m == pytest.approx(baseline_m)
    assert bool(found.warnings) == bool(said)
    assert all(said in line for line in found.warnings)


def assert_same(plain: Any, other: Any) -> None:
    for name in ("focal_px", "baseline_m", "cx", "cy", "doffs"):
        assert getattr(other.rig, name) == pytest.approx(getattr(plain.rig, name), abs=1e-6), name
    np.testing.assert_allclose(other.maps, plain.maps, atol=1e-2)
    assert other.warnings == ()


def test_the_body_of_the_poses_is_known(tmp_path: Path) -> None:
    found = read_calibration(okvis(tmp_path)).body_from_left
    assert found is not None
    np.testing.assert_allclose(found[:3, 3], BODY_FROM_LEFT[:3, 3], atol=1e-9)


# Rectified images.


@pytest.mark.parametrize(
    ("text", "doffs_px"),
    [
        ("300 0 159 0 300 120 0 0 1\n0.12\n", 0),
        ("300 0 159\n0 300 120\n0 0 1\n0.12\n", 0),
        ("300 0 159 0 0 300 120 0 0 0 1 0\n300 0 162 -36 0 300 120 0 0 0 1 0\n", 3),
        (
            '{"width": 320, "height": 240, "fx": 300, "fy": 300, "cx0": 159, "cx1": 162, "cy": 120,'
            ' "baseline_meters": 0.12, "depth_range": [1, 5]}',
            3,
        ),
        (
            "P_rect_101: 300 0 159 0 0 300 120 0 0 0 1 0\n"
            "P_rect_103: 300 0 162 -36 0 300 120 0 0 0 1 0\n",
            3,
        ),
    ],
)
def test_rectified_pairs_of_datasets(tmp_path: Path, text: str, doffs_px: float) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(text)
    found = read_calibration([path], SIZE)
    assert found.maps is None
    rig = found.rig
    assert (rig.focal_px, rig.cx, rig.cy, rig.doffs) == (300, 159, 120, doffs_px)
    assert rig.baseline_m == pytest.approx(0.12)


# Named, with what to give instead.


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<opencv_storage>\n<stereoMapL_x type_id='a'><rows>2</rows>", "holds remap tables"),
        ("%YAML:1.0\n---\nLeft_Stereo_Map_x: !!opencv-matrix\n", "holds remap tables"),
        ("# Camera list with one line of data per camera:\n0 PINHOLE 9 9 1 1 1 1\n", "COLMAP"),
        ('{"camera_angle_x": 0.7, "frames": []}', "transforms.json"),
        ('[{"token": "a", "camera_intrinsic": [[1]]}]', "nuScenes"),
        ("cam_model: Pinhole\ncam_fx: 0.5\n", "the former SVO"),
        ("cam0:\n  intrinsics: [1, 2, 3, 4]\n", "has one camera, cam0"),
        ("camera_matrix: [1, 0, 0, 0, 1, 0, 0, 0, 1]\ndist: [0, 0, 0, 0]\n", "is of one camera"),
        ("model_type: MEI\nprojection_parameters: {u0: 1}\n", "--rig config.yaml --rig cam0.yaml"),
        ("Camera: {setup: monocular, fx: 1}\n", "stella_vslam and of a monocular camera"),
        ("Camera.fx: 5\nCamera.fy: 5\nCamera.cx: 5\nCamera.cy: 5\n", "ORB-SLAM's of one camera"),
        (
            "Camera.fx: 5\nCamera.fy: 5\nCamera.cx: 5\nCamera.cy: 5\nCamera.bf: 40\n"
            "DepthMapFactor: 5000\n",
            "RGB-D camera",
        ),
        ("{'lensmodel': 'LENSMODEL_PINHOLE'}\n", "of one camera: give those of both"),
        ("K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD: [0, 0, 0, 0]\n", "is of one camera"),
        ("imu0:\n  update_rate: 200\n", "is of an IMU"),
        ("up_sigma_px: 1\nup_slam_sigma_px: 1\nrelative_config_imucam: c.yaml\n", "names, c.yaml"),
        ("camera0: 4\ncamera1: 6\nframe_width: 1280\n", "no calibration of a form that is read"),
        ('[{"x": 1}, {"x": 2}]', "no calibration of a form that is read"),
        ("Training:\n  edge_threshold: 1\n", "no calibration of a form that is read"),
        ("EDGE_PROJECT_P2MC 1 2\n", "a graph of g2o"),
        ("458.6 457.3 367.2 248.4 -0.28 0.07 0.0 0.0\n", "the numbers of one camera"),
        ("\n", "is empty"),
        ("tracker: {threads: 4}\n", "no calibration of a form that is read"),
        ("1403636579763555584\n1403636579813555456\n", "no calibration of a form that is read"),
    ],
)
def test_other_files_are_named(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        read_calibration([path], SIZE)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_cameras_of_vins_are_in_the_order_of_its_configuration(tmp_path: Path) -> None:
    config, left, right = vins(tmp_path)
    named = '"cam0.yaml"\ncam1_calib: "cam1.yaml"'
    config.write_text(config.read_text().replace('"a.yaml"', named))
    assert read_calibration([config, left, right]).rig.baseline_m > 0
    with pytest.raises(InputError, match=r"cam0\.yaml is of the left camera .* in that order"):
        read_calibration([config, right, left])


def test_remap_tables_in_npz(tmp_path: Path) -> None:
    path = tmp_path / "stereo.npz"
    tables = {f"{side}Map{axis}": np.zeros((4, 4)) for side in ("left", "right") for axis in "XY"}
    np.savez(path, imageSize=np.array(SIZE), **tables)
    with pytest.raises(InputError, match="holds remap tables"):
        read_calibration([path], SIZE)
    # With Q they are all that is needed.
    plain = read_calibration([opencv_file(tmp_path / "plain.yml")], SIZE)
    assert plain.maps is not None
    rig = plain.rig
    q = np.array(
        [
            *([1, 0, 0, -rig.cx], [0, 1, 0, -rig.cy], [0, 0, 0, rig.focal_px]),
            [0, 0, 1 / (1000 * rig.baseline_m), 0],
        ]
    )
    tables = {
        f"{side}Map{axis}": table
        for side, maps in zip(("left", "right"), plain.maps, strict=True)
        for axis, table in zip("XY", maps, strict=True)
    }
    np.savez_compressed(path, imageSize=np.array(SIZE), dispartityToDepthMap=q, **tables)
    found = read_calibration([path], SIZE)
    for name in ("focal_px", "baseline_m", "cx", "cy", "doffs"):
        assert getattr(found.rig, name) == pytest.approx(getattr(rig, name), abs=1e-6), name
    np.testing.assert_allclose(found.maps, plain.maps)
    assert "remap tables" in found.describe()


@pytest.mark.parametrize("name", ["maps.xml", "maps.yml", "maps.npz"])
@pytest.mark.parametrize("kind", [cv2.CV_16SC2, cv2.CV_32FC1])
def test_remap_tables_with_a_rig_of_the_rectified_images(
    tmp_path: Path, name: str, kind: int
) -> None:
    plain = read_calibration([opencv_file(tmp_path / "plain.yml")], SIZE)
    assert plain.maps is not None
    fixed = [cv2.convertMaps(*maps, cv2.CV_16SC2) for maps in plain.maps]
    given = fixed if kind == cv2.CV_16SC2 else plain.maps
    sides = ("L", "R") if name != "maps.yml" else ("l", "r")
    tables = {
        f"stereoMap{side}_{axis}": table
        for side, maps in zip(sides, given, strict=True)
        for axis, table in zip("xy", maps, strict=True)
    }
    path, rig = tmp_path / name, tmp_path / "rig.yaml"
    if name == "maps.npz":
        np.savez(path, **tables)
    else:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for each, table in tables.items():
            storage.write(each, table)
        storage.release()
    with pytest.raises(InputError, match=r"neither focal length nor baseline: give rig\.yaml"):
        read_calibration([path], SIZE)
    rig.write_text(format_rig(plain.rig))
    for files in ([path, rig], [rig, path]):
        found = read_calibration(files, SIZE)
        for part in ("focal_px", "baseline_m", "cx", "cy", "doffs"):
            assert getattr(found.rig, part) == pytest.approx(getattr(plain.rig, part), abs=1e-6)
        np.testing.assert_allclose(found.maps, plain.maps, atol=1 / 32)
    if name == "maps.npz":
        all_of_it = {"leftK": K1, "leftD": D1, "rightK": K2, "rightD": D2, "R": R, "T": T}
        np.savez(tmp_path / "all.npz", **tables, **all_of_it)
        whole = read_calibration([tmp_path / "all.npz"], SIZE)
        np.testing.assert_allclose(whole.maps, plain.maps, atol=1e-3)
    rig.write_text(format_rig(plain.rig).replace("width: 320", "width: 640"))
    with pytest.raises(InputError, match="remap tables of 320x240 px, but the rig is of 640x240"):
        read_calibration([path, rig], SIZE)
    with pytest.raises(InputError, match=r"leave the remap tables in .* out"):
        read_calibration([path, tmp_path / "plain.yml"], SIZE)


def test_opencv_needs_no_blank_after_a_colon(tmp_path: Path) -> None:
    path = tmp_path / "orb.yaml"
    path.write_text(
        "%YAML:1.0\nCamera.fx:300.0\nCamera.fy: 300.0\nCamera.cx: 160.0\nCamera.cy: 120.0\n"
        "Camera.bf: 36.0\nViewer.PointSize:2\n"
    )
    assert read_calibration([path], SIZE).rig.baseline_m == pytest.approx(0.12)


@pytest.mark.parametrize("baseline_in_p", [True, False])
def test_airslam(tmp_path: Path, baseline_in_p: bool) -> None:
    plain = read_calibration([orb_slam_2(tmp_path)], SIZE)
    text = "".join(
        line
        for line in (tmp_path / "orb2.yaml").read_text().splitlines(keepends=True)
        if not line.startswith("Camera.")
    )
    if not baseline_in_p:
        (shift,) = {n for n in re.findall(r"-\d+\.\d+", text[text.index("RIGHT.P") :]) if n}
        text = text.replace(shift, "0.0") + f"bf: {shift[1:]}\n"
    path = tmp_path / "airslam.yaml"
    path.write_text(text + "distortion_type: 0\n")
    found = read_calibration([path], SIZE)
    assert found.rig == plain.rig
    np.testing.assert_allclose(found.maps, plain.maps)


def test_half_of_an_opencv_calibration(tmp_path: Path) -> None:
    alone = opencv_file(tmp_path / "intrinsics.yml", R=None, T=None)
    with pytest.raises(InputError, match=r"R is missing, and T: give the file .*extrinsics\.yml"):
        read_calibration([alone], SIZE)
    r1, r2, p1, p2 = rectified()
    none = dict.fromkeys(["M1", "M2", "D1", "D2"])
    given = {"R1": r1, "R2": r2, "P1": p1, "P2": p2}
    found = read_calibration([opencv_file(tmp_path / "extrinsics.yml", **none, **given)], SIZE)
    assert found.maps is None
    assert "taken to be rectified already. If they are as recorded" in found.warnings[0]


# Contradictions.


def test_two_calibrations_in_one_file_are_asked_about(tmp_path: Path) -> None:
    path = opencv_file(tmp_path / "both.yml")
    camera = "Camera.fx: 300.0\nCamera.fy: 300.0\nCamera.cx: 160.0\nCamera.cy: 120.0\n"
    path.write_text(path.read_text() + camera + "Camera.bf: 36.0\n")
    with pytest.raises(InputError, match="holds two calibrations: ORB-SLAM's Camera, and OpenCV's"):
        read_calibration([path], SIZE)


def test_a_second_camera_on_the_left_by_all_values(tmp_path: Path) -> None:
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        K2, D2, K1, D1, SIZE, R.T, (-R.T @ T).reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )
    assert p2[0, 3] > 0
    path = opencv_file(
        tmp_path / "c.yml",
        **{"M1": K2, "D1": D2, "M2": K1, "D2": D1, "R": R.T, "T": -R.T @ T},
        **{"R1": r1, "R2": r2, "P1": p1, "P2": p2},
    )
    with pytest.raises(InputError, match="T says that the second camera stands left"):
        read_calibration([path], SIZE)


def test_a_view_overrides_how_the_file_rectifies(tmp_path: Path) -> None:
    found = read_calibration(ost(tmp_path), settings=RigSettings(fov=50))
    assert found.rig.focal_px == pytest.approx(160 / np.tan(np.radians(25)))
    assert found.rig.baseline_m == pytest.approx(LENGTH_M)
    assert abs(BASELINE_M - LENGTH_M) < 1e-3


# Units.


@pytest.mark.parametrize(
    ("length", "unit", "baseline_m", "said"),
    [
        (3.3, "auto", 0.0033, "side of a square, as --baseline-unit 25mm"),
        (3.3, "36mm", 0.1188, ""),
        (12.0, "cm", 0.12, ""),
        (1.2, "auto", 1.2, "taken to be in m"),
        (0.12, "auto", 0.12, ""),
    ],
)
def test_lengths_in_squares_and_cm(
    tmp_path: Path, length: float, unit: str, baseline_m: float, said: str
) -> None:
    path = opencv_file(tmp_path / "c.yml", T=T / LENGTH_M * length)
    found = read_calibration([path], SIZE, RigSettings(baseline_unit=unit))
    assert found.rig.baseline_m == pytest.approx(baseline_m)
    assert bool(found.warnings) == bool(said)
    assert said in " ".join(found.warnings)


@pytest.mark.parametrize(
    "written",
    [
        *(
            openvins,
            stvo,
            vins,
            vins_fisheye,
            stella,
            okvis,
            ncamera,
            maplab,
            basalt,
            basalt_fisheye,
        ),
        *(t265, ov2slam, mrcal, ost),
    ],
)
def test_damaged_files_end_in_a_line(tmp_path: Path, written: Callable[..., list[Path]]) -> None:
    """A line left out at a time: what is read then is refused in one line, or read."""
    for path in written(tmp_path):
        lines = path.read_text().splitlines(keepends=True)
        for left_out in range(0, len(lines), max(1, len(lines) // 12)):
            path.write_text("".join(lines[:left_out] + lines[left_out + 1 :]))
            assert "\n" not in said_of(written_paths(tmp_path, path))
        path.write_text("".join(lines))


def said_of(paths: list[Path]) -> str:
    try:
        return " ".join(read_calibration(paths, SIZE).warnings)
    except InputError as error:
        return str(error)


def written_paths(folder: Path, path: Path) -> list[Path]:
    """The files of a calibration that are there, in their order."""
    order = {"config.yaml": 0}
    found = sorted(folder.iterdir(), key=lambda each: (order.get(each.name, 1), each.name))
    assert path in found
    return found
