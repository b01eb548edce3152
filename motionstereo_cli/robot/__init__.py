"""Robot functions on top of depth: own motion, moving objects, heading, maps.

The pure files use arrays and numbers only; :mod:`~motionstereo_cli.robot.tracker`,
:mod:`~motionstereo_cli.robot.guide` and :mod:`~motionstereo_cli.robot.mapper` combine them and keep
state from frame to frame.
"""
