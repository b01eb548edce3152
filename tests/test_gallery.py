"""The gallery shows what its target draws."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import pytest

from bench import gallery

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "motionstereo_cli/docs/gallery.md"


def test_the_page_shows_every_still_that_is_drawn():
    shown = re.findall(r"!\[.+\]\((.+)\)", PAGE.read_text())
    names = [Path(path).stem for path in shown]
    assert names == [*gallery.RECORDED, *gallery.RENDERED]
    stills = [PAGE.parent / path for path in shown]
    assert {path.resolve() for path in stills} == set((ROOT / "sample_data/gallery").iterdir())
    for path in stills:
        assert cv2.imread(str(path)).shape[1] >= 900
        assert path.stat().st_size < 250_000


def test_a_still_is_a_frame_of_a_preview(tmp_path, capfd):
    small = "simulate {out}/scene --scene cards --frames 5 --width 64 --height 48"
    still = gallery.Still((small, *gallery.RENDERED["cards"].commands[1:]), 4)
    gallery.draw(still, tmp_path / "cards.jpg")
    assert cv2.imread(str(tmp_path / "cards.jpg")).shape[1] == 3 * 256 + 8
    with pytest.raises(SystemExit, match="has no frame 9"):
        gallery.draw(still._replace(frame=9), tmp_path / "none.jpg")
    with pytest.raises(SystemExit, match="exit code 1"):
        gallery.draw(still._replace(commands=("run none.mp4 none.mp4",)), tmp_path / "none.jpg")
    assert not (tmp_path / "none.jpg").exists()


def test_recordings_that_are_not_there_keep_their_stills(tmp_path, capsys):
    gallery.main([str(tmp_path / "stills"), str(tmp_path), "--only", *gallery.RECORDED])
    assert capsys.readouterr().out.count("it stays as it is") == len(gallery.RECORDED)
    assert not list((tmp_path / "stills").iterdir())
