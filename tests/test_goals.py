"""The scoreboard of goals: its rows can be measured, and it says what is reached."""

import json
import math

import pytest

from bench import depth, goals, house
from bench.goals import MEASURES, Goal, read_goals
from bench.speed import PARTS
from motionstereo_cli.evaluation.evaluate import Score


def test_every_row_names_a_measurement_and_no_row_is_there_twice():
    rows = read_goals()
    assert {row.measure for row in rows} <= MEASURES.keys()
    assert len({(row.part, row.what) for row in rows}) == len(rows)
    assert all(row.key.partition(" | ")[0] in PARTS for row in rows if "cpu s" in row.key)
    assert {row.part for row in rows} >= {"house", "depth", "motion", "speed"}


def test_rows_about_accuracy_name_scenes_and_scores():
    for row in read_goals():
        if row.measure == "accuracy":
            for key in filter(None, (row.key, row.per)):
                kind, pixels, contestant, name = key.split(" | ")
                assert kind in {*depth.KINDS, depth.MEAN}
                assert pixels in depth.PIXELS
                assert contestant in depth.CONTESTANTS
                assert name in {*Score.__dataclass_fields__, *depth.EXTRAS}


@pytest.mark.parametrize("least", [False, True])
def test_a_goal_is_a_limit_that_may_be_met(least):
    row = Goal("a", "b", "house", "x", "", 2, per="y", least=least)
    assert row.got({"x": 6, "y": 3}) == 2
    assert math.isnan(row.got({"x": 6}))
    assert row.reached(2)
    assert row.reached(3) == least
    assert row.reached(1) != least
    assert not row.reached(math.nan)


def test_the_table_and_the_json_say_what_is_reached(monkeypatch, tmp_path, capsys):
    """A measurement that fails is named, and the others are shown."""
    rows = [
        Goal("one", "is within", "good", "x", "3", 2),
        Goal("one", "is not", "good", "y", "", 2),
        Goal("two", "fails", "bad", "z", "", 2),
    ]

    def fails(rows, quick):
        raise ValueError("no scene")

    monkeypatch.setattr(goals, "read_goals", lambda: rows)
    monkeypatch.setattr(goals, "MEASURES", {"good": lambda *_: {"x": 1, "y": 5}, "bad": fails})
    path = tmp_path / "goals.json"
    goals.main(["--json", str(path)])
    shown = capsys.readouterr().out
    assert "| one | is within | 3 | 1 | at most 2 | reached |" in shown
    assert "| one | is not | - | 5 | at most 2 | short |" in shown
    assert "ValueError: no scene" in shown
    assert [row["said"] for row in json.loads(path.read_text())["goals"]] == [
        *("reached", "short", "ValueError: no scene"),
    ]
    goals.main(["--part", "one", "--json", str(path)])
    assert "fails" not in capsys.readouterr().out


def test_circles_are_the_imports_that_have_to_go():
    assert house._circles({"a": {"b"}, "b": {"c"}, "c": set()}) == 0
    assert house._circles({"a": {"b"}, "b": {"c"}, "c": {"a", "b"}}) == 2


def test_every_room_has_a_floor_and_nothing_is_forced_into_a_function():
    rooms = {house._room(f"motionstereo_cli.{path.stem}") for path in house.PACKAGE.glob("*.py")}
    rooms |= {path.parent.name for path in house.PACKAGE.glob("*/__init__.py")}
    known = {room for floor in house.FLOORS for room in floor}
    assert rooms - {"__init__", "building"} == known
    found = house.measured()
    assert found["imports in functions that a circle forces"] == found["circles"] == 0


def test_lines_of_code_are_neither_empty_nor_words(tmp_path):
    path = tmp_path / "a.py"
    path.write_text('"""Docs."""\n\n# why\nx = [\n    1,  # one\n]\n\n\ndef f():\n    """Do."""\n')
    assert house._code_lines(path) == 4
