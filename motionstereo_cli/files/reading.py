"""Reading files that others wrote."""

from __future__ import annotations

import hashlib
from pathlib import Path

from motionstereo_cli.errors import InputError

#: No calibration, and no table of poses or time stamps for a day's recording, is as large.
MOST_CALIBRATION_BYTES = 16_000_000
MOST_TABLE_BYTES = 256_000_000


def read_text(path: str | Path, what: str, most_bytes: int) -> str:
    """Return the text of a file; what is no UTF-8 in it becomes a replacement character.

    Args:
        path: the file.
        what: what to call it in messages.
        most_bytes: the largest that makes sense.

    Raises:
        InputError: the file cannot be read or is larger.
    """
    try:
        with Path(path).open("rb") as file:
            content = file.read(most_bytes + 1)
    except OSError as error:
        raise InputError(f"cannot read {what} {path}: {error.strerror}") from error
    if len(content) > most_bytes:
        raise InputError(f"{path} is larger than {most_bytes} bytes: check that it is {what}")
    text = content.decode("utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal digits.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
