"""Points in space and the map of the surroundings: scenes whose truth is known, and the files."""

import csv
import dataclasses
import io
import math
import struct
from fractions import Fraction

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from taken import prepared, step_of, taken

from bench import map as bench
from motionstereo_cli.commands import cli
from motionstereo_cli.errors import OutputError, SettingsError
from motionstereo_cli.files.atomic import part_of
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.fused_map import (
    OCCUPIED,
    Grid,
    Voxels,
    known_free,
    marked,
    merged,
    seen_often,
    trimmed,
    voxels_of,
)
from motionstereo_cli.robot.mapper import Floor, Mapper, apart_from, camera_points, standing
from motionstereo_cli.robot.points import in_world, points
from motionstereo_cli.runs.folder_files import NAMING
from motionstereo_cli.simulate.camera import Pose as RobotPose
from motionstereo_cli.simulate.camera import stereo_cameras
from motionstereo_cli.simulate.corridor import FRAMES_PER_SIDE, Corridor
from motionstereo_cli.simulate.drive_plan import Plan
from motionstereo_cli.simulate.drive_world import DriveWorld
from motionstereo_cli.simulate.settings import DriveSettings
from motionstereo_cli.sinks.map import map_png, map_sheet, map_yaml
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.points import encode_ply
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.types import FrameResult, Pose, Rig, Steering, StereoFrame

RIG = Rig(width=160, height=120, focal_px=140.0, baseline_m=0.12, cx=79.5, cy=59.5)
STILL = Pose(0.0, 0.0, 1.2, 0.0, 0.0, 0.0, 1.0)
NAN = math.nan


def result(depth_m, pose=STILL, *, index=0, right=None, left=None, moved=None):
    shape = depth_m.shape
    depth_m = depth_m.astype(np.float32)
    dark = np.zeros(shape, np.uint8)
    return FrameResult(
        frame=StereoFrame(
            index, index, None, dark if left is None else left, dark if right is None else right
        ),
        bands=dark,
        motion=np.ones(shape, np.bool_) if moved is None else moved,
        charge=dark,
        age_frames=dark,
        disparity_px=depth_m,
        confidence=depth_m,
        depth_m=depth_m,
        steering=Steering("blind", None, None, None, None),
        charged=1.0,
        matched=1.0,
        pose=pose,
    )


def quaternion(axis, angle_rad):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis) * math.sin(angle_rad / 2)
    return float(x), float(y), float(z), math.cos(angle_rad / 2)


def read_ply(content):
    """Read what encode_ply wrote, by the PLY format's own words."""
    head, _, body = content.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    kinds = [line.split()[1:] for line in lines if line.startswith("property")]
    codes = {"float": "f", "double": "d", "uchar": "B"}
    record = struct.Struct("<" + "".join(codes[kind] for kind, _ in kinds))
    assert [name for _, name in kinds] == ["x", "y", "z", "red", "green", "blue"]
    assert len(body) == count * record.size
    return [record.unpack_from(body, number * record.size) for number in range(count)]


