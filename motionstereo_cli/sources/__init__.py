"""Where frames come from.

The parameters are light (:mod:`~motionstereo_cli.sources.settings`); what decodes loads when used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from motionstereo_cli.sources.opening import open_stereo
    from motionstereo_cli.sources.stereo import StereoSource

__all__ = ["StereoSource", "open_stereo"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from motionstereo_cli.sources import opening

    return getattr(opening, name)
