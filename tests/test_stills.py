"""Still images that cameras, programs and strangers write: read right, counted, or refused."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow
from recordings import COUNT, folder, number_in, scene

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.stills import DamagedImageError, read_still
from motionstereo_cli.sinks.read_back import Maps
from motionstereo_cli.sources import open_stereo
from motionstereo_cli.sources.folder import FolderRecording
from motionstereo_cli.sources.settings import InputSettings

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n"


def test_no_image_starts_a_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bin").mkdir()
    ghostscript = tmp_path / "bin" / "gs"
    ghostscript.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    ghostscript.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    images = folder(tmp_path / "images", scene(), ".png")
    (images / "frame3.png").write_bytes(EPS)
    recording = FolderRecording(images)
    assert [image.number for image in recording] == [n for n in range(COUNT) if n != 3]
    assert recording.damage == [f"{images}: 1 image could not be read, the first is frame3.png"]
    assert not (tmp_path / "started").exists()


def test_other_formats_under_the_name_of_an_image_are_damage(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    for other in ("GIF", "ICO", "PCX", "TGA", "JPEG2000"):
        Pillow.fromarray(scene()[0]).save(path, other)
        with pytest.raises(DamagedImageError):
            read_still(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs")
def test_a_fifo_among_images_is_damage_and_nobody_waits_for_it(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", scene(), ".png")
    (images / "frame3.png").unlink()
    os.mkfifo(images / "frame3.png")
    os.symlink("/dev/zero", images / "frame99.png")
    recording = FolderRecording(images)
    assert len(list(recording)) == COUNT - 1
    assert recording.lost == 2
    recording.fingerprint()


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", scene(), ".png")
    for name in ("._frame3.png", "Thumbs.db", ".DS_Store"):
        (images / name).write_bytes(b"\0\5\x16\7")
    recording = FolderRecording(images)
    assert (len(list(recording)), recording.damage) == (COUNT, [])
    truth = folder(tmp_path / "disparity", [i * np.uint16(256) for i in scene()], ".png")
    (truth / "._frame3.png").write_bytes(b"\0\5\x16\7")
    assert list(Maps(truth).files) == list(range(COUNT))


# --- Pixels -----------------------------------------------------------------------------------


def first(path: Path, **settings: Any) -> np.ndarray:
    return next(iter(FolderRecording(path, **settings))).grey


def test_big_endian_16_bit_tiff(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    image = scene()[0]
    samples = (image * np.uint16(257)).astype(">u2").tobytes()
    tags = [(256, 64), (257, 48), (258, 16), (259, 1), (262, 1), (273, 8), (277, 1), (278, 48)]
    tags.append((279, len(samples)))
    entries = b"".join(
        n.to_bytes(2) + (4).to_bytes(2) + (1).to_bytes(4) + v.to_bytes(4) for n, v in tags
    )
    head = b"MM\0*" + (8 + len(samples)).to_bytes(4)
    (tmp_path / "images" / "a.tif").write_bytes(
        head + samples + len(tags).to_bytes(2) + entries + bytes(4)
    )
    np.testing.assert_array_equal(first(tmp_path / "images"), image)


@pytest.mark.parametrize("suffix", [".tif", ".jpg"])
def test_inks_become_the_grey_that_they_print(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "images").mkdir()
    grey = Pillow.fromarray(scene()[0])
    grey.convert("RGB").convert("CMYK").save(tmp_path / f"images/a{suffix}", quality=95)
    assert np.abs(first(tmp_path / "images").astype(int) - scene()[0]).max() <= 6


def test_colour_spaces_that_are_not_known_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    Pillow.new("LAB", (64, 48)).save(tmp_path / "images/a.tif")
    with pytest.raises(InputError, match=r"a\.tif has LAB pixels: convert it to grey or RGB"):
        FolderRecording(tmp_path / "images")


# --- PFM --------------------------------------------------------------------------------------

VALUES = np.arange(12, dtype=np.float32).reshape(3, 4) + np.float32(0.5)


def pfm(head: bytes, order: str, values: np.ndarray = VALUES, more: bytes = b"") -> bytes:
    return head + values[::-1].astype(order).tobytes() + more


@pytest.mark.parametrize(
    "content",
    [
        pfm(b"Pf\n4 3\n-1.0\n", "<f4"),
        pfm(b"Pf\n4 3\n1.0\n", ">f4"),
        pfm(b"Pf\r\n4 3\r\n-1.0\r\n", "<f4"),
        pfm(b"Pf\n4 3\n-0.003922\n", "<f4"),  # as in Middlebury's third evaluation
        pfm(b"Pf 4 3 1 ", ">f4"),
    ],
)
def test_pfm_in_all_its_forms(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.pfm").write_bytes(content)
    np.testing.assert_array_equal(read_still(tmp_path / "a.pfm").pixels, VALUES)


def test_the_first_byte_of_a_pfm_may_look_like_its_head(tmp_path: Path) -> None:
    values = np.frombuffer(b"\n\0\0@" * 12, "<f4").reshape(3, 4)
    (tmp_path / "a.pfm").write_bytes(pfm(b"Pf\n4 3\n-1\r", "<f4", values))
    np.testing.assert_array_equal(read_still(tmp_path / "a.pfm").pixels, values)


def test_colour_pfm_has_three_channels(tmp_path: Path) -> None:
    values = np.arange(36, dtype=np.float32).reshape(3, 4, 3)
    (tmp_path / "a.pfm").write_bytes(pfm(b"PF\n4 3\n-1\n", "<f4", values))
    np.testing.assert_array_equal(read_still(tmp_path / "a.pfm").pixels, values)
    (tmp_path / "disparity").mkdir()
    (tmp_path / "a.pfm").rename(tmp_path / "disparity/0.pfm")
    with pytest.raises(InputError, match="a one-channel PFM"):
        Maps(tmp_path / "disparity").read(0)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (pfm(b"Pf\n4 3\n-1\n", "<f4", more=b"\n"), "49 bytes of values, where 4x3 px need 48"),
        (pfm(b"Pf\n4 3\n-1\n", "<f4")[:-1], "47 bytes of values"),
        (pfm(b"Pf\n4 3\n-1\r\n", "<f4").replace(b"\0\0\0?", b"\0\0\0?\r"), "49 bytes of values"),
        (pfm(b"Pf\n4 3\n0\n", "<f4"), "its head is not that of a PFM"),
        (pfm(b"Pf\n4 3\ne.e\n", "<f4"), "its head"),
        (b"P5\n4 3\n255\n" + bytes(12), "its head"),
        (b"Pf\n4", "its head"),
    ],
)
def test_pfm_that_says_two_things_is_refused(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "a.pfm").write_bytes(content)
    with pytest.raises(DamagedImageError, match=said):
        read_still(tmp_path / "a.pfm")


# --- What was read is what is recorded ----------------------------------------------------------


def sums(path: Path, contents: list[bytes]) -> str:
    text = b"".join(
        hashlib.sha256(content).hexdigest().encode() + b"  " + os.fsencode(file.name) + b"\n"
        for file, content in zip(sorted(path.iterdir()), contents, strict=True)
    )
    return hashlib.sha256(text).hexdigest()


def test_the_hash_is_of_the_bytes_that_were_decoded(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", scene(count=4), ".png")
    contents = [file.read_bytes() for file in sorted(images.iterdir())]
    recording = FolderRecording(images)
    list(recording)
    for file in images.iterdir():
        file.write_bytes(b"another")
    assert recording.fingerprint()["sha256"] == sums(images, contents)
    assert recording.fingerprint()["bytes"] == sum(map(len, contents))
    assert recording.damage == []


def test_images_that_change_after_the_hash_are_named(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", scene(count=4), ".png")
    recording = FolderRecording(images)
    recording.fingerprint()
    assert cv2.imwrite(str(images / "frame2.png"), 255 - scene()[2])
    list(recording)
    assert recording.damage == [f"{images}: 1 image changed while the run went on"]


@pytest.mark.skipif(os.name != "posix", reason="names are text elsewhere")
def test_names_need_not_be_utf8(tmp_path: Path) -> None:
    sides = []
    for side in ("left", "right"):
        sides.append(folder(tmp_path / side, scene(count=4), ".png"))
        for file in sides[-1].iterdir():
            os.rename(file, os.fsencode(file.parent) + b"/caf\xe9_" + os.fsencode(file.name))
    with open_stereo(*sides) as source:
        assert [number_in(frame.left) for frame in source] == list(range(4))
        contents = [file.read_bytes() for file in sorted(sides[0].iterdir())]
        assert source.describe()["left"]["sha256"] == sums(sides[0], contents)


# --- Times ------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["image_0{}/data", "image_0{}/data_rect"])
def test_raw_recordings_of_kitti_have_dates_beside_the_images(tmp_path: Path, form: str) -> None:
    for camera in (0, 1):
        path = tmp_path / form.format(camera)
        path.parent.mkdir()
        folder(path, scene(), ".png", "{:010d}")
        lines = [f"2011-09-26 13:02:{25 + n / 10 + camera / 100:012.9f}" for n in range(COUNT)]
        (path.parent / "timestamps.txt").write_text("\n".join(lines) + "\n")
        (path / f"{4 + camera:010d}.png").unlink()
    with open_stereo(tmp_path) as source:
        frames = list(source)
        described = source.describe()["left"]
    assert [number_in(frame.left) for frame in frames] == [*range(4), *range(6, COUNT)]
    assert frames[2].time_s == pytest.approx(1317042145.21)
    table = (tmp_path / form.format(0)).parent / "timestamps.txt"
    assert described["times_sha256"] == hashlib.sha256(table.read_bytes()).hexdigest()


@pytest.mark.parametrize("stamp", ["9" * 19, str(2**63), "²"])
def test_stamps_beyond_64_bits_are_refused_at_the_start(tmp_path: Path, stamp: str) -> None:
    (tmp_path / "cam0").mkdir()
    data = folder(tmp_path / "cam0/data", scene(count=2), ".png")
    (tmp_path / "cam0/data.csv").write_text(f"0,frame0.png\n{stamp},frame1.png\n")
    with pytest.raises(InputError, match=r"data\.csv, line 2: give 'time stamp in ns,file name'"):
        FolderRecording(data)


@pytest.mark.parametrize(
    ("given", "rate"),
    [(33.333333333333336, "100/3"), (29.97002997002997, "30000/1001"), (29.97, "2997/100")],
)
def test_rates_are_ratios_that_a_video_can_hold(given: float, rate: str) -> None:
    assert str(InputSettings(frame_rate=given).rate) == rate


def test_rates_that_no_video_can_hold_are_refused() -> None:
    for given in (1e-300, 0.0009):
        with pytest.raises(SettingsError, match=r"--frame-rate cannot be .*: give 0\.001 to"):
            InputSettings(frame_rate=given)


def paged(path: Path, count: int = COUNT, **options: Any) -> Path:
    pages = [Pillow.fromarray(image) for image in scene()[:count]]
    if path.suffix == ".webp":
        pages, options = [page.convert("RGB") for page in pages], {"lossless": True}
    pages[0].save(path, save_all=True, append_images=pages[1:], **options)
    return path


@pytest.mark.parametrize("suffix", [".tif", ".png", ".webp"])
def test_a_file_of_several_images_is_a_recording(tmp_path: Path, suffix: str) -> None:
    left, right = (paged(tmp_path / f"{side}{suffix}") for side in "lr")
    with open_stereo(left, right, InputSettings(frame_rate=10)) as source:
        assert source.expected_frames == COUNT
        frames = list(source)
        assert [number_in(frame.left) for frame in frames] == list(range(COUNT))
        np.testing.assert_array_equal(frames[4].right, scene()[4])
        assert frames[5].time_s == 0.5
        assert not source.damage
    with open_stereo(left, right) as source:
        assert source.begin_at(7)
        assert number_in(next(iter(source)).left) == 7


def test_pages_that_are_cut_off_or_too_large_are_said(tmp_path: Path) -> None:
    whole, cut = paged(tmp_path / "whole.tif"), tmp_path / "cut.tif"
    cut.write_bytes(whole.read_bytes()[:-1500])
    with open_stereo(whole, cut) as source:
        frames = list(source)
        assert 1 < len(frames) < COUNT
        assert "could not be read" in source.damage[0]
    with pytest.raises(InputError, match="larger than --max-pixels"):
        open_stereo(whole, cut, InputSettings(max_pixels=3000))


def test_pages_within_a_folder_and_pictures_that_are_not_read_are_named(tmp_path: Path) -> None:
    for side in "lr":
        (tmp_path / side).mkdir()
        for number in range(3):
            paged(tmp_path / side / f"{number}.png", 2)
    with open_stereo(tmp_path / "l", tmp_path / "r") as source:
        assert "has 2 pages, of which the first is used" in source.warnings[0]
    (tmp_path / "other").mkdir()
    Pillow.fromarray(scene()[0]).save(tmp_path / "other" / "0.jp2")
    with pytest.raises(InputError, match=r"convert its \.jp2 files to PNG"):
        open_stereo(tmp_path / "other", tmp_path / "r")
