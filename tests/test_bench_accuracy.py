"""The accuracy benchmark: its peers see what is there, and it prints what it promises."""

import json

import cv2
import numpy as np
import pytest

from bench import accuracy, depth
from motionstereo_cli import register_matcher
from motionstereo_cli.method import block_matching, matching
from motionstereo_cli.method.block_matching import consensus, stereo_bm, stereo_sgbm
from motionstereo_cli.simulate.scenes import render_scene

WIDTH = 200
HEIGHT = 90
DISPARITY = 21


@pytest.fixture(scope="module")
def views():
    """Right and left view of a wall with fine texture, 21 px of disparity everywhere."""
    noise = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH + DISPARITY), np.uint8)
    # What the right camera has at x stands at x + 21 in the left one.
    return noise[:, DISPARITY:].copy(), noise[:, :WIDTH].copy()


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("peer", [stereo_bm, stereo_sgbm, consensus])
def test_peers_find_the_disparity_of_the_right_view(peer, filtered, views):
    found = peer(*views, 64, filtered=filtered)
    assert found.shape == (HEIGHT, WIDTH)
    assert found.dtype == np.float32
    inner = found[20:-20, 20 : WIDTH - DISPARITY - 20]  # what both cameras see
    assert np.mean(np.abs(inner - DISPARITY) < 0.1) > 0.99


@pytest.mark.parametrize("peer", [stereo_bm, stereo_sgbm, consensus])
def test_peers_say_unknown_and_never_a_negative_disparity(peer, views):
    beyond = peer(*views, 16)  # a range that ends before the wall
    assert np.mean(np.isnan(beyond)) > 0.3
    assert np.nanmin(beyond) >= 0


def test_a_consensus_has_what_two_windows_agree_on(views, monkeypatch):
    right, left = views
    left = left.copy()
    left[40:50, 95:105] = 128  # more than the small window holds, less than the large one
    sizes, found = block_matching._CONSENSUS_BLOCKS_PX, {}
    for each in (sizes, sizes[:1] * 2, sizes[1:] * 2):
        monkeypatch.setattr(block_matching, "_CONSENSUS_BLOCKS_PX", each)
        found[each] = consensus(right, left, 64)
    both, small, large = found.values()
    agree = np.abs(small - large) <= 1
    np.testing.assert_array_equal(np.isnan(both), ~agree)
    np.testing.assert_allclose(both[agree], (small + large)[agree] / 2)
    assert 0.5 < agree.mean() < 1


def test_the_bench_prints_every_matcher_on_every_scene(tmp_path, capsys):
    accuracy.main(["--quick", "--json", str(tmp_path / "scores.json")])
    table = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    named = [f"| {m}" for m in accuracy.MATCHERS]
    rest = 2 + len(named)
    assert [line.split(" | ")[0] for line in table[2:rest]] == named
    assert [line.split(" | ")[0] for line in table[rest + 2 :]] == named  # bias, and what both see
    assert "corridor straight, charged" in table[0]
    assert "cards, moved" in table[0]

    rows = json.loads((tmp_path / "scores.json").read_text())
    assert len(rows) == len(accuracy.MATCHERS) * 2 * 2
    for scene in ("corridor straight", "cards"):
        for pixels in accuracy.PIXELS:
            of_scene = [r for r in rows if (r["scene"], r["pixels"]) == (scene, pixels)]
            assert len({row["score"]["truth_pixels"] for row in of_scene}) == 1  # the same pixels
    moved = {
        r["scene"]: r for r in rows if (r["pixels"], r["matcher"]) == ("moved", "motionstereo")
    }
    # At this size, windows are large beside what is shown.
    assert moved["corridor straight"]["score"]["coverage"] > 0.7
    assert moved["corridor straight"]["score"]["bad_1"] < 0.25


def test_every_kind_of_scene_has_a_row_with_all_contestants(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(depth.KINDS, "layers", depth.KINDS["layers"][:1])
    accuracy.main(["--quick", "--held-out", "--json", str(tmp_path / "scores.json")])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert [line.split(" | ")[0][2:] for line in lines if "---" not in line] == [
        *("scene", "layers", "mean") * 2
    ]
    figures = json.loads((tmp_path / "scores.json").read_text())
    assert figures["layers"] == figures["mean"]
    kept = {key.rpartition(" | ")[2] for key in figures["mean"]}
    assert kept >= {"coverage", "bad_1", "bias_1_3_px", "flicker_px", "tepe_1", *depth.EXTRAS}
    for contestant in depth.CONTESTANTS:
        one = {
            name: figures["mean"][f"charged | {contestant} | {name}"]
            for name in ("coverage", "bad_1", "truth_pixels", *depth.FRACTIONS)
        }
        assert one["truth_pixels"] == figures["mean"]["charged | motionstereo | truth_pixels"]
        assert 0 < one["coverage"] <= 1
        assert 0 <= one["bad_1"] < 0.9
        assert sum(one[name] for name in depth.FRACTIONS) == pytest.approx(1)
    assert figures["mean"]["charged | motionstereo | bad_1"] < 0.3


def test_every_kind_of_scene_can_be_rendered_and_no_seed_is_in_both_sets():
    for clips in depth.KINDS.values():
        for first, values in clips:
            depth.SimulateSettings(**values, frames=f"{first}:{first + depth.FRAMES}")
    assert not set(depth.SEEDS) & set(depth.HELD_OUT_SEEDS)


def test_recordings_with_truth_of_either_view_are_scored_alike(tmp_path, monkeypatch):
    monkeypatch.setattr(accuracy, "OURS", {"motionstereo": accuracy.DEFAULT})
    monkeypatch.setattr(accuracy, "MATCHERS", {"motionstereo": accuracy.MATCHERS["motionstereo"]})
    monkeypatch.setattr(matching, "MATCH", dict(matching.MATCH))
    monkeypatch.setitem(matching.MATCHERS, "own", None)
    register_matcher("own", lambda right, left, settings: np.where(right.moved, 8.0, np.nan))
    accuracy.add_matcher("own")
    scene = accuracy.SimulateSettings(frames="250:256", width=160, height=96)
    plain, mirror = tmp_path / "plain", tmp_path / "mirror"
    for index, shot in enumerate(render_scene(scene)):
        truth = np.rint(shot.disparity_px * 256).astype(np.uint16)
        for folder, images in (
            (plain, {"left": shot.left, "right": shot.right, "disparity": truth}),
            (mirror, {"right": shot.left, "left": shot.right, "disparity_left": truth}),
        ):
            for name, image in images.items():
                (folder / name).mkdir(parents=True, exist_ok=True)
                stored = image if folder is plain else np.ascontiguousarray(image[:, ::-1])
                assert cv2.imwrite(str(folder / name / f"{index:06d}.png"), stored)
    cells = [accuracy.measure_recording(folder, 2) for folder in (plain, mirror)]
    counts = [
        [(cell.pixels, cell.score.both_pixels, cell.score.bad_1) for cell in each] for each in cells
    ]
    assert counts[0] == counts[1]
    by_name = {cell.matcher: cell for cell in cells[0] if cell.pixels == cells[0][0].pixels}
    assert set(by_name) == {"motionstereo", "motionstereo, matcher own"}
    score = by_name["motionstereo"].score
    assert score.truth_pixels > 500
    assert score.coverage > 0.7
    assert by_name["motionstereo, matcher own"].score.truth_pixels == score.truth_pixels
