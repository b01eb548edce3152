"""``motionstereo run``."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from motionstereo_cli.commands.options import near_match, processing_options
from motionstereo_cli.errors import OutputError
from motionstereo_cli.settings import Settings
from motionstereo_cli.sinks import DEFAULT_SAVES, SAVES, available

DAMAGED_EXIT_CODE = 3
INTERRUPTED_EXIT_CODE = 130


def _names(ctx: click.Context, _: click.Parameter, lists: tuple[str, ...]) -> tuple[str, ...]:
    names = [name.strip() for text in lists for name in text.split(",")]
    for name in names:
        if name not in SAVES:
            advice = near_match(name, SAVES) or f": choose from {', '.join(SAVES)}"
            raise click.UsageError(f"--save knows no {name!r}{advice}", ctx)
    return tuple(names)


@click.command()
@click.argument("left", type=click.Path(path_type=Path))
@click.argument("right", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--out",
    type=click.Path(allow_dash=True, path_type=Path),
    default="motionstereo_out",
    show_default=True,
    help="Folder for the results; - writes the steering table to standard output, and no files.",
)
@click.option(
    "--rig",
    type=click.Path(path_type=Path),
    help="rig.yaml of the rectified camera; needed for lengths in m and angles in rad.",
)
@click.option(
    "--save",
    multiple=True,
    metavar="NAMES",
    callback=_names,
    help="What to write, as a comma list; may be repeated.  "
    f"[{', '.join(SAVES)}; default {','.join(DEFAULT_SAVES)}]",
)
@click.option("--overwrite", is_flag=True, help="Replace the results of a former run in OUT.")
@processing_options
def run(
    *,
    left: Path,
    right: Path,
    out: Path,
    rig: Path | None,
    save: tuple[str, ...],
    overwrite: bool,
    settings: Settings,
) -> int:
    """Find depth and steering in two videos of a rectified stereo camera.

    LEFT and RIGHT are video files or folders of images.
    """
    to_stdout = str(out) == "-"
    if to_stdout and save:
        raise click.UsageError("-o - writes the steering table alone: leave --save out")
    if to_stdout and sys.stdout is None:
        raise OutputError("cannot write the steering table: standard output is closed")
    save = save or DEFAULT_SAVES
    if not to_stdout and rig is None and available(save, rig=False) != save:
        _say("note", "no --rig, so depth in mm is not known: disparity/ takes the place of depth/")

    from tqdm import tqdm

    from motionstereo_cli.rig import read_rig
    from motionstereo_cli.run import run as run_library
    from motionstereo_cli.sources import open_stereo

    camera = None if rig is None else read_rig(rig)
    with (
        open_stereo(left, right) as source,
        tqdm(total=source.expected_frames, unit="frame", disable=_quiet(to_stdout)) as bar,
    ):
        report = run_library(
            source,
            sys.stdout.buffer if to_stdout else out,
            settings,
            camera,
            save=save,
            overwrite=overwrite,
            inputs=[left, right],
            progress=bar.update,
        )

    for line in report.damage:
        _say("warning", line)
    _say(
        "note",
        f"{report.frames} frames in {report.wall_s:.1f} s "
        f"({report.frames_per_second:.0f} frames per second), "
        f"charged {report.charged:.1%}, matched {report.matched:.1%} of the image",
    )
    if report.interrupted:
        kept = "" if to_stdout else f": what was done is in {out}, tables and videos end in .part"
        _say("error", f"interrupted after {report.frames} frames{kept}")
        return INTERRUPTED_EXIT_CODE
    if not to_stdout:
        _say("note", f"results in {out}: {', '.join((*report.outputs, 'run.json'))}")
    return DAMAGED_EXIT_CODE if report.damage else 0


def _quiet(to_stdout: bool) -> bool | None:
    """Return what tqdm's ``disable`` should be: None shows the bar on a terminal alone."""
    if sys.stderr is None or (to_stdout and sys.stdout.isatty()):
        return True
    return None


def _say(kind: str, text: str) -> None:
    click.echo(f"{kind}: {text}", err=True)
