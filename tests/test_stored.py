"""Batches in an object store: a real server on this machine, which may go away for a while."""

import contextlib
import functools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress

import pytest

from motionstereo_cli.__main__ import main
from motionstereo_cli.errors import InputError, OutputError
from motionstereo_cli.files import store as stores
from motionstereo_cli.files.store import Store, address_of
from motionstereo_cli.simulate.settings import SimulateSettings
from motionstereo_cli.simulate.write import simulate

pytest.importorskip("moto.server")
pytest.importorskip("s3fs")

FRAMES, NAMES = 3, ["day/a", "day/b", "day/c", "d"]


class Proxy:
    """Passes connections on to a server; while it is down, it refuses and cuts them."""

    def __init__(self, port):
        self._target, self.down = ("127.0.0.1", port), False
        self._open = set()
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while True:
            mine, _ = self._socket.accept()
            if self.down:
                mine.close()
                continue
            with suppress(OSError):
                theirs = socket.create_connection(self._target)
                self._open |= {mine, theirs}
                for one, other in ((mine, theirs), (theirs, mine)):
                    threading.Thread(target=self._pass, args=(one, other), daemon=True).start()

    def _pass(self, one, other):
        with suppress(OSError):
            while content := one.recv(1 << 16):
                other.sendall(content)
        for each in (one, other):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def go_down(self):
        self.down = True
        for each in list(self._open):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)


@pytest.fixture(scope="module")
def proxy(tmp_path_factory):
    """An S3 server of moto in a process of its own, behind a proxy."""
    with closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until(lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0)
    proxy = Proxy(port)
    patch = pytest.MonkeyPatch()
    patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{proxy.port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        patch.setenv(name, "testing")
    patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    yield proxy
    patch.undo()
    server.kill()
    server.wait()


@pytest.fixture(scope="module")
def bucket(proxy, tmp_path_factory):
    """A bucket with a recording and a manifest, and the folder they came from."""
    folder = tmp_path_factory.mktemp("bucket")
    settings = SimulateSettings(frames=f"300:{300 + FRAMES}", width=96, height=64, noise_sigma=1.5)
    simulate(folder / "clip", settings)
    rows = [f"clip/left.mp4,clip/right.mp4,clip/rig.yaml,{name}" for name in NAMES]
    (folder / "all.csv").write_text("\n".join(["left,right,rig,out", *rows]) + "\n")
    system().mkdir("archive")
    for path in folder.rglob("*.*"):
        system().put_file(str(path), f"archive/in/{path.relative_to(folder).as_posix()}")
    return folder


def until(condition, seconds=60):
    until_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.05)


def words(out, scratch, *more):
    given = ["batch", "s3://archive/in/all.csv", "-o", f"s3://archive/{out}"]
    given += ["--no-check", "--workers", "1", "--scratch", scratch, "--save", "steering,depth"]
    return [str(word) for word in (*given, *more)]


@functools.cache
def system():
    import s3fs

    return s3fs.S3FileSystem(use_listings_cache=False, skip_instance_cache=True)


def names(out):
    return [path.removeprefix(f"archive/{out}/") for path in system().find(f"archive/{out}/")]


def objects(out):
    found = {}
    for name in names(out):
        with contextlib.suppress(FileNotFoundError):  # it has just been removed
            found[name] = system().cat_file(f"archive/{out}/{name}")
    return found


@functools.cache
def done_here(bucket):
    """Return what run makes of the recording on this machine, by name."""
    out, clip = (
        bucket / "alone",
        [str(bucket / "clip" / name) for name in ("left.mp4", "right.mp4")],
    )
    options = ["--rig", str(bucket / "clip/rig.yaml"), "--no-check", "--save", "steering,depth"]
    assert main(["run", *clip, *options, "-o", str(out)]) == 0
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*.*")}


def check_whole(out, bucket):
    """Every recording has all of its files, those of run, and nothing else is there."""
    alone = done_here(bucket)
    found = objects(out)
    for name in NAMES:
        mine = {
            path.removeprefix(f"{name}/"): content
            for path, content in found.items()
            if path.startswith(f"{name}/")
        }
        assert mine.keys() == alone.keys()
        assert {**mine, "run.json": b""} == {**alone, "run.json": b""}
        inputs = json.loads(mine["run.json"])["inputs"]
        assert inputs["left"]["path"] == "s3://archive/in/clip/left.mp4"
    table = found["batch.csv"].decode().splitlines()
    assert [line.split(",")[:2] for line in table[1:]] == [[name, "done"] for name in NAMES]


def started(*given):
    command = [sys.executable, "-m", "motionstereo_cli", *given]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def test_shards_on_machines_without_a_common_disk_make_one_batch(bucket, tmp_path, capsys):
    for index in range(2):
        scratch = tmp_path / f"machine{index}"
        assert main(words("shards", scratch, "--shard", f"{index}/2")) == 0
        assert not list(scratch.rglob("*.mp4"))
        assert not list(scratch.rglob("run.json"))
    check_whole("shards", bucket)
    before = objects("shards")
    capsys.readouterr()
    assert main(words("shards", tmp_path / "machine2", "--shard", "1/1")) == 0
    assert "4 recordings: 4 done; see s3://archive/shards/batch.csv" in capsys.readouterr().err
    after = objects("shards")
    assert before == after
    assert main(words("shards", tmp_path / "machine3", "--status")) == 0


