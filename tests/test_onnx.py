"""Stereo networks by ONNX Runtime: with a tiny one built here, as no weights are at hand."""

import hashlib
import json

import numpy as np
import pytest
from hypothesis import given, strategies

from motionstereo_cli.__main__ import main
from motionstereo_cli.method import network
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.read_back import Maps

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

WIDTH, HEIGHT, FRAMES, RANGE = 160, 96, 4, 24


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("onnx") / "clip"
    settings = SimulateSettings(
        scene="cards", frames=f"10:{10 + FRAMES}", width=WIDTH, height=HEIGHT, noise_sigma=1.5
    )
    simulate(folder, settings)
    return folder


def correlation(path, names, *, size=("h", "w"), stacked=False, sign=1.0, halves=False):
    """Write a model that gives each pixel the displacement with the least difference in a window.

    The right image is shifted by each displacement, the difference is averaged over 7 x 7 px, and
    the least one wins: block matching, made of operators of networks.
    """
    make = onnx.helper
    channels = 3
    nodes, inputs = [], []

    def image(name, count, shape):
        return make.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, count, *shape])

    constants = {
        "window": np.full((1, channels, 7, 7), 1 / (49 * channels), np.float32),
        "worst": np.array(9.0, np.float32),
        "sign": np.array(sign, np.float32),
    }
    if stacked:
        inputs.append(image(names[0], 2 * channels, size))
        constants |= {"cut": np.array([channels, channels], np.int64)}
        nodes.append(make.make_node("Split", [names[0], "cut"], ["L", "R"], axis=1))
        left, right = "L", "R"
    else:
        inputs += [image(name, channels, size) for name in names[-2:]]
        left, right = names[-2:]
    if halves:
        inputs = [image(name, channels, ("h2", "w2")) for name in names[:2]] + inputs
        nodes += [
            make.make_node("ReduceMean", [name], [f"mean_{name}"], keepdims=1) for name in names[:2]
        ]
        nodes.append(make.make_node("Sub", [f"mean_{name}" for name in names[:2]], ["nothing"]))
        nodes.append(make.make_node("Mul", ["nothing", "zero"], ["zeros"]))
        nodes.append(make.make_node("ReduceMean", ["zeros"], ["zero1"], keepdims=0))
        constants["zero"] = np.array(0.0, np.float32)
    costs = []
    for d in range(RANGE):
        constants[f"pads{d}"] = np.array([0, 0, 0, d, 0, 0, 0, -d], np.int64)
        nodes += [
            make.make_node("Pad", [right, f"pads{d}", "worst"], [f"moved{d}"]),
            make.make_node("Sub", [left, f"moved{d}"], [f"off{d}"]),
            make.make_node("Abs", [f"off{d}"], [f"abs{d}"]),
            make.make_node("Conv", [f"abs{d}", "window"], [f"cost{d}"], pads=[3, 3, 3, 3]),
        ]
        costs.append(f"cost{d}")
    nodes += [
        make.make_node("Concat", costs, ["costs"], axis=1),
        make.make_node("ArgMin", ["costs"], ["least"], axis=1, keepdims=1),
        make.make_node("Cast", ["least"], ["px"], to=onnx.TensorProto.FLOAT),
        make.make_node("Mul", ["px", "sign"], ["signed" if halves else "disparity"]),
    ]
    if halves:
        nodes.append(make.make_node("Add", ["signed", "zero1"], ["disparity"]))
    tensors = [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()]
    output = make.make_tensor_value_info("disparity", onnx.TensorProto.FLOAT, [1, 1, *size])
    graph = make.make_graph(nodes, "correlation", inputs, [output], tensors)
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def ran(clip, model, out, *more):
    given = [str(clip / "left.mp4"), str(clip / "right.mp4"), "--rig", str(clip / "rig.yaml")]
    given += ["--no-check", "--matcher", f"onnx:{model}", "-o", str(out)]
    given += ["--save", "disparity-pfm", "--depth-of", "all", "--max-disparity", str(RANGE)]
    return main(["run", *given, *map(str, more)])


