"""Whether model and findings together are physically possible.

A passive joint cannot push itself: damping, dry friction, armature and spring stiffness of the
model plus all corrections are at least zero. A correction below that compensates for something
else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.base import Parameter

# A total may be below zero by this share of the model's own value: the accuracy to which a
# correction that removes all of it is known (1.7 % where damping of 0.1 N m s/rad was removed from
# simulated recordings).
_TOLERANCE = 0.05
# The same of what is typical of the joint, such as the drive's RMS effort: where the model has none
# of a quantity, a fit ends within this of zero.
_OF_TYPICAL = 0.01


@dataclass(frozen=True, slots=True)
class Total:
    """A quantity of a joint: the model's own value and all corrections of it, SI units.

    Attributes:
        name: of the quantity.
        joint: column.
        own: the model's value.
        parts: (term, index in theta, value) of each correction.
        typical: scale of the corrections, SI units.
    """

    name: str
    joint: int
    own: float
    parts: tuple[tuple[Term, int, float], ...]
    typical: float = 0.0

    @property
    def value(self) -> float:
        """Of model and corrections."""
        return self.own + sum(value for _, _, value in self.parts)

    @property
    def is_impossible(self) -> bool:
        """Whether it is below zero by more than corrections are accurate."""
        return self.value < -max(_TOLERANCE * self.own, _OF_TYPICAL * self.typical, 0.0)


_ADDED = {"damping": "viscous friction", "inertia": "armature", "stiffness": "spring stiffness"}
"""Quantity of a parameter that is added to the model's own -> what the total is called."""


def totals(problem: Problem, hypothesis: Hypothesis) -> list[Total]:
    """Every quantity that some effect of a hypothesis corrects."""
    model = problem.simulator.segments[0].model
    layout = problem.simulator.layout
    own = {
        "damping": model.dof_damping[layout.dof_index],
        "inertia": model.dof_armature[layout.dof_index],
        "stiffness": model.jnt_stiffness[layout.joint_ids],
        "dry friction": model.dof_frictionloss[layout.dof_index],
    }
    parts: dict[tuple[str, int], list[tuple[Term, int, float]]] = {}
    typical: dict[tuple[str, int], float] = {}
    for term in hypothesis.terms:
        at = hypothesis.slice_of(term).start
        for k, p in enumerate(term.parameters):
            quantity = _quantity(term, k, p)
            if quantity is not None and term.joint >= 0:
                value = float(hypothesis.theta[at + k]) * problem.scales.value(p, term.joint)
                parts.setdefault((quantity, term.joint), []).append((term, at + k, value))
                typical[quantity, term.joint] = problem.scales.value(p, term.joint)
    return [
        Total(
            _ADDED.get(quantity, quantity),
            joint,
            float(own[quantity][joint]),
            tuple(found),
            typical[quantity, joint],
        )
        for (quantity, joint), found in parts.items()
    ]


def _quantity(term: Term, k: int, parameter: Parameter) -> str | None:
    """What total a parameter is a part of, if any."""
    if k == term.dry_level:
        return "dry friction"
    if parameter.relation == "added" and parameter.quantity in _ADDED:
        return parameter.quantity
    return None


def impossible(problem: Problem, hypothesis: Hypothesis) -> dict[Term, str]:
    """Effects that make a total impossible, and why: of several corrections those below zero."""
    out: dict[Term, str] = {}
    for total in totals(problem, hypothesis):
        if total.is_impossible:
            why = f"the total {total.name} of the joint would be {total.value:.3g}, below zero"
            out.update({term: why for term, _, value in total.parts if value < 0.0})
    return out


def at_zero(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(parameters,) of a hypothesis, with totals that are slightly below zero at zero: the largest
    negative correction gives way.
    """
    theta = hypothesis.theta.copy()
    for total in totals(problem, hypothesis):
        if total.value < 0.0:
            _, at, value = min(total.parts, key=lambda part: part[2])
            theta[at] *= (value - total.value) / value
    return np.asarray(theta)
