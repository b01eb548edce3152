"""Reading results: images, tables, and the record.

The encodings are those of :mod:`~motionstereo_cli.sinks.images`.
"""

from __future__ import annotations

import csv
import functools
import itertools
import math
import re
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.maps import SUFFIXES, numbered_files, read_map
from motionstereo_cli.files.reading import read_lines, real
from motionstereo_cli.files.records import read_json, typed
from motionstereo_cli.files.stills import DamagedImageError, read_still
from motionstereo_cli.rig import read_rig
from motionstereo_cli.sinks.images import DISPARITY_PER_PX
from motionstereo_cli.sinks.outputs import OUTPUTS, RECORD
from motionstereo_cli.sinks.records import RunRecord
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sources.names import side_of
from motionstereo_cli.sources.selection import place_near
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from motionstereo_cli.types import Real

#: Folders of images that a run writes, the most exact first.
_FOLDERS = tuple(
    output.path.partition("/")[0]
    for kind in ("disparity", "depth")
    for output in OUTPUTS.values()
    if output.kind == kind
)


#: Maximum length of a value in a message.
_SHOWN = 60

#: Prefixes of folder names by kind; KITTI's is disp_occ_0.
_NAMED = {"disp": "disparity", "depth": "depth"}

#: Folders of KITTI's truth, all of the left view: of its stereo benchmarks, and of depth.
_KITTI_LEFT = re.compile(r"disp_(occ|noc)(_[01])?|image_0?2")


class Numbering(NamedTuple):
    """Which image of its recording a frame of a run is: ``first + every * frame``.

    Attributes:
        first, every: as --start and --every said.
        lost: images that were missing, damaged or without a partner; what came after one of them
            is numbered too low.
    """

    first: int = 0
    every: int = 1
    lost: int = 0

    def of(self, frame: int) -> int:
        """Return the place of a frame in its recording."""
        return self.first + self.every * frame


def numbering_in(folder: Path) -> Numbering:
    """Return the numbering of the frames of a folder, by its run.json if there is one.

    Raises:
        InputError: the file cannot be read, or is not such a record.
    """
    path = folder / RECORD
    if not path.is_file():
        return Numbering()
    record = read_record(path)
    said = record.values("input_settings")  # those of another version may have other names
    try:
        used = InputSettings(**{name: said[name] for name in ("start", "every") if name in said})
        place = used.first
    except SettingsError as error:
        raise InputError(f"{path}: {error}") from None
    each = (record.inputs or {}).get("right")
    rate = Fraction(each.frame_rate) if each and each.frame_rate else None
    sides = (record.counts.left, record.counts.right) if record.counts else ()
    lost = sum((side or {}).get(name) or 0 for side in sides for name in ("unpaired", "damaged"))
    return Numbering(place_near(place, rate), used.every, lost)


class Maps:
    """The disparity or depth images of a folder, by frame number.

    16-bit PNG: disparity in 1/256 px (KITTI) or depth in mm (REP 118), or the unit in the
    run.json beside it, 0 = unknown. PFM, float32 TIFF and NPY: disparity in px or depth in
    m; unknown where not positive or not finite. Frames are numbered as
    :func:`~motionstereo_cli.files.maps.numbered_files` says.

    Args:
        folder: what ``run`` or ``simulate`` wrote, with folders of disparity (preferred) or depth
            in it; or a folder of images.
        within: a folder that no link to an image may lead out of; None: links may lead anywhere.
        kind: ``disparity`` or ``depth``; if None, by the prefix of the folder's name (disp, depth).
        per_m: units per m of depth PNG; 0: as a run.json says, else mm.

    Attributes:
        kind: ``disparity`` or ``depth``.
        files: the images by frame number, in order.
        rig: the rig in a rig.yaml or run.json beside them, None if there is none.
        reference: the camera whose view they are in, ``right`` or ``left``, by the folder's name
            (such as disparity_left) or what lies beside it; None if unknown.

    Raises:
        InputError: there is no such folder or no image in it, or its kind or the frame numbers
            cannot be determined.
    """

    def __init__(
        self, folder: Path, kind: str | None = None, within: Path | None = None, per_m: int = 0
    ) -> None:
        self._within = within
        inside = [
            name for name in _FOLDERS if name.startswith(kind or "") and (folder / name).is_dir()
        ]
        if inside:
            images, home = folder / inside[0], folder
            kind = _kind_by_name(images)
        else:
            named = _kind_by_name(folder)
            images, home = folder, real(folder).parent if named else folder
            kind = kind or named
        self.files = numbered_files(images, SUFFIXES)
        if kind is None:
            raise InputError(
                f"{folder}: its name does not tell whether it holds disparity or depth: "
                "give --out-kind or --truth-kind"
            )
        self.kind = kind
        self._home = home
        self.rig, reference, said_per_m = _said_in(home)
        name = real(images).name.lower()
        kitti = "left" if _KITTI_LEFT.fullmatch(name) else None
        self.reference = side_of(name) or kitti or reference
        self._png_per_unit = DISPARITY_PER_PX if kind == "disparity" else per_m or said_per_m

    @functools.cached_property
    def numbering(self) -> Numbering:
        """Which images of their recording the frames are, by a run.json beside them.

        Raises:
            InputError: as of :func:`numbering_in`.
        """
        return numbering_in(self._home)

    def read(self, number: int) -> Real:
        """Return a frame's disparity in px or depth in m, (height, width) float32, NaN = unknown.

        Raises:
            InputError: the file cannot be read, or its pixels have the wrong format.
        """
        path = self.files[number]
        try:
            image = read_map(path, within=self._within).values
        except DamagedImageError as error:
            raise _unreadable(path, error) from error
        wanted = np.uint16 if path.suffix.lower() == ".png" else np.float32
        if image.ndim != 2 or image.dtype != wanted:
            raise InputError(
                f"{path} is not a 16-bit grey PNG, a one-channel PFM, or a TIFF or NPY of "
                "floating-point numbers: convert it"
            )
        values = image.astype(np.float32)
        if wanted is np.uint16:
            values /= self._png_per_unit
        return np.where((values > 0) & np.isfinite(values), values, np.float32(np.nan))


