"""Which effects, at which joints, alone and together, could explain a residual: to first order.

Forces add, and so do their first-order responses: a structure of several effects is a least-squares
problem of its own, in which the parameters of effects that are already named may give way too.
Structures are searched breadth first over a few best at each size, so that a name which only
covers two others together does not end the search.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.diagnosis.evidence import effective_samples, log_likelihood
from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.responses import Response
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import FloatArray

# Laws with one period a turn say nothing of a slide.
_OF_A_TURN = frozenset({"cogging", "encoder_eccentricity", "position_dependent_friction"})


@dataclass(frozen=True, slots=True)
class Screened:
    """A candidate with a start for its fit, and the log-likelihood that it promises."""

    term: Term
    start: FloatArray
    gain: float
    answer: Response | None = None


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


@dataclass(slots=True)
class View:
    """A residual and what may give way to explain it, averaged over bins.

    Attributes:
        residual: (bins, signals) of the best hypothesis.
        jacobian: (bins, signals, parameters) of its prediction.
        floor: (signals,) deviation of what no model can explain.
        lengths: bins of each segment.
    """

    residual: FloatArray
    jacobian: FloatArray
    floor: FloatArray
    lengths: Sequence[int]

    @property
    def effective(self) -> FloatArray:
        """(signals,) how many independent samples the residual is worth."""
        return effective_samples(self.residual, self.lengths)


@dataclass(slots=True)
class Structure:
    """Terms that together explain a residual to first order.

    Attributes:
        starts: term -> parameters, in multiples of their scales, in the order of naming.
        residual: (bins, signals) what they leave.
        evidence: over the structure without them; comparable among structures of one search.
        columns: (bins, signals, switches) of every term.
    """

    starts: dict[Term, FloatArray]
    residual: FloatArray
    evidence: float = 0.0
    columns: dict[Term, Response] = field(default_factory=dict)

    @property
    def parameters(self) -> int:
        """How many numbers it takes."""
        return sum(len(s) for s in self.starts.values())


def price(effective: FloatArray) -> float:
    """Log-likelihood that one more parameter has to earn (Schwarz 1978)."""
    return float(0.5 * np.log(max(float(effective.mean()), 2.0)))


def screen(view: View, answers: Sequence[Response]) -> list[Screened]:
    """Candidates by the log-likelihood that they promise less their price, best first.

    One entry per term, at the best of its starting shapes.
    """
    floor, effective = view.floor, view.effective
    cost = price(effective)
    weight = (1.0 / np.sqrt(np.mean(view.residual**2, axis=0) + floor**2)).astype(np.float32)
    b = (view.residual * weight).ravel().astype(np.float32)
    own = (view.jacobian * weight[:, None]).reshape(len(b), -1).astype(np.float32)
    if own.shape[1]:
        own, _ = np.linalg.qr(own)
        b = b - own @ (own.T @ b)
    before = log_likelihood(b.reshape(view.residual.shape) / weight, floor, effective)
    best: dict[Term, Screened] = {}
    for answer in answers:
        a = (answer.change * weight[:, None]).reshape(len(b), -1)
        if own.shape[1]:
            a = a - own @ (own.T @ a)
        amplitude = _bounded_least_squares(a, b, answer)
        if not amplitude.any():
            continue
        left = (b - a @ amplitude).reshape(view.residual.shape) / weight
        gain = log_likelihood(left, floor, effective) - before - cost * len(answer.start)
        if answer.term not in best or gain > best[answer.term].gain:
            start = answer.start.copy()
            start[list(answer.switches)] *= amplitude
            best[answer.term] = Screened(answer.term, start, gain, answer)
    return sorted(best.values(), key=lambda s: -s.gain)


def search(
    view: View, answers: Sequence[Response], *, width: int, most: int, earns: float,
    worth: Callable[[FloatArray, FloatArray], bool],
) -> list[list[Structure]]:  # fmt: skip
    """Structures of one, two, ... terms that explain a residual, best first at each size.

    Args:
        view: what has to be explained.
        answers: responses of the candidates.
        width: structures kept at each size.
        most: terms at most.
        earns: evidence that a larger structure must gain.
        worth: whether (signals,) mean squares ``after`` are worth one more name than ``before``.
    """
    level = [Structure({}, view.residual)]
    found: list[list[Structure]] = []
    for _ in range(most):
        grown: dict[frozenset[Term], Structure] = {}
        for parent in level:
            for child in _children(view, parent, answers, width):
                key = frozenset(child.starts)
                if key not in grown or child.evidence > grown[key].evidence:
                    grown[key] = child
        if not grown:
            break
        children = _compared(view, level[0], list(grown.values()))
        before = np.mean(level[0].residual ** 2, axis=0)
        kept = [
            c for c in children[:width]
            if c.evidence >= earns and worth(before, np.mean(c.residual**2, axis=0))
        ]  # fmt: skip
        if not kept:
            break
        found.append(kept)
        level = kept
    return found


def _compared(view: View, parent: Structure, children: list[Structure]) -> list[Structure]:
    """Children by their evidence over the best parent, under the best child's effective samples."""

    def misfit(s: Structure) -> float:
        return float(np.log(np.maximum(np.mean(s.residual**2, axis=0), view.floor**2)).sum())

    best = min(children, key=misfit)
    effective = effective_samples(best.residual, view.lengths)
    cost = price(effective)
    base = log_likelihood(parent.residual, view.floor, effective) - cost * parent.parameters
    for c in children:
        own = log_likelihood(c.residual, view.floor, effective)
        c.evidence = own - cost * c.parameters - base
    return sorted(children, key=lambda c: -c.evidence)


