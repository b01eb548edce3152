"""Own motion from two videos, against exact poses of rendered scenes."""

import itertools

import numpy as np
import pytest

from motionstereo_cli.rig.pose_forms import rotations
from motionstereo_cli.robot.alignment import (
    LEVELS,
    Keyframe,
    Lens,
    align,
    keyframe,
    nearness_of,
    pyramid,
)
from motionstereo_cli.robot.odometry import (
    BLOCK_FRAMES,
    ERROR_SIGMA_PX,
    NO_ERROR_SIGMA_PX,
    Pair,
    setting_out,
    step,
    travelled,
)
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings

RANGE_PX = 48
#: Axes of the right camera in the rig's.
ROBOT_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def lens_of(rig, error_px=0.0):
    focal = rig.focal_px, rig.fy_px
    return Lens(focal, rig.cx_of("right"), rig.cx + error_px, rig.cy, rig.baseline_m)


def of_right_camera(pose, rig):
    """A pose of the rig as the matrix (4, 4) of its right camera."""
    turn = rotations(np.array([[pose.qx, pose.qy, pose.qz, pose.qw]]))[0]
    place = np.array([pose.x_m, pose.y_m, pose.z_m]) + turn @ [0, -rig.baseline_m / 2, 0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn @ ROBOT_FROM_OPTICAL, place
    return matrix


def motions(pairs, lens, first=0, sigma=NO_ERROR_SIGMA_PX):
    state, last, found = None, None, []
    for number, pair in enumerate(pairs, first):
        state, motion = step(state, last, pair, number, lens, RANGE_PX, sigma)
        found.append(motion)
        last = pair
    return found


def path_of(found):
    path, poses = setting_out(), []
    for motion in found:
        path = travelled(path, motion)
        poses.append(path.pose)
    return path, poses


def scene(**given):
    settings = SimulateSettings(**{"width": 320, "height": 240, "noise_sigma": 1.5, **given})
    shots = list(render_scene(settings))
    pairs = [Pair(shot.right, shot.left) for shot in shots]
    return settings.rig, pairs, [of_right_camera(s.pose.rig_pose, settings.rig) for s in shots]


@pytest.fixture(scope="module")
def street():
    return scene(scene="street", frames="20", seed=7, street_winding_deg=25)


def drift(poses, true):
    """Distance by which the end is missed, as a share of the way, and the turn in degrees."""
    way = sum(np.linalg.norm((b - a)[:3, 3]) for a, b in itertools.pairwise(true))
    ends = [np.linalg.inv(each[0]) @ each[-1] for each in (poses, true)]
    off = np.linalg.inv(ends[1]) @ ends[0]
    cos = (np.trace(off[:3, :3]) - 1) / 2
    return np.linalg.norm(off[:3, 3]) / way, np.degrees(np.arccos(min(cos, 1)))


class TestPath:
    @pytest.mark.parametrize(
        ("given", "share", "degrees"),
        [
            ({"scene": "corridor", "frames": "90:130", "seed": 2}, 0.015, 1),
            ({"scene": "street", "frames": "12", "seed": 11, "flicker": 0.1}, 0.03, 0.3),
        ],
    )
    def test_ends_where_the_rig_is(self, given, share, degrees):
        rig, pairs, true = scene(**given)
        path, poses = path_of(motions(pairs, lens_of(rig)))
        off, turned = drift(poses, true)
        assert path.lost == 0
        assert off < share
        assert turned < degrees

    def test_of_a_street_is_good_to_half_a_percent(self, street):
        rig, pairs, true = street
        _, poses = path_of(motions(pairs, lens_of(rig)))
        off, turned = drift(poses, true)
        assert off < 0.005
        assert turned < 0.2

    def test_of_a_still_camera_does_not_move_at_all_whatever_crosses(self):
        rig, pairs, _ = scene(scene="cards", frames="16", seed=3)
        path, _ = path_of(motions(pairs, lens_of(rig)))
        assert np.array_equal(path.pose, np.eye(4))

    def test_a_slow_camera_is_not_a_still_one(self):
        rig, pairs, true = scene(
            scene="street", frames="12", seed=4, street_speed_m_s=0.2, noise_sigma=2
        )
        _, poses = path_of(motions(pairs, lens_of(rig)))
        assert drift(poses, true)[0] < 0.1

    def test_says_how_sure_it_is(self, street):
        rig, pairs, true = street
        path, poses = path_of(motions(pairs, lens_of(rig)))
        off = np.linalg.inv(poses[0]) @ poses[-1] - np.linalg.inv(true[0]) @ true[-1]
        sigma = np.sqrt(np.trace(path.covariance[:3, :3]))
        assert np.linalg.norm(off[:3, 3]) < 4 * sigma < 2


class TestMotion:
    def test_depends_on_the_frames_since_the_last_keyframe_only(self, street):
        rig, pairs, _ = street
        lens = lens_of(rig)
        whole, part = motions(pairs, lens), motions(pairs[5:], lens, first=5)
        for one, other in zip(whole[BLOCK_FRAMES + 1 :], part[BLOCK_FRAMES - 4 :], strict=True):
            assert np.array_equal(one.before_from_now, other.before_from_now)
            assert np.array_equal(one.per_error, other.per_error)
            assert one.measured_px == other.measured_px

    def test_is_unknown_before_a_blank_wall_and_known_again_behind_it(self, street):
        rig, pairs, true = street
        blank = np.full_like(pairs[0].right, 120)
        shown = [*pairs[:4], Pair(blank, blank), Pair(blank, blank), *pairs[4:8]]
        found = motions(shown, lens_of(rig))
        assert [motion is None for motion in found] == [False] * 4 + [True] * 3 + [False] * 3
        assert path_of(found[:6])[0].lost == 2
        for number in (7, 8, 9):
            wanted = np.linalg.inv(true[number - 3]) @ true[number - 2]
            assert np.allclose(found[number].before_from_now, wanted, atol=0.03)

    def test_of_a_blank_recording_is_unknown(self):
        blank = np.full((60, 80), 90, np.uint8)
        lens = Lens((70.0, 70.0), 39.5, 39.5, 29.5, 0.1)
        assert motions([Pair(blank, blank)] * 3, lens)[1:] == [None, None]

    def test_a_jump_to_another_place_is_no_motion(self, street):
        rig, pairs, _ = street
        other = scene(scene="corridor", frames="3", seed=1)[1]
        assert motions([*pairs[:3], *other], lens_of(rig))[3] is None


class TestConstantErrorOfDisparity:
    @pytest.mark.parametrize("error_px", [0.0, 0.3, 1.2, -0.6])
    def test_is_measured(self, street, error_px):
        rig, pairs, _ = street
        lens = lens_of(rig, error_px)
        path, _ = path_of(motions(pairs, lens, sigma=ERROR_SIGMA_PX))
        assert path.error_px == pytest.approx(error_px, abs=0.06)

    def test_that_is_small_is_made_good_by_the_path(self, street):
        rig, pairs, true = street
        found = motions(pairs, lens_of(rig, 0.2))
        uncorrected = [np.eye(4)]
        for motion in found[1:]:
            uncorrected.append(uncorrected[-1] @ motion.before_from_now)
        assert drift(path_of(found)[1], true)[0] < 0.6 * drift(uncorrected, true)[0]


def moved(points, motion, lens):
    """Where points of the right camera are seen in both views after a motion, one by one."""
    seen = []
    for x, y, nearness, _ in points.astype(float):
        depth_m = lens.focal_px[0] * lens.baseline_m / nearness
        X, Y, Z = motion[:3, :3] @ (x * depth_m, y * depth_m, depth_m) + motion[:3, 3]
        seen.append(
            (
                lens.focal_px[0] * X / Z + lens.right_cx_px,
                lens.focal_px[0] * (X + lens.baseline_m) / Z + lens.left_cx_px,
                lens.focal_px[1] * Y / Z + lens.cy_px,
            )
        )
    return np.array(seen)


class TestAlignment:
    LENS = Lens((150.0, 140.0), 81.0, 78.5, 59.0, 0.2)

    @staticmethod
    def hills(x, y):
        """A smooth grey without repetition."""
        return 120 + 40 * np.sin(x / 7 + np.sin(y / 19)) + 30 * np.sin(y / 9 + x / 31)

    def test_finds_the_motion_that_views_were_made_with(self):
        """Views of now are painted so that each point looks as it did before: the slow way."""
        rng = np.random.default_rng(1)
        motion = np.eye(4)
        motion[:3, 3] = 0.02, -0.01, -0.05
        motion[:3, :3] = rotations(np.array([[0.004, -0.01, 0.003, 1.0]]))[0]
        at = np.stack([rng.uniform(15, 145, 500), rng.uniform(15, 105, 500)], axis=1)
        rays = (at - [self.LENS.right_cx_px, self.LENS.cy_px]) / self.LENS.focal_px
        near = rng.uniform(4, 12, 500)
        points = np.column_stack([rays, near, np.full(500, 0.05)]).astype(np.float32)
        seen = moved(points, motion, self.LENS)
        # Grey between two views is made to agree at a point's places in both, by a grey of the
        # right view that is also the left one's where that point is.
        y, x = np.mgrid[:120, :160].astype(float)
        right = [self.hills(x * 2**k, y * 2**k)[: 120 >> k, : 160 >> k] for k in range(LEVELS)]
        right = [np.ascontiguousarray(level, np.float32) for level in right]
        flat = [np.full_like(level, 128) for level in right]
        grey = np.stack([self.hills(seen[:, 0], seen[:, 2])] * LEVELS).astype(np.float32)
        key = Keyframe(points, grey, np.array([1.0, 0.0, 1.0, 0.0]))
        found = align(key, right, flat, self.LENS, np.eye(4), 0.0, 1e6)
        assert np.allclose(found.motion, motion, atol=2e-3)
        assert found.score > 0.9

    def test_measures_what_the_right_view_is_displaced_by(self):
        y, x = np.mgrid[:60, :120].astype(float)
        right = self.hills(x * 3, y * 3).astype(np.float32)
        left = self.hills((x - 6.3) * 3, y * 3).astype(np.float32)
        places = np.array([[40, 30], [55, 20], [80, 41], [3, 30]], np.int32)
        lens = Lens((100.0, 100.0), 61.5, 60.0, 30.0, 0.1)
        found = nearness_of(right, left, places, lens, 20)
        assert found[:3, 0] == pytest.approx(6.3 + 1.5, abs=0.1)
        assert np.isnan(found[3]).all()  # at the border

    def test_too_few_points_are_none(self):
        lens = Lens((100.0, 100.0), 40.0, 40.0, 30.0, 0.1)
        levels = pyramid(np.full((60, 80), 77, np.uint8))
        assert keyframe(levels, levels, lens, 16) is None
