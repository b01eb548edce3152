"""The layout of TUM RGB-D, read as those who fuse it read it."""

import json

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from motionstereo_cli.commands import cli
from motionstereo_cli.rig.pose_forms import rotations
from motionstereo_cli.simulate.corridor import Corridor

TABLES = ("associations.txt", "rgb.txt", "depth.txt", "groundtruth.txt")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rgbd")
    size = ["--width", "160", "--height", "120", "--frames", "20:32", "--seed", "1", "--crf", "8"]
    done = CliRunner().invoke(cli, ["simulate", str(folder / "in"), *size])
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture(scope="module", params=["right", "left"])
def fused(made, request):
    out, given = made / request.param, made / "in"
    videos = [str(given / f"{side}.mp4") for side in ("left", "right")]
    poses = ["--rig", str(given / "rig.yaml"), "--poses", str(given / "poses.txt")]
    save = ["--save", "rgbd", "--save", "depth", "--reference", request.param, "--no-check"]
    done = CliRunner().invoke(cli, ["run", *videos, *poses, *save, "-o", str(out)])
    assert done.exit_code == 0, done.output
    return out


def rows(path):
    lines = path.read_text(encoding="ascii").splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def test_tables_name_images_that_are_there(fused):
    tables = {name: rows(fused / "rgbd" / name) for name in TABLES}
    assert {len(table) for table in tables.values()} == {12}
    known = 0
    for together, view, depth, pose in zip(*tables.values(), strict=True):
        assert together == [*view, *depth]
        assert len({view[0], depth[0], pose[0]}) == 1
        assert len(pose) == 8
        assert (fused / "rgbd" / view[1]).is_file()
        mm = cv2.imread(str(fused / depth[1]), cv2.IMREAD_UNCHANGED)
        units = cv2.imread(str(fused / "rgbd" / depth[1]), cv2.IMREAD_UNCHANGED)
        assert units.dtype == np.uint16
        both = (mm > 0) & (units > 0)
        known += both.sum()
        np.testing.assert_allclose(units[both] / 5000, mm[both] / 1000, atol=0.0007)
        assert (mm[(units == 0) & (mm > 0)] > 13_000).all()
    assert known > 1000


def test_depth_and_poses_put_points_on_the_walls(fused):
    rgbd, corridor = fused / "rgbd", Corridor(seed=1)
    camera = json.loads((rgbd / "intrinsics.json").read_text())
    matrix = np.reshape(camera["intrinsic_matrix"], (3, 3)).T
    off = []
    for (_, _, _, depth), pose in zip(
        rows(rgbd / "associations.txt"), rows(rgbd / "groundtruth.txt"), strict=True
    ):
        z = cv2.imread(str(rgbd / depth), cv2.IMREAD_UNCHANGED) / 5000
        assert z.shape == (camera["height"], camera["width"])
        row, column = np.nonzero((z > 0) & (z < 3))
        rays = np.linalg.inv(matrix) @ np.stack([column, row, np.ones(len(row))])
        place, turn = np.array(pose[1:4], float), np.array([pose[4:]], float)
        x, y, up = (rotations(turn)[0] @ (rays * z[row, column])).T.T + place[:, None]
        square = np.maximum(np.abs(x), np.abs(y))
        walls = np.minimum(np.abs(square - corridor.outer_m), np.abs(square - corridor.inner_m))
        off += np.minimum(walls, np.minimum(np.abs(up), np.abs(up - 2.6))).tolist()
    assert len(off) > 1000
    assert np.median(off) < 0.05
