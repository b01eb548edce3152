"""Judge results: against the truth, and against an earlier run."""
