"""Finds movers: what moves by itself while the rig moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from motionstereo_cli.robot.movers import Moment, Movers, ReferenceCamera, pyramid, see
from motionstereo_cli.types import Rig

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from motionstereo_cli.robot.odometry import Motion
    from motionstereo_cli.types import Grey, Real


@dataclass(frozen=True, slots=True)
class MoverFinder:
    """Finds what moves by itself.

    Args:
        rig: the camera.
        reference: whose view it is, ``right`` or ``left``.
        max_disparity: largest disparity in px.
    """

    rig: Rig
    reference: str
    max_disparity: int

    def see(
        self,
        movers: Movers | None,
        right: Grey,
        left: Grey,
        disparity_px: Real,
        motion: Motion | None,
        changed: NDArray[np.bool_] | None,
        time_s: float,
    ) -> tuple[Movers, NDArray[np.bool_], Real]:
        """Return the state after a frame, where something moved by itself, and how fast.

        See :func:`~motionstereo_cli.robot.movers.see`. For a rig at rest it is all that changed.

        Args:
            movers: the state before; None at the first frame.
            right, left: the views, (height, width) uint8.
            disparity_px: of the reference view, NaN = unknown.
            motion: of the rig, from this frame to the one before; None where unknown.
            changed: where the band of grey has changed in the reference view.
            time_s: time of the frame.
        """
        if motion is None:  # there is no earlier frame to compare with
            movers, step = None, np.eye(4)
        else:
            step = self._of_reference(motion.before_from_now)
        view, other = (right, left) if self.reference == "right" else (left, right)
        now = Moment(pyramid(view, other), disparity_px, step, time_s)
        after, found, velocity_mps = see(movers or Movers(), now, self.camera)
        if stands(motion) and changed is not None:
            found = changed
        return after, found, velocity_mps

    @property
    def camera(self) -> ReferenceCamera:
        """The reference camera."""
        rig, right = self.rig, self.reference == "right"
        return ReferenceCamera(
            focal_px=(rig.focal_px, rig.fy_px),
            cx_px=rig.cx_of(self.reference),
            cy_px=rig.cy,
            other_cx_px=rig.cx_of("left" if right else "right"),
            side=1 if right else -1,
            focal_baseline=rig.focal_baseline,
            doffs_px=rig.doffs,
            range_px=self.max_disparity,
        )

    def _of_reference(self, motion: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a motion of the right camera as one of the reference camera."""
        if self.reference == "right":
            return motion
        aside = np.eye(4)
        aside[0, 3] = self.rig.baseline_m
        back = np.eye(4)
        back[0, 3] = -self.rig.baseline_m
        return aside @ motion @ back


def stands(motion: Motion | None) -> bool:
    """Return whether a motion is known to be none."""
    return motion is not None and bool(np.array_equal(motion.before_from_now, np.eye(4)))
