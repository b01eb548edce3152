"""The simulated robot: its world, its way, and what a drive writes."""

import csv
import json
import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from bench import drive as bench
from motionstereo_cli.__main__ import main
from motionstereo_cli.commands import cli
from motionstereo_cli.errors import MotionStereoError, SettingsError
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.simulate.camera import FloorPose, stereo_cameras
from motionstereo_cli.simulate.corridor import Corridor
from motionstereo_cli.simulate.drive import OUTPUTS, colours, driven
from motionstereo_cli.simulate.drive_world import (
    MAX_FORWARD_M,
    MAX_TURN_RAD,
    Command,
    DriveWorld,
    command,
    world_of,
)
from motionstereo_cli.simulate.settings import ROBOT_RADIUS_M, DriveSettings
from motionstereo_cli.simulate.walkers import (
    HEIGHT_M,
    RADIUS_M,
    SPEEDS_M_S,
    Walker,
    WalkerPaint,
    place_walkers,
    step,
)
from motionstereo_cli.sinks.scale import DepthScale
from motionstereo_cli.types import Steering

SMALL = {"width": 160, "height": 120}


def motionstereo(*arguments):
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def steering(steer_rad=0.0, depth_m=5.0):
    return Steering("ok", None, steer_rad, depth_m, None)


class TestRobot:
    def test_drives_on_where_the_way_is_free_and_turns_to_its_heading(self):
        assert command(steering()) == Command(MAX_FORWARD_M, 0.0)
        left = command(steering(steer_rad=0.1))
        assert left.turn_rad > 0
        assert 0 < left.forward_m < MAX_FORWARD_M

    def test_slows_down_before_things(self):
        ways = [command(steering(depth_m=d)).forward_m for d in (2.0, 1.5, 1.0, 0.5, 0.3)]
        assert ways[0] == MAX_FORWARD_M
        assert all(a > b for a, b in pairwise(ways))
        assert ways[-1] == 0

    @pytest.mark.parametrize("angle", [-1.0, 1.0])
    def test_where_the_way_is_unknown_it_turns_on_the_spot(self, angle):
        turning = Command(0.0, math.copysign(MAX_TURN_RAD, angle))
        assert command(steering(steer_rad=angle, depth_m=None)) == turning
        assert command(steering(steer_rad=angle)) == turning
        assert command(Steering("blind", None, None, None, None)) == Command(0.0, MAX_TURN_RAD)


class TestWorld:
    def world(self, **settings):
        return DriveWorld(DriveSettings(**{"noise_sigma": 0, **SMALL, **settings}))

    def test_seeds_differ_and_repeat(self):
        worlds = [self.world(seed=seed) for seed in (0, 1, 0)]
        sizes = [(w.corridor.width_m, w.lap_m, w.robot) for w in worlds]
        assert sizes[0] == sizes[2] != sizes[1]
        for each in range(20):
            world = self.world(seed=each)
            assert 2 <= world.corridor.width_m <= 3.5
            assert world.ended is None

    def test_straight_ahead_ends_at_a_wall_and_the_record_says_how_near(self):
        world = self.world(seed=0, corridor_width_m=3)
        while world.ended is None:
            world.act(Command(1.0, 0.0))  # more than it can
        assert world.ended == "touched a wall"
        assert world.path_m == pytest.approx(MAX_FORWARD_M * world.frames)
        assert -MAX_FORWARD_M < world.nearest_pass_m <= 0
        at = max(abs(world.robot.x_m), abs(world.robot.y_m))
        assert at == pytest.approx(world.corridor.outer_m - ROBOT_RADIUS_M, abs=MAX_FORWARD_M)

    @pytest.mark.parametrize("seed", [0, 1])  # one of either sense
    @pytest.mark.parametrize("sense", [1, -1])
    def test_laps_count_in_the_sense_it_set_out(self, seed, sense):
        """Along the middle line, corner by corner, with the yaw set by hand."""
        world = self.world(seed=seed, laps=1)
        ahead = 1 if math.cos(world.robot.yaw_rad) > 0 else -1
        middle_m = world.lap_m / 8
        corners = [(1, -1), (1, 1), (-1, 1), (-1, -1)][:: ahead * sense]
        for x, y in [*corners, corners[0]]:
            goal = np.array([x, y]) * middle_m
            while world.ended is None:
                here = np.array([world.robot.x_m, world.robot.y_m])
                way_m = float(np.hypot(*(goal - here)))
                if way_m < 1e-6:
                    break
                yaw_rad = math.atan2(*(goal - here)[::-1])
                world.robot = FloorPose(world.robot.x_m, world.robot.y_m, yaw_rad)
                world.act(Command(way_m, 0.0))
        assert world.ended == ("laps done" if sense > 0 else None)
        assert (world.laps >= 1) == (sense > 0)
        assert (world.laps < -0.9) == (sense < 0)

    def test_what_the_robot_sees_is_what_the_corridor_renders(self):
        world = self.world(seed=3)
        shot = world.shot()
        camera = stereo_cameras(world.settings.rig)[1]
        view = world.corridor.render(world.robot, camera)
        np.testing.assert_array_equal(shot.frame.right, np.rint(view.grey))
        rig = world.settings.rig
        np.testing.assert_allclose(shot.disparity_px, rig.focal_px * rig.baseline_m / view.depth_m)

    @pytest.mark.parametrize(
        "settings", [{"corridor_width_m": 0.5}, {"corridor_width_m": 3, "corridor_length_m": 5}]
    )
    def test_a_world_without_room_is_an_error(self, settings):
        with pytest.raises(SettingsError, match=r"no (room|corridor)"):
            DriveSettings(**settings)

    def test_the_narrowest_and_smallest_world_is_one(self):
        world = self.world(corridor_width_m=1.0, corridor_length_m=7.0)
        assert world.corridor.inner_m > 0
        assert world.ended is None


