"""The records of runs and batches: run.json, and the status of recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from msgspec import UNSET, Meta, Struct, UnsetType

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.files.records import Record
from motionstereo_cli.method.settings import Settings
from motionstereo_cli.params import params
from motionstereo_cli.rig.settings import PoseSettings, RigSettings
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sources.settings import InputSettings
from motionstereo_cli.types import Rig

#: Limits: frames of a year, and px of an image's side.
Count = Annotated[int, Meta(ge=0, le=1_000_000_000)]
Px = Annotated[int, Meta(ge=1, le=1_000_000)]
Share = Annotated[float, Meta(ge=0, le=1)]
Positive = Annotated[float, Meta(gt=0)]
Seconds = Annotated[float, Meta(ge=0, le=1e12)]
Ratio = Annotated[str, Meta(pattern=r"^\d{1,18}(/[1-9]\d{0,17})?$")]
#: A path under a folder; no system allows longer ones.
Name = Annotated[str, Meta(min_length=1, max_length=4096, pattern=r"^[^\x00]*$")]
Plain = bool | int | float | str

#: The parameters of a run by their field in its record.
GROUPS: Mapping[str, type] = {
    "input_settings": InputSettings,
    "settings": Settings,
    "output_settings": OutputSettings,
    "rig_settings": RigSettings,
    "pose_settings": PoseSettings,
}


def option_of(name: str) -> str:
    """Return the option that sets a value of a record, such as ``settings.bands``, or its name."""
    group, _, field_name = name.partition(".")
    known = params(GROUPS[group]) if group in GROUPS else ()
    return next((item.flag for item in known if item.name == field_name), name)


class OutputRecord(Struct, frozen=True):
    """An output: its first file, and its content."""

    path: str
    what: str = ""


class Counts(Struct, kw_only=True, frozen=True):
    """Numbers of frames: written, skipped by options, and images of each side."""

    written: Count
    skipped: Count | UnsetType = UNSET
    left: dict[str, Count | None] | UnsetType = UNSET
    right: dict[str, Count | None] | UnsetType = UNSET


class FolderRecord(Record, kw_only=True, frozen=True):
    """The fields of every record of an output folder.

    Attributes:
        program: the program that wrote the folder.
        outputs: its contents, by name.
        first: number of the first frame, 0 if not set.
        counts: set when the run is complete.
    """

    program: str = ""
    outputs: Mapping[str, OutputRecord | None] | tuple[str, ...] | UnsetType = UNSET
    first: Count | UnsetType = UNSET
    counts: Counts | UnsetType = UNSET


class InputRecord(Struct, kw_only=True, frozen=True):
    """A recording, as :meth:`~motionstereo_cli.sources.StereoSource.describe` returns it."""

    path: Name
    topic: str | UnsetType = UNSET
    track: Count | UnsetType = UNSET
    kind: str | UnsetType = UNSET
    codec: str | UnsetType = UNSET
    pixel_format: str | UnsetType = UNSET
    range: str | UnsetType = UNSET
    rotation_deg: int | UnsetType = UNSET
    width: Px | UnsetType = UNSET
    height: Px | UnsetType = UNSET
    frame_rate: Ratio | UnsetType | None = UNSET
    images: Count | UnsetType | None = UNSET
    camera_info: bool | UnsetType = UNSET
    bytes: Annotated[int, Meta(ge=0)] | UnsetType = UNSET
    sha256: str | UnsetType = UNSET
    times_sha256: str | UnsetType = UNSET
    serial_number: str | UnsetType = UNSET
    files: Count | UnsetType = UNSET
    created: str | UnsetType = UNSET
    timecode: str | UnsetType = UNSET
    view: str | UnsetType = UNSET
    projection: str | UnsetType = UNSET


class FileRecord(Struct, frozen=True):
    """A further file that the results depend on."""

    path: str
    sha256: str


class RigRecord(Struct, kw_only=True, frozen=True):
    """A :class:`~motionstereo_cli.types.Rig`."""

    width: Px
    height: Px
    focal_px: Positive
    baseline_m: Positive
    cx: float
    cy: float
    doffs: float = 0.0
    focal_y_px: Positive | UnsetType | None = UNSET


class Shares(Struct, frozen=True):
    """Mean shares of the image with charge, with a disparity, and at the limit of the range."""

    charged: Share
    matched: Share
    at_limit: Share = 0.0


class Timing(Struct, frozen=True):
    """How long a run took."""

    wall_s: Seconds
    frames_per_second: Annotated[float, Meta(ge=0)] | UnsetType = UNSET


class SumRecord(Struct, frozen=True):
    """Size and SHA-256 of an output's files."""

    bytes: Annotated[int, Meta(ge=0)]
    sha256: str


