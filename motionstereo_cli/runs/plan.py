"""What a run is to do, as data."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from motionstereo_cli.errors import SettingsError
from motionstereo_cli.files.targets import is_stream
from motionstereo_cli.method.settings import GIVEN, ONNX, Settings
from motionstereo_cli.params import idle, near_match
from motionstereo_cli.rig.settings import NO_RIG, PoseSettings, RigSettings
from motionstereo_cli.sinks.outputs import DEFAULT_OUTPUTS, OUTPUTS, available
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sources.settings import InputSettings

#: Names of standard input and output. Files of that name are ``./-``.
_STANDARD = "-"
#: Value for poses that are found from the recording itself. A file of that name is ``./auto``.
AUTO_POSES = "auto"


@dataclass(frozen=True, slots=True)
class RunPlan:
    """All that a run depends on: paths and options, which can be sent to another process.

    Attributes:
        left: a video file, a folder of images, a pattern of images, or ``-`` for standard input.
        right: the same for the right view; None if ``left`` holds both.
        out: folder for the results; ``-`` writes only the steering table, to standard output.
        rig: calibration files, in any format that ``--rig`` takes; none: no lengths, no angles.
        rig_settings: how to understand the calibration.
        poses: a file of poses, or ``auto``: found from the recording itself, which needs a
            calibration, from ``rig`` or a bag.
        pose_settings: how to understand the poses.
        disparity: folder with a map of disparity for each image, which takes the place of the
            matching; the matcher of the settings is then ``given``.
        save: names of the outputs in ``out``, from :data:`~motionstereo_cli.sinks.outputs.OUTPUTS`.
        table: a further place for the steering table; ``-`` is standard output, row by row.
        overwrite: replace the results of an earlier run in ``out``, and a file ``table``.
        resume: continue where the same run ended in ``out``, or begin it.
        jobs: frames matched at a time; results do not depend on it. None: the number of cores,
            1 with a pipe.
        with_check: check the first frames for mistakes.
        settings, input_settings, output_settings: parameters of processing, input and output.
        reads: further files that the plan was made from, which must not be written to.
        measured: names of the parameters that were measured before the first frame.

    Raises:
        SettingsError: two of the options contradict each other, or an output has no such name.
    """

    left: str
    right: str | None = None
    out: Path = Path("motionstereo_out")
    rig: tuple[Path, ...] = ()
    rig_settings: RigSettings = field(default_factory=RigSettings)
    poses: Path | None = None
    pose_settings: PoseSettings = field(default_factory=PoseSettings)
    disparity: Path | None = None
    save: tuple[str, ...] = ()
    table: Path | None = None
    overwrite: bool = False
    resume: bool = False
    jobs: int | None = None
    with_check: bool = True
    settings: Settings = field(default_factory=Settings)
    input_settings: InputSettings = field(default_factory=InputSettings)
    output_settings: OutputSettings = field(default_factory=OutputSettings)
    reads: tuple[Path, ...] = ()
    measured: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "out", Path(self.out))
        for name in ("rig", "reads"):
            object.__setattr__(self, name, tuple(map(Path, getattr(self, name))))
        for name in ("poses", "table", "disparity"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, Path(getattr(self, name)))
        if self.disparity is not None:
            settings = dataclasses.replace(self.settings, matcher=GIVEN)
            object.__setattr__(self, "settings", settings)
        clashes = {
            f"--matcher {GIVEN} needs --disparity": (
                self.settings.matcher == GIVEN and self.disparity is None
            ),
            "-o - writes only the steering table: leave --save and --csv out": (
                self.folder is None and (self.save or self.table)
            ),
            "--resume goes on, --overwrite starts again: give one of them": (
                self.resume and self.overwrite
            ),
            "--resume cannot go on with a table on standard output: give a file": (
                self.resume and self.to_stdout
            ),
            f"--resume cannot go on with a table in {self.table}: give a file": (
                self.resume and self.table and is_stream(self.table)
            ),
            "--resume cannot read a pipe again: give files": self.resume and self.from_pipe,
            f"--jobs cannot be {self.jobs}: give 1 or more": (
                self.jobs is not None and self.jobs < 1
            ),
        }
        for message, given in clashes.items():
            if given:
                raise SettingsError(message)
        for name in self.save:
            if name not in OUTPUTS:
                advice = near_match(name, OUTPUTS) or f": choose from {', '.join(OUTPUTS)}"
                raise SettingsError(f"--save knows no {name!r}{advice}")

    def as_json(self) -> dict[str, Any]:
        """Return the plan as JSON-able values, for another process."""
        import msgspec  # which takes time, and only a batch asks

        values: dict[str, Any] = msgspec.to_builtins(self, enc_hook=str)
        return values

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> RunPlan:
        """Return the plan that :meth:`as_json` gave.

        Raises:
            SettingsError: a value is out of range, or two contradict each other.
        """
        import msgspec

        return msgspec.convert(values, cls, dec_hook=lambda path, text: path(text))

    def with_measured(self, group: str, values: Mapping[str, Any]) -> RunPlan:
        """Return the plan with measured values of the parameters of a group."""
        before = getattr(self, group)
        new = {name for name, value in values.items() if getattr(before, name) != value}
        return dataclasses.replace(
            self,
            **{group: dataclasses.replace(before, **values)},
            measured=tuple(sorted({*self.measured, *new})),
        )

    @property
    def folder(self) -> Path | None:
        """The output folder; None where there is only a table on standard output."""
        return None if str(self.out) == _STANDARD else self.out

    @property
    def poses_file(self) -> Path | None:
        """The file of poses, if there is one."""
        return None if str(self.poses) == AUTO_POSES else self.poses

    @property
    def outputs(self) -> tuple[str, ...]:
        """The outputs to write into the folder."""
        return () if self.folder is None else self.save or DEFAULT_OUTPUTS

    def idle(self, *, rig: bool = True) -> list[str]:
        """Return a sentence for each option that is given, but has no effect.

        Args:
            rig: whether the rig is known.
        """
        conditions = {
            "--rig": rig,
            "--poses": self.poses,
            "--poses FILE": self.poses_file,
            "--disparity": self.disparity,
            "-o FOLDER": self.folder,
            "--save steering": self.to_stdout or self.table,
        }
        present = {f"--save {name}" for name in available(self.outputs, rig=rig)}
        present |= {option for option, there in conditions.items() if there}
        groups = self.settings, self.input_settings, self.output_settings, self.rig_settings
        return _idle(self.settings, (*groups, self.pose_settings), frozenset(present))

    @property
    def to_stdout(self) -> bool:
        """Whether the steering table goes to standard output."""
        return self.folder is None or str(self.table) == _STANDARD

    @property
    def from_pipe(self) -> bool:
        """Whether a recording comes from standard input or a FIFO."""
        return any(
            name == _STANDARD or is_stream(Path(name)) for name in (self.left, self.right) if name
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        """What is read besides the plan itself, as it was given."""
        poses = self.poses_file and str(self.poses_file)
        rig = (str(path) for path in self.rig if path != NO_RIG)
        model = self.settings.matcher.partition(ONNX)[2]
        disparity = self.disparity and str(self.disparity)
        named = (self.left, self.right, *rig, poses, disparity, model)
        return tuple(name for name in named if name)

    @property
    def options(self) -> list[str]:
        """The options besides parameters and outputs, as words."""
        words = [word for path in self.rig for word in ("--rig", str(path))]
        for flag, path in (("--poses", self.poses), ("--disparity", self.disparity)):
            words += [flag, str(path)] if path else []
        return words


@functools.lru_cache(64)  # most recordings of a batch have the same
def _idle(settings: Settings, groups: tuple[Any, ...], present: frozenset[str]) -> list[str]:
    return [line for group in groups for line in idle(group, settings.options | present)]