class TestWalkers:
    def walked(self, count, frames, robot, width_m=2.0, seed=0):
        corridor = Corridor(width_m, 14)
        rng = np.random.default_rng(seed)
        walkers = place_walkers(count, width_m, corridor.inner_m, robot, rng)
        for _ in range(frames):
            before = walkers
            walkers = [
                step(
                    walker,
                    robot,
                    robot_radius_m=ROBOT_RADIUS_M,
                    inner_m=corridor.inner_m,
                    outer_m=corridor.outer_m,
                    frame_s=0.1,
                )
                for walker in walkers
            ]
            yield corridor, before, walkers

    def test_never_walk_into_a_robot_at_rest_nor_out_of_the_corridor(self):
        robot = FloorPose(0.0, -(Corridor(2.0, 14).outer_m - 1.0), 0.0)
        moved = np.zeros(12)
        for corridor, before, after in self.walked(12, 1500, robot):
            for number, (old, new) in enumerate(zip(before, after, strict=True)):
                gap_m = new.distance_m(robot.x_m, robot.y_m) - RADIUS_M - ROBOT_RADIUS_M
                assert gap_m > 0.3
                square_m = max(abs(new.x_m), abs(new.y_m))
                assert corridor.inner_m + RADIUS_M < square_m < corridor.outer_m - RADIUS_M
                moved[number] += old.distance_m(new.x_m, new.y_m)
                assert old.distance_m(new.x_m, new.y_m) <= SPEEDS_M_S[1] * 0.1 + 1e-9
        assert (moved > 10).all()  # nobody gets stuck

    def scene(self, walker, pose):
        camera = stereo_cameras(DriveSettings(**SMALL).rig)[1]
        corridor = Corridor(3.0, 20.0)
        empty = corridor.render(pose, camera)
        paint = WalkerPaint(1, np.random.default_rng(0))
        return camera, empty, paint.render(empty, [walker], pose, camera, 11.0)

    def test_a_walker_has_its_size_and_distance(self):
        pose = Corridor(3.0, 20.0).path(10)
        walker = Walker(pose.x_m + 4.0, pose.y_m, 0.0, 1.0, crosses=False)
        camera, empty, view = self.scene(walker, pose)
        changed = view.depth_m != empty.depth_m
        rows, columns = np.nonzero(changed)
        near_m = 4.0 - RADIUS_M
        assert view.depth_m[changed].min() == pytest.approx(near_m, abs=0.01)
        width_px = 2 * camera.focal_px * math.tan(math.asin(RADIUS_M / 4.0))
        assert np.ptp(columns) + 1 == pytest.approx(width_px, abs=1.5)
        # The right camera sees it half a baseline further left, at the smaller column.
        middle = camera.cx - camera.focal_px * 0.06 / 4.0
        assert columns.mean() == pytest.approx(middle, abs=1)
        top = camera.cy - camera.focal_px * (HEIGHT_M - 1.2) / near_m
        assert rows.min() == pytest.approx(top, abs=1.5)
        assert (view.grey[changed] != empty.grey[changed]).mean() > 0.99
        far = cv2.dilate(changed.astype(np.uint8), np.ones((3, 3))) == 0
        np.testing.assert_array_equal(view.grey[far], empty.grey[far])

    def test_walls_hide_a_walker(self):
        pose = Corridor(3.0, 20.0).path(10)
        walker = Walker(pose.x_m + 4.0, pose.y_m + 3.5, 0.0, 1.0, crosses=False)
        _, empty, view = self.scene(walker, pose)
        np.testing.assert_array_equal(view.grey, empty.grey)
        np.testing.assert_array_equal(view.depth_m, empty.depth_m)

    def test_its_paint_stays_on_it_when_the_robot_turns(self):
        pose = Corridor(3.0, 20.0).path(10)
        walker = Walker(pose.x_m + 2.0, pose.y_m, 0.3, 1.0, crosses=False)
        turned = FloorPose(pose.x_m, pose.y_m, 0.1)
        rows = []
        for each in (pose, turned):
            _, empty, view = self.scene(walker, each)
            row = view.grey[60][(view.depth_m != empty.depth_m)[60]]
            rows.append(np.interp(np.linspace(0.1, 0.9, 20), np.linspace(0, 1, len(row)), row))
        assert np.abs(rows[0] - rows[1]).mean() < 0.25 * rows[0].std()


