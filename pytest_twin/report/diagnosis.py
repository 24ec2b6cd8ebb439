"""The report of a diagnosis: the verdict, one sentence per finding, and pictures to check it by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pytest_twin.report.text import number, quantity

_VERDICT = {
    "no_mismatch": "No mismatch: nothing stands above the floor",
    "explained": "Explained: what is left is at the floor",
    "improved": "Improved: something is still unexplained",
    "unexplained": "Unexplained: a mismatch stands, and no known effect earns its place",
}


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
    for joint, left in said["unexplained"].items():
        lines.append(
            f"  unexplained at {joint}: {100 * left['fraction']:.3g} % of the squared error, "
            f"{left['where']}"
        )
    lines += [f"  note: {note}" for note in said["notes"]]
    return lines


def finding_sentence(finding: Mapping[str, Any]) -> str:
    """One sentence: what, where, how much, how surely, what it buys."""
    name = finding["effect"].replace("_", " ")
    place = "" if finding["joint"] is None else f" at {finding['joint']}"
    values = ", ".join(
        f"{key.replace('_', ' ')} {quantity(p['value'], p['unit'])} "
        f"[{number(p['ci95'][0])}, {number(p['ci95'][1])}]"
        for key, p in finding["parameters"].items()
    )
    return (
        f"{name}{place}: {values}; confidence {100 * finding['confidence']:.0f} %, takes "
        f"{100 * finding['held_out_gain']:.0f} % off the error without it"
    )
