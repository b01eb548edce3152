"""Access to the file system: atomic writes, bounded reads, hashes, image and video encoders."""
