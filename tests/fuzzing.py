"""Damaged files without end: samples are damaged, and what reaches new code is damaged further.

An example is a content, or a tuple whose last part is one. Text is damaged by words, lines and
numbers, other content by bytes, blocks and numbers that may be lengths. Where there is time, the
lines of the package that run are watched: an example that reaches a new one is kept in a folder,
from which the next time goes on.
"""

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import random
import re
import resource
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import motionstereo_cli
from bench.damage import DAMAGES

#: An example that takes so long hangs, and one that needs so much memory is not bounded.
_HANGS_S, _MAX_KB = 60, 1_000_000

#: No example becomes longer, and none that is longer is kept.
_MAX_BYTES, _MAX_KEPT_BYTES = 1 << 20, 200_000

#: What is put in place of a word: numbers that are none or out of range, and marks of the formats.
_NASTY = [
    *(b"nan", b"-inf", b"0", b"-1", b"-0.0", b"1e308", b"1e-320", b"1e999", b"0.5", b"2", b"1_0"),
    *(b"3" * 20, b"9" * 5000, b"1" + b"0" * 400, b"0x1p3", "\u0663".encode(), b"true", b"null"),
    *(b"", b"\0", b"\r", b"\n", b"\xff\xfe", b"\xed\xa0\x80", b"\x1b[31m", b"\xef\xbb\xbf"),
    *(b"[", b"]", b"{", b"}", b"<", b">", b"<!--", b":", b"=", b",", b"-", b'"', b"'", b"#", b"|"),
    *(b"[" * 3000, b'{"a":' * 3000, b"&a [*a]", b"!!python/object/apply:os.system", b"<<: *a"),
]
_WORD = re.compile(rb"[\w.+-]+|\s+|[^\w\s]")
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?")

#: How numbers stand in files.
_PACKED = ("<H", ">H", "<I", ">I", "<Q", ">Q", "B")

_Damage = Callable[[bytes, Sequence[bytes], random.Random], bytes]


def _words(content: bytes, _: Sequence[bytes], chance: random.Random) -> bytes:
    """Replace, lose, repeat or exchange some words."""
    words = _WORD.findall(content) or [b""]
    for _i in range(chance.randint(1, 4)):
        place = chance.randrange(len(words))
        match chance.randrange(6):
            case 0:
                words[place] = chance.randbytes(chance.randint(0, 6))
            case 1:
                words[place] *= chance.randint(2, 5)
            case 2:
                words[place] = chance.choice(words)
            case 3:
                end = chance.randrange(len(words))
                words[place:end] = [b""] * (end - place)  # the number of words stays
            case _:
                words[place] = chance.choice(_NASTY)
    return b"".join(words)


def _lines(content: bytes, others: Sequence[bytes], chance: random.Random) -> bytes:
    """Move, lose, repeat or indent a line, or take some of another content."""
    lines = content.splitlines(keepends=True) or [b""]
    place, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    match chance.randrange(6):
        case 0:
            lines.insert(other, lines[place])
        case 1:
            del lines[place : place + chance.choice((1, 1, 2, 5))]
        case 2:
            lines[place], lines[other] = lines[other], lines[place]
        case 3:
            lines[place] = chance.choice((b"  ", b"    ", b"\t")) + lines[place]
        case 4:
            lines[place] = lines[place].lstrip()
        case _:
            taken = chance.choice(others).splitlines(keepends=True) or [b""]
            begin = chance.randrange(len(taken))
            lines[place : place + chance.randint(0, 3)] = taken[
                begin : begin + chance.randint(1, 8)
            ]
    return b"".join(lines)


def _numbers(content: bytes, _: Sequence[bytes], chance: random.Random) -> bytes:
    """Replace a number by one that is near, out of range, or of another kind."""
    found = list(_NUMBER.finditer(content))
    if not found:
        return _words(content, _, chance)
    at = chance.choice(found)
    old = at.group()
    new = (
        *(b"-" + old, old + b"0", old[:-1], old + b"e300", b'"' + old + b'"', b"[" + old + b"]"),
        *(b"0", b"1", b"-1", b"nan", b"2147483648", b"4294967295", chance.choice(found).group()),
    )
    return content[: at.start()] + chance.choice(new) + content[at.end() :]


def _bytes(content: bytes, _: Sequence[bytes], chance: random.Random) -> bytes:
    """Flip, zero, exchange or cut off some bytes."""
    return chance.choice(list(DAMAGES.values()))(content or b"\0", chance)


