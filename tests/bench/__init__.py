"""Measurements beside the project: how accurate, against the matchers that everyone uses."""
