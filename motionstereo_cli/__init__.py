"""Depth and steering from what moves in two stereo videos."""

__version__ = "0.1.0"
