"""Decompression with a cap: a small compressed file may claim any size in memory."""

from __future__ import annotations

import bz2
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, Protocol

#: The largest message or chunk of a bag: two raw 16-bit images of 64 million px.
MAX_CONTENT_BYTES = 256_000_000
#: A compressed file may grow by this factor, or up to the size above.
_MAX_RATIO = 30


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int) -> bytes: ...


def decompressed(decompressor: _Decompressor, data: bytes) -> bytes:
    """Decompress content that is complete and at most :data:`MAX_CONTENT_BYTES` long.

    Raises:
        ValueError: it is incomplete or longer.
    """
    content = decompressor.decompress(data, MAX_CONTENT_BYTES)
    if not decompressor.eof:
        large = len(content) >= MAX_CONTENT_BYTES
        what = f"is larger than {MAX_CONTENT_BYTES} bytes" if large else "is cut off"
        raise ValueError(f"compressed content {what}")
    return content


class _Capped:
    """A compressed file with a limit on the bytes that are read from it."""

    def __init__(self, file: BinaryIO, max_bytes: int) -> None:
        self._file, self._left = file, max_bytes

    def __enter__(self) -> _Capped:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        """Read up to ``size`` bytes, by default one block."""
        block = self._file.read(size if size > 0 else 1 << 20)
        self._left -= len(block)
        if self._left < 0:
            raise ValueError("the compressed file is too large to be what it says")
        return block


def bound_rosbags() -> None:
    """Make rosbags decompress with a cap; it has none of its own."""
    import lz4.frame
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap

    zstd: Any = getattr(ros2, "zstd")  # noqa: B009
    if isinstance(zstd, SimpleNamespace):
        return

    def opened(file: Any, mode: str) -> _Capped:
        size = Path(file.name).stat().st_size
        return _Capped(zstd.open(file, mode), max(MAX_CONTENT_BYTES, _MAX_RATIO * size))

    def of_zstd(data: bytes, _: int = 0) -> bytes:
        return decompressed(zstd.ZstdDecompressor(), data)

    def of_lz4(data: bytes, _: int = 0) -> bytes:
        return decompressed(lz4.frame.LZ4FrameDecompressor(), data)

    def of_bz2(data: bytes) -> bytes:
        return decompressed(bz2.BZ2Decompressor(), data)

    def message(data: bytes) -> bytes:
        """Return a message; a damaged one is empty, so that the ones after it are still read."""
        try:
            return of_zstd(data)
        except (ValueError, zstd.ZstdError):
            return b""

    setattr(ros2, "zstd", SimpleNamespace(decompress=message, open=opened))  # noqa: B010
    storage_mcap.DECOMPRESSORS.update(lz4=of_lz4, zstd=of_zstd)
    ros1.decompressors.update({"bz2": of_bz2, "lz4": of_lz4})
