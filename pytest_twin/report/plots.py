"""Draw one plot for each golden, as a small SVG for light and dark pages.

matplotlib is imported only when a plot is drawn, in the child process.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.outcome import Measure, tolerance_ratio
from pytest_twin.report.panels import (
    Panel,
    Series,
    frequency_panels,
    shift,
    thin,
    time_panels,
)
from pytest_twin.report.plot_style import BAND, DIM, FAIL, GOLDEN, INK, NOW, PASS, STYLE, svg_of
from pytest_twin.report.text import number, printable, quantity

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

MAX_BARS = 14
"""Largest number of bars of a plot."""
_LABEL_CHARS = 58
"""Largest number of characters of a label."""
_WIDTH_INCHES = 8.6
"""Width of a plot."""
# Of a tick, its distance to its label, and that label's to the axis label.
_LABEL_GAP_INCHES = 0.17
# Margins, distances of title and legend from the edge, distance between two panels, and height of
# an axis label of two lines, in inches. Fixed values, because a layout that measures all text takes
# a third of the drawing time.
_TOP, _BOTTOM, _RIGHT, _BETWEEN, _AXIS_LABEL = 0.7, 0.46, 0.12, 0.28, 0.3
_TITLE_AT, _LEGEND_AT = 0.06, 0.24


def plot(
    kind: str,
    title: str,
    measures: Sequence[Measure],
    now: Series | None,
    stored: Series | None,
) -> bytes | None:
    """Draw the plot of one golden; return None if nothing was measured.

    Args:
        kind: the check's name.
        title: the golden's title.
        measures: measures with tolerances.
        now: present series, or None.
        stored: series for comparison, from the golden or a recording, or None.

    Returns:
        SVG: time series with their difference and the worst sample; magnitude, phase and
            coherence over frequency; or, without series, each error relative to its tolerance.
    """
    heading = f"{title}  ({kind})"
    if now is not None and now.x.size > 1 and now.columns:
        series = now
        if now.axis[1] == "Hz":
            panels, left_out = frequency_panels(measures, now, stored)
            return _render(heading, lambda f: _draw_frequency(f, series, panels, left_out))
        panels, left_out = time_panels(measures, now, stored)
        return _render(heading, lambda f: _draw_time(f, series, panels, left_out))
    if measures:
        return _render(heading, lambda figure: _draw_bars(figure, measures))
    return None


def _render(title: str, draw: Callable[[Figure], None]) -> bytes:
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    # Ignore warnings about missing glyphs or extreme numbers, which do not concern the robot.
    with matplotlib.rc_context(STYLE), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        figure = Figure()
        FigureCanvasSVG(figure)
        draw(figure)
        top = 1.0 - _TITLE_AT / figure.get_size_inches()[1]
        figure.suptitle(
            _label(title, 90), x=0.01, y=top, ha="left", fontsize=9.5, fontweight="bold"
        )
        return svg_of(figure)


def _draw_time(figure: Figure, series: Series, panels: Sequence[Panel], left_out: int) -> None:
    """Draw each panel's series, and below it the difference."""
    ratios = [ratio for panel in panels for ratio in ([2.2, 1.0] if panel.then else [2.2])]
    figure.set_size_inches(_WIDTH_INCHES, 0.75 + 0.78 * sum(ratios))
    rows = iter(
        figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    )
    courses, last = [], None
    for panel in panels:
        last = next(rows)
        courses.append(last)
        _course(last, panel)
        if panel.then is not None:
            last = next(rows)
            _residual(last, panel)
    if last is not None:
        _axis_label(last, series, left_out)
    _place(figure, ratios)
    _legend(figure, courses)


