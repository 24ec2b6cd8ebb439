"""Effects that no stage fits, and that the recordings do not exclude either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.diagnosis.intervals import parameter_uncertainty
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.identification.simulation.stage_effects import SIMULATED, terms_of
from pytest_twin.identification.simulation.stage_fit import with_derivatives
from pytest_twin.identification.stages import StageName


def undetermined_terms(
    problem: Problem,
    found: Hypothesis,
    modes: Sequence[str],
    order: Sequence[StageName] = SIMULATED,
) -> dict[Term, StageName]:
    """Return the terms that may act unnoticed, with the stage that fits them.

    A term that no stage accepted is either absent or not shown by the motion. It is undetermined
    if the 95 % interval of its parameter, about the model's value and beside the accepted terms, is
    wider than the smallest value at which a fit of the effect starts.

    Args:
        problem: problem of the closed loop.
        found: accepted terms at their final parameters.
        modes: (joints,) command mode of each joint's drive.
        order: stages that were fitted.
    """
    absent = {
        term: stage for stage in order for term in terms_of(stage, modes) if not _is_in(term, found)
    }
    if not absent:
        return {}
    neutral = {t: np.array([p.absent_value for p in t.parameters]) for t in absent}
    whole = with_derivatives(problem, found.with_terms(neutral))
    undetermined: dict[Term, StageName] = {}
    for stage in dict.fromkeys(absent.values()):
        others = [t for t in absent if absent[t] != stage]
        kept = whole.hypothesis.without(*others)
        columns = whole.hypothesis.parameters_without(*others)
        part = replace(whole, hypothesis=kept, jacobian=whole.jacobian[..., columns])
        half = parameter_uncertainty(problem.at(part.hypothesis), part, in_parts=False).half_width
        for term in (t for t in absent if absent[t] == stage):
            own = kept.slice_of(term)
            switches = list(term.amplitude_indices(kept.theta[own]))
            if np.any(half[own][switches] > kept.sizes[own][switches]):
                undetermined[term] = stage
    return undetermined


def _is_in(term: Term, found: Hypothesis) -> bool:
    """Whether the term, or one that it is a special case of, is accepted."""
    return any(
        one.joint == term.joint and (one == term or term.effect in one.law.generalizes)
        for one in found.terms
    )
