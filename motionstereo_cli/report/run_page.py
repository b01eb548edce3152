"""The page of a run."""

from __future__ import annotations

import math
from collections import Counter
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.reading import real
from motionstereo_cli.report import write_report
from motionstereo_cli.report.pictures import (
    address_of,
    encoded,
    height_of,
    histogram,
    poster,
)
from motionstereo_cli.report.render import render
from motionstereo_cli.report.run_folder import FRAME_S, Results, SteeringTable, read_results
from motionstereo_cli.report.series import LATER_S, MIN_ROWS, SOON_S, plotted, tracks
from motionstereo_cli.report.trajectory import trajectory
from motionstereo_cli.report.words import changed, command, troubles
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.read_back import Maps
from motionstereo_cli.sinks.records import RunRecord
from motionstereo_cli.sinks.scale import DepthScale
from motionstereo_cli.sinks.settings import OutputSettings

#: Widths of pictures within the page in px.
_POSTER_PX, _MAP_PX = 640, 1000

#: Cells of map.png that are neither occupied nor free.
_UNKNOWN = 205

#: Clocks with less than a year in s do not count from 1970.
_A_YEAR_S = 366 * 86_400

#: What a letter of a tick takes of the width of the narrowest scale.
_TICK_ROOM = 0.035
#: Ticks that are nearer to an end of the scale stay within it.
_END = 0.04


def run_page(out: Path, page: Path, record: RunRecord | None = None) -> str:
    """Return the page of a run, HTML that needs only the run's videos, if they exist.

    Args:
        out: the run's folder.
        page: path of the page; the addresses of the videos are relative to it.
        record: the future content of ``run.json``, if the run has not written it yet.

    Raises:
        InputError: the folder is not the output of a run, or a table in it is damaged.
    """
    run = Results(out, record, complete=True, trusted=True) if record else read_results(out)
    said = run.record
    steering = run.steering()
    try:
        scale = DepthScale.recorded(said)
    except SettingsError as error:
        raise InputError(f"{out / 'run.json'} is damaged: {error}") from error
    data: dict[str, Any] = {}
    facts: list[Fact] = []
    shares: dict[str, float] = {}
    objects = None
    if steering:
        data = plotted(steering)
        shares = {name: n / len(steering) for name, n in Counter(steering.status).items()}
        facts = _facts(steering, scale.quantity)
        objects = _objects(run, steering)
    return render(
        "run.html",
        ("theme.js", "uPlot.iife.min.js", "page.js"),
        data=data,
        name=real(out).name,
        run=run,
        reference=run.reference,
        about=_about(said, steering),
        panels=_panels(run, page, steering, scale),
        scale=_drawn(scale),
        facts=facts,
        shares=shares,
        objects=objects,
        soon_s=SOON_S,
        later_s=LATER_S,
        min_rows=MIN_ROWS,
        histogram=_histogram(run, scale),
        map=_map(run),
        trajectory=trajectory(run, steering),
        troubles=troubles(said),
        changed=list(changed(said)),
        command=command(said, real(out).name),
        outputs=_outputs(run),
    )


def write_page(out: Path, page: Path, record: RunRecord) -> None:
    """Write the page of a run whose other outputs are complete, see :func:`run_page`.

    Raises:
        OutputError: it cannot be written.
    """
    write_report(page, run_page(out, page, record))


def _drawn(scale: DepthScale) -> dict[str, Any]:
    """Return the scale for the page."""
    places = np.linspace(0, 1, 24)
    return {
        "unit": scale.unit,
        "quantity": scale.quantity,
        "gradient": ", ".join("rgb({},{},{})".format(*scale.colour(place)) for place in places),
        "ticks": _ticks(scale),
        "unknown": "rgb({},{},{})".format(*scale.unknown),
        "ends": scale.ends,
    }


