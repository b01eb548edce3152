"""What hostile and damaged input may do: be refused, or be counted, in one line."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from recordings import COUNT, FULL, cut, encode, folder, remux, scene

from motionstereo_cli.__main__ import _fail, main
from motionstereo_cli.commands.messages import printable
from motionstereo_cli.errors import InputError, OutputError, opening, words_of
from motionstereo_cli.evaluation.poses import evaluate_poses
from motionstereo_cli.files.maps import read_map
from motionstereo_cli.files.records import unpack
from motionstereo_cli.files.stills import DamagedImageError, read_still
from motionstereo_cli.files.video import VideoWriter
from motionstereo_cli.report.batch_page import batch_page
from motionstereo_cli.rig.calibration import read_calibration
from motionstereo_cli.rig.poses import read_poses
from motionstereo_cli.runs.checkpoint import read_checkpoint
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.recording import Recording
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.video import VideoRecording


def called(*args: object) -> tuple[int, str]:
    """Run the command line; return its exit code and what it says."""
    with contextlib.redirect_stderr(io.StringIO()) as talk:
        exit_code = main([str(arg) for arg in args])
    assert "Traceback" not in talk.getvalue()
    assert "internal" not in talk.getvalue()
    return exit_code, talk.getvalue()


def moving(count: int = COUNT, size: int = 128) -> list[np.ndarray]:
    """Texture that moves by 3 px a frame."""
    noise = np.random.default_rng(0).integers(0, 256, (size, size + 3 * count)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return [np.ascontiguousarray(smooth[:, 3 * i : 3 * i + size]) for i in range(count)]


def consumed(stream: Recording) -> Recording:
    for _ in stream:
        pass
    stream.close()
    return stream


def test_what_asks_for_more_memory_than_there_is_gets_named() -> None:
    said = r"a\.bag cannot be opened: out of memory.*damaged"
    with pytest.raises(InputError, match=said), opening("a.bag"):
        bytes(1 << 62)
    with pytest.raises(ZeroDivisionError), opening("a.bag"):
        raise ZeroDivisionError


def test_libraries_are_quoted_in_a_short_line() -> None:
    assert words_of(ValueError("a\nb " + "c" * 5000 + ".")) == "a b " + "c" * 196
    assert words_of(OSError(2, "no such file", "x")) == "no such file"
    assert words_of(ValueError()) == "ValueError"


# --- Strictness -------------------------------------------------------------------------------


@pytest.fixture
def mjpeg(tmp_path: Path) -> Path:
    return encode(tmp_path / "whole.mkv", scene(), "mjpeg", "yuvj420p", FULL)


def unreadable_image(whole: Path, spoilt: Path) -> Path:
    path = folder(spoilt.with_suffix(""), scene(), ".png")
    (path / "frame5.png").write_bytes(b"no image")
    return path


def undecodable_image(whole: Path, spoilt: Path) -> Path:
    return remux(whole, spoilt, lambda index, packet: b"no image" if index == 5 else packet)


def missing_image(whole: Path, spoilt: Path) -> Path:
    return remux(whole, spoilt, lambda index, packet: None if index == 5 else packet)


SPOILT = [unreadable_image, undecodable_image, missing_image]


@pytest.mark.parametrize("spoil", SPOILT, ids=lambda spoil: spoil.__name__)
def test_strict_stops_before_the_first_damage_and_otherwise_it_is_counted(
    tmp_path: Path, mjpeg: Path, spoil: Callable[[Path, Path], Path]
) -> None:
    spoilt = spoil(mjpeg, tmp_path / "spoilt.mkv")
    with open_stereo(mjpeg, spoilt) as source:
        assert len(list(source)) == COUNT - 1
        assert source.counts["right"]["damaged"] == 1
    with open_stereo(mjpeg, spoilt, InputSettings(strict=True)) as source:
        frames = iter(source)
        for _ in range(5):
            next(frames)
        with pytest.raises(InputError, match=r"spoilt.* 1 image .*--strict"):
            next(frames)
    command = ["run", mjpeg, spoilt, "--save", "steering", "-o"]
    assert called(*command, tmp_path / "counted")[0] == 3
    exit_code, said = called(*command, tmp_path / "strict", "--strict")
    assert (exit_code, said.count("error: ")) == (1, 1)
    assert not (tmp_path / "strict" / "run.json").exists()


def test_strict_takes_no_short_stream_and_no_gap_in_numbers(tmp_path: Path, mjpeg: Path) -> None:
    short = cut(mjpeg, tmp_path / "short.mkv", 0.7)
    gap = folder(tmp_path / "gap", scene(), ".png")
    (gap / "frame5.png").unlink()
    with (
        open_stereo(mjpeg, short, InputSettings(strict=True)) as source,
        pytest.raises(InputError, match=r"short.* missing at its end.*--strict"),
    ):
        list(source)
    with pytest.raises(InputError, match=r"numbers are missing between 4 and 6.*--strict"):
        open_stereo(mjpeg, gap, InputSettings(strict=True))


def test_strict_lets_whole_input_through(tmp_path: Path, mjpeg: Path) -> None:
    other = folder(tmp_path / "other", scene(), ".png")
    with open_stereo(mjpeg, other, InputSettings(strict=True)) as source:
        assert len(list(source)) == COUNT


# --- Nothing stale goes unsaid ----------------------------------------------------------------


def test_images_decoded_from_a_damaged_one_are_flawed_until_the_next_key_frame(
    tmp_path: Path,
) -> None:
    options = {"g": "6", "bf": "0", "sc_threshold": "0"}
    whole = encode(tmp_path / "whole.mp4", moving(18), "libx264", "yuv420p", options=options)

    def spoil(index: int, packet: bytes) -> bytes:
        half = len(packet) // 2
        return packet[:half] + bytes(len(packet) - half) if index == 7 else packet

    assert consumed(VideoRecording(whole)).flawed == 0
    stream = consumed(VideoRecording(remux(whole, tmp_path / "spoilt.mp4", spoil)))
    assert stream.flawed + stream.lost == 5  # 7..11; 12 is a key frame
    assert stream.flawed >= 4


def test_images_decoded_in_place_of_missing_ones_are_flawed(tmp_path: Path) -> None:
    options = {"g": "6", "bf": "0", "sc_threshold": "0"}
    whole = encode(tmp_path / "whole.mkv", moving(18), "libx264", "yuv420p", options=options)
    path = remux(whole, tmp_path / "gap.mkv", lambda i, packet: None if i == 8 else packet)
    stream = consumed(VideoRecording(path))
    assert (stream.lost, stream.flawed) == (1, 3)  # 9..11


def test_a_wrong_checksum_is_seen(tmp_path: Path) -> None:
    options = {"level": "3", "slicecrc": "1", "g": "1"}
    whole = encode(tmp_path / "whole.mkv", moving(), "ffv1", "gray", options=options)

    def flip(index: int, packet: bytes) -> bytes:
        middle = len(packet) // 2
        wrong = bytes([packet[middle] ^ 8])
        return packet[:middle] + wrong + packet[middle + 1 :] if index in (3, 4) else packet

    assert consumed(VideoRecording(whole)).damage == []
    stream = consumed(VideoRecording(remux(whole, tmp_path / "spoilt.mkv", flip)))
    assert stream.flawed == 2
    assert "2 images decoded with errors" in stream.damage[0]


def test_repeated_images_are_counted_where_the_other_side_moves(tmp_path: Path) -> None:
    images = moving()
    still = [images[0]] * COUNT
    stuck = [*images[:4], images[3], images[3], *images[6:]]
    left = encode(tmp_path / "left.mkv", images, "ffv1", "gray")
    right = encode(tmp_path / "right.mkv", stuck, "ffv1", "gray")
    with open_stereo(left, right) as source:
        list(source)
        assert [source.counts[side]["repeated"] for side in ("left", "right")] == [0, 2]
        assert source.damage == [f"{right}: 2 images repeated while the other side moves"]
    one = encode(tmp_path / "one.mkv", still, "ffv1", "gray")
    other = encode(tmp_path / "other.mkv", still, "ffv1", "gray")
    with open_stereo(one, other) as source:
        list(source)
        assert source.damage == []


def test_decoding_damaged_videos_is_repeatable(tmp_path: Path) -> None:
    whole = encode(tmp_path / "whole.mp4", moving(), "libx264", "yuv420p", options={"g": "6"})
    rng = np.random.default_rng(1)
    counted = 0

    def flip(index: int, packet: bytes) -> bytes:
        spoilt = bytearray(packet)
        if index in (4, 7):
            spoilt[rng.integers(len(packet) // 4, len(packet))] ^= 16
        return bytes(spoilt)

    for _ in range(5):
        path = remux(whole, tmp_path / "spoilt.mp4", flip)
        runs = []
        for _ in range(3):
            stream = VideoRecording(path)
            pixels = [(image.number, image.pts, image.grey.tobytes()) for image in stream]
            runs.append((pixels, stream.lost, stream.flawed, stream.damage))
            stream.close()
        assert runs[0] == runs[1] == runs[2]
        counted += runs[0][2]
    assert counted > 0


# --- Sizes ------------------------------------------------------------------------------------


def png_of(width: int, height: int) -> bytes:
    """Return a small file whose head says that it is a large image."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + checksum

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(1000))
    chunks = (chunk(b"IHDR", head), chunk(b"IDAT", pixels), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.mark.parametrize("size", [(8001, 8000), (12_000, 10_000), (50_000, 50_000)])
def test_images_that_would_fill_the_memory(tmp_path: Path, size: tuple[int, int]) -> None:
    sides = [folder(tmp_path / side, scene(count=3), ".png") for side in ("left", "right")]
    (sides[0] / "frame0.png").write_bytes(png_of(*size))
    exit_code, said = called("run", *sides, "-o", tmp_path / "out")
    assert (exit_code, said.count("\n")) == (1, 1)
    assert "frame0.png is larger than --max-pixels 64000000" in said


def test_the_largest_size_can_be_chosen(tmp_path: Path) -> None:
    video = encode(tmp_path / "left.mp4", scene(), "libx264", "yuv420p")
    other = encode(tmp_path / "right.mp4", scene(), "libx264", "yuv420p")
    images = folder(tmp_path / "images", scene(), ".png")
    with pytest.raises(InputError, match=r"left.mp4 is 64x48: .*--max-pixels 3071"):
        open_stereo(video, other, InputSettings(max_pixels=64 * 48 - 1))
    with pytest.raises(InputError, match=r"frame0.png is larger than --max-pixels 3071 \(64x48"):
        open_stereo(images, other, InputSettings(max_pixels=64 * 48 - 1))
    with open_stereo(video, images, InputSettings(max_pixels=64 * 48)) as source:
        assert len(list(source)) == COUNT
    with pytest.raises(InputError, match=r"views of 128x96 px are more than --max-pixels 3072"):
        open_stereo(video, images, InputSettings(max_pixels=64 * 48, scale=2))


def test_the_size_in_a_calibration(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        "width: 8001\nheight: 8000\nfocal_px: 80\nbaseline_m: 0.1\ncx: 4000\ncy: 4000\n"
    )
    with pytest.raises(InputError, match=r"8001x8000 px are far too large"):
        read_calibration([path])
    assert read_calibration([path], max_pixels=8001 * 8000).rig.width == 8001


def test_files_without_an_end(tmp_path: Path) -> None:
    for read in (read_calibration, read_poses):
        given = [Path("/dev/zero")] if read is read_calibration else "/dev/zero"
        with pytest.raises(InputError, match=r"/dev/zero: it is a FIFO, a socket or a device"):
            read(given)
    with (tmp_path / "long.yaml").open("wb") as file:
        file.truncate(16_000_001)
    with pytest.raises(InputError, match=r"long\.yaml is larger than 16000000 bytes"):
        read_calibration([tmp_path / "long.yaml"])


# --- Other files, and the network -------------------------------------------------------------

PLAYLIST = "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.ts\n#EXT-X-ENDLIST\n"
SCRIPT = "ffconcat version 1.0\nfile secret.ts\n"


@pytest.mark.parametrize("text", [PLAYLIST, SCRIPT], ids=["HLS", "concat"])
@pytest.mark.parametrize("suffix", [".mp4", ".m3u8"])
def test_a_recording_makes_no_other_file_be_read(tmp_path: Path, text: str, suffix: str) -> None:
    secret = encode(tmp_path / "secret.ts", scene(), "libx264", "yuv420p")
    consumed(VideoRecording(secret))
    path = tmp_path / f"playlist{suffix}"
    path.write_text(text)
    with pytest.raises(InputError, match="is not a video that can be decoded"):
        VideoRecording(path)
    if suffix == ".m3u8":
        stream = VideoRecording(path, allow_network=True)
        assert sum(1 for _ in stream) == COUNT


@pytest.mark.parametrize(
    "name",
    [
        *("http://127.0.0.1:9/left.mp4", "rtsp://127.0.0.1:9/", "tcp://127.0.0.1:9", "udp://:9"),
        *("concat:a.mp4|b.mp4", "subfile,,start,0,end,9,,:a.mp4", "data:text/plain,x", "fd:"),
    ],
)
def test_addresses_are_no_files(mjpeg: Path, tmp_path: Path, name: str) -> None:
    exit_code, said = called("run", name, mjpeg, "-o", tmp_path / "out")
    assert (exit_code, said.count("\n")) == (1, 1)
    assert "--allow-network" in said


def test_the_network_is_asked_only_when_allowed(mjpeg: Path) -> None:
    name = "tcp://127.0.0.1:9"  # nobody listens there
    with pytest.raises(InputError, match="is not a video that can be decoded"):
        open_stereo(name, mjpeg, InputSettings(allow_network=True))


def test_files_named_like_addresses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    encode(tmp_path / "a.mp4", scene(), "libx264", "yuv420p").rename("http:a.mp4")
    encode(tmp_path / "b.mp4", scene(), "libx264", "yuv420p").rename("concat:b.mp4|c")
    with open_stereo("http:a.mp4", "concat:b.mp4|c") as source:
        assert len(list(source)) == COUNT


# --- Metadata ---------------------------------------------------------------------------------


def test_control_characters_are_shown_and_not_obeyed(tmp_path: Path) -> None:
    name = tmp_path / "a\x1b[2Jb\nc\u202e.mp4"
    name.write_bytes(b"no video")
    exit_code, said = called("run", name, tmp_path / "nowhere.mp4", "-o", tmp_path / "out")
    assert (exit_code, said.count("\n")) == (1, 1)
    exit_code, said = called("run", name, encode(tmp_path / "b.mkv", scene(), "ffv1", "gray"))
    assert (exit_code, said.count("\n")) == (1, 1)
    assert r"a\x1b[2Jb c\u202e.mp4 is not a video" in said


def test_printable() -> None:
    assert printable("Bänder 日本 ok") == "Bänder 日本 ok"
    assert printable("\x07\u202e\udcff") == r"\x07\u202e\udcff"


def retimed(source: Path, target: Path, scale: int, shift: int, time_base: Fraction) -> Path:
    """Copy a video with other time stamps: ``shift + scale * n`` in a time base."""
    with av.open(str(source)) as old, av.open(str(target), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        stream.time_base = time_base
        packets = [packet for packet in old.demux(video=0) if packet.size]
        for index, packet in enumerate(packets):
            packet.pts = packet.dts = shift + scale * index
            packet.time_base, packet.stream = time_base, stream
            new.mux(packet)
    return target


@pytest.mark.parametrize("suffix", [".mkv", ".mp4", ".avi", ".nut"])
@pytest.mark.parametrize(
    ("scale", "shift", "time_base"),
    [
        (1, 0, Fraction(1, 1_000_000_000)),
        (1, -500, Fraction(1, 30)),
        (1_000_000, 0, Fraction(1)),  # a frame in 12 days
        (1, 2_000_000_000, Fraction(1, 30)),
    ],
    ids=["fast", "negative", "slow", "late"],
)
def test_absurd_time_stamps(
    tmp_path: Path, suffix: str, scale: int, shift: int, time_base: Fraction
) -> None:
    whole = encode(tmp_path / "whole.mkv", scene(), "mjpeg", "yuvj420p", FULL)
    sides = []
    for side in ("left", "right"):
        path = tmp_path / f"{side}{suffix}"
        try:
            sides.append(retimed(whole, path, scale, shift, time_base))
        except (av.FFmpegError, OSError):  # this container has no room for them
            return
    exit_code, said = called("run", *sides, "-o", tmp_path / "out", "--no-check")
    assert exit_code in (0, 1, 3)
    if exit_code == 1:
        assert said.count("error: ") == 1
    else:
        record = json.loads((tmp_path / "out/run.json").read_text())
        assert record["counts"]["written"] > 0


# --- Calibration ------------------------------------------------------------------------------


def test_calibration_files_make_no_objects(tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    path = tmp_path / "rig.yaml"
    for text in (
        f"M1: !!python/object/apply:os.system ['touch {witness}']\nM2: [1]\n",
        f"M1: !!python/object/new:os.system [touch {witness}]\n",
        f'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY e SYSTEM "file://{witness}">]>'
        "<opencv_storage><M1>&e;</M1></opencv_storage>",
    ):
        path.write_text(text)
        with pytest.raises(InputError):
            read_calibration([path], (640, 480))
        assert not witness.exists()


def test_a_title_that_is_no_text(tmp_path: Path) -> None:
    """The encoder's name stands in the file; in another encoding it is nothing that matters."""
    path = encode(tmp_path / "video.mkv", scene(), "ffv1", "gray", FULL)
    content = path.read_bytes()
    assert b"Lavf" in content
    path.write_bytes(content.replace(b"Lavf", b"L\xc5\xc5f"))
    with open_stereo(path, settings=InputSettings(layout="side-by-side")) as source:
        assert sum(1 for _ in source) == COUNT


def test_a_codec_that_nobody_knows(tmp_path: Path) -> None:
    path = encode(tmp_path / "video.mkv", scene(), "ffv1", "gray", FULL)
    path.write_bytes(path.read_bytes().replace(b"V_FFV1", b"V_FFVX"))
    with pytest.raises(InputError, match="is in a format that cannot be decoded"):
        VideoRecording(path)


#: Readers of files, the head of one that is far larger than it can be, and what is said of it.
SPARSE: dict[str, tuple[Callable[[Path], object], bytes, str]] = {
    "x.png": (
        read_still,
        cv2.imencode(".png", np.zeros((8, 8)))[1].tobytes(),
        "more than an image",
    ),
    "y.png": (read_still, b"", "cannot identify image"),
    "x.pfm": (read_still, b"Pf\n8 8\n-1\n" + bytes(256), "more than an image of 64 px"),
    "y.pfm": (read_still, b"", "more than an image of 0 px"),
    "huge.png": (read_still, b"", "is larger than --max-pixels"),
    "huge.npy": (read_map, b"", "is larger than --max-pixels"),
    "poses.txt": (read_poses, b"0 0 0 0 0 0 0 1\n", "a line of more than 65536 bytes"),
    "rig.yaml": (lambda path: read_calibration([path], (8, 8)), b"", "is larger than"),
    "huge.checkpoint": (lambda path: read_checkpoint(path, {}), b"", "is larger than"),
}


@pytest.mark.parametrize("name", SPARSE)
def test_what_is_too_large_is_not_read(tmp_path: Path, name: str) -> None:
    """A file without content takes no place on the disk, whatever size it has."""
    read, head, said = SPARSE[name]
    path = tmp_path / name
    with path.open("wb") as file:
        file.write(head)
        file.truncate(20_000_000_000 if "huge" in name else 300_000_000)
    tracemalloc.start()
    try:
        with pytest.raises((InputError, OutputError, DamagedImageError), match=said):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_large_images_are_read(tmp_path: Path) -> None:
    """Notes and pages make a file larger than its first image needs."""
    path, pages = tmp_path / "pages.tif", [np.full((1000, 1000), n, np.uint8) for n in range(20)]
    assert cv2.imwritemulti(str(path), pages, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    assert path.stat().st_size > 16_000_000
    assert read_still(path).pages == 20


def test_there_is_a_number_of_poses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("motionstereo_cli.rig.pose_forms._MAX_POSES", 3)
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{n} {n} 0 0 0 0 0 1\n" for n in range(3)))
    assert len(read_poses(path).poses) == 3
    with path.open("a") as file:
        file.write("3 3 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="has more than 3 poses"):
        read_poses(path)
    monkeypatch.undo()
    monkeypatch.setattr("motionstereo_cli.evaluation.poses._MAX_POSES", 3)
    with pytest.raises(InputError, match="has more than 3 poses"):
        evaluate_poses(path, path)


def test_there_is_a_number_of_recordings_on_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("motionstereo_cli.report.batch_page._MAX_ROWS", 3)
    head, rows = "name,status\n", [f"{n},failed\n" for n in range(4)]
    table = tmp_path / "batch.csv"
    table.write_text(head + "".join(rows[:3]))
    assert "3 recordings" in batch_page(tmp_path, tmp_path / "report.html")
    table.write_text(head + "".join(rows))
    with pytest.raises(InputError, match="has more than 3 recordings"):
        batch_page(tmp_path, tmp_path / "report.html")


def test_a_folder_that_is_gone(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    here = Path.cwd()
    gone = tmp_path / "gone"
    gone.mkdir()
    os.chdir(gone)
    try:
        gone.rmdir()
        with pytest.raises(FileNotFoundError) as raised:
            Path.cwd()
    finally:
        os.chdir(here)
    assert _fail(raised.value) == 1
    assert capsys.readouterr().err.startswith("error: the current folder has been removed")


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_no_name_of_an_output_is_an_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    """FFmpeg takes what precedes a colon for a protocol."""
    monkeypatch.chdir(tmp_path)
    for name in ("tcp:/127.0.0.1:1", "concat:a|b", "file:x"):
        path = Path(name, f"depth{suffix}")
        path.parent.mkdir(parents=True)
        video = VideoWriter(path, Fraction(1, 25))
        video.write(np.zeros((16, 16), np.uint8), 0)
        video.close()
        assert path.stat().st_size > 500


def test_an_archive_that_grows_is_refused() -> None:
    file = io.BytesIO()
    np.savez_compressed(file, record=np.zeros(1_000_000, np.uint8))
    with pytest.raises(ValueError, match="it is compressed"):
        unpack(file.getvalue(), dict)


def test_pillow_prints_nothing() -> None:
    assert any(type(each) is logging.NullHandler for each in logging.getLogger("PIL").handlers)


class Unseekable:
    """A damaged container, in which FFmpeg finds no way back."""

    def __init__(self, source: av.container.InputContainer) -> None:
        self._source = source

    def __getattr__(self, name: str) -> object:
        return getattr(self._source, name)

    def seek(self, *_: object, **__: object) -> None:
        raise av.PermissionError(1, "Operation not permitted")


def test_a_video_that_cannot_be_seeked_is_opened_anew(tmp_path: Path) -> None:
    path = encode(tmp_path / "video.mkv", moving(), "libx264", "yuv420p", FULL)
    with contextlib.closing(VideoRecording(path)) as whole:
        images = [(each.number, each.grey.tobytes()) for each in whole]
    with contextlib.closing(VideoRecording(path)) as recording:
        source: object = Unseekable(recording._file.source)
        recording._file.source = source  # type: ignore[assignment]
        recording.skip_to(3)
        assert [(each.number, each.grey.tobytes()) for each in recording][-2:] == images[-2:]
        assert recording._file.source is not source