class TestPoints:
    def test_by_hand(self):
        depth_m = np.array([[NAN, 1.0, NAN], [NAN, NAN, 2.0]], np.float32)
        found = points(depth_m, ~np.isnan(depth_m), focal_px=(10.0, 10.0), cx_px=1.0, cy_px=0.5)
        np.testing.assert_allclose(found, [[0, -0.05, 1], [0.2, 0.1, 2]])

    @pytest.mark.parametrize(
        ("pose", "wanted"),
        [
            (STILL, (3.0, -0.56, 0.2)),
            # To the left: ahead is y, the right is x.
            (Pose(1, 2, 0, *quaternion((0, 0, 1), math.pi / 2)), (1.56, 5.0, -1.0)),
            # Nose down (REP 103: positive about the axis to the left): ahead is down.
            (Pose(0, 0, 0, *quaternion((0, 1, 0), math.pi / 2)), (-1.0, -0.56, -3.0)),
            # Right side down: the right is down.
            (Pose(0, 0, 0, *quaternion((1, 0, 0), math.pi / 2)), (3.0, 1.0, -0.56)),
        ],
    )
    def test_half_a_metre_right_one_down_three_ahead_of_the_right_camera(self, pose, wanted):
        found = in_world(
            np.array([[0.5, 1.0, 3.0]]),
            camera_left_m=-0.06,
            place_m=(pose.x_m, pose.y_m, pose.z_m),
            quaternion=(pose.qx, pose.qy, pose.qz, pose.qw),
        )
        np.testing.assert_allclose(found, [wanted], atol=1e-12)

    @given(
        st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1),
        st.floats(-3, 3),
        st.floats(0.99, 1.01),
    )
    def test_turns_as_opencv_turns(self, axis, angle_rad, length):
        turn, _ = cv2.Rodrigues(np.asarray(axis) / np.linalg.norm(axis) * angle_rad)
        found = in_world(
            np.array([[-2.0, -3.0, 1.0]]),
            camera_left_m=0.0,
            place_m=(5, 6, 7),
            quaternion=tuple(length * each for each in quaternion(axis, angle_rad)),
        )
        np.testing.assert_allclose(found[0], turn @ [1, 2, 3] + [5, 6, 7], atol=1e-9)

    @pytest.mark.parametrize("kind", [np.float32, np.float64])
    @pytest.mark.parametrize("count", [0, 1, 5])
    def test_a_ply_file_is_read_back(self, kind, count):
        places = (np.arange(3 * count).reshape(count, 3) / 7).astype(kind)
        grey = np.arange(count, dtype=np.uint8) * 50
        found = read_ply(encode_ply(places, grey, "m"))
        assert found == [(*place, g, g, g) for place, g in zip(places.tolist(), grey, strict=True)]

    @pytest.mark.parametrize("reference", ["right", "left"])
    def test_each_frame_becomes_a_file(self, tmp_path, reference):
        rig = Rig(
            width=3, height=2, focal_px=(10.0, 10.0), baseline_m=0.1, cx=1.0, cy=0.5, doffs=0.5
        )
        stream = RunContext(Fraction(1, 25), Settings(reference=reference), rig)
        sink = OUTPUTS["points"].open(tmp_path, stream)
        depth_m = np.array([[NAN, 1.0, NAN], [NAN, NAN, 2.0]])
        right = np.arange(6, dtype=np.uint8).reshape(2, 3)
        shown = result(depth_m, index=7, right=right, left=right + 100)
        sink.write(taken("points", shown, reference))
        sink.close()
        content = (tmp_path / "points" / "000007.ply").read_bytes()
        assert f"{reference} camera: x right, y down, z forward".encode() in content
        found = np.array(read_ply(content))
        cx, grey = (1.5, 0) if reference == "right" else (1.0, 100)
        np.testing.assert_allclose(found[:, 0], [(1 - cx) * 0.1, (2 - cx) * 0.2], rtol=1e-6)
        np.testing.assert_allclose(found[:, 1:3], [[-0.05, 1], [0.1, 2]], rtol=1e-6)
        assert found[:, 3].tolist() == [grey + 1, grey + 5]


def mask(*cells, shape=(4, 4)):
    found = np.zeros(shape, np.bool_)
    found[tuple(np.array(cells).T)] = True
    return found


class TestGrid:
    nothing = np.zeros((4, 4), np.bool_)

    def test_one_frame_is_no_evidence_and_several_are(self):
        grid, frames = Grid.empty(), 0
        while not (grid.evidence >= OCCUPIED).any():
            grid, frames = marked(grid, (-2, 5), self.nothing, mask((1, 2))), frames + 1
        assert frames == 3
        seen = trimmed(grid)
        assert (seen.corner, seen.evidence.shape) == ((-1, 7), (1, 1))

    def test_what_moved_on_becomes_free_however_long_it_stood(self):
        grid = Grid.empty()
        for _ in range(1000):
            grid = marked(grid, (0, 0), self.nothing, mask((1, 2)))
        assert grid.evidence.max() >= OCCUPIED
        for _ in range(32):
            grid = marked(grid, (0, 0), mask((1, 2)), self.nothing)
        places = np.array([[1.5, 2.5], [1.5, 3.5], [-500.0, 0.0]])
        assert known_free(grid, places).tolist() == [True, False, False]

    def test_nothing_seen_is_one_unknown_cell(self):
        grid = marked(Grid.empty(), (3, 4), self.nothing, self.nothing)
        assert trimmed(grid).evidence.tolist() == [[0]]

    @given(
        st.lists(
            st.tuples(
                st.tuples(st.integers(-150, 150), st.integers(-150, 150)),
                st.lists(st.integers(0, 2), min_size=12, max_size=12),
            ),
            max_size=12,
        )
    )
    def test_grows_any_way_and_forgets_nothing(self, frames):
        """Against a dict of cells."""
        grid, wanted = Grid.empty(), {}
        for corner, cells in frames:
            what = np.array(cells).reshape(4, 3)
            before = grid.evidence.copy()
            later = marked(grid, corner, what == 1, what == 2)
            np.testing.assert_array_equal(grid.evidence, before)
            grid = later
            for (i, j), each in np.ndenumerate(what):
                key = (corner[0] + i, corner[1] + j)
                wanted[key] = wanted.get(key, 0) + (0, -1, 2)[each]
        found = {
            (int(i) + grid.corner[0], int(j) + grid.corner[1]): int(grid.evidence[i, j])
            for i, j in np.argwhere(grid.evidence)
        }
        assert found == {key: value for key, value in wanted.items() if value}


