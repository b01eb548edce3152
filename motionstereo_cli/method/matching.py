"""The matchers: from two memories to disparity.

A new matcher is a file of its own, a function here, and a row in ``settings.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.method.balance import balanced
from motionstereo_cli.method.block_matching import consensus, stereo_bm, stereo_sgbm
from motionstereo_cli.method.borders import hidden_filled, trimmed
from motionstereo_cli.method.cleaning import filled, without_speckles
from motionstereo_cli.method.confidence import confidence, confidence_by_margin, margin_of_planes
from motionstereo_cli.method.dense import match_dense, smoothed, weights_of
from motionstereo_cli.method.memory import Memory, age_of, blurred, in_mirror, keys_of, mirrored
from motionstereo_cli.method.planes import Surface, with_planes
from motionstereo_cli.method.refine import refined
from motionstereo_cli.method.regions import match_regions
from motionstereo_cli.method.residual import residual
from motionstereo_cli.method.rows import (
    ROWS,
    enlarged,
    every_second,
    halved,
    halved_exactly,
    halved_mask,
    in_pairs,
    reduced,
    whole,
    without_fringes,
)
from motionstereo_cli.method.settings import (
    FOREVER,
    GIVEN,
    MATCHERS,
    ONNX,
    OWN_MATCHERS,
    Matcher,
    Settings,
    installed_matchers,
)
from motionstereo_cli.method.trails import match_trails
from motionstereo_cli.method.unknown import reasons

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from motionstereo_cli.types import Grey, Real


class Found(NamedTuple):
    """What a matcher found, (height, width) each.

    Attributes:
        disparity_px: float32, NaN = unknown.
        confidence: makes the confidence 0..1, float32, NaN = unknown: it takes time, and few ask
            for it.
        at_limit: pixels left unknown because the best match was the last one of the range, bool;
            None for none.
    """

    disparity_px: Real
    confidence: Callable[[], Real]
    at_limit: NDArray[np.bool_] | None = None


#: Disparities so close to the limit of the range, in px, may be beyond it.
_LIMIT_PX = 0.5

#: Trails are looked for in every so many rows, in blocks that are twice as high as usual: their
#: proposals are those of the rows in between, too.
_TRAIL_ROWS = 4

#: Texture is fine where more than this share of the pixels begin a trail.
_FINE = 0.4

#: Views of this height and width in px are matched at half the size: objects are larger in them.
_LARGE_PX = 600, 1600


def _trails(right: Memory, left: Memory, settings: Settings) -> Found:
    s, wanted = settings, keys_of(right, settings)
    disparity, votes = match_trails(
        wanted,
        keys_of(left, s),
        s.max_disparity,
        block_px=(s.vote_rows, s.vote_columns),
        max_ratio=s.max_ratio,
        min_votes=s.min_votes,
    )
    differs = residual(disparity, blurred(right, s), blurred(left, s))
    matched = without_speckles(disparity, differs <= s.max_residual, s.speckle_px)
    disparity = filled(matched, wanted > 0, s.gap_px)
    return Found(
        disparity, lambda: confidence(disparity, matched, votes, differs, age_of(right, s))
    )


def _dense(right: Memory, left: Memory, settings: Settings) -> Found:
    s = settings
    right_grey, left_smoothed = smoothed(right.grey), smoothed(left.grey)
    left_grey = balanced(right_grey, left_smoothed, s.max_disparity)
    left_exact = halved_exactly(left.grey)
    if left_grey is not left_smoothed:
        left_exact += halved_exactly(left_grey) - halved_exactly(left_smoothed)
    keys = keys_of(right, s)
    charged = keys > 0 if s.depth_of == "moved" else np.ones(keys.shape, np.bool_)
    views = _Views(
        *(right_grey, left_grey, halved_exactly(right.grey), left_exact),
        *(keys, keys_of(left, s), charged, age_of(right, s)),
    )
    half, at_limit, margin, share = _half(views, s.max_disparity, s)
    half[half > s.max_disparity - _LIMIT_PX] = np.nan
    disparity = whole(half, halved_exactly(right_grey), right_grey)
    # Windows of the matching are so many px wide in the views that it was done in.
    wide = keys.shape[1] // at_limit.shape[1]
    disparity = trimmed(disparity, right_grey, left_grey, wide)
    matched = without_speckles(disparity, np.ones(charged.shape, np.bool_), s.speckle_px)
    disparity = hidden_filled(filled(matched, charged, s.gap_px), charged, wide)
    disparity = without_fringes(disparity, charged)

    def sure() -> Real:
        margins = np.where(np.isnan(share), margin, margin_of_planes(share))
        return confidence_by_margin(disparity, matched, enlarged(margins, charged.shape))

    at_limit = enlarged(at_limit.view(np.uint8), charged.shape).view(np.bool_) & charged
    return Found(disparity, sure, at_limit)


class _Views(NamedTuple):
    """What is matched, (height, width) each.

    Attributes:
        right, left: grey with little noise and of equal brightness, uint8.
        right_exact, left_exact: grey of half the rows, with its noise, (rows, width) float32.
        keys, left_keys: match keys, uint16.
        wanted: right pixels to match, bool.
        age_frames: frames since something moved there, uint8.
    """

    right: Grey
    left: Grey
    right_exact: Real
    left_exact: Real
    keys: NDArray[np.uint16]
    left_keys: NDArray[np.uint16]
    wanted: NDArray[np.bool_]
    age_frames: Grey

    def smaller(self) -> _Views:
        """Return the same at half the size."""
        right, left = self.exact_pairs()
        return _Views(
            *(reduced(self.right), reduced(self.left), reduced(right), reduced(left)),
            *(every_second(self.keys), every_second(self.left_keys)),
            *(every_second(self.wanted), every_second(self.age_frames)),
        )

    def exact_pairs(self) -> tuple[Real, Real]:
        """Return grey of half the rows of which each pair is one row at half the size."""
        rows = len(self.right) // 2
        right, left = (in_pairs(exact[:rows]) for exact in (self.right_exact, self.left_exact))
        return right, left


class _Half(NamedTuple):
    """What is found at half the height, (rows, width) each.

    Attributes:
        disparity_px: float32, NaN = unknown.
        at_limit: where the best match was the last one of the range, bool; in the smaller views
            that were matched, as margin and share are.
        margin: by how much the second best disparity costs more, float32.
        share: of the inliers of the plane that decided, float32, NaN = none did.
    """

    disparity_px: Real
    at_limit: NDArray[np.bool_]
    margin: Real
    share: Real


def _half(views: _Views, max_disparity: int, settings: Settings) -> _Half:
    """Match half the rows; large views are matched at half the size, and that is refined."""
    if all(side >= large for side, large in zip(views.right.shape, _LARGE_PX, strict=True)):
        found = _half(views.smaller(), -(-max_disparity // 2), settings)
        right, left = (reduced(exact, columns=1) for exact in views.exact_pairs())
        fine = refined(2 * enlarged(found.disparity_px, right.shape), right, left)
        # Surfaces that lean are twice as steep as in the smaller views.
        grey = halved(views.right)[: len(views.right) // 2]
        fine = enlarged(whole(fine, right, grey, 2), views.right_exact.shape)
        return found._replace(disparity_px=fine)
    limit_px = max_disparity - _LIMIT_PX
    keys, age = views.keys[::ROWS], views.age_frames[::ROWS]
    proposed = _proposed(views.keys, views.left_keys, max_disparity, settings)
    half, margin = match_dense(
        *(halved(views.right), halved(views.left), halved_mask(views.wanted), proposed),
        weights_of(proposed, keys, age == 0),
        max_disparity,
    )
    at_limit = half > limit_px
    half[at_limit] = np.nan
    half = refined(half, views.right_exact, views.left_exact)
    surface = Surface.of(halved_exactly(views.right), views.wanted[::ROWS], age)
    half, share = with_planes(half, margin, proposed, surface, max_disparity)
    half[half > limit_px] = np.nan
    return _Half(half, at_limit, margin, share)


def _proposed(
    keys: NDArray[np.uint16], left_keys: NDArray[np.uint16], max_disparity: int, settings: Settings
) -> Real:
    """Return the disparity of trails, (half the rows, width) float32, NaN = none.

    Fine texture tells its disparity by itself: there trails propose none.

    Args:
        keys, left_keys: match keys, (height, width) uint16.
        max_disparity: px.
        settings: how trails are matched.
    """
    s, rows = settings, -(-len(keys) // ROWS)
    some, left_some = keys[::_TRAIL_ROWS], left_keys[::_TRAIL_ROWS]
    ends = np.count_nonzero(some[:, 1:] != some[:, :-1])
    if ends > _FINE * some.size:
        return np.full((rows, keys.shape[1]), np.nan, np.float32)
    found, _ = match_trails(
        some,
        left_some,
        max_disparity,
        block_px=(max(s.vote_rows // ROWS, 1), s.vote_columns),
        max_ratio=s.max_ratio,
        min_votes=max(s.min_votes // _TRAIL_ROWS, 1),
    )
    return np.repeat(found, _TRAIL_ROWS // ROWS, axis=0)[:rows]


def _regions(right: Memory, left: Memory, settings: Settings) -> Found:
    s = settings
    disparity = match_regions(keys_of(right, s), keys_of(left, s), s.max_disparity)
    return Found(disparity, lambda: np.full_like(disparity, np.nan))


def _of_opencv(function: Callable[..., Real]) -> Callable[[Memory, Memory, Settings], Found]:
    """Return a matcher with OpenCV's filtered disparity of charged pixels."""

    def match(right: Memory, left: Memory, settings: Settings) -> Found:
        disparity = function(right.grey, left.grey, settings.max_disparity + 1, filtered=True)
        return wanted_of(disparity, right, settings)

    return match


