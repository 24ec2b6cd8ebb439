"""Style of plots, for light and dark pages."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Light colour -> dark colour. The SVG has the light ones; a style rule replaces them.
INK, DIM, GRID = "#1c2430", "#5c6675", "#d5dae1"
NOW, GOLDEN, BAND, PASS, FAIL = "#0b62c4", "#3f4a59", "#c9d3e0", "#2b8a6b", "#c8341f"
_DARK = {
    INK: "#e8ecf2",
    DIM: "#a3adba",
    GRID: "#39424e",
    NOW: "#6cb2ff",
    GOLDEN: "#c4ccd6",
    BAND: "#3a4655",
    PASS: "#5cc7a2",
    FAIL: "#ff7a63",
}

STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "pytest-twin",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "text.color": INK,
    # Names come from files, so do not interpret dollar signs as formulas.
    "text.parse_math": False,
    # A `matplotlibrc` in the working folder must not start LaTeX.
    "text.usetex": False,
    "axes.edgecolor": DIM,
    "axes.labelcolor": DIM,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    # No axis has ticks at its top; searching for them takes a fifth of the drawing time.
    "axes.titley": 1.0,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": DIM,
    "ytick.color": DIM,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "lines.linewidth": 1.3,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8,
}
"""Matplotlib settings of all plots."""


def svg_of(figure: Figure) -> bytes:
    """The figure as an SVG for light and dark pages; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
    figure.savefig(buffer, format="svg", transparent=True, metadata=metadata)
    return finish(buffer.getvalue().decode("utf-8")).encode("utf-8")


def finish(svg: str) -> str:
    """Shorten decimals in an SVG, and add a rule that replaces colours on a dark page."""
    svg = re.sub(
        r' d="[^"]*"', lambda m: re.sub(r"(\d+\.\d)\d+", r"\1", m[0]).replace("\n", ""), svg
    )
    rules = "".join(
        f'[style*="{name}: {light}"]{{{name}:{dark} !important}}'
        for light, dark in _DARK.items()
        for name in ("fill", "stroke")
    )
    style = (
        "<style>text{font-family:system-ui,sans-serif}"
        f"@media (prefers-color-scheme:dark){{{rules}}}</style>"
    )
    start = svg.index("<svg")
    end = svg.index(">", start) + 1
    return svg[start:end] + style + svg[end:]
