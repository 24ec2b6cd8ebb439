"""Style sheets, templates and embedded pictures of all HTML pages."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import jinja2

from pytest_twin.report.text import printable


@dataclass(frozen=True, slots=True)
class Style:
    """Style sheets of a page, concatenated.

    Attributes:
        sha256: SHA-256 in base64, for the page's content security policy.
    """

    text: str
    sha256: str


@cache
def style_of(*sheets: str) -> Style:
    """Read style sheets of this folder."""
    folder = resources.files(__package__)
    text = "".join(folder.joinpath(name).read_text("utf-8") for name in sheets)
    return Style(text, base64.b64encode(hashlib.sha256(text.encode()).digest()).decode())


def template(name: str, **filters: Callable[..., Any]) -> jinja2.Template:
    """Load a template of this folder, with filters.

    Inserted text is escaped, and its control characters are made printable. The template's own
    markup is not changed.
    """
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.PackageLoader("pytest_twin.report", "."),
    )
    environment.filters.update(filters)
    return environment.get_template(name)


def svg_uri(svg: bytes) -> str:
    """Return an SVG as data URI."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode()


def _printable(value: object) -> object:
    return printable(value) if type(value) is str else value
