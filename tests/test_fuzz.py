"""Damaged and hostile files: every reader gives a result or says what is wrong, in one line.

The suite tries each reader a hundred times. `make fuzz` goes on for 10 minutes each from what it
kept in out/fuzz the last time.
"""

import contextlib
import functools
import hashlib
import io
import math
import re
import shutil

import cv2
import numpy as np
import pytest
from bags import Bag
from fuzzing import Fuzz
from PIL import Image
from recordings import encode, scene
from spatial import svo2, vr180, with_boxes
from taken import prepared
from test_calibration import (
    KITTI,
    MIDDLEBURY,
    SIZE,
    euroc_files,
    fisheye_file,
    opencv_file,
    ros_files,
)
from test_calibration_formats import (
    depthai,
    kalibr,
    nested_json,
    nested_parts,
    npz,
    orb_slam_2,
    orb_slam_3,
    zed,
)
from test_calibration_slam import (
    basalt,
    mrcal,
    ncamera,
    okvis,
    openvins,
    ov2slam,
    stella,
    stvo,
    t265,
)
from test_compare import RECORD, STEERING, written
from test_rig import VALUES, rig_file
from test_worlds import PLAN

from motionstereo_cli.__main__ import main
from motionstereo_cli.batch.cluster import Cluster
from motionstereo_cli.batch.own_folder import claim, read_status, status_path, write_status
from motionstereo_cli.batch.status import format_statuses
from motionstereo_cli.errors import MotionStereoError, shortage
from motionstereo_cli.evaluation.compare import compare
from motionstereo_cli.evaluation.evaluate import Comparison
from motionstereo_cli.evaluation.objects import read_objects
from motionstereo_cli.evaluation.settings import EvaluateSettings
from motionstereo_cli.files.maps import SUFFIXES as MAP_SUFFIXES
from motionstereo_cli.files.maps import read_map
from motionstereo_cli.files.stills import DamagedImageError
from motionstereo_cli.method.memory import Memory
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.pipeline import State
from motionstereo_cli.report.batch_page import batch_page
from motionstereo_cli.rig import format_rig, read_rig
from motionstereo_cli.rig.calibration import read_calibration
from motionstereo_cli.rig.poses import read_poses
from motionstereo_cli.runs.checkpoint import check_state, read_checkpoint, write_checkpoint
from motionstereo_cli.runs.onnx_model import load_model
from motionstereo_cli.runs.open_outputs import Totals
from motionstereo_cli.simulate.floor_plan import prisms, read_plan
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate
from motionstereo_cli.sinks.read_back import Maps, Table, read_mask
from motionstereo_cli.sinks.records import Status
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.folder import FolderRecording
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import Rig

#: A warning of NumPy's would be talk that no user can follow.
pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture
def fuzz(request):
    """Return what tries a check on former finds and on a hundred examples, or for some time."""
    options, name = request.config, re.sub(r"\W+", "-", request.node.name)
    seconds, seed = options.getoption("--fuzz-seconds"), options.getoption("--fuzz-seed")
    return Fuzz(options.rootpath / "out/fuzz" / name, seconds, seed)


def result_of(read, *args, **options):
    """Return what a reader gives, or None where it says in one line what is wrong."""
    try:
        return read(*args, **options)
    except Exception as error:  # a size that no memory has is one of the damages
        message = str(error) if isinstance(error, MotionStereoError) else shortage(error)
        if message is None:
            raise
    assert 10 < len(message) < 1000
    return None


def test_rig_files(fuzz, tmp_path):
    path = rig_file(tmp_path, doffs="-3.5")
    samples = [path.read_bytes(), b"\xef\xbb\xbf%YAML:1.0\r\n---\r\n" + path.read_bytes()]

    def check(content):
        path.write_bytes(content)
        rig = result_of(read_rig, path)
        if rig is not None:
            assert all(math.isfinite(getattr(rig, name)) for name in VALUES)
            path.write_text(format_rig(rig))
            assert read_rig(path) == rig

    fuzz(samples, check)


