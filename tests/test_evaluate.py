"""The evaluation: measures worked out by hand, formats, and the command from outside."""

import csv
import dataclasses
import io
import json
import math
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motionstereo_cli.errors import InputError
from motionstereo_cli.evaluation.evaluate import Comparison, FramePair, evaluate, tally
from motionstereo_cli.evaluation.evaluate_report import draw_errors, format_table
from motionstereo_cli.files.encode import encode_pfm, encode_png, encode_tiff
from motionstereo_cli.rig import write_rig
from motionstereo_cli.sinks.images import depth_png, disparity_png
from motionstereo_cli.sinks.read_back import Maps
from motionstereo_cli.types import Rig

NAN = math.nan
RIG = Rig(width=4, height=2, focal_px=100.0, baseline_m=0.2, cx=1.5, cy=0.5)


def row(*values):
    return np.array([values], np.float32)


def pfm(path, image, order="<"):
    """Write a PFM as its definition has it: last row first, the scale's sign tells the order."""
    scale = "-0.003922" if order == "<" else "0.003922"  # as in Middlebury's files
    head = f"Pf\n{image.shape[1]} {image.shape[0]}\n{scale}\n".encode()
    path.write_bytes(head + image[::-1].astype(f"{order}f4").tobytes())


def png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def disparity(folder, *images, first=0):
    """Write disparity in px as KITTI has it."""
    for number, image in enumerate(images, first):
        png(folder / f"{number:06d}.png", np.rint(np.nan_to_num(image) * 256).astype(np.uint16))


@pytest.fixture
def sides(tmp_path):
    """A result and a truth of two frames, 4x2; errors 0.5, 1, 4 px, then 0 everywhere."""
    truth = np.array([[10, 20, 30, 40], [10, 20, NAN, 40]], np.float32)
    found = np.array([[10.5, 19, 34, NAN], [NAN, NAN, 30, NAN]], np.float32)
    disparity(tmp_path / "out" / "disparity", found, truth)
    disparity(tmp_path / "truth" / "disparity", truth, truth)
    return tmp_path / "out", tmp_path / "truth"


# The measures.


def test_disparity_measures_worked_out_by_hand():
    # Errors 0, 0.5, 0.75, 1.5, 2.5, 3.5 (3.5 % of the truth), 4 (20 %); one has no result, two no
    # truth.
    truth = row(10, 10, 10, 10, 10, 100, 20, 30, NAN, NAN)
    found = row(10, 10.5, 9.25, 11.5, 7.5, 103.5, 24, NAN, 5, NAN)
    score = tally(FramePair(found, truth)).score(3)
    assert score.frame == 3
    assert (score.truth_pixels, score.both_pixels) == (8, 7)
    assert score.coverage == 7 / 8
    assert (score.bad_0_5, score.bad_1, score.bad_2, score.bad_3) == (5 / 7, 4 / 7, 3 / 7, 2 / 7)
    assert score.d1 == 1 / 7
    assert score.mean_px == pytest.approx(12.75 / 7)
    assert score.median_px == 1.5
    squares = 0.25 + 0.5625 + 2.25 + 6.25 + 12.25 + 16
    assert score.rms_px == pytest.approx(math.sqrt(squares / 7))
    assert math.isnan(score.abs_rel)
    assert math.isnan(score.rmse_m)


def test_bias_is_told_apart_by_disparity_and_cut():
    score = tally(FramePair(row(0.7, 2.5, 2, 14, 9), row(0.5, 1, 2.5, 4, 10))).score()
    biases = score.bias_0_1_px, score.bias_1_3_px, score.bias_3_10_px, score.bias_10_px
    assert biases == pytest.approx((0.2, 0.5, 3, -1))


