"""Write one replay as an HTML page: error of each joint, and frequency responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pytest_twin.report.frequency import figures_of, rows_of
from pytest_twin.report.page import Page


def render(summary: Mapping[str, Any]) -> str:
    """Return the JSON of a replay as one HTML document without external files."""
    responses = summary["frequency_response"]
    return _PAGE.render(
        summary=summary,
        joints=[
            (joint, *(_cell(one[name]) for name in ("rms", "max", "mean", "at")), one["unit"])
            for joint, one in summary["joints"].items()
        ],
        frequency_rows=rows_of(responses),
        frequency_figures=figures_of(responses),
    )


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


_PAGE = Page("replay.html.j2", "diagnosis.css")
