"""Plots of measures and series for any numbers and names."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from lxml import etree
from matplotlib.figure import Figure

from pytest_twin.checks.base import Trace
from pytest_twin.outcome import Measure
from pytest_twin.report.panels import Line, frequency_panels, thin, time_panels
from pytest_twin.report.plots import plot

pytestmark = pytest.mark.usefixtures("rendered_figures")

SVG = "{http://www.w3.org/2000/svg}"
TIME = np.linspace(0.0, 2.0, 401)


def words(svg: bytes | None) -> list[str]:
    assert svg is not None
    tree = etree.fromstring(svg, etree.XMLParser(resolve_entities=False, no_network=True))
    return ["".join(node.itertext()) for node in tree.iter(f"{SVG}text")]


def trace(shift: float = 0.0, unit: str = "rad", names: Sequence[str] = ("elbow",)) -> Trace:
    columns = {f"position:{name}": (unit, np.sin(3 * TIME) + shift * TIME) for name in names}
    return Trace(("time", "s"), TIME, columns)


def worst_of(now: Trace, then: Trace, name: str, tolerance: float) -> Measure:
    unit, values = now.columns[f"position:{name}"]
    expected = then.columns[f"position:{name}"][1]
    error = np.abs(values - expected)
    at = int(error.argmax())
    return Measure(
        "angle",
        name,
        float(values[at]),
        float(expected[at]),
        float(error[at]),
        tolerance,
        unit,
        time=float(TIME[at]),
    )


def test_a_series_plot_shows_the_worst_sample_and_the_tolerance() -> None:
    now, then = trace(0.05), trace()
    found = words(plot("step", "Step", [worst_of(now, then, "elbow", 0.02)], now, then))
    assert "Step  (step)" in found
    assert "position of elbow" in found
    assert "0.1 at 2 s, of 0.02 rad allowed" in found
    assert {"tolerance", "golden", "now", "worst sample"} <= set(found)
    assert "time [s]" in found


def test_panels_are_sorted_by_their_worst_measure() -> None:
    names = [f"joint{i}" for i in range(7)]
    then = trace(names=names)
    columns = {
        f"position:{name}": ("rad", np.sin(3 * TIME) + 0.01 * i * TIME)
        for i, name in enumerate(names)
    }
    now = Trace(("time", "s"), TIME, columns)
    measures = [worst_of(now, then, name, 0.05) for name in names]
    panels, left_out = time_panels(measures, now, then)
    assert [panel.title for panel in panels] == [f"position of joint{i}" for i in (6, 5, 4)]
    assert left_out == 4
    assert panels[0].worst is not None
    assert panels[0].worst.error == pytest.approx(0.12)


def test_an_rms_measure_draws_no_tolerance_band() -> None:
    """An RMS measure has a time too, but it is not a value of the series."""
    now, then = trace(0.05), trace()
    rms = Measure("rms", "elbow", 0.058, 0.0, 0.058, 0.02, "rad", "recording", time=2.0)
    (panel,), _ = time_panels([rms], now, then)
    assert panel.worst is None
    assert panel.against == "recording"
    assert "rms 0.058, of 0.02 rad allowed" in words(plot("replay", "R", [rms], now, then))
    peak = worst_of(now, then, "elbow", 0.5)
    (panel,), _ = time_panels([rms, peak], now, then)
    assert panel.worst is not None
    assert panel.worst.tolerance == 0.5


def test_a_command_is_drawn_in_the_panel_of_its_joint() -> None:
    now = trace()
    both = Trace(now.axis, now.x, {"command:elbow": ("rad", np.ones(401)), **now.columns})
    (panel,), _ = time_panels([], both, None)
    assert panel.title == "position of elbow"
    assert panel.command is not None
    effort = Trace(now.axis, now.x, {"command:elbow": ("N*m", np.ones(401)), **now.columns})
    panels, _ = time_panels([], effort, None)
    assert sorted(panel.title for panel in panels) == ["command of elbow", "position of elbow"]


def test_frequency_responses_are_drawn_in_db_on_a_logarithmic_axis() -> None:
    frequency = np.geomspace(0.5, 20.0, 60)
    columns = {
        "magnitude": ("1", 1.0 / frequency),
        "phase": ("rad", -np.arctan(frequency)),
        "coherence": ("1", np.ones(60)),
    }
    now = Trace(("frequency", "Hz"), frequency, columns)
    then = Trace(now.axis, now.x, columns | {"magnitude": ("1", 2.0 / frequency)})
    bound = Measure("magnitude", "elbow at 3 Hz", 0.0, 0.0, 6.02, 3.0, "dB")
    panels, _ = frequency_panels([bound], now, then)
    assert [(panel.title, panel.unit) for panel in panels] == [
        ("magnitude", "dB"),
        ("phase", "rad"),
        ("coherence", ""),
    ]
    assert panels[0].residual is not None
    np.testing.assert_allclose(panels[0].residual.y, -20.0 * math.log10(2.0))
    found = words(plot("frequency_response", "Chirp", [bound], now, then))
    assert {"magnitude", "phase", "coherence", "frequency [Hz]", "1", "10"} <= set(found)
    assert any(word.startswith("6.02 at") for word in found)


def test_without_series_errors_are_drawn_relative_to_their_tolerances() -> None:
    measures = [
        Measure("position", f"tcp at pose {i}", 0.0, 0.0, 10.0**-i, 1e-2, "m") for i in range(20)
    ]
    found = words(plot("fk", "Kinematics", measures, None, None))
    assert "position  tcp at pose 0" in found
    assert "1 of 0.01 m" in found
    assert "error, of the tolerance   (6 with less not shown)" in found


def test_without_measures_there_is_no_plot() -> None:
    assert plot("fk", "Kinematics", [], None, None) is None
    assert plot("step", "Step", [], Trace(("time", "s"), TIME, {}), None) is None


def test_plots_change_their_colours_in_dark_mode() -> None:
    svg = (plot("step", "Step", [], trace(), None) or b"").decode()
    assert "prefers-color-scheme:dark" in svg
    light = set(re.findall(r"(?:fill|stroke): (#[0-9a-f]{6})", svg))
    swapped = set(re.findall(r'\[style\*="(?:fill|stroke): (#[0-9a-f]{6})"\]', svg))
    # matplotlib writes clip paths and empty markers in black.
    assert light - {"#000000"} <= swapped


def test_the_size_of_a_plot_does_not_depend_on_the_length_of_the_series() -> None:
    time = np.linspace(0.0, 200.0, 200_000)
    noise = np.random.default_rng(1).normal(size=(6, time.size))
    now = Trace(("time", "s"), time, {f"position:j{i}": ("rad", noise[i]) for i in range(6)})
    then = Trace(now.axis, time, {name: (u, v + 0.1) for name, (u, v) in now.columns.items()})
    svg = plot("replay", "Long", [], now, then)
    assert svg is not None
    assert len(svg) < 200_000


def test_downsampling_keeps_every_spike() -> None:
    values = np.zeros(100_000)
    values[[5, 33_333, 99_998]] = (3.0, -7.0, 5.0)
    line = thin(Line(np.arange(values.size, dtype=float), values))
    assert line.x.size <= 502
    for at in (5, 33_333, 99_998):
        assert line.y[line.x == at] == values[at]
    assert (np.diff(line.x) > 0).all()


@pytest.mark.parametrize("kind", ["time", "frequency", "bars"])
def test_all_text_lies_within_the_plot_and_panels_do_not_overlap(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[Figure] = []

    def keep(figure: Figure) -> bytes:
        kept.append(figure)
        return b""

    monkeypatch.setattr("pytest_twin.report.plots.svg_of", keep)
    long = "of_a_joint_with_a_long_name_that_nobody_wants_to_read_twice"
    if kind == "bars":
        plot("fk", "Bars", [Measure(long, long, 1.0, 0.0, 1e-9, 1e-8, "N*m*s/rad")], None, None)
    elif kind == "time":
        now, then = (trace(1e-7 * x, "N*m*s/rad", [long, "elbow"]) for x in (1.0, 0.0))
        plot("step", "Step", [worst_of(now, then, long, 1e-9)], now, then)
    else:
        lines = np.geomspace(0.5, 50.0, 30)
        columns = {
            "magnitude": ("dB re rad/rad", 1e-5 * lines),
            "phase": ("rad", -0.01 * lines),
            "coherence": ("1", np.ones(30)),
        }
        plot("frequency_response", "F", [], Trace(("frequency", "Hz"), lines, columns), None)
    (figure,) = kept
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    width, height = figure.bbox.size
    for box in boxes:
        assert box.x0 > -1.0
        assert box.y0 > -1.0
        assert box.x1 < width + 1.0
        assert box.y1 < height + 1.0
    for above, below in pairwise(boxes):
        assert above.y0 > below.y1 - 1.0
    title = figure.texts[0].get_window_extent()
    for legend in figure.legends:
        assert legend.get_window_extent().y1 < title.y0 + 1.0
        assert legend.get_window_extent().y0 > boxes[0].y1 - 1.0


def test_plots_are_reproducible() -> None:
    assert plot("step", "Step", [], trace(), trace(0.1)) == plot(
        "step", "Step", [], trace(), trace(0.1)
    )


_NAMES = st.text(max_size=30) | st.sampled_from(
    ["$x_1$", "<script>alert(1)</script>", "a&b", "]]>", "\\frac{", "$\\notacommand{$", "_hidden"]
)
_VALUES = st.floats() | st.sampled_from([0.0, 1e-300, 1e300, math.nan, math.inf])


# Drawing is slow, so failing examples are not shrunk.
_DRAWN = settings(max_examples=12, deadline=None, phases=(Phase.explicit, Phase.generate))


@_DRAWN
@given(_NAMES, st.lists(st.tuples(_NAMES, _VALUES, _VALUES), min_size=1, max_size=5))
def test_bar_plots_can_be_drawn_for_any_name_and_number(
    title: str, given_measures: list[tuple[str, float, float]]
) -> None:
    measures = [
        Measure("m", name, error, 0.0, error, tolerance, "m")
        for name, error, tolerance in given_measures
    ]
    words(plot("fk", title, measures, None, None))


@_DRAWN
@given(_NAMES, _NAMES, st.lists(_VALUES, min_size=5, max_size=5), _VALUES)
def test_series_plots_can_be_drawn_for_any_name_and_number(
    title: str, name: str, values: list[float], tolerance: float
) -> None:
    x = np.arange(5.0)
    now = Trace(("time", "s"), x, {f"position:{name}": ("rad", np.array(values))})
    then = Trace(("time", "s"), x, {f"position:{name}": ("rad", np.arange(5.0))})
    measure = Measure(
        "angle", name, values[2], 2.0, abs(values[2] - 2.0), tolerance, "rad", time=2.0
    )
    words(plot("step", title, [measure], now, then))