@pytest.mark.parametrize("reference", ["right", "left"])
def test_what_both_cameras_see_is_neither_hidden_nor_outside(reference):
    truth = row(1, 4, 1, 1, 1, 1, 1, 4)  # the second hides the fifth, the last two look outside
    found = row(1, 4, NAN, 1, NAN, 1, NAN, NAN)
    if reference == "left":
        truth, found = truth[:, ::-1], found[:, ::-1]
    score = tally(FramePair(found, truth, reference=reference)).score()
    assert score.coverage_seen == pytest.approx(4 / 6)


def test_changes_from_frame_to_frame_worked_out_by_hand():
    # Errors 0, 0.5, 0, 3 then 0.25, 0.5, 2, unknown; the truth of the third and fourth moves.
    before = FramePair(row(5, 5.5, 5, 8, NAN), row(5, 5, 5, 5, 5))
    after = FramePair(row(5.25, 5.5, 8, NAN, 5), row(5, 5, 6, 6, 5))
    score = tally(after, before).score()
    assert score.tepe_px == pytest.approx((0.25 + 0 + 2) / 3)
    assert score.tepe_1 == pytest.approx(1 / 3)
    assert (score.flicker_px, score.flicker_1) == (0.125, 0)


def test_an_error_of_exactly_the_limit_is_not_bad():
    score = tally(FramePair(row(10.5, 11, 12, 13), row(10, 10, 10, 10))).score()
    assert (score.bad_0_5, score.bad_1, score.bad_2, score.bad_3) == (0.75, 0.5, 0.25, 0)


def test_depth_measures_worked_out_by_hand():
    # The truth at 100 m does not count, the result at 200 m counts as 80 m.
    truth_m = row(2, 4, 10, 100, 5)
    found_m = row(3, 3, 200, 100, NAN)
    score = tally(FramePair(row(1, 1, 1, 1, NAN), row(1, 1, 1, 1, 1), found_m, truth_m)).score()
    assert score.abs_rel == pytest.approx((1 / 2 + 1 / 4 + 70 / 10) / 3)
    assert score.rmse_m == pytest.approx(math.sqrt((1 + 1 + 4900) / 3))


def test_the_median_of_an_even_number_lies_between_the_middle_two():
    assert tally(FramePair(row(1, 2, 4, 9), row(0, 0, 0, 0))).score().median_px == 3


def test_nothing_to_measure_is_nan():
    score = tally(FramePair(row(NAN, NAN), row(1, NAN))).score()
    assert (score.truth_pixels, score.both_pixels, score.coverage) == (1, 0, 0)
    assert all(math.isnan(v) for v in (score.bad_1, score.d1, score.mean_px, score.median_px))


pixels = st.lists(
    st.tuples(*[st.one_of(st.just(NAN), st.integers(1, 60_000).map(lambda n: n / 256))] * 2),
    min_size=1,
    max_size=30,
)


@given(pixels, pixels)
def test_the_sum_of_two_tallies_is_that_of_all_their_pixels(one, other):
    def pair(pairs):
        found, truth = np.array(pairs, np.float32).T[:, None]
        return FramePair(found, truth, 50 / found, 50 / truth)

    added, at_once = (
        (tally(pair(one)) + tally(pair(other))).score(),
        tally(pair(one + other)).score(),
    )
    # Which pixels both cameras see depends on where they are.
    for name in set(at_once.__slots__) - {"frame", "coverage_seen"}:
        assert getattr(added, name) == pytest.approx(getattr(at_once, name), nan_ok=True), name
    errors = [abs(f - t) for f, t in one + other if not math.isnan(f - t)]
    assert at_once.median_px == pytest.approx(np.median(errors) if errors else NAN, nan_ok=True)


# Formats.


def test_png_is_read_as_what_its_folder_says(tmp_path):
    stored = np.array([[0, 256, 65535]], np.uint16)
    for folder in ("disp_occ_0", "depth_of_mine"):
        png(tmp_path / folder / "0.png", stored)
    disparity_px = Maps(tmp_path / "disp_occ_0").read(0)
    np.testing.assert_array_equal(disparity_px, row(NAN, 1, 65535 / 256))
    assert disparity_px.dtype == np.float32
    depth_m = Maps(tmp_path / "depth_of_mine").read(0)
    np.testing.assert_allclose(depth_m, row(NAN, 0.256, 65.535))
    assert Maps(tmp_path / "depth_of_mine", "disparity").read(0)[0, 1] == 1


