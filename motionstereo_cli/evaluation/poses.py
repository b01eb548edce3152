"""Poses against the truth: how far a path drifts, and how far it is off."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from motionstereo_cli.errors import InputError
from motionstereo_cli.rig.pose_forms import rotations
from motionstereo_cli.rig.poses import read_poses
from motionstereo_cli.rig.settings import PoseSettings
from motionstereo_cli.types import Pose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reals = NDArray[np.float64]

#: Lengths of path, in m, over which drift is measured.
LENGTHS_M = (5, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100)


#: Limit of poses, each of which takes some kB: an hour at 80 in a second.
_MAX_POSES = 300_000


@dataclass(frozen=True, slots=True)
class PoseReport:
    """What was measured.

    Attributes:
        NOTHING: why a number is NaN.
        poses: found poses that have a true one.
        way_m: length of the true path.
        drift_percent: error of place at the end of each stretch of :data:`LENGTHS_M`, as a share of
            its length, mean over all stretches that begin at a pose (KITTI); NaN where none fits.
        drift_deg_per_m: error of turn, likewise.
        ate_m: root mean square distance of places, once the path is moved and turned to fit best.
        step_m, step_deg: root mean square error of the motion from pose to pose.
        end_m: distance of the ends, once the beginnings agree.
        without_truth: found poses that have no true one.
    """

    NOTHING: ClassVar[str] = f"the true path is shorter than {LENGTHS_M[0]} m"

    poses: int
    way_m: float
    drift_percent: float
    drift_deg_per_m: float
    ate_m: float
    step_m: float
    step_deg: float
    end_m: float
    without_truth: int = field(default=0, kw_only=True)


def evaluate_poses(found: str | Path, true: str | Path) -> PoseReport:
    """Compare two files of poses, which are of the same frame of the same rig.

    Poses are matched by time, or by number where a file has no times; truth between two poses is on
    the straight line.

    Args:
        found: a file in any form that :func:`~motionstereo_cli.rig.poses.read_poses` takes.
        true: the same.

    Raises:
        InputError: one cannot be read, or they have fewer than two poses in common.
    """
    settings = PoseSettings(pose_frame="robot")
    one, other = read_poses(found, settings), read_poses(true, settings)
    if one.by_number != other.by_number:
        raise InputError(
            f"{found} and {true}: only one has times: give both in the same form (run "
            "writes TUM's by --save poses and KITTI's by --save poses-kitti)"
        )
    first, last = float(other.time_s[0]), float(other.time_s[-1])
    for name, path in ((found, one), (true, other)):
        if len(path.time_s) > _MAX_POSES:
            raise InputError(f"{name} has more than {_MAX_POSES} poses: give a part of the path")
    inside = (one.time_s >= first - 1e-6) & (one.time_s <= last + 1e-6)
    truth = [other.at(time) for time in one.time_s[inside].tolist()]
    inside[inside] = [pose is not None for pose in truth]
    if np.count_nonzero(inside) < 2:
        raise InputError(
            f"{found} has fewer than two poses in the time that {true} covers: give the truth of "
            "this recording"
        )
    rows = [[getattr(pose, name) for name in Pose.__slots__] for pose in truth if pose is not None]
    report = compare(matrices(one.poses[inside]), matrices(np.array(rows)))
    return replace(report, without_truth=int(np.count_nonzero(~inside)))


def matrices(poses: Reals) -> Reals:
    """Return poses (n, 7), place in m and quaternion as :class:`Pose` has them, as (n, 4, 4)."""
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = rotations(poses[:, 3:]), poses[:, :3]
    return result


def compare(found: Reals, true: Reals, lost: NDArray[np.bool_] | None = None) -> PoseReport:
    """Compare poses (n, 4, 4) of the same moments, n >= 2; see :class:`PoseReport`.

    Drift is over the stretches within which no pose is ``lost`` (n,), if that is given.
    """
    losses = np.zeros(len(true)) if lost is None else np.cumsum(lost)
    step_m, step_deg = _errors(found[:-1], found[1:], true[:-1], true[1:])
    steps_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1)
    way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    drifts, turns = [], []
    for length_m in LENGTHS_M:
        ends = np.searchsorted(way_m, way_m + length_m)
        starts = np.flatnonzero(ends < len(true))
        ends = ends[starts]
        known = losses[ends] == losses[starts]
        starts, ends = starts[known], ends[known]
        off_m, off_deg = _errors(found[starts], found[ends], true[starts], true[ends])
        drifts.append(off_m / length_m)
        turns.append(off_deg / length_m)
    drift, turn = np.concatenate(drifts), np.concatenate(turns)
    end_m, _ = _errors(found[:1], found[-1:], true[:1], true[-1:])
    return PoseReport(
        poses=len(found),
        way_m=float(way_m[-1]),
        drift_percent=100 * float(drift.mean()) if drift.size else float("nan"),
        drift_deg_per_m=float(turn.mean()) if turn.size else float("nan"),
        ate_m=_ate_m(found[:, :3, 3], true[:, :3, 3]),
        step_m=_rms(step_m),
        step_deg=_rms(step_deg),
        end_m=float(end_m[0]),
    )


def _errors(
    found: Reals, found_after: Reals, true: Reals, true_after: Reals
) -> tuple[Reals, Reals]:
    """Return by how much motions differ: distance in m and turn in degrees."""
    wanted, came = np.linalg.inv(true) @ true_after, np.linalg.inv(found) @ found_after
    off = np.linalg.inv(wanted) @ came
    cos = (np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(np.arccos(cos.clip(-1, 1)))


def _ate_m(found: Reals, true: Reals) -> float:
    """Return the error after the best rigid fit (Horn; Umeyama without scale)."""
    one, other = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(other.T @ one)
    flip = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    return _rms(np.linalg.norm(one @ (u @ flip @ vt).T - other, axis=1))


def _rms(values: Reals) -> float:
    return float(np.sqrt(np.mean(values**2)))