class TestVoxels:
    def test_one_point_a_voxel_at_the_mean(self):
        cloud = Voxels.empty((10, 0, 0))
        for frame in range(3):
            places = np.array([[10.25, -0.5, 2.0], [10.75, -0.5, 2.0], [-3.5, 0.0, 0.0 + frame]])
            cloud = merged(cloud, voxels_of(places, np.array([100, 200, 7], np.uint8), (10, 0, 0)))
        found, grey = seen_often(cloud)
        np.testing.assert_allclose(found, [[10.5, -0.5, 2.0]])  # the other was in each frame new
        assert grey.tolist() == [150]
        assert len(cloud.key) == 4

    def test_far_beyond_the_keys_nothing_wraps_round(self):
        places = np.array([[0.5, 0.5, 0.5], [2.0**21, 0.5, 0.5], [0.5, -(2.0**21), 0.5]])
        cloud = voxels_of(places, np.zeros(3, np.uint8), (0, 0, 0))
        assert len(cloud.key) == 1

    @given(
        st.lists(
            st.lists(st.tuples(*[st.integers(-2, 2)] * 3, st.integers(0, 255)), max_size=8),
            max_size=6,
        )
    )
    def test_merging_is_counting(self, frames):
        """Against a dict of voxels, whatever is merged first."""
        origin, wanted = (1, 2, 3), {}
        clouds = []
        for frame in frames:
            table = np.array(frame, np.float64).reshape(-1, 4)
            clouds.append(voxels_of(table[:, :3] + 0.5, table[:, 3].astype(np.uint8), origin))
            for cell in {tuple(row[:3]) for row in frame}:
                mean = np.mean([row[3] for row in frame if tuple(row[:3]) == cell])
                count, total = wanted.get(cell, (0, 0))
                wanted[cell] = count + 1, total + mean
        one, other = Voxels.empty(origin), Voxels.empty(origin)
        for number, cloud in enumerate(clouds):
            one = merged(one, cloud)
            assert (np.diff(one.key) > 0).all()
            other = merged(other, cloud) if number % 2 else merged(cloud, other)
        np.testing.assert_array_equal(one.key, other.key)
        np.testing.assert_array_equal(one.frames, other.frames)
        found, grey = seen_often(one)
        often = {cell: total / count for cell, (count, total) in wanted.items() if count >= 3}
        assert {tuple(np.floor(place).astype(int)) for place in found} == set(often)
        assert sorted(grey) == pytest.approx(sorted(often.values()), abs=0.51)


def wall_depth(pose, ahead_m, rig=RIG, reference="right"):
    """Depth of a wall at x = ``ahead_m`` in the world, and what a world point it shows."""
    column, row = np.meshgrid(np.arange(rig.width), np.arange(rig.height))
    forward = np.ones(column.shape)
    left = (rig.cx_of(reference) - column) / rig.focal_px
    up = (rig.cy - row) / rig.focal_px
    x, y, z, w = pose.qx, pose.qy, pose.qz, pose.qw
    axis = np.array([x, y, z])
    turn, _ = cv2.Rodrigues(
        axis / max(np.linalg.norm(axis), 1e-12) * 2 * math.atan2(np.linalg.norm(axis), w)
    )
    rays = np.stack([forward, left, up], axis=-1) @ turn.T
    side = rig.baseline_m / (-2 if reference == "right" else 2)
    eye = np.array([pose.x_m, pose.y_m, pose.z_m]) + turn @ [0, side, 0]
    return (ahead_m - eye[0]) / rays[..., 0]