def test_calibration_files(fuzz, tmp_path):
    files = [opencv_file(tmp_path / f"rig.{suffix}") for suffix in ("yml", "xml", "json")]
    files += [fisheye_file(tmp_path / "fisheye.yml"), rig_file(tmp_path)]
    files.append(opencv_file(tmp_path / "sized.yml", image_width=320.0, image_height=240.0))
    samples = [path.read_bytes() for path in files] + [KITTI.encode(), MIDDLEBURY.encode()]
    path = tmp_path / "calibration"

    def check(content):
        path.write_bytes(content)
        for size in (SIZE, None):
            check_calibration(result_of(read_calibration, [path], size))

    sized = files[-1].read_bytes()
    assert b"320." in sized
    finds = [sized.replace(b"320.", size) for size in (b"1e999", b"2e9", b"1e6")]
    finds.append(b"P0: 7 0 6 0 0 7 1 0 0 0 1 0\nP1: 0 0 6 0 0 0 1 0 0 0 1 0\n")
    finds += [samples[0].replace(b"rows: 3", b"rows: 1e999"), sized.replace(b"258.", b"1e-320")]
    fuzz(samples, check, finds)


def test_calibration_files_of_other_programs(fuzz, tmp_path):
    writers = [kalibr, orb_slam_2, orb_slam_3, depthai, zed, nested_json, nested_parts, npz]
    paths = [write(tmp_path) for write in writers]
    systems = [openvins, stvo, stella, okvis, ncamera, basalt, t265, ov2slam]
    paths += [path for write in systems for path in write(tmp_path)]
    samples = [path.read_bytes() for path in paths]
    path = tmp_path / "calibration"

    def check(content):
        path.write_bytes(content)
        check_calibration(result_of(read_calibration, [path], SIZE))

    fuzz(samples, check)


def test_pairs_of_calibration_files(fuzz, tmp_path):
    pairs = [euroc_files(tmp_path), ros_files(tmp_path), mrcal(tmp_path)]
    samples = [(left.read_bytes(), right.read_bytes()) for left, right in pairs]
    paths = [tmp_path / "one", tmp_path / "other"]

    def check(example):
        side, other, content = example
        paths[side].write_bytes(content)
        paths[1 - side].write_bytes(other)
        check_calibration(result_of(read_calibration, paths))

    left, right = samples[0]
    assert b"0.0, 0.0, 0.0, 1.0]" in right
    find = right.replace(b"0.0, 0.0, 0.0, 1.0]", b"0, 0, 0, 0]")
    sides = [(0, right, left) for left, right in samples]
    sides += [(1, left, right) for left, right in samples]
    fuzz(sides, check, [(1, left, find)])


def check_calibration(calibration):
    if calibration is not None:
        rig = calibration.rig
        assert math.isfinite(rig.cx + rig.cy + rig.doffs)
        assert 0 < rig.focal_px < math.inf
        assert 0 < rig.baseline_m < math.inf
        assert calibration.describe()


def test_poses(fuzz, tmp_path):
    path, rig = tmp_path / "poses.txt", Rig(64, 48, 50.0, 0.1, 32.0, 24.0)
    turns = [(math.sin(t), math.cos(t)) for t in range(5)]
    tum = [f"{t / 10} {t} -0.5 1.2 0 0 {sin} {cos}" for t, (sin, cos) in enumerate(turns)]
    euroc = [f"{t}00000000,{t},0,1.2,{cos},0,0,{sin},0" for t, (sin, cos) in enumerate(turns)]
    kitti = [f"{cos} {-sin} 0 {t} {sin} {cos} 0 0 0 0 1 0" for t, (sin, cos) in enumerate(turns)]
    heads = "# poses", "#timestamp, x [m], y [m], z [m], q_w, q_x, q_y, q_z, v", ""
    samples = zip(heads, (tum, euroc, kitti), strict=True)

    def check(content):
        path.write_bytes(content)
        trajectory = result_of(read_poses, path, None, rig, np.eye(4))
        if trajectory is not None:
            result_of(trajectory.check_covers, 0.0, 0.3)
            for time_s in (*trajectory.time_s, 0.05, 0.3):
                pose = result_of(trajectory.at, time_s)
                assert pose is None or math.isfinite(pose.yaw_rad)

    fuzz(["\n".join([head, *lines]).encode() for head, lines in samples], check)


