"""Weights of windows under effort commands in which joints stick, slip or reverse.

Before sliding, dry friction yields a little and damps (presliding; Armstrong-Helouvry, Dupont,
Canudas de Wit, Automatica 30, 1994). The time at which a joint breaks away depends on a few per
cent of the friction level. No data sheet contains these quantities, and they are smaller than any
effect of the catalogue. A servo corrects their influence. Under effort commands they change the
velocity after a reversal, and this error remains for the rest of the window. A few windows then
have errors of ten noise floors or more, while all others are at the noise. Without weights, such
windows would support wrong effects and bias the parameters of the right ones.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.window_settings import WINDOWS
from pytest_twin.effects.friction import CoulombFriction, PreslidingHysteresis
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term


def stiction_weights(problem: Problem) -> dict[int, FloatArray]:
    """Segment -> (joints,) weights of its positions, of mean square 1 at every joint.

    Presliding friction and a small change of the dry friction each change the predicted motion of
    a segment. The larger these changes are, in noise floors, the smaller is the weight of the
    segment. Empty if the model has no dry friction.
    """
    levels = _levels(problem)
    if not levels.any():
        return {}
    hypotheses = [EMPTY, _with_presliding(problem, levels)]
    hypotheses += [
        _with_added_friction(problem, share * levels)
        for share in (WINDOWS.stiction_level, -WINDOWS.stiction_level)
    ]
    nominal, yielding, more, less = problem.errors(hypotheses, problem.all_segments)
    second_difference = more + less - 2.0 * nominal
    change = np.hypot(
        _segment_rms(problem, yielding - nominal), _segment_rms(problem, second_difference)
    )
    weights = 1.0 / np.hypot(1.0, np.nan_to_num(change))
    weights /= np.sqrt(np.mean(weights**2, axis=0))
    return dict(enumerate(weights))


def _segment_rms(problem: Problem, change: FloatArray) -> FloatArray:
    """(segments, joints) root mean squares of (samples, signals), in noise floors."""
    ends = np.cumsum(problem.lengths(problem.all_segments))[:-1]
    floors = change[:, : len(problem.joints)] / problem.floor
    return np.array([np.sqrt(np.mean(part**2, axis=0)) for part in np.split(floors, ends)])


def _levels(problem: Problem) -> FloatArray:
    """(joints,) dry friction of the nominal model, N*m or N."""
    levels: FloatArray = problem.simulator.segments[0].model.dof_frictionloss[
        problem.simulator.layout.dof_index
    ]
    return levels


def _with_presliding(problem: Problem, levels: FloatArray) -> Hypothesis:
    """The hypothesis with presliding friction over a short distance for all dry friction."""
    found = _with_added_friction(problem, -levels)
    for joint in np.flatnonzero(levels):
        term = Term(PreslidingHysteresis.id, int(joint))
        level, distance = term.parameters
        size = levels[joint] / problem.scales.value(level, int(joint))
        found = found.with_term(term, np.array([size, WINDOWS.stiction_distance * distance.lower]))
    return found


def _with_added_friction(problem: Problem, levels: FloatArray) -> Hypothesis:
    """The hypothesis with ``levels`` (joints,) of additional dry friction, N*m or N."""
    found = EMPTY
    for joint in np.flatnonzero(levels):
        term = Term(CoulombFriction.id, int(joint))
        size = levels[joint] / problem.scales.value(term.parameters[0], int(joint))
        found = found.with_term(term, np.array([size]))
    return found
