"""Text of a failed golden for people."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pytest_twin.outcome import Measure, Outcome, Reason, tolerance_ratio
from pytest_twin.report.failure import failure_text, headline, measure_table
from pytest_twin.report.text import printable, use

ELBOW = Measure("angle", "elbow", 0.5213, 0.4893, 0.032, 0.0107, "rad", time=1.234)
WRIST = Measure("angle", "wrist", 0.1, 0.101, 0.001, 0.0107, "rad", time=0.5)
FAILED = Outcome(
    golden="golden/step/elbow",
    kind="step",
    realization="mujoco",
    criticality="critical",
    status="failed",
    measures=(WRIST, ELBOW),
    reasons=(
        Reason("mujoco/inertia:forearm", "mass", "0.5", "0.7"),
        Reason("no release yet"),
    ),
)


def test_a_failure_text_states_values_margin_cause_spec_and_plot() -> None:
    text = failure_text(FAILED, location="golden/step/elbow.yaml:12", plot=".twin/plots/x.svg")
    assert text == "\n".join(
        [
            "golden/step/elbow@mujoco: "
            "angle of elbow exceeded its tolerance of 0.0107 rad by 0.0213 rad at 1.234 s",
            "  worst        angle of elbow at 1.234 s",
            "  measured     0.5213 rad",
            "  golden       0.4893 rad",
            "  error        0.032 rad",
            "  tolerance    0.0107 rad",
            "  margin       -0.0213 rad (used 299 %)",
            "  ran because  mujoco/inertia:forearm: mass 0.5 -> 0.7",
            "               no release yet",
            "  spec         golden/step/elbow.yaml:12",
            "  plot         .twin/plots/x.svg",
            "",
            "        measure  of     at       measured    against"
            "              error  tolerance  margin",
            "  FAIL  angle    elbow  1.234 s  0.5213 rad  0.4893 rad (golden)"
            "  0.032  0.0107     -0.0213",
            "  ok    angle    wrist  0.5 s    0.1 rad     0.101 rad (golden)"
            "   0.001  0.0107     0.0097",
        ]
    )


def test_the_table_has_a_time_column_only_if_measures_have_times() -> None:
    still = [replace(measure, time=None) for measure in (ELBOW, WRIST)]
    assert measure_table(still)[0].split() == (
        ["measure", "of", "measured", "against", "error", "tolerance", "margin"]
    )


def test_an_error_text_states_the_error_and_the_spec() -> None:
    outcome = replace(FAILED, status="error", measures=(), reasons=(), error="simulation diverged")
    assert failure_text(outcome, location="golden/step/elbow.yaml:12") == (
        "golden/step/elbow@mujoco: simulation diverged\n  spec  golden/step/elbow.yaml:12"
    )


def test_the_headline_states_the_worst_failure_and_counts_the_others() -> None:
    several = replace(FAILED, measures=(ELBOW, replace(ELBOW, subject="wrist", error=0.02)))
    assert headline(several).endswith("at 1.234 s (1 more failed)")
    assert headline(replace(FAILED, status="passed", measures=(WRIST,))) == (
        "golden/step/elbow@mujoco: angle of wrist used 9.35 % of its tolerance"
    )


def test_a_measure_that_is_not_a_number_is_the_worst() -> None:
    lost = replace(WRIST, error=math.nan)
    outcome = replace(FAILED, measures=(ELBOW, lost))
    assert headline(outcome).startswith(
        "golden/step/elbow@mujoco: angle of wrist is not a number at 0.5 s"
    )
    assert "FAIL" in measure_table((lost,))[1]


def test_a_long_table_shows_only_the_40_worst_measures() -> None:
    measures = [replace(ELBOW, subject=f"joint{i}", error=0.02 + i * 1e-3) for i in range(100)]
    lines = measure_table(measures)
    assert len(lines) == 42
    assert "joint99" in lines[1]
    assert lines[-1] == "  and 60 more, 60 of them failed"


def test_a_long_list_of_changes_is_shortened() -> None:
    outcome = replace(FAILED, reasons=tuple(Reason(f"part{i}") for i in range(50)))
    assert "and 42 more changes" in failure_text(outcome, location="x:1")


def test_names_cannot_inject_escape_sequences_or_lines() -> None:
    hostile = replace(ELBOW, subject="el\x1b[31mbow\nPASSED")
    outcome = replace(FAILED, golden="a\u202eb", measures=(hostile, WRIST))
    text = failure_text(outcome, location="x\ry:1")
    assert not set(text) & set("\x1b\r\u202e")
    assert "PASSED" not in [line.strip() for line in text.splitlines()]
    assert printable("a\tb\x00") == "a\N{REPLACEMENT CHARACTER}b\N{REPLACEMENT CHARACTER}"


@pytest.mark.parametrize(
    ("error", "tolerance", "expected"),
    [
        (0.5, 1.0, "50 %"),
        (1e-9, 1.0, "< 0.1 %"),
        (25.0, 1.0, "25 times"),
        (0.0, 0.0, "< 0.1 %"),
        (1.0, 0.0, "all of none"),
        (math.nan, 1.0, "no number"),
        (math.inf, 1.0, "no number"),
        (math.inf, math.inf, "no number"),
    ],
)
def test_the_used_fraction_of_a_tolerance_is_in_percent_or_multiples(
    error: float, tolerance: float, expected: str
) -> None:
    measure = Measure("a", "b", 0.0, 0.0, error, tolerance, "m")
    assert use(measure) == expected
    assert measure.passed == (tolerance_ratio(measure) <= 1.0)


def test_an_outcome_survives_conversion_to_json_and_back() -> None:
    import json

    odd = replace(FAILED, measures=(replace(ELBOW, error=math.inf, time=None), WRIST))
    assert Outcome.from_json(json.loads(json.dumps(odd.to_json(), allow_nan=False))) == odd


def test_an_rms_measure_states_the_time_of_its_largest_error() -> None:
    mean = replace(ELBOW, name="position_rms")
    outcome = replace(FAILED, measures=(mean,))
    assert headline(outcome).endswith(" by 0.0213 rad (largest at 1.234 s)")
    text = failure_text(outcome, location="golden/replay/a.yaml:3")
    assert "position_rms of elbow (largest at 1.234 s)" in text


@pytest.mark.parametrize(
    ("error", "words"), [(0.0107, "100 %"), (0.1069, "999 %"), (0.107, "10 times")]
)
def test_the_used_fraction_of_a_tolerance_has_no_exponent(error: float, words: str) -> None:
    assert use(replace(ELBOW, error=error)) == words
