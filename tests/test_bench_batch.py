"""The benchmark of batches tells equal folders from others, and times the joining of pieces."""

import re

from bench.batch import Size, _same, joining
from bench.clips import rendered
from motionstereo_cli.simulate.settings import SimulateSettings


def test_folders_are_the_same_but_for_the_record(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name / "depth").mkdir(parents=True)
        (tmp_path / name / "depth/000000.png").write_bytes(b"same")
        (tmp_path / name / "run.json").write_text(name)
    one, other = tmp_path / "one", tmp_path / "other"
    assert _same(one, other)
    (other / "depth/000000.png").write_bytes(b"else")
    assert not _same(one, other)
    (other / "depth/000000.png").write_bytes(b"same")
    (other / "more.csv").touch()
    assert not _same(one, other)


def test_joining_is_timed(tmp_path):
    settings = SimulateSettings(width=64, height=48, frames="250:256")
    clip = rendered(tmp_path / "clip", settings)
    size = Size(0, 0, 0, 0, 0, (), clip.count, 0, 0)
    (row,) = joining(clip, size, tmp_path)
    assert re.fullmatch(r"[\d.]+ ms, [\d.]+ ms in a piece: the limit at \d+ workers", row.found)
