"""Draw figures as bytes; matplotlib is imported only when needed."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING

from pytest_twin.report.plot_style import STYLE, svg_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def svg(draw: Callable[[Figure], None], width: float, height: float) -> bytes:
    """Draw an SVG figure of ``width`` by ``height`` inches, for light and dark pages."""
    return _draw(draw, width, height, "svg")


def png(draw: Callable[[Figure], None], width: float, height: float) -> bytes:
    """Draw a PNG figure of ``width`` by ``height`` inches, 120 dots per inch, on white."""
    return _draw(draw, width, height, "png")


def _draw(draw: Callable[[Figure], None], width: float, height: float, kind: str) -> bytes:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        (FigureCanvasSVG if kind == "svg" else FigureCanvasAgg)(figure)
        draw(figure)
        if kind == "svg":
            return svg_of(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120, facecolor="white")
        return buffer.getvalue()
