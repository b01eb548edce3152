"""Decode videos side by side and do nothing with them: ``python decode.py VIDEO...``."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import av


def decode(path: str) -> int:
    """Return how many frames a video has, by decoding them all."""
    with av.open(path) as container:
        return sum(1 for _ in container.decode(video=0))


if __name__ == "__main__":
    with ThreadPoolExecutor() as pool:
        print(*pool.map(decode, sys.argv[1:]))
