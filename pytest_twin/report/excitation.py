"""Write the report of an excitation as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pytest_twin.report.excitation_plots import deviations_figure, motion_figure
from pytest_twin.report.page import Page, svg_uri

_VERDICT = {
    "identifiable": ("All requested parameters are identifiable", "good"),
    "not_identifiable": ("Some requested parameters are not identifiable", "bad"),
    "separable": ("A motion is expected to decide between the hypotheses", "good"),
    "not_separable": ("No motion is expected to decide between the hypotheses", "bad"),
}
_KIND = {
    "steps": "Steps of one joint",
    "chirp": "Chirps of one joint",
    "reversals": "Slow reversals of one joint",
    "grid": "Poses at rest",
    "fourier": "Fourier series",
    "moves": "Moves from rest to rest",
}
_CHECK_VERDICT = {
    "separable": "The check distinguishes what motions within the limits can",
    "not_separable": "The check misses effects that other motions show",
}
MARGINS = ("position", "velocity", "acceleration", "effort", "power", "stop", "workspace",
           "clearance")  # fmt: skip


def render(document: Mapping[str, Any], abort: Mapping[str, Any], drawn: Mapping[str, Any]) -> str:
    """Return the report as one HTML document without external files.

    Args:
        document: ``excitation.json``.
        abort: ``abort.json``.
        drawn: name of a motion -> its series, from :func:`excitation.document.courses`.
    """
    headline, mood = _VERDICT[document["verdict"]]
    if "check" in document:
        headline = _CHECK_VERDICT[document["verdict"]]
    groups = [
        (words, [one for one in document["trajectories"] if one["kind"] == kind])
        for kind, words in _KIND.items()
    ]
    return _PAGE.render(
        document=document,
        abort=abort,
        headline=headline,
        mood=mood,
        margins=MARGINS,
        groups=[(words, own) for words, own in groups if own],
        figures={name: svg_uri(motion_figure(course)) for name, course in drawn.items()},
        deviations=_deviations(document),
    )


def _deviations(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    found = []
    for mechanism in document["mechanisms"]:
        own = [
            one
            for one in document["predicted"]
            if one["mechanism"] == mechanism
            and one["relative_std"]
            and not (one["small"] and one["identifiable"])
        ]
        if own:
            found.append((mechanism, svg_uri(deviations_figure(own))))
    return found


_PAGE = Page("excitation.html.j2", "diagnosis.css")
