"""The one-line text of a quick diagnosis."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pytest_twin.report.finding_words import meaning_of, place, readable
from pytest_twin.report.text import printable, quantity

if TYPE_CHECKING:
    from pytest_twin.diagnosis.glance import Glance, Suspect

_MOST_PARAMETERS = 2
_MOST_WINDOWS = 2


def glance_words(seen: Glance) -> str:
    """The most likely effect with its confidence, or where and when a force is missing."""
    if seen.suspect is not None:
        return printable(_suspect(seen.suspect))
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


def _suspect(found: Suspect) -> str:
    effect = found.term.effect
    values = [
        f"{meaning_of(effect, name)} about {_about(value, unit)}"
        for name, (value, unit) in list(found.values.items())[:_MOST_PARAMETERS]
    ]
    of = f" of {' and '.join(found.of)}" if found.of else ""
    rivals = " or ".join(place({"effect": e, "joint": j}) for e, j in found.rivals)
    return (
        f"probably {place({'effect': effect, 'joint': found.joint})}: {', '.join(values)}; "
        f"confidence {math.floor(100 * found.share)} %"
        f"{f', it could also be {rivals}' if rivals else ''}; correcting it would remove "
        f"{math.floor(100 * found.removed)} % of the squared error{of}"
    )


def _about(value: float, unit: str) -> str:
    rounded = float(f"{value:.2g}")
    factor, unit = readable(rounded, unit)
    return quantity(factor * rounded, unit)


def _spans(seen: Glance) -> str:
    spans = [span for windows in seen.where.windows.values() for span in windows]
    longest = sorted(sorted(spans, key=lambda s: s[0] - s[1])[:_MOST_WINDOWS])
    return "".join(f", {a:.4g} to {b:.4g} s" for a, b in longest)
