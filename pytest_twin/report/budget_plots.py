"""Figures of an error budget: a bar for each category, and a waterfall chart of causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pytest_twin.report.figures import svg
from pytest_twin.report.plot_style import BAND, DIM, FAIL, GOLDEN, INK, NOW
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZES = {"position": (1e3, "mm"), "rotation": (1e3, "mrad")}
"""Quantity -> factor from SI units, and unit of the axis."""
_SHOWN = 34
"""Largest number of characters of a label."""


def categories_figure(document: Mapping[str, Any], quantity: str) -> bytes:
    """Draw a bar for each category's error, and the task's tolerance, as SVG.

    Args:
        document: ``budget.json``.
        quantity: ``position`` or ``rotation``.
    """
    scale, unit = _SIZES[quantity]
    rows = document["categories"]
    allowed = document["tolerance"][quantity]
    height = 0.6 + 0.26 * len(rows)

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.30, 0.45 / height, 0.66, 1.0 - 0.55 / height))
        values = [_value(one, quantity) for one in rows]
        widest = scale * max([value or 0.0 for value in values] + [allowed or 0.0])
        for row, (one, value) in enumerate(zip(rows, values, strict=True)):
            if value is None:
                axes.text(0.01 * widest, row, _why(one), va="center", color=DIM, fontsize=7)
                continue
            bound = one["beyond"] is not None
            colour = BAND if bound else NOW
            axes.barh(row, scale * value, height=0.62, color=colour)
            label = f"{scale * value:.3g} {unit}{' at most' if bound else ''}"
            if allowed:
                label += f" ({100 * value / allowed:.3g} %)"
            _place_label(axes, scale * value, row, label)
        if allowed:
            axes.axvline(scale * allowed, color=FAIL, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.set_xlim(0, 1.35 * widest or 1.0)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_yticks(range(len(rows)), [one["category"].replace("_", " ") for one in rows])
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(f"{quantity}, one standard deviation [{unit}]")

    return svg(draw, 7.4, height)


def waterfall_figure(document: Mapping[str, Any], quantity: str) -> bytes | None:
    """Draw how independent causes add up to the output, as SVG; None without known causes.

    Steps are squares, because variances of independent causes add up. Bars above a cause are its
    parts, which are correlated and do not add up.
    """
    scale, unit = _SIZES[quantity]
    lines = [line for line in document["lines"] if (line["sampled"] or {}).get(quantity)]
    if not lines:
        return None
    steps = [(line["id"], scale * line["sampled"][quantity]) for line in lines]
    parts = [
        (part["name"], scale * part["alone"][quantity])
        for line in lines
        for part in line["parts"]
        if part["alone"] is not None and len(line["parts"]) > 1
    ]
    total = scale * document["total"]["sampled"][quantity]
    rows = [*parts, *steps, ("total", total)]
    height = 0.6 + 0.28 * len(rows)

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.34, 0.45 / height, 0.62, 1.0 - 0.55 / height))
        so_far = 0.0
        for row, (_, value) in enumerate(rows):
            if row < len(parts):
                axes.barh(row, value, height=0.5, color=BAND)
                end = value
            elif row < len(rows) - 1:
                end = (so_far**2 + value**2) ** 0.5
                axes.barh(row, end - so_far, left=so_far, height=0.62, color=NOW)
                axes.plot([end, end], [row, row + 1], color=DIM, linewidth=0.8)
                so_far = end
            else:
                axes.barh(row, value, height=0.62, color=GOLDEN)
                end = value
            _place_label(axes, end, row, f"{value:.3g} {unit}")
        allowed = document["tolerance"][quantity]
        if allowed:
            axes.axvline(scale * allowed, color=FAIL, linewidth=1.0, linestyle=(0, (4, 3)))
        furthest = max([value for _, value in rows] + [scale * (allowed or 0.0)])
        axes.set_xlim(0, 1.25 * furthest)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_yticks(range(len(rows)), _names([name for name, _ in rows]), fontsize=7)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(f"{quantity}, one standard deviation [{unit}]")

    return svg(draw, 7.4, height)


def _value(one: Mapping[str, Any], quantity: str) -> float | None:
    if one["beyond"] is not None:
        beyond = one["beyond"][quantity]
        return None if beyond is None else float(beyond)
    return None if one["moves"] is None else float(one["moves"][quantity])


def _why(one: Mapping[str, Any]) -> str:
    if one["state"] in ("not_measured", "not_tried"):
        return "not measured"
    if one["state"] == "counted_elsewhere":
        return printable(f"counted with {', '.join(one['counted_in'])}")
    return "measured, not carried to this output"


def _names(names: Sequence[str]) -> list[str]:
    return [
        text if len(text) <= _SHOWN else text[: _SHOWN - 2] + " …" for text in map(printable, names)
    ]


def _place_label(axes: Axes, end: float, row: int, label: str) -> None:
    """Place a label right of a bar's end, with an offset because SVG drops leading spaces."""
    axes.annotate(
        label, (end, row), (4, 0), textcoords="offset points", va="center", color=INK, fontsize=7
    )
