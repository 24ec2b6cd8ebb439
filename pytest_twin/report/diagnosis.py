"""Write the report of a diagnosis as text for the terminal and as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pytest_twin.realization.executor import Forks
from pytest_twin.realization.forks import usable_cores
from pytest_twin.report.diagnosis_plots import joint_figure
from pytest_twin.report.diagnosis_view import DiagnosisView
from pytest_twin.report.finding_words import (
    SURE,
    ambiguity_sentence,
    finding_sentence,
    gain,
    percent,
    place,
    place_of_set,
    readable_unit,
    table_row,
    to_confirm,
)
from pytest_twin.report.frequency import figures_of, rows_of
from pytest_twin.report.law_plot import law_figure
from pytest_twin.report.page import Page, svg_uri
from pytest_twin.report.priors import prior_sentences
from pytest_twin.report.text import number, quantity

MAX_FIGURES = 12
"""Largest number of joints with a figure, largest errors first."""
_MOST_SPANS = 8
"""Largest number of time intervals listed for one recording."""

_VERDICT = {
    "no_mismatch": "No mismatch: the model agrees with the recordings to the noise floor",
    "explained": "Explained: with these findings the residual is at the noise floor",
    "improved": "Improved: these findings explain a part, and a residual remains",
    "unexplained": "Unexplained: the model is wrong, and no known effect explains it",
}
_ENDED_EARLY = (
    "Unexplained so far: the model is wrong, and the search ended before every known effect was "
    "tried"
)
SMALL = "Small corrections of the model, no missing physics; the patched model contains them"
_NO_MISMATCH_WITH_CORRECTIONS = (
    "No mismatch of consequence: the model's error is at most 0.1 % of the travel of each joint"
)
_WHAT_TO_DO = (
    "Next: inspect the joint in this regime, and record more motion there. If you know the cause, "
    "add it as an effect (docs, page Effects)."
)
_MOOD = {"no_mismatch": "good", "explained": "good", "improved": "part", "unexplained": "bad"}


def words(document: Mapping[str, Any]) -> list[str]:
    """Return lines for a terminal: verdict, findings, errors, unexplained residuals, notes.

    Args:
        document: content of ``diagnosis.json``.
    """
    held_out = bool(document["trials"]["held_out"])
    lines = [headline(document)]
    for i, finding in enumerate(document["findings"], 1):
        lines.append(f"  {i}. {finding_sentence(finding)}")
        buys = f"Correcting it {gain(finding, held_out=held_out)}."
        lines.append(f"     {buys} Confidence: {percent(finding['confidence'])}.")
        if rivals := ambiguity_sentence(finding):
            lines.append(f"     {rivals}")
        if finding["confidence"] < SURE:
            lines.append(f"     {to_confirm(finding)}")
    if document.get("small_corrections"):
        lines.append(f"  {SMALL}:")
        lines += [
            f"    {finding_sentence(f)} Small: {f['why_small']}."
            for f in document["small_corrections"]
        ]
    lines += [f"  {line}" for line in prior_sentences(document)]
    if document["held_out"]:
        which = "held-out recordings" if held_out else "fitted recordings, none is held out"
        lines.append(f"  RMS error on the {which}:")
        width = max(len(joint) for joint in document["held_out"])
        for joint, error in document["held_out"].items():
            before, after, floor = errors_shown(error)
            lines.append(
                f"    {joint:<{width}}  model {before}, patched model {after}, noise floor {floor}"
            )
    lines += [f"  {line}" for line in _unexplained_sentences(document)]
    if document["unexplained"]:
        lines.append(f"  {_WHAT_TO_DO}")
    lines += [f"  Note: {note}" for note in document["notes"]]
    return lines


def headline(document: Mapping[str, Any]) -> str:
    """Return the verdict of ``diagnosis.json`` as a sentence."""
    if document["verdict"] == "no_mismatch" and document.get("small_corrections"):
        return _NO_MISMATCH_WITH_CORRECTIONS
    if document["verdict"] == "unexplained" and document.get("not_tried"):
        return _ENDED_EARLY
    return _VERDICT[document["verdict"]] + _measured(document)


def _measured(document: Mapping[str, Any]) -> str:
    """Return the largest error in noise floors, and the windows in which it was measured."""
    if document["verdict"] == "unexplained" or not document.get("held_out"):
        return ""
    error = "rms_before" if document["verdict"] == "no_mismatch" else "rms_after"
    longest = document.get("longest_windows") or {
        "held_out": document["held_out"], "seconds": document.get("tested_windows"),
    }  # fmt: skip
    floors, joint = max((e[error] / e["floor"], j) for j, e in longest["held_out"].items())
    seconds = longest["seconds"]
    windows = f", over windows of {number(seconds)} s" if seconds else ""
    at = f" at {joint}" if len(document["held_out"]) > 1 else ""
    return f" (at most {floors:.2g} noise floors{at}{windows})"


def errors_shown(error: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return RMS errors of a joint before and after, and its noise floor, in one readable unit."""
    factor, unit = readable_unit(max(error["rms_before"], error["floor"]), error["unit"])
    before, after, floor = (
        f"{number(factor * error[key])} {unit}" for key in ("rms_before", "rms_after", "floor")
    )
    return before, after, floor


