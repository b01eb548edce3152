"""Disparity that another program found: read in every form, checked against the images."""

import itertools
import json
import re
import shutil

import cv2
import numpy as np
import pytest
from hypothesis import given, strategies
from hypothesis.extra.numpy import arrays

import motionstereo_cli.runs.run as library
from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError
from motionstereo_cli.files.maps import read_map
from motionstereo_cli.files.stills import DamagedImageError
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import process
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.read_back import Maps
from motionstereo_cli.sources.given import in_other_view
from motionstereo_cli.types import StereoFrame

WIDTH, HEIGHT, FRAMES = 160, 96, 8


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Frames of a corridor, with the true disparity of the right view."""
    folder = tmp_path_factory.mktemp("given") / "clip"
    frames = f"300:{300 + FRAMES}"
    simulate(folder, SimulateSettings(frames=frames, width=WIDTH, height=HEIGHT, noise_sigma=1.5))
    return folder


@pytest.fixture(scope="module")
def truth(clip):
    maps = Maps(clip / "disparity", "disparity")
    return [maps.read(number) for number in range(FRAMES)]


def ran(clip, maps, out, *more):
    given = [str(clip / "left.mp4"), str(clip / "right.mp4"), "--rig", str(clip / "rig.yaml")]
    given += ["--no-check", "--disparity", str(maps), "-o", str(out)]
    return main(["run", *given, *map(str, more)])


def whole(kind, scale):
    return lambda px: np.rint(np.nan_to_num(px) * scale).astype(kind)


FORMS = {
    "KITTI": (".png", whole(np.uint16, 256), 256),
    "OpenCV": (".npy", whole(np.int16, 16), 16),
    "PNG of 8 bits": (".png", whole(np.uint8, 4), 4),
    "TIFF of 16 bits": (".tiff", whole(np.uint16, 100), 100),
    "PFM": (".pfm", lambda px: np.where(np.isnan(px), np.inf, px).astype(np.float32), 1),
    "TIFF": (".tif", lambda px: px.astype(np.float32), 1),
    "half precision, batches": (".npy", lambda px: px[None, None].astype(np.float16), 1),
    "other signs": (".npy", lambda px: -np.nan_to_num(px), -1),
    "shares of the width": (".npy", lambda px: px.astype(np.float64) / WIDTH, 1 / WIDTH),
}


def written(folder, truth, suffix, form, view="right", names="{:06d}"):
    folder.mkdir(exist_ok=True)
    for number, px in enumerate(truth):
        values = form(px if view == "right" else in_other_view(px, "right"))
        path = folder / (names.format(number) + suffix)
        if suffix == ".npy":
            np.save(path, values)
        else:
            assert cv2.imwrite(str(path), values)
    return folder


@pytest.mark.parametrize("view", ["left", "right"])
@pytest.mark.parametrize("form", FORMS)
def test_view_and_scale_are_found_and_the_disparity_arrives(clip, truth, tmp_path, form, view):
    suffix, made, scale = FORMS[form]
    maps = written(tmp_path / "maps", truth, suffix, made, view)
    assert ran(clip, maps, tmp_path / "out", "--save", "disparity-pfm", "--depth-of", "all") == 0
    record = json.loads((tmp_path / "out/run.json").read_text())
    said = record["input_settings"]
    assert (said["disparity_view"], said["disparity_scale"]) == (view, pytest.approx(scale))
    assert record["settings"]["matcher"] == "given"
    assert record["shares"]["matched"] > 0.75
    found = Maps(tmp_path / "out", "disparity")
    for number, px in enumerate(truth):
        one = found.read(number)
        known = ~np.isnan(one)
        error = np.abs(one - px)[known]
        # Whole numbers are steps; carried to the other view, an edge may be half a px off.
        assert np.mean(error > 0.5 / abs(scale) * 1.01 + 0.3) < 0.03
        assert np.median(error) <= 0.5 / min(abs(scale), 16) + 0.06


def test_the_view_of_results_may_be_the_left_one(clip, truth, tmp_path):
    maps = written(tmp_path / "maps", truth, *FORMS["KITTI"][:2], "left")
    options = ["--reference", "left", "--save", "disparity-pfm", "--depth-of", "all"]
    assert ran(clip, maps, tmp_path / "out", *options) == 0
    found, given_px = Maps(tmp_path / "out", "disparity"), Maps(maps, "disparity")
    for number in range(FRAMES):
        one, other = found.read(number), given_px.read(number)
        known = ~np.isnan(one)
        assert known.mean() > 0.7
        np.testing.assert_allclose(one[known], other[known], atol=1e-5)


def test_what_the_images_contradict_is_left_out(clip, truth, tmp_path):
    """A wrong map of a textured part, as a network dreams it up."""
    wrong = [px.copy() for px in truth]
    for px in wrong:
        px[30:60, 40:100] += 12
    maps = written(tmp_path / "maps", wrong, *FORMS["KITTI"][:2])
    assert ran(clip, maps, tmp_path / "out", "--save", "disparity-pfm", "--depth-of", "all") == 0
    one = Maps(tmp_path / "out", "disparity").read(4)
    inside = np.isnan(one[34:56, 44:96]).mean()
    assert inside > 0.5 > 5 * np.isnan(one[60:]).mean()


def test_all_that_follows_from_disparity_follows(clip, tmp_path, capsys):
    save = "steering,depth,objects,map,report,occlusion"
    options = ["--poses", "auto", "--save", save]
    assert ran(clip, clip / "disparity", tmp_path / "out", *options) == 0
    rows = (tmp_path / "out/steering.csv").read_text().splitlines()
    assert len(rows) == FRAMES + 1
    assert ",ok," in rows[-1]
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {
        *("objects.csv", "map.ply", "report.html", "depth", "occlusion"),
    }
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert [file["path"] for file in record["files"]][-1] == str(clip / "disparity")
    assert "--disparity" in record["options"]


@pytest.mark.parametrize("matcher", ["sgbm", "bm", "consensus"])
def test_all_that_follows_from_disparity_follows_from_that_of_opencv(clip, tmp_path, matcher):
    given = [clip / "left.mp4", clip / "right.mp4", "--rig", clip / "rig.yaml", "--no-check"]
    given += [
        "--matcher",
        matcher,
        "--poses",
        "auto",
        "--save",
        "steering,depth,objects,map,report",
    ]
    assert main(["run", *map(str, given), "-o", str(tmp_path / "out")]) == 0
    rows = (tmp_path / "out/steering.csv").read_text().splitlines()
    assert len(rows) == FRAMES + 1
    assert ",ok," in rows[-1]
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {
        *("objects.csv", "map.ply", "report.html", "depth"),
    }
    depth_m = Maps(tmp_path / "out/depth").read(FRAMES - 1)
    assert np.isfinite(depth_m).mean() > 0.1


def test_disparity_is_cut_and_scaled_with_the_images(clip, truth, tmp_path):
    options = ["--crop", "32,16,96,64", "--scale", "0.5", "--depth-of", "all"]
    options += ["--save", "disparity-pfm"]
    assert ran(clip, clip / "disparity", tmp_path / "out", *options) == 0
    one = Maps(tmp_path / "out", "disparity").read(5)
    assert one.shape == (32, 48)
    px = truth[5][16:80:2, 32:128:2] / 2
    error = np.abs(one - px)
    assert np.nanmedian(error) < 0.1


def names_of(clip, tmp_path):
    """The recording as two folders of images with names that are times."""
    names = [f"14036365797635{number:05d}" for number in range(10_000, 10_000 + FRAMES)]
    for side in ("left", "right"):
        video = cv2.VideoCapture(str(clip / f"{side}.mp4"))
        (tmp_path / side).mkdir()
        for name in names:
            assert cv2.imwrite(str(tmp_path / side / f"{name}.png"), video.read()[1])
    return names


@pytest.mark.parametrize("first", [0, 1, 1000])
def test_maps_have_the_number_of_their_image_or_its_order(clip, truth, tmp_path, first):
    maps = tmp_path / "maps"
    maps.mkdir()
    for number, px in enumerate(truth, first):
        cv2.imwrite(str(maps / f"d_{number:04d}_10.png"), whole(np.uint16, 256)(px))
    assert ran(clip, maps, tmp_path / "out", "--save", "steering") == 0
    assert json.loads((tmp_path / "out/run.json").read_text())["shares"]["matched"] > 0.05


def test_maps_have_the_names_of_their_images(clip, truth, tmp_path, capsys):
    names = names_of(clip, tmp_path)
    maps = tmp_path / "maps"
    maps.mkdir()
    for name, px in zip(names[::2], truth[::2], strict=True):
        cv2.imwrite(str(maps / f"{name}.png"), whole(np.uint16, 256)(px))
    given = [str(tmp_path / "left"), str(tmp_path / "right"), "--rig", str(clip / "rig.yaml")]
    given += ["--disparity", str(maps), "--no-check", "--save", "steering"]
    assert main(["run", *given, "--every", "2", "-o", str(tmp_path / "half")]) == 0
    capsys.readouterr()
    assert main(["run", *given, "-o", str(tmp_path / "all")]) == 3
    assert f"{FRAMES // 2} images without a map, the first is 1" in capsys.readouterr().err


def spoilt(maps, how):
    paths = sorted(maps.iterdir())
    if how == "cut off":
        paths[3].write_bytes(paths[3].read_bytes()[:200])
    elif how == "missing":
        paths[3].unlink()
    elif how == "of another size":
        assert cv2.imwrite(str(paths[3]), np.ones((10, 10), np.uint16))
    else:
        paths[3].write_bytes(b"")
    return paths[3].name


@pytest.mark.parametrize("how", ["cut off", "missing", "of another size", "empty"])
def test_a_damaged_map_is_named_and_costs_its_frame_alone(clip, truth, tmp_path, capsys, how):
    maps = written(tmp_path / "maps", truth, *FORMS["KITTI"][:2])
    name = spoilt(maps, how)
    options = ["--save", "disparity-pfm", "--depth-of", "all"]
    assert ran(clip, maps, tmp_path / "out", *options) == 3
    said = capsys.readouterr().err
    assert ("without a map, the first is 3" if how == "missing" else name) in said
    found = Maps(tmp_path / "out", "disparity")
    known = [float((~np.isnan(found.read(number))).mean()) for number in range(FRAMES)]
    assert known[3] == 0
    assert min(known[:3] + known[4:]) > 0.5
    assert ran(clip, maps, tmp_path / "strict", "--strict") == 1
    assert "as --strict says" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda px, n: px[:, 1:], r"000000\.png is 159x96 but the images are 160x96"),
        (lambda px, n: px.max() - px, "does not belong to these images"),
        (lambda px, n: np.dstack([px] * 3), r"000000\.png has colours"),
        (lambda px, n: px if n < 5 else None, None),
    ],
    ids=["size", "other images", "colours", "count"],
)
def test_maps_of_others_are_refused_by_name(clip, truth, tmp_path, capsys, change, said):
    maps = tmp_path / "maps"
    maps.mkdir()
    for number, px in enumerate(truth):
        changed = change(whole(np.uint16, 256)(px), number)
        if changed is not None:
            name = f"{number + 40 * (said is None):06d}.png"
            cv2.imwrite(str(maps / name), np.ascontiguousarray(changed))
    assert ran(clip, maps, tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert "error:" in error
    assert re.search(said or "has 5 maps, 40 to 44, and .* has 8 images, 0 to 7", error), error
    assert not (tmp_path / "out").exists()


def test_exchanged_views_and_other_mistakes_are_refused(clip, tmp_path, capsys):
    given = [str(clip / "right.mp4"), str(clip / "left.mp4"), "-o", str(tmp_path / "out")]
    given += ["--disparity", str(clip / "disparity")]
    assert main(["run", *given]) == 2
    assert "LEFT and RIGHT are not exchanged" in capsys.readouterr().err
    assert ran(clip, tmp_path / "none", tmp_path / "out") == 1
    assert "cannot read the folder" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert ran(clip, tmp_path / "empty", tmp_path / "out") == 1
    assert main(["run", *given[:2], "--matcher", "given"]) == 2
    assert "--matcher given needs --disparity" in capsys.readouterr().err


def test_frames_without_disparity_are_named():
    frame = StereoFrame(0, 0, None, *np.zeros((2, 8, 8), np.uint8))
    with pytest.raises(InputError, match="takes the disparity of frames, which have none"):
        list(process([frame], Settings(matcher="given")))


def test_what_is_said_holds_and_is_doubted(clip, tmp_path, capsys):
    options = ["--disparity-scale", "128", "--save", "steering"]
    assert ran(clip, clip / "disparity", tmp_path / "out", *options) == 0
    assert "the images agree better with --disparity-scale 256" in capsys.readouterr().err
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["input_settings"]["disparity_scale"] == 128
    assert next(each["code"] for each in record["warnings"]) == "disparity"


def test_jobs_give_the_same_bytes(clip, tmp_path):
    for jobs in (1, 3):
        options = ["--jobs", jobs, "--save", "steering,disparity,objects"]
        assert ran(clip, clip / "disparity", tmp_path / f"{jobs}", *options) == 0
    files = [path for path in (tmp_path / "1").rglob("*.*") if path.name != "run.json"]
    assert len(files) > FRAMES
    for path in files:
        assert path.read_bytes() == (tmp_path / "3" / path.relative_to(tmp_path / "1")).read_bytes()


def test_an_interrupted_run_goes_on_with_the_same_bytes(clip, tmp_path, monkeypatch):
    maps, steps = tmp_path / "maps", library.steps
    shutil.copytree(clip / "disparity", maps)
    (maps / "000002.png").unlink()
    options = ["--save", "steering,disparity,objects", "--checkpoint-frames", "2"]
    assert ran(clip, maps, tmp_path / "whole", *options) == 3

    def until(*args, **more):
        yield from itertools.islice(steps(*args, **more), 5)
        raise KeyboardInterrupt

    monkeypatch.setattr(library, "steps", until)
    assert ran(clip, maps, tmp_path / "again", *options) == 130
    monkeypatch.undo()
    assert ran(clip, maps, tmp_path / "again", *options, "--resume") == 3
    one, other = (
        {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*.*")}
        for out in (tmp_path / "whole", tmp_path / "again")
    )
    assert {**one, "run.json": None} == {**other, "run.json": None}


@given(arrays(np.float32, (3, 24), elements=strategies.sampled_from([np.nan, 0.5, 1, 2.25, 5, 9])))
def test_a_left_map_is_carried_to_the_right_view_by_the_nearest(left_px):
    carried = in_other_view(left_px, "left")
    for y, x in np.ndindex(carried.shape):
        candidates = [
            d for at, d in enumerate(left_px[y]) if not np.isnan(d) and np.rint(at - d) == x
        ]
        if candidates:
            assert carried[y, x] == max(candidates)
    mirrored = in_other_view(left_px[:, ::-1], "right")[:, ::-1]
    np.testing.assert_array_equal(mirrored, carried)


def npy(tmp_path, array):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    return (tmp_path / "a.npy").read_bytes()


def test_an_npy_file_is_an_array_and_nothing_else(tmp_path):
    path = tmp_path / "a.npy"
    values = np.arange(12, dtype=">f8").reshape(3, 4)
    for each in (values, np.asfortranarray(values), values[None, :, :, None]):
        npy(tmp_path, each)
        np.testing.assert_array_equal(read_map(path).values, values.astype(np.float32))
    good = npy(tmp_path, values)
    bad = [
        good[:-1],
        good + b"1",
        good[:30],
        b"",
        good.replace(b"(3, 4)", b"(9999999999, 9999999999)"),
        good.replace(b"(3, 4)", b"(3, -4)"),
        npy(tmp_path, np.array([{"a": 1}], object)),
        npy(tmp_path, values.astype(complex)),
        npy(tmp_path, values[0]),
        npy(tmp_path, np.zeros((2, 3, 4))),
    ]
    for content in bad:
        path.write_bytes(content)
        with pytest.raises(DamagedImageError):
            read_map(path)
    npy(tmp_path, np.zeros((40, 40)))
    with pytest.raises(InputError, match="--max-pixels"):
        read_map(path, max_pixels=100)
