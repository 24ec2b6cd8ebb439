"""Figures of a trend: parameters and errors of one joint over the dates of its sessions."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.report.figures import svg
from pytest_twin.report.plot_style import DIM, FAIL, GOLDEN, INK, NOW
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

_WIDTH, _ROW = 7.4, 1.05
"""Width of a figure and height of one parameter, inches."""


def joint_figure(document: Mapping[str, Any], joint: str) -> bytes:
    """Draw every parameter of a joint over the dates, then its errors, as SVG.

    Bars are 95 % intervals. Red: a change, with the sessions between which it happened. Dashed: a
    declared event.

    Args:
        document: content of ``trend.json``.
    """
    own = {name: one for name, one in document["parameters"].items() if one["joint"] == joint}
    dates = [_days(one["date"]) for one in document["sessions"]]
    height = 0.45 + _ROW * (len(own) + 1)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(
            len(own) + 1, 1, sharex=True, squeeze=False,
            gridspec_kw={"left": 0.1, "right": 0.985, "top": 1.0 - 0.2 / height,
                         "bottom": 0.3 / height, "hspace": 0.42},
        )[:, 0]  # fmt: skip
        for axes, (name, one) in zip(grid[:-1], own.items(), strict=True):
            _parameter(axes, one, dates)
            _changes(axes, document, name)
        _errors(grid[-1], document["held_out"][joint], dates)
        _changes(grid[-1], document, f"{joint}.unexplained_effort")
        for axes in grid:
            for event in document["events"]:
                date = _days(event["date"])
                if dates[0] <= date <= dates[-1]:
                    axes.axvline(date, color=GOLDEN, linewidth=0.9, linestyle=(0, (4, 3)))
        _set_dates(grid[-1].xaxis)

    return svg(draw, _WIDTH, height)


def _days(date: str) -> float:
    """Days since 1970, the unit of a time axis."""
    return datetime.fromisoformat(date).timestamp() / 86400.0


def _parameter(axes: Axes, one: Mapping[str, Any], dates: list[float]) -> None:
    known = [k for k, value in enumerate(one["values"]) if value is not None]
    if known:
        value = np.array([one["values"][k]["value"] for k in known])
        low, high = np.array([one["values"][k]["ci95"] for k in known], dtype=float).T
        axes.errorbar(
            [dates[k] for k in known], value, yerr=[value - low, high - value], fmt="o",
            color=NOW, markersize=3.0, linewidth=0.9, ecolor=DIM,
        )  # fmt: skip
    unit = "" if one["unit"] == "1" else f" [{one['unit']}]"
    axes.set_title(f"{printable(one['meaning'])}{unit}")


def _errors(axes: Axes, errors: Mapping[str, Any], dates: list[float]) -> None:
    for key, colour, label in (
        ("effort_relative", INK, "with the parameters of the other sessions"),
        ("unexplained", NOW, "with its own"),
    ):
        known = [k for k, value in enumerate(errors[key]) if value is not None]
        axes.plot(
            [dates[k] for k in known], [100.0 * errors[key][k] for k in known], "o-",
            color=colour, markersize=2.5, linewidth=0.8, label=label,
        )  # fmt: skip
    axes.set_ylim(bottom=0.0)
    axes.set_title("effort error [% of the RMS effort]: black with the parameters of the other "
                   "sessions, blue with its own")  # fmt: skip


def _changes(axes: Axes, document: Mapping[str, Any], name: str) -> None:
    for change in document["changes"]:
        if change["parameter"] == name:
            first, last = (_days(date) for date in change["between"])
            axes.axvspan(first, last, color=FAIL, alpha=0.18, linewidth=0)


def _set_dates(axis: Axis) -> None:
    from matplotlib.dates import AutoDateLocator, DateFormatter

    axis.set_major_locator(AutoDateLocator(minticks=3, maxticks=8))  # type: ignore[no-untyped-call]
    axis.set_major_formatter(DateFormatter("%Y-%m-%d"))  # type: ignore[no-untyped-call]
