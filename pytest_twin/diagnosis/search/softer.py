"""Servos that are far softer than the model's: where its drives would be at their limit all along.

A vendor's model may hold a joint fifty times as stiff as its firmware does. Along the measured
motion such a drive is at its limit throughout, no slope says anything of its gain, and to first
order nothing stands out. Simulated with drives that are softer by the decade it does.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem

_GAIN, _FRICTION = "controller_gain", "coulomb_friction"
# Shares of the model's stiffness that are tried; less far ones are found along the motion, and what
# would be softer still has another cause.
_SOFTNESS = (0.1, 0.05, 0.02, 0.01, 0.005)
# Dry friction that is tried, in multiples of its reference.
_DRY = 0.05
# Floors beyond which a joint is far off, and the share of its mismatch that a softer drive may
# leave.
_FAR, _LEFT = 10.0, 0.5


def softened(problem: Problem, bare: Hypothesis, whole: FloatArray) -> list[Hypothesis]:
    """Softer servos at all joints that need them, the same with dry friction, which a stiff servo
    does not show, and softer servos at each of the joints alone.

    Args:
        problem: what to explain.
        bare: without gains.
        whole: (signals,) mean square that it leaves of what is fitted.
    """
    joints = len(problem.joints)
    far = np.flatnonzero(whole[:joints] > (_FAR * problem.floor) ** 2)
    terms = [Term(_GAIN, int(j)) for j in far if problem.simulator.layout.servo[j] == "position"]
    if not terms:
        return []
    # As damped as before: damping goes with the root of the stiffness.
    sizes = [np.array([share - 1.0, np.sqrt(share) - 1.0]) for share in _SOFTNESS]
    tried = [bare.with_terms(dict.fromkeys(terms, size)) for size in sizes]
    left = np.array([np.mean(r**2, axis=0) for r in problem.residuals(tried, problem.fit)])
    left = np.where(np.isfinite(left), left, np.inf)
    starts = {}
    for t in terms:
        best = int(np.argmin(left[:, t.joint]))
        if best < len(sizes) - 1 and left[best, t.joint] < _LEFT * whole[t.joint]:
            starts[t] = sizes[best]
    if not starts:
        return []
    alone = [bare.with_term(t, size) for t, size in starts.items()]
    together = bare.with_terms(starts)
    rubbing = together.with_terms({Term(_FRICTION, t.joint): np.array([_DRY]) for t in starts})
    return [together, rubbing, *(alone if len(alone) > 1 else [])]
