"""Images of every size and content: nothing crashes, and what does not fit together is refused.

``make sanitize`` runs this on loops that check each index.
"""

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import motionstereo_cli
from motionstereo_cli.compiled import pictures
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.encode import encode_png
from motionstereo_cli.method.borders import hidden_filled, trimmed
from motionstereo_cli.method.cleaning import filled, without_speckles
from motionstereo_cli.method.confidence import confidence, confidence_by_margin
from motionstereo_cli.method.dense import semi_global
from motionstereo_cli.method.match_keys import match_keys
from motionstereo_cli.method.matching import MATCH
from motionstereo_cli.method.residual import residual
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.method.trails import match_trails
from motionstereo_cli.pipeline import process
from motionstereo_cli.robot.free_space import StripValues, find_ground, free_space
from motionstereo_cli.robot.objects import regions
from motionstereo_cli.sinks.drawing import depth_levels
from motionstereo_cli.sinks.images import disparity_png
from motionstereo_cli.sinks.scale import DepthScale
from motionstereo_cli.types import Pose, Rig, StereoFrame

PACKAGE = Path(motionstereo_cli.__file__).parent

#: Height and width: one pixel, one row, one column, odd, higher and wider, larger than a block.
shapes = st.sampled_from([(1, 1), (1, 40), (40, 1), (2, 3), (7, 5), (16, 16)]) | st.tuples(
    st.integers(1, 50), st.integers(1, 90)
)
reaches = st.sampled_from([1, 2, 63, 64, 300]) | st.integers(1, 300)
seeds = st.integers(0, 1 << 32)


def rig_of(shape):
    height, width = shape
    return Rig(width, height, width + 1.0, 0.1, width / 2, height / 2)


def frames_of(shape, content, seed, count=4):
    """Frames that show noise; nothing that moves; or all of the image moving at once."""
    random = np.random.default_rng(seed)
    for index in range(count):
        views = random.integers(0, 256, (2, *shape), np.uint8)
        if content == "at rest":
            views[:] = 100
        elif content == "all moves":
            views[:] = views // 64 + 190 * (index % 2)
        yield StereoFrame(index, index, index / 10, views[0], views[1])


@pytest.mark.parametrize("matcher", MATCH)
@settings(max_examples=40)
@given(
    shapes,
    st.sampled_from(["noise", "at rest", "all moves"]),
    reaches,
    seeds,
    st.sampled_from(["right", "left"]),
    st.sampled_from([{}, {"charge_mode": "general"}, {"contrast_px": 15.0, "bands": 256}]),
    st.booleans(),
)
@example((1, 1), "all moves", 300, 0, "left", {}, True)
@example((48, 90), "all moves", 300, 0, "right", {}, True)
def test_frames_of_any_size_have_results_of_that_size(
    matcher, shape, content, reach, seed, reference, more, with_rig
):
    rig = rig_of(shape) if with_rig else None
    given_ = Settings(matcher=matcher, max_disparity=reach, reference=reference, **more)
    poses = {"pose_of": lambda frame: Pose(frame.time_s, 0, 0, 0, 0, 0, 1)} if with_rig else {}
    results = list(process(frames_of(shape, content, seed), given_, rig, **poses))
    assert len(results) == 4
    for result in results:
        known = result.disparity_px[~np.isnan(result.disparity_px)]
        assert result.disparity_px.shape == result.charge.shape == shape
        assert ((known >= 0) & (known <= reach - 0.5)).all()
        assert np.isnan(result.disparity_px[result.charge == 0]).all()
        assert content != "at rest" or not result.charge.any()
        if more.get("bands") != 256 and content == "all moves" and result.frame.index:
            assert result.charge.all() or more
        for image in (result.charge, disparity_png(result.disparity_px)):
            assert encode_png(image).startswith(b"\x89PNG")


