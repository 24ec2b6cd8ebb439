"""Starts that effects propose for a fit at their joint."""

from __future__ import annotations

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.proposal import JointFit, Start
from pytest_twin.estimation.hypothesis import Hypothesis, Term


def starts_at(problem: Problem, own: Hypothesis, term: Term) -> list[Start]:
    """Starts that an effect proposes at its joint, beside or within a hypothesis."""
    if term.joint < 0:
        return []
    present = None
    if term in own.terms:
        values = own.theta[own.slice_of(term)].tolist()
        present = dict(zip((p.name for p in term.parameters), values, strict=True))
    stiffness = float(problem.simulator.models.world(problem.fit[:1]).stiffness[0, term.joint])
    scale = float(problem.scales.of["compliance"][term.joint])
    here = JointFit(
        servo=str(problem.simulator.layout.servo[term.joint]),
        servo_compliance=1.0 / (stiffness * scale) if stiffness else 0.0,
        present=present,
        is_nominal=not own.terms,
    )
    return list(term.law.propose(here))
