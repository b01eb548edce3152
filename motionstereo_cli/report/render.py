"""From data to HTML."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from motionstereo_cli import __version__

_HOME = Path(__file__).parent


def render(template: str, **values: Any) -> str:
    """Return a template of this folder filled in; all text is escaped.

    The page obeys no script but its own, and loads nothing but pictures and videos: its
    Content-Security-Policy says so.
    """
    scripts = [_read(name) for name in ("uPlot.iife.min.js", "page.js")]
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
        scripts=[Markup(text) for text in scripts],
        hashes=" ".join(_hash(text) for text in scripts),
        styles=[Markup(_read(name)) for name in ("uPlot.min.css", "page.css")],
    )


def _read(name: str) -> str:
    return (_HOME / name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    digest = hashlib.sha256(script.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