def stage_calls(shape, reach, seed):
    """A call of each function on arrays that has a compiled loop: with arrays of any content."""
    random = np.random.default_rng(seed)
    share = random.random()

    def reals(high=reach):
        image = (random.random(shape) * high).astype(np.float32)
        image[random.random(shape) < share] = np.nan
        return image

    def grey():
        return random.integers(0, 256, shape, np.uint8)

    def mask():
        return random.random(shape) < share

    def slopes():
        return random.integers(-40, 41, shape).astype(np.int8)

    def keys():
        return random.integers(0, 1 + int(4 * share), shape).astype(np.uint16) * 257

    far = reals(1e30)
    block = {"block_px": tuple(random.integers(1, 20, 2).tolist()), "min_votes": 1}
    strips = int(random.integers(1, shape[1] + 1))
    near, near_far = StripValues.of(reals(), strips), StripValues.of(far, strips)
    ground = find_ground(near, shape[0] / 2)
    weights = random.integers(0, 14, shape).astype(np.int16)
    proposed = np.where(weights > 0, np.nan_to_num(reals()), np.float32(np.nan))
    proposed, weights = proposed.astype(np.float32), np.where(weights > 0, weights, np.int16(0))
    return [
        (match_trails, [keys(), keys(), reach], block),
        (semi_global, [grey(), grey(), slopes(), slopes(), mask(), proposed, weights, reach], {}),
        (trimmed, [reals(), grey(), grey()], {}),
        (hidden_filled, [reals(), mask()], {}),
        (without_speckles, [reals(), mask(), int(random.integers(0, 300))], {}),
        (filled, [reals(), mask(), int(random.integers(0, 100))], {}),
        (residual, [reals(), grey(), grey()], {}),
        (residual, [far, grey(), grey()], {}),
        (confidence, [reals(), reals(), reals(1e6), reals(), grey()], {}),
        (confidence_by_margin, [reals(), reals(), far], {}),
        (match_keys, [grey(), 0, grey()], {}),
        (match_keys, [grey(), 3], {}),
        (StripValues.of, [far, strips], {}),
        (near_far.quantiles, [share], {}),
        (find_ground, [near, -3.0], {}),
        (find_ground, [near_far, 1e3], {}),
        (free_space, [near, ground], {}),
        (regions, [reals(), mask(), 0.01], {}),
        (disparity_png, [far], {}),
        (depth_levels, [far, DepthScale(max(reach, 2.0), 1.0, None, "turbo")], {}),
    ]


@settings(max_examples=80)
@given(shapes, reaches, seeds)
@example((1, 1), 300, 0)
def test_loops_take_images_of_any_size_and_content(shape, reach, seed):
    for function, args, options in stage_calls(shape, reach, seed):
        before = [np.copy(each) for each in args if isinstance(each, np.ndarray)]
        found = function(*args, **options)
        given_ = [each for each in args if isinstance(each, np.ndarray)]
        for image, copy in zip(given_, before, strict=True):
            np.testing.assert_array_equal(image, copy, err_msg=function.__name__)
        for image in found if isinstance(found, tuple) else (found,):
            if isinstance(image, np.ndarray) and image.ndim == 2:
                assert image.shape == shape, function.__name__


@settings(max_examples=40)
@given(st.integers(1, 20), st.integers(1, 30), seeds)
def test_planes_of_a_video_picture_are_its_colours(half_height, half_width, seed):
    random = np.random.default_rng(seed)
    levels = random.integers(0, 256, (2 * half_height, 2 * half_width), np.uint8)
    table = random.integers(0, 256, (3, 256), np.uint8)
    luma = np.empty(levels.shape, np.uint8)
    blue, red = np.empty((2, half_height, half_width), np.uint8)
    pictures.planes(levels, table, luma, blue, red)
    np.testing.assert_array_equal(luma, table[0][levels])
    np.testing.assert_array_equal(blue, table[1][levels[::2, ::2]])
    np.testing.assert_array_equal(red, table[2][levels[::2, ::2]])


