"""Links of other mass behind gears that give: the gear as much stiffer as the link is heavier.

A link swings on its gear and its servo, one behind the other, at the root of their stiffness over
its inertia. A gear that is named first takes the stiffness at which a link of the model's inertia
swings as the real one does; from there a heavier link alone leads off that resonance, and no small
step leads to both.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.diagnosis.fit import fit
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.tryout import Tryout

_GEAR, _COMPLIANCE, _LINK, _ERROR = (
    "joint_elasticity", "compliance", "inertial_parameters", "relative_error",
)  # fmt: skip
# Relative errors of the link's mass and inertia that are tried.
_TRIED = (-0.4, -0.2, 0.2, 0.4, 0.8)
# How many of them are fitted, by so many iterations: both laws are only roughly one resonance.
_FITTED, _ITERATIONS = 2, 3


def resonant(tryout: Tryout, own: Hypothesis) -> list[Hypothesis]:
    """For each gear of a hypothesis that gives, the link of other mass that leaves least with it
    after a short fit, where that is less than without.

    Args:
        tryout: what hypotheses leave.
        own: the fit at hand.
    """
    out = []
    for gear in own.terms:
        link = Term(_LINK, gear.joint)
        if gear.effect != _GEAR or link in own.terms:
            continue
        servo = _servo_compliance(tryout.problem, gear)
        heavier = (_heavier(own, gear, link, error, servo) for error in _TRIED)
        rows = [h for h in heavier if h.theta[h.slice_of(gear)].min() > 0.0]
        if not rows:
            continue
        order = np.argsort(np.nan_to_num(tryout.costs(rows), nan=np.inf))
        near = [rows[i] for i in order[:_FITTED]]
        ends = fit(tryout.problem, near, tryout.weights, tryout.segments, iterations=_ITERATIONS)
        bare, *costs = tryout.costs([own, *(f.hypothesis for f in ends)])
        least = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
        if costs[least] < bare:
            out.append(ends[least].hypothesis)
    return out


def _servo_compliance(problem: Problem, gear: Term) -> float:
    """Of the servo that holds the motor, in multiples of the gear's reference; 0 without one."""
    stiffness = float(problem.simulator.models.world(problem.fit[:1]).stiffness[0, gear.joint])
    (compliance,) = (p for p in gear.parameters if p.name == _COMPLIANCE)
    return 1.0 / (stiffness * problem.scales.value(compliance, gear.joint)) if stiffness else 0.0


def _heavier(own: Hypothesis, gear: Term, link: Term, error: float, servo: float) -> Hypothesis:
    """A hypothesis with a link of (1 + error) times its mass, and the gear stiffer by as much."""
    theta = own.theta.copy()
    names = [p.name for p in gear.parameters]
    at = own.slice_of(gear).start + names.index(_COMPLIANCE)
    theta[at] = (theta[at] + servo) / (1.0 + error) - servo
    start = np.array([error if p.name == _ERROR else 0.0 for p in link.parameters])
    return own.with_theta(theta).with_term(link, start)
