"""What a robot makes of depth: moving objects, a heading, maps.

The pure files know arrays and numbers only; :mod:`~motionstereo_cli.robot.tracker`,
:mod:`~motionstereo_cli.robot.guide` and :mod:`~motionstereo_cli.robot.mapper` join them and keep
state from frame to frame.
"""
