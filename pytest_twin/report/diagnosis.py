"""The report of a diagnosis: the verdict, one sentence per finding, and pictures to check it by."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import cache, partial
from importlib import resources
from typing import Any

import jinja2

from pytest_twin.realization.forks import in_forks, usable_cores
from pytest_twin.report.diagnosis_plots import joint_figure
from pytest_twin.report.diagnosis_view import DiagnosisView
from pytest_twin.report.text import number, printable, quantity

MAX_FIGURES = 12
"""Joints that are drawn; the worst mismatch first."""
_MOST_SPANS = 8

_VERDICT = {
    "no_mismatch": "No mismatch: nothing stands above the floor",
    "explained": "Explained: what is left is at the floor",
    "improved": "Improved: something is still unexplained",
    "unexplained": "Unexplained: a mismatch stands, and no known effect earns its place",
}
_MOOD = {"no_mismatch": "good", "explained": "good", "improved": "part", "unexplained": "bad"}


def words(said: Mapping[str, Any]) -> list[str]:
    """What a terminal shows of a ``diagnosis.json``."""
    lines = [_VERDICT[said["verdict"]]]
    lines += [f"  {finding_sentence(f)}" for f in said["findings"]]
    if said["held_out"]:
        what = "held-out" if said["trials"]["held_out"] else "fitted (nothing held out)"
        lines.append(f"  {what} error, root mean square:")
        width = max(len(joint) for joint in said["held_out"])
        for joint, e in said["held_out"].items():
            lines.append(
                f"    {joint:<{width}}  {number(e['rms_before'])} -> {number(e['rms_after'])} "
                f"{e['unit']} (floor {number(e['floor'])})"
            )
    lines += [f"  {line}" for line in _left(said)]
    lines += [f"  next: {f['next_test']}" for f in said["findings"] if f["confidence"] < _SURE]
    lines += [f"  note: {note}" for note in said["notes"]]
    return lines


_SURE = 0.9


def finding_sentence(finding: Mapping[str, Any]) -> str:
    """One sentence: what, where, how much, how surely, what it buys."""
    values = ", ".join(
        f"{key.replace('_', ' ')} {quantity(p['value'], p['unit'])}"
        + (f" ({interval})" if (interval := _interval(p["ci95"])) else "")
        for key, p in finding["parameters"].items()
    )
    name = _name(finding)
    text = (
        f"{name[:1].upper()}{name[1:]}: {values}; confidence {_percent(finding['confidence'])}, "
        f"{_bought(finding['held_out_gain'])}."
    )
    rivals = [a for a in finding["alternatives"] if a["confidence"] >= 1.0 - _SURE]
    if rivals:
        text += f" The data cannot tell it from {' or '.join(_name(a) for a in rivals)}."
    return text


def _bought(gain: float) -> str:
    """What a finding does to the squared error; one slide that ends elsewhere may be most of it."""
    if gain < 0.0:
        return f"adds {_percent(-gain)} to the error that stands without it"
    return f"takes {_percent(gain)} off the error that stands without it"


def render(view: DiagnosisView) -> str:
    """The report as one HTML document that needs nothing but itself."""
    folder = resources.files(__package__)
    style = "".join(
        folder.joinpath(name).read_text("utf-8") for name in ("report.css", "diagnosis.css")
    )
    said = view.said
    drawn = view.joints[:MAX_FIGURES]
    figures = in_forks([partial(joint_figure, v) for v in drawn], usable_cores())
    return _template().render(
        view=view,
        style=style,
        style_hash=base64.b64encode(hashlib.sha256(style.encode()).digest()).decode(),
        headline=_VERDICT[said["verdict"]],
        mood=_MOOD[said["verdict"]],
        findings=[_shown(f, view) for f in said["findings"]],
        left=_left(said),
        figures=[(v.joint, _data_uri(f)) for v, f in zip(drawn, figures, strict=True)],
        figures_left_out=[v.joint for v in view.joints[MAX_FIGURES:]],
        at_floor=view.at_floor,
        share_left=view.share_left,
        left_floors=view.left_floors,
    )


def _shown(finding: Mapping[str, Any], view: DiagnosisView) -> dict[str, Any]:
    law, source = view.laws[finding["effect"]]
    return {
        **finding,
        "name": _name(finding),
        "sentence": finding_sentence(finding),
        "bought": _bought(finding["held_out_gain"]),
        "alternatives": [{**a, "name": _name(a)} for a in finding["alternatives"]],
        "correlated": finding.get("correlated", []),
        "windows": [(n, spans_said(w)) for n, w in finding["where"]["windows"].items()],
        "law": law,
        "source": source,
    }


def _left(said: Mapping[str, Any]) -> list[str]:
    return [
        f"Unexplained at {joint}: {_percent(u['fraction'])} of the squared mismatch, {u['where']}."
        for joint, u in said["unexplained"].items()
    ]


def _name(item: Mapping[str, Any]) -> str:
    place = "" if item["joint"] is None else f" at {item['joint']}"
    return str(item["effect"]).replace("_", " ") + place


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def spans_said(windows: Sequence[Sequence[float]]) -> str:
    """Stretches of a recording; of many the longest, in their order."""
    longest = sorted(windows, key=lambda w: w[0] - w[1])[:_MOST_SPANS]
    said = ", ".join(
        f"{number(start)} to {number(end)}" for start, end in sorted((w[0], w[1]) for w in longest)
    )
    more = len(windows) - len(longest)
    return f"{said} s, and {more} shorter" if more else f"{said} s"


def _interval(ci95: Sequence[float]) -> str:
    """From where to where; nothing of a choice, which is one of a few values and never between."""
    low, high = ci95
    return "" if low == high else f"{number(low)} to {number(high)}"


def _data_uri(svg: bytes) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode()


def _printable(value: object) -> object:
    return printable(value) if type(value) is str else value


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.PackageLoader("pytest_twin.report", "."),
    )
    environment.filters.update(
        number=number, quantity=quantity, interval=_interval, percent=_percent, spans=spans_said
    )
    return environment.get_template("diagnosis.html.j2")