CONFIG = b"""max-disparity = 96
blur_px = 0.5
preset = "paper"
save = ["steering", "depth"]
check = false
overwrite = true
crop = "0,0,64,48"
start = "0:12.5"
matcher = "trails" # or regions
rig = ["a.yaml", "b.yaml"]
"""
COMPARE_CONFIG = b"""tolerance = ["steer=0.02", "depth_m=1"]
max-differing = 0.1
junit = "out.xml"
"""


@pytest.mark.parametrize(
    ("command", "sample"), [("run", CONFIG), ("compare", COMPARE_CONFIG)], ids=["run", "compare"]
)
def test_configuration_files(fuzz, tmp_path, monkeypatch, command, sample):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "config.toml"

    def check(content):
        path.write_bytes(content)
        with contextlib.redirect_stderr(io.StringIO()) as talk:
            exit_code = main([command, "nowhere.mp4", "nor_here.mp4", "--config", str(path)])
        assert exit_code in (1, 2)
        assert talk.getvalue().startswith("error: ")
        assert "internal: " not in talk.getvalue()
        assert talk.getvalue().count("\n") == 1

    finds = [b"max-disparity = 1" + b"0" * 400, b"tolerance = " + b"[" * 3000, b'junit = ""']
    fuzz([sample], check, finds)


def test_tables(fuzz, tmp_path):
    path = tmp_path / "steering.csv"
    objects = b'frame,id,x,note\n0,1,5,"a ""b"",c"\n0,2,7,\n3,1,-4,\n'

    def check(content):
        path.write_bytes(content)
        table = result_of(Table, path)
        if table is not None:
            frames = result_of(lambda: list(table.by_frame())) or []
            assert all(tuple(row) == table.columns for _, rows in frames for row in rows.values())

    fuzz([STEERING.encode(), objects], check)


def test_times_by_line(fuzz, tmp_path):
    tables = {"image_0": "times.txt", "image_00/data": "image_00/timestamps.txt"}
    for folder in tables:
        (tmp_path / folder).mkdir(parents=True)
        for number in range(3):
            image = tmp_path / folder / f"{number:06d}.png"
            assert cv2.imwrite(str(image), np.zeros((4, 4), np.uint8))

    def check(content):
        for folder, table in tables.items():
            (tmp_path / table).write_bytes(content)
            stream = result_of(FolderRecording, tmp_path / folder)
            if stream is not None:
                result_of(lambda stream=stream: [image.pts for image in stream])

    samples = [b"0.0\n0.1\n0.2\n", b"2011-09-26 13:02:25.964389445\n" * 3]
    fuzz(samples, check)


def test_time_stamps_of_images(fuzz, tmp_path):
    (tmp_path / "data").mkdir()
    stamps = [1403636579763555584 + 50_000_000 * number for number in range(3)]
    for stamp in stamps:
        assert cv2.imwrite(str(tmp_path / f"data/{stamp}.png"), np.zeros((4, 4), np.uint8))
    sample = "#timestamp [ns],filename\r\n" + "".join(f"{s},{s}.png\r\n" for s in stamps)

    def check(content):
        (tmp_path / "data.csv").write_bytes(content)
        stream = result_of(FolderRecording, tmp_path / "data")
        if stream is not None:
            result_of(lambda: [(image.pts, stream.time_base) for image in stream])

    finds = [b"1" + b"0" * 400 + b",a.png", b"9" * 5000 + b",a.png"]
    fuzz([sample.encode()], check, [sample.encode() + find for find in finds])


