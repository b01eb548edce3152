"""What a worker is given: one recording, a piece of one, or pieces to be joined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from motionstereo_cli.batch.pieces import Piece


@dataclass(frozen=True, slots=True)
class Storage:
    """What part of a batch lies in an object store.

    Attributes:
        address: where the results go; None = they stay in the folder of the batch.
        fetch_bytes: maximum size of what is fetched of one recording's inputs.
    """

    address: str | None = None
    fetch_bytes: int = 0


#: All lies on this machine's disk.
LOCAL = Storage()


@dataclass(frozen=True, slots=True)
class Task:
    """A task of a batch.

    Attributes:
        plan: as :meth:`~motionstereo_cli.runs.plan.RunPlan.as_json` gives it.
        plan_hash: hash by which statuses refer to the plan of the whole recording.
        out: folder of the batch.
        name: name of the recording.
        storage: what does not lie on this machine's disk.
        piece: the piece to process; None = the whole recording.
        pieces: all pieces, to be joined; None = not in pieces.
        seek: whether a piece may begin by seeking.
        tell_s: minimum time between two reports of progress, in s.
        submitted_s: when it was given out, in s since 1970.
    """

    plan: Mapping[str, Any]
    plan_hash: str
    out: Path
    name: str
    storage: Storage = LOCAL
    piece: Piece | None = None
    pieces: tuple[Piece, ...] | None = None
    seek: bool = True
    tell_s: float = 0.5
    submitted_s: float = 0.0

    @property
    def folder(self) -> Path:
        """Folder of the recording's results."""
        return self.out / self.name
