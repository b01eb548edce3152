"""The stills of the gallery: ``python -m bench gallery OUT [RECORDINGS]``.

Each is a frame of what ``--save preview`` or ``drive --view`` shows.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import av
import cv2

from motionstereo_cli.__main__ import main as motionstereo

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 82)


class Still(NamedTuple):
    """A still of the gallery.

    Attributes:
        commands: what makes the video, with the folder of the results as ``{out}`` and that of the
            recordings as ``{data}``.
        frame: number of the frame that is shown.
        video: its path under the folder of the results.
    """

    commands: tuple[str, ...]
    frame: int
    video: str = "run/preview.mp4"


_SCENE = "{out}/scene/left.mp4 {out}/scene/right.mp4 --rig {out}/scene/rig.yaml -o {out}/run"

#: Recordings that anybody may show; ``RECORDINGS`` has a folder for each.
RECORDED = {
    "overhead_people": Still(
        (
            "run {data}/left.mp4 {data}/right.mp4 --rig {data}/rig.yaml --start 165 --end 200 "
            "-o {out}/run --save preview",
        ),
        26,
    ),
    "chessboard": Still(
        (
            "run {data}/left {data}/right --max-disparity 112 --no-check -o {out}/run "
            "--save preview",
        ),
        6,
    ),
}

#: Simulated ones, which need no files.
RENDERED = {
    "corridor": Still(
        (
            "simulate {out}/scene --frames 310:380 --noise-sigma 1.5",
            f"run {_SCENE} --poses auto --save preview,map",
        ),
        55,
    ),
    "street": Still(
        (
            "simulate {out}/scene --scene street --frames 60 --width 480 --height 320 "
            "--noise-sigma 1.5",
            f"run {_SCENE} --save preview,map",
        ),
        50,
    ),
    "cards": Still(
        (
            "simulate {out}/scene --scene cards --frames 50 --noise-sigma 1.5",
            f"run {_SCENE} --save preview",
        ),
        40,
    ),
    "office": Still(
        ("drive {out}/drive --world office --view --max-frames 70",), 60, "drive/drive.mp4"
    ),
}


def draw(still: Still, out: Path, data: Path | None = None) -> None:
    """Make a still from a recording in ``data``, or without one, and write it as JPEG."""
    with tempfile.TemporaryDirectory() as folder:
        for command in still.commands:
            words = [word.format(out=folder, data=data) for word in command.split()]
            if code := motionstereo([*words, "--quiet"]):
                raise SystemExit(f"exit code {code}: motionstereo {' '.join(words)}")
        with av.open(str(Path(folder) / still.video)) as video:
            for number, frame in enumerate(video.decode(video=0)):
                if number == still.frame:
                    cv2.imwrite(str(out), frame.to_ndarray(format="bgr24"), _JPEG)
                    return
    raise SystemExit(f"{still.video} has no frame {still.frame}")


def main(args: Sequence[str] | None = None) -> None:
    """Make all stills whose recordings there are; the others stay as they are."""
    parser = argparse.ArgumentParser(prog="python -m bench gallery")
    parser.add_argument("out", type=Path)
    parser.add_argument("recordings", type=Path, nargs="?")
    parser.add_argument("--only", nargs="+", choices=[*RECORDED, *RENDERED])
    given = parser.parse_args(args)
    given.out.mkdir(exist_ok=True)
    for name, still in (RECORDED | RENDERED).items():
        data = given.recordings / name if given.recordings and name in RECORDED else None
        if given.only and name not in given.only:
            continue
        if name in RECORDED and (data is None or not data.is_dir()):
            print(f"{name}: there is no such folder in RECORDINGS, so it stays as it is")
            continue
        draw(still, given.out / f"{name}.jpg", data)
        print(given.out / f"{name}.jpg")