def test_a_killed_batch_leaves_nothing_half_and_goes_on(bucket, tmp_path):
    process = started(*words("killed", tmp_path / "scratch", "--shard", "0/1"))
    until(lambda: any(name.endswith("run.json") for name in names("killed")))
    process.send_signal(signal.SIGKILL)
    process.communicate()
    found = names("killed")
    for name in NAMES:
        if f"{name}/run.json" in found:
            assert f"{name}/steering.csv" in found
            assert f"{name}/depth/{FRAMES - 1:06d}.png" in found
    assert main(words("killed", tmp_path / "elsewhere", "--shard", "0/1")) == 0
    check_whole("killed", bucket)


def test_the_store_may_be_gone_for_a_while(bucket, proxy, tmp_path):
    process = started(*words("outage", tmp_path / "scratch", "--shard", "0/1"))
    until(lambda: any(name.endswith("run.json") for name in names("outage")))
    proxy.go_down()
    time.sleep(float(os.environ.get("MOTIONSTEREO_OUTAGE_S", "3")))
    proxy.down = False
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert "Traceback" not in said
    check_whole("outage", bucket)


def test_what_the_store_lacks_or_is_too_large_is_named(bucket, proxy, tmp_path, capsys):
    system().pipe_file("archive/in/bad.csv", b"left,right,out\nnone.mp4,clip/right.mp4,a\n")
    given = words("bad", tmp_path / "scratch", "--shard", "0/1")
    given[1] = "s3://archive/in/bad.csv"
    assert main(given) == 1
    assert "there is no s3://archive/in/none.mp4" in capsys.readouterr().err
    assert main(words("small", tmp_path / "s", "--shard", "0/1", "--fetch-mb", "1")) == 0
    system().pipe_file("archive/in/clip/large.mp4", bytes(1_100_000))
    system().pipe_file("archive/in/bad.csv", b"left,right,out\nclip/large.mp4,clip/right.mp4,a\n")
    given = words(
        "bad", tmp_path / "scratch", "--shard", "0/1", "--fetch-mb", "1", "--retry-failed"
    )
    given[1] = "s3://archive/in/bad.csv"
    assert main(given) == 1
    assert "more than --fetch-mb lets be fetched" in capsys.readouterr().err
    # A folder of somebody else is not touched.
    system().pipe_file("archive/mine/notes.txt", b"mine")
    assert main(words("mine", tmp_path / "m", "--shard", "0/1")) == 1
    assert "s3://archive/mine is not from an earlier batch" in capsys.readouterr().err
    assert objects("mine") == {"notes.txt": b"mine"}
    given = words("x", tmp_path / "x")
    given[1] = "s3://archive/in/none.csv"
    assert main(given) == 1
    assert "there is no manifest s3://archive/in/none.csv" in capsys.readouterr().err
    assert main(words("x", tmp_path / "x", "--scheduler", "tcp://127.0.0.1:9")) == 2
    assert "needs --shard, or workers of this machine" in capsys.readouterr().err


def test_recordings_of_the_web_go_into_a_folder_of_this_machine(bucket, tmp_path):
    served = subprocess.Popen(
        [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1"],
        cwd=bucket,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        port = re.search(r"port (\d+)", served.stdout.readline())[1]
        manifest = f"http://127.0.0.1:{port}/all.csv"
        given = ["batch", manifest, "-o", str(tmp_path / "out"), "--no-check", "--shard", "0/1"]
        assert main([*given, "--save", "steering"]) == 0
        record = json.loads((tmp_path / "out/d/run.json").read_text())
        assert record["inputs"]["left"]["path"] == f"http://127.0.0.1:{port}/clip/left.mp4"
        assert not list((tmp_path / "out").rglob("*.mp4"))
    finally:
        served.terminate()
        served.communicate()


@pytest.mark.parametrize(
    ("name", "address"),
    [
        ("s3://b/x y", "s3://b/x y"),
        ("s3:/b/x", "s3://b/x"),  # as a path of this system has it
        ("https://h/x?y=1", "https://h/x?y=1"),
        *((name, None) for name in ("s3", "s3:", "s3://", "./s3://b", "ftp://h/x", "C:/x", "-")),
    ],
)
def test_an_address_is_told_from_a_path(name, address):
    assert address_of(name) == address


class Failing:
    """A store that answers the third time, or never will."""

    def __init__(self, error):
        self.error, self.times = error, 0

    def find(self, path, detail):
        self.times += 1
        if self.times < 3:
            raise self.error
        return {path: {"size": 1}}


def test_a_store_is_asked_again_unless_it_refuses(monkeypatch):
    monkeypatch.setattr(stores, "_FIRST_PAUSE_S", 0.01)
    store = Store("http://127.0.0.1:9/x")
    store._system = Failing(OSError("gone"))
    assert store.files() == {"": 1}
    for error in (PermissionError("no"), type("Refused", (OSError,), {"status": 403})("no")):
        store._system = Failing(error)
        with pytest.raises(InputError, match="cannot be read: no"):
            store.files()
        assert store._system.times == 1
    with pytest.raises(OutputError, match="cannot write http://127"):
        Store(store.address, patience_s=0.05).put([("/dev/null", "x")])


def test_an_address_that_never_answers_is_said_soon(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for room in ("manifest", "stored"):
        monkeypatch.setattr(f"motionstereo_cli.batch.{room}.FIRST_PATIENCE_S", 0.05)
    (tmp_path / "m.csv").write_text("left,right,out\nl.mp4,r.mp4,a\n")
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        address = f"http://127.0.0.1:{free.getsockname()[1]}/x"
    assert main(["batch", "m.csv", "-o", address, "--shard", "0/1"]) == 1
    assert main(["batch", f"{address}.csv", "-o", "out", "--shard", "0/1"]) == 1
    assert capsys.readouterr().err.count(f"{address}") == 2
