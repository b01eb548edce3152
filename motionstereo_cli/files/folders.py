"""Folders of results: no links in their paths, and only this program's files are removed."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

from motionstereo_cli.errors import OutputError
from motionstereo_cli.files.atomic import reported

_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_FOLDER = getattr(os, "O_DIRECTORY", 0)


def make_folder(path: Path, root: Path | None = None) -> None:
    """Create a folder for results, and its parents up to ``root``, where missing.

    Args:
        path: the folder.
        root: a folder above it, which may be a link itself and is made with all above it;
            ``path.parent``, which has to be there, if None.

    Raises:
        OutputError: it cannot be created, or a link or file is in its place or in its path.
    """
    if root is not None:
        with reported(root):
            root.mkdir(parents=True, exist_ok=True)
    above = path.parent if root is None else root
    check_no_links(path, above)
    for name in path.relative_to(above).parts:
        above = above / name
        with reported(above):
            above.mkdir(exist_ok=True)


def check_no_links(path: Path, root: Path) -> None:
    """Check that a path and its parents below ``root`` are not links.

    Raises:
        OutputError: one is.
    """
    above = root
    for name in path.relative_to(root).parts:
        above = above / name
        with reported(above):
            if above.is_symlink():
                raise OutputError(
                    f"{above} is a link to elsewhere: remove it, or give another folder"
                )


def spread(name: str) -> str:
    """Return the name of one of 256 folders for what belongs to a name, so that none has many."""
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:2]


def remove(root: Path, paths: Iterable[Path]) -> None:
    """Remove files in a folder or below, in order; missing ones are skipped.

    No link but ``root`` itself is followed: if a folder below is replaced by a link, the files it
    leads to stay.

    Args:
        root: the folder.
        paths: files in it.

    Raises:
        OSError: one cannot be removed, or lies behind a link.
    """
    if os.unlink not in os.supports_dir_fd:
        for path in paths:
            for folder in path.parents[: len(path.relative_to(root).parts) - 1]:
                if folder.is_symlink():
                    raise OSError(f"{folder} is a link")
            path.unlink(missing_ok=True)
        return
    top = os.open(root, os.O_RDONLY | _FOLDER)
    try:
        for folder, files in groupby(paths, key=lambda path: path.parent):
            with contextlib.suppress(FileNotFoundError), contextlib.ExitStack() as opened:
                below = top
                for name in folder.relative_to(root).parts:
                    below = os.open(name, os.O_RDONLY | _FOLDER | _NO_LINK, dir_fd=below)
                    opened.callback(os.close, below)
                _remove_in(below, files)
    finally:
        os.close(top)


def _remove_in(folder: int, files: Iterable[Path]) -> None:
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path.name, dir_fd=folder)


def remove_tree(folder: Path, root: Path) -> None:
    """Remove a folder of results with all that is in it, if it is there; no link is followed.

    Raises:
        OutputError: it cannot be removed, or below ``root`` a link stands in its place or above.
    """
    check_no_links(folder, root)
    with reported(folder):
        if folder.is_dir():
            shutil.rmtree(folder)


def remove_empty(folder: Path) -> None:
    """Remove a folder if it is there, is empty, and is no link."""
    with contextlib.suppress(OSError):
        folder.rmdir()
