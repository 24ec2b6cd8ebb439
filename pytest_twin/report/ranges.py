"""Write the randomization ranges of a twin as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pytest_twin.report.page import Page, svg_uri
from pytest_twin.report.ranges_plots import (
    against_figure,
    correlation_figure,
    envelope_figure,
    transform_figure,
)

_MOODS = {"useful": "good", "too_narrow": "bad", "too_wide": "bad", "not_checked": "part"}
_RECORDINGS = 4
"""Largest number of recordings with a figure; ``ranges.json`` has all."""


def render(document: Mapping[str, Any]) -> str:
    """Return the ranges as one HTML document without external files.

    Args:
        document: ``ranges.json``.
    """
    recordings: dict[str, list[Mapping[str, Any]]] = {}
    for one in document["envelopes"]:
        recordings.setdefault(one["recording"], []).append(one)
    shown = dict(list(recordings.items())[:_RECORDINGS])
    single = [k for k, one in enumerate(document["coordinates"]) if one["body"] is None]
    correlation = correlation_figure(
        [document["coordinates"][k]["name"] for k in single],
        [[document["correlation"][i][k] for k in single] for i in single],
    )
    against = document["against"]
    return _PAGE.render(
        document=document,
        mood=_MOODS[document["verdict"]],
        headline=document["words"][0],
        envelopes={name: svg_uri(envelope_figure(panels)) for name, panels in shown.items()},
        left_out=len(recordings) - len(shown),
        transform=svg_uri(transform_figure(document["check"]["joints"]))
        if document["check"]
        else None,
        correlation=None if correlation is None else svg_uri(correlation),
        against=svg_uri(against_figure(against["entries"]))
        if against and against["entries"]
        else None,
    )


_PAGE = Page("ranges.html.j2", "diagnosis.css")
