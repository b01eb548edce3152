"""The camera: its calibration files, and rectification.

Heavy modules load only with :mod:`~motionstereo_cli.rig.calibration`; rig files need none.
"""

from motionstereo_cli.rig.rig_file import format_rig, read_rig, rig_values, write_rig

__all__ = ["format_rig", "read_rig", "rig_values", "write_rig"]
