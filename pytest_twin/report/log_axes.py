"""Logarithmic axes with plain numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FEW_DECADES = 1.5
"""Number of decades up to which 2 and 5 are labelled too: a band may contain at most one decade."""


def set_logarithmic(axes: Axes, *which: str) -> None:
    """Make the axes ``x`` or ``y`` logarithmic; call this after drawing.

    Labels are plain numbers, because reports do not interpret matplotlib's formulas.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for name in which:
        (axes.set_xscale if name == "x" else axes.set_yscale)("log")
        axis = axes.xaxis if name == "x" else axes.yaxis
        low, high = axis.get_view_interval()
        narrow = 0.0 < low < high and np.log10(high / low) <= _FEW_DECADES
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if narrow else (1.0,), numticks=6))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
