"""One plot for each golden, as a small SVG that is legible on white and on black.

matplotlib is imported when something is drawn, which happens in the child process.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.outcome import Measure, use_of_tolerance
from pytest_twin.report.plot_style import BAND, DIM, FAIL, GOLDEN, INK, NOW, PASS, STYLE, finish
from pytest_twin.report.text import number, printable, quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

MAX_SERIES = 3
MAX_BARS = 14
BUCKETS = 250
_LABEL_CHARS = 46
_WIDTH_INCHES = 7.6


class Series(Protocol):
    """Series on one axis, as checks record them (``checks.base.Trace``)."""

    @property
    def axis(self) -> tuple[str, str]:
        """(name, unit) of ``x``."""

    @property
    def x(self) -> FloatArray:
        """(n,) values of the axis."""

    @property
    def columns(self) -> Mapping[str, tuple[str, FloatArray]]:
        """Name -> (unit, (n,) values)."""


def plot(
    kind: str,
    title: str,
    measures: Sequence[Measure],
    now: Series | None,
    stored: Series | None,
) -> bytes | None:
    """The plot of one golden, or None where nothing was measured.

    Args:
        kind: the check's name.
        title: the golden's title.
        measures: what was held against tolerances.
        now: what was observed now.
        stored: the golden's own series.

    Returns:
        SVG: with series their course, what is left between them and the worst sample; over
        frequency the magnitude, phase and coherence; without series each error against its
        tolerance.
    """
    if now is not None and now.x.size > 1 and now.columns:
        draw = _draw_frequency if now.axis[1] == "Hz" else _draw_series
        return _render(title, draw, measures, now, stored)
    if measures:
        return _render(title, _draw_bars, measures)
    return None


def _render(title: str, draw: Any, *what: Any) -> bytes:
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure, *what)
        figure.suptitle(_label(title, 90), x=0.01, ha="left", fontsize=9.5, fontweight="bold")
        buffer = io.BytesIO()
        figure.savefig(
            buffer,
            format="svg",
            transparent=True,
            metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
        )
    return finish(buffer.getvalue().decode("utf-8")).encode("utf-8")


def _draw_series(
    figure: Figure, measures: Sequence[Measure], now: Series, stored: Series | None
) -> None:
    names = _most_telling(measures, now, stored)
    left_out = len(now.columns) - len(names)
    both = stored is not None
    ratios = [2.2, 1.0] if both else [1.0]
    figure.set_size_inches(_WIDTH_INCHES, 0.55 + (2.5 if both else 1.7) * len(names))
    rows = figure.subplots(
        len(names) * len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios * len(names)
    )[:, 0]
    for i, name in enumerate(names):
        unit, values = now.columns[name]
        then = _column(stored, name)
        bound = _bound_of(name, unit, measures)
        axes = rows[i * len(ratios)]
        _overlay(axes, now.x, values, stored, then, bound)
        axes.set_title(_label(name.replace(":", " of "), 70), color=INK)
        axes.set_ylabel(unit)
        if both:
            _residual(rows[i * 2 + 1], now.x, values, stored, then, unit, bound)
    more = f"   ({left_out} more series not shown)" if left_out else ""
    rows[-1].set_xlabel(f"{now.axis[0]} [{now.axis[1]}]{more}")
    figure.align_ylabels()
    handles, labels = rows[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=len(labels), borderaxespad=0.1)


def _overlay(
    axes: Axes,
    x: FloatArray,
    values: FloatArray,
    stored: Series | None,
    then: FloatArray | None,
    bound: Measure | None,
) -> None:
    if stored is not None and then is not None:
        if bound is not None and math.isfinite(bound.tolerance):
            at, low = _thin(stored.x, then - bound.tolerance)
            _, high = _thin(stored.x, then + bound.tolerance)
            axes.fill_between(at, low, high, color=BAND, linewidth=0, label="tolerance")
        axes.plot(*_thin(stored.x, then), color=GOLDEN, linewidth=2.2, alpha=0.55, label="golden")
    axes.plot(*_thin(x, values), color=NOW, label="now")
    if bound is not None and bound.time is not None and math.isfinite(bound.measured):
        axes.axvline(bound.time, color=FAIL if not bound.passed else DIM, linewidth=0.8)
        here = float(np.interp(bound.time, x, values))
        axes.plot(
            [bound.time],
            [here],
            "o",
            color=FAIL if not bound.passed else DIM,
            markersize=5,
            fillstyle="none",
            label="worst sample",
        )


def _residual(
    axes: Axes,
    x: FloatArray,
    values: FloatArray,
    stored: Series | None,
    then: FloatArray | None,
    unit: str,
    bound: Measure | None,
) -> None:
    axes.set_ylabel(f"now \N{MINUS SIGN} golden\n[{unit}]")
    if stored is None or then is None:
        axes.text(0.01, 0.5, "no golden series", transform=axes.transAxes, color=DIM, va="center")
        return
    left = values - np.interp(x, stored.x, then)
    if bound is not None and math.isfinite(bound.tolerance):
        axes.axhspan(-bound.tolerance, bound.tolerance, color=BAND, linewidth=0)
    axes.axhline(0.0, color=DIM, linewidth=0.6)
    axes.plot(*_thin(x, left), color=NOW, linewidth=1.0)
    if bound is not None and bound.time is not None:
        colour = DIM if bound.passed else FAIL
        axes.axvline(bound.time, color=colour, linewidth=0.8)
        axes.set_title(
            f"{quantity(bound.error, bound.unit)} at {number(bound.time)} s, "
            f"of {quantity(bound.tolerance, bound.unit)} allowed",
            loc="right",
            color=colour,
            fontsize=8,
        )


def _draw_frequency(
    figure: Figure, measures: Sequence[Measure], now: Series, stored: Series | None
) -> None:
    families: dict[str, list[str]] = {}
    for name in now.columns:
        families.setdefault(name.split(":")[0], []).append(name)
    order = ["magnitude", "phase", "coherence"]
    shown = sorted(families, key=lambda f: order.index(f) if f in order else len(order))[:4]
    figure.set_size_inches(_WIDTH_INCHES, 0.6 + 1.6 * len(shown))
    rows = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axes, family in zip(rows, shown, strict=True):
        for name in families[family][:MAX_SERIES]:
            unit, values = now.columns[name]
            then = _column(stored, name)
            bound = _bound_of(name, unit, measures)
            _overlay(axes, now.x, values, stored, then, bound)
            axes.set_ylabel(unit if unit != "1" else "")
        more = len(families[family]) - MAX_SERIES
        axes.set_title(family + (f" ({more} more not shown)" if more > 0 else ""), color=INK)
        if family == "magnitude" and now.columns[families[family][0]][0] != "dB":
            positive = all(np.nanmin(now.columns[n][1]) > 0 for n in families[family][:MAX_SERIES])
            if positive:
                axes.set_yscale("log")
                axes.yaxis.set_major_formatter(_plain)
        if family == "coherence":
            axes.set_ylim(-0.03, 1.05)
    if now.x[0] > 0:
        rows[-1].set_xscale("log")
        rows[-1].xaxis.set_major_formatter(_plain)
    rows[-1].set_xlabel(f"{now.axis[0]} [{now.axis[1]}]")
    handles, labels = rows[0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(
        list(unique.values()), list(unique), loc="upper right", ncols=len(unique), borderaxespad=0.1
    )


def _draw_bars(figure: Figure, measures: Sequence[Measure]) -> None:
    ordered = sorted(measures, key=use_of_tolerance, reverse=True)
    shown, left_out = ordered[:MAX_BARS], len(ordered) - MAX_BARS
    figure.set_size_inches(_WIDTH_INCHES, 0.85 + 0.24 * len(shown))
    axes = figure.subplots()
    used = np.array([use_of_tolerance(measure) for measure in shown])
    finite = used[np.isfinite(used) & (used > 0)]
    # A decade of room on both sides; what is exact or hardly off ends at the left edge.
    low = 10.0 ** max(-4, min(-1, math.floor(math.log10(finite.min())) if finite.size else -1))
    high = 10.0 ** min(6, max(1, math.ceil(math.log10(finite.max())) if finite.size else 1))
    ends = np.clip(np.where(np.isfinite(used), used, high), low * 1.08, high)
    rows = np.arange(len(shown))
    colours = [PASS if measure.passed else FAIL for measure in shown]
    axes.barh(rows, ends - low, left=low, color=colours, height=0.62)
    axes.axvline(1.0, color=INK, linewidth=1.1)
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.set_yticks(
        rows, [_label(f"{measure.name}  {measure.subject}") for measure in shown], color=INK
    )
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.xaxis.set_major_formatter(_percent)
    more = f"   ({left_out} with less not shown)" if left_out > 0 else ""
    axes.set_xlabel(f"error, of the tolerance{more}")
    for row, measure in zip(rows, shown, strict=True):
        axes.annotate(
            f"{number(measure.error)} of {quantity(measure.tolerance, measure.unit)}",
            (1.0, row),
            xycoords=("axes fraction", "data"),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            color=INK if measure.passed else FAIL,
            fontsize=8,
        )


def _plain(value: float, _: object = None) -> str:
    return f"{value:g}"


def _percent(value: float, _: object = None) -> str:
    return f"{100 * value:g} %" if value < 10 else f"{value:g} x"


def _most_telling(measures: Sequence[Measure], now: Series, stored: Series | None) -> list[str]:
    """The columns to show: those with the worst measure first, then the largest residual."""

    def rank(name: str) -> tuple[float, float]:
        unit, values = now.columns[name]
        bound = _bound_of(name, unit, measures)
        then = _column(stored, name)
        left = 0.0
        if stored is not None and then is not None:
            scale = float(np.ptp(then)) or 1.0
            left = float(np.max(np.abs(values - np.interp(now.x, stored.x, then)))) / scale
        return (-1.0 if bound is None else use_of_tolerance(bound), left)

    ordered = sorted(now.columns, key=rank, reverse=True)
    return ordered[:MAX_SERIES]


def _bound_of(column: str, unit: str, measures: Sequence[Measure]) -> Measure | None:
    """The worst measure with a time that speaks of a column: its unit, and its subject."""
    _, _, subject = column.partition(":")
    fitting = [
        measure
        for measure in measures
        if measure.unit == unit
        and measure.time is not None
        and measure.subject in (subject, column)
    ]
    return max(fitting, key=use_of_tolerance, default=None)


def _column(series: Series | None, name: str) -> FloatArray | None:
    if series is None or name not in series.columns:
        return None
    return series.columns[name][1]


def _thin(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """At most two points for each of ``BUCKETS`` stretches: its lowest and its highest."""
    if x.size <= 2 * BUCKETS:
        return x, y
    edges = np.linspace(0, x.size, BUCKETS + 1).astype(int)
    picked: list[int] = [0]
    for start, end in itertools.pairwise(edges.tolist()):
        piece = np.nan_to_num(y[start:end])
        picked += sorted({start + int(piece.argmin()), start + int(piece.argmax())})
    picked.append(x.size - 1)
    index = np.unique(picked)
    return x[index], y[index]


def _label(text: str, length: int = _LABEL_CHARS) -> str:
    text = printable(text)
    return text if len(text) <= length else text[: length - 1] + "…"
