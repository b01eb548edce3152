"""What was measured of a recording, and what is wrong with it: the table :data:`RULES`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from motionstereo_cli.check.mounting import Mounting

#: Median distance between the rows of the views, and that in a tenth of the image, in px.
MAX_MISALIGNED_PX = 1.0
MAX_MISALIGNED_IMAGE_PX = 1.5
#: Shares of the matches whose disparity is not looked for: swapped views, ruined, worth a warning.
SWAPPED_SHARE = 0.9
RUINED_SHARE = 0.5
NOTED_SHARE = 0.15
#: Difference in grey levels between the views that is worth a warning.
MAX_GREY_DIFFERENCE = 8.0
#: Views that differ less, as a share of what 1 px of disparity makes, are one and the same.
SAME_VIEW_SHARE = 0.2
#: Disparities that are all smaller, in px, are those of one view.
SAME_VIEW_PX = 0.75
#: Grey level that some pixels of an image in good light exceed.
DARK_GREY = 32
#: Share of the image that changes from frame to frame below which nothing moves.
STILL_SHARE = 5e-4
#: Shares of images that repeat the one before: worth a warning, from two images on, and ruined.
REPEATED_SHARE = 0.01
FROZEN_SHARE = 0.2


#: An offset of disparity of less px does not matter: depth at 10 px is then off by 1.5 %.
MAX_OFFSET_PX = 0.15


class Drift(NamedTuple):
    """How the step between the views changes: frames ahead at a frame, and later at another."""

    first_frames: float
    first_at: int
    last_frames: float
    last_at: int


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was measured, None where too little was found to measure it.

    Attributes:
        max_disparity: range that the processing is to look in, in px.
        frames: stereo frames seen.
        calibrated: a calibration was given, and the views are as it says.
        matches: features matched between the views.
        misaligned_px, misaligned_p90_px: median and 90th percentile of their vertical distance.
        misaligned_image_px: distance that the rows exceed in a tenth of the image.
        shifted_px: by how much the right view is lower than the left one.
        turned_deg: by how much the right view is turned against the left one, clockwise.
        disparity_low_px, disparity_high_px: 2nd and 98th percentile of their disparities.
        advised_max_disparity: a range that holds the latter, in px.
        given_offset_px: what ``--disparity-offset`` adds.
        behind, put_behind: shares of the matches, 0..1, that lie beyond infinity by themselves, and
            with that offset.
        negative, beyond: likewise with a disparity below 0, and with one above ``max_disparity``.
        grey_difference: median of left minus right grey level.
        brightest: grey level that a thousandth of the pixels exceed.
        alike: mean difference between the views, as a share of that to a view 1 px aside.
        mounted: how the right view stands against the left one, and what mends it; None if alike.
        moving: share of the image, 0..1, that changes from a frame to the next.
        repeated_left, repeated_right: images that repeat the one before though objects move.
        first_repeated_left, first_repeated_right: the frames of the first of these.
        ahead_frames: by how many frames the right view is ahead of the left one.
        step_frames: the same in whole frames, 0 where it is not certain.
        step_certain: whether no other number of whole frames can be meant.
        drift: how that changes; None where it does not.
        disparity_offset_px: constant by which disparities are too small, by how things move as the
            rig moves; None without a calibration.
    """

    max_disparity: int
    frames: int = 0
    calibrated: bool = False
    matches: int = 0
    misaligned_px: float | None = None
    misaligned_p90_px: float | None = None
    misaligned_image_px: float | None = None
    shifted_px: float | None = None
    turned_deg: float | None = None
    disparity_low_px: float | None = None
    disparity_high_px: float | None = None
    advised_max_disparity: int | None = None
    given_offset_px: float = 0.0
    behind: float | None = None
    put_behind: float | None = None
    negative: float | None = None
    beyond: float | None = None
    grey_difference: float | None = None
    brightest: int | None = None
    alike: float | None = None
    mounted: Mounting | None = None
    moving: float | None = None
    repeated_left: int = 0
    repeated_right: int = 0
    first_repeated_left: int | None = None
    first_repeated_right: int | None = None
    ahead_frames: float | None = None
    step_frames: int = 0
    step_certain: bool = False
    drift: Drift | None = None
    disparity_offset_px: float | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong, what ruins the result first."""
        found = [
            Finding(rule.name, rule.ruins(self), rule.text(self), rule.numbers(self))
            for rule in RULES
            if self.frames and rule.applies(self)
        ]
        return tuple(sorted(found, key=lambda finding: not finding.ruins))

    @property
    def ruined(self) -> bool:
        """Whether anything found would make the result useless."""
        return any(finding.ruins for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON-able values."""
        found = [dataclasses.asdict(finding) for finding in self.findings]
        drift = None if self.drift is None else self.drift._asdict()
        return {
            **dataclasses.asdict(self),
            "drift": drift,
            "mounted": self.mounted.text if self.mounted else "",
            "findings": found,
            "ruined": self.ruined,
        }


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong.

    Attributes:
        name: which, for programs: the name of one of the :data:`RULES`.
        ruins: whether the result would be of no use.
        text: what, how much, and what to do, in one line.
        numbers: what it was judged by, by the fields of the report.
    """

    name: str
    ruins: bool
    text: str
    numbers: Mapping[str, float] = dataclasses.field(default_factory=dict)


class Rule(NamedTuple):
    """When something is wrong.

    Attributes:
        name: what it is called.
        measured: what it is judged by, for the docs.
        limit: when the result is ruined, for the docs.
        applies: whether something is wrong.
        ruins: whether that ruins the result.
        text: what, how much, and what to do, in one line.
        fields: the fields of the report that it is judged by.
    """

    name: str
    measured: str
    limit: str
    applies: Callable[[CheckReport], bool]
    ruins: Callable[[CheckReport], bool]
    text: Callable[[CheckReport], str]
    fields: Sequence[str] = ()

    def numbers(self, report: CheckReport) -> dict[str, float]:
        """Return what a report is judged by, as far as it was measured."""
        found = {name: getattr(report, name) for name in self.fields}
        return {name: round(value, 4) for name, value in found.items() if value is not None}


def offset_warning(offset_px: float) -> str:
    """Return what to say of a constant error of disparity that matters."""
    return (
        f"disparities are {abs(offset_px):.2f} px too {'small' if offset_px > 0 else 'large'} by "
        "how things move as the rig moves, as after a small turn between the cameras: depth is "
        "wrong, most of all far off; calibrate again, or give --disparity-offset auto"
    )


def _always(_: CheckReport) -> bool:
    return True


def _never(_: CheckReport) -> bool:
    return False


def _repeated(side: str) -> Rule:
    def count(report: CheckReport) -> int:
        return int(getattr(report, f"repeated_{side}"))

    return Rule(
        "repeated",
        "images that repeat the last one while objects move",
        f"over {FROZEN_SHARE:.0%}",
        lambda r: count(r) >= max(2, REPEATED_SHARE * (r.frames - 1)),
        lambda r: count(r) > FROZEN_SHARE * (r.frames - 1),
        lambda r: (
            f"the {side} recording repeats itself in {count(r)} of {r.frames} frames, "
            f"first in frame {getattr(r, f'first_repeated_{side}')}, while objects move: record it "
            "again, or leave these out with --start, --end or --every"
        ),
        (f"repeated_{side}", f"first_repeated_{side}", "frames"),
    )


def _drifting(report: CheckReport) -> str:
    assert report.drift is not None
    first_frames, first_at, last_frames, last_at = report.drift
    return (
        "the recordings drift apart: the right one is ahead of the left one by "
        f"{first_frames:+.1f} frames at frame {first_at} and by {last_frames:+.1f} at frame "
        f"{last_at}: frames were dropped, so pair them by time, with --sync-tolerance"
    )


#: What to do where a calibration was given and the views are not as it says.
_MISFIT = (
    "by so much the calibration given does not fit: see that it is of these cameras at this size, "
    "and that the images are rectified if it is a rig.yaml; otherwise calibrate again"
)


def _perhaps_step(report: CheckReport) -> str:
    """Return what else may be wrong with the rows, where the step is not known."""
    if report.step_certain or not report.moving:
        return ""
    return (
        "if both cameras were not started together, give --sync-offset auto, which measures it; "
        "otherwise, "
    )


def _misaligned(report: CheckReport) -> str:
    """Return how far the rows are apart, by the figure that exceeds its limit."""
    median, image = report.misaligned_px or 0.0, report.misaligned_image_px or 0.0
    where, also = f"{median:.1f} px", f"90th percentile {report.misaligned_p90_px:.1f}"
    if median <= MAX_MISALIGNED_PX:
        where, also = f"in a tenth of the image {image:.1f} px or more", f"median {median:.1f}"
    return (
        f"rows do not agree: objects are {where} higher or lower on the right ({also}; shifted by "
        f"{report.shifted_px:+.1f} px, turned by {report.turned_deg:+.2f} degrees): "
    )


def _same_view(report: CheckReport) -> bool:
    if report.alike is not None and report.alike < SAME_VIEW_SHARE:
        return True
    low, high, off = report.disparity_low_px, report.disparity_high_px, report.misaligned_px
    if low is None or high is None or off is None:
        return False
    return max(-low, high, off) < SAME_VIEW_PX


def _dark(report: CheckReport) -> bool:
    return report.brightest is not None and report.brightest < DARK_GREY


RULES = (
    Rule(
        "identical",
        "difference between the views, as a share of what 1 px of disparity makes; or disparities",
        f"under {SAME_VIEW_SHARE:.0%}; or all under {SAME_VIEW_PX:g} px",
        _same_view,
        _always,
        lambda _: (
            "left and right show the same view, so every disparity is 0: give the recordings of "
            "two cameras (two tracks of one file: --layout tracks), and of what is not too far"
        ),
        ("alike", "disparity_low_px", "disparity_high_px"),
    ),
    Rule(
        "turned",
        "features that match once the right view is turned or mirrored",
        "always",
        lambda r: bool(r.mounted),
        _always,
        lambda r: r.mounted.text if r.mounted else "",
    ),
    Rule(
        "dark",
        "the grey level that a thousandth of the pixels exceed",
        f"under {DARK_GREY}, if nothing is seen to move; else a warning",
        _dark,
        lambda r: (r.moving or 0) < STILL_SHARE,
        lambda r: (
            f"the images are dark, nearly all below grey level {(r.brightest or 0) + 1} of 255: "
            "where a camera puts few bits into many, give --white (4095 for 12 bits); else give "
            "more light or exposure"
        ),
        ("brightest", "moving"),
    ),
    Rule(
        "drifting",
        "how the step between the recordings changes",
        "always",
        lambda r: r.drift is not None,
        _always,
        _drifting,
    ),
    Rule(
        "out-of-step",
        "frames by which the right recording is ahead of the left one, and the `--sync-offset` "
        "that mends it",
        "always",
        lambda r: r.step_frames != 0,
        _always,
        lambda r: (
            f"out of step: the right recording is {r.ahead_frames:+.1f} frames ahead of the "
            f"left one: add {-r.step_frames} to --sync-offset"
        ),
        ("ahead_frames", "step_frames"),
    ),
    Rule(
        "still",
        "share of the image that changes from frame to frame",
        f"under {STILL_SHARE:.2%}",
        lambda r: r.frames == 1,
        _always,
        lambda _: (
            "one frame shows no motion, so there will be no depth: give a recording, or "
            "--depth-of all for the depth of what stands still"
        ),
    ),
    Rule(
        "still",
        "share of the image that changes from frame to frame",
        f"under {STILL_SHARE:.2%}",
        lambda r: r.moving is not None and r.moving < STILL_SHARE and not _dark(r),
        _always,
        lambda r: (
            f"nothing moves: {r.moving:.2%} of the image changes from frame to frame in "
            f"{r.frames} frames, and what stands still gets no depth: move the camera, give a part "
            "with motion, or --depth-of all"
        ),
        ("moving", "frames"),
    ),
    _repeated("left"),
    _repeated("right"),
    Rule(
        "few-matches",
        "number of matches",
        "never; a warning",
        lambda r: r.misaligned_px is None and not r.mounted and not r.step_frames,
        _never,
        lambda r: (
            f"only {r.matches} features agree between left and right, too few to check "
            "alignment: see that both show the same scene, in focus and lit"
        ),
        ("matches",),
    ),
    Rule(
        "misaligned",
        "median and 90th percentile of the distance between rows, px; by how many degrees the "
        "right view is turned (clockwise is positive)",
        f"median over {MAX_MISALIGNED_PX:g} px, or over {MAX_MISALIGNED_IMAGE_PX:g} px in a tenth "
        "of the image",
        lambda r: (
            not r.mounted
            and (
                (r.misaligned_px or 0) > MAX_MISALIGNED_PX
                or (r.misaligned_image_px or 0) > MAX_MISALIGNED_IMAGE_PX
            )
        ),
        _always,
        lambda r: (
            _misaligned(r)
            + _perhaps_step(r)
            + (_MISFIT if r.calibrated else "rectify, by giving the calibration to --rig")
        ),
        (
            *("misaligned_px", "misaligned_p90_px", "misaligned_image_px"),
            *("shifted_px", "turned_deg"),
        ),
    ),
    Rule(
        "swapped",
        "share of matches with x farther right in the right image",
        f"over {SWAPPED_SHARE:.0%}",
        lambda r: (r.behind or 0) > SWAPPED_SHARE and not r.mounted,
        _always,
        lambda r: (
            f"left and right are swapped: {r.behind:.0%} of the matches lie farther right in "
            "the right image: exchange "
            + (
                "the two recordings or, if they are right, the order of the calibration's cameras"
                if r.calibrated
                else "the two recordings (or, if the cameras converge, rectify)"
            )
            + "; if both are upside down, give --rotate-left 180 --rotate-right 180 instead"
        ),
        ("behind",),
    ),
    Rule(
        "negative-disparity",
        "share of matches below 0",
        f"over {RUINED_SHARE:.0%}; a warning over {NOTED_SHARE:.0%}",
        lambda r: (r.negative or 0) > NOTED_SHARE and (r.behind or 0) <= SWAPPED_SHARE,
        lambda r: (r.negative or 0) > RUINED_SHARE,
        lambda r: (
            f"{r.negative:.0%} of the matches have disparities below 0 (down to "
            f"{r.disparity_low_px:.0f} px), which are not looked for: "
            + _perhaps_step(r)
            + (
                _MISFIT
                if r.calibrated
                else "the cameras converge, so rectify them by giving the calibration to --rig"
            )
        ),
        ("negative", "disparity_low_px"),
    ),
    Rule(
        "offset-too-low",
        "share of matches that `--disparity-offset` puts beyond infinity",
        f"over {RUINED_SHARE:.0%}; a warning over {NOTED_SHARE:.0%}",
        lambda r: (r.put_behind or 0) - (r.behind or 0) > NOTED_SHARE,
        lambda r: (r.put_behind or 0) - (r.behind or 0) > RUINED_SHARE,
        lambda r: (
            f"--disparity-offset {r.given_offset_px:g} puts {r.put_behind:.0%} of the matches "
            "beyond infinity, and they have no depth: leave it out, or give --disparity-offset auto"
        ),
        ("put_behind", "behind", "given_offset_px"),
    ),
    Rule(
        "beyond-range",
        "share of matches above `--max-disparity`; the range found, the `--max-disparity` advised",
        f"over {RUINED_SHARE:.0%}; a warning over {NOTED_SHARE:.0%}",
        lambda r: (r.beyond or 0) > NOTED_SHARE,
        lambda r: (r.beyond or 0) > RUINED_SHARE,
        lambda r: (
            f"{r.beyond:.0%} of the matches have disparities above {r.max_disparity} px (up "
            f"to {r.disparity_high_px:.0f}): give --max-disparity {r.advised_max_disparity}"
        ),
        ("beyond", "disparity_high_px", "advised_max_disparity"),
    ),
    Rule(
        "disparity-offset",
        "constant by which all disparities are too small, px, where a calibrated rig moves",
        f"never; a warning over {MAX_OFFSET_PX:g}",
        lambda r: abs(r.disparity_offset_px or 0) > MAX_OFFSET_PX,
        _never,
        lambda r: offset_warning(r.disparity_offset_px or 0),
        ("disparity_offset_px",),
    ),
    Rule(
        "grey-difference",
        "left minus right, grey levels",
        f"never; a warning over {MAX_GREY_DIFFERENCE:g}",
        lambda r: abs(r.grey_difference or 0) > MAX_GREY_DIFFERENCE,
        _never,
        lambda r: (
            f"the {'left' if (r.grey_difference or 0) > 0 else 'right'} recording is "
            f"{abs(r.grey_difference or 0):.0f} grey levels brighter: give both cameras the same "
            "exposure and gain"
        ),
        ("grey_difference",),
    ),
)
