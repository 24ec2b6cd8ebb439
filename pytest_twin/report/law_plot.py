"""Figure of an unnamed law: curve, confidence band, and distribution of the data."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from pytest_twin.report.plot_style import BAND, DIM, INK, NOW, STYLE, svg_of
from pytest_twin.report.text import printable

_SIZE = (6.4, 3.4)
"""Size of the figure, inches."""
# The curve is thin where the share of samples times the number of knots is smaller: a tenth of the
# value for a uniform distribution.
_FEW = 0.1


def law_figure(law: Mapping[str, Any], joint: str) -> bytes:
    """Draw an unnamed law as SVG.

    Args:
        law: the object ``law`` of a finding of ``diagnosis.json``.
        joint: name for the title.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    knots, values, samples = (np.array(law[n]) for n in ("knots", "values", "samples"))
    low, high = np.array(law["band"]).T
    against = law["acts"] == "against motion"
    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        figure = Figure(figsize=_SIZE)
        FigureCanvasSVG(figure)
        curve = figure.add_axes((0.12, 0.4, 0.86, 0.52))
        data = figure.add_axes((0.12, 0.14, 0.86, 0.2), sharex=curve)
        curve.set_title(printable(f"{joint}: {law['acts']}")[:90], color=INK)
        curve.axhline(0.0, color=DIM, linewidth=0.6)
        curve.fill_between(knots, low, high, color=NOW, alpha=0.18, linewidth=0)
        curve.plot(knots, values, color=NOW, linewidth=0.7)
        known = samples * len(samples) >= _FEW
        curve.plot(knots, np.where(known, values, np.nan), color=NOW, linewidth=1.8)
        # The band is wide without data, so limit the axis to keep the curve visible.
        room = 2.0 * float(np.max(np.abs(values[known]), initial=1e-12))
        curve.set_ylim(
            max(float(np.min([*low[known], 0.0], initial=0.0)) * 1.1, -room),
            min(float(np.max([*high[known], 0.0], initial=0.0)) * 1.1, room),
        )
        curve.set_ylabel(f"{'friction' if against else 'force'} [{law['force_unit']}]")
        curve.tick_params(labelbottom=False)
        data.bar(knots, 100.0 * samples, width=0.9 * (knots[1] - knots[0]), color=BAND)
        data.set_ylabel("samples [%]")
        unit = "" if law["unit"] == "1" else f" [{law['unit']}]"
        data.set_xlabel(f"{law['variable']}{unit}")
        return svg_of(figure)
