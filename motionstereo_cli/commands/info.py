"""``motionstereo info``."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from motionstereo_cli.commands.grouped import GroupedCommand
from motionstereo_cli.commands.messages import printable, say
from motionstereo_cli.commands.options import config_option, input_options, rig_options, say_idle
from motionstereo_cli.commands.progress import quiet_option
from motionstereo_cli.rig.settings import RigSettings
from motionstereo_cli.sources.settings import InputSettings, adapted_rig

if TYPE_CHECKING:
    from motionstereo_cli.sources import StereoSource


@click.command(
    cls=GroupedCommand,
    examples=(
        "motionstereo info left.mp4 right.mp4 --rig rig.yaml",
        "motionstereo info kitti/sequences/00 --json",
    ),
)
@input_options
@rig_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@config_option
@quiet_option
def info(
    *,
    left: str,
    right: str | None,
    input_settings: InputSettings,
    rig: tuple[Path, ...],
    rig_settings: RigSettings,
    as_json: bool,
) -> None:
    """Show what was detected in an input.

    Give it the same options as run. It decodes only the first image of each side. The numbers
    of images come from the files' indices, or are counted; a damaged file may give fewer.
    """
    from motionstereo_cli.check.offset import with_offset
    from motionstereo_cli.rig import rig_values
    from motionstereo_cli.rig.calibration import rectify_source
    from motionstereo_cli.sources import open_stereo
    from motionstereo_cli.sources.bag_topics import bags_in, image_topics_of
    from motionstereo_cli.sources.opening import LoneRecordingError

    try:
        prepare = partial(rectify_source, paths=rig, settings=rig_settings)
        input_settings = with_offset(left, right, input_settings, say, prepare)
        with open_stereo(left, right, input_settings) as source:
            source.count()
            facts = _facts(source)
            if bag := bags_in(left):
                facts["topics"] = [topic._asdict() for topic in image_topics_of(bag)]
            calibration = rectify_source(source, rig, rig_settings)
            if calibration is not None:
                facts["rig"] = rig_values(adapted_rig(calibration.rig, input_settings))
            facts["rig_from"] = calibration and calibration.origin
            say_idle({"--rig"} if calibration else set(), input_settings, rig_settings)
        warnings = (*source.warnings, *(calibration.warnings if calibration else ()))
    except LoneRecordingError as lone:
        facts, warnings = {"recording": lone.described}, (*lone.warnings, str(lone))
    click.echo(json.dumps(facts, indent=2) if as_json else _table(facts))
    for line in warnings:
        say("warning", line)


def _facts(source: StereoSource) -> dict[str, Any]:
    rate = source.frame_rate
    return {
        "layout": source.settings.layout,
        **source.describe(fingerprint=False),
        "delivered": {
            "width": source.width,
            "height": source.height,
            "frames": source.expected_frames,
            "frame_rate": None if rate is None else str(rate),
            **({"focal_px": source.projected_focal_px} if source.settings.project else {}),
        },
    }


def _table(facts: dict[str, Any]) -> str:
    """Return the facts as aligned lines, one for each recording or subject."""
    from motionstereo_cli.sources.bag_topics import Topic

    lines = {}
    for name, fact in facts.items():
        if name == "layout":
            lines[name] = fact
        elif name == "rig_from":
            lines["rig from"] = printable(fact or "nowhere: give --rig for results in m")
        elif name == "topics":
            lines[name] = ", ".join(printable(str(Topic(**topic))) for topic in fact)
        elif name == "rig":
            lines[name] = ", ".join(f"{key} {value:.10g}" for key, value in fact.items())
        else:
            lines[name] = _line(fact)
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {line}" for name, line in lines.items())


def _line(fact: dict[str, Any]) -> str:
    """Return one recording, or what is delivered of it, in words."""
    count = fact["images"] if "images" in fact else fact["frames"]
    number, _, divisor = (fact["frame_rate"] or "").partition("/")
    parts = [
        f"{fact['width']}x{fact['height']} px",
        "unknown number of images" if count is None else f"{count} images",
        f"{int(number) / int(divisor or 1):.6g} per second" if number else "no time",
    ]
    if "focal_px" in fact:
        parts.append(f"pinhole of focal_px {fact['focal_px']:.10g}")
    if "path" in fact:
        parts += [fact["codec"], fact["pixel_format"], f"{fact['range']} range"]
        if fact["rotation_deg"]:
            parts.append(f"turned by {fact['rotation_deg']} degrees")
        parts += [f"{key} {fact[key]}" for key in ("created", "timecode") if key in fact]
        parts += [fact[key] for key in ("projection", "serial_number") if key in fact]
        parts += [f"{fact['view']} view"] if "view" in fact else []
        parts.append(printable(fact["path"]))
        if "topic" in fact:
            known = "with" if fact["camera_info"] else "without"
            parts.append(f"topic {printable(fact['topic'])} {known} camera_info")
    return ", ".join(parts)
