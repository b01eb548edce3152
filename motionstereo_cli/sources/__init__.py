"""Where frames come from."""

from motionstereo_cli.sources.stereo import StereoSource, open_stereo

__all__ = ["StereoSource", "open_stereo"]
