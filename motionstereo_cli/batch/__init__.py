"""Many recordings: the manifest, the workers, and the status of each recording."""