def _children(
    view: View, parent: Structure, answers: Sequence[Response], width: int
) -> list[Structure]:
    """The parent with one more term, the most promising ones, all amplitudes fitted together."""
    mine = [r.change for r in parent.columns.values()]
    jacobian = np.concatenate([view.jacobian, *mine], axis=-1) if mine else view.jacobian
    inner = View(parent.residual, jacobian, view.floor, view.lengths)
    free = [a for a in answers if a.term not in parent.starts]
    return [joined(view, s, parent) for s in screen(inner, free)[: 2 * width]]


def joined(view: View, more: Screened, parent: Structure | None = None) -> Structure:
    """A structure with one more term, all amplitudes fitted together."""
    assert more.answer is not None
    parent = Structure({}, view.residual) if parent is None else parent
    chosen = {**parent.columns, more.term: more.answer}
    starts = {**parent.starts, more.term: more.start}
    amplitude, residual = _fitted(view, [r.change for r in chosen.values()], parent.residual)
    at = view.jacobian.shape[2]
    for term, response in chosen.items():
        switches = list(response.switches)
        start = response.start.copy()
        start[switches] *= amplitude[at : at + len(switches)]
        at += len(switches)
        lower = np.array([p.lower for p in term.parameters])
        upper = np.array([p.upper for p in term.parameters])
        starts[term] = np.clip(start, lower, upper)
    return Structure(starts, residual, more.gain, chosen)


def refitted(view: View) -> Structure:
    """What stands when only what is named already gives way."""
    return Structure({}, _fitted(view, [], view.residual)[1])


def _fitted(
    view: View, changes: Sequence[FloatArray], current: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Amplitudes of named parameters and ``changes``, and the (bins, signals) residual."""
    columns = np.concatenate([view.jacobian, *changes], axis=-1)
    amplitude = np.zeros(columns.shape[2])
    if not amplitude.size:
        return amplitude, view.residual
    for _ in range(2):
        # Again under the weights of what is left: what is explained must not drown the rest.
        weight = 1.0 / np.sqrt(np.mean(current**2, axis=0) + view.floor**2)
        a = (columns * weight[:, None]).reshape(view.residual.size, -1)
        b = (view.residual * weight).ravel()
        amplitude = _ridge(a, b)
        left: FloatArray = (b - a @ amplitude).reshape(view.residual.shape)
        current = left / weight
    return amplitude, current


def _ridge(a: FloatArray, b: FloatArray) -> FloatArray:
    normal = a.T @ a
    ridge = 1e-9 * max(float(np.trace(normal)), 1e-300) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal + ridge, a.T @ b), dtype=np.float64)


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
        ridge = max(1e-7 * float(np.trace(normal)), 1e-30) * np.eye(len(normal))
        amplitude[free] = np.linalg.solve(normal + ridge, a[:, free].T @ rest)
        outside = free & ((amplitude < lower) | (amplitude > upper))
        if not outside.any():
            break
        amplitude = np.clip(amplitude, lower, upper)
        free &= ~outside
    return amplitude
