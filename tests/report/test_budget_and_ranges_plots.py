"""Figures of the error budget and of randomization ranges show the numbers of their documents."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from lxml import etree
from matplotlib.figure import Figure

from pytest_twin.report import budget_plots, ranges_plots

pytestmark = pytest.mark.usefixtures("rendered_figures")

SVG = "{http://www.w3.org/2000/svg}"
Drawn = Callable[..., Figure]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    """Draw a figure with one of both modules, and return it instead of its SVG."""

    def figure_of(make: Callable[..., Any], *arguments: Any) -> Figure:
        found: list[Figure] = []

        def keep(draw: Callable[[Figure], None], width: float, height: float) -> bytes:
            figure = Figure(figsize=(width, height))
            draw(figure)
            found.append(figure)
            return b"drawn"

        for module in (budget_plots, ranges_plots):
            monkeypatch.setattr(module, "svg", keep)
        assert make(*arguments) == b"drawn"
        return found[0]

    return figure_of


def widths(figure: Figure) -> list[float]:
    """Lengths of the horizontal bars from top to bottom."""
    (axes,) = figure.axes
    return [bar.get_width() for bar in axes.patches]


def texts(figure: Figure) -> str:
    return " | ".join(text.get_text() for axes in figure.axes for text in axes.texts)


def labels(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].get_yticklabels()]


def category(name: str, position: float | None, **changes: Any) -> dict[str, Any]:
    moves = None if position is None else {"position": position, "rotation": 0.0}
    found = {"category": name, "state": "measured", "moves": moves, "beyond": None,
             "counted_in": []}  # fmt: skip
    return {**found, **changes}


def line(name: str, position: float, parts: dict[str, float]) -> dict[str, Any]:
    own = {"position": position, "rotation": 0.0}
    return {
        "id": name,
        "sampled": own,
        "parts": [
            {"name": part, "alone": {"position": value, "rotation": 0.0}}
            for part, value in parts.items()
        ],
    }


BUDGET = {
    "tolerance": {"position": 0.004, "rotation": None},
    "categories": [
        category("timing", 0.003),
        category("frame_calibration", 0.004),
        category("sensing", None, state="counted_elsewhere", counted_in=["wrist"]),
        category("contact_and_material", None, state="not_measured"),
        category("unmodelled", None, beyond={"position": 0.002, "rotation": None}),
    ],
    "lines": [
        line("clock", 0.003, {"time offset": 0.003}),
        line("cell", 0.004, {"joint zeros": 0.0035, "hand-eye": 0.0025}),
    ],
    "total": {"sampled": {"position": 0.005, "rotation": 0.0}},
}


def test_a_budget_has_a_bar_for_each_category_with_its_share_of_the_tolerance(
    drawn: Drawn,
) -> None:
    figure = drawn(budget_plots.categories_figure, BUDGET, "position")
    assert labels(figure) == [
        "timing", "frame calibration", "sensing", "contact and material", "unmodelled",
    ]  # fmt: skip
    assert widths(figure) == pytest.approx([3.0, 4.0, 2.0])
    found = texts(figure)
    assert "3 mm (75 %)" in found
    assert "4 mm (100 %)" in found
    assert "2 mm at most (50 %)" in found
    assert "counted with wrist" in found
    assert "not measured" in found
    (tolerance,) = figure.axes[0].lines
    assert set(tolerance.get_xdata()) == {4.0}


def test_the_steps_of_the_waterfall_add_in_quadrature_to_the_total(drawn: Drawn) -> None:
    """Of 3 mm and 4 mm the second step is from 3 to 5 mm; parts of one record do not add."""
    figure = drawn(budget_plots.waterfall_figure, BUDGET, "position")
    assert labels(figure) == ["joint zeros", "hand-eye", "clock", "cell", "total"]
    bars = figure.axes[0].patches
    assert [bar.get_width() for bar in bars] == pytest.approx([3.5, 2.5, 3.0, 2.0, 5.0])
    assert [bar.get_x() for bar in bars] == pytest.approx([0.0, 0.0, 0.0, 3.0, 0.0])
    assert texts(figure).endswith("5 mm")


def test_without_a_cause_there_is_no_waterfall() -> None:
    assert budget_plots.waterfall_figure(BUDGET, "rotation") is None


JOINTS = {
    "elbow": {"histogram": [0.02] * 5 + [0.18] * 5, "uneven_chance": 0.01},
    "wrist": {"histogram": [0.1] * 10, "uneven_chance": 0.7},
}


def test_the_probability_integral_is_drawn_beside_the_uniform_share(drawn: Drawn) -> None:
    figure = drawn(ranges_plots.transform_figure, JOINTS)
    elbow, wrist = figure.axes
    assert [bar.get_height() for bar in elbow.patches] == pytest.approx([2.0] * 5 + [18.0] * 5)
    assert [bar.get_height() for bar in wrist.patches] == pytest.approx([10.0] * 10)
    assert set(elbow.lines[0].get_ydata()) == {10.0}
    # An uneven histogram has another colour.
    assert elbow.patches[0].get_facecolor() != wrist.patches[0].get_facecolor()
    assert elbow.get_title() == "elbow: p = 0.01"


def test_samples_outside_the_envelope_are_marked(drawn: Drawn) -> None:
    panel = {
        "recording": "final.mcap", "joint": "elbow", "unit": "rad", "time": [0.0, 0.1, 0.2, 0.3],
        "middle": [0.0, 0.1, 0.2, 0.3], "lower": [-0.1, 0.0, 0.1, 0.2],
        "upper": [0.1, 0.2, 0.3, 0.4], "measured": [0.0, 0.25, 0.2, 0.15],
    }  # fmt: skip
    motion, off = drawn(ranges_plots.envelope_figure, [panel]).axes
    marked = off.lines[-1]
    assert marked.get_xdata().tolist() == [0.1, 0.3]
    assert marked.get_ydata() == pytest.approx([150.0, -150.0])
    assert motion.lines[1].get_ydata().tolist() == panel["measured"]


def test_given_and_measured_ranges_are_drawn_over_the_value_of_the_model(drawn: Drawn) -> None:
    entry = {"parameter": "elbow.coulomb_friction", "nominal": 0.2, "given": [0.0, 1.8],
             "measured": [0.1, 0.3]}  # fmt: skip
    figure = drawn(ranges_plots.against_figure, [entry])
    assert widths(figure) == pytest.approx([9.0, 1.0])
    assert set(figure.axes[0].lines[0].get_xdata()) == {1.0}
    assert labels(figure) == ["elbow.coulomb_friction"]


def test_the_correlation_matrix_is_drawn_up_to_a_readable_size(drawn: Drawn) -> None:
    matrix = np.array([[1.0, -0.6], [-0.6, 1.0]])
    figure = drawn(ranges_plots.correlation_figure, ["a.armature", "a.friction"], matrix.tolist())
    assert figure.axes[0].images[0].get_array().tolist() == matrix.tolist()
    assert ranges_plots.correlation_figure(["a"], [[1.0]]) is None
    many = [f"j{k}.armature" for k in range(40)]
    assert ranges_plots.correlation_figure(many, np.eye(40).tolist()) is None


def test_a_large_correlation_matrix_fits_with_its_colour_bar_and_different_labels(
    drawn: Drawn,
) -> None:
    laws = ("coulomb", "stiction_excess", "stribeck_velocity")
    names = [f"shoulder_pan_{k}.stribeck_friction.{law}" for k in range(10) for law in laws]
    figure = drawn(ranges_plots.correlation_figure, names, np.eye(len(names)).tolist())
    figure.canvas.draw()
    whole = figure.bbox
    for axes in figure.axes:
        box = axes.get_tightbbox()
        assert box.x0 >= whole.x0
        assert box.x1 <= whole.x1
    assert len(set(labels(figure))) == len(names)


@pytest.mark.parametrize("name", ["<b>&", "a" * 80, "poignée"])
def test_figures_are_valid_svg_for_any_name(name: str) -> None:
    budget = {**BUDGET, "lines": [line(name, 0.003, {name: 0.001, "b": 0.002})]}
    pages = [
        budget_plots.waterfall_figure(budget, "position"),
        budget_plots.categories_figure(BUDGET, "position"),
        ranges_plots.transform_figure({name: JOINTS["elbow"]}),
    ]
    for page in pages:
        assert page is not None
        tree = etree.fromstring(page, etree.XMLParser(resolve_entities=False, no_network=True))
        assert next(tree.iter(f"{SVG}text"), None) is not None