def _ticks(scale: DepthScale) -> list[tuple[str, float, int]]:
    """Return the ticks of a scale that have room: what they say, and their places from 0 to 1.

    The last number is how far the text is moved to the left of its place, in percent of its width:
    50, its middle is there, but at an end it stays within the scale.
    """
    ticks: list[tuple[str, float, int]] = []
    for tick in scale.ticks():
        text, place = f"{tick:g}", scale.place(tick)
        shift = 0 if place < _END else 100 if place > 1 - _END else 50
        aside = shift != 50 or bool(ticks and ticks[-1][2] != 50)
        room = _TICK_ROOM * (len(text) + 1) * (1.5 if aside else 1)
        if not ticks or place - ticks[-1][1] > room:
            ticks.append((text, place, shift))
    return ticks


def _about(record: RunRecord, steering: SteeringTable | None) -> list[str]:
    """Return the facts of the input and the rig, in a few words each."""
    inputs = list((record.inputs or {}).values())
    names = dict.fromkeys(Path(each.path).name for each in inputs)
    about = [" + ".join(names)] if names else []
    if steering and steering.begin_s is not None:
        about.append(f"begins {_date(steering.begin_s)}")
    for each in inputs[:1]:
        if each.width and each.height:
            about.append(f"{each.width}x{each.height} px")
        if each.frame_rate:
            about.append(f"{float(Fraction(each.frame_rate)):.4g} frames per second")
    if rig := record.camera:
        about.append(f"baseline {rig.baseline_m * 1000:.4g} mm, focal {rig.focal_px:.4g} px")
        if inputs and (rig.width, rig.height) != (inputs[0].width, inputs[0].height):
            about[-1] += f" at {rig.width}x{rig.height} px"
    elif record.rig is None:
        about.append("no calibration: results are in px")
    return about


def _date(time_s: float) -> str:
    """Return a time since 1970, or since a camera was switched on, in words."""
    if time_s < _A_YEAR_S:
        return f"at {time_s:.2f} s of its clock"
    try:
        return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):  # a clock that counts from elsewhere
        return f"at {time_s:.2f} s"


class Fact(NamedTuple):
    """A key figure; ``frame`` is the frame that it belongs to, None = the whole run."""

    label: str
    value: str
    note: str
    frame: int | None = None


def _facts(steering: SteeringTable, quantity: str) -> list[Fact]:
    count = len(steering)
    lasts = f"{np.ptp(steering.time_s):.1f} s" if steering.timed else ""
    ok = steering.status.count("ok") / count
    facts = [
        Fact("Frames", f"{count:,}", lasts),
        Fact("Heading known", f"{ok:.0%}", "of the frames"),
    ]
    ahead, nearest = steering.series["depth_m"], steering.series["nearest_m"]
    if not np.isnan(ahead).all():
        spread = f"{np.nanmin(ahead):.3g} to {np.nanmax(ahead):.3g} m"
        facts.append(Fact("Depth ahead, median", f"{np.nanmedian(ahead):.3g} m", spread))
    if not np.isnan(nearest).all():
        when = int(np.nanargmin(nearest))
        frame = int(steering.frames[when])
        facts.append(Fact("Nearest", f"{nearest[when]:.3g} m", f"in frame {frame}", frame))
    for name, label, note in (
        ("charged", "Charged", "of the image: moved lately"),
        ("matched", f"{quantity.capitalize()} known", "of the image"),
    ):
        facts.append(Fact(label, f"{np.nanmean(steering.series[name]):.0%}", note))
    return facts


def _panels(
    run: Results, page: Path, steering: SteeringTable | None, scale: DepthScale
) -> list[dict[str, Any]]:
    """Return the videos with their posters, the frame in which most was matched."""
    when_s, number = None, None
    if steering:
        when_s = float(steering.places[steering.best])
        number = int(steering.frames[steering.best])
    view, plays = run.view()
    shown = []
    # Below depth there may be a strip: the poster is as high as the pictures without one.
    rig, charge = run.record.camera, _parts(run.video("charge"), run.path)
    rows = (
        rig.height
        if rig
        else next((height_of(each, run.within) for each in charge if each.is_file()), None)
    )
    panels: list[tuple[str, str, str, Path | None, bool]] = [
        ("view", f"{run.reference.capitalize()} view", "what the camera saw", view, plays),
        ("charge", "Charge", "white moved just now, darker longer ago", run.video("charge"), True),
        (
            *("depth", scale.quantity.capitalize(), "grey, the view, is unknown"),
            *(run.video("depth-video"), True),
        ),
    ]
    if run.has("own-charge"):
        what = "what moved by itself, whatever the rig did"
        panels.insert(2, ("own", "Own motion", what, run.video("own-charge"), True))
    for key, title, what, video, played in panels:
        parts = _parts(video, run.path)
        source = next((each for each in parts if each.is_file()), None)
        address = address_of(source, page) if source and played and source == video else None
        shown.append(
            {
                "key": key,
                "title": title,
                "what": what,
                "src": address,
                "poster": source
                and poster(source, run.within, when_s, max_width=_POSTER_PX, rows=rows),
                "alt": f"{title}{'' if number is None else f' of frame {number}'}: {what}",
            }
        )
    return shown


