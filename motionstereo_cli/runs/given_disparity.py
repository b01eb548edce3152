"""``--disparity FOLDER``: disparity of another program in place of the matching."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from motionstereo_cli.check.convention import Convention, convention, scales_of
from motionstereo_cli.errors import SettingsError
from motionstereo_cli.rig.calibration import rectify_source
from motionstereo_cli.runs.job import Warned
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.sources import StereoSource, open_stereo

if TYPE_CHECKING:
    from motionstereo_cli.sources.given import GivenDisparity
    from motionstereo_cli.types import Grey, Real

#: Where in a recording its images are compared with the maps.
_PLACES = (0.0, 0.5, 0.9)
_VIEWS = ("left", "right")
#: Other values are advised if the images then differ by less than this share.
_BETTER = 0.7


def take_disparity(plan: RunPlan, source: StereoSource, warned: Warned) -> None:
    """Add the disparity of the plan's folder, if there is one, to the frames of a source.

    View and scale of the maps are found from images, unless they are given.

    Args:
        plan: the run.
        source: its source, which rectifies already.
        warned: hears what was found.

    Raises:
        InputError: there are no maps, or none that can be read.
        SettingsError: the maps do not belong to the images.
    """
    s, folder, camera = source.settings, plan.disparity, plan.settings.reference
    if folder is None:
        return
    view, scale = s.disparity_view, s.disparity_scale
    if not source.rereadable:
        if view == "auto" or not scale:
            raise SettingsError(
                "--disparity with a pipe needs --disparity-view and --disparity-scale: the images "
                "cannot be looked at before"
            )
        source.bring_disparity(folder, view, scale, camera)
        return
    views = _VIEWS if view == "auto" else (view,)
    first = source.bring_disparity(folder, views[0], 0.0, camera)
    best, said, likeliest = _compared(plan, folder, first, views, scale)
    if best is None or said is None:
        view, scale = views[0], scale or likeliest
        warned.warn(
            "disparity",
            f"the images do not tell of which view {folder} is: {view} and a scale of {scale:g} "
            "are taken",
        )
    elif not best.fits:
        raise SettingsError(
            f"--disparity {folder} does not belong to these images: by no scale and of neither "
            "view do they agree; see that LEFT and RIGHT are not exchanged, are rectified, and "
            "that the maps have the numbers of their images"
        )
    else:
        if best.differs < _BETTER * said.differs:
            warned.warn(
                "disparity",
                f"the images agree better with --disparity-scale {best.scale:g} "
                f"--disparity-view {best.view} (they differ by {best.differs:.1f} grey levels) "
                f"than with --disparity-scale {said.scale:g} ({said.differs:.1f})",
            )
        if view == "auto" or not scale:
            view, scale = said.view, said.scale
            warned.say(
                "",
                "note",
                f"{folder} has the {view} view and {scale:g} for 1 px: the images then differ by "
                f"{said.differs:.1f} grey levels",
            )
    source.bring_disparity(folder, view, scale, camera)


def _compared(
    plan: RunPlan, folder: Path, first: GivenDisparity, views: tuple[str, ...], scale: float
) -> tuple[Convention | None, Convention | None, float]:
    """Compare maps with images, until these tell how the maps are to be taken.

    Args:
        plan: the run.
        folder: the maps.
        first: the same, opened.
        views: the views that they may be in.
        scale: what they have for 1 px; 0: unknown.

    Returns:
        The best of all conventions, None where the images do not tell it; the best with the given
        scale; and the likeliest scale.
    """
    looks: list[tuple[str, Real, Grey, Grey]] = []
    known: tuple[float, ...] = (256.0 if first.whole_numbers else 1.0,)
    best = None
    for look in _looks(plan, folder, views):
        if not looks:
            known = scales_of(look[1], first.width, whole_numbers=first.whole_numbers)
        looks.append(look)
        if len(looks) % len(views) == 0:
            best = convention(looks, known)
            if best is not None and best.sure:
                break
    return best, convention(looks, (scale,)) if scale else best, known[0]


def _looks(
    plan: RunPlan, folder: Path, views: tuple[str, ...]
) -> Iterator[tuple[str, Real, Grey, Grey]]:
    """Yield a view, its map as the file has it, and the right and the left image, of some frames.

    Frames that cannot be reached without decoding all before are left out.
    """
    unsettled = dataclasses.replace(plan.input_settings, strict=False)
    for place in _PLACES:
        for view in views:
            with open_stereo(plan.left, plan.right, unsettled) as source:
                rectify_source(source, plan.rig, plan.rig_settings)
                source.bring_disparity(folder, view, 0.0, view)
                begin = int(place * (source.expected_frames or 0))
                if begin and not source.begin_at(begin):
                    return
                if (frame := next(iter(source), None)) is not None:
                    assert frame.disparity_px is not None
                    yield view, frame.disparity_px, frame.right, frame.left
