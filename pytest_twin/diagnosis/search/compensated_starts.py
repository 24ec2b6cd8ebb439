"""Pairs of effects whose changes cancel to first order, so that no small step leads to both.

Effects state such pairs themselves (``Effect.compensated_starts``): a heavier link on a stiffer
gear has the same resonance as the nominal link on a softer one.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.diagnosis.fit import fit
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.trial_simulation import TrialSimulation

_FITTED, _ITERATIONS = 2, 3
"""Pairs that are fitted, and iterations of the fit: the pairs cancel only approximately."""


def compensated(trial_simulation: TrialSimulation, own: Hypothesis) -> list[Hypothesis]:
    """For each term and each effect that compensates it: the pair with the smallest error.

    The pairs are fitted for a few iterations. A pair is returned only if its error is smaller than
    that of the present fit.

    Args:
        trial_simulation: gives the error of hypotheses.
        own: the present fit.
    """
    out = []
    for term in own.terms:
        for rows in _pairs(trial_simulation.problem, own, term).values():
            order = np.argsort(np.nan_to_num(trial_simulation.costs(rows), nan=np.inf))
            near = [rows[i] for i in order[:_FITTED]]
            ends = fit(
                trial_simulation.problem,
                near,
                trial_simulation.weights,
                trial_simulation.segments,
                iterations=_ITERATIONS,
            )
            bare, *costs = trial_simulation.costs([own, *(f.hypothesis for f in ends)])
            least = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
            if costs[least] < bare:
                out.append(ends[least].hypothesis)
    return out


def _pairs(problem: Problem, own: Hypothesis, term: Term) -> dict[str, list[Hypothesis]]:
    """Effect id -> hypotheses with a term of it that compensates a change of ``term``."""
    if not term.law.overrides("compensated_starts"):
        return {}
    names = [p.name for p in term.parameters]
    at = own.slice_of(term)
    values = dict(zip(names, own.theta[at].tolist(), strict=True))
    found: dict[str, list[Hypothesis]] = {}
    servo = _servo_compliance(problem, term)
    for changed, effect, other in term.law.compensated_starts(values, servo):
        new = Term(effect, term.joint)
        theta = own.theta.copy()
        theta[at] = [changed.get(name, values[name]) for name in names]
        if new not in own.terms:
            start = np.array([other.get(p.name, 0.0) for p in new.parameters])
            found.setdefault(effect, []).append(own.with_theta(theta).with_term(new, start))
    return found


def _servo_compliance(problem: Problem, term: Term) -> float:
    """Reciprocal stiffness of the joint's servo, in multiples of the reference; 0 without one."""
    if term.joint < 0:
        return 0.0
    stiffness = float(problem.simulator.models.world(problem.fit[:1]).stiffness[0, term.joint])
    scale = float(problem.scales.of["compliance"][term.joint])
    return 1.0 / (stiffness * scale) if stiffness else 0.0
