"""The dense matcher, and the grey that both cameras agree on."""

import cv2
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from motionstereo_cli.compiled import bilateral
from motionstereo_cli.compiled import dense as loops
from motionstereo_cli.method import dense
from motionstereo_cli.method.balance import balanced
from motionstereo_cli.method.borders import hidden_filled, trimmed
from motionstereo_cli.method.contrast import contrast, noise_of
from motionstereo_cli.method.dense import WEIGHTS, match_dense, semi_global, smoothed, weights_of
from motionstereo_cli.method.rows import enlarged, every_second, halved, halved_mask, reduced

everywhere = np.ones((48, 96), np.bool_)
nothing_proposed = np.full((24, 96), np.nan, np.float32)
no_weights = np.zeros((24, 96), np.int16)


def textured(height=48, width=96, grain_px=1.5, seed=0):
    """Grey noise of some grain, around 120."""
    white = np.random.default_rng(seed).standard_normal((height, width + 40)).astype(np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), grain_px)
    return (120 + 35 * smooth / smooth.std()).clip(0, 255).astype(np.uint8)


def views(disparity, **texture):
    """The right and the left view of a wall."""
    wall = textured(**texture)
    return wall[:, 40:], wall[:, 40 - disparity : wall.shape[1] - disparity]


class TestContrast:
    def test_a_flat_image_has_none(self):
        assert (contrast(np.full((40, 60), 77, np.uint8), 15, 12) == 128).all()

    @pytest.mark.parametrize("change", [20, -30])
    def test_brightness_does_not_matter(self, change):
        grey = textured(80, 120).clip(60, 190)
        brighter = (grey.astype(int) + change).astype(np.uint8)
        assert np.abs(contrast(grey, 15, 12).astype(int) - contrast(brighter, 15, 12)).max() <= 1

    def test_half_the_contrast_is_more_than_half_of_it(self):
        grey = textured(80, 120)
        half = (60 + grey / 2).astype(np.uint8)
        whole, halved = (contrast(g, 15, 2).astype(float).std() for g in (grey, half))
        assert halved > 0.75 * whole

    def test_a_floor_keeps_weak_texture_weak(self):
        weak = (120 + (textured(80, 120).astype(int) - 120) // 20).astype(np.uint8)
        assert contrast(weak, 15, 12).std() < contrast(weak, 15, 1).std() / 2

    def test_noise_is_no_contrast(self):
        rng = np.random.default_rng(0)
        calm, noisy = (np.rint(120 + s * rng.standard_normal((96, 128))) for s in (1, 6))
        spreads = [contrast(image.astype(np.uint8), 15, 6).std() for image in (calm, noisy)]
        assert spreads[1] < 1.5 * spreads[0]

    @pytest.mark.parametrize("sigma", [1.5, 4])
    def test_noise_is_measured(self, sigma):
        ramp = np.linspace(40, 200, 160)[None] + np.zeros((128, 1))
        noise = sigma * np.random.default_rng(1).standard_normal(ramp.shape)
        assert noise_of(np.rint(ramp + noise).astype(np.uint8)) == pytest.approx(sigma, rel=0.15)

    def test_no_window_returns_the_grey(self):
        grey = textured()
        assert contrast(grey, 0, 12) is grey

    @pytest.mark.parametrize("size", [(1, 1), (1, 30), (7, 3)])
    def test_tiny_images_have_one_too(self, size):
        assert contrast(np.full(size, 9, np.uint8), 15, 12).shape == size


class TestSmoothing:
    @given(
        st.tuples(st.integers(1, 9), st.integers(1, 40)).flatmap(
            lambda size: arrays(np.uint8, size, elements=st.integers(0, 255))
        )
    )
    def test_pixels_are_the_oracles(self, view):
        wanted = oracles.smoothed(view)
        np.testing.assert_array_equal(smoothed(view), wanted)
        plain = np.empty_like(view)
        bilateral.smooth(view, bilateral.Workspace(view.shape[1]), plain)
        np.testing.assert_array_equal(plain, wanted)

    def test_it_is_about_a_gaussian_bilateral_filter(self):
        noise = np.rint(3 * np.random.default_rng(0).standard_normal((60, 80)))
        view = (textured(60, 80, 4)[:, :80] + noise).clip(0, 255).astype(np.uint8)
        gaussian = cv2.bilateralFilter(view, 5, 10, 1.5)
        assert np.abs(smoothed(view).astype(int) - gaussian).max() <= 4
        assert np.abs(smoothed(view) - gaussian.astype(float)).mean() < 0.3


class TestSlopes:
    @given(
        arrays(
            np.uint8, st.tuples(st.integers(1, 5), st.integers(1, 9)), elements=st.integers(0, 255)
        )
    )
    def test_slopes_are_half_of_what_sobels_filter_gives(self, grey):
        wanted = np.clip(cv2.Sobel(grey, cv2.CV_16S, 1, 0), -80, 80) // 2
        np.testing.assert_array_equal(dense.slopes_of(grey), wanted)


class TestBalance:
    @pytest.mark.parametrize("size", [(160, 240), (96, 640), (160, 1920)])
    def test_equal_views_stay_as_they_are(self, size):
        right, left = views(10, height=size[0], width=size[1])
        assert balanced(right, left, 32) is left

    @pytest.mark.parametrize("size", [(160, 240), (160, 640), (160, 1920)])
    @pytest.mark.parametrize(("gain", "offset"), [(1, 16), (0.9, 20), (1.1, -25)])
    def test_a_brighter_view_becomes_as_bright(self, gain, offset, size):
        right, left = views(10, height=size[0], width=size[1], grain_px=size[1] / 160)
        changed = np.rint(left * gain + offset).clip(0, 255).astype(np.uint8)
        seen = (changed > 0) & (changed < 255)
        assert np.abs(balanced(right, changed, 32).astype(int) - left)[seen].mean() < 1.5

    def test_most_of_a_slow_change_over_the_image_goes(self):
        right, left = views(10, height=160, width=240)
        changed = (left + np.linspace(0, 24, 240)).clip(0, 255).astype(np.uint8)
        assert np.abs(balanced(right, changed, 32).astype(int) - left).mean() < 5  # of 12

    @pytest.mark.parametrize("size", [(1, 1), (20, 30), (160, 240)])
    def test_where_no_points_are_found_the_view_stays(self, size):
        flat = np.full(size, 90, np.uint8)
        assert balanced(flat, flat, 64) is flat


def matched(right, left, proposed, weights, reach, where=None):
    """Disparity and margin of half the rows."""
    where = np.ones(right.shape, np.bool_) if where is None else where
    halves = halved(right), halved(left), halved_mask(where)
    return match_dense(*halves, proposed, weights, reach)


small = arrays(np.int16, (3, 9), elements=st.integers(0, 40), fill=st.nothing())


needs_vectors = pytest.mark.skipif(dense.vectors is None, reason="has no vectors")


def random_frame(seed, rows, width, reach, grain_px, share):
    """What is matched: views that agree in part, random slopes and proposals, pixels wanted."""
    rng = np.random.default_rng(seed)
    wall = textured(rows, width + reach, grain_px, seed)[:, : width + reach]
    shift = rng.integers(0, reach + 1)
    left = wall[:, reach - shift :][:, :width] + rng.integers(0, 4, (rows, width), np.uint8)
    slopes = rng.integers(-20, 20, (2, rows, width), np.int8)
    proposed = (rng.random((rows, width)) * reach).astype(np.float32)
    weight = rng.choice(np.array([0, 5, 15], np.int16), (rows, width))
    where = rng.random((rows, width)) < share
    return wall[:, reach:], left, *slopes, where, proposed, weight


class TestDense:
    @settings(max_examples=60)
    @given(small, small, small, small, st.integers(0, 2**27 - 1), st.integers(1, 7), st.data())
    def test_matches_are_the_oracles(self, right, left, right_slope, left_slope, bits, reach, data):
        where = np.array([bits >> i & 1 for i in range(27)], np.bool_).reshape(3, 9) | (
            bits % 3 == 0
        )
        proposed = np.full((3, 9), np.nan, np.float32)
        proposed[1, ::2] = data.draw(st.integers(0, 8 * reach)) / 8  # exact in binary
        weight = np.where(np.isnan(proposed), 0, 15).astype(np.int16)
        greys = (3 * right).astype(np.uint8), (3 * left).astype(np.uint8)
        slopes = (right_slope - 20).astype(np.int8), (left_slope - 20).astype(np.int8)
        given_ = *greys, *slopes, where, proposed, weight
        found = semi_global(*given_, reach, with_vectors=False)
        wanted = oracles.semi_global(*given_, reach)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-4)

    @needs_vectors
    @settings(max_examples=150, deadline=None)
    @given(
        st.integers(0, 2**32),
        st.integers(1, 40),
        st.integers(1, 70),
        st.integers(0, 100),
        st.data(),
    )
    def test_vectors_give_the_bytes_of_loops(self, seed, rows, width, reach, data):
        grain, share = data.draw(st.sampled_from([(0.01, 1), (1.5, 0.9), (1.5, 0.3)]))
        given_ = *random_frame(seed, rows, width, reach, grain, share), reach
        tiles = -(-rows // 16), -(-width // 16)
        every = np.full(tiles, 2 ** (reach // 2 + 1) - 1, np.uint64)
        found = semi_global(
            *given_,
            sets=data.draw(st.sampled_from([None, every])),
            strip_bytes=data.draw(st.sampled_from([1 << 26, 1 << 13, 1])),
        )
        np.testing.assert_array_equal(found, semi_global(*given_, with_vectors=False))

    @needs_vectors
    @settings(max_examples=10, deadline=None)
    @given(st.integers(0, 2**32), st.integers(15, 40))
    def test_tiles_of_sets_give_what_the_oracle_does(self, seed, reach):
        rows, width = 18, 40
        given_ = *random_frame(seed, rows, width, reach, 1.5, 0.9), reach
        chunks = reach // 2 + 1
        sets = np.random.default_rng(seed).integers(1, 2**chunks, (2, 3), np.uint64)
        found = semi_global(*given_, sets=sets)
        wanted = oracles.semi_global(
            *given_, lambda y, x, d: int(sets[y // 16, x // 16]) >> d // 2 & 1
        )
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-4)

    @needs_vectors
    @given(arrays(np.float32, (2, 5, 7), elements=st.sampled_from([np.nan, np.nan, 0, 3.5, 9, 12])))
    def test_sets_have_all_candidates_around_or_those_beside(self, candidates):
        cells, sets = np.zeros((3, 4), np.uint64), np.zeros((2, 4), np.uint64)
        dense.vectors.fill_sets(candidates, 4, 6, 2, 2, 1, 1, 50, 4, cells, sets)
        own = np.full((2, 4), 0, object)
        for y, x in np.ndindex(2, 4):
            around = candidates[:, max(4 * y - 2, 0) : 4 * y + 6, max(2 * x - 2, 0) : 2 * x + 4]
            for c in around[~np.isnan(around)]:
                for d in range(max(int(4 * c - 6), 0), min(int(4 * c + 6), 49) + 1):
                    own[y, x] |= 1 << d // 4
        for y, x in np.ndindex(2, 4):
            before, after = ([o for o in side if o] for side in (own[y, :x], own[y, x + 1 :]))
            beside = (before[-1] if before else 0) | (after[0] if after else 0)
            assert sets[y, x] == (own[y, x] or beside or 2**13 - 1)

    @pytest.mark.parametrize("strip_rows", [2, 6, 16])
    def test_strips_of_any_height_give_the_same_bytes(self, strip_rows):
        right, left = (view.astype(np.int16) for view in views(9, height=21))
        frame = loops.Frame(
            *(right, left, right // 4, left // 4),
            np.random.default_rng(0).random(right.shape) < 0.9,
            np.zeros(right.shape, np.float32),
            np.zeros(right.shape, np.int16),
        )
        found = np.empty((2, 2, *right.shape), np.float32)
        for height, result in zip((0, strip_rows), found, strict=True):
            work = loops.Workspace(*right.shape, 33, height)
            loops.semi_global(frame, WEIGHTS, work, *result)
        np.testing.assert_array_equal(*found)

    @pytest.mark.parametrize("disparity", [0, 7, 30])
    def test_a_wall_has_its_disparity(self, disparity):
        right, left = views(disparity)
        found, margin = matched(right, left, nothing_proposed, no_weights, 32)
        inside = np.s_[:, : 96 - disparity]
        assert (np.abs(found[inside] - disparity) < 0.5).mean() > 0.97
        assert (margin[~np.isnan(found)] >= 80).all()

    def test_odd_heights_and_pixels_not_wanted(self):
        right, left = views(5, height=47, width=200)
        where = np.zeros(right.shape, np.bool_)
        where[:, :20] = True
        nothing = np.full((24, 200), np.nan, np.float32)
        found, _ = matched(right, left, nothing, np.zeros((24, 200), np.int16), 16, where)
        assert found.shape == (24, 200)
        assert (np.abs(found[where[::2]] - 5) < 0.5).mean() > 0.95
        assert np.isnan(found[:, 60:]).all()

    def test_where_grey_tells_nothing_proposals_decide(self):
        flat = np.full((48, 96), 120, np.uint8)
        proposed = np.full((24, 96), 9, np.float32)
        known, _ = matched(flat, flat, proposed, no_weights + 15, 32)
        unknown, _ = matched(flat, flat, nothing_proposed, no_weights, 32)
        assert np.nanmedian(known) == pytest.approx(9, abs=0.5)
        assert np.isnan(unknown).all()

    def test_where_grey_tells_proposals_do_not_decide(self):
        right, left = views(12)
        stale = np.full((24, 96), 25, np.float32)
        found, _ = matched(right, left, stale, no_weights + 5, 32)
        assert (np.abs(found[:, :80] - 12) < 0.5).mean() > 0.97

    def test_a_card_before_a_wall_ends_where_it_ends(self):
        right, left = (view.copy() for view in views(4))
        card = textured(24, 30, seed=3)[:, :30] // 2
        right[12:36, 40:70] = card
        left[12:36, 58:88] = card
        found, _ = matched(right, left, nothing_proposed, no_weights, 32)
        found = np.repeat(found, 2, axis=0)
        truth = np.full((48, 96), 4.0)
        truth[12:36, 40:70] = 18
        hidden = np.zeros((48, 96), np.bool_)
        hidden[12:36, 70:84] = True  # of the wall, from the left camera
        known = ~np.isnan(found) & ~hidden
        assert (np.abs(found - truth)[known] > 1).mean() < 0.04
        assert known.mean() > 0.8

    def test_trails_propose_near_their_ends_only(self):
        keys = np.repeat(np.array([[1, 2, 3]], np.uint16), [30, 3, 7], axis=1)
        proposed = np.full(keys.shape, 5, np.float32)
        proposed[0, 28] = np.nan
        weights = weights_of(proposed, keys, keys == 2)[0]
        assert (np.flatnonzero(weights == 0) == [*range(24), 28, *range(39, 40)]).all()
        assert (weights[30:33] > weights[33]).all()


class TestBorders:
    def scene(self, disparity_px=20):
        """A card of 30 px before a wall: views, truth, and what the left camera does not see."""
        right, left = (view.copy() for view in views(4))
        card = textured(24, 30, seed=3)[:, :30] // 2
        right[12:36, 40:70] = card
        left[12:36, 40 + disparity_px : 70 + disparity_px] = card
        truth = np.full((48, 96), 4, np.float32)
        truth[12:36, 40:70] = disparity_px
        hidden = np.zeros((48, 96), np.bool_)
        hidden[12:36, 70 : 70 + disparity_px - 4] = True
        return right, left, truth, hidden

    def test_an_object_made_too_large_is_trimmed_and_what_it_hides_is_filled(self):
        right, left, truth, hidden = self.scene()
        large = cv2.dilate(truth, np.ones((5, 7), np.uint8))
        large[hidden & (large == 4)] = np.nan
        found = trimmed(large, right, left)
        assert (np.abs(large - truth) > 1).sum() > 200
        assert (np.abs(found - truth) > 1).sum() < 20
        assert np.isnan(found[hidden]).mean() > 0.9
        filled = hidden_filled(found, everywhere)
        assert (np.abs(filled - truth) > 1).sum() < 20
        assert np.isnan(filled).mean() < 0.01

    def test_borders_that_are_right_stay(self):
        right, left, truth, hidden = self.scene()
        truth[hidden] = np.nan
        found = trimmed(truth, right, left)
        assert (np.isnan(found) != np.isnan(truth)).sum() + (np.abs(found - truth) > 1).sum() < 12

    @settings(max_examples=40)
    @given(
        arrays(np.float32, (4, 12), elements=st.sampled_from([np.nan, 0, 1.25, 6, 6.5, 14])),
        arrays(np.uint8, (2, 4, 12), elements=st.integers(0, 255)),
    )
    def test_pixels_far_from_borders_stay_and_others_go_to_what_is_beside(self, disparity, greys):
        found = trimmed(disparity, *greys)
        leaps = np.zeros((4, 12), np.uint8)
        unknown = np.nan_to_num(disparity, nan=-9)
        leaps[:, 1:] = np.abs(np.diff(unknown, axis=1)) > 1.5
        leaps[1:] |= np.abs(np.diff(unknown, axis=0)) > 1.5
        near = cv2.dilate(leaps, np.ones((9, 9), np.uint8)) > 0
        np.testing.assert_array_equal(found[~near], disparity[~near])
        assert np.isnan(found)[np.isnan(disparity)].all()
        assert (found <= disparity)[~np.isnan(found)].all()

    def test_only_what_a_nearer_object_on_the_left_can_hide_is_filled(self):
        nan = np.nan
        row = [9, nan, nan, nan, 3, 2.5, 3, nan, nan, 12, nan, 3, *[nan] * 16, 3]
        disparity = np.array([row], np.float32)
        where = ~np.zeros(disparity.shape, np.bool_)
        where[0, 2] = False
        wanted = [9, 2.5, nan, 2.5, 3, 2.5, 3, nan, nan, 12, 3, 3, *[nan] * 16, 3]
        np.testing.assert_array_equal(hidden_filled(disparity, where), [wanted])


class TestHalfTheSize:
    @given(st.integers(2, 9), st.integers(2, 9), st.integers(0, 99))
    def test_a_square_becomes_its_mean_and_its_first_pixel_and_comes_back(self, rows, width, seed):
        image = np.random.default_rng(seed).integers(0, 256, (rows, width)).astype(np.float32)
        means, firsts = reduced(image), every_second(image)
        for y in range(rows // 2):
            for x in range(width // 2):
                down = image[2 * y : 2 * y + 2, 2 * x]
                assert reduced(image, columns=1)[y, 2 * x] == down.mean()
                assert means[y, x] == image[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].mean()
                assert firsts[y, x] == image[2 * y, 2 * x]
        back = enlarged(firsts, image.shape)
        for y in range(rows):
            for x in range(width):
                assert back[y, x] == firsts[min(y // 2, rows // 2 - 1), min(x // 2, width // 2 - 1)]
