"""Style sheets, templates and embedded pictures of all HTML pages."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from functools import cached_property
from importlib import resources
from typing import Any

import jinja2

from pytest_twin.report.text import printable


class Page:
    """An HTML page without external files.

    Inserted text is escaped, and its control characters are made printable. The template's own
    markup is not changed.
    """

    def __init__(self, name: str, *sheets: str, **filters: Callable[..., Any]) -> None:
        """Make a page of files of this folder, which are read at its first use.

        Args:
            name: template.
            sheets: style sheets beside that of all pages.
            filters: filters of the template.
        """
        self._name, self._sheets, self._filters = name, ("report.css", *sheets), filters

    @cached_property
    def _template(self) -> jinja2.Template:
        environment = jinja2.Environment(
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            finalize=_printable,
            trim_blocks=True,
            lstrip_blocks=True,
            loader=jinja2.PackageLoader("pytest_twin.report", "."),
        )
        environment.filters.update(self._filters)
        return environment.get_template(self._name)

    @cached_property
    def _style(self) -> dict[str, str]:
        """The style sheets, and their SHA-256 in base64 for the content security policy."""
        folder = resources.files(__package__)
        text = "".join(folder.joinpath(name).read_text("utf-8") for name in self._sheets)
        sha256 = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        return {"style": text, "style_hash": sha256}

    def render(self, **fields: Any) -> str:
        """Return the page with these fields of its template."""
        return self._template.render(**self._style, **fields)


def svg_uri(svg: bytes) -> str:
    """Return an SVG as data URI."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode()


def _printable(value: object) -> object:
    return printable(value) if type(value) is str else value
