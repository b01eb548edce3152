"""What containers say besides images: tracks, rates, times, holes, references."""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.stream import Disposition
from recordings import COUNT, FULL, LIMITED, Images, encode, folder, number_in, remux, scene
from test_limits import called, moving

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.sinks.outputs import check_video_size
from motionstereo_cli.sources import open_stereo, pipe
from motionstereo_cli.sources.h264 import SliceHeader
from motionstereo_cli.sources.luma import grey_levels
from motionstereo_cli.sources.pace import rhythm
from motionstereo_cli.sources.pipe import Pipe
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.sources.video import VideoRecording


@contextlib.contextmanager
def recorded(*args: Any, **settings: Any) -> Iterator[VideoRecording]:
    with contextlib.closing(VideoRecording(*args, **settings)) as recording:
        yield recording


def tracks(path: Path, *films: Images, posters: int = 0, disposition: int = 0) -> Path:
    """Write several video tracks into a file, the first few of them MJPEG."""
    with av.open(str(path), "w") as container:
        streams = []
        for number, images in enumerate(films):
            stream: Any = container.add_stream("mjpeg" if number < posters else "libx264", rate=30)
            stream.height, stream.width = images[0].shape
            stream.pix_fmt = "yuvj420p" if number < posters else "yuv420p"
            if number < posters and disposition:
                stream.disposition = disposition
            streams.append(stream)
        for stream, images in zip(streams, films, strict=True):
            for index, image in enumerate(images):
                frame = av.VideoFrame.from_ndarray(image, "gray").reformat(format=stream.pix_fmt)
                frame.pts, frame.time_base = index, Fraction(1, 30)
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    return path


# --- Tracks -----------------------------------------------------------------------------------

COVER = [np.zeros((40, 40), np.uint8)]


@pytest.mark.parametrize(
    ("suffix", "disposition"), [(".mp4", Disposition.attached_pic), (".mkv", 0), (".mp4", 0)]
)
def test_covers_and_posters_are_no_recordings(
    tmp_path: Path, suffix: str, disposition: int
) -> None:
    path = tracks(tmp_path / f"v{suffix}", COVER, scene(), posters=1, disposition=int(disposition))
    with recorded(path) as recording:
        assert (recording.width, len(list(recording)), recording.warnings) == (64, COUNT, ())


def test_further_tracks_are_named_and_chosen(tmp_path: Path) -> None:
    path = tracks(tmp_path / "v.mkv", scene(), [255 - image for image in scene()])
    with recorded(path) as recording:
        assert "v.mkv has 2 video tracks, of which the first is used" in recording.warnings[0]
        assert next(iter(recording)).grey.mean() == pytest.approx(scene()[0].mean(), abs=2)
    with recorded(path, track=2) as recording:
        assert recording.warnings == ()
        assert recording.describe()["track"] == 2
        assert next(iter(recording)).grey.mean() == pytest.approx(255 - scene()[0].mean(), abs=2)
    with pytest.raises(SettingsError, match=r"v\.mkv has no video track 3: it has 2"):
        VideoRecording(path, track=3)


@pytest.mark.parametrize(
    ("settings", "negative"),
    [
        ({"layout": "tracks"}, "right"),
        ({"layout": "tracks", "swap": True}, "left"),
        ({"layout": "tracks", "track": "2,1"}, "left"),
    ],
)
def test_two_tracks_are_left_and_right(
    tmp_path: Path, settings: dict[str, Any], negative: str
) -> None:
    path = tracks(tmp_path / "v.mp4", scene(), [255 - image for image in scene()])
    with open_stereo(path, settings=InputSettings(**settings)) as source:
        frames = list(source)
        assert (source.paths, source.rereadable) == ((path,), True)
    assert len(frames) == COUNT
    for frame, image in zip(frames, scene(), strict=True):
        bright = {"left": frame.left, "right": frame.right}[negative]
        assert bright.mean() == pytest.approx(255 - image.mean(), abs=2)


@pytest.mark.parametrize("given", ["0", "1,2,3", "x", "-1", "1,"])
def test_tracks_that_are_none(given: str) -> None:
    with pytest.raises(SettingsError, match=r"--track cannot be"):
        InputSettings(track=given)
    with pytest.raises(SettingsError, match=r"--track cannot be '2': give"):
        InputSettings(layout="tracks", track="2")


# --- Times ------------------------------------------------------------------------------------


