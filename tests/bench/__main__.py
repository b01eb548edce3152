"""The entry point of the measurements: ``python -m bench NAME [options]``."""

from __future__ import annotations

import importlib
import sys

BENCHES = (
    "accuracy",
    "batch",
    "drive",
    "gallery",
    "given",
    "goals",
    "map",
    "objects",
    "own_motion",
    "presets",
    "speed",
    "torture",
)


def main(args: list[str]) -> int:
    """Run the measurement that the first argument names with the arguments after it."""
    if not args or args[0] not in BENCHES:
        print(f"usage: python -m bench {{{','.join(BENCHES)}}} [--help]", file=sys.stderr)
        return 2
    return importlib.import_module(f"bench.{args[0]}").main(args[1:]) or 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
