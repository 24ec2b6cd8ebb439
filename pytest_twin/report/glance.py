"""A first look at a mismatch in one line."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pytest_twin.report.text import printable, quantity

if TYPE_CHECKING:
    from pytest_twin.diagnosis.glance import Glance, Suspect

_MOST_PARAMETERS = 2
_MOST_WINDOWS = 2
# Times below this read better in ms.
_MILLISECONDS = 0.1


def glance_words(seen: Glance) -> str:
    """What it looks like and how surely; without a name, where and when the force is missing."""
    if seen.suspect is not None:
        return printable(_suspect(seen.suspect))
    when = f"{seen.where.summary}{_spans(seen)}"
    if seen.joint is None:
        return printable(
            f"no known effect stands out and no joint's force stands out of the noise; the error "
            f"is {seen.floors:.2g} times the floor, {when}"
        )
    return printable(f"no known effect stands out; force is missing at {seen.joint}, {when}")


def _suspect(found: Suspect) -> str:
    values = [
        f"{name.replace('_', ' ')} about {_about(value, unit)}"
        for name, (value, unit) in list(found.values.items())[:_MOST_PARAMETERS]
    ]
    of = f" of {' and '.join(found.of)}" if found.of else ""
    rivals = "".join(f" or {_place(effect, joint)}" for effect, joint in found.rivals)
    return (
        f"looks like {_place(found.term.effect, found.joint)}, {', '.join(values)} "
        f"({math.floor(100 * found.share)} % sure{', could be' + rivals[3:] if rivals else ''}); "
        f"would remove {math.floor(100 * found.removed)} % of the squared error{of}"
    )


def _place(effect: str, joint: str | None) -> str:
    return effect if joint is None else f"{effect} at {joint}"


def _about(value: float, unit: str) -> str:
    rounded = float(f"{value:.2g}")
    if unit == "s" and abs(rounded) < _MILLISECONDS:
        return quantity(1e3 * rounded, "ms")
    return quantity(rounded, unit)


def _spans(seen: Glance) -> str:
    spans = [span for windows in seen.where.windows.values() for span in windows]
    longest = sorted(sorted(spans, key=lambda s: s[0] - s[1])[:_MOST_WINDOWS])
    return "".join(f", {a:.4g} to {b:.4g} s" for a, b in longest)
