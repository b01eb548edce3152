"""Object stores, by fsspec: objects are fetched whole, and put back whole."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from motionstereo_cli.errors import InputError, OutputError, words_of
from motionstereo_cli.files.folders import make_folder

_T = TypeVar("_T")

#: What is taken for an address; paths of this system have only one slash where it had two.
_ADDRESS = re.compile(r"(s3|gs|gcs|https|http):/{1,2}(?=[^/])")

#: How long a store that does not answer is asked again, in s, and the pauses between.
_PATIENCE_S, _FIRST_PAUSE_S, _MAX_PAUSE_S = 600.0, 0.5, 15.0
#: The same where a command begins: an address that never answers is likely a wrong one.
FIRST_PATIENCE_S = 10.0
#: What asking again does not change.
_FINAL = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)


def address_of(name: str | Path) -> str | None:
    """Return a name as an address in a store, None if it is a path of this system."""
    text = str(name)
    found = _ADDRESS.match(text)
    return None if found is None else f"{found[1]}://{text[found.end() :]}"


class Store:
    """A folder in an object store.

    A request that the store does not answer is repeated for ten minutes.

    Args:
        address: ``s3://bucket/folder`` and the like, or ``https://``, which can only be read.
        patience_s: repeat requests for this long instead of ten minutes.

    Raises:
        InputError: the package for this kind of store is not installed.
    """

    def __init__(self, address: str, patience_s: float | None = None) -> None:
        try:
            import fsspec
        except ImportError:
            raise InputError(f"{address} needs fsspec: pip install 'motionstereo[cloud]'") from None
        # It prints tracebacks of connections that broke; what matters is raised.
        logging.getLogger("asyncio").setLevel(logging.CRITICAL)
        self.address = address.rstrip("/")
        self._patience_s = _PATIENCE_S if patience_s is None else patience_s
        try:
            # One connection for all addresses of a kind: to make one takes .3 s.
            self._system, self._root = fsspec.core.url_to_fs(self.address, use_listings_cache=False)
        except (ImportError, ValueError) as error:
            raise InputError(
                f"{address} cannot be reached ({error}): pip install 'motionstereo[cloud]', and "
                "for gs:// gcsfs"
            ) from None

    def _at(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}" if name else str(self._root)

    def _patiently(self, action: Callable[[], _T]) -> _T:
        """Repeat an action while the store does not answer; at the end raise its last error."""
        until_s, pause_s = time.monotonic() + self._patience_s, _FIRST_PAUSE_S
        while True:
            try:
                return action()
            except _FINAL:
                raise
            except Exception as error:
                if time.monotonic() + pause_s > until_s or _is_refusal(error):
                    raise
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, _MAX_PAUSE_S)

    def files(self, name: str = "") -> dict[str, int]:
        """Return the size of each object in a folder, or of an object, by its name below that.

        Raises:
            InputError: the store does not answer, or refuses.
        """
        top = self._at(name)

        def find() -> dict[str, int]:
            found = self._system.find(top, detail=True)
            return {
                path.removeprefix(top).strip("/"): int(about.get("size") or 0)
                for path, about in found.items()
            }

        try:
            return self._patiently(find)
        except FileNotFoundError:
            return {}
        except Exception as error:
            raise InputError(f"{self.address} cannot be read: {words_of(error)}") from error

    def read(self, name: str, max_bytes: int) -> bytes | None:
        """Return the content of an object, None where there is none.

        Raises:
            InputError: it is larger, or the store does not answer.
        """
        size = self.files(name).get("")
        if size is None:
            return None
        if size > max_bytes:
            raise InputError(f"{self.address}/{name} is larger than {max_bytes} bytes")
        try:
            return bytes(self._patiently(lambda: self._system.cat_file(self._at(name))))
        except FileNotFoundError:
            return None
        except Exception as error:
            raise InputError(f"{self.address}/{name} cannot be read: {words_of(error)}") from error

    def fetch(self, folder: Path, root: Path, max_bytes: int, name: str = "") -> Path:
        """Fetch an object, or all objects of a folder, and return its path.

        Args:
            folder: where it is put, under its own name.
            root: a folder above, which no link leads out of.
            max_bytes: the most that all may take.
            name: below the store's address; empty: what that itself names.

        Raises:
            InputError: there is none, it is larger, or the store does not answer.
            OutputError: it cannot be written.
        """
        sizes = self.files(name)
        what = f"{self.address}/{name}".rstrip("/")
        if not sizes:
            raise InputError(f"there is no {what}")
        if sum(sizes.values()) > max_bytes:
            raise InputError(
                f"{what} has {sum(sizes.values())} bytes, more than --fetch-mb lets be fetched"
            )
        target = folder / (PurePosixPath(what.split("?")[0]).name or "object")
        for each in sizes:
            if ".." in PurePosixPath(each).parts:
                raise InputError(f"{what} has an object whose name leads elsewhere: {each}")
            path = target / each if each else target
            make_folder(path.parent, root)
            source = f"{self._at(name).rstrip('/')}/{each}" if each else self._at(name)
            try:
                self._patiently(lambda: self._system.get_file(source, str(path)))  # noqa: B023
            except Exception as error:
                raise InputError(f"{what} cannot be fetched: {words_of(error)}") from error
        return target

    def put(self, files: Iterable[tuple[Path, str]]) -> None:
        """Put files, each under a name, in order; each appears whole or not at all.

        Raises:
            OutputError: the store does not take them.
        """
        for path, name in files:
            try:
                self._patiently(lambda: self._system.put_file(str(path), self._at(name)))  # noqa: B023
            except Exception as error:
                raise OutputError(
                    f"cannot write {self.address}/{name}: {words_of(error)}"
                ) from error

    def remove(self, names: Iterable[str]) -> None:
        """Remove objects that are there.

        Raises:
            OutputError: the store does not let them be removed.
        """
        for name in names:
            try:
                self._patiently(lambda: self._system.rm_file(self._at(name)))  # noqa: B023
            except FileNotFoundError:
                continue
            except Exception as error:
                raise OutputError(
                    f"cannot remove {self.address}/{name}: {words_of(error)}"
                ) from error


def _is_refusal(error: Exception) -> bool:
    """Return whether an error says that the store refused the request."""
    response: Any = getattr(error, "response", None)
    status = getattr(error, "status", None) or (
        response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        if isinstance(response, dict)
        else None
    )
    return isinstance(status, int) and 400 <= status < 500 and status not in (408, 429)