def of_others(given_px: Real) -> Callable[[Memory, Memory, Settings], Found]:
    """Return a matcher that gives a disparity as it is, where both images agree with it.

    Args:
        given_px: of the right view, (height, width) float32, NaN = unknown.
    """

    def match(right: Memory, left: Memory, settings: Settings) -> Found:
        found = wanted_of(given_px, right, settings)
        differs = residual(found.disparity_px, blurred(right, settings), blurred(left, settings))
        found.disparity_px[differs > settings.max_residual] = np.nan
        return found

    return match


def wanted_of(
    disparity_px: Real, right: Memory, settings: Settings, chance: Real | None = None
) -> Found:
    """Return a disparity without what was not asked for: at rest.

    Args:
        disparity_px: (height, width) float32, NaN = unknown.
        right: the memory of the view that it is of.
        settings: what is asked for.
        chance: its confidence, likewise; None where that is unknown.
    """
    wanted = (right.charge > settings.charge_min) | (settings.depth_of == "all")
    found = np.where(wanted, disparity_px, np.float32(np.nan))

    def sure() -> Real:
        if chance is None:
            return np.full_like(found, np.nan)
        return np.where(np.isnan(found), np.float32(np.nan), chance)

    return Found(found, sure)


#: By the name that users give, as :data:`~motionstereo_cli.method.settings.MATCHERS` describes
#: them. Each takes the right and the left memory and the settings; it returns the disparity in px
#: of each charged right pixel and what makes its confidence 0..1, both (height, width) float32,
#: NaN = unknown.
MATCH: dict[str, Callable[[Memory, Memory, Settings], Found]] = {
    "trails": _trails,
    "dense": _dense,
    "regions": _regions,
    "sgbm": _of_opencv(stereo_sgbm),
    "bm": _of_opencv(stereo_bm),
    "consensus": _of_opencv(consensus),
}


