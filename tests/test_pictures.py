"""Pictures for people: scales are true, and nothing is coloured without one."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from taken import step_of, taken

from motionstereo_cli.files.lettering import (
    DARK,
    GAP_PX,
    LIGHT,
    Label,
    colour_key,
    fitted,
    length_bar,
    lettered,
    text_width,
    titled,
)
from motionstereo_cli.files.records import pack, unpack
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.robot.mapper import Floor
from motionstereo_cli.sinks.drawing import coloured
from motionstereo_cli.sinks.legend import strip
from motionstereo_cli.sinks.map import from_above, map_sheet
from motionstereo_cli.sinks.outputs import OUTPUTS
from motionstereo_cli.sinks.preview import (
    heading_text,
    mover_text,
    preview_picture,
    with_heading,
    with_movers,
)
from motionstereo_cli.sinks.scale import DepthScale, measured_ends
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.types import FrameResult, MovingObject, Pose, Rig, Steering, StereoFrame

HEIGHT, WIDTH = 60, 96
#: A preview shows such small views so much larger.
TIMES = 3
RIG = Rig(width=WIDTH, height=HEIGHT, focal_px=100, baseline_m=0.1, cx=47.5, cy=29.5)
LEFT = Steering("ok", 0.5, 0.25, 3.25, 1.0)
BLIND = Steering("blind", None, None, None, None)


def context(rig=RIG, **output):
    return RunContext(Fraction(1, 25), Settings(), rig, OutputSettings(**output))


def result(steering=LEFT, disparity_px=4.0, *, time_s=1.5):
    grey = np.full((HEIGHT, WIDTH), 90, np.uint8)
    real = np.full((HEIGHT, WIDTH), disparity_px, np.float32)
    return FrameResult(
        frame=StereoFrame(3, 38, time_s, grey, grey),
        bands=grey,
        motion=grey > 0,
        charge=grey,
        age_frames=grey,
        confidence=real,
        disparity_px=real,
        depth_m=None,
        steering=steering,
        charged=0.5,
        matched=0.5,
    )


def frames(path):
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


@pytest.mark.parametrize("rig", [RIG, dataclasses.replace(RIG, doffs=2.0), None])
def test_a_depth_has_its_colour_at_its_place_on_the_scale(rig):
    scale = DepthScale.of(Settings(), OutputSettings(), rig)
    assert scale.unit == ("m" if rig else "px")
    ticks = scale.ticks()
    assert len(ticks) > 3
    for tick in ticks:
        disparity_px = np.float32([[scale.px_m / tick if scale.px_m else tick]])
        [[painted]] = coloured(disparity_px, DepthScale(scale.near_px, scale.far_px))
        colour = np.array(scale.colour(scale.place(tick)), int)
        assert np.abs(painted - colour).max() <= 6
    places = [scale.place(tick) for tick in ticks]
    assert places == sorted(places)
    assert all(0 <= place <= 1 for place in places)


def test_near_and_far_are_the_ends_of_the_scale():
    scale = DepthScale.of(Settings(), OutputSettings(near_m=0.5, far_m=8), RIG)
    assert scale.ends == pytest.approx((0.5, 8))
    assert scale.ticks() == [0.5, 1, 2, 5]


@pytest.mark.parametrize("width", [2, 17, 64, 320, 1920])
def test_a_strip_shows_every_colour_from_near_to_far(width):
    scale = DepthScale.of(Settings(), OutputSettings(), RIG)
    image = strip(width, scale, "12.34 s")
    assert image.shape[1:] == (width, 3)
    assert image.shape[0] % 2 == 0
    if width >= 64:
        row = image[round(0.3 * len(image))].astype(int)
        ramp = np.flatnonzero(np.ptp(row, axis=1) > 60)
        assert len(ramp) > 0.4 * width
        for column, place in ((ramp[0], 0), (ramp[-1], 1)):
            assert np.abs(row[column] - scale.colour(place)).max() < 30


def test_the_strip_of_the_depth_video_can_be_switched_off(tmp_path):
    heights = []
    for legend in (True, False):
        sink = OUTPUTS["depth-video"].open(tmp_path, context(legend=legend))
        sink.write(taken("depth-video", result()))
        sink.close()
        [picture] = frames(tmp_path / "depth.mp4")
        heights.append(len(picture))
        wanted = coloured(np.float32([[4]]), DepthScale(64))[0, 0].astype(int)
        assert np.abs(picture[HEIGHT // 2, WIDTH // 2] - wanted).max() < 16
    assert heights == [HEIGHT + 28, HEIGHT]


@pytest.mark.parametrize("output", ["depth-video", "preview"])
def test_the_view_shines_through_in_grey_where_nothing_is_known(tmp_path, output):
    shown, values = result(BLIND, 4.0), np.full((HEIGHT, WIDTH), np.nan, np.float32)
    values[:, :8] = 4
    view = np.repeat(np.linspace(0, 255, WIDTH).astype(np.uint8)[np.newaxis], HEIGHT, axis=0)
    frame = dataclasses.replace(shown.frame, left=view, right=view)
    sink = OUTPUTS[output].open(tmp_path, context())
    sink.write(taken(output, dataclasses.replace(shown, frame=frame, disparity_px=values)))
    sink.close()
    [picture] = frames(tmp_path / OUTPUTS[output].path)
    if output == "preview":
        picture = picture[26:, 2 * (TIMES * WIDTH + GAP_PX) :][::TIMES, ::TIMES]
    row = picture[HEIGHT // 2, :WIDTH].astype(int)
    assert np.ptp(row[2:6], axis=1).min() > 80
    grey = row[14:]
    assert np.ptp(grey, axis=1).max() < 16
    assert 40 <= grey.min() < grey.max() <= 145
    assert (np.diff(grey[::8, 0]) >= 0).all()


@given(
    st.lists(st.floats(0.01, 2000), min_size=1, max_size=50),
    st.one_of(st.none(), st.floats(0.1, 5000)),
)
def test_measured_ends_leave_what_is_known_in_the_middle(nearness_px, px_m):
    values = np.float32(nearness_px).repeat(1000)  # no quantile lies between two of them
    near, far = measured_ends(values, px_m)
    output = {"near_px": near, "far_px": far}
    rig = None
    if px_m:
        output = {"near_m": near, "far_m": far}
        rig = dataclasses.replace(RIG, focal_px=px_m / RIG.baseline_m)
    scale = DepthScale.of(Settings(), OutputSettings(**output), rig)
    assert scale.ends == pytest.approx((near, far))
    assert max(near / far, far / near) >= 1.999
    assert len(scale.ticks()) >= 2
    shown = np.maximum(nearness_px, 0.5)
    shown = px_m / shown if px_m else shown
    places = np.array([scale.place(float(value)) for value in shown])
    assert (places < 0.048).mean() <= 0.015
    assert (places > 0.952).mean() <= 0.03


def test_nothing_known_has_no_ends():
    assert measured_ends(np.empty(0, np.float32), None) is None


def test_the_preview_has_three_panels_and_the_heading(tmp_path):
    sink = OUTPUTS["preview"].open(tmp_path, context())
    for steering in (LEFT, BLIND):
        sink.write(taken("preview", result(steering)))
    sink.close()
    with_arrow, without = (picture.astype(int) for picture in frames(tmp_path / "preview.mp4"))
    assert with_arrow.shape[1] >= 3 * TIMES * WIDTH
    body = slice(26, 26 + TIMES * HEIGHT)
    green = with_arrow[body, :, 1] - with_arrow[body, :, 0] > 60
    assert green[:, : TIMES * WIDTH // 2 + 4].sum() > 20
    view = slice(TIMES * WIDTH)
    assert not (without[body, view, 1] - without[body, view, 0] > 60).any()


def test_what_moves_by_itself_has_a_box_with_its_figures():
    view = np.zeros((120, 320, 3), np.uint8)
    mover = MovingObject(7, 40, 60, 50, 30, 2.0, 1.0, 1.5, 0.9, velocity_mps=(0.6, 0.8))
    drawn = with_movers(view, [mover], 0.5)
    assert not view.any()
    rows, columns = np.nonzero(drawn[:, :, 0] == 255)
    box = drawn[30:45, 20:45]
    assert (box[-1, :, 0] == 255).all()
    assert (box[:, [0, -1], 0] == 255).all()
    assert not box[4:-4, 4:-4].any()
    assert columns.min() >= 18
    assert rows.min() < 20  # its figures are above it
    assert mover_text(mover) == "7  1.0 m/s  1.5 s"
    for change in ({"by_itself": False}, {"shadow": True}):
        assert with_movers(view, [dataclasses.replace(mover, **change)], 0.5) is view
    for x, y in ((0, 0), (600, 0), (600, 230), (0, 230)):  # labels stay within the view
        assert with_movers(view, [dataclasses.replace(mover, x=x, y=y)], 0.5).any()


@pytest.mark.parametrize(
    ("size", "panel"),
    [
        ((100, 1300), (49, 640)),
        ((1920, 1080), (640, 360)),  # a portrait
        ((480, 640), (480, 640)),
        ((48, 64), (192, 256)),
        ((500, 20), (500, 20)),  # it cannot be made larger
    ],
)
def test_panels_are_neither_too_large_nor_too_small(size, panel):
    grey = np.full(size, 90, np.uint8)
    real = np.full(size, 4, np.float32)
    shown = dataclasses.replace(
        result(), frame=StereoFrame(0, 0, None, grey, grey), charge=grey, disparity_px=real
    )
    picture = preview_picture(step_of(shown), context())
    assert picture.shape[1] == 3 * panel[1] + 2 * GAP_PX
    assert fitted(grey).shape == panel


def test_a_run_that_makes_a_map_shows_it_beside(tmp_path):
    stream = dataclasses.replace(context(), with_map=True)
    seen = result(LEFT, 4.0), Pose(1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    points = np.array([[0.2 * n - 0.5, 0.0, 2.5] for n in range(6)] * 9), np.full(54, 90, np.uint8)
    step = dataclasses.replace(step_of(seen[0]), pose=seen[1], points=points)
    sink = OUTPUTS["preview"].open(tmp_path, stream)
    sink.write(step)
    mark = unpack(pack(sink.checkpoint()), Any)
    sink.abandon(keep=True)
    sink = OUTPUTS["preview"].open(tmp_path, stream, mark)
    sink.write(dataclasses.replace(step, pose=Pose(2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
    sink.close()
    shown = frames(tmp_path / "preview.mp4")
    height = TIMES * HEIGHT
    panels = [picture[26 : 26 + height, -height:].astype(int) for picture in shown]
    blue = [int((panel[..., 2] - panel[..., 0] > 100).sum()) for panel in panels]
    assert 0 < blue[0] < blue[1]  # the dot, then the path with it
    assert all((panel.max(axis=2) < 40).any() for panel in panels)  # what is occupied


@pytest.mark.parametrize("cells", [(3, 2), (90, 400), (3000, 1200)])
def test_a_map_sheet_can_be_read_at_any_size(cells):
    occupied = np.zeros(cells, np.bool_)
    occupied[-1, 0] = True
    floor = Floor(occupied, np.zeros(cells, np.bool_), -1.0, 2.0, 0.1)
    path_m = np.array([[-1.5, 2.05], [-1 + 0.1 * cells[0], 2.05]])  # it begins outside
    sheet = map_sheet(floor, path_m)
    assert 400 <= sheet.shape[1] <= 1000
    assert len(sheet) <= 1100
    assert (sheet == (20, 90, 200)).all(axis=2).sum() > 100
    # Ring and dot are whole: neither touches the edge.
    blue = (from_above(floor, path_m, 960)[0] == (20, 90, 200)).all(axis=2)
    assert not blue[[0, -1]].any()
    assert not blue[:, [0, -1]].any()
    picture, px_per_m = from_above(floor, path_m[:0], 960)
    dark = np.argwhere((picture == 0).all(axis=2))
    right_m = (dark[:, 1].max() + 1) / px_per_m
    assert right_m == pytest.approx(0.1 * cells[0], abs=2 / px_per_m)
    assert dark[:, 0].max() == len(picture) - 1


@pytest.mark.parametrize("steer", [-1.0, -0.5, 0.0, 0.5, 1.0])
def test_the_arrow_points_where_the_heading_is(steer):
    view = np.zeros((120, 200, 3), np.uint8)
    drawn = with_heading(view, Steering("ok", steer, None, None, None))
    assert not view.any()
    rows, columns = np.nonzero(drawn[:, :, 1] > 150)
    tip = columns[rows <= rows.min() + 2].mean()
    assert tip == pytest.approx(100 * (1 - steer), abs=15)


def test_headings_in_words():
    assert heading_text(LEFT) == "ok: 14° left, 3.2 m ahead"
    assert heading_text(Steering("held", -0.25, None, None, None)) == "held: 25% right"
    assert heading_text(BLIND) == "blind: no heading"


def test_letters_stand_where_they_should():
    blank = np.zeros((40, 200, 3), np.uint8)
    drawn = lettered(blank, [Label(100, 20, "mm", "mm")], size_px=16)
    assert not blank.any()
    columns = np.flatnonzero(drawn.any(axis=(0, 2)))
    assert columns.mean() == pytest.approx(100, abs=3)
    assert np.ptp(columns) == pytest.approx(text_width("mm", 16), abs=4)


@pytest.mark.parametrize("style", [DARK, LIGHT])
def test_titles_stand_above_their_panels(style):
    panels = [np.full((20, width, 3), grey, np.uint8) for width, grey in ((60, 9), (40, 99))]
    picture = titled(panels, ["one", "a title that is too wide"], style)
    head = 2 * style.size_px
    assert picture.shape == (head + 20, 60 + GAP_PX + 40, 3)
    assert (picture[head:, :60] == 9).all()
    assert (picture[head:, 60 + GAP_PX :] == 99).all()
    assert (picture[:head, 60 : 60 + GAP_PX] == style.ground).all()
    assert (picture[:head, :60] != style.ground).any()


def test_a_key_shows_every_colour_even_where_it_takes_rows():
    colours = [(200, 0, 0), (0, 200, 0), (0, 0, 200)]
    for width in (50, 90, 400):
        key = colour_key(width, [(colour, "some words") for colour in colours], LIGHT)
        assert key.shape[0] % 2 == 0
        for colour in colours:
            assert (key == colour).all(axis=2).sum() > 50
    assert len(colour_key(400, [((9, 9, 9), "a")] * 2, LIGHT)) < len(key) * 2


@pytest.mark.parametrize(("px_per_m", "length_m"), [(32, 5), (1000, 0.2), (0.5, 200)])
def test_a_bar_is_as_long_as_it_says(px_per_m, length_m):
    row = length_bar(600, px_per_m, LIGHT)
    line = np.flatnonzero((row[LIGHT.size_px] == LIGHT.ink).all(axis=1))
    first = line[: np.argmax(np.diff(line) > 1) + 1] if (np.diff(line) > 1).any() else line
    assert len(first) == pytest.approx(length_m * px_per_m, abs=1)
