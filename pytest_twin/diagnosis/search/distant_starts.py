"""Starts far from the model's own values, at all joints that need them.

Where a drive of the model would be at its limit along all of the measured motion, no slope says
anything about its gain. Effects state such starts themselves (``Effect.distant_starts``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue

_FAR, _LEFT = 10.0, 0.5
"""RMS error in noise floors above which a joint needs a distant start; largest share of its mean
squared error that may remain with this start."""


def distant(problem: Problem, bare: Hypothesis, whole: FloatArray) -> list[Hypothesis]:
    """Hypotheses with the distant starts that reduce the error.

    For each effect: its starts at all joints that need them, the same with the effects that are
    visible only there, and its start at each single joint.

    Args:
        problem: the problem.
        bare: the nominal hypothesis, without these effects.
        whole: (signals,) mean squared error of ``bare`` on the fit recordings.
    """
    joints = len(problem.joints)
    far = np.flatnonzero(whole[:joints] > (_FAR * problem.floor) ** 2)
    out: list[Hypothesis] = []
    for effect in catalogue():
        terms = [t for t in (Term(effect, int(j)) for j in far) if _starts(problem, t)]
        if terms:
            out += _of_effect(problem, bare, whole, terms)
    return out


def _starts(problem: Problem, term: Term) -> Sequence[tuple[float, ...]]:
    return term.law.distant_starts(str(problem.simulator.layout.servo[term.joint]))


def _of_effect(
    problem: Problem, bare: Hypothesis, whole: FloatArray, terms: Sequence[Term]
) -> list[Hypothesis]:
    """The distant starts of one effect at several joints."""
    sizes = [np.array(size) for size in _starts(problem, terms[0])]
    tried = [bare.with_terms(dict.fromkeys(terms, size)) for size in sizes]
    left = np.array([np.mean(r**2, axis=0) for r in problem.residuals(tried, problem.fit)])
    left = np.where(np.isfinite(left), left, np.inf)
    starts = {}
    for t in terms:
        best = int(np.argmin(left[:, t.joint]))
        # The farthest start is at the bound: an error that fits best there has another cause.
        if best < len(sizes) - 1 and left[best, t.joint] < _LEFT * whole[t.joint]:
            starts[t] = sizes[best]
    if not starts:
        return []
    alone = [bare.with_term(t, size) for t, size in starts.items()]
    together = bare.with_terms(starts)
    shown = [
        together.with_terms({Term(effect, t.joint): np.array(size) for t in starts})
        for effect, size in terms[0].law.hidden_until_distant().items()
    ]
    return [together, *shown, *(alone if len(alone) > 1 else [])]
