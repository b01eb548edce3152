"""A run and its output folder."""
