"""Robot functions on top of depth: own motion, moving objects, heading, maps.

The pure files use arrays and numbers only; :mod:`~motionstereo_cli.robot.tracker`,
:mod:`~motionstereo_cli.robot.guide` and :mod:`~motionstereo_cli.robot.mapper` combine them and keep
state from frame to frame. Attributes of this package are its modules, each loaded when it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from motionstereo_cli.robot import mover_finder, movers, odometer, odometry

__all__ = ["mover_finder", "movers", "odometer", "odometry"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.{name}")
