"""Format numbers and names for people."""

from __future__ import annotations

import math

from pytest_twin.outcome import Measure, tolerance_ratio


def printable(text: str) -> str:
    """Return ``text`` on one line and without terminal escape sequences."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else "�" for char in text)


def number(value: float) -> str:
    """Format a number with four significant digits."""
    if not math.isfinite(value):
        return str(value)
    return f"{value:.4g}"


def quantity(value: float, unit: str) -> str:
    """Format a number with four significant digits and its unit."""
    return number(value) if unit == "1" else f"{number(value)} {unit}"


def use(measure: Measure) -> str:
    """Return the used share of the tolerance, ``47 %``, ``3.2 times``."""
    used = tolerance_ratio(measure)
    if not math.isfinite(used):
        return "all of none" if math.isfinite(measure.error) else "no number"
    if used < 0.001:
        return "< 0.1 %"
    return f"{used:.3g} times" if used >= 9.995 else f"{100 * used:.3g} %"