def test_records_of_runs(fuzz, tmp_path):
    actual, golden = written(tmp_path / "actual"), written(tmp_path / "golden")
    sample = (golden / "run.json").read_bytes()
    assert RECORD["program"].encode() in sample
    out = tmp_path / "out"
    out.mkdir()

    def check(content):
        (actual / "run.json").write_bytes(content)
        assert result_of(compare, actual, golden) is not None  # unreadable is a difference
        result_of(lambda: Comparison(Maps(actual), Maps(golden)).pair(0))
        (out / "run.json").write_bytes(content)
        result_of(prepared, out, ["steering"], overwrite=True)

    fuzz([sample], check, [b"[" * 3000, b"{" + b'"a": {' * 3000])


def talk_of(*args):
    """Return the exit code of a command, and what it says; nothing of it is unforeseen."""
    with (
        contextlib.redirect_stderr(io.StringIO()) as talk,
        contextlib.redirect_stdout(io.StringIO()),
    ):
        exit_code = main([str(each) for each in args])
    said = talk.getvalue()
    assert exit_code in (0, 1, 2, 3, 4)
    assert "internal: " not in said
    assert "Traceback" not in said
    return exit_code, said


def read_all(path, **options):
    """Read a recording from its beginning, and once more from its third frame."""
    for begin in (0, 2):
        with open_stereo(path, None, InputSettings(**options)) as source:
            if not begin or source.begin_at(begin):
                for frame in source:
                    assert frame.left.shape == frame.right.shape
            assert all(0 < len(line) < 2000 for line in source.damage)


SIDES = [np.ascontiguousarray(image) for image in scene(48, 32, 6)]


def media(tmp_path):
    """Each container and codec, with both views side by side."""
    kinds = {
        ".mp4": ("libx264", "yuv420p"),
        ".mkv": ("libx264", "yuv420p"),
        ".mov": ("mjpeg", "yuvj420p"),
        ".avi": ("mpeg4", "yuv420p"),
        ".webm": ("libvpx-vp9", "yuv420p"),
        ".ts": ("libx265", "yuv420p"),
        ".nut": ("ffv1", "gray"),
    }
    options = {"libx264": {"g": "3"}, "libx265": {"x265-params": "log-level=none"}}
    for suffix, (codec, form) in kinds.items():
        path = tmp_path / f"whole{suffix}"
        # libx265 writes beyond its buffers where an image is smaller than its blocks of 64 px.
        whole = scene(128, 64, 4) if codec == "libx265" else SIDES
        encode(path, whole, codec, form, options=options.get(codec))
        yield suffix, path.read_bytes()
    path = with_boxes(tmp_path / "whole.mp4", vr180())
    yield ".mp4", path.read_bytes()
    for codec in ("jpeg", "h264"):
        path = svo2(tmp_path / "whole.svo2", SIDES, codec, "zstd")
        yield ".svo2", path.read_bytes()


def test_videos(fuzz, tmp_path):
    samples = list(media(tmp_path))

    def check(example):
        suffix, content = example
        path = tmp_path / f"spoilt{suffix}"
        path.write_bytes(content)
        layout = "two" if suffix == ".svo2" else "side-by-side"
        result_of(read_all, path, layout=layout)

    fuzz(samples, check)


def test_bags(fuzz, tmp_path):
    samples = []
    for kind in (".bag", ".db3", ".mcap"):
        whole = tmp_path / f"whole{kind}"
        with Bag(whole, kind) as bag:
            for number, image in enumerate(SIDES):
                for side, half in (("left", image[:, :24]), ("right", image[:, 24:])):
                    packed = cv2.imencode(".png", half)[1].tobytes()
                    bag.image(f"/{side}/image_raw", half, number * 10**8)
                    bag.compressed(f"/{side}/image_raw/compressed", packed, number * 10**8)
                    rig = Rig(24, 32, 50.0, 0.1, 12.0, 16.0)
                    info = f"/{side}/camera_info"
                    bag.camera_info(info, rig, number * 10**8, right=side == "right")
        files = [whole] if whole.is_file() else sorted(whole.iterdir())
        samples += [(kind, path.name, path.read_bytes()) for path in files]

    def check(example):
        kind, name, content = example
        place = tmp_path / f"whole{kind}"
        path = place if place.is_file() else place / name
        whole = path.read_bytes()
        path.write_bytes(content)
        try:
            for topics in ("/left/image_raw,/right/image_raw", ""):
                result_of(read_all, place, topics=topics)
        finally:
            path.write_bytes(whole)

    fuzz(samples, check, examples=25)


