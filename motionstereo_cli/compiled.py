"""Loops over pixels, compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from numba import njit
from numba.core import event

_P = ParamSpec("_P")
_R = TypeVar("_R")


#: Other threads run meanwhile. A division by 0 gives inf or NaN, as everywhere in NumPy: to check
#: each one takes a tenth of the time to compile.
_HOW: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def kernel(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function of arrays and numbers when it is first called.

    What was compiled is kept on disk, beside the package or in the user's cache folder; where
    neither can be written, every process compiles for itself.
    """
    try:
        compiled: Callable[_P, _R] = njit(cache=True, **_HOW)(function)
    except RuntimeError:  # no folder for the cache
        compiled = njit(**_HOW)(function)
    return compiled


def when_compiling(tell: Callable[[], object]) -> None:
    """Call ``tell`` once if a function has to be compiled from now on: that takes seconds."""

    class Listener(event.Listener):
        def on_start(self, _: event.Event) -> None:
            event.unregister("numba:compile", self)  # type: ignore[no-untyped-call]
            tell()

        def on_end(self, _: event.Event) -> None:
            pass

    event.register("numba:compile", Listener())  # type: ignore[no-untyped-call]