@pytest.mark.parametrize("order", "<>")
def test_pfm_is_read_upright_and_unscaled(tmp_path, order):
    image = np.array([[1.25, math.inf], [0, 70.5], [NAN, -1]], np.float32)
    pfm(tmp_path / "7.pfm", image, order)
    expected = np.array([[1.25, NAN], [NAN, 70.5], [NAN, NAN]], np.float32)
    np.testing.assert_array_equal(Maps(tmp_path, "disparity").read(7), expected)


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("000002_10.png", "000010_10.png"), [2, 10]),
        (("scene3_frame9.png", "scene3_frame10.png"), [9, 10]),
        (("left07.png",), [7]),
    ],
)
def test_frame_numbers_come_from_the_names(tmp_path, names, numbers):
    for name in names:
        png(tmp_path / name, np.ones((1, 1), np.uint16))
    assert list(Maps(tmp_path, "disparity").files) == numbers


def test_depth_and_disparity_meet_through_the_rigs(tmp_path):
    # 20 px m: 10 px is 2 m. The result's own rig has doffs 5: 2 m is 5 px, 4 m is 0 px.
    with_doffs = {**{name: getattr(RIG, name) for name in RIG.__slots__}, "doffs": 5.0}
    png(tmp_path / "out" / "depth" / "0.png", np.array([[2000, 4000, 0, 2000]] * 2, np.uint16))
    (tmp_path / "out" / "run.json").write_text(json.dumps({"rig": with_doffs}))
    disparity(tmp_path / "truth" / "disparity", np.full((2, 4), 10, np.float32))
    write_rig(tmp_path / "truth" / "rig.yaml", RIG)
    comparison = Comparison(Maps(tmp_path / "out"), Maps(tmp_path / "truth" / "disparity"))
    pair = comparison.pair(0)
    np.testing.assert_allclose(pair.found_px[:1], row(5, 0, NAN, 5))
    np.testing.assert_allclose(pair.found_m[:1], row(2, 4, NAN, 2))
    np.testing.assert_allclose(pair.truth_m, 2)


def test_only_masked_in_pixels_count(sides, tmp_path):
    out, truth = sides
    counted = np.zeros((2, 4, 3), np.uint8)
    counted[0, 1:3, 0] = 1
    for number in (0, 1):
        png(tmp_path / "mask" / f"{number}.png", counted)
    comparison = Comparison(Maps(out), Maps(truth), mask=tmp_path / "mask")
    first = evaluate(comparison).frames[0]
    assert (first.truth_pixels, first.both_pixels, first.mean_px) == (2, 2, 2.5)


def test_overall_pools_the_pixels_and_names_the_worst_frame(sides):
    report = evaluate(Comparison(*map(Maps, sides)))
    assert [score.frame for score in report.frames] == [0, 1]
    assert report.overall.both_pixels == 3 + 7
    assert report.overall.mean_px == pytest.approx(5.5 / 10)
    assert report.overall.bad_1 == 0.1
    assert report.worst.frame == 0
    assert re.search(r"bad_1 +0\.1000 +0\.3333\n", format_table(report))


def test_the_worst_frame_of_a_perfect_result_is_the_one_with_most_truth(tmp_path):
    truth = np.stack([np.full((2, 4), level, np.float32) for level in (NAN, 9, 9)])
    truth[1, 0] = NAN
    disparity(tmp_path / "truth", *truth)
    assert evaluate(Comparison(*[Maps(tmp_path / "truth", "disparity")] * 2)).worst.frame == 2


