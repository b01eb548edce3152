"""One recording: its plan, its output folder, its record, and going on after an interruption."""