def add(mapper, shown, reference="right", rig=RIG):
    step = step_of(shown, rig, reference)
    mapper.add(*step.points, step.pose)


@pytest.mark.parametrize("camera", ["right", "left"])
def test_points_near_what_moves_by_itself_are_left_out(camera):
    """Each grey tells which pixel it was."""
    rig = dataclasses.replace(RIG, doffs=3.0)
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 9, (rig.height, rig.width)).astype(np.float32)
    view = rng.integers(0, 256, depth.shape, dtype=np.uint8)
    which = rng.random(depth.shape) < 0.3
    moved = np.zeros(depth.shape, np.bool_)
    moved[40, 70] = moved[5, 0] = True
    near = np.zeros(depth.shape, np.bool_)
    near[28:53, 58:83] = near[:18, :13] = True
    found = apart_from(camera_points(depth, view, which, camera, rig), moved, camera, rig)
    wanted = camera_points(depth, view, which & ~near, camera, rig)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


class TestMapper:
    def mapper(self, cell_m=0.05, **settings):
        return Mapper(Settings(**settings), RIG, cell_m)

    @pytest.mark.parametrize("reference", ["right", "left"])
    @pytest.mark.parametrize("turn", [(0, 0, 0), (0, 0.3, 0), (0.25, -0.2, 0.3)])
    def test_a_wall_is_where_it_is_however_the_camera_is_held(self, reference, turn):
        axis, angle_rad = (turn, np.linalg.norm(turn)) if any(turn) else ((0, 0, 1), 0.0)
        pose = Pose(0.3, 0.1, 1.2, *quaternion(axis, angle_rad))
        mapper = self.mapper(reference=reference)
        for _ in range(6):
            add(mapper, result(wall_depth(pose, 3.0, reference=reference), pose), reference)
        floor = mapper.floor()
        x_m, y_m = ((np.argwhere(floor.occupied) + 0.5) * 0.05 + (floor.x_m, floor.y_m)).T
        assert len(x_m) > 40
        np.testing.assert_allclose(x_m, 3.0, atol=0.16)
        assert abs(np.median(x_m) - 3.0) <= 0.05
        assert np.ptp(y_m) > 1.8
        places, _ = mapper.points()
        np.testing.assert_allclose(places[:, 0], 3.0, atol=1e-5)
        free_m = (np.argwhere(floor.free) + 0.5) * 0.05 + (floor.x_m, floor.y_m)
        assert free_m[:, 0].max() < 3.0
        assert len(free_m) > 400

    def test_only_what_stands_up_from_the_ground_is_standing(self):
        """A post, a step, and a far wall of which one row is seen; 6 points each."""
        post = [[1.05, 0.05, z] for z in np.linspace(0.1, 1.0, 6)]
        step = [[2.05, 0.05, 0.12]] * 6
        lone = [[3.05, 0.05, z] for z in (0.2, 0.9)]
        placed = np.array([*post, *step, *lone, [-9.0, 0.0, 1.0]])
        found = standing(placed, placed[:, 2], (0, 0), (40, 4), 0.1)
        assert np.argwhere(found).tolist() == [[10, 0]]

    def test_what_stands_is_in_the_map_though_something_is_nearer_in_its_bearing(self):
        """A low box before a wall: both are seen in the same columns, and neither is free."""
        depth = wall_depth(STILL, 3.0)
        depth[105:] = np.minimum(depth[105:], 2.0)
        mapper = self.mapper()
        for _ in range(8):
            add(mapper, result(depth))
        floor = mapper.floor()
        x_m = (np.argwhere(floor.occupied)[:, 0] + 0.5) * 0.05 + floor.x_m
        assert (np.abs(x_m - 2.0) < 0.1).sum() > 20
        assert (np.abs(x_m - 3.0) < 0.1).sum() > 20

    def test_what_moves_on_leaves_no_trace(self):
        wall = wall_depth(STILL, 3.0)
        thing = wall.copy()
        thing[20:110, 60:100] = 2.0
        grey = np.where(thing < 2.5, 200, 50).astype(np.uint8)
        mapper = self.mapper()
        for _ in range(10):
            add(mapper, result(thing, right=grey))
        places, shown = mapper.points()
        assert (np.abs(places[shown == 200][:, 0] - 2) < 1e-5).sum() > 50
        for _ in range(40):
            add(mapper, result(wall, right=np.full_like(grey, 50)))
        places, shown = mapper.points()
        assert not (places[:, 0] < 2.9).any()
        floor = mapper.floor()
        x_m = (np.argwhere(floor.occupied)[:, 0] + 0.5) * 0.05 + floor.x_m
        assert x_m.min() > 2.8

    def test_only_what_moves_now_goes_in_and_only_near_things(self):
        mapper = self.mapper()
        for _ in range(6):
            add(mapper, result(wall_depth(STILL, 3.0), moved=np.zeros((120, 160), np.bool_)))
        assert not len(mapper.points()[0])
        for _ in range(6):
            add(mapper, result(wall_depth(STILL, 6.0)))  # 0.25 px are 0.5 m there
        assert not len(mapper.points()[0])
        assert not mapper.floor().occupied.any()
        assert mapper.floor().free.any()

    def test_floor_and_ceiling_stay_and_are_not_in_the_way(self):
        """A wall 2.5 m ahead, from the floor to a ceiling half a metre above the camera."""
        up = (RIG.cy - np.arange(120)) / RIG.focal_px
        with np.errstate(divide="ignore"):
            depth_m = np.minimum(2.5, np.where(up < 0, 0.6, 0.5) / np.abs(up))
        pose = Pose(0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 1.0)
        mapper = self.mapper(robot_below_m=0.4, robot_above_m=0.3)
        for _ in range(6):
            add(mapper, result(np.repeat(depth_m[:, None], 160, axis=1), pose))
        floor = mapper.floor()
        x_m = (np.argwhere(floor.occupied)[:, 0] + 0.5) * 0.05 + floor.x_m
        np.testing.assert_allclose(x_m, 2.5, atol=0.16)
        assert floor.free.any()
        places, _ = mapper.points()
        for height_m in (0.0, 1.1):
            flat = (np.abs(places[:, 2] - height_m) < 1e-5) & (np.abs(places[:, 1]) < 0.3)
            assert (places[flat, 0] < 1.6).sum() > 20  # where the way is free
        lower, _ = mapper.points(top_m=0.4)
        np.testing.assert_array_equal(lower, places[places[:, 2] < 1.0])
        assert 0 < len(lower) < len(places)

    @pytest.mark.parametrize("reference", ["right", "left"])
    def test_the_free_space_begins_at_the_camera(self, reference):
        rig = dataclasses.replace(RIG, baseline_m=0.5)
        mapper = Mapper(Settings(reference=reference), rig, 0.05)
        pose = Pose(0.0, 0.0, 1.2, *quaternion((0, 0, 1), math.pi / 2))  # x is to the right
        add(mapper, result(np.full((120, 160), 3.0), pose), reference, rig)
        add(mapper, result(np.full((120, 160), 3.0), pose), reference, rig)
        floor = mapper.floor()
        x_m, y_m = ((np.argwhere(floor.free) + 0.5) * 0.05 + (floor.x_m, floor.y_m)).T
        eye_m = 0.25 if reference == "right" else -0.25
        for low_m, high_m in ((0.2, 0.6), (1.0, 2.0)):
            assert x_m[(low_m < y_m) & (y_m < high_m)].mean() == pytest.approx(eye_m, abs=0.03)

    def test_it_grows_with_the_area_and_not_with_time(self):
        mapper = self.mapper()
        sizes = []
        for _ in range(3):
            for step in range(20):
                pose = Pose(0.1 * step, 0.0, 1.2, 0.0, 0.0, 0.0, 1.0)
                add(mapper, result(wall_depth(pose, 4.0), pose))
            mapper.points()
            known = mapper.known
            sizes.append((known.grid.evidence.nbytes, len(known.cloud.key), len(known.recent.key)))
        assert sizes[0][2] == 0
        assert len(set(sizes)) == 1

    def test_a_corridor_from_true_depth(self):
        corridor = Corridor(2.0, 14.0)
        camera = stereo_cameras(RIG)[1]
        mapper = self.mapper()
        for frame in range(0, 2 * FRAMES_PER_SIDE, 5):
            pose: RobotPose = corridor.path(frame)
            depth_m = corridor.render(pose, camera).depth_m
            for _ in range(2):
                add(mapper, result(depth_m, pose.rig_pose))
        floor = mapper.floor()
        cells = (np.argwhere(floor.occupied) + 0.5) * 0.05 + (floor.x_m, floor.y_m)
        square_m = np.abs(cells).max(axis=1)
        to_outer, to_inner = (
            np.abs(square_m - corridor.outer_m),
            np.abs(square_m - corridor.inner_m),
        )
        assert (np.minimum(to_outer, to_inner) < 0.15).mean() > 0.97
        right = cells[(to_outer < 0.15) & (cells[:, 0] > corridor.outer_m - 0.2)]
        seen_m = np.unique(np.floor(right[:, 1] / 0.1))
        assert len(seen_m) * 0.1 > 0.9 * 2 * corridor.outer_m


