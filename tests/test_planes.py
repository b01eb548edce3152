"""Planes on smooth surfaces, disparity between whole px, and half the rows."""

import cv2
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from motionstereo_cli.compiled import planes as loops
from motionstereo_cli.method.confidence import margin_of_planes, sigma_px
from motionstereo_cli.method.planes import Surface, with_planes
from motionstereo_cli.method.refine import refined
from motionstereo_cli.method.rows import halved, halved_exactly, whole, without_fringes
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.types import StereoFrame

NAN = np.float32(np.nan)


def texture(rows, width, seed=0, sigma=1.5):
    white = np.random.default_rng(seed).standard_normal((rows, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), sigma)
    return 120 + 30 * smooth / smooth.std()


def sure(matched):
    """Large margins for all matches."""
    return np.full(matched.shape, 1000, np.float32)


class TestPlanes:
    @settings(max_examples=40)
    @given(
        st.integers(0, 10_000),
        st.sampled_from([(6, 4, 2, 1, 1, 3, 2), (9, 5, 3, 2, 2, 4, 3), (3, 3, 1, 1, 0, 1, 1)]),
        st.integers(1, 5),
    )
    def test_planes_are_the_oracles(self, seed, sizes, rounds):
        rng = np.random.default_rng(seed)
        rows, width = 11, 17
        y, x = np.mgrid[:rows, :width]
        slopes = rng.uniform(-0.4, 0.4, 2)
        disparity = (9 + slopes[0] * x + slopes[1] * y).astype(np.float32)
        disparity += rng.normal(0, 0.3, disparity.shape).astype(np.float32)
        disparity = np.round(64 * disparity) / 64
        disparity[rng.random(disparity.shape) < 0.2] = 15
        disparity[rng.random(disparity.shape) < 0.2] = np.nan
        halves = rng.integers(0, 3, disparity.shape).astype(np.uint8)
        grey = rng.integers(100, 112, disparity.shape).astype(np.float32)
        where = rng.random(disparity.shape) < 0.7
        window = loops.Window(*sizes, 8, 1.0, rounds, 0.5, 0.7, 1.0)
        rule = loops.Rule(True, *[np.inf] * 4, True, False)
        found = np.full((3, rows, width), np.nan, np.float32)
        samples = loops.Samples(rows, width, 32)
        loops.fit(
            *(disparity, halves, grey, where.view(np.uint8), window, rule, samples, *found),
        )
        assert np.isnan(found[:, ~where]).all()
        for top, left in np.ndindex(-(-rows // sizes[6]), -(-width // sizes[5])):
            block = np.s_[
                top * sizes[6] : (top + 1) * sizes[6], left * sizes[5] : (left + 1) * sizes[5]
            ]
            inside = np.argwhere(where[block])
            if not len(inside):
                continue
            middle = (np.array(where[block].shape) - 1) / 2
            offset = min(inside.tolist(), key=lambda p: (np.abs(p - middle).sum(), p))
            place = np.add(offset, [block[0].start, block[1].start])
            wanted = oracles.plane(disparity, halves / 2, grey, *place.tolist(), window)
            np.testing.assert_allclose(found[:, place[0], place[1]], wanted, rtol=0, atol=2e-3)

    def wall(self, slope=0.1):
        """A smooth wall between textured ones, slanted all along: truth, disparity as matched."""
        rows, width = 40, 160
        truth = np.broadcast_to(5 + slope * np.arange(width, dtype=np.float32), (rows, width))
        grey = texture(rows, width)
        grey[:, 60:100] = 120
        matched = truth.copy()
        matched[:, 60:100] += np.random.default_rng(1).choice([0, 3], (rows, 40), p=[0.8, 0.2])
        return truth, grey, matched.astype(np.float32)

    @pytest.mark.parametrize("age", [0, 5])
    def test_a_smooth_wall_goes_on_between_textured_ones(self, age):
        truth, grey, matched = self.wall()
        everywhere = np.ones(truth.shape, np.bool_)
        surface = Surface.of(grey, everywhere, np.full(truth.shape, age, np.uint8))
        assert surface.smooth[:, 68:92].all()
        assert surface.smooth[:, :50].mean() < 0.05
        found, share = with_planes(
            matched, sure(matched), np.full_like(matched, np.nan), surface, 64
        )
        wrong = np.abs(found - truth)[:, 68:92] > 1
        assert wrong.mean() < 0.05 < (np.abs(matched - truth)[:, 68:92] > 1).mean()
        assert (share[:, 68:92] > 0.6).all()
        seen = np.arange(truth.shape[1]) + matched <= truth.shape[1] - 1
        assert np.isnan(share[seen & ~surface.smooth]).all()

    def test_what_is_painted_on_a_moving_wall_tells_of_it_whatever_its_grey(self):
        """Old trails keep the disparity of the edge that made them; the wall has gone on."""
        rows, width = 40, 240
        truth = np.broadcast_to(5 + 0.1 * np.arange(width, dtype=np.float32), (rows, width))
        grey = np.full((rows, width), 180, np.float32)
        painted = np.arange(width) // 10 % 10 == 0
        grey[:, painted] = 60
        matched = np.where(
            cv2.dilate(painted[None].view(np.uint8), np.ones((1, 25))) > 0, truth, 20
        )
        surface = Surface.of(grey, np.ones(truth.shape, np.bool_), np.zeros(truth.shape, np.uint8))
        wall = np.s_[:, 125:185]
        assert surface.smooth[wall].all()
        trails = np.full_like(matched, 20)
        found, share = with_planes(matched.astype(np.float32), sure(matched), trails, surface, 64)
        assert (np.abs(found - truth)[wall] < 0.1).all()
        assert (share[wall] > 0.8).all()

    def test_trails_that_agree_with_the_matching_nearby_are_taken(self):
        truth, grey, matched = self.wall()
        matched[:, 60:100] = np.nan
        surface = Surface.of(grey, np.ones(truth.shape, np.bool_), np.zeros(truth.shape, np.uint8))
        found, _ = with_planes(matched, sure(matched), truth.copy(), surface, 64)
        assert (np.abs(found - truth)[:, 68:92] < 0.5).all()

    @pytest.mark.parametrize("margin", [100, 1000])
    def test_beyond_the_left_views_border_sure_matches_beside_it_decide(self, margin):
        rows, width = 24, 160
        grey = texture(rows, width)
        surface = Surface.of(grey, np.ones(grey.shape, np.bool_), np.zeros(grey.shape, np.uint8))
        x = np.arange(width, dtype=np.float32)
        matched = np.tile(10 + 0.1 * x, (rows, 1))
        seen = x + matched[0] <= width - 1
        matched[:, ~seen] += 3
        margins = np.full_like(matched, margin)
        found, share = with_planes(matched, margins, np.full_like(matched, NAN), surface, 64)
        np.testing.assert_array_equal(found[:, seen], matched[:, seen])
        beyond = np.s_[:, np.flatnonzero(~seen)]
        if margin < 500:
            assert np.isnan(found[beyond]).all()
        else:
            assert (np.abs(found - 10 - 0.1 * x)[beyond] < 0.5).mean() > 0.9
            assert (share[beyond] > 0.7).mean() > 0.9


class TestRefined:
    @settings(max_examples=15)
    @given(st.integers(0, 10_000))
    def test_steps_are_the_oracles(self, seed):
        rng = np.random.default_rng(seed)
        rows, width = 10, 26
        right, left = (rng.integers(90, 120, (rows, width)).astype(np.float32) for _ in range(2))
        disparity = (4 + rng.integers(0, 8, (rows, width)) / 4).astype(np.float32)
        disparity[rng.random(disparity.shape) < 0.15] = np.nan
        disparity[:, rng.integers(width) :] += 2 * rng.integers(3)
        found, wanted = refined(disparity, right, left), oracles.refined(disparity, right, left)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=0.04)  # cv2.remap: 1/32 px

    @pytest.mark.parametrize("true_px", [4.0, 4.3, 4.5, 4.8])
    def test_whole_px_become_what_the_views_say(self, true_px):
        wall = texture(30, 120, sigma=2)
        shift = np.array([[1, 0, -true_px], [0, 1, 0]], np.float32)
        right = cv2.warpAffine(wall, shift, (120, 30), flags=cv2.INTER_CUBIC)
        found = refined(np.full(wall.shape, round(true_px), np.float32), right, wall)
        assert np.abs(np.median(found[:, 10:100]) - true_px) < 0.1

    def test_unknown_stays_unknown_and_borders_stay_where_they_are(self):
        disparity = np.full((20, 60), 4, np.float32)
        disparity[:, 30:] = 12
        disparity[5, 5] = np.nan
        found = refined(disparity, texture(20, 60), texture(20, 60, seed=1))
        np.testing.assert_array_equal(np.isnan(found), np.isnan(disparity))
        np.testing.assert_array_equal(found[:, 23:37], disparity[:, 23:37])


class TestRows:
    @settings(max_examples=60)
    @given(
        st.sampled_from([1, 4, 5]),
        st.data(),
    )
    def test_rows_are_the_oracles(self, height, data):
        rows = (height + 1) // 2
        values = st.sampled_from([NAN, 0, 1, 2.25, 6])
        disparity = data.draw(arrays(np.float32, (rows, 4), elements=values))
        grey = data.draw(arrays(np.uint8, (height, 4), elements=st.integers(0, 12)))
        half_grey = halved_exactly(grey)
        found = whole(disparity, half_grey, grey)
        np.testing.assert_array_equal(found, oracles.whole_rows(disparity, half_grey, grey))

    def test_halves_are_means_and_an_odd_row_stands_alone(self):
        view = np.array([[1, 5], [3, 6], [9, 9]], np.uint8)
        np.testing.assert_array_equal(halved_exactly(view), [[2, 5.5], [9, 9]])
        assert np.abs(halved(view).astype(float) - halved_exactly(view)).max() <= 0.5

    @settings(max_examples=40)
    @given(st.tuples(st.integers(1, 9), st.integers(1, 9)), st.integers(0, 10_000))
    def test_the_majority_around_is_that_of_sums_over_windows(self, shape, seed):
        rng = np.random.default_rng(seed)
        where = rng.random(shape) < 0.7
        disparity = np.where(rng.random(shape) < 0.5, np.float32(3), NAN)
        known, could = (
            cv2.boxFilter(
                mask.astype(np.float32), -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT
            )
            for mask in (where & ~np.isnan(disparity), where)
        )
        wanted = np.where(where & (2 * known >= could - 0.5), disparity, NAN)
        np.testing.assert_array_equal(without_fringes(disparity, where), wanted)

    def test_fringes_go_and_areas_stay(self):
        known = np.full((12, 20), NAN)
        known[3:9, 3:12] = 5
        known[6, 12:18] = 5
        found = without_fringes(known, np.ones(known.shape, np.bool_))
        assert np.isnan(found[6, 14:]).all()
        assert (found[4:8, 4:11] == 5).all()


class TestSigma:
    def test_a_surer_disparity_has_a_smaller_sigma(self):
        flat = np.full((5, 50), 7, np.float32)
        chance = np.broadcast_to(np.linspace(0, 1, 50, dtype=np.float32), flat.shape)
        sigmas = sigma_px(chance, flat)
        assert (np.diff(sigmas) <= 0).all()
        assert sigmas[0, 0] > 0.8
        assert sigmas[-1, -1] < 0.1
        assert np.isnan(sigma_px(np.full((1, 1), NAN), np.full((1, 1), NAN))).all()

    def test_at_the_border_of_an_object_sigma_is_larger(self):
        disparity = np.full((12, 40), 4, np.float32)
        disparity[:, 20:] = 12
        sigmas = sigma_px(np.full_like(disparity, 0.95), disparity)
        assert (sigmas[:, 18:22] > 8 * sigmas[0, 0]).all()
        assert (sigmas[:, :18] == sigmas[0, 0]).all()
        assert (sigmas[:, 22:] == sigmas[0, 0]).all()

    def test_a_plane_that_more_samples_agree_with_is_surer(self):
        margins = margin_of_planes(np.array([[0.6, 0.8, 1]], np.float32))[0]
        assert (np.diff(margins) > 50).all()

    def test_most_errors_are_within_one_and_95_of_100_within_two(self):
        scene = SimulateSettings(
            scene="layers", frames="10", width=240, height=160, noise_sigma=1.5, seed=107
        )
        shots = list(render_scene(scene))
        frames = (StereoFrame(i, i, None, s.left, s.right) for i, s in enumerate(shots))
        *_, last = process(frames)
        away = np.abs(last.disparity_px - shots[-1].disparity_px) / last.sigma_px
        away = away[~np.isnan(away)]
        assert 0.68 < (away <= 1).mean() < 0.93
        assert (away <= 2).mean() == pytest.approx(0.95, abs=0.04)