def register_matcher(
    name: str, function: Callable[[Memory, Memory, Settings], ArrayLike], what: str = ""
) -> None:
    """Add a matcher, or replace an added one; settings choose it by its name.

    A package offers one to all users, the command line included, by an entry point of the group
    ``motionstereo.matchers`` that names the function.

    Args:
        name: its name for ``Settings(matcher=...)`` and ``--matcher``.
        function: takes the right and the left memory and the settings; returns the disparity in px
            of each right pixel, (height, width), NaN = unknown. What it gives outside
            0..``max_disparity`` becomes unknown, and so does what it gives for pixels at rest, but
            with ``depth_of="all"``; it must not write to the memories.
            With ``--reference left`` it is given mirror images, and its result is mirrored back.
        what: what it does, in a few words.

    Raises:
        SettingsError: the package has a matcher of that name, or the function is not callable.
    """
    if name in OWN_MATCHERS or not name or not callable(function):
        raise SettingsError(f"matcher {name!r}: give another name, and a function")

    def match(right: Memory, left: Memory, settings: Settings) -> Found:
        try:
            found = np.array(function(right, left, settings), np.float32)
        except Exception as error:
            raise InputError(f"the matcher {name} failed: {error!r}") from error
        if found.shape != right.charge.shape:
            raise InputError(
                f"the matcher {name} gives shape {found.shape}: give {right.charge.shape}"
            )
        found[~(found >= 0)] = np.nan
        return wanted_of(found, right, settings)

    MATCH[name] = match
    MATCHERS[name] = Matcher(what or name, knows_confidence=False, knows_rest=True)


