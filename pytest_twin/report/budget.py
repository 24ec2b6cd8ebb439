"""Write the error budget of a twin as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pytest_twin.report.budget_plots import categories_figure, waterfall_figure
from pytest_twin.report.page import Page, svg_uri

_STATES = {
    "measured": "measured",
    "counted_elsewhere": "counted with",
    "not_measured": "not measured",
    "not_tried": "not known: not every record was tried",
}


def render(document: Mapping[str, Any]) -> str:
    """Return the budget as one HTML document without external files.

    Args:
        document: ``budget.json``.
    """
    unmeasured = [one for one in document["categories"] if one["state"] == "not_measured"]
    mood = {"exceeded": "bad", "within": "good"}.get(document["verdict"], "part")
    # A kind of error that nothing measures may be large elsewhere than on the held-out recordings.
    mood = "part" if mood == "good" and unmeasured else mood
    figures = {}
    for quantity in ("position", "rotation"):
        if quantity == "rotation" and not any(
            one["moves"] and one["moves"][quantity] for one in document["categories"]
        ):
            continue
        waterfall = waterfall_figure(document, quantity)
        figures[quantity] = {
            "categories": svg_uri(categories_figure(document, quantity)),
            "waterfall": None if waterfall is None else svg_uri(waterfall),
        }
    return _PAGE.render(
        document=document,
        mood=mood,
        headline=document["words"][0],
        more_words=document["words"][1:],
        estimated=_estimated(document),
        unmeasured=len(unmeasured),
        states=_STATES,
        figures=figures,
    )


def _estimated(document: Mapping[str, Any]) -> str:
    found = document["total"]["sampled"]
    if found is None:
        return "No record of this twin affects the frame"
    words = (
        f"By the estimates {1e3 * found['position']:.3g} mm and {1e3 * found['rotation']:.3g} mrad"
    )
    shares = [
        f"{100 * value:.3g} % of the {name}"
        for name, value in document["total"]["share"].items()
        if value is not None
    ]
    return f"{words}: {', '.join(shares)} that the task allows" if shares else words


_PAGE = Page("budget.html.j2", "diagnosis.css")
