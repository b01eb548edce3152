"""The builds of all processes of a batch: where they differ, results would."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from motionstereo_cli.batch.own_folder import builds_path
from motionstereo_cli.errors import InputError
from motionstereo_cli.files.atomic import Temporary, reported
from motionstereo_cli.files.records import Record, encode, read_json, typed


class BuildsRecord(Record, frozen=True):
    """``builds.json``: what the bytes of results depend on, see ``runs.record.builds``."""

    builds: dict[str, str]


def own_builds() -> dict[str, str]:
    """Return the builds of this process, which loads all libraries."""
    from motionstereo_cli.runs.record import builds

    return builds()


def builds_here() -> dict[str, str]:
    """Return the builds of this process, found by another one: loading all libraries takes memory.

    Raises:
        InputError: a library cannot be loaded.
    """
    code = f"import json; from {__name__} import own_builds; print(json.dumps(own_builds()))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    if found.returncode:
        raise InputError("this process cannot run motionstereo: install it again")
    builds: dict[str, str] = json.loads(found.stdout)
    return builds


def difference(theirs: Mapping[str, str], here: Mapping[str, str]) -> str:
    """Return the first difference of some builds from those here, in words; empty if none."""
    for name, ours in here.items():
        if (there := theirs.get(name)) != ours:
            return f"{name} is {there}, and not {ours} as here,"
    return ""


def check_builds(out: Path, builds: Mapping[str, str]) -> None:
    """Check that all shards of a batch have the same builds; the first one records its own.

    Raises:
        InputError: another one has others.
        OutputError: the record cannot be written.
    """
    path = builds_path(out)
    if not os.path.lexists(path):
        with reported(path), contextlib.suppress(FileExistsError), Temporary(path) as record:
            record.content.write(encode(BuildsRecord(dict(builds))))
            record.place_new()
    theirs = typed(read_json(path, within=out), BuildsRecord, path).builds
    if said := difference(theirs, builds):
        raise InputError(
            f"{said} where this batch began: install the same versions, so that all give the same "
            f"results, or remove {path}"
        )
