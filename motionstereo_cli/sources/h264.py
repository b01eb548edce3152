"""Missing reference images of H.264 streams.

FFmpeg's decoder conceals a lost reference without reporting it. Reference images are numbered
(frame_num of ITU-T H.264, 7.4.3), so a gap in the numbers means that one is lost. An image that
the camera skipped before encoding leaves no gap.
"""

from __future__ import annotations

import contextlib
from typing import NamedTuple

#: Profiles whose parameter sets have further fields for colour: 7.3.2.1.1.
_HIGH = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}

_SLICE, _IDR_SLICE, _SEQUENCE_SET = 1, 5, 7


class SliceHeader(NamedTuple):
    """An image's slice header: its frame_num modulo ``modulus``, and whether it is a reference."""

    number: int
    modulus: int
    is_reference: bool
    is_idr: bool

    def follows(self, last: SliceHeader) -> bool:
        """Return whether no reference is missing between an image and this one."""
        expected = (last.number + last.is_reference) % self.modulus
        return self.is_idr or self.number in (expected, last.number)


class SliceHeaders:
    """Reads the slice headers of the images in packets.

    Args:
        extradata: the codec's data in the container: the parameter sets, and the size of the
            length fields of units.
    """

    def __init__(self, extradata: bytes) -> None:
        in_lengths = len(extradata) > 8 and extradata[0] == 1
        self._length_bytes = (extradata[4] & 3) + 1 if in_lengths else 0
        self._bits_of_numbers: tuple[int, bool] | None = None
        with contextlib.suppress(IndexError):  # torn
            for part in [extradata[8:]] if in_lengths else _annex_b(extradata):
                self._note(part)

    def read(self, packet: bytes) -> SliceHeader | None:
        """Return the slice header of the first image in a packet, None if it cannot be parsed."""
        parts = _lengths(packet, self._length_bytes) if self._length_bytes else _annex_b(packet)
        with contextlib.suppress(IndexError):  # torn
            for part in parts:
                self._note(part)
                if part[0] & 31 in (_SLICE, _IDR_SLICE) and self._bits_of_numbers is not None:
                    size, has_planes = self._bits_of_numbers
                    bits = _Bits(part[1:64])
                    for _ in range(3):  # first macroblock, kind of slice, parameter set
                        bits.exp_golomb()
                    if has_planes:
                        bits.take(2)
                    is_idr = part[0] & 31 == _IDR_SLICE
                    return SliceHeader(bits.take(size), 1 << size, bool(part[0] & 0x60), is_idr)
        return None

    def _note(self, part: bytes) -> None:
        """Note the number of bits of frame numbers, if a unit is a parameter set."""
        if not part or part[0] & 31 != _SEQUENCE_SET:
            return
        bits = _Bits(part[4:512])
        bits.exp_golomb()  # its identifier
        has_planes = False
        if part[1] in _HIGH:
            chroma = bits.exp_golomb()
            has_planes = chroma == 3 and bool(bits.take(1))
            bits.exp_golomb()
            bits.exp_golomb()
            bits.take(1)
            if bits.take(1):
                for index in range(12 if chroma == 3 else 8):
                    if bits.take(1):
                        bits.skip_scaling_list(16 if index < 6 else 64)
        self._bits_of_numbers = bits.exp_golomb() + 4, has_planes


class _Bits:
    """Reads bits in order; IndexError after the last."""

    def __init__(self, content: bytes) -> None:
        plain = content.replace(b"\0\0\3", b"\0\0")
        self._bits = "".join(f"{byte:08b}" for byte in plain)
        self._at = 0

    def take(self, count: int) -> int:
        self._at += count
        if self._at > len(self._bits):
            raise IndexError
        return int(self._bits[self._at - count : self._at] or "0", 2)

    def exp_golomb(self) -> int:
        zeros = 0
        while not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)

    def skip_scaling_list(self, size: int) -> None:
        last = following = 8
        for _ in range(size):
            if following:
                coded = self.exp_golomb()
                following = (last + (-(coded // 2) if coded % 2 == 0 else coded // 2 + 1)) % 256
            last = following or last


def _annex_b(content: bytes) -> list[bytes]:
    return [part for part in content.split(b"\0\0\1")[1:] if part]


def _lengths(content: bytes, size: int) -> list[bytes]:
    parts, at = [], 0
    while at + size <= len(content):
        length = int.from_bytes(content[at : at + size])
        parts.append(content[at + size : at + size + length])
        at += size + length
    return [part for part in parts if part]