def _lengths(content: bytes, _: Sequence[bytes], chance: random.Random) -> bytes:
    """Replace a number that may be a length or a count, or any."""
    form, place, value = "B", 0, 0
    for _i in range(100):
        form = chance.choice(_PACKED)
        if len(content) >= struct.calcsize(form):
            place = chance.randrange(len(content) - struct.calcsize(form) + 1)
            (value,) = struct.unpack_from(form, content, place)
            if 0 < value <= len(content) or chance.randrange(20) == 0:
                break
    size = struct.calcsize(form)
    top = (1 << 8 * size) - 1
    new = (0, 1, value - 1, value + 1, 2 * value, value // 2, top, top >> 1, len(content))
    return content[:place] + struct.pack(form, chance.choice(new) & top) + content[place + size :]


def _blocks(content: bytes, others: Sequence[bytes], chance: random.Random) -> bytes:
    """Lose, repeat or insert a block, or go on with another content."""
    place, size = chance.randrange(len(content) + 1), chance.choice((1, 4, 16, 100, 1000))
    head, tail = content[:place], content[place:]
    match chance.randrange(4):
        case 0:
            return head + tail[size:]
        case 1:
            return head + tail[:size] + tail
        case 2:
            return head + chance.randbytes(min(size, 16)) + tail
        case _:
            other = chance.choice(others)
            return head + other[chance.randrange(len(other) + 1) :]


_OF_TEXT: tuple[_Damage, ...] = (_words, _words, _lines, _numbers, _numbers)
_OF_BYTES: tuple[_Damage, ...] = (_bytes, _bytes, _lengths, _lengths, _blocks)


def damaged(content: bytes, others: Sequence[bytes], chance: random.Random) -> bytes:
    """Return a content with damage; ``others`` are contents of the same kind."""
    if chance.randrange(20) == 0:
        return chance.randbytes(chance.randint(0, 200))
    kinds = _OF_BYTES if b"\0" in content[:1000] else _OF_TEXT
    for _i in range(chance.randint(1, 3)):
        content = chance.choice(kinds)(content, others, chance)
    return content[:_MAX_BYTES]


class _Watch:
    """Counts lines of the package that run and have not run before.

    Functions without such lines are not watched, so that it gets fast in time.
    """

    def __init__(self) -> None:
        self.new = 0
        self._left: dict[CodeType, set[int]] = {}
        self._package = str(Path(motionstereo_cli.__file__).parent)

    def called(self, frame: FrameType, _event: str, _: object) -> Any:
        """Watch a function; for sys.settrace."""
        code = frame.f_code
        if code not in self._left:
            ours = code.co_filename.startswith(self._package)
            self._left[code] = {line for *_, line in code.co_lines() if line} if ours else set()
        return self._ran if self._left[code] else None

    def _ran(self, frame: FrameType, event: str, _: object) -> Any:
        left = self._left[frame.f_code]
        if event == "line" and frame.f_lineno in left:
            left.discard(frame.f_lineno)
            self.new += 1
        return self._ran


@contextlib.contextmanager
def _watching(watch: _Watch) -> Iterator[None]:
    threading.settrace(watch.called)
    sys.settrace(watch.called)
    try:
        yield
    finally:
        sys.settrace(None)
        threading.settrace(None)  # type: ignore[arg-type]


class Fuzz:
    """Tries a check on former finds, and then on damaged samples.

    Args:
        kept: folder of the examples that are kept; what is tried right now is ``current`` there.
        seconds: how long to go on; 0: a number of examples, and nothing is kept.
        seed: what is drawn depends on it.
    """

    def __init__(self, kept: Path, seconds: float, seed: int) -> None:
        self._kept, self._seconds, self._seed = kept, seconds, seed
        self._before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def __call__(
        self,
        samples: Sequence[Any],
        check: Callable[[Any], object],
        finds: Sequence[Any] = (),
        examples: int = 100,
    ) -> None:
        """Try them.

        Args:
            samples: contents, or tuples whose last part is one.
            check: raises where an example is not treated as it should be.
            finds: examples that are tried as they are.
            examples: how many are tried where there are no seconds.
        """
        for find in finds:
            self._try(check, find)
        heads = [tuple(each[:-1]) if isinstance(each, tuple) else None for each in samples]
        contents = [
            each if head is None else each[-1] for each, head in zip(samples, heads, strict=True)
        ]
        if not self._seconds:
            chance = random.Random(self._seed)
            for _i in range(examples):
                number = chance.randrange(len(contents))
                content = damaged(contents[number], contents, chance)
                self._try(check, _example(heads[number], content))
            return
        self._go_on(heads, contents, check)

    def _go_on(
        self, heads: list[Any], contents: list[bytes], check: Callable[[Any], object]
    ) -> None:
        self._kept.mkdir(parents=True, exist_ok=True)
        pool = list(enumerate(contents))
        for path in sorted(self._kept.glob("*-*")):
            number = int(path.name.partition("-")[0])
            if number < len(contents):
                pool.append((number, path.read_bytes()))
        chance, watch, ends = random.Random(self._seed), _Watch(), time.monotonic() + self._seconds
        begun, tried = len(pool), 0
        with _watching(watch):
            while time.monotonic() < ends:
                # Those that are kept, and new damage, take turns.
                number, content = pool[tried] if tried < begun else chance.choice(pool)
                if tried >= begun:
                    others = [each for at, each in pool if heads[at] == heads[number]]
                    content = damaged(content, others, chance)
                (self._kept / "current").write_bytes(content)
                watch.new = 0
                self._try(check, _example(heads[number], content))
                tried += 1
                if watch.new and tried > begun and len(content) <= _MAX_KEPT_BYTES:
                    pool.append((number, content))
                    name = f"{number}-{hashlib.sha256(content).hexdigest()[:16]}"
                    (self._kept / name).write_bytes(content)
        print(f"{tried} examples, {len(pool) - begun} kept, {begun - len(contents)} before")

    def _try(self, check: Callable[[Any], object], example: Any) -> None:
        faulthandler.dump_traceback_later(_HANGS_S, exit=True)
        try:
            check(example)
        except Exception as error:
            error.add_note(f"example: {example!r:.3000}")
            raise
        finally:
            faulthandler.cancel_dump_traceback_later()
        used_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - self._before_kb
        assert used_kb < _MAX_KB, f"{used_kb} kB with {example!r:.3000}"


def _example(head: Any, content: bytes) -> Any:
    return content if head is None else (*head, content)
