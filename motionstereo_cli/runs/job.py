"""A plan whose input is open, and what was warned of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from motionstereo_cli.check.findings import Finding
from motionstereo_cli.pipeline import StreamContext
from motionstereo_cli.runs.cores import frames_at_once
from motionstereo_cli.runs.plan import RunPlan
from motionstereo_cli.sinks.outputs import OUTPUTS, available
from motionstereo_cli.sinks.records import WarningRecord
from motionstereo_cli.sinks.sink import RunContext
from motionstereo_cli.sources import StereoSource
from motionstereo_cli.types import FrameTime, Pose, Say, StereoFrame

if TYPE_CHECKING:
    from motionstereo_cli.rig.poses import Trajectory


class Warned:
    """The warnings of a run: shown at once, and kept for its record.

    Args:
        say: called with a kind, ``note`` or ``warning``, and a line.
    """

    def __init__(self, say: Say) -> None:
        self._say = say
        self._found: list[WarningRecord] = []
        self._opening: list[WarningRecord] = []
        self._before = 0

    @property
    def found(self) -> tuple[WarningRecord, ...]:
        """The warnings so far: those before the first frame, of its check, and later ones."""
        later = self._found[self._before :]
        return (*self._found[: self._before], *self._opening, *later)

    def begin(self) -> None:
        """Note that frames begin. Findings come from a thread, sooner or later than others."""
        self._before = len(self._found)

    def warn(self, code: str, text: str, numbers: Mapping[str, int | float] | None = None) -> None:
        """Show and keep a warning, see :class:`~motionstereo_cli.sinks.records.WarningRecord`."""
        self._found.append(WarningRecord(code, text, dict(numbers or {})))
        self._say("warning", text)

    def say(self, code: str, kind: str, text: str) -> None:
        """Show a line, and keep it if it is a warning."""
        if kind == "warning":
            self.warn(code, text)
        else:
            self._say(kind, text)

    def warn_of(self, findings: Iterable[Finding]) -> None:
        """Show and keep the findings of a check."""
        for finding in findings:
            self._opening.append(WarningRecord(finding.name, finding.text, dict(finding.numbers)))
            self._say("warning", finding.text)


@dataclasses.dataclass(frozen=True, slots=True)
class Job:
    """A plan whose input is open.

    Attributes:
        plan: with a range of disparities that is a number.
        source: the input, which rectifies.
        frames: all frames of the source.
        context: what the outputs need.
        poses: poses of the rig; None if unknown.
        warned: the warnings so far.
        motion_offset_px: constant added to disparity for finding own motion.
    """

    plan: RunPlan
    source: StereoSource
    frames: Iterable[StereoFrame]
    context: RunContext
    poses: Trajectory | None
    warned: Warned
    motion_offset_px: float = 0.0

    @property
    def save(self) -> tuple[str, ...]:
        """The outputs, with substitutes for those that need a missing rig."""
        return available(
            self.plan.outputs,
            rig=self.context.rig is not None,
            steering_format=self.context.output.steering_format,
        )

    @property
    def frames_at_once(self) -> int:
        """How many frames are matched at the same time."""
        if self.plan.jobs or not self.source.rereadable:
            return self.plan.jobs or 1
        return frames_at_once(self.source.width, self.source.height)

    def pose_of(self, frame: StereoFrame | FrameTime) -> Pose | None:
        """Return the pose of the rig; None if it is unknown or to be found.

        Raises:
            InputError: the poses do not cover the frame.
        """
        return None if self.poses is None else self.poses.of(frame)

    def warn_of(self, findings: Iterable[Finding]) -> None:
        """Warn of what a check found, but not of stillness where what stands still has depth."""
        still = "still" if self.plan.settings.depth_of == "all" else ""
        self.warned.warn_of(each for each in findings if each.name != still)

    @property
    def with_own_motion(self) -> bool:
        """Whether the rig's own motion is found: for poses that are not given, or for movers."""
        rows = [OUTPUTS[name] for name in self.save]
        asked = self.plan.poses is not None or any(row.needs_poses for row in rows)
        asked = (asked and self.poses is None) or any(row.needs_movers for row in rows)
        return asked and self.context.rig is not None

    @property
    def stream(self) -> StreamContext:
        """What the processing has to find for the outputs."""
        rows = [OUTPUTS[name] for name in self.save]
        return StreamContext.of(
            self.plan.settings,
            self.context.rig,
            with_poses=self.plan.poses is not None,
            with_objects=any(row.needs_objects for row in rows),
            poses_are_given=self.poses is not None,
            with_own_motion=self.with_own_motion,
            with_movers=self.with_own_motion and any(row.needs_movers for row in rows),
            motion_offset_px=self.motion_offset_px,
            extras={extra for row in rows for extra in row.extras},
            with_points=any(row.needs_points for row in rows),
        )
