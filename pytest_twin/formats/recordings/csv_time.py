"""Determine the unit of a CSV file's times: stated, or recognised by date and sampling rate."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from pytest_twin.formats.ros_serialization import Floats

TIME_UNITS: Mapping[str, int] = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1000, "ns": 1}
"""Unit of a time -> ns."""
_NAMES = {
    "s": "s", "sec": "s", "secs": "s", "second": "s", "seconds": "s",
    "ms": "ms", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "us": "us", "usec": "us", "µs": "us", "μs": "us", "micros": "us", "microseconds": "us",
    "ns": "ns", "nsec": "ns", "nanos": "ns", "nanoseconds": "ns",
}  # fmt: skip
_TIME_HEADING = re.compile(r"(?:time|timestamp|stamp|t)[ _]*[\[(]?([a-zµμ]+)[\])]?", re.IGNORECASE)
# s since 1970: 2000-01-01 and 2100-01-01.
_DATES = (946_684_800.0, 4_102_444_800.0)
# Hz. Robots log joint states at these rates; a log at fewer samples shows no dynamics.
_SLOWEST, _FASTEST = 5.5, 20_000.0
# Hz. Faster whole nanoseconds may be whole microseconds of a log at less than 10 Hz.
_FASTEST_NS, _FAST_NS = 9_999.0, 1_050.0
# Fewer different times show no sampling rate.
_FEWEST = 3


class TimeUnitError(ValueError):
    """The unit of times cannot be determined; the text says which units are possible."""


def unit_in_heading(heading: str) -> str | None:
    """Return the unit that a heading of times states, such as ``time_ms`` or ``t [s]``."""
    match = _TIME_HEADING.fullmatch(heading.strip())
    return None if match is None else unit_named(match[1])


def unit_named(name: str) -> str | None:
    """Return the unit of times with a name, such as ``msec``; None for another word."""
    return _NAMES.get(name.strip().lower())


def unit_of_times(times: Floats, *, whole: bool) -> tuple[str, str]:
    """Return the unit of times that state none, and a note or nothing.

    Whole numbers are ns and others s, unless date or rate contradict.

    Args:
        times: (n,) finite times as written.
        whole: whether all are written as whole numbers.

    Raises:
        TimeUnitError: the unit has to be stated.
    """
    usual = "ns" if whole else "s"
    different = np.unique(times)
    if len(different) < 2:
        return usual, ""
    dated = _unit_of_dates(float(different[0]), float(different[-1]))
    rates = {
        unit: 1e9 / (float(np.median(np.diff(different))) * size)
        for unit, size in TIME_UNITS.items()
    }
    if len(different) < _FEWEST and dated:
        return dated, _note(dated, "their dates say so")
    if len(different) < _FEWEST and not (whole and rates["ns"] >= _FASTEST_NS):
        return usual, ""
    likely = [unit for unit, rate in rates.items() if _SLOWEST < rate <= _FASTEST]
    if dated == usual and (usual in likely or not likely):
        return usual, ""
    if dated and dated != usual and not whole:
        return dated, _note(dated, "their dates say so")
    if dated and dated != usual and (dated in likely) != (rates[usual] < _FASTEST_NS):
        if dated in likely:
            return dated, _note(dated, f"dates and {rates[dated]:.4g} Hz")
        return usual, _note(usual, f"{rates[usual]:.4g} Hz; as {dated} they would be dates")
    if not dated and whole and rates["ns"] < _FASTEST_NS:
        if rates["ns"] <= _FAST_NS:
            return usual, ""
        return usual, _note(usual, f"{rates['ns']:.4g} Hz; --time-unit us if they are microseconds")
    if not dated and not whole and usual in likely:
        return usual, ""
    offers = ", ".join(f"{rate:.4g} Hz as {unit}" for unit, rate in rates.items())
    if len(different) < len(times):
        offers += f"; {len(times)} rows at {len(different)} times"
    raise TimeUnitError(offers)


def _unit_of_dates(first: float, last: float) -> str:
    """The unit in which both times are dates from 2000 to 2100; empty if there is none."""
    for unit, size in TIME_UNITS.items():
        if _DATES[0] <= first * size * 1e-9 and last * size * 1e-9 <= _DATES[1]:
            return unit
    return ""


def _note(unit: str, reason: str) -> str:
    return "" if unit == "s" else f"times are read as {unit} ({reason})"
