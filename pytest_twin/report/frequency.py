"""Report section on frequency responses, with a row and a figure for each joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pytest_twin.report.figures import svg
from pytest_twin.report.log_axes import set_logarithmic
from pytest_twin.report.page import svg_uri
from pytest_twin.report.plot_style import GOLDEN, NOW
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_FIGURES = 12
"""Largest number of figures on a page; the table has all responses."""
_PANELS = (("magnitude_db", "magnitude [dB]"), ("phase", "phase [rad]"), ("coherence", "coherence"))


def rows_of(responses: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return a row for each response: band, bandwidth and resonance, measured and predicted."""
    return [
        {
            "joint": one["joint"],
            "from": f"{one['input']} to {one['response']}",
            "recording": one["recording"],
            "band": _band(one["measured"]),
            "bandwidth": _both(one, _bandwidth),
            "resonance": _both(one, _resonance),
        }
        for one in responses
    ]


def figures_of(responses: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return (name, image URI) of each response with a figure."""
    return [
        (f"{one['joint']}: {one['input']} to {one['response']}", svg_uri(_draw(one)))
        for one in responses[:_MOST_FIGURES]
    ]


def _band(response: Mapping[str, Any]) -> str:
    lines = response["frequency"]
    return f"{lines[0]:.3g} to {lines[-1]:.3g} Hz, {len(lines)} lines"


def _bandwidth(response: Mapping[str, Any]) -> str:
    value = response["bandwidth"]
    return "not in the band" if value is None else f"{value:.3g} Hz"


def _resonance(response: Mapping[str, Any]) -> str:
    peak = response["resonance"]
    return "none" if peak is None else f"{peak['frequency']:.3g} Hz, {peak['level_db']:+.1f} dB"


def _both(one: Mapping[str, Any], said: Any) -> str:
    words = said(one["measured"])
    return f"{words}; model: {said(one['predicted'])}" if one.get("predicted") else words


def _draw(one: Mapping[str, Any]) -> bytes:
    title = f"{one['joint']}: {one['input']} to {one['response']} ({one['recording']})"

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(_PANELS), 1, sharex=True)
        for axes, (name, label) in zip(rows, _PANELS, strict=True):
            for kind, colour in (("measured", GOLDEN), ("predicted", NOW)):
                if one.get(kind):
                    axes.plot(
                        one[kind]["frequency"], one[kind][name], ".-", color=colour, label=kind
                    )
            axes.set_ylabel(label)
        rows[0].set_title(printable(title))
        rows[0].legend()
        set_logarithmic(rows[-1], "x")
        rows[-1].set_xlabel("frequency [Hz]")

    return svg(draw, 7.0, 5.0)