def _draw_frequency(figure: Figure, series: Series, panels: Sequence[Panel], left_out: int) -> None:
    figure.set_size_inches(_WIDTH_INCHES, 0.8 + 1.75 * len(panels))
    rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, panel in zip(rows, panels, strict=True):
        _course(axes, panel)
        _note_worst(axes, panel, "Hz")
        if panel.title.startswith("coherence"):
            axes.set_ylim(-0.03, 1.06)
    if series.x[0] > 0:
        rows[-1].set_xscale("log")
        for formatter in (rows[-1].xaxis.set_major_formatter, rows[-1].xaxis.set_minor_formatter):
            formatter(_plain_number)
        rows[-1].tick_params(axis="x", which="minor", labelsize=7)
    _axis_label(rows[-1], series, left_out)
    _place(figure, [1.0] * len(panels))
    _legend(figure, list(rows))


def _course(axes: Axes, panel: Panel) -> None:
    axes.set_title(_label(panel.title, 70), color=INK)
    axes.set_ylabel(_label(panel.unit, 20))
    worst, then = panel.worst, panel.then
    if then is not None:
        if worst is not None and math.isfinite(worst.tolerance):
            low, high = thin(shift(then, -worst.tolerance)), thin(shift(then, worst.tolerance))
            axes.fill_between(low.x, low.y, high.y, color=BAND, linewidth=0, label="tolerance")
        line = thin(then)
        axes.plot(line.x, line.y, color=GOLDEN, linewidth=2.6, alpha=0.5, label=panel.against)
    if panel.command is not None:
        line = thin(panel.command)
        axes.plot(line.x, line.y, color=DIM, linewidth=0.9, linestyle=(0, (4, 3)), label="command")
    line = thin(panel.now)
    axes.plot(line.x, line.y, color=NOW, label="now")
    if worst is not None:
        colour = DIM if worst.passed else FAIL
        axes.axvline(worst.x, color=colour, linewidth=0.8)
        if math.isfinite(worst.y):
            axes.plot(
                [worst.x], [worst.y], "o", color=colour, markersize=5.5, fillstyle="none",
                label="worst sample",
            )  # fmt: skip


def _residual(axes: Axes, panel: Panel) -> None:
    left, worst = panel.residual, panel.worst
    if left is None:
        return
    axes.set_ylabel(f"now \N{MINUS SIGN} {panel.against}\n[{_label(panel.unit, 14)}]")
    if worst is not None and math.isfinite(worst.tolerance):
        axes.axhspan(-worst.tolerance, worst.tolerance, color=BAND, linewidth=0)
    axes.axhline(0.0, color=DIM, linewidth=0.6)
    line = thin(left)
    axes.plot(line.x, line.y, color=NOW, linewidth=1.0)
    if worst is not None:
        axes.axvline(worst.x, color=DIM if worst.passed else FAIL, linewidth=0.8)
        _note_worst(axes, panel, "s")
    elif panel.bound is not None:
        bound = panel.bound
        _note(
            axes,
            f"{bound.name} {number(bound.error)}, of {quantity(bound.tolerance, bound.unit)} "
            "allowed",
            passed=bound.passed,
        )


def _note_worst(axes: Axes, panel: Panel, unit: str) -> None:
    worst = panel.worst
    if worst is not None:
        _note(
            axes,
            f"{number(worst.error)} at {number(worst.x)} {unit}, of "
            f"{quantity(worst.tolerance, panel.unit.split(' ')[0] or '1')} allowed",
            passed=worst.passed,
        )


def _note(axes: Axes, text: str, *, passed: bool) -> None:
    axes.set_title(_label(text, 90), loc="right", color=DIM if passed else FAIL, fontsize=8)


def _axis_label(axes: Axes, series: Series, left_out: int) -> None:
    name, unit = series.axis
    more = f"   ({left_out} more series not shown)" if left_out else ""
    axes.set_xlabel(_label(f"{name} [{unit}]{more}", 80))


