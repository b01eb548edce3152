"""Trajectories in the TUM format, and `run --poses`."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.poses import HEAD, as_written, format_pose, read_poses
from motionstereo_cli.types import Pose, StereoFrame


def yawed(yaw_rad, x_m=0.0, y_m=0.0):
    return Pose(x_m, y_m, 1.2, 0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def written(tmp_path, *lines):
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@given(st.floats(-math.pi, math.pi), st.floats(-1000, 1000))
def test_a_pose_reads_back_as_written(yaw_rad, x_m):
    pose = as_written(yawed(yaw_rad, x_m))
    assert pose == as_written(pose)
    assert pose.x_m == pytest.approx(x_m, abs=1e-6)
    assert math.remainder(pose.yaw_rad - yaw_rad, math.tau) == pytest.approx(0, abs=1e-8)


def test_at_its_own_times_a_trajectory_gives_its_poses_exactly(tmp_path):
    poses = [as_written(yawed(0.1 * n, 0.3 * n)) for n in range(4)]
    lines = [format_pose(n / 30, pose).strip() for n, pose in enumerate(poses)]
    trajectory = read_poses(written(tmp_path, HEAD.strip(), "", *lines))
    assert [trajectory.at(time_s) for time_s in trajectory.time_s] == poses


def test_between_its_times_it_runs_straight_and_turns_the_short_way(tmp_path):
    low, high = yawed(math.radians(170)), yawed(math.radians(-170), 2.0, 4.0)
    flipped = Pose(high.x_m, high.y_m, high.z_m, -high.qx, -high.qy, -high.qz, -high.qw)
    lines = (format_pose(1, low).strip(), format_pose(2, flipped).strip())
    pose = read_poses(written(tmp_path, *lines)).at(1.5)
    assert (pose.x_m, pose.y_m, pose.z_m) == pytest.approx((1, 2, 1.2))
    assert abs(pose.yaw_rad) == pytest.approx(math.pi)


@pytest.mark.parametrize("time_s", [0.9, 2.1])
def test_a_frame_outside_the_trajectory_is_an_error_that_names_both(tmp_path, time_s):
    lines = [format_pose(t, yawed(0)).strip() for t in (1, 2)]
    trajectory = read_poses(written(tmp_path, *lines))
    assert trajectory.at(2.01) == trajectory.at(2)  # containers round their times
    with pytest.raises(InputError, match=rf"{time_s}00 s.* 1\.000 to 2\.000 s"):
        trajectory.at(time_s)


def test_a_frame_without_time_has_no_pose(tmp_path):
    trajectory = read_poses(written(tmp_path, "0 0 0 0 0 0 0 1"))
    frame = StereoFrame(0, 0, None, np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.uint8))
    with pytest.raises(InputError, match="do not say when"):
        trajectory.of(frame)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["# only talk"], "has no poses"),
        (["0 0 0 0 0 0 0 1", "", "1 0 0 0 0 0 0"], "line 3: .* is not a pose"),
        (["0 0 0 0 0 0 0 1", "1 x 0 0 0 0 0 1"], "line 2: .* is not a pose"),
        (["0 0 0 0 0 0 0 1", "1 nan 0 0 0 0 0 1"], "line 2: .* is not a pose"),
        (["0 0 0 0 0 0 0 2"], "line 1: .* is not a pose"),
        (["1 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], "line 2: time 1 s does not come after 1 s"),
    ],
)
def test_what_is_no_trajectory_is_named_with_its_line(tmp_path, lines, words):
    with pytest.raises(InputError, match=words):
        read_poses(written(tmp_path, *lines))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_poses(tmp_path / "nowhere")