def _parts(video: Path | None, folder: Path) -> list[Path]:
    """Return a video, and the first segment that an interrupted run leaves in its folder."""
    if video is None:
        return []
    if video.parent != folder:
        return [video]
    segments = sorted(video.parent.glob(f"{video.stem}.[0-9]*{video.suffix}.part"))
    return [video, *segments[:1]]


def _objects(run: Results, steering: SteeringTable) -> dict[str, Any] | None:
    rows = run.objects()
    if rows is None:
        return None
    places = steering.places
    step = float(np.median(np.diff(places))) if len(steering) > 1 else FRAME_S
    x_of = dict(zip(steering.frames.tolist(), places.tolist(), strict=True))
    try:
        return tracks(rows, x_of, step)._asdict() | {"timed": steering.timed}
    except ValueError as error:
        raise InputError(f"cannot show {run.path / 'objects.csv'}: {error}") from error


def _histogram(run: Results, scale: DepthScale) -> dict[str, Any] | None:
    """Return the histogram of depth for the page; None without images, empty if none is known."""
    try:
        found = histogram(Maps(run.path, within=run.path), scale)
    except InputError:
        return None
    if found is None:
        return {}
    count, (near, far) = len(found.shares), found.scale.ends
    most = max(found.shares) or 1.0  # all may lie beyond its ends
    bars = []
    for index, share in enumerate(found.shares):
        low, middle, high = (near * (far / near) ** ((index + at) / count) for at in (0, 0.5, 1))
        bars.append(
            {
                "x": index / count,
                "height": share / most,
                "colour": "rgb({},{},{})".format(*scale.colour(scale.place(middle))),
                "text": f"{low:.3g} to {high:.3g} {scale.unit}: {share:.1%}",
            }
        )
    return {
        "bars": bars,
        "ticks": _ticks(found.scale),
        "images": found.images,
        "median": found.median,
        "beyond": 1 - sum(found.shares),
        "most": most,
        "width": 1 / count,
        "unit": scale.unit,
    }


def _map(run: Results) -> dict[str, Any] | None:
    """Return the map from above; None without one, empty if nothing is known in it."""
    image = run.map()
    if image is None:
        return None
    if (image == _UNKNOWN).all():
        return {}
    said = run.record.values("output_settings")
    cell_m = float(said.get("map_cell_m", OutputSettings().map_cell_m))
    width_m, height_m = image.shape[1] * cell_m, image.shape[0] * cell_m
    bar_m = 10 ** math.floor(math.log10(width_m / 3))
    bar_m *= next(each for each in (5, 2, 1) if each * bar_m <= width_m / 2)
    return {
        "picture": encoded(image, _MAP_PX, ".png"),
        "bar_m": f"{bar_m:g}",
        "bar": bar_m / width_m,
        "alt": f"Map from above, {width_m:.1f} by {height_m:.1f} m",
        "size": f"{width_m:.1f} by {height_m:.1f} m, cells of {cell_m * 100:g} cm",
    }


def _outputs(run: Results) -> list[dict[str, str]]:
    """Return the outputs in the folder."""
    outputs = run.record.outputs or {}
    return [
        {
            "path": OUTPUTS[name].shown if name in OUTPUTS else said.path if said else "",
            "what": said.what if said else "",
        }
        for name, said in outputs.items()
    ]
