"""The matchers against slow oracles, hand-worked rows, and scenes shifted by a known amount."""

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from motionstereo_cli.compiled import trails
from motionstereo_cli.method.cleaning import filled, without_speckles
from motionstereo_cli.method.regions import match_regions
from motionstereo_cli.method.trails import match_trails

rows = arrays(np.uint16, (5, 13), elements=st.integers(0, 3), fill=st.nothing())


def match_keys(*rows):
    return np.array(rows, np.uint16)


def listed(image):
    """All (row, start, stop, key) of an image's trails."""
    work = trails.Workspace(*image.shape, 1, 1, 1)
    trails.find_trails(image, 0, work)
    first = np.array(work.first[0])
    row = np.repeat(np.arange(len(first) - 1), np.diff(first))
    each = (np.array(values[0])[: len(row)] for values in (work.start, work.stop, work.key))
    return list(zip(row.tolist(), *(one.tolist() for one in each), strict=True))


class TestTrails:
    def test_a_trail_is_a_maximal_run_of_one_unit(self):
        found = listed(match_keys([0, 5, 5, 7, 0, 7], [7, 7, 7, 7, 7, 7]))
        assert found == [(0, 1, 3, 5), (0, 3, 4, 7), (0, 5, 6, 7), (1, 0, 6, 7)]

    @given(rows)
    def test_trails_are_the_oracles(self, image):
        assert listed(image) == oracles.trails_of(image)

    def test_a_slanted_trail_runs_from_one_disparity_to_another(self):
        right = match_keys([0, 0, 9, 9, 9, 9, 0, 0, 0, 0, 0, 0])
        left = match_keys([0, 0, 0, 0, 0, 9, 9, 9, 9, 9, 9, 0])  # starts 3, stops 5 px to the right
        found, _ = match_trails(right, left, 8, block_px=(1, 1), min_votes=1)
        assert np.isnan(found[0, [0, 1, 6, 7]]).all()
        assert found[0, 2:6] == pytest.approx([3.25, 3.75, 4.25, 4.75])

    def test_a_trail_cut_by_the_border_takes_the_disparity_of_its_other_end(self):
        right = match_keys([9, 9, 9, 0, 0, 0, 0, 0])
        left = match_keys([0, 9, 9, 9, 9, 9, 9, 0])
        found, _ = match_trails(right, left, 6, block_px=(1, 1), min_votes=1)
        assert found[0, :3].tolist() == [4, 4, 4]

    def test_a_trail_with_two_equal_partners_stays_unknown(self):
        right = match_keys([0, 9, 9, 0, 0, 0, 0, 0, 0])
        left = match_keys([0, 0, 9, 9, 0, 9, 9, 0, 0])
        assert np.isnan(match_trails(right, left, 6, block_px=(1, 1), min_votes=1)).all()

    def test_a_trail_that_noise_split_takes_what_its_block_elected(self):
        row = [1, 2, 3, 9, 9, 9, 9, 4, 5, 0, 0, 0, 0]
        right = match_keys(*[row] * 4, row)
        left = match_keys(*[[0, 0, 0, *row[:-3]]] * 5)
        left[4, 8] = 0  # the run of 9 at 6..9 falls to pieces
        found, votes = match_trails(right, left, 6, block_px=(8, 8), min_votes=8)
        assert found[4, 3:7] == pytest.approx([3, 3, 3, 3], abs=0.1)
        assert votes[4, 3] >= 8
        left[4, 6:10] = 0  # nothing left that is equal
        assert np.isnan(match_trails(right, left, 6, block_px=(8, 8))[0][4, 3:7]).all()

    @settings(max_examples=300)
    @given(rows, rows, st.integers(1, 14), st.integers(1, 6), st.integers(1, 8), st.integers(1, 9))
    def test_matches_are_the_oracles(self, right, left, reach, block_rows, block_columns, least):
        settings = {"block_px": (block_rows, block_columns), "max_ratio": 0.9}
        found = match_trails(right, left, reach, **settings, min_votes=least)
        wanted = oracles.match_trails(right, left, reach, **settings, min_votes=least)
        # Votes that are just enough may miss by the last bit of float32, which decides.
        decided = np.abs(wanted[1] - least) > 1e-4
        found, wanted = (np.where(decided, each, np.nan) for each in (found, wanted))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-4)

    def test_nothing_charged_gives_nothing(self):
        nothing = np.zeros((6, 9), np.uint16)
        assert np.isnan(match_trails(nothing, nothing, 4)).all()

    def test_speckles_go_and_patches_stay(self):
        disparity = np.full((20, 20), np.nan, np.float32)
        disparity[2:12, 2:12] = 7.25
        disparity[15, 15] = 7.25
        everywhere = np.ones(disparity.shape, bool)
        kept = without_speckles(disparity, everywhere, 50)
        assert np.isnan(kept[15, 15])
        assert (kept[2:12, 2:12] == 7.25).all()
        everywhere[2:12, 6:8] = False  # two patches of 40 pixels
        assert np.isnan(without_speckles(disparity, everywhere, 50)).all()

    def test_short_gaps_between_like_disparities_are_filled(self):
        nan = np.nan
        row = np.array([[nan, 4, nan, nan, nan, 6, nan, 9, nan]], np.float32)
        everywhere = np.ones(row.shape, bool)
        wanted = [[nan, 4, 4.5, 5, 5.5, 6, nan, 9, nan]]  # 6 and 9 are not one surface
        np.testing.assert_array_equal(filled(row, everywhere, 3), wanted)
        np.testing.assert_array_equal(filled(row, everywhere, 2), row)
        np.testing.assert_array_equal(filled(row, ~everywhere, 3), row)


class TestRegions:
    def test_each_pixel_keeps_the_displacement_of_its_largest_region(self):
        right = match_keys([0, 1, 2, 3, 0, 0, 0, 0])
        left = match_keys([0, 0, 0, 1, 2, 3, 1, 0])  # whole at 2; the 1 alone also at 5
        found = match_regions(right, left, 6)
        assert found[0, 1:4].tolist() == [2, 2, 2]
        assert np.isnan(found[0, [0, 4, 5, 6, 7]]).all()

    @settings(max_examples=200)
    @given(rows, rows, st.integers(0, 12))
    def test_matches_are_the_oracles(self, right, left, max_disparity):
        np.testing.assert_array_equal(
            match_regions(right, left, max_disparity),
            oracles.match_regions(right, left, max_disparity),
        )


def trails_alone(right, left, max_disparity):
    return match_trails(right, left, max_disparity)[0]


@pytest.mark.parametrize("match", [trails_alone, match_regions])
@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), shift=st.integers(0, 20))
def test_the_disparity_of_a_shifted_view_is_the_shift(match, seed, shift):
    """A right view full of distinct trails, and a left view that is the same, displaced."""
    random = np.random.default_rng(seed)
    wide = np.repeat(random.integers(1, 1000, (24, 20)), 4, axis=1).astype(np.uint16)
    right, left = wide[:, shift : shift + 50], wide[:, :50]
    found = match(right, left, 24)
    known = ~np.isnan(found)
    assert known[:, : 50 - shift - 4].mean() > 0.9
    assert np.abs(found[known] - shift).max() < 0.02
