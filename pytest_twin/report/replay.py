"""Write one replay as an HTML page: error of each joint, and frequency responses."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import jinja2

from pytest_twin.report.frequency import figures_of, rows_of
from pytest_twin.report.page import style_of, template


def render(summary: Mapping[str, Any]) -> str:
    """Return the JSON of a replay as one HTML document without external files."""
    style = style_of("report.css", "diagnosis.css")
    responses = summary["frequency_response"]
    return _template().render(
        summary=summary,
        style=style.text,
        style_hash=style.sha256,
        joints=[
            (joint, *(_cell(one[name]) for name in ("rms", "max", "mean", "at")), one["unit"])
            for joint, one in summary["joints"].items()
        ],
        frequency_rows=rows_of(responses),
        frequency_figures=figures_of(responses),
    )


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


@cache
def _template() -> jinja2.Template:
    return template("replay.html.j2")