class WarningRecord(Struct, frozen=True):
    """A warning of a run.

    Attributes:
        code: identifier for programs: the name of a finding of ``check``, or of its subject.
        text: what, how much, and what to do, in one line.
        numbers: what was measured, by name.
    """

    code: str
    text: str
    numbers: dict[str, int | float] = {}


class RunRecord(FolderRecord, kw_only=True, frozen=True):
    """``run.json``: a run's identity and, once it is complete, its outcome.

    Raises:
        ValueError: a setting is of another kind or out of range.
    """

    outputs: Mapping[str, OutputRecord | None] | UnsetType = UNSET
    table: str | UnsetType = UNSET
    versions: dict[str, str] | UnsetType = UNSET
    settings: dict[str, Plain] | UnsetType = UNSET
    input_settings: dict[str, Plain] | UnsetType = UNSET
    output_settings: dict[str, Plain] | UnsetType = UNSET
    rig_settings: dict[str, Plain] | UnsetType = UNSET
    pose_settings: dict[str, Plain] | UnsetType = UNSET
    inputs: dict[str, InputRecord] | UnsetType = UNSET
    files: list[FileRecord] | UnsetType = UNSET
    rig: RigRecord | UnsetType | None = UNSET
    time_base: Ratio | UnsetType | None = UNSET
    grey: str | UnsetType = UNSET
    poses: str | UnsetType = UNSET
    motion_offset_px: float | UnsetType = UNSET
    options: list[str] | UnsetType = UNSET
    measured: list[str] | UnsetType = UNSET
    shares: Shares | UnsetType = UNSET
    warnings: list[WarningRecord | str] | UnsetType = UNSET
    damage: list[str] | UnsetType = UNSET
    timing: Timing | UnsetType = UNSET
    sums: dict[str, SumRecord] | UnsetType = UNSET

    def __post_init__(self) -> None:
        for group, kind in GROUPS.items():
            values = getattr(self, group) or {}
            for item in params(kind):
                try:
                    if item.name in values:
                        item.parse(values[item.name])
                except SettingsError as error:
                    said = str(error).replace(item.flag, f"{group}.{item.name}", 1)
                    raise ValueError(said) from None

    def values(self, group: str) -> Mapping[str, Any]:
        """Return the recorded settings of a group of :data:`GROUPS`."""
        return getattr(self, group) or {}

    @property
    def warned(self) -> tuple[WarningRecord, ...]:
        """The warnings; those of earlier versions have only a text."""
        each = self.warnings or ()
        return tuple(WarningRecord("recording", w) if isinstance(w, str) else w for w in each)

    @property
    def camera(self) -> Rig | None:
        """The rig, None where none is recorded."""
        if not self.rig:
            return None
        values = {name: getattr(self.rig, name) for name in self.rig.__struct_fields__}
        return Rig(**values | {"focal_y_px": self.rig.focal_y_px or None})


class Status(Record, frozen=True):
    """Status of a recording: a file, and a row in the table of its batch.

    Attributes:
        name: its folder under that of the batch.
        status: ``done``; ``damaged``: done, with damaged input; ``failed``; ``lost``: its worker
            died; ``interrupted``; ``running``; ``waiting``.
        frames: frames processed.
        seconds: processing time in s.
        charged, matched: mean shares of the image, 0..1, with charge and with a disparity.
        damage: number of losses of input.
        warnings: number of warnings.
        said: losses and warnings, in words.
        reason: why it failed, in one line.
        worker: the worker that processed it.
        plan: hash of its plan.
    """

    name: Name
    status: str = "waiting"
    frames: Count = 0
    seconds: Seconds = 0.0
    charged: Share | None = None
    matched: Share | None = None
    damage: Count = 0
    warnings: Count = 0
    said: str = ""
    reason: str = ""
    worker: str = ""
    plan: str = ""
