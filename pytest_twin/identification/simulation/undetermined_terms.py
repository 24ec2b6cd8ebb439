"""Effects that every robot has, and that an identification has not found.

Each is as in the model, or the motion does not show it. What the motion does not show may also hide
in the parameters that were found: only the sum of a joint's friction and its servo's damping moves
it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import ParameterUncertainty, parameter_uncertainty
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.simulation.stage_effects import StagePlan
from pytest_twin.identification.simulation.stage_tests import with_derivatives
from pytest_twin.identification.stages import StageName
from pytest_twin.metrics.joint_covariance import upper_covariance, with_deviations

_COLUMNS_DIFFER = 0.01
"""Share of a derivative by which two of them must differ. They are differences of simulations,
whose integration error changes with the parameter: that of the damping of a joint and of its servo
differ by 0.3 % with a time step of 5 ms, and by 0.1 % with 1 ms."""


@dataclass(frozen=True)
class AbsentEffects:
    """Basic effects of the stages that a fit lacks, and the derivatives of the motion by them.

    Attributes:
        problem: problem of the fit.
        found: the fit.
        stage_of: absent effect -> stage that fits it.
        given: those of them that the search had fitted together with all others.
        whole: the fit and the absent effects, at their absence, with derivatives.
    """

    problem: Problem
    found: Hypothesis
    stage_of: dict[Term, StageName]
    given: frozenset[Term]
    whole: FittedModel

    @classmethod
    def of(cls, problem: Problem, found: Hypothesis, plan: StagePlan) -> AbsentEffects:
        """Return the absent effects of a fit.

        Args:
            problem: problem of the closed loop.
            found: effects at their final parameters.
            plan: stages that were fitted.
        """
        modes = plan.modes_of(problem)
        stage_of = {
            term: stage
            for stage in plan.order
            for term in plan.terms_of(stage, modes)
            if not _is_in(term, found)
        }
        neutral = {t: np.array([p.absent_value for p in t.parameters]) for t in stage_of}
        whole = with_derivatives(problem, found.with_terms(neutral))
        given = frozenset(t for t in stage_of if t.effect in plan.mask.given)
        return cls(problem, found, stage_of, given, whole)

    def undetermined(self) -> dict[Term, StageName]:
        """Return the effects that may act unnoticed, with the stage that fits them.

        An effect is undetermined if the 95 % interval of its parameter, about its absence and
        beside the effects that were found, is wider than the smallest value at which a fit of the
        effect starts.
        """
        undetermined: dict[Term, StageName] = {}
        for stage in dict.fromkeys(self.stage_of.values()):
            absent = [t for t in self.stage_of if self.stage_of[t] == stage]
            part = self._with(absent)
            kept = part.hypothesis
            half = self._uncertainty(part, in_parts=False).half_width
            for term in absent:
                own = kept.slice_of(term)
                switches = list(term.amplitude_indices(kept.theta[own]))
                if np.any(half[own][switches] > kept.sizes[own][switches]):
                    undetermined[term] = stage
        return undetermined

    def widened(self, known: ParameterUncertainty) -> ParameterUncertainty:
        """Return the uncertainty of the fit with what absent friction and gains could take of it.

        Args:
            known: uncertainty of the fit without them.
        """
        if not self.given or not self.found.terms:
            return known
        part = self._with([t for t in self.stage_of if t in self.given])
        own = slice(0, self.found.theta.size)
        whole = self._uncertainty(part)
        half = np.maximum(known.half_width, whole.half_width[own])
        half = np.maximum(half, _hidden_amounts(part, own.stop))
        together = upper_covariance(
            known.conservative_covariance, whole.conservative_covariance[own, own]
        )
        return replace(
            known, half_width=half, conservative_covariance=with_deviations(together, half / Z95)
        )

    def _with(self, absent: list[Term]) -> FittedModel:
        """Return the fit with some of the absent effects."""
        others = [t for t in self.stage_of if t not in absent]
        columns = self.whole.hypothesis.parameters_without(*others)
        return replace(
            self.whole,
            hypothesis=self.whole.hypothesis.without(*others),
            jacobian=self.whole.jacobian[..., columns],
        )

    def _uncertainty(self, part: FittedModel, *, in_parts: bool = True) -> ParameterUncertainty:
        return parameter_uncertainty(self.problem.at(self.found), part, in_parts=in_parts)


def _hidden_amounts(part: FittedModel, found: int) -> FloatArray:
    """(found,) largest change of each found parameter that absent effects hide.

    An absent effect whose derivative is proportional to that of a found parameter may have any
    value that it can have.

    Args:
        part: found parameters, then absent ones, with derivatives.
        found: number of parameters that were found.
    """
    columns = part.jacobian.reshape(-1, part.jacobian.shape[-1])
    largest = np.abs(part.hypothesis.bounds).max(axis=0)
    hidden = np.zeros(found)
    for known in range(found):
        square = float(columns[:, known] @ columns[:, known])
        for absent in range(found, columns.shape[1]) if square else ():
            share = float(columns[:, known] @ columns[:, absent]) / square
            rest = np.linalg.norm(columns[:, absent] - share * columns[:, known])
            if rest < _COLUMNS_DIFFER * np.linalg.norm(columns[:, absent]):
                hidden[known] = max(hidden[known], abs(share) * largest[absent])
    return hidden


def _is_in(term: Term, found: Hypothesis) -> bool:
    """Whether the term, or a law of its family that it is a special case of, is in a fit.

    The damping of a servo generalizes viscous friction, but is another part of the robot.
    """
    return term in found.terms or any(
        one.joint == term.joint
        and term.effect in one.law.generalizes
        and term.law.family == one.law.family
        for one in found.terms
    )
