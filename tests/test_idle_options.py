"""Options without effect are said: the help and the note derive from one declared condition."""

import itertools
import re

import click
import numpy as np
import pytest

from motionstereo_cli.__main__ import cli, main
from motionstereo_cli.commands.batch import plan_of
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.evaluation.settings import EvaluateSettings
from motionstereo_cli.method.settings import MATCHERS, Settings
from motionstereo_cli.params import Param, idle, options_in, param, params
from motionstereo_cli.pipeline import process
from motionstereo_cli.rig.settings import PoseSettings, RigSettings
from motionstereo_cli.simulate.settings import DriveSettings, SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import StereoFrame

GROUPS = (Settings, InputSettings, OutputSettings, RigSettings, PoseSettings)
SCENES = (SimulateSettings, DriveSettings)
#: Values for what stands in conditions without one, and of text that is not free.
VALUES = {"--contrast-px": "15", "--poses": "auto", "--disparity": "maps"}
TEXTS = {"goal": "1,2", "baseline_unit": "mm", "disparity_offset": "2"}


def conditional(*groups: type) -> list[Param]:
    return [item for group in groups for item in params(group) if item.only_with]


def other_value(item: Param) -> object:
    """A value that is not the default."""
    if item.kind is bool:
        return not item.default
    if item.kind is str:
        return TEXTS.get(item.name) or next(each for each in item.choices if each != item.default)
    ends = (10, item.high, item.low)
    return next(
        each for each in ends if each not in (None, item.default) and each <= (item.high or each)
    )


def given(item: Param) -> list[str]:
    value = other_value(item)
    return [item.flag_for(value), *([] if item.kind is bool else [str(value)])]


def words_of(option: str) -> list[str]:
    """What to give for an option of a condition."""
    flag, _, value = option.partition(" ")
    value = value.replace("FILE", "poses.txt").replace("FOLDER", "out")
    value = value or VALUES.get(option, "")
    return [] if flag == "--rig" else [flag, value]


def ways(item: Param) -> list[list[str]]:
    """For each option of the condition, what to give so that it holds."""
    groups = [list(options_in(group)) for group in item.only_with.split(" and ")]
    return [
        [word for option in options for word in words_of(option)]
        for options in itertools.product(*groups)
    ]


@pytest.mark.parametrize("item", conditional(*GROUPS), ids=lambda item: item.name)
def test_the_note_appears_without_the_condition_and_not_with_it(item):
    table_alone = "-o FOLDER" in item.only_with
    bare = ["-o", "-"] if table_alone else ["--save", "bands"]
    start = ["left.mp4", "right.mp4", *given(item)]
    missing = item.only_with.split(" and ")[0]
    said = plan_of([*start, "--matcher", "bm", *bare]).idle(rig=False)
    assert said == [f"{item.flag_for(other_value(item))} has no effect without {missing}"]
    for words in ways(item):
        matcher = [] if {"--matcher", "--disparity"} & set(words) else ["--matcher", "bm"]
        save = [] if "--save" in words or table_alone else bare
        assert plan_of([*start, *matcher, *save, *words]).idle() == [], words


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_the_help_says_each_condition_and_no_other(name):
    own = {"simulate": [SimulateSettings], "drive": [Settings, DriveSettings]}
    groups = {**own, "evaluate": [EvaluateSettings]}.get(name, GROUPS)
    stated = {item.name: item.only_with for item in conditional(*groups)}
    for option in cli.commands[name].params:
        if isinstance(option, click.Option) and not option.hidden:
            said = re.findall(r"[Oo]nly (?:with|in|for) ([^.]*)", option.help or "")
            wanted = [stated[option.name]] if option.name in stated else []
            # What a command always has is not stated.
            assert said == wanted or (name in ("drive", "rig") and not said), option.name


def test_a_fulfilled_condition_is_not_stated():
    helps = {option.name: option.help for option in cli.commands["drive"].params
             if isinstance(option, click.Option)}  # fmt: skip
    assert "Only" not in helps["robot_radius_m"] + helps["steer_gain"]
    assert "Only with --matcher" in helps["max_ratio"]


@pytest.mark.parametrize(
    ("group", "item"),
    [(group, item) for group in SCENES for item in conditional(group)],
    ids=lambda each: getattr(each, "name", ""),
)
def test_scenes_refuse_what_has_no_effect(group, item):
    without = {
        "--scene corridor": {"scene": "cards"},
        "--world corridor": {"world": "doorway"},
        "--no-lossless": {"lossless": True},
    }.get(item.only_with, {"scene": "corridor"})
    with pytest.raises(SettingsError, match=f"{item.flag} has no effect without {item.only_with}"):
        group(**without, **{item.name: other_value(item)})


def test_tables_and_substitutes_are_known():
    def said(*words, rig=True):
        return plan_of(["left.mp4", "right.mp4", *words]).idle(rig=rig)

    assert said("--steer-gain", "0.5", "--save", "depth", "--csv", "-") == []
    assert said("--steer-gain", "0.5", "--save", "report") == []
    assert said("--steer-gain", "0.5", "--steering-format", "jsonl", "-o", "-") == []
    assert said("--depth-scale", "256", "--save", "depth") == []
    assert len(said("--depth-scale", "256", "--save", "depth", rig=False)) == 1
    # A matcher of another package may use any value.
    assert idle_of(matcher="trails", average_frames=3) != []
    MATCHERS["of-another"] = MATCHERS["bm"]
    try:
        assert idle_of(matcher="of-another", average_frames=3, max_ratio=0.5) == []
    finally:
        del MATCHERS["of-another"]


