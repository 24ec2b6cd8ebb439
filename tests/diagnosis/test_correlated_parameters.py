"""For correlated parameters, the combination that is determined better is reported."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from pytest_twin.diagnosis.findings import describe_correlations
from pytest_twin.diagnosis.intervals import ParameterUncertainty
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Hypothesis, Scales, Term

VISCOUS, COULOMB = Term("viscous_friction", 0), Term("coulomb_friction", 0)
WAVY = Term("position_dependent_friction", 0)
REPORTED = re.compile(
    r"(\w+) and (.+) are strongly correlated \(([+-][\d.]+)\); better known is "
    r"\1 ([+-]) ([\d.e+-]+) x \2 = ([\d.e+-]+) \+- ([\d.e+-]+) \(SI units, 95 %\)"
)
PROBLEM: Problem = SimpleNamespace(  # type: ignore[assignment]
    scales=Scales(
        {
            p.reference: np.array([2.0 + i])
            for i, p in enumerate(p for t in (VISCOUS, COULOMB, WAVY) for p in t.parameters)
        }
    ),
    joints=("elbow",),
)


def spread_of(correlation: np.ndarray, sd: np.ndarray) -> ParameterUncertainty:
    covariance = correlation * np.outer(sd, sd)
    return ParameterUncertainty(1.96 * sd, correlation, covariance, 1.96, covariance)


@pytest.mark.parametrize("rho", [0.97, -0.97])
def test_the_interval_of_the_reported_combination_is_valid_and_narrower_than_each_parameters(
    rho: float,
) -> None:
    hypothesis = Hypothesis((VISCOUS, COULOMB), np.array([0.3, 0.7]))
    correlation, sd = np.array([[1.0, rho], [rho, 1.0]]), np.array([0.04, 0.1])
    width = spread_of(correlation, sd)
    (line,) = describe_correlations(PROBLEM, hypothesis, VISCOUS, width)
    match = REPORTED.fullmatch(line)
    assert match is not None, line
    assert match[1] == hypothesis.terms[0].parameters[0].name
    assert match[2] == "coulomb of coulomb_friction at elbow"
    slope = float(match[4] + match[5])
    draws = np.random.default_rng(0).multivariate_normal(
        hypothesis.theta, width.covariance, size=20_000
    )
    scale = [PROBLEM.scales.value(t.parameters[0], 0) for t in hypothesis.terms]
    draws = draws * scale
    combination = draws[:, 0] + slope * draws[:, 1]
    inside = np.abs(combination - float(match[6])) <= float(match[7])
    assert 0.94 <= inside.mean() <= 0.96
    assert combination.std() < 0.3 * draws[:, 0].std()


def test_a_parameter_that_the_fit_holds_fixed_is_not_reported_as_correlated() -> None:
    hypothesis = Hypothesis((WAVY,), np.array([0.6, 0.4, -0.2, 1.0]))
    names = [p.name for p in WAVY.parameters]
    fixed = names.index("harmonic")
    assert not hypothesis.is_estimated[fixed]
    correlation = np.full((4, 4), 0.98) + 0.02 * np.eye(4)
    lines = describe_correlations(
        PROBLEM, hypothesis, WAVY, spread_of(correlation, np.full(4, 0.1))
    )
    assert len(lines) == 3
    assert not any("harmonic" in line for line in lines)
