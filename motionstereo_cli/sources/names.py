"""Order, numbers and times of images by their file names."""

from __future__ import annotations

import itertools
import operator
import re
from collections.abc import Sequence
from datetime import UTC, datetime

#: The largest time stamp and number: FFmpeg and NumPy hold 64 bits with a sign.
MAX_STAMP = 2**63 - 1

_NS = 1_000_000_000

#: A name that is a time since 1970, from 2001 to 2100: in s with decimals; in ms, us or ns.
_NAME_STAMP = re.compile(
    r"(.*?)(?<!\d)(?:([1-3]\d{9})[._](\d{3}|\d{6}|\d{9})|([1-3](?:\d{12}|\d{15}|\d{18})))(\D*)",
    re.ASCII,
)
#: A name that is a date and time, with or without parts of seconds.
_NAME_DATE = re.compile(
    r"(.*?)(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[T_\- ]?"
    r"(\d\d)[-:_.h]?(\d\d)[-:_.m]?(\d\d)(?:[._,-](\d{3}|\d{6}|\d{9}))?(?!\d)(.*)",
    re.ASCII,
)


#: What the left camera is called in names, and the right one in its place.
_SIDES = (("left", "right"), ("infra1", "infra2"), ("cam0", "cam1"), ("camera0", "camera1"))


def right_of(name: str) -> str | None:
    """Return the name of the right camera for that of the left one, None for other names."""
    for left, right in _SIDES:
        if re.search(_word(left), name):
            return re.sub(_word(left), right, name)
    return None


def side_of(name: str) -> str | None:
    """Return which camera a name belongs to, ``left`` or ``right``; None if it does not say."""
    for sides in _SIDES:
        for side, called in zip(("left", "right"), sides, strict=True):
            if re.search(_word(called), name):
                return side
    return None


def _word(called: str) -> str:
    return rf"(?<![a-z]){called}(?![a-z0-9])"


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that counts digits as numbers: frame2 comes before frame10."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)]


def file_numbers(stems: list[str]) -> list[int] | None:
    """Return the number in each of a folder's file names without suffix, given in order.

    None unless the names differ only in that number, which counts in steps of one size with gaps
    allowed. Time stamps, several numbers and words give none.
    """
    split = [re.split(r"([0-9]+)", stem) for stem in stems]
    if len({len(parts) for parts in split}) > 1:
        return None
    columns = [
        [parts[i] if i % 2 == 0 else int(parts[i]) for parts in split] for i in range(len(split[0]))
    ]
    varying = [(i, column) for i, column in enumerate(columns) if len(set(column)) > 1]
    if len(varying) != 1 or varying[0][0] % 2 == 0:
        return None
    numbers = [int(number) for number in varying[0][1]]
    if max(numbers) > MAX_STAMP:
        return None
    steps = list(map(operator.sub, numbers[1:], numbers[:-1]))
    least = min(steps)
    return numbers if least > 0 and not any(step % least for step in steps) else None


def gaps(numbers: list[int]) -> list[str]:
    """Return a line that names the gaps in a numbering, if there are any."""
    steps = list(map(operator.sub, numbers[1:], numbers[:-1]))
    pairs = zip(itertools.pairwise(numbers), steps, strict=True)
    gaps = [f"{before} and {after}" for (before, after), step in pairs if step > min(steps)]
    if not gaps:
        return []
    more = f" and in {len(gaps) - 1} other places" if len(gaps) > 1 else ""
    return [f"numbers are missing between {gaps[0]}{more}: check that no images are lost"]


def stamps_in(stems: Sequence[str]) -> list[int]:
    """Return names without suffix as time stamps in ns, in the forms of camera drivers.

    These are seconds since 1970 with a decimal point, whole ms, us or ns since then, or dates; the
    rest of the names, except for counters, is the same. None if a name has none, or the times do
    not rise.
    """
    for pattern, stamp_of in ((_NAME_STAMP, _stamp_of), (_NAME_DATE, _stamp_of_date)):
        found = [each for stem in stems if (each := pattern.fullmatch(stem))]
        around = {re.sub(r"\d+", "", each[1] + "/" + each[each.re.groups]) for each in found}
        if len(found) != len(stems) or len(around) != 1:
            continue
        stamps = [stamp_of(each) for each in found]
        if len(stamps) > 1 and all(a < b for a, b in itertools.pairwise(stamps)) and stamps[0] >= 0:
            return stamps
    return []


def _stamp_of(found: re.Match[str]) -> int:
    if found[3]:
        return int(found[2]) * _NS + int(f"{found[3]:0<9.9}")
    return int(found[4].ljust(19, "0"))


def _stamp_of_date(found: re.Match[str]) -> int:
    try:
        moment = datetime.strptime("".join(found.group(*range(2, 8))), "%Y%m%d%H%M%S")
    except ValueError:
        return -1
    return int(moment.replace(tzinfo=UTC).timestamp()) * _NS + int((found[8] or "").ljust(9, "0"))


def joint_marks(left: Sequence[str], right: Sequence[str]) -> tuple[list[int], list[int]] | None:
    """Return a rising number for each name of both sides, comparable between them.

    It is the part that differs among the names of a side: a number, or several of fixed width,
    such as seconds and their decimals. None if the names differ in form, or the numbers do not
    rise.
    """
    sides = [[re.split(r"(\d+)", stem) for stem in stems] for stems in (left, right)]
    both = [parts for side in sides for parts in side]
    if not all(sides) or len({len(parts) for parts in both}) != 1:
        return None
    if any(len({tuple(parts[::2]) for parts in side}) != 1 for side in sides):
        return None  # words differ, so the numbers may not be comparable
    places = range(1, len(both[0]), 2)
    varying = [at for at in places if any(len({parts[at] for parts in side}) > 1 for side in sides)]
    if not varying:
        return None
    last = varying[-1]
    behind_point = last > 1 and all(parts[last - 1] == "." for parts in both)
    alone = [[int(parts[last]) for parts in side] for side in sides]
    if not behind_point and all(map(_rises, alone)):
        return alone[0], alone[1]
    used = range(min(varying[0], last - 2 if behind_point else last), last + 1, 2)
    if any(len({len(parts[at]) for parts in both}) != 1 for at in used[1:]):
        return None
    whole = [[int("".join(parts[at] for at in used)) for parts in side] for side in sides]
    return (whole[0], whole[1]) if all(map(_rises, whole)) else None


def _rises(numbers: Sequence[int]) -> bool:
    return all(before < after for before, after in itertools.pairwise(numbers))