class TestPicture:
    occupied = np.array([[0, 0], [0, 1], [0, 0]], np.bool_)
    free = np.array([[1, 1], [0, 0], [0, 0]], np.bool_)
    floor = Floor(occupied, free, x_m=-1.0, y_m=2.0, cell_m=0.5)

    def test_x_to_the_right_and_y_upward(self):
        assert map_png(self.floor).tolist() == [[254, 0, 205], [254, 205, 205]]

    def test_the_sheet_shows_the_cells_larger_below_a_title_and_above_a_scale(self):
        sheet = map_sheet(self.floor, np.zeros((0, 2)))
        times = 960 // 3
        assert sheet.shape[1] == 3 * times
        ink = np.flatnonzero((sheet[:, times + 5] == 0).all(axis=1))
        assert len(ink) == times  # the occupied cell, upper row, middle column
        assert len(sheet) > 2 * times + 60

    def test_map_server_reads_what_was_meant(self):
        """By the words of map_server: p = (255 - v) / 255; origin is the lower left corner."""
        lines = map_yaml(self.floor, "map.png").splitlines()
        facts = dict(line.split(": ") for line in lines)
        assert facts["image"] == "map.png"
        assert facts["negate"] == "0"
        assert facts["mode"] == "trinary"
        picture = map_png(self.floor)
        chance = (255 - picture.astype(float)) / 255
        occupied, free = (
            chance > float(facts["occupied_thresh"]),
            chance < float(facts["free_thresh"]),
        )
        x_m, y_m, yaw_rad = (float(each) for each in facts["origin"].strip("[]").split(","))
        scale_m = float(facts["resolution"])
        assert yaw_rad == 0
        ((row, column),) = np.argwhere(occupied)
        place = x_m + (column + 0.5) * scale_m, y_m + (picture.shape[0] - row - 0.5) * scale_m
        assert place == (-0.25, 2.75)  # the middle of cell (1, 1)
        assert free.tolist() == [[True, False, False], [True, False, False]]


