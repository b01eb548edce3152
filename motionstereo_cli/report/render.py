"""Render the HTML of a page."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from motionstereo_cli import __version__
from motionstereo_cli.files.reading import read_text

_HOME = Path(__file__).parent
_MAX_PART_BYTES = 1_000_000


def render(template: str, scripts: Sequence[str], **values: Any) -> str:
    """Return a template of this folder filled in; all text is escaped.

    The Content-Security-Policy of the page allows its own scripts, pictures and videos, and
    nothing else.

    Args:
        template: name of the template.
        scripts: names of the page's scripts, in order.
        values: what the template shows.
    """
    texts = [_read(name) for name in scripts]
    environment = Environment(
        loader=FileSystemLoader(_HOME),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(
        **values,
        version=__version__,
        scripts=[Markup(text) for text in texts],
        hashes=" ".join(_hash(text) for text in texts),
        styles=[Markup(_read(name)) for name in ("uPlot.min.css", "page.css")],
    )


def _read(name: str) -> str:
    return read_text(_HOME / name, "a part of the page", _MAX_PART_BYTES)


def _hash(script: str) -> str:
    digest = hashlib.sha256(script.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
