"""Every parameter of the processing once: default, range, unit, help.

The command line, the configuration file, run.json and the documentation's tables derive from the
dataclasses declared with :func:`param`, here and in ``simulate``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.params import checked, options_of, param, params

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

#: Limit of --max-disparity, in px.
MAX_DISPARITY = 2048

#: The largest age in frames that can be told apart.
FOREVER = 254

#: Value of ``--max-disparity auto`` until the range is measured.
AUTO = 0


#: The matcher whose disparity another program found, and how the name of a model's begins.
GIVEN, ONNX = "given", "onnx:"


class Matcher(NamedTuple):
    """A matcher's description; its function is in ``matching.py`` under the same name.

    Attributes:
        what: what it does, in a few words.
        knows_confidence: whether it gives a confidence; otherwise that is NaN.
        is_averaged: whether its disparity is averaged in time.
        knows_rest: whether it tells the disparity of what stands still, too.
        compares_memories: whether it takes the memories of both views; otherwise it takes that of
            the reference view, and the image of the other.
    """

    what: str
    knows_confidence: bool = True
    is_averaged: bool = False
    knows_rest: bool = False
    compares_memories: bool = True


#: Of those that are no part of the method.
_OF_IMAGES = {"knows_confidence": False, "knows_rest": True, "compares_memories": False}

MATCHERS = {
    "trails": Matcher("pair runs of equal charge by their ends"),
    "dense": Matcher(
        "semi-global matching of what both views show now, trails where grey does not tell",
        is_averaged=True,
        knows_rest=True,
    ),
    "regions": Matcher(
        "largest connected region of equal charge at each displacement", knows_confidence=False
    ),
    "sgbm": Matcher("OpenCV's StereoSGBM, for comparison", **_OF_IMAGES),
    "bm": Matcher("OpenCV's StereoBM, for comparison", **_OF_IMAGES),
    "consensus": Matcher(
        "what OpenCV's StereoSGBM finds along eight paths with two windows alike, to measure "
        "against",
        **_OF_IMAGES,
    ),
    GIVEN: Matcher("what --disparity has", **_OF_IMAGES),
}

#: Those of the package itself, which cannot be replaced.
OWN_MATCHERS = frozenset(MATCHERS)

#: What some parameters have no effect without.
_TRAILS, _STEERING = "--matcher trails or dense", "--save steering, preview or bag"

#: Meanings of the codes of ``--save occlusion``.
OCCLUSION = {
    0: "known",
    1: "not moved",
    2: "hidden from the other camera",
    3: "outside the other camera's view",
    4: "ambiguous",
    5: "nearer than --max-disparity reaches, perhaps",
}

#: Installed packages offer matchers by entry points of this group.
ENTRY_POINTS = "motionstereo.matchers"


@cache
def installed_matchers() -> dict[str, EntryPoint]:
    """Return the matchers that installed packages offer, by name, without loading them."""
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


@dataclass(frozen=True, slots=True)
class Settings:
    """All parameters of the processing of a stereo stream.

    Raises:
        SettingsError: a value is out of range, or two values contradict each other.
    """

    # Equation (4): grey-level bands.
    blur_px: float = param(
        1.0, "Gaussian blur before the bands (0 = none).", unit="px", low=0, high=20
    )
    contrast_px: float = param(
        0.0,
        "Window of the local contrast that bands are taken from; it makes them independent of "
        "brightness. 0: bands of the grey itself, as in the paper.",
        unit="px",
        low=0,
        high=200,
    )
    contrast_floor: float = param(
        12.0,
        "Standard deviation of grey below which contrast is weak; 8 times the noise if that is "
        "more.",
        unit="grey levels",
        low=0.1,
        high=255,
        only_with="--contrast-px",
    )
    bands: int = param(8, "Number n of grey-level bands.", low=2, high=256)
    grey_min: int = param(0, "Grey level where the first band begins.", low=0, high=254)
    grey_max: int = param(255, "Grey level where the last band ends.", low=1, high=255)
    # Equation (3): motion.
    min_jump: int = param(
        6,
        "Minimum grey-level change between frames to count as motion.",
        unit="grey levels",
        low=0,
        high=255,
        old="least_jump",
    )
    # Equations (1) and (2): charge.
    charge_mode: str = param(
        "permanency",
        "What motion does to the charge. permanency: it charges fully (eq. 2); general: it adds "
        "--charge-gain (eq. 1).",
        choices=("permanency", "general"),
    )
    charge_max: int = param(255, "Charge at saturation, Chmax.", low=1, high=255)
    charge_min: int = param(
        0, "Charge at rest, Chmin. Pixels at rest never match.", low=0, high=254
    )
    charge_gain: int = param(
        255, "Charge C added by motion.", low=1, high=255, only_with="--charge-mode general"
    )
    charge_leak: int = param(
        16, "Charge D lost in each frame without motion.", unit="charge per frame", low=1, high=255
    )
    # Disparity.
    matcher: str = param(
        "dense",
        "How the two memories are matched. "
        + "; ".join(f"{name}: {matcher.what}" for name, matcher in MATCHERS.items())
        + f"; {ONNX}MODEL: a stereo network in a file.",
        choices=lambda: MATCHERS,
        begun=(ONNX,),
        more=installed_matchers,
    )
    check_both: bool = param(
        False,
        "Run a model on the mirrored views, too. A disparity on which both runs agree within 1 px "
        f"has a confidence, others are unknown. Needs --matcher {ONNX}MODEL.",
    )
    match_on: str = param(
        "charge-band",
        "What two pixels must have in common to match: the charge, or the charge and the band.",
        choices=("charge", "charge-band"),
        only_with="--matcher trails, dense or regions",
    )
    max_disparity: int = param(
        64,
        "Maximum disparity or auto. A larger one finds nearer objects and takes longer; auto (or "
        "0) measures it in a sample of the recording, as check does.",
        unit="px",
        low=AUTO,
        high=MAX_DISPARITY,
        common=True,
        words={"auto": AUTO},
    )
    depth_of: str = param(
        "moved",
        "Which pixels have depth. moved: those with charge, as in the paper; all: what stands "
        "still too, from the first frame on. Not with --matcher trails or regions.",
        choices=("moved", "all"),
    )
    reference: str = param(
        "right",
        "Camera whose view all results are in. right as in the paper; left as in KITTI, "
        "Middlebury and ROS.",
        choices=("right", "left"),
        group="Output",
        common=True,
    )

    # Disparity by trails.
    vote_rows: int = param(
        8,
        "Height of the blocks in which trails vote together.",
        unit="px",
        low=1,
        high=256,
        only_with=_TRAILS,
    )
    vote_columns: int = param(
        8,
        "Width of the blocks in which trails vote together.",
        unit="px",
        low=1,
        high=256,
        only_with=_TRAILS,
    )
    max_ratio: float = param(
        0.9,
        "Maximum support of a trail's second best partner, as a share of that of the best.",
        low=0,
        high=1,
        only_with=_TRAILS,
    )
    min_votes: int = param(
        16,
        "Minimum number of votes for a disparity, within about a block around it.",
        low=1,
        high=100_000,
        old="least_votes",
        only_with=_TRAILS,
    )
    max_residual: float = param(
        8.0,
        "Maximum grey-level difference between corresponding pixels (255 = any). A constant "
        "difference in brightness between the cameras does not count.",
        unit="grey levels",
        low=0,
        high=255,
        only_with="--matcher trails or --disparity",
    )
    speckle_px: int = param(
        100,
        "Minimum size of a connected patch of disparity; smaller ones are dropped (0 = none are).",
        unit="px",
        low=0,
        high=1_000_000,
        only_with=_TRAILS,
    )
    gap_px: int = param(
        16,
        "Maximum width of a gap that is filled, between matched trails of like disparity in a row.",
        unit="px",
        low=0,
        high=1024,
        only_with=_TRAILS,
    )
    average_frames: int = param(
        8,
        "Maximum number of frames whose disparity is averaged where nothing moves, so that it does "
        "not flicker (1 = none is).",
        unit="frames",
        low=1,
        high=16,
        only_with="--matcher dense",
    )
    # Which of the disparities to give.
    max_age: int = param(
        FOREVER,
        "Maximum age of the motion that gives a disparity (0 = only motion of this frame). Needs "
        "--charge-mode permanency.",
        unit="frames",
        low=0,
        high=FOREVER,
        common=True,
    )
    min_confidence: float = param(
        0.0,
        "Minimum chance that a disparity is right within 1 px. Needs --matcher "
        + " or ".join(name for name, matcher in MATCHERS.items() if matcher.knows_confidence)
        + ".",
        low=0,
        high=1,
        common=True,
    )
    # Guidance.
    steer_strips: int = param(
        48,
        "Number of vertical strips in which the free way is looked for.",
        low=1,
        high=256,
        group="Guidance",
        only_with="--save steering, objects, preview or bag",
    )
    steer_gain: float = param(
        0.3,
        "Share of the turn from the last heading to the new one that is made in a frame (1 = all).",
        low=0.01,
        high=1,
        group="Guidance",
        only_with=_STEERING,
    )
    # Guidance of a robot whose own motion is known.
    goal: str = param(
        "",
        "Place to steer to, X,Y in m in the world of the poses (empty = along the longest free "
        "way). Needs --poses.",
        group="Guidance",
        only_with=_STEERING,
    )
    robot_radius_m: float = param(
        0.25,
        "Radius of the robot that is steered.",
        unit="m",
        low=0.05,
        high=5,
        group="Guidance",
        only_with=f"--rig and {_STEERING}",
    )
    robot_below_m: float = param(
        1.1,
        "How far below the cameras an object is in the robot's way; less than the height of the "
        "cameras over the floor.",
        unit="m",
        low=0,
        high=10,
        group="Guidance",
        only_with="--poses or --save map",
    )
    robot_above_m: float = param(
        0.6,
        "How far above the cameras an object is in the robot's way.",
        unit="m",
        low=0,
        high=10,
        group="Guidance",
        only_with="--poses or --save map",
    )

    @property
    def goal_m(self) -> tuple[float, float] | None:
        """The place to steer to, None if there is none."""
        if not self.goal:
            return None
        try:
            x_m, y_m = (float(part) for part in self.goal.split(","))
        except ValueError:
            x_m = y_m = math.nan
        if not (math.isfinite(x_m) and math.isfinite(y_m)):
            raise SettingsError(f"--goal cannot be {self.goal!r}: give X,Y in m, such as 4.5,-1")
        return x_m, y_m

    @property
    def options(self) -> set[str]:
        """The options that these values are, as conditions of other parameters name them."""
        matchers = {self.matcher}
        if self.matcher.startswith(ONNX):
            matchers = {f"{ONNX}MODEL"}
        elif self.matcher not in OWN_MATCHERS:  # one of another package, which may use any value
            matchers |= OWN_MATCHERS
        return {*options_of(self), *(f"--matcher {name}" for name in matchers)}

    def __post_init__(self) -> None:
        checked(self)
        _ = self.goal_m
        if self.grey_min >= self.grey_max:
            raise SettingsError(
                f"--grey-min {self.grey_min} is not below --grey-max {self.grey_max}"
            )
        if self.charge_min >= self.charge_max:
            raise SettingsError(
                f"--charge-min {self.charge_min} is not below --charge-max {self.charge_max}"
            )
        if self.max_age < FOREVER and self.charge_mode == "general":
            raise SettingsError("--max-age needs --charge-mode permanency: else age is not known")
        # A model, or what another package offers.
        other = Matcher("another", knows_confidence=self.check_both, knows_rest=True)
        row = MATCHERS.get(self.matcher) or other
        if self.check_both and not self.matcher.startswith(ONNX):
            raise SettingsError(f"--check-both needs --matcher {ONNX}MODEL")
        if self.depth_of == "all" and not row.knows_rest:
            knowing = " or ".join(name for name in MATCHERS if MATCHERS[name].knows_rest)
            raise SettingsError(f"--depth-of all needs --matcher {knowing}")
        if self.depth_of == "all" and self.max_age < FOREVER:
            raise SettingsError("--max-age needs --depth-of moved: what stands still has no age")
        if self.min_confidence > 0 and not row.knows_confidence:
            knowing = " or ".join(name for name in MATCHERS if MATCHERS[name].knows_confidence)
            raise SettingsError(
                f"--min-confidence needs --matcher {knowing}, or a model with --check-both"
            )

    @classmethod
    def preset(cls, name: str, **overrides: Any) -> Settings:
        """Return a named preset, with some values replaced.

        What it has without an effect beside these keeps its default.

        Raises:
            SettingsError: no such preset, or a value is out of range.
        """
        if name not in PRESETS:
            raise SettingsError(f"there is no preset {name!r}: choose {' | '.join(PRESETS)}")
        values = {**PRESETS[name], **overrides}
        present = cls(**values).options
        idle = {item.name for item in params(cls) if item.missing(present)}
        return cls(**{key: values[key] for key in values if key in overrides or key not in idle})


#: Named sets of values; what they leave out keeps its default.
PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": {"matcher": "trails"},
    "contrast": {"contrast_px": 15.0, "bands": 16, "min_jump": 8},
    "paper": {
        "blur_px": 0.0,
        "contrast_px": 0.0,
        "bands": 8,
        "grey_min": 0,
        "grey_max": 255,
        "min_jump": 0,
        "charge_mode": "permanency",
        "charge_max": 255,
        "charge_min": 0,
        "charge_leak": 16,
        "matcher": "trails",
        "match_on": "charge",
        "max_residual": 255.0,
    },
}