class TestTruthOfWalkers:
    def seen(self, walker):
        """Return what a shot says of a walker, after the robot drove 0.1 m in a frame."""
        world = DriveWorld(DriveSettings(seed=0, walkers=1, **SMALL))
        ahead = world.robot
        x_m, y_m = np.array([ahead.x_m, ahead.y_m]) + 3 * np.array(ahead.forward)
        world.walkers = [walker(x_m, y_m, ahead.yaw_rad)]
        world.act(Command(0.1, 0.0))
        return world.shot().objects

    def test_is_its_box_and_its_speed(self):
        (found,) = self.seen(lambda x, y, yaw: Walker(x, y, yaw + math.pi, 1.0, True))
        assert found.depth_m == pytest.approx(3 - 0.2 - RADIUS_M, abs=0.15)
        assert found.closing_mps == pytest.approx(2.0, abs=0.05)
        assert found.over_ground_mps == pytest.approx(1.0, abs=0.01)
        assert found.by_itself
        left, right = np.array([found.x, found.x + found.width]) / 160
        assert left < 0.5 < right
        assert found.width / 160 == pytest.approx(0.87 * 2 * RADIUS_M / 2.7, abs=0.03)

    def test_one_that_stands_does_not_move_by_itself(self):
        (found,) = self.seen(lambda x, y, yaw: Walker(x, y, yaw, 0.0, True))
        assert not found.by_itself
        assert found.over_ground_mps == 0
        assert found.closing_mps == pytest.approx(1.0, abs=0.05)

    def test_one_out_of_sight_has_no_row(self):
        assert self.seen(lambda x, y, yaw: Walker(-x, -y, yaw, 1.0, True)) == ()


def test_finds_its_way_round_a_corner():
    world = DriveWorld(DriveSettings(seed=0, laps=0.3))
    for _, found in driven(world, Settings()):
        world.act_on(found.steering)
    assert world.ended == "laps done"
    assert world.nearest_pass_m > 0.2
    assert world.path_m / world.laps < 1.2 * world.lap_m


@pytest.fixture(scope="module")
def drive_out(tmp_path_factory):
    out = tmp_path_factory.mktemp("drive") / "out"
    given = ("--max-frames", 25, "--walkers", 2, "--view", "--width", 160, "--height", 120)
    done = motionstereo("drive", out, *given)
    assert done.exit_code == 0, done.output
    assert "out of frames after 25 frames" in done.stderr
    return out