def test_frames_of_one_side_alone_are_counted_and_not_scored(sides):
    out, truth = sides
    disparity(out / "disparity", np.ones((2, 4), np.float32), first=2)
    (truth / "disparity" / "000000.png").unlink()
    report = evaluate(Comparison(Maps(out), Maps(truth)))
    assert [score.frame for score in report.frames] == [1]
    assert (report.only_out, report.only_truth) == (2, 0)


def test_the_picture_has_a_colour_for_each_kind_of_pixel():
    truth = np.tile(row(10, 10, 10, 10, 10, 10, NAN), (30, 60))
    found = np.tile(row(10, 11, 12, 13, 14, NAN, 10), (30, 60))
    picture = draw_errors(FramePair(found, truth))
    assert picture.dtype == np.uint8
    assert picture.shape[0] > 30
    shown = [tuple(int(level) for level in bgr) for bgr in picture[0, :7]]
    assert len(set(shown)) == 7
    assert shown[5:] == [(0, 0, 0), (64, 64, 64)]
    legend = {tuple(int(level) for level in bgr) for bgr in picture[30:].reshape(-1, 3)}
    assert set(shown) <= legend


# Bad input.


def spoiled(tmp_path, spoil):
    """Return the sides after something was spoiled."""
    truth = np.ones((2, 4), np.float32)
    for side in ("out", "truth"):
        disparity(tmp_path / side / "disparity", truth)
    spoil(tmp_path)
    return tmp_path / "out", tmp_path / "truth"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda t: (t / "out/disparity/000000.png").unlink(),
            "has no .png or .pfm or .tif or .tiff or .npy files",
        ),
        (lambda t: (t / "out/disparity/000000.png").rename(t / "out/disparity/a.png"), "number"),
        (lambda t: (t / "out/disparity/000000.png").rename(t / "out/disparity/7.png"), "no frame"),
        (lambda t: (t / "out/disparity/000000.png").write_bytes(b"text"), "cannot be read"),
        (lambda t: png(t / "out/disparity/0.png", np.ones((2, 4), np.uint16)), "several files"),
        (lambda t: png(t / "out/disparity/000000.png", np.ones((2, 4), np.uint8)), "16-bit"),
        (lambda t: png(t / "out/disparity/000000.png", np.ones((3, 4), np.uint16)), "4x3 but"),
        (lambda t: png(t / "truth/disparity/000000.png", np.zeros((2, 4), np.uint16)), "no pixel"),
        (lambda t: (t / "out/disparity").rename(t / "out/depth"), "give --rig"),
        (lambda t: (t / "out/disparity").rename(t / "out/mine"), "has no .png"),
        (
            lambda t: (t / "out/run.json").write_text('{"rig": {"f": 1}}'),
            "rig: object missing required field width",
        ),
        (lambda t: (t / "truth/rig.yaml").write_text("width: 9"), "height is missing"),
        (lambda t: write_rig(t / "out/rig.yaml", Rig(5, 2, 1, 1, 0, 0)), "the rig is for 5x2"),
    ],
)
def test_bad_input_is_refused_in_one_line(tmp_path, spoil, message):
    out, truth = spoiled(tmp_path, spoil)
    with pytest.raises(InputError, match=re.escape(message)) as refused:
        evaluate(Comparison(Maps(out), Maps(truth)))
    assert "\n" not in str(refused.value)


def test_a_folder_whose_name_tells_nothing_is_refused(tmp_path):
    png(tmp_path / "mine" / "0.png", np.ones((1, 1), np.uint16))
    with pytest.raises(InputError, match="--out-kind or --truth-kind"):
        Maps(tmp_path / "mine")


