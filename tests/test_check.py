"""What check says about simulated recordings whose faults are known."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from motionstereo_cli.__main__ import main
from motionstereo_cli.check import features, mounting
from motionstereo_cli.check.advice import advised, as_toml
from motionstereo_cli.check.findings import CheckReport, Finding
from motionstereo_cli.check.measure import WINDOW_FRAMES, check, step_of, watched
from motionstereo_cli.check.mounting import Mounting
from motionstereo_cli.rig.settings import RigSettings
from motionstereo_cli.simulate.scenes import render_scene
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import Rig, StereoFrame

SAMPLE = Path(__file__).parent.parent / "sample_data"
MAX_DISPARITY = 64
FRAMES = 36
SHORT = 20

Views = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module", autouse=True)
def keypoints_found_once() -> Iterator[None]:
    """The same images are checked again and again, spoilt in other ways: most time goes there."""
    found: dict[tuple[tuple[int, ...], bytes], features.Keypoints] = {}
    find = features.keypoints

    def once(image: np.ndarray) -> features.Keypoints:
        key = image.shape, hashlib.sha256(np.ascontiguousarray(image)).digest()
        if key not in found:
            found[key] = find(image)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (features, mounting):
            patch.setattr(module, "keypoints", once)
        yield


def simulated(trial: int, frames: int = FRAMES) -> Views:
    """A recording: left and right, (frames, height, width) uint8."""
    rng = np.random.default_rng(trial)
    start = int(rng.integers(0, 450))
    scene = ("corridor", "cards")[trial % 2]
    settings = SimulateSettings(
        scene=scene,
        frames=f"{start}:{start + frames}",
        noise_sigma=float(rng.choice([0, 1.5, 2.5, 4])),
        pan=scene == "cards" and bool(rng.integers(2)),
        # The wall behind the cards repeats itself every 4 m: a long lens sees no more of it.
        focal_px=560.0 if scene == "cards" else 0.0,
        seed=trial,
    )
    shots = list(render_scene(settings))
    return np.stack([shot.left for shot in shots]), np.stack([shot.right for shot in shots])


def turned(images: np.ndarray, degrees: float) -> np.ndarray:
    height, width = images.shape[1:]
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1)
    return np.stack([cv2.warpAffine(image, turn, (width, height)) for image in images])


def still(images: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 2.5, images.shape)
    return (images[:1] + noise).round().clip(0, 255).astype(np.uint8)


SPOILT = {
    "swapped": ("swapped", lambda left, right: (right, left)),
    "late": ("out-of-step", lambda left, right: (left[2:], right[:-2])),
    "early": ("out-of-step", lambda left, right: (left[:-2], right[2:])),
    "turned": ("misaligned", lambda left, right: (left, turned(right, 1))),
    "still": ("still", lambda left, right: (still(left), still(right))),
}


def frames_of(views: Views) -> list[StereoFrame]:
    return [StereoFrame(i, i, None, *pair) for i, pair in enumerate(zip(*views, strict=True))]


def checked(views: Views, max_disparity: int = MAX_DISPARITY) -> CheckReport:
    return check(frames_of(views), max_disparity, expected_frames=len(views[0]))


def said(views: Views) -> list[Finding]:
    """What is said at the start of a run."""
    told: list[Sequence[Finding]] = []
    frames = frames_of(views)
    assert list(watched(iter(frames), MAX_DISPARITY, told.append)) == frames
    (findings,) = told
    return list(findings)


def test_trial(trial: int) -> None:
    views = simulated(trial)
    good = checked(views)
    assert good.findings == ()
    assert not good.ruined
    assert said(views) == []
    for case, (name, spoil) in SPOILT.items():
        spoilt = spoil(*views)
        report = checked(spoilt)
        assert name in [finding.name for finding in report.findings], case
        assert report.ruined
        assert name in [finding.name for finding in said(spoilt)], case
        if name == "out-of-step":
            wanted = 2 if case == "early" else -2
            assert report.ahead_frames == pytest.approx(wanted, abs=0.4)
            (line,) = [f.text for f in report.findings if f.name == name]
            assert line.endswith(f"add {-wanted} to --sync-offset")


@pytest.fixture(scope="module")
def corridor() -> Views:
    return simulated(0, SHORT)


@pytest.mark.parametrize("ahead", [0, 1, -3])
def test_one_judge_tells_check_run_and_the_measurement_the_step(
    corridor: Views, ahead: int
) -> None:
    length = len(corridor[0]) - abs(ahead)
    views = corridor[0][max(0, -ahead) :][:length], corridor[1][max(0, ahead) :][:length]
    report, step = checked(views), step_of(frames_of(views), length)
    assert step is not None
    assert (report.step_frames, report.step_certain) == (ahead, True)
    assert (step.whole, step.is_certain) == (ahead, True)
    steps = [each for each in said(views) if each.name == "out-of-step"]
    assert [each.numbers["step_frames"] for each in steps] == ([ahead] if ahead else [])


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize(("certain", "moving"), [(False, 0.1), (True, 0.1), (False, None)])
def test_rows_that_do_not_agree_may_be_out_of_step(
    calibrated: bool, certain: bool, moving: float | None
) -> None:
    off = {"misaligned_px": 3.0, "misaligned_p90_px": 4.0, "misaligned_image_px": 3.0}
    off |= {"shifted_px": 3.0, "turned_deg": 0.0, "negative": 0.3, "disparity_low_px": -9.0}
    report = CheckReport(
        64,
        frames=16,
        calibrated=calibrated,
        matches=500,
        ahead_frames=0.0,
        step_certain=certain,
        moving=moving,
        **off,  # type: ignore[arg-type]
    )
    texts = {each.name: each.text for each in report.findings}
    for name in ("misaligned", "negative-disparity"):
        assert ("--sync-offset auto" in texts[name]) == (not certain and moving is not None)


def square(views: Views) -> Views:
    side = min(views[0].shape[1:])
    return views[0][:, :side, :side], views[1][:, :side, :side]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda le, ri: (le, ri[:, ::-1, ::-1]),
            "upside down against .* give --rotate-right 180",
        ),
        (lambda le, ri: (le, ri[:, :, ::-1]), "mirrored against the left one: give --mirror-right"),
        (lambda le, ri: (le, ri[:, ::-1]), "give --mirror-right --rotate-right 180"),
        (lambda le, ri: (le, np.rot90(ri, 1, (1, 2))), "on its side .* give --rotate-right 90"),
        (lambda le, ri: (le, np.rot90(ri, -1, (1, 2))), "give --rotate-right 270"),
        (lambda le, ri: (le[:, ::-1, ::-1], ri), "left view is upside .* give --rotate-left 180"),
        (lambda le, ri: (le[:, :, ::-1], ri), "left view is mirrored .* give --mirror-left"),
        (lambda le, ri: (np.rot90(le, 1, (1, 2)), ri), "left view is on .* give --rotate-left 90"),
        (
            lambda le, ri: (np.rot90(le, 1, (1, 2)), np.rot90(ri, 1, (1, 2))),
            "one above the other: give --rotate-left 90 --rotate-right 90",
        ),
    ],
)
def test_views_that_stand_otherwise_are_named(corridor: Views, spoil: Any, said: str) -> None:
    views = square(corridor) if "9" in said or "27" in said else corridor
    spoilt = tuple(np.ascontiguousarray(side) for side in spoil(*views))
    report = checked((spoilt[0], spoilt[1]))
    (line,) = [finding.text for finding in report.findings if finding.name == "turned"]
    assert re.search(said, line)
    assert report.ruined
    assert "misaligned" not in [finding.name for finding in report.findings]


def test_one_view_twice_is_named(corridor: Views) -> None:
    noise = np.random.default_rng(0).normal(0, 0.5, corridor[0].shape)
    again = (corridor[0] + noise).round().clip(0, 255).astype(np.uint8)
    report = checked((corridor[0], again))
    assert report.findings[0].name == "identical"
    assert report.ruined


def test_one_view_twice_is_named_through_the_noise_of_two_cameras(corridor: Views) -> None:
    noise = np.random.default_rng(0).normal(0, 4, (2, *corridor[0].shape))
    left, right = (corridor[0] + noise).round().clip(0, 255).astype(np.uint8)
    assert checked((left, right)).findings[0].name == "identical"


def test_both_views_upside_down_are_not_taken_for_swapped_without_a_word(corridor: Views) -> None:
    left, right = (np.ascontiguousarray(side[:, ::-1, ::-1]) for side in corridor)
    (line,) = [each.text for each in checked((left, right)).findings if each.name == "swapped"]
    assert "if both are upside down, give --rotate-left 180 --rotate-right 180" in line


def test_dark_images_are_named_and_light_is_asked_for(corridor: Views) -> None:
    report = checked((corridor[0] // 16, corridor[1] // 16))
    assert report.findings[0].name == "dark"
    assert "give --white" in report.findings[0].text
    assert "still" not in [finding.name for finding in report.findings]


def test_what_is_measured(corridor: Views) -> None:
    report = checked(corridor)
    assert report.frames == SHORT
    assert report.matches > 100
    assert report.misaligned_px is not None
    assert report.misaligned_px < 0.4
    assert report.turned_deg == pytest.approx(0, abs=0.1)
    # The corridor's walls are 1.5 m away, its end is at most 20 m away.
    assert report.disparity_low_px is not None
    assert report.disparity_high_px is not None
    assert 278 * 0.12 / 20 < report.disparity_low_px < report.disparity_high_px < 278 * 0.12 / 1.2
    # What is nearest has few features: there is a margin.
    advised = report.advised_max_disparity
    assert advised is not None
    assert 1.5 * report.disparity_high_px <= advised <= 32
    assert report.grey_difference == pytest.approx(0, abs=2)
    assert report.moving is not None
    assert report.moving > 0.05
    assert (report.repeated_left, report.repeated_right) == (0, 0)
    assert json.loads(json.dumps(report.as_json()))["ruined"] is False


def test_a_turn_is_measured(corridor: Views) -> None:
    left, right = corridor
    for degrees in (-1.0, 2.0):
        # OpenCV turns counter-clockwise, so what lay at the right goes up.
        report = checked((left, turned(right, degrees)))
        assert report.turned_deg == pytest.approx(-degrees, abs=0.2)


def test_a_shift_is_measured(corridor: Views) -> None:
    left, right = corridor
    report = checked((left[:, :-3], right[:, 3:]))
    assert report.misaligned_px == pytest.approx(3, abs=0.2)
    assert [finding.name for finding in report.findings] == ["misaligned"]


def test_range_below_and_above(corridor: Views) -> None:
    left, right = corridor
    above = checked(corridor, max_disparity=3)
    assert [finding.name for finding in above.findings] == ["beyond-range"]
    assert "--max-disparity 16" in above.findings[0].text
    # Cameras that converge: far things have disparities below 0, near things above.
    converging = checked((left[:, :, 5:], right[:, :, :-5]))
    assert [finding.name for finding in converging.findings] == ["negative-disparity"]
    assert converging.disparity_low_px is not None
    assert converging.disparity_low_px < -1


@pytest.mark.parametrize(("seed", "pan"), [(0, False), (1, True)])
def test_a_wall_that_repeats_itself_behind_objects_does_not_widen_the_range(
    seed: int, pan: bool
) -> None:
    shots = list(render_scene(SimulateSettings(scene="cards", frames="0:16", seed=seed, pan=pan)))
    true = np.percentile([shot.disparity_px for shot in shots], [0, 100])
    report = checked((np.stack([s.left for s in shots]), np.stack([s.right for s in shots])))
    assert true[0] - 1 < report.disparity_low_px < report.disparity_high_px < true[1] + 1
    assert report.advised_max_disparity == 32


@pytest.mark.parametrize(
    ("repeats", "left"),
    [
        ([40] * 12, {5, 30}),  # 85 is as far from 45 as that from 5
        ([40] * 11, {5, 30, 45}),  # too few for twelve matches
        ([40] * 9, {-35, 5, 30, 45, 85}),  # too few for any
        ([40] * 12 + list(range(100, 800, 10)), {-35, 5, 30, 45, 85}),  # few of many
        ([], {-35, 5, 30, 45, 85}),
    ],
)
def test_repetitions_explain_disparities_that_fewer_matches_have(
    repeats: list[int], left: set[int]
) -> None:
    column = np.array([5.0] * 30 + [45.0] * 12 + [-35.0, 30.0, 85.0])
    matches = features.Matches(*[column] * 6)
    kept = features.without_repetitions(matches, np.array(repeats, np.float64))
    assert set(kept.disparity) == left


def test_known_principal_points_excuse_negative_disparities(corridor: Views) -> None:
    left, right = corridor
    frames = frames_of((left[:, :, 12:], right[:, :, :-12]))
    height, width = left[0].shape
    rig = Rig(width - 12, height, 200.0, 0.1, 100.0, 80.0, doffs=12.0)
    report = check(frames, MAX_DISPARITY, expected_frames=SHORT, rig=rig)
    assert "swapped" not in [finding.name for finding in report.findings]
    assert "negative-disparity" in [finding.name for finding in report.findings]


def test_an_offset_that_leaves_nothing_is_the_cause_and_not_the_order_of_the_views(
    corridor: Views,
) -> None:
    height, width = corridor[0][0].shape
    rig = Rig(width, height, 200.0, 0.1, 100.0, 80.0)
    for offset_px, names in ((-70.0, ["offset-too-low"]), (2.0, []), (0.0, [])):
        frames = frames_of(corridor)
        mended = rig.with_disparity_offset(offset_px)
        report = check(
            *(frames, MAX_DISPARITY),
            expected_frames=SHORT,
            rig=mended,
            given_offset_px=offset_px,
        )
        found = [finding.name for finding in report.findings]
        assert [name for name in found if name in ("swapped", "offset-too-low")] == names
    text = (
        check(
            *(frames_of(corridor), MAX_DISPARITY),
            rig=rig.with_disparity_offset(-70.0),
            given_offset_px=-70.0,
        )
        .findings[0]
        .text
    )
    assert text.startswith("--disparity-offset -70 puts 100% of the matches beyond infinity")


def test_where_a_calibration_was_given_it_is_what_does_not_fit(corridor: Views) -> None:
    left, right = corridor
    height, width = left[0].shape
    rig = Rig(width, height, 200.0, 0.1, 100.0, 80.0)
    for views, name in (
        ((left[:, :-3], right[:, 3:]), "misaligned"),
        ((left[:, :, 5:], right[:, :, :-5]), "negative-disparity"),
        ((right, left), "swapped"),
    ):
        frames = frames_of(views)
        report = check(frames, MAX_DISPARITY, expected_frames=len(views[0]), rig=rig)
        text = next(finding.text for finding in report.findings if finding.name == name)
        assert "calibration" in text
        assert "--rig" not in text


def test_grey_difference(corridor: Views) -> None:
    left, right = corridor
    report = checked(((left * 0.8).astype(np.uint8), right))
    (finding,) = report.findings
    assert (finding.name, finding.ruins) == ("grey-difference", False)
    assert finding.text.startswith("the right recording is")
    assert report.grey_difference is not None
    assert report.grey_difference < -15


def test_repeated_and_frozen_frames(corridor: Views) -> None:
    left, right = corridor
    repeating = right.copy()
    repeating[[7, 13]] = right[[6, 12]]
    report = checked((left, repeating))
    assert (report.repeated_left, report.repeated_right) == (0, 2)
    (finding,) = [f for f in report.findings if f.name == "repeated"]
    assert not finding.ruins
    assert "the right recording repeats itself in 2 of 20 frames, first in frame 7" in finding.text
    frozen = left.copy()
    frozen[6:] = left[6]
    report = checked((frozen, right))
    assert report.repeated_left == SHORT - 7
    assert report.ruined


def test_an_image_that_hardly_differs_from_the_last_one_is_no_repetition(corridor: Views) -> None:
    left, right = corridor
    halting = right.copy()
    for number in range(6, SHORT, 2):
        halting[number] = halting[number - 1]
        halting[number, 100:104, 100:104] ^= 1
    report = checked((left, halting))
    assert (report.repeated_left, report.repeated_right) == (0, 0)


def test_a_dark_opening_is_not_what_a_run_is_judged_by(corridor: Views) -> None:
    opening = np.full((WINDOW_FRAMES + 4, *corridor[0].shape[1:]), 2, np.uint8)
    lit = [np.concatenate([opening, view]) for view in corridor]
    assert said((lit[0], lit[1])) == []
    assert [finding.name for finding in said((opening, opening))][:1] == ["dark"]
    assert "swapped" in [finding.name for finding in said((lit[1], lit[0]))]


def test_frames_dropped_halfway_are_a_drift() -> None:
    left, right = simulated(2, 66)
    report = checked((left[:-2], np.delete(right, [30, 31], axis=0)))
    assert "drifting" in [finding.name for finding in report.findings]
    assert report.ruined


@pytest.mark.parametrize("frames", [2, 5, WINDOW_FRAMES - 1])
def test_short_recordings(corridor: Views, frames: int) -> None:
    left, right = (side[:frames] for side in corridor)
    report = checked((left, right))
    assert report.frames == frames
    assert report.misaligned_px is not None
    assert [finding.name for finding in report.findings] == []
    assert [finding.name for finding in said((right, left))] == ["swapped"]


def test_one_frame_alone_shows_no_motion(corridor: Views) -> None:
    left, right = (side[:1] for side in corridor)
    (finding,) = checked((left, right)).findings
    assert (finding.name, finding.ruins) == ("still", True)
    assert finding.text.startswith("one frame shows no motion")
    assert said((left, right)) == [finding]


def test_nothing_to_see() -> None:
    assert check([], MAX_DISPARITY).findings == ()
    grey = np.full((SHORT, 60, 80), 128, np.uint8)
    report = checked((grey, grey))
    assert [finding.name for finding in report.findings] == ["still", "few-matches"]
    assert [finding.name for finding in said((grey, grey))] == ["still"]


def test_a_single_column_is_no_failure(corridor: Views) -> None:
    left, right = (np.ascontiguousarray(side[:, :, 40:41]) for side in corridor)
    assert "few-matches" in [finding.name for finding in checked((left, right)).findings]


def test_unknown_length(corridor: Views) -> None:
    report = check(frames_of(corridor), MAX_DISPARITY)
    assert report.matches > 100
    assert report.findings == ()


def test_large_images_are_measured_in_their_own_px(corridor: Views) -> None:
    left, right = (
        np.stack([cv2.resize(image, (960, 720)) for image in side[:8]]) for side in corridor
    )
    report, small = checked((left[:, :-6], right[:, 6:])), checked(corridor)
    assert report.misaligned_px == pytest.approx(6, abs=0.4)
    assert report.disparity_high_px == pytest.approx(3 * small.disparity_high_px, rel=0.15)


# The command, and the start of a run.


def sample(*sides: str) -> list[str]:
    return [str(SAMPLE / f"{side}.mp4") for side in sides]


def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", *sample("left", "right"), "--rig", str(SAMPLE / "rig.yaml")]) == 0
    out = capsys.readouterr().out
    assert "advised: --max-disparity 32" in out
    assert re.search(
        r"^motion: +[\d.]+% of the image changes from one frame to the next, ", out, re.M
    )
    assert out.endswith("nothing wrong found\n")
    assert main(["check", *sample("right", "left"), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["ruined"]
    assert report["findings"][0]["name"] == "swapped"
    assert report["findings"][0]["ruins"]


def test_run_warns_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Trails match next to nothing in swapped views; planes of the default match half.
    run = ["run", *sample("right", "left"), "--preset", "fast"]
    run += ["--end", "20", "--save", "steering", "-o"]
    assert main([*run, str(tmp_path / "checked")]) == 0
    warnings = [w for w in capsys.readouterr().err.splitlines() if w.startswith("warning: ")]
    assert len(warnings) == 2
    assert "left and right are swapped" in warnings[0]
    # At the end it says what came of it, and why.
    assert "of what moved lately was matched: left and right seem to be swapped" in warnings[1]
    assert main([*run, str(tmp_path / "unchecked"), "--no-check"]) == 0
    assert "are swapped" not in capsys.readouterr().err
    tables = [(tmp_path / out / "steering.csv").read_bytes() for out in ("checked", "unchecked")]
    assert tables[0] == tables[1]


def written(folder: Path, views: Views) -> list[str]:
    for side, images in zip(("left", "right"), views, strict=True):
        (folder / side).mkdir(parents=True)
        for number, image in enumerate(images):
            assert cv2.imwrite(str(folder / side / f"{number}.png"), image)
    return [str(folder / side) for side in ("left", "right")]


def test_what_is_advised_mends_the_run(corridor: Views, tmp_path: Path, capsys: Any) -> None:
    left, right = corridor
    deep = (left[2:, ::-1, ::-1].astype(np.uint16) * 16, right[:-2].astype(np.uint16) * 16)
    recordings = written(tmp_path, deep)
    config = str(tmp_path / "run.toml")
    Path(config).touch()
    for _ in range(4):  # one mistake hides the next
        code = main(["check", *recordings, "--config", config, "--write", f"{config}.next"])
        assert f"run --config {config}.next" in capsys.readouterr().err
        Path(f"{config}.next").replace(config)
    assert code == 0
    values = tomllib.loads(Path(config).read_text())
    assert values == {
        "white": 4095,
        "rotate-left": 180,
        "sync-offset": "2",
        "max-disparity": 16,
    }
    assert "# disparities of" in Path(config).read_text()
    out = tmp_path / "out"
    assert main(["run", *recordings, "--config", config, "--save", "steering", "-o", str(out)]) == 0
    assert "warning" not in capsys.readouterr().err
    assert main(["check", *recordings, "--write", str(tmp_path / "left" / "0.png")]) == 1
    assert "an input of this run" in capsys.readouterr().err.splitlines()[-1]


def test_turns_follow_those_that_are_given() -> None:
    given = InputSettings(rotate_right=90, mirror_left=True)
    mounting = Mounting("", {"mirror_right": True, "rotate_right": 180, "rotate_left": 90})
    found = advised(
        CheckReport(64, frames=1, mounted=mounting, step_frames=3, ahead_frames=3), given
    )
    assert {each.name: each.value for each in found} == {
        "mirror_right": True,  # and 180 - 90, as before
        "rotate_left": 90,
        "sync_offset": -3,
        "max_disparity": "auto",
    }
    text = as_toml(
        ["why"], (given, RigSettings(baseline_unit="mm")), [Path('a"\n\x7f.yaml')], found
    ).decode()
    assert tomllib.loads(text)["rig"] == ['a"\n\x7f.yaml']
