"""Figure of a change: new minus earlier signal, over time and over what the law depends on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pytest_twin.report.figures import svg
from pytest_twin.report.plot_style import DIM, FAIL, GOLDEN
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH, _HEIGHT = 8.6, 2.7
"""Size of the figure, inches."""


def difference_figure(difference: Mapping[str, Any], signal: str) -> bytes:
    """Draw what is new in the efforts or positions of a joint, as SVG.

    Grey: measured, minus what the earlier recordings predict for the same motion or commands. It
    would be noise about 0 if nothing had changed. Red: the change that is named.

    Args:
        difference: object of a finding of ``diagnosis.json``.
        signal: ``effort`` or ``position``.
    """
    unit = printable(difference["unit"])
    over = difference["over"]
    motion_unit = printable(difference["position_unit"]) + ("/s" if over == "velocity" else "")

    def draw(figure: Figure) -> None:
        time, law = figure.subplots(
            1, 2, sharey=True,
            gridspec_kw={"left": 0.1, "right": 0.985, "top": 0.86, "bottom": 0.17,
                         "wspace": 0.06, "width_ratios": [1.7, 1.0]},
        )  # fmt: skip
        time.plot(difference["time"], difference["measured"], color=DIM, linewidth=0.9,
                  label="measured")  # fmt: skip
        time.plot(difference["time"], difference["change"], color=FAIL, linewidth=1.2,
                  label="the change that is named")  # fmt: skip
        time.set_xlabel("time [s]")
        time.set_ylabel(f"new minus earlier {signal} [{unit}]")
        time.set_title(f"{printable(difference['joint'])} in {printable(difference['recording'])}")
        law.plot(difference[over], difference["measured"], ".", color=DIM, markersize=3.0)
        law.plot(difference[over], difference["change"], ".", color=FAIL, markersize=3.0)
        law.set_xlabel(f"{over} [{motion_unit}]")
        for axes in (time, law):
            axes.axhline(0.0, color=GOLDEN, linewidth=0.8, linestyle=(0, (4, 3)))
        figure.legend(*time.get_legend_handles_labels(), loc="upper right", ncols=2)

    return svg(draw, _WIDTH, _HEIGHT)
