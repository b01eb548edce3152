"""Measure a recording: whether its views are in step, rectified and equally bright."""
