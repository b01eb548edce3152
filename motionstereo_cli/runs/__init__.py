"""One recording: its plan, its output folder, its record, and resuming it."""
