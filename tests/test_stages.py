"""Each equation of the paper against hand-worked arrays and properties."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from motionstereo_cli.compiled import pictures
from motionstereo_cli.method.bands import band_table, bands, blur
from motionstereo_cli.method.charge import accumulate, age, permanency
from motionstereo_cli.method.confidence import confidence
from motionstereo_cli.method.match_keys import match_keys
from motionstereo_cli.method.motion import motion
from motionstereo_cli.method.residual import residual
from motionstereo_cli.pipeline import depth_of
from motionstereo_cli.robot.free_space import StripValues, strip_borders
from motionstereo_cli.sources.luma import full_range
from motionstereo_cli.types import Rig

NAN = float("nan")


def u8(*rows):
    return np.array(rows, np.uint8)


def f32(*rows):
    return np.array(rows, np.float32)


class TestBands:
    def test_eight_bands_of_the_full_range_are_32_levels_each(self):
        table = band_table(8)
        assert list(table[[0, 31, 32, 63, 64, 223, 224, 255]]) == [1, 1, 2, 2, 3, 7, 8, 8]

    def test_a_range_that_does_not_start_at_zero_still_gives_bands_1_to_n(self):
        # floor((GL - 50) * 4 / 101) + 1: steps at 50 + 25.25, 50.5 and 75.75
        table = band_table(4, 50, 150)
        assert list(table[[50, 75, 76, 100, 101, 125, 126, 150]]) == [1, 1, 2, 2, 3, 3, 4, 4]

    def test_levels_outside_the_range_fall_into_the_first_or_last_band(self):
        table = band_table(4, 50, 150)
        assert (table[0], table[49], table[151], table[255]) == (1, 1, 4, 4)

    def test_256_bands_do_not_overflow(self):
        grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
        assert np.array_equal(bands(grey, 256), grey.astype(int) + 1)

    @given(st.integers(2, 256), st.integers(0, 254), st.data())
    def test_bands_are_the_equation_and_never_fall(self, n, low, data):
        high = data.draw(st.integers(low + 1, 255))
        table = band_table(n, low, high).astype(int)
        assert np.all(np.diff(table) >= 0)
        assert table[0] == 1
        assert table[255] <= n
        grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
        assert np.array_equal(bands(grey, n, low, high).ravel(), table)
        level = data.draw(st.integers(low, high))
        assert table[level] == int(np.floor((level - low) * n / (high - low + 1))) + 1

    def test_blur_of_zero_changes_nothing_and_else_smooths(self):
        grey = u8([0, 0, 200, 0, 0])
        assert blur(grey, 0) is grey
        assert blur(grey, 1.0)[0, 2] < 200


class TestMotion:
    def test_motion_is_a_change_of_band(self):
        moved = motion(u8([1, 2, 3]), u8([1, 3, 3]), u8([0, 40, 70]), u8([9, 70, 90]))
        assert moved.tolist() == [[False, True, False]]

    def test_a_change_below_the_least_jump_does_not_count(self):
        # 31 -> 32 and 29 -> 36 both cross from band 1 to 2; only the second jumps by 6 or more
        moved = motion(u8([2, 2]), u8([1, 1]), u8([32, 36]), u8([31, 29]), min_jump=6)
        assert moved.tolist() == [[False, True]]

    def test_the_least_jump_itself_counts_both_ways(self):
        moved = motion(u8([2, 1]), u8([1, 2]), u8([36, 30]), u8([30, 36]), min_jump=6)
        assert moved.tolist() == [[True, True]]


images = arrays(np.uint8, (3, 4))
masks = arrays(np.bool_, (3, 4))


class TestCharge:
    def test_permanency_by_hand(self):
        charge = permanency(u8([0, 20, 255, 9]), np.array([[True, False, False, False]]))
        assert charge.tolist() == [[255, 4, 239, 0]]

    def test_general_by_hand(self):
        charge = u8([0, 20, 250, 9])
        moved = np.array([[True, False, True, False]])
        result = accumulate(charge, moved, charge_max=252, charge_min=5, gain=30, leak=16)
        assert result.tolist() == [[30, 5, 252, 5]]

    @given(images, masks, st.integers(0, 254), st.integers(1, 255), st.data())
    def test_both_modes_are_their_equations(self, charge, moved, low, leak, data):
        high = data.draw(st.integers(low + 1, 255))
        gain = data.draw(st.integers(1, 255))
        charge = np.clip(charge, low, high).astype(np.uint8)
        limits = {"charge_max": high, "charge_min": low, "leak": leak}
        leaked = np.maximum(charge.astype(int) - leak, low)
        gained = np.minimum(charge.astype(int) + gain, high)
        memory = permanency(charge, moved, **limits)
        general = accumulate(charge, moved, gain=gain, **limits)
        assert np.array_equal(memory, np.where(moved, high, leaked))
        assert np.array_equal(general, np.where(moved, gained, leaked))
        for result in (memory, general):
            assert result.dtype == np.uint8
            assert result.min() >= low
            assert result.max() <= high

    @given(st.integers(0, 254), st.integers(1, 255), st.data())
    def test_forgets_exactly_after_the_time_the_leak_gives_it(self, low, leak, data):
        high = data.draw(st.integers(low + 1, 255))
        lasts = -(-(high - low) // leak)
        charge = permanency(
            u8([low]), np.array([[True]]), charge_max=high, charge_min=low, leak=leak
        )
        at_rest = np.array([[False]])
        for _ in range(lasts - 1):
            charge = permanency(charge, at_rest, charge_max=high, charge_min=low, leak=leak)
            assert charge[0, 0] > low
        charge = permanency(charge, at_rest, charge_max=high, charge_min=low, leak=leak)
        assert charge[0, 0] == low

    def test_inputs_are_not_edited(self):
        charge, moved = u8([7, 8]), np.array([[True, False]])
        permanency(charge, moved)
        accumulate(charge, moved)
        assert charge.tolist() == [[7, 8]]
        assert moved.tolist() == [[True, False]]


class TestAge:
    def test_the_memory_read_backwards(self):
        found = age(u8([255, 239, 223, 15, 0]))
        assert found.tolist() == [[0, 1, 2, 15, 255]]

    @given(st.integers(0, 254), st.integers(1, 255), st.data())
    def test_is_the_number_of_frames_since_motion(self, low, leak, data):
        high = data.draw(st.integers(low + 1, 255))
        limits = {"charge_max": high, "charge_min": low, "leak": leak}
        lasts = -(-(high - low) // leak)
        charge = permanency(u8([low]), np.array([[True]]), **limits)
        for frames in range(lasts):
            assert age(charge, **limits)[0, 0] == min(frames, 254)
            charge = permanency(charge, np.array([[False]]), **limits)
        assert age(charge, **limits)[0, 0] == 255


class TestResidual:
    def test_views_that_agree_differ_by_nothing_whatever_their_brightness(self):
        random = np.random.default_rng(0)
        scene = random.integers(20, 200, (9, 30)).astype(np.uint8)
        right, left = scene[:, 4:] + 30, scene[:, :-4]
        disparity = np.full((9, 26), NAN, np.float32)
        disparity[2:7, 2:20] = 4
        found = residual(disparity, right, left)
        assert np.array_equal(np.isnan(found), np.isnan(disparity))
        assert found[2:7, 2:20].max() == 0
        wrong = residual(disparity + 3, right, left)
        assert np.nanmedian(wrong) > 30

    def test_by_hand(self):
        # Grey 10 20 40 80 seen at 0, 1.5 and 2 px: 10-10, 20-60, 40-80; the median is -40.
        disparity = np.array([[0, 1.5, NAN, NAN]], np.float32)
        grey = u8([10, 20, 40, 80])
        disparity[0, 0], disparity[0, 1] = 0, 1.5
        found = residual(np.vstack([disparity] * 3), np.vstack([grey] * 3), np.vstack([grey] * 3))
        # differences 0 and -40, median -20: each is 20 off
        assert found[1].tolist()[:2] == [20, 20]
        assert np.isnan(found[1, 2:]).all()

    def test_nothing_known_gives_nothing(self):
        unknown = np.full((3, 4), NAN, np.float32)
        assert np.isnan(residual(unknown, u8(*[[1] * 4] * 3), u8(*[[1] * 4] * 3))).all()


class TestConfidence:
    def test_by_hand(self):
        # -4.38 + 0.918 * log2(64) - 0.157 * 2 - 0.093 * 3 = 0.535
        chance = confidence(f32([9]), f32([9]), f32([64]), f32([2]), u8([3]))
        assert chance[0, 0] == pytest.approx(1 / (1 + np.exp(-0.535)), abs=0.003)

    def test_unknown_stays_unknown_and_filled_gaps_have_a_value(self):
        chance = confidence(
            f32([NAN, 9]), f32([NAN, NAN]), f32([80, NAN]), f32([0, NAN]), u8([0, 0])
        )
        assert np.isnan(chance[0, 0])
        assert 0.9 < chance[0, 1] < 1

    def test_more_votes_less_difference_and_less_age_are_better(self):
        at = f32([9]), f32([9])
        plain = confidence(*at, f32([64]), f32([4]), u8([4]))
        assert confidence(*at, f32([128]), f32([4]), u8([4])) > plain
        assert confidence(*at, f32([64]), f32([2]), u8([4])) > plain
        assert confidence(*at, f32([64]), f32([4]), u8([2])) > plain


class TestUnits:
    def test_pixels_at_rest_have_no_unit(self):
        assert match_keys(u8([10, 11]), 10).tolist() == [[0, 11 * 256]]

    def test_equal_charge_of_another_band_is_another_unit(self):
        by_band = match_keys(u8([9, 9, 9]), 0, u8([1, 2, 1]))
        assert by_band[0, 0] == by_band[0, 2] != by_band[0, 1]

    def test_the_largest_charge_and_band_fit(self):
        unit = match_keys(u8([255]), 0, np.array([[256]], np.uint16))
        assert unit.tolist() == [[255 * 256 + 255]]

    @given(images, images)
    def test_units_are_equal_where_charge_and_band_are(self, charge, band):
        band = np.maximum(band, 1)
        flat = match_keys(charge, 0, band).reshape(-1)
        pairs = list(zip(charge.reshape(-1).tolist(), band.reshape(-1).tolist(), strict=True))
        for a in range(len(pairs)):
            for b in range(a):
                if pairs[a][0] and pairs[b][0]:
                    assert (flat[a] == flat[b]) == (pairs[a] == pairs[b])


class TestDepth:
    def test_by_hand(self):
        z = depth_of(f32([10, 20, NAN, 0]), Rig(4, 1, 500, 0.1, 2, 0))
        assert np.array_equal(z, f32([5, 2.5, NAN, NAN]), equal_nan=True)

    def test_doffs_are_added_to_the_disparity(self):
        z = depth_of(f32([10, -40, 0]), Rig(3, 1, 500, 0.1, 2, 0, doffs=40))
        assert np.array_equal(z, f32([1.0, NAN, 1.25]), equal_nan=True)


class TestQuantiles:
    @given(
        arrays(
            np.float32,
            st.tuples(st.integers(1, 9), st.integers(1, 14)),
            elements=st.one_of(st.just(np.float32(np.nan)), st.floats(-4, 200, width=32)),
        ),
        st.integers(1, 14),
    )
    def test_they_are_those_of_the_sorted_values(self, near, strips):
        strips = min(strips, near.shape[1])
        found = StripValues.of(near, strips).quantiles(0.8, min_share=0.1)
        borders = strip_borders(near.shape[1], strips)[1:-1]
        for part, got in zip(np.split(near, borders, axis=1), found, strict=True):
            known = part[~np.isnan(part)]
            if len(known) <= 0.1 * part.size:
                assert np.isnan(got)
            else:
                assert got == pytest.approx(np.quantile(known, 0.8), rel=1e-5, abs=1e-5)


class TestLevels:
    """Limited range of video, all 256 levels: the equations of BT.601."""

    LEVELS = np.arange(256, dtype=np.uint8).reshape(8, 32)

    def test_luma_of_limited_range_becomes_grey(self):
        padded = np.pad(self.LEVELS, ((0, 0), (0, 5)))
        wanted = np.clip(np.rint((self.LEVELS.astype(float) - 16) * 255 / 219), 0, 255)
        assert np.array_equal(full_range(padded, 32), wanted)

    def test_grey_becomes_luma_and_colours_that_are_none(self):
        luma, blue, red = (np.zeros(shape, np.uint8) for shape in ((8, 37), (4, 20), (4, 20)))
        pictures.grey_planes(self.LEVELS, luma, blue, red)
        wanted = np.floor(16.5 + self.LEVELS * (219 / 255))
        assert np.array_equal(luma[:, :32], wanted)
        assert np.all(luma[:, 32:] == 0)
        for plane in (blue, red):
            assert np.all(plane[:, :16] == 128)
            assert np.all(plane[:, 16:] == 0)
