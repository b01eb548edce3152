"""The ground floor: atomic writes, bounded reads, hashes, image and video encoders."""
