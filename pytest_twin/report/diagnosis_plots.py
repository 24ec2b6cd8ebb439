"""Figure of one joint: measured and predicted motion, residuals over time, speed and frequency."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.spectrum import power_density
from pytest_twin.report.diagnosis_view import JointView, Regime
from pytest_twin.report.log_axes import set_logarithmic
from pytest_twin.report.panels import Line, thin
from pytest_twin.report.plot_style import BAND, DIM, FAIL, GOLDEN, INK, NOW, STYLE, svg_of
from pytest_twin.report.text import number, printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH, _HEIGHT = 9.6, 9.0
"""Size of the figure, inches."""
_STRETCHES = 700
"""Number of intervals of a line; each shows its minimum and maximum."""
_BINS = 24
"""Number of bins of a residual over speed, with equal numbers of samples."""
_MOST_REGIMES = 9
"""Largest number of regimes in the figure; those with the largest residual come first."""
# Shares of the width: start and end of panels, the gap between them, and a character of a regime's
# name. Fixed values, because a layout that measures all text takes as long as the drawing.
_LEFT, _MIDDLE, _RIGHT, _GAP = 0.098, 0.42, 0.985, 0.022
_CHARACTER = 0.0058


def joint_figure(view: JointView) -> bytes:
    """Draw one joint's figure as SVG.

    Top to bottom: measured, before and after over time; residual over time; residual
    against velocity, position and load; its spectrum; its root mean square by regime.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        figure = Figure(figsize=(_WIDTH, _HEIGHT))
        FigureCanvasSVG(figure)
        overlay = _panel(figure, 0.77, 0.972)
        left = _panel(figure, 0.588, 0.742, sharex=overlay)
        _overlay(overlay, view)
        _plot_residual(left, view)
        for axes in (overlay, left):
            axes.yaxis.set_label_coords(-0.067, 0.5)
        effort = "N" if view.unit == "m" else "N*m"
        drivers = (
            (f"velocity [{view.unit}/s]", view.velocity),
            (f"position [{view.unit}]", view.position),
            (f"load [{effort}]", view.load),
        )
        edges = np.linspace(_LEFT, _RIGHT + _GAP, len(drivers) + 1)
        first: Axes | None = None
        for start, end, (label, values) in zip(edges, edges[1:] - _GAP, drivers, strict=False):
            axes = _panel(figure, 0.35, 0.5, start, end, sharey=first)
            _plot_against(axes, view, values, label, first=first is None)
            first = first or axes
        _spectrum(_panel(figure, 0.055, 0.285, _LEFT, _MIDDLE), view)
        shown = sorted(view.regimes, key=lambda r: -r.before)[:_MOST_REGIMES]
        names = max((len(_regime_name(r)) for r in shown), default=0)
        start = _MIDDLE + _GAP + _CHARACTER * names
        _regimes(_panel(figure, 0.055, 0.285, start), view, shown)
        return svg_of(figure)


def _panel(
    figure: Figure,
    bottom: float,
    top: float,
    left: float = _LEFT,
    right: float = _RIGHT,
    sharex: Axes | None = None,
    sharey: Axes | None = None,
) -> Axes:
    """Add axes; positions are fractions of the figure."""
    return figure.add_axes((left, bottom, right - left, top - bottom), sharex=sharex, sharey=sharey)


def _overlay(axes: Axes, view: JointView) -> None:
    axes.set_title(printable(f"{view.joint} in {view.recording}")[:90], color=INK)
    axes.set_ylabel(f"position [{view.unit}]")
    if view.command is not None and view.command_time is not None:
        inside = view.command_time <= view.time[-1]
        t, c = _thin(view.command_time[inside], view.command[inside])
        axes.plot(t, c, color=DIM, linewidth=0.8, linestyle=(0, (4, 3)), label="command",
                  drawstyle="steps-post")  # fmt: skip
    axes.plot(
        *_thin(view.time, view.measured),
        color=GOLDEN,
        linewidth=3.4,
        alpha=0.35,
        label="measured",
    )
    axes.plot(*_thin(view.time, view.before), color=FAIL, linewidth=1.0, label="model")
    axes.plot(*_thin(view.time, view.after), color=NOW, linewidth=1.1, label="patched model")
    low, high = float(view.measured.min()), float(view.measured.max())
    room = 0.35 * max(high - low, 1e-6)
    axes.set_ylim(low - room, high + room)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.1)
    axes.tick_params(labelbottom=False)


def _plot_residual(axes: Axes, view: JointView) -> None:
    axes.set_ylabel(f"measured \N{MINUS SIGN} model\n[{view.unit}]")
    axes.set_xlabel("time [s]")
    for start, end in {(a, b) for _, a, b in view.windows}:
        axes.axvspan(start, end, color=BAND, alpha=0.35, linewidth=0)
    _floor_band(axes, view)
    for values, colour, width in ((view.before, FAIL, 0.9), (view.after, NOW, 1.0)):
        axes.plot(*_thin(view.time, view.measured - values), color=colour, linewidth=width)
    reach = 1.15 * float(np.nanmax(np.abs(view.measured - view.before)))
    reach = max(reach, 3.0 * view.floor)
    axes.set_ylim(-reach, reach)
    said = "shaded: time intervals of the findings" if view.windows else ""
    axes.set_title(said, loc="right", color=DIM, fontsize=8)
    axes.set_title("residual over time; grey band: noise floor", color=DIM, fontsize=8)


