"""Figures of an excitation: each motion over time, and predicted standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pytest_twin.report.figures import svg
from pytest_twin.report.log_axes import set_logarithmic
from pytest_twin.report.plot_style import BAND, DIM, FAIL, INK, NOW, PASS
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = (NOW, PASS, FAIL, "#8a5cc2", "#b8860b", "#3f7f8c", "#c2528b", DIM)
_PARTS = (("position", "position"), ("speed", "speed"), ("effort", "effort"))
_SHOWN_EXPRESSION = 46
"""Largest number of characters of an expression."""


def motion_figure(course: Mapping[str, Any]) -> bytes:
    """Draw position, speed and effort of one motion as shares of their limits, as SVG."""

    def draw(figure: Figure) -> None:
        several = len(course["joints"]) > 1
        for row, (key, label) in enumerate(_PARTS):
            axes = figure.add_axes((0.11, 0.70 - 0.285 * row, 0.64 if several else 0.87, 0.235))
            for at, values in enumerate(course[key]):
                axes.plot(
                    course["time"], [100 * v for v in values], linewidth=0.9,
                    color=_COLOURS[at % len(_COLOURS)], label=printable(course["joints"][at]),
                )  # fmt: skip
            for limit in (-100, 100):
                axes.axhline(limit, color=FAIL, linewidth=0.8, linestyle=(0, (4, 3)))
            axes.set_ylim(-115, 115)
            axes.set_yticks([-100, 0, 100])
            axes.set_ylabel(f"{label} [%]")
            axes.set_xlim(0, course["time"][-1])
            if row < 2:
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel("time [s]")
            if row == 0 and several:
                axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.1))

    return svg(draw, 5.6, 3.4)


def deviations_figure(parameters: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw the predicted relative standard deviation of each parameter, logarithmic, as SVG.

    Args:
        parameters: parameters of one mechanism that have a relative deviation.
    """
    least = min(100 * one["relative_std"] for one in parameters)
    most = max(100 * one["relative_std"] for one in parameters)

    def draw(figure: Figure) -> None:
        height = 0.55 + 0.19 * len(parameters)
        axes = figure.add_axes((0.36, 0.42 / height, 0.58, 1.0 - 0.5 / height))
        for row, one in enumerate(parameters):
            value = 100 * one["relative_std"]
            colour = NOW if one["identifiable"] else FAIL
            axes.plot([0.5 * least, value], [row, row], color=BAND, linewidth=1.0)
            axes.plot([value], [row], "o", color=colour, markersize=4)
            axes.text(value * 1.12, row, f"{value:.2g}", va="center", color=INK, fontsize=7)
        axes.set_xlim(0.5 * least, max(3.0 * most, 2.0 * least))
        set_logarithmic(axes, "x")
        axes.set_ylim(len(parameters) - 0.5, -0.5)
        axes.set_yticks(
            range(len(parameters)), [_short_label(one) for one in parameters], fontsize=7
        )
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("predicted standard deviation [% of the nominal value]")

    return svg(draw, 8.4, 0.55 + 0.19 * len(parameters))


def _short_label(one: Mapping[str, Any]) -> str:
    text = printable(one["expression"])
    return text if len(text) <= _SHOWN_EXPRESSION else text[: _SHOWN_EXPRESSION - 2] + " …"