def _kind_by_name(folder: Path) -> str | None:
    name = real(folder).name.lower()
    return next((kind for start, kind in _NAMED.items() if name.startswith(start)), None)


def _said_in(folder: Path) -> tuple[Rig | None, str | None, int]:
    """Return rig, reference camera and units of depth PNG per m, from the files of a folder."""
    rig = read_rig(folder / "rig.yaml") if (folder / "rig.yaml").is_file() else None
    path = folder / RECORD
    if not path.is_file():
        return rig, "right" if rig else None, OutputSettings().depth_scale  # simulate's truth
    record = read_record(path)
    per_m = record.values("output_settings").get("depth_scale", OutputSettings().depth_scale)
    reference = record.values("settings").get("reference")
    return rig or record.camera, None if reference is None else str(reference), int(per_m)


def _unreadable(path: Path, error: DamagedImageError) -> InputError:
    return InputError(f"{path} cannot be read as an image ({error}): write it again")


def read_pixels(path: Path) -> NDArray[Any]:
    """Return an image as it is stored, (height, width) or (height, width, channels).

    Raises:
        InputError: it cannot be read.
    """
    try:
        return read_still(path).pixels
    except DamagedImageError as error:
        raise _unreadable(path, error) from error


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Return where an image is not 0, (height, width) bool."""
    mask = read_pixels(path)
    return np.asarray(mask != 0 if mask.ndim == 2 else mask[..., :3].any(axis=2))


def size_of(image: NDArray[Any]) -> str:
    """Return the size of an image in words."""
    return f"{image.shape[1]}x{image.shape[0]}"


class Table:
    """A CSV table that ``run`` wrote: a row for each frame, or for each frame and id.

    Iterating yields the number of the frame and the cells by column of each row. The file is read
    row by row, so that memory does not grow with its size.

    Args:
        path: the file.
        part: it may be cut off: an incomplete last line is dropped.

    Attributes:
        columns: names, in order.

    Raises:
        InputError: it cannot be read, has an unnamed column, two columns of one name, no column
            ``frame``, or a row of another length; while iterating, too.
    """

    def __init__(self, path: Path, *, part: bool = False) -> None:
        self.path = path
        self._part = part
        self.columns = tuple(next(self._cells(), ()))
        if "frame" not in self.columns or len(set(self.columns)) < len(self.columns):
            raise InputError(f"{path} is no table of a run: its first line has to name each column")

    def __iter__(self) -> Iterator[tuple[int, dict[str, str]]]:
        path, columns = self.path, self.columns
        for number, cells in enumerate(itertools.islice(self._cells(), 1, None), 2):
            if len(cells) != len(columns):
                raise InputError(
                    f"{path} row {number} has {len(cells)} cells and not {len(columns)}: write it "
                    "again"
                )
            row = dict(zip(columns, cells, strict=True))
            try:
                frame = int(row["frame"])
            except ValueError:
                raise InputError(
                    f"{path} row {number}: {shortened(row['frame'])} is no frame number: write it "
                    "again"
                ) from None
            yield frame, row

    def by_frame(self) -> Iterator[tuple[int, dict[str, dict[str, str]]]]:
        """Yield the number of each frame, and its rows by their id, empty without such a column.

        Raises:
            InputError: frames are not in order, or two rows are of the same frame and id.
        """
        last = -math.inf
        for frame, group in itertools.groupby(self, lambda each: each[0]):
            if frame < last:
                raise InputError(
                    f"{self.path}: frame {frame} comes after frame {last}: write it again"
                )
            rows: dict[str, dict[str, str]] = {}
            for _, row in group:
                if row.get("id", "") in rows:
                    raise InputError(f"{self.path}: frame {frame} comes twice: write it again")
                rows[row.get("id", "")] = row
            yield frame, rows
            last = frame

    def _cells(self) -> Iterator[list[str]]:
        try:
            yield from csv.reader(lines_of_table(self.path, part=self._part), strict=True)
        except csv.Error as error:
            raise InputError(f"cannot read the table {self.path}: {error}") from error


def lines_of_table(path: Path, *, part: bool = False) -> Iterator[str]:
    """Yield the lines of a table of a run; no link may lead out of its folder.

    Raises:
        InputError: see :func:`~motionstereo_cli.files.reading.read_lines`.
    """
    return read_lines(path, "the table", path.parent, part=part)


def read_record(path: Path) -> RunRecord:
    """Return a run's record.

    Raises:
        InputError: the file cannot be read, or is not such a record.
    """
    return typed(read_json(path, within=path.parent), RunRecord, path)


def shortened(value: object) -> str:
    """Return a value for a message: at most 60 characters of ASCII, then ``...``."""
    text = ascii(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
