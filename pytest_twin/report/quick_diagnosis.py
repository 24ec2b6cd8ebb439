"""Format a quick diagnosis as one line of text."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pytest_twin.report.finding_words import meaning_of, place, readable_unit
from pytest_twin.report.text import printable, quantity
from pytest_twin.words import join_words

if TYPE_CHECKING:
    from pytest_twin.diagnosis.likely_effect import LikelyEffect, Place
    from pytest_twin.diagnosis.quick_diagnosis import QuickDiagnosis

_MOST_PARAMETERS = 2
"""Largest number of parameters in the line."""
_MOST_WINDOWS = 2
"""Largest number of time windows in the line."""


def quick_diagnosis_in_words(seen: QuickDiagnosis) -> str:
    """Return the most likely effects, joint and time of a missing force, or that there is none."""
    if seen.likely_effects:
        parts = [_in_words(found) for found in seen.likely_effects]
        if seen.unexplained:
            parts.append(f"no known effect explains the error of {join_words(seen.unexplained)}")
        return printable("; ".join(parts))
    if seen.is_at_noise:
        return f"the error is within the noise ({seen.floors:.2g} noise floors)"
    when = f"{seen.where.summary}{_spans(seen)}"
    if seen.joint is None:
        return printable(
            "no known effect explains the error, and no joint shows a missing force above the "
            f"noise; the error is {seen.floors:.2g} times the noise floor; mainly {when}"
        )
    return printable(
        f"no known effect explains the error; a force is missing at joint {seen.joint}, "
        f"mainly {when}"
    )


def _in_words(found: LikelyEffect) -> str:
    effect = found.place[0]
    shown = [(name, *value) for name, value in found.values.items() if value[0] != 0.0]
    values = ", ".join(
        f"{meaning_of(effect, name)} about {_approximate_value(value, unit)}"
        for name, value, unit in shown[:_MOST_PARAMETERS]
    )
    of = f" of {join_words(found.explained_joints)}" if found.explained_joints else ""
    removes = f"would remove {math.floor(100 * found.removed_share)} % of the squared error{of}"
    if found.alternatives:
        places = [f"{_place_name(found.place)} ({values})", *map(_place_name, found.alternatives)]
        return f"could be {join_words(places, 'or')}; correcting the first {removes}"
    return (
        f"probably {_place_name(found.place)}: {values}; "
        f"confidence {math.floor(100 * found.posterior_share)} %; correcting it {removes}"
    )


def _place_name(where: Place) -> str:
    effect, joints = where
    return place({"effect": effect, "joint": join_words(joints) if joints else None})


def _approximate_value(value: float, unit: str) -> str:
    rounded = float(f"{value:.2g}")
    factor, unit = readable_unit(rounded, unit)
    return quantity(factor * rounded, unit)


def _spans(seen: QuickDiagnosis) -> str:
    spans = [span for windows in seen.where.windows.values() for span in windows]
    longest = sorted(sorted(spans, key=lambda s: s[0] - s[1])[:_MOST_WINDOWS])
    return "".join(f", {a:.4g} to {b:.4g} s" for a, b in longest)