def test_a_missing_or_misshapen_mask_is_refused(sides, tmp_path):
    out, truth = map(Maps, sides)
    png(tmp_path / "mask" / "0.png", np.ones((2, 5), np.uint8))
    with pytest.raises(InputError, match="no PNG for frame 1"):
        Comparison(out, truth, mask=tmp_path / "mask")
    png(tmp_path / "mask" / "1.png", np.ones((2, 5), np.uint8))
    with pytest.raises(InputError, match="5x2 but the truth is 4x2"):
        evaluate(Comparison(out, truth, mask=tmp_path / "mask"))


DEPTH_M = np.float32([[1.25, 2.5, NAN, 5], [3, 4, 5, 6]])
WITH_DOFFS = dataclasses.replace(RIG, doffs=2)
DISPARITY_PX = 100 * 0.2 / DEPTH_M - 2


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("depth/000000.png", encode_png(depth_png(DISPARITY_PX, WITH_DOFFS, 5000))),
        ("depth-pfm/000000.pfm", encode_pfm(DEPTH_M)),
        ("depth-tiff/000000.tiff", encode_tiff(DEPTH_M)),
        ("disparity/000000.png", encode_png(disparity_png(DISPARITY_PX))),
        ("disparity-pfm/000000.pfm", encode_pfm(DISPARITY_PX)),
    ],
)
def test_every_format_of_a_run_is_read_by_itself(tmp_path, name, content):
    record = {"rig": dataclasses.asdict(WITH_DOFFS), "output_settings": {"depth_scale": 5000}}
    (tmp_path / name).parent.mkdir()
    (tmp_path / name).write_bytes(content)
    (tmp_path / "run.json").write_text(json.dumps(record))
    disparity(tmp_path / "truth", DISPARITY_PX)
    truth = Maps(tmp_path / "truth", "disparity")
    overall = evaluate(Comparison(Maps(tmp_path), truth)).overall
    assert overall.coverage == 1
    assert overall.rms_px < 1 / 256
    assert overall.rmse_m < 0.01


# The command from outside.


