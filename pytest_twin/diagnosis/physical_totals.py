"""Physical limits of the sum of model and findings.

A passive joint cannot generate energy: damping, dry friction, armature and spring stiffness of the
model plus all corrections are at least zero, damping and dry friction in both directions of motion.
A negative total compensates for another effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.correction_settings import CORRECTIONS
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.base import Parameter
from pytest_twin.estimation.hypothesis import Hypothesis, Term


@dataclass(frozen=True, slots=True)
class Total:
    """A quantity of a joint: the model's own value and all corrections of it, SI units.

    Attributes:
        joint: column of the joint.
        own: the model's value.
        parts: (term, index in theta, value) of each correction.
        typical: scale of the corrections, SI units.
        differences: (term, index in theta, value) of each half difference between the directions of
            motion.
    """

    name: str
    joint: int
    own: float
    parts: tuple[tuple[Term, int, float], ...]
    typical: float = 0.0
    differences: tuple[tuple[Term, int, float], ...] = ()

    @property
    def value(self) -> float:
        """Sum of the model's value and all corrections, SI units."""
        return self.own + sum(value for _, _, value in self.parts)

    @property
    def accuracy(self) -> float:
        """Accuracy of corrections, SI units, by which a total may be below zero."""
        return max(
            CORRECTIONS.below_zero * self.own, CORRECTIONS.below_zero_of_typical * self.typical, 0.0
        )

    @property
    def is_impossible(self) -> bool:
        """Whether the total is below zero by more than the accuracy of corrections."""
        return self.value < -self.accuracy

    @property
    def in_weaker_direction(self) -> float:
        """The total in the direction of motion in which it is smaller, SI units."""
        return self.value - abs(sum(value for _, _, value in self.differences))


_ADDED = {"damping": "viscous friction", "inertia": "armature", "stiffness": "spring stiffness"}
"""Quantity of a parameter that is added to the model's value -> name of the total."""


_UNLIMITED = 1e8
"""Effort above which a drive has no limit, N*m or N."""


def own_values(problem: Problem) -> Mapping[str, FloatArray]:
    """(joints,) values of the nominal model at the joints, SI units.

    ``viscous``, ``friction``, ``armature`` and ``spring`` of the joint; ``stiffness``, ``damping``
    and ``effort_limit`` of its servo, the last one as a reciprocal. ``is_one`` is whether the servo
    is the same in all recordings.
    """
    known = problem.memory.own_values
    if not known:
        model, layout = problem.simulator.segments[0].model, problem.simulator.layout
        drives = problem.simulator.models.world(problem.all_segments)
        limit = np.minimum(drives.upper, -drives.lower)
        of_servo = {
            "stiffness": drives.stiffness,
            "damping": drives.damping,
            "effort_limit": np.where(limit < _UNLIMITED, 1.0 / np.maximum(limit, 1e-12), 0.0),
        }
        known |= {
            "viscous": model.dof_damping[layout.dof_index],
            "armature": model.dof_armature[layout.dof_index],
            "spring": model.jnt_stiffness[layout.joint_ids],
            "friction": model.dof_frictionloss[layout.dof_index],
            **{name: values[0] for name, values in of_servo.items()},
            "is_one": np.all([np.ptp(v, axis=0) == 0.0 for v in of_servo.values()], axis=0),
        }
    return known


def totals(problem: Problem, hypothesis: Hypothesis) -> list[Total]:
    """The total of every quantity that an effect of the hypothesis corrects."""
    own = {
        quantity: own_values(problem)[name]
        for quantity, name in (
            ("damping", "viscous"), ("inertia", "armature"), ("stiffness", "spring"),
            ("dry friction", "friction"),
        )
    }  # fmt: skip
    parts: dict[tuple[str, int], list[tuple[Term, int, float]]] = {}
    differences: dict[tuple[str, int], list[tuple[Term, int, float]]] = {}
    typical: dict[tuple[str, int], float] = {}
    for term in hypothesis.terms:
        at = hypothesis.slice_of(term).start
        for k, p in enumerate(term.parameters):
            quantity = _quantity(term, k, p)
            if quantity is not None and term.joint >= 0:
                value = float(hypothesis.theta[at + k]) * problem.scales.value(p, term.joint)
                parts.setdefault((quantity, term.joint), []).append((term, at + k, value))
                typical[quantity, term.joint] = problem.scales.value(p, term.joint)
                differences.setdefault((quantity, term.joint), []).extend(
                    (
                        term,
                        at + i,
                        float(hypothesis.theta[at + i]) * problem.scales.value(d, term.joint),
                    )
                    for i, d in enumerate(term.parameters)
                    if d.difference_of == p.name
                )
    return [
        Total(
            _ADDED.get(quantity, quantity),
            joint,
            float(own[quantity][joint]),
            tuple(found),
            typical[quantity, joint],
            tuple(differences[quantity, joint]),
        )
        for (quantity, joint), found in parts.items()
    ]


def _quantity(term: Term, k: int, parameter: Parameter) -> str | None:
    """Quantity to whose total a parameter belongs; None if there is none."""
    if k == term.dry_level:
        return "dry friction"
    if parameter.relation == "added" and parameter.quantity in _ADDED:
        return parameter.quantity
    return None


def impossible_effects(problem: Problem, hypothesis: Hypothesis) -> dict[Term, str]:
    """Effects with a negative correction of an impossible total, and the reason of each."""
    out: dict[Term, str] = {}
    for total in totals(problem, hypothesis):
        if total.is_impossible:
            why = f"the total {total.name} of the joint would be {total.value:.3g}, below zero"
            out.update({term: why for term, _, value in total.parts if value < 0.0})
        elif total.in_weaker_direction < -total.accuracy:
            why = (
                f"the total {total.name} of the joint would be {total.in_weaker_direction:.3g} in "
                "one direction, below zero"
            )
            out.update({term: why for term, _, _ in total.differences})
    return out


def without_negative_totals(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(parameters,) of a hypothesis, with negative totals set to zero.

    The largest negative correction of the total is changed.
    """
    theta = hypothesis.theta.copy()
    for total in totals(problem, hypothesis):
        if total.value < 0.0:
            _, at, value = min(total.parts, key=lambda part: part[2])
            theta[at] *= (value - total.value) / value
    return np.asarray(theta)