class TestFiles:
    def sink(self, tmp_path, frames=6, **output):
        stream = RunContext(Fraction(1, 25), Settings(), RIG, OutputSettings(**output))
        sink = OUTPUTS["map"].open(tmp_path, stream)
        for _ in range(frames):
            sink.write(step_of(result(wall_depth(STILL, 3.0)), RIG))
        return sink

    def test_nothing_is_there_before_all_is(self, tmp_path):
        sink = self.sink(tmp_path, map_cell_m=0.1)
        assert not list(tmp_path.iterdir())
        sink.close()
        assert {path.name for path in tmp_path.iterdir()} == {
            "map.ply",
            "map.png",
            "map.yaml",
            "map-sheet.png",
        }
        assert "resolution: 0.1\n" in (tmp_path / "map.yaml").read_text()
        picture = cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(picture)) == {0, 205, 254}
        found = np.array(read_ply((tmp_path / "map.ply").read_bytes()))
        np.testing.assert_allclose(found[:, 0], 3.0, atol=1e-6)

    def test_a_map_of_nothing_is_one(self, tmp_path):
        self.sink(tmp_path, frames=0).close()
        assert read_ply((tmp_path / "map.ply").read_bytes()) == []
        assert cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED).tolist() == [[205]]

    @pytest.mark.parametrize("keep", [True, False])
    def test_ended_early(self, tmp_path, keep):
        self.sink(tmp_path).abandon(keep=keep)
        names = {path.name for path in tmp_path.iterdir()}
        wanted = {f"map{end}.part" for end in (".ply", ".png", ".yaml", "-sheet.png")}
        assert names == (wanted if keep else set())

    def test_all_its_files_are_known_as_a_runs_own(self, tmp_path):
        prepared(tmp_path, ["map", "steering"])
        for name in (NAMING, "map.ply", "map.png"):
            (tmp_path / name).touch()
        part_of(tmp_path / "map.yaml").touch()
        prepared(tmp_path, ["steering"], overwrite=True)
        assert [path.name for path in tmp_path.iterdir()] == ["run.json.part"]
        (tmp_path / "map.yaml").touch()
        with pytest.raises(OutputError, match=r"map\.yaml is not from an earlier run"):
            prepared(tmp_path, ["map"], overwrite=True)