def test_stages_refuse_arrays_that_do_not_fit_together():
    """Loops check no index: one array that is smaller would be read, or written, beyond its end."""
    for function, args, options in stage_calls((12, 20), 30, 1):
        arrays = [i for i, each in enumerate(args) if isinstance(each, np.ndarray)]
        for place in arrays:
            image = args[place]
            wrong = [image.astype(np.complex64), image[None], image[:0]]
            if len(arrays) > 1:
                wrong += [image[:-1], image[:, 1:]]
            for each in wrong:
                changed = [*args[:place], each, *args[place + 1 :]]
                with pytest.raises(InputError, match=r"arrays? (is|of shapes) "):
                    function(*changed, **options)
    for reach in (-1, -2, 1 << 20):
        keys = np.ones((4, 5), np.uint16)
        with pytest.raises(InputError, match="max_disparity is"):
            match_trails(keys, keys, reach)
    with pytest.raises(InputError, match="block_px is 0"):
        match_trails(keys, keys, 8, block_px=(8, 0))


def strided(frame):
    """The same frame, its views as parts of larger images."""
    right, left = (np.repeat(view, 2, axis=1)[:, ::2] for view in (frame.right, frame.left))
    assert not right.flags.c_contiguous
    return dataclasses.replace(frame, right=right, left=left)


def test_views_that_are_not_contiguous_give_the_same():
    plain = list(process(frames_of((30, 60), "noise", 0)))
    parts = list(process(map(strided, frames_of((30, 60), "noise", 0))))
    for a, b in zip(plain, parts, strict=True):
        np.testing.assert_array_equal(a.disparity_px, b.disparity_px)


SMALL, LARGE = (np.zeros(shape, np.uint8) for shape in ((24, 32), (48, 64)))


def frame(left, right, index=0):
    return StereoFrame(index, index, None, left, right)


@pytest.mark.parametrize("matcher", MATCH)
@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([frame(LARGE, SMALL)], "frame 0: arrays of shapes"),
        ([frame(SMALL, LARGE)], "frame 0: arrays of shapes"),
        ([frame(SMALL, SMALL), frame(LARGE, LARGE, 1)], "frame 1: arrays of shapes"),
        ([frame(LARGE, LARGE), frame(SMALL, SMALL, 1)], "frame 1: arrays of shapes"),
        ([frame(SMALL.astype(np.uint16), SMALL)], "an array is uint16"),
        ([frame(SMALL, SMALL.astype(float))], "an array is float64"),
        ([frame(np.zeros((24, 32, 3), np.uint8), SMALL)], "of shape"),
        ([frame(SMALL[:0], SMALL[:0])], "of shape"),
        ([frame(None, SMALL)], "an array is object"),
    ],
)
def test_frames_that_do_not_fit_are_refused(frames, message, matcher):
    with pytest.raises(InputError, match=message):
        list(process(frames, Settings(matcher=matcher)))


def test_frames_of_another_size_than_the_rig_or_the_state_are_refused():
    with pytest.raises(InputError, match=r"frame 0: arrays of shapes \(10, 20\) and \(24, 32\)"):
        list(process([frame(SMALL, SMALL)], rig=rig_of((10, 20))))
    *_, last = process([frame(LARGE, LARGE)])
    with pytest.raises(InputError, match="frame 0: arrays of shapes"):
        list(process([frame(SMALL, SMALL)], state=last.state))


@pytest.mark.parametrize(
    "wrong", [{"jobs": 0}, {"settings": {"max_disparity": 64}}, {"extras": {"depth"}}]
)
def test_arguments_of_another_kind_are_refused(wrong):
    with pytest.raises(SettingsError):
        list(process([frame(SMALL, SMALL)], **wrong))


def loops_imported_by(*places):
    """Loop files that the Python files in these folders, or these files, import."""
    found = set()
    for place in places:
        for path in [place] if place.is_file() else place.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module:
                    found.add(node.module.removeprefix("motionstereo_cli.compiled."))
                    if node.module == "motionstereo_cli.compiled":
                        found |= {alias.name for alias in node.names}
    return found


def test_every_loop_is_tried_on_random_sizes():
    """What ``process`` reaches is; others are called in a test of their own."""
    loops = {path.stem for path in (PACKAGE / "compiled").glob("*.py")} - {"__init__"}
    processed = loops_imported_by(PACKAGE / "method", PACKAGE / "robot")
    tested = loops_imported_by(Path(__file__), Path(__file__).with_name("test_simulate.py"))
    assert loops - processed - tested == set()
