"""How far windows under effort commands are trusted where joints stick, slip or turn around.

Dry friction yields a little before it slides, and damps as it does (Armstrong-Helouvry, Dupont,
Canudas de Wit, Automatica 30, 1994), and where a joint breaks loose depends on a few per cent of
its level. Neither is in any data sheet, and both are less than what the catalogue has names for. A
servo holds at bay what they change. Under effort commands they change the speed with which a joint
leaves a turn, and that stays for the rest of a window: by ten floors and more in a few windows,
while all others are followed to the noise. Such windows would earn names that none of the others
supports, and draw the parameters of those that are right.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.friction import CoulombFriction, PreslidingHysteresis

# Of the least distance at which yielding has a name, and of the level, what is open.
_DISTANCE, _LEVEL = 0.05, 0.05


def stiction_weights(problem: Problem) -> dict[int, FloatArray]:
    """Segment -> (joints,) weights of its positions, of mean square 1 at every joint.

    Presliding friction and a small change of the dry friction each change the predicted motion of
    a segment. The larger these changes are, in noise floors, the smaller is the weight of the
    segment. Empty if the model has no dry friction.
    """
    levels = _levels(problem)
    if not levels.any():
        return {}
    hypotheses = [EMPTY, _yielding(problem, levels)]
    hypotheses += [_with_more(problem, share * levels) for share in (_LEVEL, -_LEVEL)]
    as_it_is, yielding, more, less = problem.errors(hypotheses, problem.everywhere)
    leaps = more + less - 2.0 * as_it_is
    moved = np.hypot(_of_segments(problem, yielding - as_it_is), _of_segments(problem, leaps))
    weights = 1.0 / np.hypot(1.0, np.nan_to_num(moved))
    weights /= np.sqrt(np.mean(weights**2, axis=0))
    return dict(enumerate(weights))


def _of_segments(problem: Problem, change: FloatArray) -> FloatArray:
    """(segments, joints) root mean squares of (samples, signals), in noise floors."""
    ends = np.cumsum(problem.lengths(problem.everywhere))[:-1]
    floors = change[:, : len(problem.joints)] / problem.floor
    return np.array([np.sqrt(np.mean(part**2, axis=0)) for part in np.split(floors, ends)])


def _levels(problem: Problem) -> FloatArray:
    """(joints,) dry friction of the nominal model, N*m or N."""
    levels: FloatArray = problem.simulator.segments[0].model.dof_frictionloss[
        problem.simulator.layout.dof_index
    ]
    return levels


def _yielding(problem: Problem, levels: FloatArray) -> Hypothesis:
    """All dry friction by bristles."""
    found = _with_more(problem, -levels)
    for joint in np.flatnonzero(levels):
        term = Term(PreslidingHysteresis.id, int(joint))
        level, distance = term.parameters
        size = levels[joint] / problem.scales.value(level, int(joint))
        found = found.with_term(term, np.array([size, _DISTANCE * distance.lower]))
    return found


def _with_more(problem: Problem, levels: FloatArray) -> Hypothesis:
    """Dry friction of so much more at each of the joints."""
    found = EMPTY
    for joint in np.flatnonzero(levels):
        term = Term(CoulombFriction.id, int(joint))
        size = levels[joint] / problem.scales.value(term.parameters[0], int(joint))
        found = found.with_term(term, np.array([size]))
    return found
