"""Of parameters that trade off the combination is said that is known, and it holds."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from pytest_twin.diagnosis.findings import trade_offs
from pytest_twin.diagnosis.hypothesis import Hypothesis, Scales, Term
from pytest_twin.diagnosis.intervals import Spread
from pytest_twin.diagnosis.problem import Problem

VISCOUS, COULOMB = Term("viscous_friction", 0), Term("coulomb_friction", 0)
CRESTS = Term("position_dependent_friction", 0)
KNOWN = re.compile(
    r"(\w+) and (.+) are strongly correlated \(([+-][\d.]+)\); better known is "
    r"\1 ([+-]) ([\d.e+-]+) x \2 = ([\d.e+-]+) \+- ([\d.e+-]+) \(SI units, 95 %\)"
)
PROBLEM: Problem = SimpleNamespace(  # type: ignore[assignment]
    scales=Scales(
        {
            p.reference: np.array([2.0 + i])
            for i, p in enumerate(p for t in (VISCOUS, COULOMB, CRESTS) for p in t.parameters)
        }
    ),
    joints=("elbow",),
)


def found(correlation: np.ndarray, sd: np.ndarray) -> Spread:
    covariance = correlation * np.outer(sd, sd)
    return Spread(1.96 * sd, correlation, covariance, 1.96, covariance)


@pytest.mark.parametrize("rho", [0.97, -0.97])
def test_the_combination_holds_and_is_known_better_than_either(rho: float) -> None:
    hypothesis = Hypothesis((VISCOUS, COULOMB), np.array([0.3, 0.7]))
    correlation, sd = np.array([[1.0, rho], [rho, 1.0]]), np.array([0.04, 0.1])
    width = found(correlation, sd)
    (line,) = trade_offs(PROBLEM, hypothesis, VISCOUS, width)
    said = KNOWN.fullmatch(line)
    assert said is not None, line
    assert said[1] == hypothesis.terms[0].parameters[0].name
    assert said[2] == "coulomb of coulomb_friction at elbow"
    slope = float(said[4] + said[5])
    draws = np.random.default_rng(0).multivariate_normal(
        hypothesis.theta, width.covariance, size=20_000
    )
    scale = [PROBLEM.scales.value(t.parameters[0], 0) for t in hypothesis.terms]
    draws = draws * scale
    combination = draws[:, 0] + slope * draws[:, 1]
    inside = np.abs(combination - float(said[6])) <= float(said[7])
    assert 0.94 <= inside.mean() <= 0.96
    assert combination.std() < 0.3 * draws[:, 0].std()


def test_only_what_a_fit_moves_trades_off() -> None:
    hypothesis = Hypothesis((CRESTS,), np.array([0.6, 0.4, -0.2, 1.0]))
    names = [p.name for p in CRESTS.parameters]
    still = names.index("harmonic")
    assert not hypothesis.movable[still]
    correlation = np.full((4, 4), 0.98) + 0.02 * np.eye(4)
    lines = trade_offs(PROBLEM, hypothesis, CRESTS, found(correlation, np.full(4, 0.1)))
    assert len(lines) == 3
    assert not any("harmonic" in line for line in lines)