def images(tmp_path):
    """Each format of still images and of maps."""
    image = SIDES[0]
    deep = image.astype(np.uint16) * 257
    for suffix, pixels in {
        **dict.fromkeys((".png", ".jpg", ".bmp", ".pgm", ".webp", ".tif"), image),
        ".tiff": deep,
        ".jps": image,
        ".pfm": image.astype(np.float32),
    }.items():
        path = tmp_path / f"whole{'.jpg' if suffix == '.jps' else suffix}"
        assert cv2.imwrite(str(path), pixels)
        yield suffix, path.read_bytes()
    assert cv2.imwrite(str(tmp_path / "deep.png"), deep)
    yield ".png", (tmp_path / "deep.png").read_bytes()
    assert cv2.imwritemulti(str(tmp_path / "pages.tif"), SIDES)
    yield ".tif", (tmp_path / "pages.tif").read_bytes()
    pages = [Image.fromarray(each) for each in SIDES[:2]]
    pages[0].save(tmp_path / "two.mpo", save_all=True, append_images=pages[1:])
    yield ".mpo", (tmp_path / "two.mpo").read_bytes()
    np.save(tmp_path / "map.npy", image.astype(np.float32))
    yield ".npy", (tmp_path / "map.npy").read_bytes()


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, which the program silences
def test_images_and_maps(fuzz, tmp_path):
    place, samples = tmp_path / "images", list(images(tmp_path))

    def check(example):
        suffix, content = example
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        path = place / f"000000{suffix}"
        path.write_bytes(content)
        if suffix in MAP_SUFFIXES:
            with contextlib.suppress(DamagedImageError):
                result_of(read_map, path)
            result_of(lambda: Maps(place).read(0))
            with contextlib.suppress(DamagedImageError):
                result_of(read_mask, path)
        if suffix != ".npy":
            result_of(read_all, path, layout="side-by-side")
            result_of(read_all, place, layout="side-by-side")

    fuzz(samples, check)


def test_checkpoints(fuzz, tmp_path):
    """With the right sum, as whoever may write to OUT can make it."""
    grey = np.zeros((8, 12), np.uint8)
    memory = Memory(grey, grey, grey + 1, grey > 0, grey)
    path = tmp_path / "run.checkpoint"
    write_checkpoint(path, {}, State(memory, memory), Totals(3, 0.5, 0.5), {})
    head, _, whole = path.read_bytes().partition(b"\n")
    head = head[: -len(hashlib.sha256().hexdigest())]

    def check(content):
        path.write_bytes(head + hashlib.sha256(content).hexdigest().encode() + b"\n" + content)
        state = functools.partial(check_state, settings=Settings(), width=12, height=8)
        result_of(read_checkpoint, path, {}, state)

    fuzz([whole], check)


