"""Prepare the data of a plot of series: present series, the golden's, and the tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.outcome import Measure, tolerance_ratio

MAX_PANELS = 3
"""Largest number of panels of a plot."""
BUCKETS = 250
"""Default number of intervals of a line; each shows its minimum and maximum."""
_COMMAND = "command:"
_LARGEST = 1e100
"""Size above which a value is not drawn, because the axis would overflow."""
_ORDER = ("magnitude", "phase", "coherence")


class Series(Protocol):
    """Series on one axis, in the form of ``checks.base.Trace``."""

    @property
    def axis(self) -> tuple[str, str]:
        """Return (name, unit) of ``x``."""

    @property
    def x(self) -> FloatArray:
        """Return the (n,) values of the axis."""

    @property
    def columns(self) -> Mapping[str, tuple[str, FloatArray]]:
        """Return name -> (unit, (n,) values)."""


@dataclass(frozen=True, slots=True)
class Line:
    """(n,) values over (n,) positions on the axis; NaN for values that cannot be drawn."""

    x: FloatArray
    y: FloatArray

    def __post_init__(self) -> None:
        with np.errstate(invalid="ignore"):
            drawable = np.where(np.abs(self.y) < _LARGEST, self.y, np.nan)
        object.__setattr__(self, "y", drawable)


@dataclass(frozen=True, slots=True)
class Worst:
    """The sample with the largest error relative to its tolerance.

    Attributes:
        x: its position on the axis.
        error, tolerance: error and tolerance, in the panel's unit.
        passed: whether the error is within tolerance.
    """

    x: float
    y: float
    error: float
    tolerance: float
    passed: bool


@dataclass(frozen=True, slots=True)
class Panel:
    """Data of one quantity.

    Attributes:
        title, unit: name and unit of the quantity.
        then: series for comparison, or None.
        command: commanded series of the same unit, or None.
        worst: the worst sample, None without a tolerance for samples.
        bound: measure of this quantity with the largest used share of tolerance, such as an RMS.
    """

    title: str
    unit: str
    now: Line
    then: Line | None = None
    against: str = "golden"
    command: Line | None = None
    worst: Worst | None = None
    bound: Measure | None = None

    @property
    def residual(self) -> Line | None:
        """Return now minus then, at the positions of now."""
        if self.then is None:
            return None
        return Line(self.now.x, self.now.y - np.interp(self.now.x, self.then.x, self.then.y))


def time_panels(
    measures: Sequence[Measure], now: Series, stored: Series | None
) -> tuple[list[Panel], int]:
    """Return panels over time, the worst first, and the number of omitted ones."""
    panels = []
    for name, (unit, values) in now.columns.items():
        quantity_name, _, subject = name.partition(":")
        commanded = now.columns.get(_COMMAND + subject)
        shares_panel = any(
            name == _COMMAND + other.partition(":")[2] and other != name and unit == other_unit
            for other, (other_unit, _) in now.columns.items()
        )
        if shares_panel:
            continue
        line = Line(now.x, values)
        about = [m for m in measures if m.unit == unit and m.subject == subject]
        bound = _bound_of(line, about)
        command = None
        if commanded is not None and commanded[0] == unit and not name.startswith(_COMMAND):
            command = Line(now.x, commanded[1])
        panels.append(
            Panel(
                title=f"{quantity_name} of {subject}" if subject else name,
                unit=unit,
                now=line,
                then=_golden_line(stored, name),
                against=bound.against if bound else _reference_word(measures),
                command=command,
                worst=None if bound is None or bound.time is None else _worst(bound, bound.time),
                bound=max(about, key=tolerance_ratio, default=None),
            )
        )
    panels.sort(key=_sort_key, reverse=True)
    return panels[:MAX_PANELS], max(0, len(panels) - MAX_PANELS)


def frequency_panels(
    measures: Sequence[Measure], now: Series, stored: Series | None
) -> tuple[list[Panel], int]:
    """Return panels over frequency: magnitude in dB, phase, coherence, in this order."""
    panels = []
    for name, (unit, values) in now.columns.items():
        kind, _, subject = name.partition(":")
        then = _golden_line(stored, name)
        line = Line(now.x, values)
        if kind == "magnitude" and unit != "dB":
            line, unit = _decibel(line), f"dB re {unit}" if unit != "1" else "dB"
            then = None if then is None else _decibel(then)
        bound = next((measure for measure in measures if measure.name == kind), None)
        panels.append(
            Panel(
                title=f"{kind} of {subject}" if subject else kind,
                unit="" if unit == "1" else unit,
                now=line,
                then=then,
                worst=None if bound is None or then is None else _worst_line(bound, line, then),
            )
        )
    panels.sort(key=lambda panel: _position(panel.title))
    return panels[:MAX_PANELS], max(0, len(panels) - MAX_PANELS)


def thin(line: Line, stretches: int = BUCKETS) -> Line:
    """Reduce a line to the minimum and maximum of each of ``stretches`` sections."""
    if line.x.size <= 2 * stretches:
        return line
    last = line.x.size - 1
    width = -(-line.x.size // stretches)
    count = -(-line.x.size // width)
    # Pad with the last sample; values that are not finite are neither minimum nor maximum.
    pieces = np.pad(line.y, (0, count * width - line.y.size), mode="edge").reshape(count, width)
    finite = np.isfinite(pieces)
    lowest = np.where(finite, pieces, np.inf).argmin(axis=1)
    highest = np.where(finite, pieces, -np.inf).argmax(axis=1)
    picked = np.minimum(width * np.arange(count) + np.stack([lowest, highest]), last)
    index = np.unique(np.append(picked, [0, last]))
    return Line(line.x[index], line.y[index])


def shift(line: Line, offset: float) -> Line:
    """Return ``line`` shifted up by ``offset``."""
    return replace(line, y=line.y + offset)


def _sort_key(panel: Panel) -> tuple[float, float]:
    """Return a sort key: used share of tolerance, then residual relative to the golden's range."""
    left = panel.residual
    used = -1.0 if panel.bound is None else tolerance_ratio(panel.bound)
    if left is None or panel.then is None:
        return (used, _range(panel.now) * 1e-12)
    scale = _range(panel.then) or 1.0
    return (used, float(np.max(np.abs(np.nan_to_num(left.y)))) / scale)


