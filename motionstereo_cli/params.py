"""Declaration of a parameter: default, range, unit and help in one place.

The command line, the configuration file, run.json and the docs derive from dataclasses whose
fields are declared with :func:`param`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from motionstereo_cli.errors import SettingsError


@dataclass(frozen=True, slots=True)
class Param:
    """A declared parameter.

    Attributes:
        name: field name, as in the configuration file and run.json.
        kind: ``bool``, ``int``, ``float`` or ``str``.
        default: its default value.
        help: one sentence for users; that on ``only_with`` is made from it.
        unit: unit of the number, empty for a plain number or a choice.
        low, high: inclusive range of a number, None = open.
        choices: allowed strings, empty = any.
        group: its heading in the help, empty = that of its dataclass.
        common: whether the short help shows it.
        old: former name, still accepted on the command line and in the configuration file.
        words: words for values, such as ``auto`` for 0.
        begun: words that begin with one of these, such as ``onnx:``, are choices as well.
        more: finds further choices, which takes time, for a value that is none of the others.
        only_with: options without which it has no effect, such as ``--poses and --save steering,
            preview or bag``: of each group that ``and`` divides, one is needed; for what is no
            option, words such as ``files of objects``.
    """

    name: str
    kind: type
    default: Any
    help: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    group: str
    common: bool
    old: str
    words: Mapping[str, Any]
    begun: tuple[str, ...] = ()
    more: Callable[[], Iterable[str]] = tuple
    only_with: str = ""

    @property
    def flag(self) -> str:
        """The name as a command-line option."""
        return "--" + self.name.replace("_", "-")

    def flag_for(self, value: object) -> str:
        """Return the option that sets this value; that of a switch that is off begins with no."""
        return self.flag if value is not False else f"--no-{self.flag.removeprefix('--')}"

    def missing(self, present: Set[str]) -> str:
        """Return the options of which one would be needed for an effect, as words; empty = none.

        Args:
            present: the options there are.
        """
        groups = self.only_with.split(" and ") if self.only_with else ()
        return next((each for each in groups if present.isdisjoint(options_in(each))), "")

    @property
    def range(self) -> str:
        """The allowed values in words, empty = any."""
        if self.choices:
            return " | ".join((*self.choices, *(f"{each}..." for each in self.begun)))
        if self.low is None and self.high is None:
            return ""
        if self.high is None:
            return f"at least {self.low:,.10g}"
        return f"{self.low:,.10g} to {self.high:,.10g}"

    def parse(self, value: object) -> Any:
        """Return ``value`` (perhaps text) as this parameter's kind, within its range.

        Raises:
            SettingsError: it is of another kind, not a number, or out of range.
        """
        if isinstance(value, str):
            value = self.words.get(value, value)
        wanted = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
        try:
            if self.kind is bool and not isinstance(value, bool):
                raise ValueError
            if self.kind in (int, float) and isinstance(value, bool):
                raise ValueError
            if self.kind is int and isinstance(value, float) and not value.is_integer():
                raise ValueError
            parsed = self.kind(value)
        except (TypeError, ValueError, OverflowError):
            unit = " in" if self.unit else ""
            raise self._error(value, f"give {wanted[self.kind]}{unit}") from None
        begun = self.begun and parsed.startswith(self.begun)
        if self.choices and parsed not in self.choices and not begun:
            more = [each for each in self.more() if each not in self.choices]
            if parsed not in more:
                raise self._error(value, f"choose {' | '.join((self.range, *more))}")
        if self.kind in (int, float) and not (
            (self.kind is int or math.isfinite(parsed))
            and (self.low is None or parsed >= self.low)
            and (self.high is None or parsed <= self.high)
        ):
            raise self._error(value, f"give {self.range or 'a finite number'}")
        return parsed

    def _error(self, value: object, advice: str) -> SettingsError:
        unit = f" {self.unit}" if self.unit else ""
        return SettingsError(f"{self.flag} cannot be {value!r}: {advice}{unit}")


def param(
    default: Any,
    help: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | Callable[[], Iterable[str]] = (),
    group: str = "",
    common: bool = False,
    old: str = "",
    words: Mapping[str, Any] = MappingProxyType({}),
    begun: tuple[str, ...] = (),
    more: Callable[[], Iterable[str]] = tuple,
    only_with: str = "",
) -> Any:
    """Declare a dataclass field that :func:`params` describes and :func:`checked` verifies.

    ``choices`` may be a function, if choices can be added.
    """
    meta: dict[str, Any] = {
        "help": help,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": choices,
    }
    meta |= {"group": group, "common": common, "old": old, "words": words, "begun": begun}
    meta |= {"more": more, "only_with": only_with}
    return field(default=default, metadata=meta)


def params(settings: type) -> Iterator[Param]:
    """Yield the declared parameters of a dataclass, in order."""
    for item in fields(settings):
        choices = item.metadata["choices"]
        meta = {**item.metadata, "choices": tuple(choices() if callable(choices) else choices)}
        yield Param(item.name, type(item.default), item.default, **meta)


def checked(settings: Any) -> None:
    """Verify each parameter of a dataclass instance; for its ``__post_init__``.

    Raises:
        SettingsError: a value is of the wrong kind or out of range.
    """
    for item in params(type(settings)):
        object.__setattr__(settings, item.name, item.parse(getattr(settings, item.name)))


def options_of(settings: Any) -> Iterator[str]:
    """Yield the options that set the values of a dataclass instance, as ``only_with`` names them.

    They are ``--name`` for what is neither 0 nor empty, and ``--name value`` for text.
    """
    for item in params(type(settings)):
        value = getattr(settings, item.name)
        if value or value is False:
            yield item.flag_for(value)
        if isinstance(value, str):
            yield f"{item.flag} {value}"


def idle(settings: Any, present: Set[str]) -> Iterator[str]:
    """Yield a sentence for each parameter that is given, but has no effect.

    Args:
        settings: a dataclass instance.
        present: the options there are, as ``only_with`` names them.
    """
    for item in params(type(settings)):
        value = getattr(settings, item.name)
        if value != item.default and (missing := item.missing(present)):
            yield f"{item.flag_for(value)} has no effect without {missing}"


def options_in(words: str) -> Iterator[str]:
    """Yield the options in words such as ``--matcher trails or dense``."""
    flag = ""
    for word in re.split(", | or ", words):
        flag = word.partition(" ")[0] if word.startswith("-") else flag
        yield word if not flag or word.startswith("-") else f"{flag} {word}"


def near_match(name: str, known: Iterable[str]) -> str:
    """Return `` (did you mean ...?)`` for a mistyped name, or nothing."""
    import difflib  # which takes time, and is for mistakes

    matches = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {matches[0]!r}?)" if matches else ""