def called(*args, cwd):
    command = [sys.executable, "-m", "motionstereo_cli", "evaluate", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


def test_the_command_prints_a_table_and_writes_what_is_asked_for(sides, tmp_path):
    files = ["--csv", "s.csv", "--json", "s.json", "--picture", "0", "-o", "e.png"]
    done = called(*sides, *files, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search(r"coverage +0\.7143 +0\.4286\n", done.stdout)
    assert "errors in m need a rig" in done.stderr
    rows = list(csv.DictReader((tmp_path / "s.csv").open()))
    assert [r["frame"] for r in rows] == ["0", "1", "overall"]
    assert (rows[2]["both_pixels"], rows[2]["bad_1"], rows[2]["rmse_m"]) == ("10", "0.1", "")
    report = json.loads((tmp_path / "s.json").read_text())
    assert report["overall"]["bad_1"] == 0.1
    assert report["overall"]["rmse_m"] is None
    assert [frame["frame"] for frame in report["frames"]] == [0, 1]
    assert cv2.imread(str(tmp_path / "e.png")).shape[0] > 2


def test_two_views_are_warned_of(sides, tmp_path):
    """A run in the left view, beside what simulate wrote."""
    record = {"rig": None, "settings": {"reference": "left"}}
    (sides[0] / "run.json").write_text(json.dumps(record))
    assert "warning" not in called(*sides, cwd=tmp_path).stderr
    write_rig(sides[1] / "rig.yaml", RIG)
    done = called(*sides, cwd=tmp_path)
    assert "warning: OUT is in the left view, but TRUTH in the right one\n" in done.stderr
    # The name of a folder says more than what lies beside it.
    named = (sides[1] / "disparity").rename(sides[1] / "disparity_left")
    assert "warning" not in called(sides[0], named, cwd=tmp_path).stderr


def test_truth_of_kitti_is_in_the_left_view(sides, tmp_path):
    write_rig(sides[0] / "rig.yaml", RIG)  # as simulate's own results, in the right view
    (sides[1] / "disparity").rename(sides[1] / "disp_occ_0")
    done = called(sides[0], sides[1] / "disp_occ_0", cwd=tmp_path)
    assert "warning: OUT is in the right view, but TRUTH in the left one\n" in done.stderr


def test_truth_of_another_unit_is_warned_of_and_can_be_told(sides, tmp_path):
    write_rig(sides[0] / "rig.yaml", RIG)
    for number in range(2):
        truth_px = Maps(sides[1]).read(number)
        depth = np.nan_to_num(256 * RIG.focal_px * RIG.baseline_m / truth_px)
        png(tmp_path / f"depth_kitti/{number:06d}.png", np.rint(depth).astype(np.uint16))
    done = called(sides[0], "depth_kitti", cwd=tmp_path)
    assert "warning: depths are 3.7 times those of TRUTH: check its unit" in done.stderr
    done = called(sides[0], "depth_kitti", "--truth-scale", "256", "--json", "-", cwd=tmp_path)
    assert "times those of TRUTH" not in done.stderr
    assert json.loads(done.stdout)["overall"]["bad_1"] == 0.1


def test_frames_are_matched_by_their_places_in_the_recording(tmp_path):
    images = [np.full((2, 4), 10.0 + number, np.float32) for number in range(8)]
    disparity(tmp_path / "truth/disparity", *images)
    disparity(tmp_path / "out/disparity", *images[2::3])
    record = {
        "input_settings": {"start": "0.2s", "every": 3},
        "inputs": {"right": {"path": "right.mp4", "frame_rate": "10"}},
        "counts": {"written": 2, "right": {"unpaired": 1}},
    }
    (tmp_path / "out/run.json").write_text(json.dumps(record))
    done = called("out", "truth", "--json", "-", cwd=tmp_path)
    report = json.loads(done.stdout)
    assert [frame["frame"] for frame in report["frames"]] == [2, 5]
    assert report["overall"]["mean_px"] == 0
    assert "note: frame n of OUT is image 2 + 3 n of its recording" in done.stderr
    assert "warning: 1 images of the recording were lost or had no partner" in done.stderr
    done = called("out", "truth", "--picture", "1", cwd=tmp_path)
    assert "frame 1 is not on both sides, by its place in the recording: out" in done.stderr
    assert "(2 to 5)" in done.stderr


@pytest.mark.parametrize(
    ("said", "code", "words"),
    [({"of_another_version": 1}, 0, ""), ({"start": "abc"}, 1, "run.json: --start cannot be")],
)
def test_a_record_tells_only_where_a_run_began(sides, tmp_path, said, code, words):
    (sides[0] / "run.json").write_text(json.dumps({"input_settings": said}))
    done = called(*sides, cwd=tmp_path)
    assert done.returncode == code
    assert words in done.stderr
    assert "internal" not in done.stderr


def test_dash_puts_csv_on_standard_output_alone(sides, tmp_path):
    disparity(sides[0] / "disparity", np.ones((2, 4), np.float32), first=9)
    done = called(*sides, "--csv", "-", cwd=tmp_path)
    assert done.returncode == 0
    assert "warning: 1 frames are only in OUT" in done.stderr
    assert len(list(csv.DictReader(io.StringIO(done.stdout)))) == 3


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["--csv", "-", "--json", "-"], 2, "cannot both go to standard output"),
        (["--truth-kind", "depth"], 1, "has no .png or .pfm or .tif or .tiff or .npy files"),
        (["--picture", "5"], 1, "frame 5 is not on both sides"),
        (["--csv", "missing/s.csv"], 1, "cannot write missing/s.csv"),
        (["--rig", "missing.yaml"], 1, "cannot read the rig missing.yaml"),
    ],
)
def test_the_command_fails_in_one_line(sides, tmp_path, args, code, message):
    done = called(*sides, *args, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (code, "")
    assert message in done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in done.stderr


def test_a_missing_folder_is_one_line(tmp_path):
    done = called("nothing", "here", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr == ("error: cannot read the folder nothing: No such file or directory\n")
