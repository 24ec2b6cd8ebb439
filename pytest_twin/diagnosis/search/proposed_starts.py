"""Starts that effects propose for a fit at their joint."""

from __future__ import annotations

import numpy as np

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.proposal import JointFit, Start
from pytest_twin.effects.segment import Segment
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
        longest_rest=max(
            _longest_rest(problem.simulator.segments[s], term.joint) for s in problem.fit
        ),
    )
    return list(term.law.propose(here))


def _longest_rest(segment: Segment, joint: int) -> float:
    """Longest time between two changes of a joint's command, s."""
    changes = np.flatnonzero(np.diff(segment.command[:, joint])) + 1
    ends = segment.command_time[[0, *changes]].tolist()
    return float(np.max(np.diff([*ends, max(segment.time[-1], ends[-1])])))