def _bound_of(line: Line, measures: Sequence[Measure]) -> Measure | None:
    """Return the worst measure that refers to one sample of a series.

    Such a measure has a time, and its value equals the series at that time. A mean over the series
    (RMS) has no time and no tolerance band.
    """
    scale = _range(line) + 1e-12
    fitting = [
        measure
        for measure in measures
        if measure.time is not None
        and abs(float(np.interp(measure.time, line.x, line.y)) - measure.measured) <= 1e-3 * scale
    ]
    return max(fitting, key=tolerance_ratio, default=None)


def _worst(measure: Measure, time: float) -> Worst:
    return Worst(time, measure.measured, measure.error, measure.tolerance, measure.passed)


def _worst_line(measure: Measure, now: Line, then: Line) -> Worst | None:
    """Return the line of a frequency response to which a measure refers."""
    found = np.interp(then.x, now.x, now.y)
    error = np.abs(found - then.y)
    if measure.unit == "rad":
        error = np.abs((found - then.y + np.pi) % (2.0 * np.pi) - np.pi)
    at = int(np.argmax(np.nan_to_num(error)))
    return Worst(
        float(then.x[at]), float(found[at]), measure.error, measure.tolerance, measure.passed
    )


def _range(line: Line) -> float:
    """Return maximum minus minimum of the finite values."""
    finite = line.y[np.isfinite(line.y)]
    return float(np.ptp(finite)) if finite.size else 0.0


def _golden_line(stored: Series | None, name: str) -> Line | None:
    if stored is None or name not in stored.columns:
        return None
    return Line(stored.x, stored.columns[name][1])


def _reference_word(measures: Sequence[Measure]) -> str:
    names = {measure.against for measure in measures}
    return "recording" if names == {"recording"} else "golden"


def _decibel(line: Line) -> Line:
    with np.errstate(divide="ignore"):
        return replace(line, y=20.0 * np.log10(np.abs(line.y)))


def _position(title: str) -> int:
    kind = title.split(" ")[0]
    return _ORDER.index(kind) if kind in _ORDER else len(_ORDER)
