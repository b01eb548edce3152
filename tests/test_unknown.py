"""Why disparity is unknown, the limit of the range, and depth of what stands still."""

import numpy as np
import pytest

from motionstereo_cli.check.shortfall import beyond_range
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.method.matching import MATCH
from motionstereo_cli.method.settings import OCCLUSION, Settings
from motionstereo_cli.method.unknown import reasons
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.types import StereoFrame

NAN = np.nan
KNOWN, NOT_MOVED, HIDDEN, OUTSIDE, AMBIGUOUS, AT_LIMIT = OCCLUSION


def row_of(disparity, wanted=None, at_limit=None):
    """The codes of one row."""
    disparity = np.array([disparity], np.float32)
    nothing = np.zeros(disparity.shape, np.bool_)
    wanted = ~nothing if wanted is None else np.array([wanted], np.bool_)
    at_limit = nothing if at_limit is None else np.array([at_limit], np.bool_)
    return reasons(disparity, wanted, at_limit)[0].tolist()


def test_what_an_object_hides_is_to_its_right_and_as_wide_as_the_leap():
    found = row_of([9, *[NAN] * 15, 3, *[3] * 9])
    assert found == [KNOWN, *[HIDDEN] * 10, *[AMBIGUOUS] * 5, *[KNOWN] * 10]


def test_left_of_an_object_nothing_is_hidden():
    assert row_of([3, NAN, NAN, 9, *[3] * 12])[1:3] == [AMBIGUOUS] * 2


def test_what_has_its_partner_beyond_the_border_is_outside():
    assert row_of([4, 4, 4, 4, *[NAN] * 6]) == [*[KNOWN] * 4, *[AMBIGUOUS] * 2, *[OUTSIDE] * 4]


def test_what_did_not_move_and_what_is_at_the_limit_is_said_first():
    found = row_of([NAN, NAN, 5, NAN], [0, 1, 1, 1], [1, 1, 0, 0])
    assert found == [NOT_MOVED, AT_LIMIT, KNOWN, OUTSIDE]


def test_a_row_where_nothing_is_known_is_ambiguous():
    assert row_of([NAN] * 5) == [AMBIGUOUS] * 5


@pytest.mark.parametrize(
    ("matched", "at_limit", "said"), [(0.46, 0.04, "8% .*--max-disparity 96"), (0.5, 0.001, None)]
)
def test_a_range_that_is_too_short_is_said(matched, at_limit, said):
    found = beyond_range(matched, at_limit, 64)
    assert found is None if said is None else found is not None


@pytest.fixture(scope="module")
def frames():
    """Cards before a still camera: their disparities are 6 to 22 px."""
    scene = SimulateSettings(scene="cards", frames="6", width=160, height=96, seed=1)
    return [
        (StereoFrame(index, index, None, shot.left, shot.right), shot.disparity_px)
        for index, shot in enumerate(render_scene(scene))
    ]


@pytest.mark.parametrize("matcher", MATCH)
def test_nothing_is_known_at_the_limit_of_the_range(frames, matcher):
    truth = frames[-1][1]
    limit = int(np.quantile(truth, 0.9))
    assert (truth > limit).mean() > 0.02
    views = [frame for frame, _ in frames]
    *_, last = process(views, Settings(matcher=matcher, max_disparity=limit))
    assert np.nanmax(last.disparity_px) <= limit - 0.5
    if matcher != "trails":  # they have few partners there
        assert (last.occlusion == AT_LIMIT).any()
    assert ((last.occlusion == KNOWN) == ~np.isnan(last.disparity_px)).all()


@pytest.mark.parametrize("reference", ["right", "left"])
def test_what_stands_still_has_depth_too_if_asked_for(frames, reference):
    views = [frame for frame, _ in frames]
    moved, everything = (
        list(process(views, Settings(depth_of=which, reference=reference)))
        for which in ("moved", "all")
    )
    assert np.isnan(moved[0].disparity_px).all()
    assert (~np.isnan(everything[0].disparity_px)).mean() > 0.7
    if reference == "right":
        assert np.nanmedian(np.abs(everything[0].disparity_px - frames[0][1])) < 0.3
    for one, other in zip(moved, everything, strict=True):
        np.testing.assert_array_equal(one.charge, other.charge)
        assert one.charged == other.charged


@pytest.mark.parametrize("values", [{"matcher": "trails"}, {"max_age": 3}])
def test_depth_of_all_needs_what_can_give_it(values):
    with pytest.raises(SettingsError, match="depth-of"):
        Settings(depth_of="all", **values)