def _floor_band(axes: Axes, view: JointView) -> None:
    axes.axhspan(-view.floor, view.floor, color=GOLDEN, alpha=0.25, linewidth=0)
    axes.axhline(0.0, color=DIM, linewidth=0.5)


def _plot_against(
    axes: Axes, view: JointView, values: FloatArray, label: str, *, first: bool
) -> None:
    """Draw median and middle 80 % of the residual, in bins with equal numbers of samples."""
    good = np.isfinite(values) & np.isfinite(view.left_before) & np.isfinite(view.left_after)
    edges = np.unique(np.quantile(values[good], np.linspace(0.0, 1.0, _BINS + 1)))
    _floor_band(axes, view)
    if len(edges) > 2:
        bins = np.clip(np.searchsorted(edges, values[good], side="right") - 1, 0, len(edges) - 2)
        for series, colour in ((view.left_before, FAIL), (view.left_after, NOW)):
            rows = [
                (float(np.median(values[good][bins == b])),
                 *np.quantile(series[good][bins == b], (0.1, 0.5, 0.9)))
                for b in range(len(edges) - 1)
                if (bins == b).any()
            ]  # fmt: skip
            x, low, middle, high = np.array(rows).T
            axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
            axes.plot(x, middle, color=colour, linewidth=1.3)
    axes.set_xlabel(label)
    if first:
        axes.set_ylabel(f"residual [{view.unit}]")
        axes.set_title(
            "residual against velocity, position and load: median and middle 80 %",
            color=DIM,
            fontsize=8,
        )
    else:
        axes.tick_params(labelleft=False)


def _spectrum(axes: Axes, view: JointView) -> None:
    """Draw the amplitude spectral density, averaged over the test recordings."""
    rate = 1.0 / view.interval
    longest = max(view.stretches)
    window = max(min(longest, round(4.0 * rate)), 8)
    for series, colour, name in (
        (view.left_before, FAIL, "model"), (view.left_after, NOW, "patched model"),
    ):  # fmt: skip
        total, weight, at = None, 0, 0
        for n in view.stretches:
            part = np.nan_to_num(series[at : at + n])
            at += n
            if n < 8:
                continue
            size = min(window, n)
            f, p = power_density(part, rate, size, padded=window, centred=False)
            total = p * n if total is None else total + p * n
            weight += n
        if total is not None:
            # The lowest bin is the constant part, which a logarithmic axis cannot show.
            f, power = _by_octaves(f[1:], total[1:] / weight)
            axes.plot(f, np.sqrt(power), color=colour, linewidth=1.3, label=name)
    axes.axhline(view.floor * np.sqrt(2.0 / rate), color=GOLDEN, linewidth=0.9,
                 linestyle=(0, (4, 3)), label="noise floor, if white")  # fmt: skip
    set_logarithmic(axes, "x", "y")
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"residual [{view.unit}/\N{SQUARE ROOT}Hz]")
    axes.legend(loc="upper right")


def _regimes(axes: Axes, view: JointView, shown: Sequence[Regime]) -> None:
    """Draw the RMS error of both models in each regime."""
    rows = np.arange(len(shown))
    scale = max(view.floor, 1e-300)
    for row, r in zip(rows, shown, strict=True):
        axes.plot([r.after, r.before], [row, row], color=BAND, linewidth=2.2, zorder=1)
    axes.scatter([r.before for r in shown], rows, color=FAIL, s=22, zorder=2)
    axes.scatter([r.after for r in shown], rows, color=NOW, s=22, zorder=3)
    axes.axvline(view.floor, color=GOLDEN, linewidth=0.9, linestyle=(0, (4, 3)))
    set_logarithmic(axes, "x")
    values = [x for r in shown for x in (r.before, r.after)] + [scale]
    axes.set_xlim(0.6 * min(values), 1.6 * max(values))
    axes.set_yticks(rows, [_regime_name(r) for r in shown], color=INK, fontsize=7.5)
    axes.set_ylim(len(shown) - 0.5, -0.6)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    said = f"RMS [{view.unit}]; dashed: noise floor {number(view.floor)}"
    axes.set_xlabel(said, loc="right")


def _regime_name(regime: Regime) -> str:
    return printable(regime.name)[:46]


def _by_octaves(frequency: FloatArray, power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return means over eight bands per octave, which smooth high frequencies."""
    band = np.floor(8.0 * np.log2(frequency / frequency[0]))
    _, first = np.unique(band, return_index=True)
    count = np.diff(np.append(first, len(power)))
    return (
        np.add.reduceat(frequency, first) / count,
        np.add.reduceat(power, first) / count,
    )


def _thin(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    line = thin(Line(x, y), _STRETCHES)
    return line.x, line.y
