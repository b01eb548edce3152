"""Calibration files, rectification, and poses.

Only :mod:`~motionstereo_cli.rig.calibration` imports heavy modules; rig files need none.
"""

from motionstereo_cli.rig.rig_file import format_rig, read_rig, rig_values, write_rig

__all__ = ["format_rig", "read_rig", "rig_values", "write_rig"]