def _score_shown(score: float | None) -> str:
    """Return a score of the search as text; empty if none was computed."""
    return "" if score is None else f"{score:.1f}"


def render(view: DiagnosisView) -> str:
    """Return the report as one HTML document without external files."""
    document = view.document
    drawn = view.joints[:MAX_FIGURES]
    figures = Forks(usable_cores()).map(joint_figure, drawn)
    return _PAGE.render(
        view=view,
        headline=headline(document),
        mood=_MOOD[document["verdict"]],
        findings=[_view_of_finding(f, view) for f in document["findings"]],
        small_title=SMALL,
        small=[
            {"sentence": finding_sentence(f), "why": f["why_small"]}
            for f in document.get("small_corrections", ())
        ],
        priors=prior_sentences(document),
        left=_unexplained_sentences(document),
        what_to_do=_WHAT_TO_DO,
        figures=[(v.joint, svg_uri(f)) for v, f in zip(drawn, figures, strict=True)],
        figures_left_out=[v.joint for v in view.joints[MAX_FIGURES:]],
        frequency_rows=rows_of(document.get("frequency_response", ())),
        frequency_figures=figures_of(document.get("frequency_response", ())),
        at_floor=view.at_floor,
    )


def _view_of_finding(finding: Mapping[str, Any], view: DiagnosisView) -> dict[str, Any]:
    equation, source = view.laws[finding["effect"]]
    law = finding.get("law")
    return {
        **finding,
        "name": place(finding),
        "sentence": finding_sentence(finding),
        "gain": gain(finding, held_out=bool(view.document["trials"]["held_out"])),
        "ambiguous": ambiguity_sentence(finding),
        "to_confirm": to_confirm(finding),
        "rows": [table_row(finding, key) for key in finding["parameters"]],
        "alternatives": [{**a, "name": place_of_set(a)} for a in finding["alternatives"]],
        "correlated": finding.get("correlated", []),
        "windows": [(n, spans_in_words(w)) for n, w in finding["where"]["windows"].items()],
        "equation": equation,
        "source": source,
        "curve": svg_uri(law_figure(law, finding["joint"])) if law is not None else None,
    }


def _unexplained_sentences(document: Mapping[str, Any]) -> list[str]:
    return [
        f"Unexplained: {percent(u['fraction'])} of the squared error of joint {joint}; "
        f"mainly {u['where']}.{_law_sentence(u)}"
        for joint, u in document["unexplained"].items()
    ]


def _law_sentence(unexplained: Mapping[str, Any]) -> str:
    removed = unexplained.get("unnamed_law_removes")
    if removed is None:
        return ""
    return f" The fitted law removes {percent(removed)} of the squared held-out error."


def spans_in_words(windows: Sequence[Sequence[float]]) -> str:
    """Return time intervals of a recording in order; if there are many, only the longest."""
    longest = sorted(windows, key=lambda w: w[0] - w[1])[:_MOST_SPANS]
    shown = ", ".join(
        f"{number(start)} to {number(end)}" for start, end in sorted((w[0], w[1]) for w in longest)
    )
    more = len(windows) - len(longest)
    return f"{shown} s, and {more} shorter" if more else f"{shown} s"


_PAGE = Page(
    "diagnosis.html.j2",
    "diagnosis.css",
    number=number,
    quantity=quantity,
    percent=percent,
    spans=spans_in_words,
    errors=errors_shown,
    score=_score_shown,
)
