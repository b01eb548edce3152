"""How far disparity or depth is from the truth, in the measures the field uses.

Images compared are of one view; a run's are of the right one unless it ran with --reference left.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig import read_rig
from motionstereo_cli.sources.stills import DamagedImageError, read_still, shown
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

#: Where a run writes them, the most exact ones first.
_FOLDERS = ("disparity-pfm", "disparity", "depth-pfm", "depth-tiff", "depth")

_SUFFIXES = (".png", ".pfm", ".tiff")

#: How the names of folders that hold them begin; KITTI's is disp_occ_0.
_NAMED = {"disp": "disparity", "depth": "depth"}

#: Errors in px above which a disparity is bad.
BAD_PX = (0.5, 1.0, 2.0, 3.0)

#: Depths count up to here, as is the custom on KITTI since Eigen et al. (2014): a disparity near
#: 0 would otherwise outweigh all others.
FAR_M = 80.0

#: Units per px of a 16-bit PNG, as KITTI has it, and per m, as REP 118 has it.
_PER_PX = 256
_PER_M = 1000

#: The median comes from a histogram: exact for disparities in 1/256 px, and up to 256 px.
_BINS_PER_PX = 256
_BINS = 65536


class FramePair(NamedTuple):
    """One frame of both sides, (height, width) float32 each, NaN = unknown or not counted.

    Attributes:
        found_px, truth_px: disparity in px.
        found_m, truth_m: depth in m; None where no rig is known.
    """

    found_px: Real
    truth_px: Real
    found_m: Real | None = None
    truth_m: Real | None = None


@dataclass(frozen=True, slots=True)
class Score:
    """What the evaluation found out about a frame, or about all pixels of all frames together.

    Shares are 0..1 and, but for coverage, of the pixels that have both truth and a result. A
    measure of no pixel at all is NaN.

    Attributes:
        frame: its number; None for all frames together.
        truth_pixels: how many pixels have truth and are not masked out.
        both_pixels: how many of these have a result.
        coverage: both_pixels / truth_pixels.
        bad_0_5, bad_1, bad_2, bad_3: share whose disparity is wrong by more than 0.5, 1, 2, 3 px:
            the bad-pixel measure B of Scharstein and Szeliski, "A Taxonomy and Evaluation of
            Dense Two-Frame Stereo Correspondence Algorithms" (2002), section 5.1.
        d1: share wrong by more than 3 px and by more than 5 % of the truth, the outliers of KITTI
            2015: Menze and Geiger, "Object Scene Flow for Autonomous Vehicles" (2015).
        mean_px, median_px: mean and median of the absolute error of the disparity.
        rms_px: root of its mean square: R of Scharstein and Szeliski (2002).
        abs_rel: mean of abs(depth - truth) / truth, of depths up to :data:`FAR_M`: Eigen et al.,
            "Depth Map Prediction from a Single Image using a Multi-Scale Deep Network" (2014).
        rmse_m: root of the mean square of depth - truth, of the same pixels and source.
    """

    frame: int | None
    truth_pixels: int
    both_pixels: int
    coverage: float
    bad_0_5: float
    bad_1: float
    bad_2: float
    bad_3: float
    d1: float
    mean_px: float
    median_px: float
    rms_px: float
    abs_rel: float
    rmse_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """Sums over pixels, from which a score follows; the sum of tallies is that of all pixels.

    Attributes:
        truth, both: number of pixels with truth, and with truth and a result.
        bad: number of pixels wrong by more than each of :data:`BAD_PX`, (4,) int64.
        outliers: number of pixels that D1 counts.
        error_px, error_px2: sums of the absolute and of the squared error of the disparity.
        histogram: number of pixels by absolute error in steps of 1/256 px, int64.
        depths: number of pixels where both depths are known and the true one counts.
        error_rel, error_m2: sums of the relative absolute and of the squared error of the depth.
    """

    truth: int
    both: int
    bad: NDArray[np.int64]
    outliers: int
    error_px: float
    error_px2: float
    histogram: NDArray[np.int64]
    depths: int
    error_rel: float
    error_m2: float

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def score(self, frame: int | None = None) -> Score:
        """Return the measures of the pixels counted."""
        bad_0_5, bad_1, bad_2, bad_3 = (_ratio(int(count), self.both) for count in self.bad)
        return Score(
            frame=frame,
            truth_pixels=self.truth,
            both_pixels=self.both,
            coverage=_ratio(self.both, self.truth),
            bad_0_5=bad_0_5,
            bad_1=bad_1,
            bad_2=bad_2,
            bad_3=bad_3,
            d1=_ratio(self.outliers, self.both),
            mean_px=_ratio(self.error_px, self.both),
            median_px=self._median_px(),
            rms_px=math.sqrt(_ratio(self.error_px2, self.both)),
            abs_rel=_ratio(self.error_rel, self.depths),
            rmse_m=math.sqrt(_ratio(self.error_m2, self.depths)),
        )

    def _median_px(self) -> float:
        if not self.both:
            return math.nan
        middle = [(self.both + 1) // 2, self.both // 2 + 1]  # two where their number is even
        steps = np.searchsorted(np.cumsum(self.histogram), middle)
        return float(steps.mean()) / _BINS_PER_PX


def tally(pair: FramePair) -> Tally:
    """Return the sums over the pixels of a frame."""
    has_truth = ~np.isnan(pair.truth_px)
    both = has_truth & ~np.isnan(pair.found_px)
    truth_px = pair.truth_px[both]
    error_px = np.abs(pair.found_px[both] - truth_px)
    steps = np.minimum(np.rint(error_px * _BINS_PER_PX), _BINS - 1).astype(np.int64)
    depths, error_rel, error_m2 = 0, 0.0, 0.0
    if pair.found_m is not None and pair.truth_m is not None:
        compared = ~np.isnan(pair.found_m) & (pair.truth_m <= FAR_M)
        truth_m = pair.truth_m[compared].astype(np.float64)
        error_m = np.minimum(pair.found_m[compared], FAR_M) - truth_m
        depths = len(truth_m)
        error_rel, error_m2 = float((np.abs(error_m) / truth_m).sum()), float(error_m @ error_m)
    return Tally(
        truth=int(np.count_nonzero(has_truth)),
        both=len(error_px),
        bad=np.array([np.count_nonzero(error_px > limit) for limit in BAD_PX], np.int64),
        outliers=int(np.count_nonzero((error_px > 3) & (error_px > 0.05 * truth_px))),
        error_px=float(error_px.sum(dtype=np.float64)),
        error_px2=float(np.square(error_px, dtype=np.float64).sum()),
        histogram=np.bincount(steps, minlength=_BINS),
        depths=depths,
        error_rel=error_rel,
        error_m2=error_m2,
    )


class Maps:
    """The disparity or depth images of a folder, by frame number.

    16-bit PNG: disparity in 1/256 px (KITTI) or depth in mm (REP 118), or whatever unit the
    run.json beside it names, 0 = unknown. PFM and float32 TIFF: disparity in px or depth in m;
    unknown where not positive or not finite.

    A frame's number is the number in its file name or, of several, that which differs most from
    file to file: 7 of 000007_10.png.

    Args:
        folder: what ``run`` or ``simulate`` wrote, with folders of disparity (preferred) or depth
            in it; or a folder of images.
        kind: ``disparity`` or ``depth``; if None, as the folder's name begins (disp, depth).

    Attributes:
        kind: ``disparity`` or ``depth``.
        files: the images by frame number, in order.
        rig: what the rig.yaml or run.json beside them says, None if nothing.
        reference: the camera whose view they are in, ``right`` or ``left``; None if nobody says.

    Raises:
        InputError: there is no such folder or no image in it, or its kind or the frame numbers
            cannot be told.
    """

    def __init__(self, folder: Path, kind: str | None = None) -> None:
        within = [
            name for name in _FOLDERS if name.startswith(kind or "") and (folder / name).is_dir()
        ]
        if within:
            images, home = folder / within[0], folder
            kind = _kind_by_name(images)
        else:
            named = _kind_by_name(folder)
            images, home = folder, folder.resolve().parent if named else folder
            kind = kind or named
        self.files = _numbered(images, _SUFFIXES)
        if kind is None:
            raise InputError(
                f"{folder}: its name does not tell whether it holds disparity or depth: "
                "give --out-kind or --truth-kind"
            )
        self.kind = kind
        self.rig, self.reference, per_m = _said_in(home)
        self._png_per_unit = _PER_PX if kind == "disparity" else per_m

    def read(self, number: int) -> Real:
        """Return a frame's disparity in px or depth in m, (height, width) float32, NaN = unknown.

        Raises:
            InputError: the file cannot be read, or its pixels are of another kind.
        """
        path = self.files[number]
        image = _read(path)
        wanted = np.uint16 if path.suffix.lower() == ".png" else np.float32
        if image.ndim != 2 or image.dtype != wanted:
            raise InputError(
                f"{path} is not a 16-bit grey PNG, a one-channel PFM or a float32 TIFF: convert it"
            )
        values = image.astype(np.float32)
        if wanted is np.uint16:
            values /= self._png_per_unit
        return np.where((values > 0) & np.isfinite(values), values, np.float32(np.nan))


class Comparison:
    """A result beside its truth, frame by frame.

    Args:
        out, truth: the two sides.
        rig: the camera; if None, each side's own rig serves, or else the other's.
        mask: folder of PNG files; only pixels where they are not 0 count.

    Attributes:
        numbers: the frames that both sides have, in order.
        only_out, only_truth: the frames that one side alone has.
        has_depth: a rig is known, so that there are errors in m.
        views: the cameras whose views both sides are in, None where nobody says.

    Raises:
        InputError: the sides have no frame in common, a mask is missing, or depth has to be
            converted and there is no rig.
    """

    def __init__(
        self, out: Maps, truth: Maps, rig: Rig | None = None, mask: Path | None = None
    ) -> None:
        self._out, self._truth = out, truth
        self._out_rig = rig or out.rig or truth.rig
        self._truth_rig = rig or truth.rig or out.rig
        self.has_depth = self._out_rig is not None
        self.views = (out.reference, truth.reference)
        if not self.has_depth and "depth" in (out.kind, truth.kind):
            raise InputError("depth becomes disparity by the rig, and none was found: give --rig")
        self.numbers = [number for number in truth.files if number in out.files]
        self.only_out = sorted(out.files.keys() - truth.files.keys())
        self.only_truth = sorted(truth.files.keys() - out.files.keys())
        if not self.numbers:
            raise InputError(
                f"no frame number is common to {_span(out)} and {_span(truth)}: "
                "give results and truth of the same frames"
            )
        self._masks = None if mask is None else _numbered(mask, (".png",))
        for number in self.numbers:
            if self._masks is not None and number not in self._masks:
                raise InputError(f"{mask} has no PNG for frame {number}: add it (not 0 = count)")

    def pair(self, number: int) -> FramePair:
        """Return both sides of a frame.

        Raises:
            InputError: one side lacks the frame, a file cannot be read, or sizes differ.
        """
        if not (number in self._out.files and number in self._truth.files):
            raise InputError(
                f"frame {number} is not on both sides: {_span(self._out)}, {_span(self._truth)}"
            )
        out, truth = self._out.read(number), self._truth.read(number)
        self._check_size(self._out.files[number], out)
        self._check_size(self._truth.files[number], truth)
        if out.shape != truth.shape:
            raise InputError(
                f"{self._out.files[number]} is {_size(out)} but {self._truth.files[number]} is "
                f"{_size(truth)}: give results and truth of the same size"
            )
        if self._masks is not None:
            counted = _read_mask(self._masks[number])
            if counted.shape != truth.shape:
                raise InputError(
                    f"{self._masks[number]} is {_size(counted)} but the truth is {_size(truth)}: "
                    "give masks of the same size"
                )
            truth = np.where(counted, truth, np.float32(np.nan))
        found_px, found_m = _both_kinds(out, self._out.kind, self._out_rig)
        truth_px, truth_m = _both_kinds(truth, self._truth.kind, self._truth_rig)
        assert found_px is not None
        assert truth_px is not None
        return FramePair(found_px, truth_px, found_m, truth_m)

    def _check_size(self, path: Path, image: Real) -> None:
        for rig in (self._out_rig, self._truth_rig):
            if rig is not None and (rig.height, rig.width) != image.shape:
                raise InputError(
                    f"{path} is {_size(image)} but the rig is for {rig.width}x{rig.height}: "
                    "give the rig of these images with --rig"
                )


@dataclass(frozen=True, slots=True)
class Report:
    """Scores of a comparison.

    Attributes:
        overall: all pixels of all frames together, each pixel counted alike.
        frames: each frame.
        only_out, only_truth: how many frames one side alone has; they are not scored.
    """

    overall: Score
    frames: Sequence[Score]
    only_out: int
    only_truth: int

    @property
    def worst(self) -> Score:
        """The frame with the most pixels wrong by more than 1 px, else with the most compared."""
        return max(
            self.frames,
            key=lambda s: (s.both_pixels and s.bad_1 * s.both_pixels, s.both_pixels),
        )


def evaluate(comparison: Comparison, progress: Callable[[], object] = lambda: None) -> Report:
    """Score every frame that both sides have, one at a time in memory.

    Args:
        comparison: result and truth.
        progress: called after each frame.

    Raises:
        InputError: a file cannot be used, or no pixel at all has truth.
    """
    total: Tally | None = None
    frames = []
    for number in comparison.numbers:
        sums = tally(comparison.pair(number))
        frames.append(sums.score(number))
        total = sums if total is None else total + sums
        progress()
    if total is None or not total.truth:
        raise InputError("no pixel has truth: check the truth, its kind and the mask")
    return Report(total.score(), frames, len(comparison.only_out), len(comparison.only_truth))


def format_csv(report: Report) -> str:
    """Return the scores as RFC 4180 CSV (but LF): a row a frame, then one for all; empty = none."""
    rows = [",".join(item.name for item in fields(Score))]
    for score in (*report.frames, report.overall):
        frame, *values = asdict(score).values()
        cells = ["" if _is_nan(value) else f"{value:.7g}" for value in values]
        rows.append(",".join(["overall" if frame is None else str(frame), *cells]))
    return "\n".join(rows) + "\n"


def format_json(report: Report) -> str:
    """Return the report as JSON; null = none."""

    def known(score: Score) -> dict[str, Any]:
        return {key: None if _is_nan(value) else value for key, value in asdict(score).items()}

    content = {
        "overall": known(report.overall),
        "frames": [known(score) for score in report.frames],
        "only_out": report.only_out,
        "only_truth": report.only_truth,
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def format_table(report: Report) -> str:
    """Return a table to read: all frames together beside the worst."""
    worst = report.worst
    rows = [("", f"{len(report.frames)} frames", f"worst: {worst.frame}")]
    for item in fields(Score)[1:]:
        overall, frame = (getattr(score, item.name) for score in (report.overall, worst))
        rows.append((item.name, _shown(overall), _shown(frame)))
    return "".join(f"{name:<13}{overall:>14}{frame:>14}\n" for name, overall, frame in rows)


_STEPS_BGR = (
    ("within 0.5 px", (149, 54, 49)),
    ("within 1 px", (209, 173, 116)),
    ("within 2 px", (144, 224, 254)),
    ("within 3 px", (67, 109, 244)),
    ("over 3 px", (38, 0, 165)),
)
_UNKNOWN_BGR = (0, 0, 0)
_NO_TRUTH_BGR = (64, 64, 64)
_ENTRY_PX = 120
_LINE_PX = 18


def draw_errors(pair: FramePair) -> NDArray[np.uint8]:
    """Return a picture of the errors of the disparity, with a legend below.

    Blue is right and red is wrong, in the steps of :data:`BAD_PX`; black has no result, dark grey
    has no truth or is masked out.

    Returns:
        (height + legend, width, 3) uint8 BGR; widened where the legend needs it.
    """
    error_px = np.abs(pair.found_px - pair.truth_px)
    palette = np.array([bgr for _, bgr in _STEPS_BGR], np.uint8)
    picture = palette[np.searchsorted(BAD_PX, np.nan_to_num(error_px))]
    picture[np.isnan(pair.found_px)] = _UNKNOWN_BGR
    picture[np.isnan(pair.truth_px)] = _NO_TRUTH_BGR

    entries = (*_STEPS_BGR, ("unknown", _UNKNOWN_BGR), ("no truth", _NO_TRUTH_BGR))
    per_line = max(picture.shape[1] // _ENTRY_PX, 1)
    lines = math.ceil(len(entries) / per_line)
    width = max(picture.shape[1], _ENTRY_PX)
    legend = np.full((lines * _LINE_PX + 4, width, 3), 255, np.uint8)
    for index, (label, bgr) in enumerate(entries):
        x, y = index % per_line * _ENTRY_PX + 4, index // per_line * _LINE_PX + 5
        cv2.rectangle(legend, (x, y), (x + 11, y + 11), bgr, cv2.FILLED)
        origin = (x + 17, y + 10)
        cv2.putText(legend, label, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    widened = np.pad(picture, ((0, 0), (0, width - picture.shape[1]), (0, 0)), constant_values=255)
    return np.vstack([widened, legend])


def _both_kinds(values: Real, kind: str, rig: Rig | None) -> tuple[Real | None, Real | None]:
    """Return disparity in px and depth in m; None for the one that would need a rig."""
    if rig is None:
        return (values, None) if kind == "disparity" else (None, values)
    focal_baseline, doffs = np.float32(rig.focal_px * rig.baseline_m), np.float32(rig.doffs)
    if kind == "depth":
        return focal_baseline / values - doffs, values
    inverse = values + doffs
    inverse[inverse <= 0] = np.nan  # at or beyond infinity
    return values, focal_baseline / inverse


def _kind_by_name(folder: Path) -> str | None:
    name = folder.resolve().name.lower()
    return next((kind for start, kind in _NAMED.items() if name.startswith(start)), None)


def _numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    try:
        files = shown(folder.iterdir(), suffixes)
    except OSError as error:
        raise InputError(f"cannot read the folder {folder}: {error.strerror}") from error
    if not files:
        raise InputError(f"{folder} has no {' or '.join(suffixes)} files: check the path")
    # Columns of numbers, as many as the name with the fewest has.
    columns = list(zip(*(re.findall("[0-9]+", file.stem) for file in files), strict=False))
    if not columns:
        raise InputError(f"{folder}: give every file name a frame number, such as 000007.png")
    numbers = [int(digits) for digits in max(columns, key=lambda column: len(set(column)))]
    numbered = dict(sorted(zip(numbers, files, strict=True)))
    if len(numbered) < len(files):
        raise InputError(f"{folder}: several files have the same frame number: keep one of each")
    return numbered


def _said_in(folder: Path) -> tuple[Rig | None, str | None, int]:
    """Return rig, reference camera and units of depth PNG per m, as files in a folder say."""
    rig = read_rig(folder / "rig.yaml") if (folder / "rig.yaml").is_file() else None
    path = folder / "run.json"
    if not path.is_file():
        return rig, "right" if rig else None, _PER_M  # simulate's truth
    try:
        record = json.loads(path.read_bytes())
        if rig is None and record["rig"] is not None:
            rig = Rig(**record["rig"])
        per_m = int(record.get("output_settings", {}).get("depth_scale", _PER_M))
        if not (per_m > 0 and all(map(math.isfinite, (record["rig"] or {}).values()))):
            raise ValueError
        return rig, record.get("settings", {}).get("reference"), per_m
    except (
        *(OSError, ValueError, LookupError, TypeError, AttributeError),
        *(OverflowError, RecursionError),
    ) as error:
        raise InputError(f"{path}: its rig cannot be read: give --rig, or run again") from error


def _read(path: Path) -> NDArray[Any]:
    try:
        return read_still(path).pixels
    except DamagedImageError as error:
        raise InputError(f"{path} cannot be read as an image ({error}): write it again") from error


def _read_mask(path: Path) -> NDArray[np.bool_]:
    mask = _read(path)
    return np.asarray(mask != 0 if mask.ndim == 2 else mask[..., :3].any(axis=2))


def _ratio(part: float, whole: int) -> float:
    return part / whole if whole else math.nan


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _shown(value: float) -> str:
    if _is_nan(value):
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4f}"


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _span(maps: Maps) -> str:
    first, *_ = maps.files
    *_, last = maps.files
    return f"{maps.files[first].parent} ({first} to {last})"