def matcher_of(settings: Settings) -> Callable[[Memory, Memory, Settings], Found]:
    """Return the matcher that settings choose.

    Raises:
        InputError: a package offers it, and it cannot be loaded; or frames were to bring disparity,
            and have none.
    """
    name = settings.matcher
    if name == GIVEN:
        raise InputError(f"the matcher {name} takes the disparity of frames, which have none")
    if name.startswith(ONNX) and name not in MATCH:
        raise InputError(f"the model of {name} is not loaded: runs.onnx_model.load_model does it")
    if name not in MATCH:
        try:
            register_matcher(name, installed_matchers()[name].load())
        except Exception as error:
            raise InputError(f"the matcher {name} cannot be loaded: {error!r}") from error
    return MATCH[name]


class Match(NamedTuple):
    """The result of matching one frame, in the reference view, (height, width) each.

    Attributes:
        disparity_px: float32, NaN = unknown.
        confidence: 0..1, float32, NaN = unknown; None if not asked for.
        occlusion: why it is unknown, uint8, by the codes of
            :data:`~motionstereo_cli.method.settings.OCCLUSION`; None if not asked for.
        at_limit: share of the image whose best match was the last one of the range.
    """

    disparity_px: Real
    confidence: Real | None
    occlusion: Grey | None
    at_limit: float


def match(
    right: Memory,
    left: Memory,
    settings: Settings,
    given_px: Real | None = None,
    *,
    with_confidence: bool = True,
    with_occlusion: bool = False,
) -> Match:
    """Match the two memories, in the reference view.

    Where disparity is given, that is taken.
    """
    extras = {"with_confidence": with_confidence, "with_occlusion": with_occlusion}
    if settings.reference == "left":
        # In mirror images left and right cameras are exchanged, and disparities stay the same.
        given_px = None if given_px is None else mirrored(given_px)
        found = _match(in_mirror(left), in_mirror(right), settings, given_px, **extras)
        return Match(
            mirrored(found.disparity_px),
            None if found.confidence is None else mirrored(found.confidence),
            None if found.occlusion is None else mirrored(found.occlusion),
            found.at_limit,
        )
    return _match(right, left, settings, given_px, **extras)


def _match(
    right: Memory,
    left: Memory,
    settings: Settings,
    given_px: Real | None,
    *,
    with_confidence: bool,
    with_occlusion: bool,
) -> Match:
    s = settings
    matcher = matcher_of(s) if given_px is None else of_others(given_px)
    disparity, confidence, at_limit = matcher(right, left, s)
    chance = confidence() if with_confidence or s.min_confidence > 0 else None
    if s.min_confidence > 0 or s.max_age < FOREVER:
        dropped = age_of(right, s) > s.max_age
        if chance is not None:
            dropped |= chance < s.min_confidence
            chance[dropped] = np.nan
        disparity[dropped] = np.nan
    beyond = disparity > s.max_disparity - _LIMIT_PX
    at_limit = beyond if at_limit is None else at_limit | beyond
    disparity[beyond] = np.nan
    if chance is not None:
        chance[beyond] = np.nan
    occlusion = None
    if with_occlusion:
        wanted = (right.charge > s.charge_min) | (s.depth_of == "all")
        occlusion = reasons(disparity, wanted, at_limit)
    return Match(disparity, chance, occlusion, float(np.count_nonzero(at_limit)) / at_limit.size)
