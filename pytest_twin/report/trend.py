"""Write the trend of a robot as text for the terminal and as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pytest_twin.report.page import Page, svg_uri
from pytest_twin.report.text import number, quantity
from pytest_twin.report.trend_plots import joint_figure
from pytest_twin.words import counted

_DAY = 10
"""Number of characters of a date without its time."""
_MOST_LINES = 12
"""Largest number of changes that are printed."""


def words(document: Mapping[str, Any]) -> list[str]:
    """Return lines for a terminal.

    Args:
        document: content of ``trend.json``.
    """
    changes = document["changes"]
    lines = [headline(document), f"  {_sessions(document)}"]
    lines += [f"  {change_sentence(one)}" for one in changes[:_MOST_LINES]]
    if len(changes) > _MOST_LINES:
        lines.append(f"  {len(changes) - _MOST_LINES} more are in trend.json")
    lines += [f"  {mixed_sentence(one)}" for one in document["mixed"][:_MOST_LINES]]
    lines += [f"  Declared: {one}" for one in document["declared"]]
    early = [document["ended_early"]] if document["ended_early"] else []
    return lines + [f"  Note: {note}" for note in (*early, *document["notes"])]


def headline(document: Mapping[str, Any]) -> str:
    """Return the verdict as a sentence."""
    if document["verdict"] == "no_alarm":
        return "No alarm: no parameter changed beyond the scatter of the sessions"
    names = list(dict.fromkeys(one["parameter"] for one in (*document["changes"],
                                                            *document["mixed"])))  # fmt: skip
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"Alarm: {', '.join(names[:3])}{more}"


def _sessions(document: Mapping[str, Any]) -> str:
    sessions = document["sessions"]
    first, last = (sessions[i]["date"][:_DAY] for i in (0, -1))
    return (
        f"{counted(len(sessions), 'session')} from {first} to {last}. If nothing changes, an alarm "
        f"has a probability of {100 * document['level']:.3g} %."
    )


def change_sentence(change: Mapping[str, Any]) -> str:
    """Return parameter, size, dates and probability of one change."""
    value, unit = change["change"]["value"], change["change"]["unit"]
    if change["relative"]:
        size = f"{100 * value:+.0f} %"
    else:
        low, high = change["change"]["ci95"]
        size = f"{quantity(value, unit)} ({number(low)} to {number(high)})"
    before, after = (date[:_DAY] for date in change["between"])
    when = (
        f"between {before} and {after}"
        if change["kind"] == "step"
        else (f"gradually from {before} to {after}")
    )
    return (
        f"{change['parameter']}: {change['meaning']} changed by {size} {when}; by chance: "
        f"{100 * change['probability_by_chance']:.2g} %"
    )


def mixed_sentence(mixed: Mapping[str, Any]) -> str:
    """Return why a parameter that switches between two levels is doubtful."""
    return (
        f"{mixed['parameter']} switches {mixed['switches']} times between two levels: recordings "
        "of two robots, tools or controllers? State robot, tool and controller in the metadata"
    )


def render(document: Mapping[str, Any], *, every: bool = True) -> str:
    """Return the page as one HTML document without external files.

    Args:
        document: content of ``trend.json``.
        every: whether all joints are drawn; else those with an alarm.
    """
    alarmed = {one["joint"] for one in document["changes"]}
    alarmed |= {document["parameters"][one["parameter"]]["joint"] for one in document["mixed"]}
    joints = [joint for joint in document["held_out"] if every or joint in alarmed]
    return _PAGE.render(
        document=document,
        headline=headline(document),
        mood="good" if document["verdict"] == "no_alarm" else "bad",
        sessions=_sessions(document),
        changes=[change_sentence(one) for one in document["changes"]],
        mixed=[mixed_sentence(one) for one in document["mixed"]],
        figures=[(joint, svg_uri(joint_figure(document, joint))) for joint in joints],
        rows=_rows(document),
        day=_DAY,
    )


def _rows(document: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Meaning, first and last value, and the smallest change that would be found."""
    rows = []
    for name, one in document["parameters"].items():
        known = [value["value"] for value in one["values"] if value is not None]
        if not known:
            rows.append((name, one["meaning"], "the motion does not show it", "", ""))
            continue
        least = one["detectable"]
        rows.append((
            name, one["meaning"], quantity(known[0], one["unit"]), quantity(known[-1], one["unit"]),
            "none" if least is None else quantity(least, one["unit"]),
        ))  # fmt: skip
    return rows


_PAGE = Page("trend.html.j2", "diagnosis.css")