def wrong_and_known(clip, out):
    """Return the share of known pixels that are wrong by over 1 px, and the share known."""
    found, truth = Maps(out, "disparity"), Maps(clip / "disparity", "disparity")
    errors = np.stack([found.read(n) - truth.read(n) for n in range(FRAMES)])
    known = ~np.isnan(errors)
    return float((np.abs(errors[known]) > 1).mean()), float(known.mean())


FORMS = {
    "published": ({"names": ("left_image", "right_image")}, None),
    "names exchanged": ({"names": ("left", "right")}, None),
    "one input": ({"names": ("input",), "stacked": True}, None),
    "fixed size, scaled": ({"names": ("left", "right"), "size": (48, 128)}, None),
    "other signs": ({"names": ("left", "right"), "sign": -1.0}, None),
    "scale said": ({"names": ("left", "right"), "sign": 4.0}, "scale = 4.0"),
    "halves": (
        {"names": ("init_left", "init_right", "next_left", "next_right"), "halves": True},
        None,
    ),
    "tiles": (
        {"names": ("a", "b"), "size": (64, 96)},
        'inputs = ["a", "b"]\nlarge = "tiles"\nlevels = "symmetric"\noutput = "disparity"',
    ),
    "right first": ({"names": ("a", "b")}, 'inputs = ["b", "a"]\nscale = 1.0\nmultiple = 16'),
}


@pytest.mark.parametrize("form", FORMS)
def test_conventions_are_found_or_said(clip, tmp_path, form):
    built, said = FORMS[form]
    model = correlation(tmp_path / "m.onnx", **built)
    if said is not None:
        (tmp_path / "m.toml").write_text(said + "\n")
    assert ran(clip, model, tmp_path / "out") == 0
    wrong, known = wrong_and_known(clip, tmp_path / "out")
    if form == "right first":
        assert wrong > 0.5  # images exchanged: it does matter
        return
    assert known > 0.9
    assert wrong < (0.5 if "scaled" in form else 0.35)
    record = json.loads((tmp_path / "out/run.json").read_text())
    files = {file["path"]: file["sha256"] for file in record["files"]}
    assert files[str(model)] == hashlib.sha256(model.read_bytes()).hexdigest()
    assert (str(tmp_path / "m.toml") in files) == (said is not None)
    assert record["settings"]["matcher"] == f"onnx:{model}"


def test_tiles_give_what_the_whole_gives(clip, tmp_path):
    whole = correlation(tmp_path / "w.onnx", ("left", "right"))
    tiled = correlation(tmp_path / "t.onnx", ("left", "right"), size=(64, 96))
    (tmp_path / "t.toml").write_text('large = "tiles"\n', encoding="utf-8-sig")
    assert ran(clip, whole, tmp_path / "whole") == 0
    assert ran(clip, tiled, tmp_path / "tiled") == 0
    one, other = (Maps(tmp_path / name, "disparity").read(2) for name in ("whole", "tiled"))
    inside = np.s_[4:-4, 4:-4]  # near the border, what is behind it differs
    assert np.mean(one[inside] == other[inside]) > 0.995
    assert ran(clip, tiled, tmp_path / "more", "--max-disparity", "80") == 1


def test_both_runs_agree_or_it_is_unknown_and_has_a_confidence(clip, tmp_path):
    model = correlation(tmp_path / "m.onnx", ("left", "right"))
    assert ran(clip, model, tmp_path / "one") == 0
    both = ["--check-both", "--save", "disparity-pfm,confidence"]
    assert ran(clip, model, tmp_path / "both", *both) == 0
    (wrong, known), (sure_wrong, sure_known) = (
        wrong_and_known(clip, tmp_path / name) for name in ("one", "both")
    )
    assert sure_wrong < 0.6 * wrong
    assert 0.4 < sure_known < known
    assert ran(clip, model, tmp_path / "sure", *both, "--min-confidence", "0.9") == 0
    assert wrong_and_known(clip, tmp_path / "sure")[1] < sure_known