def _place(figure: Figure, ratios: Sequence[float]) -> None:
    """Place the panels below each other, with the labels of vertical axes in one column.

    Args:
        figure: its axes are the panels, from top to bottom.
        ratios: their relative heights.
    """
    from matplotlib.transforms import ScaledTranslation

    # The number of ticks depends on the height of a panel, and the margin on the tick labels.
    _place_below(figure, ratios, 1.0)
    labels = [label for axes in figure.axes for label in axes.get_yticklabels()]
    left = max(map(_width, labels), default=0.0) + _LABEL_GAP_INCHES
    _place_below(figure, ratios, left + _AXIS_LABEL)
    for axes in figure.axes:
        moved = axes.transAxes + ScaledTranslation(-left, 0.0, figure.dpi_scale_trans)
        axes.yaxis.set_label_coords(0.0, 0.5, transform=moved)


def _place_below(figure: Figure, ratios: Sequence[float], left: float) -> None:
    width, height = figure.get_size_inches()
    room = height - _TOP - _BOTTOM - _BETWEEN * (len(ratios) - 1)
    top = height - _TOP
    for axes, ratio in zip(figure.axes, ratios, strict=True):
        tall = room * ratio / sum(ratios)
        axes.set_position(
            (left / width, (top - tall) / height, 1.0 - (left + _RIGHT) / width, tall / height)
        )
        top -= tall + _BETWEEN


def _width(text: Text) -> float:
    """Width of a text in inches."""
    return float(text.get_window_extent().width / text.figure.dpi)


def _legend(figure: Figure, rows: Sequence[Axes]) -> None:
    """Draw one legend for all panels below the title, with each label once."""
    found: dict[str, Artist] = {}
    for axes in rows:
        handles, labels = axes.get_legend_handles_labels()
        for label, handle in zip(labels, handles, strict=True):
            found.setdefault(label, handle)
    top = 1.0 - _LEGEND_AT / figure.get_size_inches()[1]
    figure.legend(
        list(found.values()), list(found), loc="upper right", bbox_to_anchor=(1.0, top),
        ncols=len(found), borderaxespad=0.1,
    )  # fmt: skip


def _draw_bars(figure: Figure, measures: Sequence[Measure]) -> None:
    ordered = sorted(measures, key=tolerance_ratio, reverse=True)
    shown, left_out = ordered[:MAX_BARS], len(ordered) - MAX_BARS
    figure.set_size_inches(_WIDTH_INCHES, 0.85 + 0.24 * len(shown))
    axes = figure.subplots()
    used = np.array([tolerance_ratio(measure) for measure in shown])
    finite = used[np.isfinite(used) & (used > 0)]
    # One decade of margin on both sides; bars of very small errors end at the left edge.
    low = 10.0 ** max(-4, min(-1, math.floor(math.log10(finite.min())) if finite.size else -1))
    high = 10.0 ** min(6, max(1, math.ceil(math.log10(finite.max())) if finite.size else 1))
    ends = np.clip(np.where(np.isfinite(used), used, high), low * 1.08, high)
    rows = np.arange(len(shown))
    colours = [PASS if measure.passed else FAIL for measure in shown]
    axes.barh(rows, ends - low, left=low, color=colours, height=0.62)
    axes.axvline(1.0, color=INK, linewidth=1.1)
    axes.set_xscale("log")
    # Only decades have ticks, because ticks between them take half of the drawing time.
    axes.minorticks_off()
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
    notes = [
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
        for row, measure in zip(rows, shown, strict=True)
    ]
    left, right = (max(map(_width, texts)) + 0.17 for texts in (axes.get_yticklabels(), notes))
    width, height = figure.get_size_inches()
    tall = height - _BETWEEN - _BOTTOM
    axes.set_position((left / width, _BOTTOM / height, 1.0 - (left + right) / width, tall / height))


def _percent(value: float, _: object = None) -> str:
    return f"{100 * value:g} %" if value < 10 else f"{value:g} x"


def _plain_number(value: float, _: object = None) -> str:
    leading = f"{value:e}"[0]
    return f"{value:g}" if leading in "125" else ""


def _label(text: str, length: int = _LABEL_CHARS) -> str:
    text = printable(text)
    return text if len(text) <= length else text[: length - 1] + "…"