def test_what_a_preset_sets_is_not_said():
    words = ["left.mp4", "right.mp4", "--preset", "paper", "--matcher", "sgbm"]
    assert plan_of(words).idle() == []
    flag = "--match-on has no effect without --matcher trails, dense or regions"
    assert plan_of([*words, "--match-on", "charge"]).idle() == [flag]
    assert plan_of(words[:4]).settings.match_on == "charge"


def idle_of(**values):
    settings = Settings(**values)
    return list(idle(settings, settings.options))


BY_MATCHER = [item for item in conditional(Settings) if "--matcher" in item.only_with]


@pytest.mark.parametrize("matcher", ["trails", "dense", "regions", "bm"])
def test_what_is_said_to_have_no_effect_of_a_matcher_has_none(matcher):
    random = np.random.default_rng(4)
    grey = random.integers(0, 255, (32, 64), np.uint8)
    frames = [
        StereoFrame(n, n, 0.1 * n, np.roll(grey, 3 - n, 1), np.roll(grey, -n, 1)) for n in range(3)
    ]

    def disparity(**values):
        settings = Settings(matcher=matcher, max_disparity=16, **values)
        last = list(process(frames, settings, with_objects=False, extras=()))[-1]
        return settings, last.disparity_px

    _, usual = disparity()
    assert np.isfinite(usual).any()
    for item in BY_MATCHER:
        settings, found = disparity(**{item.name: other_value(item)})
        if list(idle(settings, settings.options)):
            np.testing.assert_array_equal(found, usual, item.name)


class TestSaid:
    @pytest.fixture(scope="class")
    @classmethod
    def recording(cls, tmp_path_factory):
        folder = tmp_path_factory.mktemp("recording") / "clip"
        simulate(folder, SimulateSettings(frames="300:303", width=96, height=64, noise_sigma=1.5))
        return folder

    NOTE = "note: --charge-gain has no effect without --charge-mode general\n"

    @pytest.mark.parametrize("where", ["line", "config"])
    def test_by_run(self, recording, where, tmp_path, capsys):
        views = [str(recording / "left.mp4"), str(recording / "right.mp4")]
        (tmp_path / "of.toml").write_text("charge-gain = 5\nfov = 90\n")
        words = {"line": ["--charge-gain", "5", "--fov", "90"]}
        words["config"] = ["--config", str(tmp_path / "of.toml")]
        assert main(["run", *views, *words[where], "-o", str(tmp_path / "out")]) == 0
        said = capsys.readouterr().err
        assert self.NOTE in said
        assert "note: --fov has no effect without --rig\n" in said

    @pytest.mark.parametrize("command", ["check", "info"])
    def test_by_check_and_info(self, recording, command, capsys):
        views = [str(recording / "left.mp4"), str(recording / "right.mp4")]
        main([command, *views, "--baseline-unit", "mm", "--disparity-scale", "16"])
        said = capsys.readouterr().err
        assert "note: --baseline-unit has no effect without --rig\n" in said
        assert "note: --disparity-scale has no effect without --disparity\n" in said

    def test_by_figure(self, recording, tmp_path, capsys):
        views = [str(recording / "left.mp4"), str(recording / "right.mp4")]
        out = ["--frames", "1", "-o", str(tmp_path / "sheet.png"), "--charge-gain", "5"]
        no_advice = ["--robot-radius-m", "2", "--steer-gain", "0.9"]  # it has no --save
        assert main(["figure", *views, *out, *no_advice]) == 0
        said = capsys.readouterr().err
        assert self.NOTE in said
        assert said.count("has no effect") == 1

    def test_by_drive(self, tmp_path, capsys):
        words = [str(tmp_path / "out"), "--max-frames", "2", "--charge-gain", "5"]
        assert main(["drive", *words, "--robot-radius-m", "0.3"]) == 0
        said = capsys.readouterr().err
        assert self.NOTE in said
        assert said.count("has no effect") == 1

    def test_by_evaluate(self, recording, tmp_path, capsys):
        truth = str(recording)
        main(["evaluate", truth, truth, "--min-overlap", "0.5", "-o", str(tmp_path / "p.png")])
        said = capsys.readouterr().err
        assert "note: --min-overlap has no effect without files of objects\n" in said
        assert "note: --picture-out has no effect without --picture\n" in said
        assert not (tmp_path / "p.png").exists()
        poses = str(recording / "poses.txt")
        main(
            ["evaluate", poses, poses, "--truth-scale", "256", "--mask", truth, "--label-rate", "9"]
        )
        said = capsys.readouterr().err
        for flag, needed in (
            ("--truth-scale", "folders of images"),
            ("--mask", "folders of images"),
            ("--label-rate", "files of objects"),
        ):
            assert f"note: {flag} has no effect without {needed}\n" in said

    def test_by_batch_once(self, recording, tmp_path, capsys):
        pytest.importorskip("distributed")
        rows = [f"{recording}/left.mp4,{recording}/right.mp4,{name},{gain}"
                for name, gain in (("a", ""), ("b", ""), ("c", "9"))]  # fmt: skip
        (tmp_path / "all.csv").write_text("\n".join(["left,right,out,vote-rows", *rows]))
        words = ["--charge-gain", "5", "--matcher", "bm", "--workers", "1"]
        out = tmp_path / "out"
        assert main(["batch", str(tmp_path / "all.csv"), "-o", str(out), *words]) == 0
        said = capsys.readouterr().err
        assert said.count(self.NOTE) == 1
        assert "note: c: --vote-rows has no effect without --matcher trails or dense\n" in said


def test_a_condition_of_several_options():
    item = next(each for each in conditional(Settings) if each.name == "robot_radius_m")
    assert item.missing({"--rig", "--save preview"}) == ""
    assert item.missing({"--rig"}) == "--save steering, preview or bag"
    assert item.missing({"--save preview"}) == "--rig"
    assert param(1, "A number.").metadata["help"] == "A number."
