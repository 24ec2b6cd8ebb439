"""Screen every effect at every joint by what it would change, before any rival is fitted.

One batch simulates each candidate at its starting size. How far a combination of these changes
explains the residual is then a small least-squares problem per candidate, in which the parameters
of effects that are already named may give way too.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.evidence import log_likelihood
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import FloatArray

# Laws with one period a turn say nothing of a slide.
_OF_A_TURN = frozenset({"cogging", "encoder_eccentricity", "position_dependent_friction"})


@dataclass(frozen=True, slots=True)
class Response:
    """What a candidate changes at one choice of its shape parameters.

    Attributes:
        term: the candidate.
        start: its parameters where the change was simulated, each switch on.
        switches: indices of the parameters that switch the effect on.
        change: (samples, signals, switches) prediction with one switch on minus without.
    """

    term: Term
    start: FloatArray
    switches: tuple[int, ...]
    change: FloatArray


@dataclass(frozen=True, slots=True)
class Screened:
    """A candidate with a start for its fit and the log-likelihood that it promises."""

    term: Term
    start: FloatArray
    gain: float


def candidates(problem: Problem) -> list[Term]:
    """Every effect where it can act."""
    servo = problem.simulator.servo
    found = []
    for effect in catalogue().values():
        if effect.id.startswith("effort_") and problem.effort_floor is None:
            continue
        if effect.family == "contact" and not problem.simulator.contact.has(effect.id):
            continue
        if effect.scope == "robot":
            found.append(Term(effect.id, -1))
            continue
        for j in range(len(problem.joints)):
            if effect.family in ("actuation", "timing") and servo[j] not in effect.modes:
                continue
            if effect.id == "joint_coupling" and j == 0:
                continue
            if effect.id in _OF_A_TURN and problem.simulator.slides[j]:
                continue
            found.append(Term(effect.id, j))
    return found


def responses(
    problem: Problem, terms: Sequence[Term], segments: NDArray[np.int64]
) -> list[Response]:
    """Simulate every candidate at its starting sizes, all in one batch."""
    rows: list[Hypothesis] = [EMPTY]
    plan: list[tuple[Term, FloatArray, tuple[int, ...]]] = []
    for term in terms:
        switches = tuple(i for i, p in enumerate(term.parameters) if p.neutral is not None)
        grids = [
            p.starts if p.neutral is None or len(switches) == 1 else p.starts[:1]
            for p in term.parameters
        ]
        for sizes in itertools.product(*grids):
            full = np.array(sizes)
            plan.append((term, full, switches))
            for s in switches:
                alone = full.copy()
                alone[[k for k in switches if k != s]] = 0.0
                rows.append(Hypothesis((term,), alone))
    found = problem.residuals(rows, segments)
    base, at, out = found[0], 1, []
    for term, start, switches in plan:
        change = np.stack([base - found[at + k] for k in range(len(switches))], axis=-1)
        at += len(switches)
        if np.isfinite(change).all():
            out.append(Response(term, start, switches, change.astype(np.float32)))
    return out


def screen(
    residual: FloatArray,
    jacobian: FloatArray,
    answers: Sequence[Response],
    floor: FloatArray,
    effective: FloatArray,
) -> list[Screened]:
    """Candidates by the log-likelihood that they promise, best first, one entry per term.

    Args:
        residual: (samples, signals) of the current hypothesis.
        jacobian: (samples, signals, parameters) of its prediction.
        answers: responses of the candidates.
        floor, effective: (signals,) as :func:`log_likelihood` takes them.
    """
    weight = 1.0 / np.sqrt(np.mean(residual**2, axis=0) + floor**2)
    b = (residual * weight).ravel()
    own = (jacobian * weight[:, None]).reshape(len(b), -1)
    own, _ = np.linalg.qr(own) if own.shape[1] else (own, None)
    b = b - own @ (own.T @ b)
    before = log_likelihood((b.reshape(residual.shape)) / weight, floor, effective)
    best: dict[Term, Screened] = {}
    for answer in answers:
        a = (answer.change * weight[:, None]).reshape(len(b), -1).astype(np.float64)
        a = a - own @ (own.T @ a)
        amplitude = _bounded_least_squares(a, b, answer)
        if not amplitude.any():
            continue
        left = (b - a @ amplitude).reshape(residual.shape) / weight
        gain = log_likelihood(left, floor, effective) - before
        start = answer.start.copy()
        start[list(answer.switches)] *= amplitude
        if answer.term not in best or gain > best[answer.term].gain:
            best[answer.term] = Screened(answer.term, start, gain)
    return sorted(best.values(), key=lambda s: -s.gain)


def _bounded_least_squares(a: FloatArray, b: FloatArray, answer: Response) -> FloatArray:
    """Amplitudes of the simulated changes; those that would leave their bounds stop there."""
    parameters = [answer.term.parameters[s] for s in answer.switches]
    sizes = answer.start[list(answer.switches)]
    ends = np.array([[p.lower, p.upper] for p in parameters]) / sizes[:, None]
    lower, upper = ends.min(axis=1), ends.max(axis=1)
    free = np.ones(len(sizes), dtype=bool)
    amplitude = np.zeros(len(sizes))
    for _ in range(len(sizes)):
        if not free.any():
            break
        rest = b - a @ np.where(free, 0.0, amplitude)
        normal = a[:, free].T @ a[:, free]
        normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
        amplitude[free] = np.linalg.solve(
            normal + 1e-300 * np.eye(len(normal)), a[:, free].T @ rest
        )
        outside = free & ((amplitude < lower) | (amplitude > upper))
        if not outside.any():
            break
        amplitude = np.clip(amplitude, lower, upper)
        free &= ~outside
    return amplitude
