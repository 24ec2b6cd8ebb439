"""Figures of randomization ranges: envelopes, probability integrals, correlations, ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.report.figures import svg
from pytest_twin.report.plot_style import BAND, DIM, FAIL, GOLDEN, INK, NOW
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SCALE = {"rad": (1e3, "mrad"), "m": (1e3, "mm")}
"""SI unit -> factor and unit of the axis."""
_SHOWN = 30
"""Largest number of characters of a label."""
_WIDTH = 7.4
"""Width of a figure, inches."""
_BAR = 0.75
"""Width of the colour bar with its labels, inches."""
_MOST_NAMES = 30
"""Largest number of rows of a readable correlation matrix."""


def envelope_figure(panels: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw envelopes of one recording, a row for each joint: motion and deviation, as SVG.

    Args:
        panels: entries of ``envelopes`` of ``ranges.json`` for one recording.
    """
    height = 0.3 + 1.5 * len(panels)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(
            len(panels), 2, squeeze=False, sharex=True, width_ratios=(1.0, 1.6),
            gridspec_kw={"left": 0.08, "right": 0.99, "top": 1.0 - 0.22 / height,
                         "bottom": 0.4 / height, "hspace": 0.32, "wspace": 0.2},
        )  # fmt: skip
        for row, one in zip(grid, panels, strict=True):
            scale, unit = _SCALE[one["unit"]]
            time, middle = np.array(one["time"]), np.array(one["middle"])
            measured = np.array(one["measured"])
            row[0].plot(time, middle, color=NOW, linewidth=1.0)
            row[0].plot(time, measured, color=INK, linewidth=0.8, linestyle=(0, (2, 1.5)))
            row[0].set_title(f"{printable(one['joint'])} [{one['unit']}]")
            low, high = (scale * (np.array(one[k]) - middle) for k in ("lower", "upper"))
            off = scale * (measured - middle)
            row[1].fill_between(time, low, high, color=BAND, linewidth=0)
            row[1].plot(time, off, color=INK, linewidth=0.7)
            outside = (off < low) | (off > high)
            row[1].plot(time[outside], off[outside], ".", color=FAIL, markersize=2.5)
            row[1].set_title(f"off the middle of the envelope [{unit}]")
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")

    return svg(draw, _WIDTH, height)


def transform_figure(joints: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Draw histograms of the probability integral of each joint, as SVG; uniform: calibrated."""
    columns = min(4, len(joints))
    rows = -(-len(joints) // columns)
    height = 0.25 + 1.35 * rows

    def draw(figure: Figure) -> None:
        grid = figure.subplots(
            rows, columns, squeeze=False, sharey=True, sharex=True,
            gridspec_kw={"left": 0.08, "right": 0.99, "top": 1.0 - 0.22 / height,
                         "bottom": 0.42 / height, "hspace": 0.5, "wspace": 0.12},
        )  # fmt: skip
        for axes, (joint, one) in zip(grid.ravel(), joints.items(), strict=False):
            shares = 100.0 * np.array(one["histogram"])
            centres = (np.arange(len(shares)) + 0.5) / len(shares)
            odd = one["uneven_chance"] <= 0.05
            axes.bar(centres, shares, width=0.9 / len(shares), color=FAIL if odd else NOW)
            axes.axhline(100.0 / len(shares), color=GOLDEN, linewidth=0.9, linestyle=(0, (4, 3)))
            axes.set_title(f"{printable(joint)}: p = {one['uneven_chance']:.2g}")
        for axes in grid.ravel()[len(joints) :]:
            axes.set_axis_off()
        for axes in grid[-1]:
            axes.set_xlabel("share of robots below")
        for axes in grid[:, 0]:
            axes.set_ylabel("samples [%]")

    return svg(draw, _WIDTH, height)


def correlation_figure(names: Sequence[str], matrix: Sequence[Sequence[float]]) -> bytes | None:
    """Draw the correlation matrix, as SVG; None if it has too many coordinates to be readable."""
    if not 2 <= len(names) <= _MOST_NAMES:
        return None
    values = np.array(matrix)
    side = min(0.5 + 0.16 * len(names), _WIDTH - 1.9 - _BAR)
    height = side + 1.9

    def draw(figure: Figure) -> None:
        place = (1.9 / _WIDTH, 1.8 / height, side / _WIDTH, side / height)
        axes = figure.add_axes(place)
        image = axes.imshow(values, vmin=-1.0, vmax=1.0, cmap="RdBu_r", rasterized=True)
        shown = [_short_label(name) for name in names]
        axes.set_xticks(range(len(names)), shown, rotation=90, fontsize=6.5)
        axes.set_yticks(range(len(names)), shown, fontsize=6.5)
        axes.grid(visible=False)
        bar = figure.add_axes(((2.0 + side) / _WIDTH, place[1], 0.12 / _WIDTH, place[3]))
        figure.colorbar(image, cax=bar)

    return svg(draw, _WIDTH, height)


def against_figure(entries: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw given and measured ranges, relative to the model's values, as SVG."""
    height = 0.5 + 0.36 * len(entries)

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.30, 0.42 / height, 0.67, 1.0 - 0.5 / height))
        for row, one in enumerate(entries):
            size = abs(one["nominal"]) or max(abs(v) for v in one["measured"]) or 1.0
            for key, offset, colour, thick in (
                ("given", -0.17, BAND, 0.3), ("measured", 0.17, NOW, 0.3),
            ):  # fmt: skip
                low, high = (v / size for v in one[key])
                axes.barh(row + offset, high - low, left=low, height=thick, color=colour)
            axes.plot([one["nominal"] / size] * 2, [row - 0.4, row + 0.4], color=INK, linewidth=0.9)
        axes.set_yticks(
            range(len(entries)), [_short_label(one["parameter"]) for one in entries], fontsize=7
        )
        axes.set_ylim(len(entries) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("over the model's value (line); grey: given, blue: measured", color=DIM)

    return svg(draw, _WIDTH, height)


def _short_label(name: str) -> str:
    """Return a label: of a long name its begin and its end, which differs between parameters."""
    text = printable(name)
    if len(text) <= _SHOWN:
        return text
    end = 2 * _SHOWN // 5
    return f"{text[: _SHOWN - 3 - end]} … {text[-end:]}"