def test_a_drive_writes_all_it_promises(drive_out):
    assert {path.name for path in drive_out.iterdir()} == set(OUTPUTS)
    record = json.loads((drive_out / "drive.json").read_text())
    assert record["outputs"] == list(OUTPUTS)
    assert record["ended"] == "out of frames"
    assert (record["frames"], record["collisions"]) == (25, [])
    assert record["distance_m"] > 0.5
    with (drive_out / "steering.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["pts"] for row in rows] == [str(100 * n) for n in range(25)]
    assert rows[0]["status"] == "blind"
    assert rows[-1]["status"] == "ok"
    assert len((drive_out / "poses.txt").read_text().splitlines()) == 26
    plan = cv2.imread(str(drive_out / "plan.png"))
    blue = (plan == (200, 90, 20)).all(axis=2)
    assert blue.sum() > 100


def test_run_on_the_recordings_with_the_poses_gives_the_same_steering(drive_out, tmp_path):
    recordings = (drive_out / "left.mkv", drive_out / "right.mkv", "--rig", drive_out / "rig.yaml")
    poses = ("--poses", drive_out / "poses.txt", "--save", "steering", "--no-check")
    done = motionstereo("run", *recordings, *poses, "-o", tmp_path / "with")
    assert done.exit_code == 0, done.output
    steered = (tmp_path / "with" / "steering.csv").read_bytes()
    assert steered == (drive_out / "steering.csv").read_bytes()
    # Whatever else is saved.
    rest = ("--save", "objects,preview,report,map,own-charge", "-o", tmp_path / "all")
    assert motionstereo("run", *recordings, *poses, *rest).exit_code == 0
    assert (tmp_path / "all" / "steering.csv").read_bytes() == steered
    motionstereo("run", *recordings, "--save", "steering", "--no-check", "-o", tmp_path / "without")
    assert (tmp_path / "without" / "steering.csv").read_bytes() != steered


@pytest.mark.parametrize(
    ("keep", "words"),
    [(10, "the recording goes on to about 2.400 s"), (None, "line 3: 'x' is not a pose")],
)
def test_poses_that_do_not_fit_are_named_and_nothing_is_whole(drive_out, tmp_path, keep, words):
    lines = (drive_out / "poses.txt").read_text().splitlines()
    lines = [*lines[:2], "x"] if keep is None else lines[:keep]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    recordings = (drive_out / "left.mkv", drive_out / "right.mkv", "--rig", drive_out / "rig.yaml")
    out = tmp_path / "out"
    done = motionstereo("run", *recordings, "--poses", tmp_path / "poses.txt", "-o", out)
    assert isinstance(done.exception, MotionStereoError)
    assert words in str(done.exception)
    assert not out.exists()


def test_poses_need_a_rig(drive_out, tmp_path, capsys):
    recordings = (drive_out / "left.mkv", drive_out / "right.mkv")
    given = ("--poses", drive_out / "poses.txt", "-o", tmp_path / "o")
    assert main(["run", *map(str, (*recordings, *given))]) == 2
    assert "--poses need --rig" in capsys.readouterr().err


def test_only_a_former_drive_is_replaced(drive_out, tmp_path):
    few = ("--max-frames", 2, "--width", 64, "--height", 48)
    (tmp_path / "plan.png").write_bytes(b"mine")
    for options in ((), ("--overwrite",)):
        done = motionstereo("drive", tmp_path, *few, *options)
        assert isinstance(done.exception, MotionStereoError)
        assert (tmp_path / "plan.png").read_bytes() == b"mine"
        assert len(list(tmp_path.iterdir())) == 1
    (tmp_path / "plan.png").rename(tmp_path / "my.png")
    for _ in range(2):
        assert motionstereo("drive", tmp_path, *few, "--overwrite").exit_code == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {*OUTPUTS, "my.png"} - {"drive.mp4"}
    record = json.loads((tmp_path / "drive.json").read_text())
    assert {*record["outputs"], "my.png"} == names


@pytest.mark.parametrize("world", ["corridor", "office"])
def test_the_colours_of_a_drive_are_for_what_is_around(world):
    driven = world_of(DriveSettings(world=world, **SMALL))
    before, output = driven.robot, colours(driven)
    depth_m = driven.settings.rig.depth_m(driven.around_px())
    assert driven.robot is before
    near_m, far_m = output.near_m, output.far_m
    scale = DepthScale.of(Settings(), output, driven.settings.rig)
    places = np.array([scale.place(each) for each in depth_m[::97]])
    assert ((places > 0.05) & (places < 0.95)).mean() > 0.9
    assert 2 * near_m <= far_m


class TestBench:
    def test_random_steering_ends_at_a_wall(self):
        row = bench.drive_once("random steering", DriveSettings(seed=0, laps=2, **SMALL))
        assert row["ended"] == "touched a wall"
        assert float(row["laps"]) < 1

    def test_the_table_says_who_finished(self, tmp_path, capsys):
        rows = tmp_path / "rows.csv"
        few = ["--seeds", "1", "--laps", "0.01", "--rows", str(rows)]
        bench.main([*few, "--depths", "true depth", "StereoSGBM"])
        first = rows.read_bytes()
        table = capsys.readouterr().out.splitlines()
        assert table[2].startswith("| true depth | 1 of 1 | 0 | 0.01 |")
        bench.main([*few, "--depths", "true depth", "StereoSGBM"])  # nothing is driven again
        assert rows.read_bytes() == first
        assert capsys.readouterr().out.splitlines() == table
