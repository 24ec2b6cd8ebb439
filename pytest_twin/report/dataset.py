"""Format the check of a data set as text for the terminal and as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pytest_twin.report.figures import svg
from pytest_twin.report.page import Page, svg_uri
from pytest_twin.report.plot_style import DIM, FAIL, NOW
from pytest_twin.report.text import printable
from pytest_twin.words import counted, list_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_EPISODES = 6
"""Largest number of episodes in a line."""
_COLUMNS = 3
"""Figures in a row."""


def text(document: Mapping[str, Any]) -> str:
    """Return text for the terminal."""
    facts = document["format"]
    lines = [
        f"{document['dataset']}: {headline(document)}",
        f"{counted(facts['episodes'], 'episode')}, {counted(facts['frames'], 'frame')}, "
        f"{facts['fps']} fps, {facts['robot_type'] or 'robot not stated'}, positions in "
        f"{document['unit']['value']}",
    ]
    if document["joints"]:
        width = max(map(len, document["joints"]))
        lines.append(f"{'':<{width}}{'offset':>14}{'lag':>10}{'gain':>8}")
    for name, one in document["joints"].items():
        lag = "" if one["lag"] is None else f"{1e3 * one['lag']['value']:.0f} ms"
        gain = "" if one["gain"] is None else f"{one['gain']:.2f}"
        offset = f"{one['offset']:+.3g} {one['unit']}"
        lines.append(f"{name:<{width}}{offset:>14}{lag:>10}{gain:>8}")
    for one in document["findings"]:
        subject = f"{one['joint']}: " if one["joint"] else ""
        lines.append(f"X {one['code']}: {subject}{one['text']}{episodes(one['episodes'])}")
        lines.append(f"    next: {one['next_step']}")
    lines += [f"? {one['what']}: {one['why']}" for one in document["unknown"]]
    return "\n".join(printable(line) for line in lines)


def headline(document: Mapping[str, Any]) -> str:
    """Return the verdict in words."""
    count = len(document["findings"])
    return f"{counted(count, 'finding')}" if count else "nothing found"


def episodes(numbers: Sequence[int]) -> str:
    """Return the affected episodes in words; empty for all."""
    if not numbers:
        return ""
    plural = "episode" if len(numbers) == 1 else "episodes"
    return f" ({plural} {list_names([str(n) for n in numbers], _EPISODES)})"


def render(document: Mapping[str, Any]) -> str:
    """Return the check as an HTML page.

    Args:
        document: content of the JSON file.
    """
    return _PAGE.render(
        document=document,
        headline=headline(document),
        figure=svg_uri(_offsets(document["joints"])) if document["joints"] else None,
    )


def _offsets(joints: Mapping[str, Any]) -> bytes:
    """Draw the offset of each joint over the episodes, as SVG."""
    rows = -(-len(joints) // _COLUMNS)

    def draw(figure: Figure) -> None:
        for at, (name, one) in enumerate(joints.items()):
            axes = figure.add_subplot(rows, _COLUMNS, at + 1)
            numbers = [int(number) for number in one["offset_by_episode"]]
            axes.plot(numbers, list(one["offset_by_episode"].values()), ".", color=NOW)
            axes.axhline(0.0, color=DIM, linewidth=0.6)
            axes.axhline(one["offset"], color=FAIL, linewidth=0.6, linestyle=(0, (4, 3)))
            axes.set_title(printable(f"{name} [{one['unit']}]"))
        figure.supxlabel("episode", fontsize=8)
        figure.subplots_adjust(0.06, 0.4 / (1.6 * rows), 0.99, 0.92, 0.25, 0.5)

    return svg(draw, 9.0, 1.6 * rows)


_PAGE = Page("dataset.html.j2", "audit.css", episodes=episodes)