def test_bare_streams_have_the_rate_that_they_state(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.h264", scene(), "libx264", "yuv420p")
    with recorded(path) as recording:
        assert (recording.frame_rate, recording.warnings) == (30, ())
        assert [image.pts for image in recording] == list(range(COUNT))
        assert recording.time_base == Fraction(1, 30)
    with recorded(path, rate=Fraction(15)) as recording:
        assert recording.time_base == Fraction(1, 15)


def test_bare_streams_without_a_rate_have_no_time(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.mjpeg", scene(), "mjpeg", "yuvj420p", FULL)
    with recorded(path) as recording:
        assert (recording.frame_rate, recording.time_base) == (None, None)
        assert recording.warnings == (f"{path} has no times: give its rate to --frame-rate",)
    other = encode(tmp_path / "w.mjpeg", scene(), "mjpeg", "yuvj420p", FULL)
    with pytest.raises(SettingsError, match="has no time stamps: give --frame-rate"):
        open_stereo(path, other, InputSettings(start="0.1s"))
    with open_stereo(path, other, InputSettings(start="0.1s", frame_rate=20)) as source:
        assert [frame.time_s for frame in source][:2] == pytest.approx([0.1, 0.15])


@pytest.mark.parametrize(("rate", "expected"), [(b"F30:1", 30), (b"F0:0", None), (b"", None)])
def test_yuv4mpeg_may_state_a_rate_or_none(
    tmp_path: Path, rate: bytes, expected: int | None
) -> None:
    path = encode(tmp_path / "v.y4m", scene(), "rawvideo", "yuv420p")
    path.write_bytes(path.read_bytes().replace(b"F30:1", rate, 1))
    with recorded(path) as recording:
        assert recording.frame_rate == expected
        assert len(list(recording)) == COUNT


def test_a_pause_is_named_and_not_counted_as_images(tmp_path: Path) -> None:
    for suffix in (".mp4", ".mkv"):
        pts = [n if n < 8 else n + 300_000 for n in range(COUNT)]
        path = encode(tmp_path / f"v{suffix}", scene(), "mjpeg", "yuvj420p", FULL, pts=pts)
        with recorded(path) as recording:
            assert [image.number for image in recording] == list(range(COUNT))
            assert (recording.lost, recording.count()) == (0, COUNT)
            assert "time stamps leap by 10000.0 s at 0.2 s" in recording.damage[0]


def test_info_counts_images(tmp_path: Path, capsys: Any) -> None:
    pts = [n if n < 8 else n + 300_000 for n in range(COUNT)]
    path = encode(tmp_path / "v.mkv", scene(), "ffv1", "gray", pts=pts)
    assert called("info", path, "--layout", "side-by-side")[0] == 0
    assert "64x48 px, 12 images" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_a_varying_rate_in_whole_periods_is_no_loss(tmp_path: Path, suffix: str) -> None:
    chance = np.random.default_rng(2)
    pts = np.cumsum([1, 1, *chance.integers(1, 4, 22)]).tolist()
    path = encode(tmp_path / f"v{suffix}", scene(count=24), "ffv1", "gray", pts=pts)
    with recorded(path) as recording:
        assert len(list(recording)) == 24
        assert (recording.lost, recording.flawed, recording.damage) == (0, 0, [])


def test_rhythm_of_an_index() -> None:
    tick = Fraction(1, 1000)
    assert rhythm([0, 33, 67, 133, 167, 100, 300], tick) == (Fraction(30), 10)
    assert rhythm([0, 33, 67, 100, 20_100, 20_133, 20_167], tick).places == 7
    assert rhythm([0, 10, 30, 70, 71], tick) == (None, 5)
    assert rhythm([5, 5, 5], tick) == (None, 3)
    assert rhythm([], tick) == (None, 0)


# --- References -------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"bf": "0"}, {"bf": "2"}, {"bf": "2", "profile": "baseline"}])
@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_what_the_camera_skipped_tears_nothing(
    tmp_path: Path, options: dict[str, str], suffix: str
) -> None:
    options = options | {"g": "30", "sc_threshold": "0"}
    kept = [n for n in range(18) if n != 8]
    images = [moving(18)[n] for n in kept]
    path = encode(tmp_path / f"v{suffix}", images, "libx264", "yuv420p", options=options, pts=kept)
    with recorded(path) as recording:
        assert len(list(recording)) == 17
        assert (recording.lost, recording.flawed) == (1, 0)


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_a_reference_that_is_gone_tears_what_follows(tmp_path: Path, suffix: str) -> None:
    options = {"g": "6", "bf": "0", "sc_threshold": "0"}
    whole = encode(tmp_path / "w.mkv", moving(18), "libx264", "yuv420p", options=options)
    path = remux(whole, tmp_path / f"v{suffix}", lambda i, packet: None if i == 8 else packet)
    with recorded(path) as recording:
        list(recording)
        assert (recording.lost, recording.flawed) == (1, 3)  # 9..11


def test_numbers_of_references_follow_one_another() -> None:
    last = SliceHeader(15, 16, is_reference=True, is_idr=False)
    assert SliceHeader(0, 16, is_reference=True, is_idr=False).follows(last)
    assert not SliceHeader(1, 16, is_reference=True, is_idr=False).follows(last)
    assert SliceHeader(7, 16, is_reference=True, is_idr=True).follows(last)
    last = SliceHeader(15, 16, is_reference=False, is_idr=False)
    assert SliceHeader(15, 16, is_reference=True, is_idr=False).follows(last)


# --- White ------------------------------------------------------------------------------------


def dim(images: Images) -> list[np.ndarray]:
    """12 bits in 16."""
    return [(image.astype(np.uint16) << 4) + (image >> 4) for image in images]


def as_video(path: Path) -> Path:
    with av.open(str(path.with_suffix(".mkv")), "w") as container:
        stream: Any = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "gray16le"
        for index, image in enumerate(dim(scene())):
            frame = av.VideoFrame.from_ndarray(image, "gray16le")
            frame.pts, frame.time_base = index, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path.with_suffix(".mkv")


@pytest.mark.parametrize(
    "make", [as_video, lambda path: folder(path, dim(scene()), ".png")], ids=["video", "images"]
)
def test_deep_images_with_few_bits_are_named_and_made_bright(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    one, other = make(tmp_path / "one"), make(tmp_path / "other")
    with open_stereo(one, other) as source:
        assert "one" in source.warnings[0]
        assert "is dark: no level of its first image is over 409" in source.warnings[0]
        assert "give --white 4095" in source.warnings[0]
    with open_stereo(one, other, InputSettings(white=4095)) as source:
        assert source.warnings == []
        for frame, image in zip(source, scene(), strict=True):
            assert np.abs(frame.left.astype(int) - image).max() <= 1


def test_white_is_a_level_of_the_stream() -> None:
    luma = np.array([[0, 511, 512, 1022, 1023, 1023, 0, 0]] * 8, np.uint16)
    frame = av.VideoFrame.from_ndarray(luma, "gray10le")
    assert grey_levels(frame, 512)[0].tolist() == [0, 254, 255, 255, 255, 255, 0, 0]
    frame = av.VideoFrame.from_ndarray(np.full((8, 8), 100, np.uint8), "gray")
    assert np.unique(grey_levels(frame, 200)).tolist() == [128]


# --- Pipes and files that change ----------------------------------------------------------------


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    if not hasattr(os, "mkfifo"):
        pytest.skip("needs FIFOs")
    os.mkfifo(tmp_path / "fifo")
    return tmp_path / "fifo"


def test_a_fifo_is_a_recording(tmp_path: Path, fifo: Path) -> None:
    film = encode(tmp_path / "v.mkv", scene(), "ffv1", "gray")
    writer = threading.Thread(target=lambda: fifo.write_bytes(film.read_bytes()))
    writer.start()
    images = folder(tmp_path / "images", scene(), ".png")
    with open_stereo(fifo, images) as source:
        assert [number_in(frame.left) for frame in source] == list(range(COUNT))
        assert (source.rereadable, source.paths) == (False, (images,))
        sha256 = source.describe()["left"]["sha256"]
    assert sha256 == hashlib.sha256(film.read_bytes()).hexdigest()
    writer.join()


def test_a_fifo_that_nobody_writes_to(fifo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipe, "PATIENCE_S", 0.3)
    with pytest.raises(InputError, match=r"fifo: nothing came for .* s: see that a program"):
        VideoRecording(Pipe(fifo))


def test_devices_are_no_recordings(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", scene(), ".png")
    with pytest.raises(InputError, match="it is a FIFO, a socket or a device"):
        open_stereo("/dev/zero", images)


def test_the_hash_is_of_the_file_that_was_opened(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.mkv", scene(), "ffv1", "gray", LIMITED)
    other = encode(tmp_path / "w.mkv", [255 - image for image in scene()], "ffv1", "gray")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    with recorded(path) as recording:
        other.replace(path)
        list(recording)
        assert recording.fingerprint()["sha256"] == digest
        assert recording.damage == []


def test_a_file_that_is_written_to_is_named(tmp_path: Path) -> None:
    path = encode(tmp_path / "v.mkv", scene(), "ffv1", "gray", LIMITED)
    with recorded(path) as recording:
        with path.open("ab") as file:
            file.write(bytes(100))
        list(recording)
        assert recording.damage == [f"{path} was written to while the run went on"]


# --- What no video can hold -------------------------------------------------------------------


def test_views_too_wide_for_video_are_refused_before_the_run(tmp_path: Path) -> None:
    wide = [np.zeros((16, 16_400), np.uint8)] * 2
    left, right = (folder(tmp_path / side, wide, ".png") for side in ("left", "right"))
    code, said = called("run", left, right, "-o", tmp_path / "out")
    assert code == 2
    assert "16400x16 px are too large for charge, depth-video: H.264 takes up to 16,384" in said
    assert not (tmp_path / "out").exists()
    check_video_size(["steering", "depth", "depth-mkv"], 20_000, 20_000)
    check_video_size(["charge"], 16_000, 16_000)