def test_manifests(fuzz, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "all.csv"
    sample = b"left,right,out,rig,max-disparity,check\nl.mp4,r.mp4,a/b,a.yaml;b.yaml,96,no\n"
    sample += b'"l 2.mp4",r.mp4,c,,,\n'

    def check(content):
        path.write_bytes(content)
        for more in (("--dry-run",), ("--status",), ("--shard", "0/2")):
            exit_code, said = talk_of("batch", path, "-o", tmp_path / "out", *more)
            assert exit_code in (1, 2)
            assert said.startswith("error: ")

    fuzz([sample], check)


def test_records_of_batches(fuzz, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    claim(out, ())
    write_status(out, Status("a", "damaged", frames=5, seconds=0.5, charged=0.1, said="lost 1"))
    (out / "batch.csv").write_bytes(format_statuses([read_status(out, "a")]))
    names = [status_path(out, "a"), out / ".batch/batch.json", out / "batch.csv"]
    samples = [(name, name.read_bytes()) for name in names]

    def check(example):
        name, content = example
        whole = name.read_bytes()
        name.write_bytes(content)
        try:
            assert read_status(out, "a").name == "a"
            result_of(claim, out, ())
            result_of(batch_page, out, out / "report.html")
        finally:
            name.write_bytes(whole)

    fuzz(samples, check, examples=25)


def test_reports_of_results(fuzz, tmp_path):
    """Each file of a run that the report and evaluate read, one of them damaged."""
    clip, out = tmp_path / "clip", tmp_path / "out"
    simulate(clip, SimulateSettings(frames="300:304", width=64, height=48))
    names = [clip / name for name in ("left.mp4", "right.mp4", "--rig", "rig.yaml")]
    given = [path.name if path.name == "--rig" else path for path in names]
    save = "steering,objects,poses,map,depth"
    more = ("--save", save, "--no-check", "--poses", "auto", "-o", out)
    assert talk_of("run", *given, *more)[0] == 0
    samples = [
        (path, path.read_bytes()) for path in sorted(out.rglob("*.*")) if path.suffix != ".png"
    ]
    assert {"run.json", "steering.csv", "objects.csv", "map.yaml"} <= {p.name for p, _ in samples}

    def check(example):
        path, content = example
        whole = path.read_bytes()
        path.write_bytes(content)
        try:
            talk_of("report", out, "-o", tmp_path / "page.html")
            talk_of("evaluate", out, clip)
        finally:
            path.write_bytes(whole)

    fuzz(samples, check, examples=25)


def test_objects(fuzz, tmp_path):
    path = tmp_path / "objects"
    table = b"frame,id,x,y,width,height,depth_m\n0,1,3,4,5,6,2.5\n1,1,4,4,5,6,\n"
    labels = b"0 1 Car 0 0 -1.5 10 20 30 40 1.5 1.6 3.7 -2 1.5 8.4 -1.6\n"
    labels += b"1 1 Car 0 0 -1.5 11 20 31 40 1.5 1.6 3.7 -2 1.5 8.2 -1.6\n"

    def check(content):
        path.write_bytes(content)
        for box in result_of(read_objects, path, EvaluateSettings()) or ():
            assert math.isfinite(box.left + box.bottom)

    fuzz([table, labels], check)


def test_floor_plans(fuzz, tmp_path):
    path = tmp_path / "plan.toml"

    def check(content):
        path.write_bytes(content)
        plan = result_of(read_plan, str(path))
        if plan is not None:
            assert prisms(plan) is not None

    fuzz([PLAN.encode()], check)


def test_models_and_their_forms(fuzz, tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    make = onnx.helper
    size = [1, 3, 32, 64]
    tensors = [make.make_tensor_value_info(n, onnx.TensorProto.FLOAT, size) for n in "LRD"]
    nodes = [make.make_node("Sub", ["L", "R"], ["D"])]
    graph = make.make_graph(nodes, "sub", tensors[:2], tensors[2:])
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 18)], ir_version=10)
    whole = model.SerializeToString()
    form = b'inputs = ["L", "R"]\nlevels = "unit"\noutput = "D"\nscale = 1.5\nsize = [32, 64]\n'
    settings = Settings(matcher=f"onnx:{tmp_path}/model.onnx")

    parts = {"onnx": whole, "toml": form}

    def check(example):
        name, content = example
        for suffix, part in (parts | {name: content}).items():
            (tmp_path / f"model.{suffix}").write_bytes(part)
        result_of(load_model, settings)

    fuzz(list(parts.items()), check)


def test_scheduler_files(fuzz, tmp_path):
    path = tmp_path / "scheduler.json"

    def check(content):
        path.write_bytes(content)
        result_of(Cluster(scheduler_file=path).address)

    fuzz([b'{"type": "Scheduler", "id": "a", "address": "tcp://127.0.0.1:9"}'], check)
