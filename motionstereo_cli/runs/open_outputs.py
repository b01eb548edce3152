"""The open outputs of a command, handled together."""

from __future__ import annotations

import contextlib
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

from motionstereo_cli.errors import OutputError
from motionstereo_cli.types import Step

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from motionstereo_cli.pipeline import FrameSummary, State
    from motionstereo_cli.sinks.outputs import Input
    from motionstereo_cli.sinks.records import FolderRecord
    from motionstereo_cli.sinks.sink import Sink
    from motionstereo_cli.types import FrameImages


@dataclass(frozen=True, slots=True)
class Totals:
    """Sums over the frames so far.

    Attributes:
        frames: how many there were.
        charged, matched, at_limit: sums of the shares of the image with charge, with a disparity,
            and at the limit of the range.
        blind: how many of them have no heading.
        lost: in how many of them the rig's own motion was sought and is unknown.
        first_lost: first and last frame of the first stretch of these; None without any.
    """

    frames: int = 0
    charged: float = 0.0
    matched: float = 0.0
    at_limit: float = 0.0
    blind: int = 0
    lost: int = 0
    first_lost: tuple[int, int] | None = None

    @property
    def means(self) -> tuple[float, float, float]:
        """Means of the shares: charged, matched, at the limit."""
        count = max(self.frames, 1)
        return self.charged / count, self.matched / count, self.at_limit / count

    def plus(self, shares: Step | FrameSummary) -> Totals:
        """Return the sums with a further frame, of which a piece has no more than the shares."""
        blind, lost, first_lost = self.blind, self.lost, self.first_lost
        if isinstance(shares, Step):
            blind += shares.steering.status == "blind"
            if shares.fix is not None and shares.fix.lost:
                number, lost = shares.time.index, lost + 1
                first, last = first_lost or (number, number - 1)
                first_lost = first, number if last == number - 1 else last
        return Totals(
            self.frames + 1,
            self.charged + shares.charged,
            self.matched + shares.matched,
            self.at_limit + shares.at_limit,
            *(blind, lost, first_lost),
        )


class Ends(Protocol):
    """An output that is closed or abandoned, see :class:`~motionstereo_cli.sinks.sink.Sink`."""

    def close(self) -> None:
        """Complete the output and give it its final name."""

    def abandon(self, *, keep: bool) -> None:
        """End early; keep the results so far, or remove them."""


_Output = TypeVar("_Output", bound=Ends)


class Sinks:
    """Outputs that are completed together or, if the block ends before that, abandoned.

    Attributes:
        state: all that is kept from frame to frame, None before the first.
        totals: sums over the frames so far; at first those that an earlier process did.
        resumed: an earlier process began the same run, which this one continues or repeats.
        finished: the record of an earlier process that completed the run; None if none did.
    """

    def __init__(self) -> None:
        self.state: State | None = None
        self.totals = Totals()
        self.resumed = False
        self.finished: FolderRecord | None = None
        self._marks: Mapping[str, Any] = {}
        self._sinks: dict[str, Sink[Any]] = {}
        self._takes: dict[str, Input] = {}
        self._others: list[Ends] = []
        self._keep = False
        self._complete = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if not self._complete:
            for sink in (*self._sinks.values(), *self._others):
                with contextlib.suppress(OutputError):  # the reason why the block ends matters more
                    sink.abandon(keep=self._keep)

    def add(self, name: str, opened: Callable[[Any], Sink[Any]], takes: Input = "step") -> None:
        """Open an output that takes something of each frame.

        Args:
            name: its name.
            opened: opens it from a checkpoint to continue from; None: from the beginning.
            takes: what it takes, see :class:`~motionstereo_cli.sinks.outputs.Output`.

        Raises:
            OutputError: it cannot be opened, or is not what the checkpoint says.
        """
        mark = self._marks.get(name)
        try:
            self._sinks[name] = opened(mark)
            self._takes[name] = takes
        except (TypeError, ValueError, LookupError, AttributeError) as error:
            if mark is None:
                raise
            raise OutputError(
                f"the checkpoint of {name} makes no sense: --resume cannot go on, give --overwrite"
            ) from error

    def own(self, output: _Output) -> _Output:
        """Take over an output that is written by other means, and return it."""
        self._others.append(output)
        return output

    def write(self, step: Step, state: State | None = None) -> None:
        """Hand a frame to the outputs.

        Args:
            step: that of the frame.
            state: the state after it, for checkpoints.

        Raises:
            OutputError: it cannot be written.
        """
        if step.images is not None:
            self.show(step.images)
        self._hand("step", step)
        self.state, self.totals = state, self.totals.plus(step)

    def show(self, images: FrameImages) -> None:
        """Hand a frame to the outputs that take images.

        Raises:
            OutputError: it cannot be written.
        """
        self._hand("images", images)

    def _hand(self, takes: Input, given: FrameImages | Step) -> None:
        for name, sink in self._sinks.items():
            if self._takes[name] == takes:
                sink.write(given)
        self._keep = True

    def checkpoint(self) -> None:
        """Do nothing: without a folder there are no checkpoints."""

    def end_segments(self) -> None:
        """Begin new segments of videos, with a key frame, once all so far is written."""
        for made in [sink.checkpoint() for sink in self._sinks.values()]:
            if isinstance(made, Future):
                made.result()

    def close(self) -> None:
        """Complete the outputs.

        Raises:
            OutputError: one cannot be completed.
        """
        # At the same time, because each waits for the disk.
        outputs = (*self._sinks.values(), *self._others)
        with ThreadPoolExecutor(max(len(outputs), 1), "close") as threads:
            for closed in [threads.submit(output.close) for output in outputs]:
                closed.result()

    def complete(self, **outcome: Any) -> FolderRecord | None:
        """Complete the run, and return its record, None if none is written.

        Args:
            outcome: the outcome, by the fields of the record.
        """
        self._complete = True
        return None