def motionstereo(*arguments):
    return CliRunner().invoke(cli, [str(each) for each in arguments])


@pytest.fixture(scope="module")
def drive_out(tmp_path_factory):
    out = tmp_path_factory.mktemp("drive") / "out"
    done = motionstereo("drive", out, "--max-frames", 25, "--width", 160, "--height", 120)
    assert done.exit_code == 0, done.output
    return out


def recorded(out):
    return (out / "left.mkv", out / "right.mkv", "--rig", out / "rig.yaml", "--no-check")


def test_a_run_on_a_drive_gives_the_same_map(drive_out, tmp_path):
    poses = ("--poses", drive_out / "poses.txt", "--save", "map,points,steering")
    done = motionstereo("run", *recorded(drive_out), *poses, "-o", tmp_path)
    assert done.exit_code == 0, done.output
    for name in ("map.ply", "map.png", "map.yaml", "map-sheet.png"):
        assert (tmp_path / name).read_bytes() == (drive_out / name).read_bytes()
    assert len(read_ply((tmp_path / "map.ply").read_bytes())) > 100
    assert len(list((tmp_path / "points").iterdir())) == 25
    rows = csv.DictReader(io.StringIO((tmp_path / "steering.csv").read_text()))
    matched = [round(float(row["matched"]) * 160 * 120) for row in rows]
    found = [len(read_ply(path.read_bytes())) for path in sorted((tmp_path / "points").iterdir())]
    # The table has four decimals, and a disparity of 0 is no point.
    np.testing.assert_allclose(found, matched, atol=60)


def test_the_plan_shows_the_occupied_cells():
    world = DriveWorld(DriveSettings(corridor_width_m=2.0, corridor_length_m=14.0))
    plan, nothing = Plan(world), np.zeros((3, 2), np.bool_)
    cells = np.array([[0, 0], [0, 1], [0, 0]], np.bool_)
    # The occupied cell spans x 2..3 m and y 3..4 m, which is inside the inner square.
    before, after = (plan.draw(Floor(each, nothing, 1.0, 2.0, 1.0)) for each in (nothing, cells))
    rows, columns = np.nonzero((before != after).any(axis=2))
    assert (after[rows, columns] == 0).all()
    middle = before.shape[0] / 2
    assert len(rows) == 32 * 32
    # Its middle, at 32 px a metre from the world's; rows grow downward.
    assert columns.mean() + 0.5 - middle == pytest.approx(2.5 * 32, abs=1)
    assert rows.mean() + 0.5 - middle == pytest.approx(-3.5 * 32, abs=1)


@pytest.mark.parametrize("name", ["points", "map", "poses"])
def test_no_map_without_a_rig(drive_out, tmp_path, name):
    left, right, *_ = recorded(drive_out)
    out = tmp_path / "out"
    done = motionstereo("run", left, right, "--save", name, "-o", out)
    assert isinstance(done.exception, SettingsError)
    assert f"--save {name} needs --rig" in str(done.exception)
    assert not out.exists()


def test_a_drive_finds_the_walls():
    score = bench.score(DriveSettings(seed=0, laps=0.1), 0.05)
    assert score.true_cells > 0.9
    assert score.found_wall > 0.55
    assert score.true_points > 0.95
    lines = bench.summary({0: score}).splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["0", "mean", "least"]
    assert len({line.count("|") for line in lines}) == 1


def test_the_bench_measures_a_map_of_a_street():
    score = bench.street_score(1, 0.2, frames=8)
    assert score.occupied > 0.05
    assert score.right > 0.8
    assert score.free < 0.1
    assert score.on_way == 0