def test_the_left_view_and_all_that_follows(clip, tmp_path):
    model = correlation(tmp_path / "m.onnx", ("left", "right"))
    more = ["--reference", "left", "--poses", "auto", "--save", "objects,map,report,steering"]
    assert ran(clip, model, tmp_path / "out", *more) == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"objects.csv", "map.ply", "report.html", "steering.csv"} <= names


def test_jobs_give_the_same_bytes(clip, tmp_path):
    model = correlation(tmp_path / "m.onnx", ("left", "right"))
    for jobs in (1, 3):
        assert ran(clip, model, tmp_path / str(jobs), "--jobs", jobs) == 0
    for path in (tmp_path / "1").rglob("*.pfm"):
        assert path.read_bytes() == (tmp_path / "3" / path.relative_to(tmp_path / "1")).read_bytes()


def without_weights(path):
    """A model whose weights are in another file, of somebody else."""
    model = onnx.load(str(correlation(path, ("left", "right"))))
    for tensor in model.graph.initializer:
        if tensor.name == "window":
            onnx.external_data_helper.set_external_data(tensor, "../../etc/passwd")
            tensor.ClearField("raw_data")
    path.write_bytes(model.SerializeToString())


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda p: p.write_bytes(b"no model"), "is no model that ONNX Runtime can run"),
        (lambda p: p.write_bytes(b""), "is no model that ONNX Runtime can run"),
        (
            lambda p: p.write_bytes(p.read_bytes().replace(b"left", b"l\xccft")),
            "is no model that ONNX Runtime can run",
        ),
        (lambda p: p.unlink(), "there is no|cannot read the model"),
        (without_weights, "is no model that ONNX Runtime can run"),
        (lambda p: p.with_suffix(".toml").write_text("a ="), "cannot be read as TOML"),
        (lambda p: p.with_suffix(".toml").write_text("sclae = 1"), "sclae"),
        (lambda p: p.with_suffix(".toml").write_text('output = "x"'), "has no output x"),
        (lambda p: p.with_suffix(".toml").write_text('inputs = ["x", "y"]'), "name them in"),
        (lambda p: p.with_suffix(".toml").write_text('levels = "dark"'), "levels"),
    ],
)
def test_what_cannot_be_used_is_named_in_a_line(clip, tmp_path, capsys, spoil, said):
    model = correlation(tmp_path / "m.onnx", ("left", "right"))
    spoil(model)
    assert ran(clip, model, tmp_path / "out") == 1
    out, err = capsys.readouterr()
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert (out, len(errors)) == ("", 1)
    assert any(each in errors[0] for each in said.split("|")), errors


def test_what_does_not_go_together_is_said(clip, tmp_path, capsys):
    for more, said in (
        (["--check-both", "--matcher", "dense"], "--check-both needs --matcher onnx:MODEL"),
        (["--min-confidence", "0.5"], "or a model with --check-both"),
    ):
        assert ran(clip, tmp_path / "m.onnx", tmp_path / "out", *more) == 2
        assert said in capsys.readouterr().err


@given(
    strategies.tuples(strategies.integers(1, 150), strategies.integers(1, 260)),
    strategies.integers(0, 40),
)
def test_tiles_cover_images_of_all_sizes_and_keep_to_their_range(shape, reach):
    """A network that gives each pixel its place, and refuses partners outside of its tile."""
    rows, columns = np.indices(shape)
    code = np.asarray(rows * 7 + columns * 3, np.uint8)

    def exact(left, right):
        assert left.shape == (40, 80)
        return left.astype(np.float32)

    found = network.tiled(exact, 40, 80, reach)(code, code)
    np.testing.assert_array_equal(found, code)
    with pytest.raises(ValueError, match="too small"):
        network.tiled(exact, 40, 80, 60)
