"""Choose the structure: which effects earn their place.

Forward: the best-screened candidates are fitted side by side, together with what is already
named, and judged by evidence: log-likelihood on the fit recordings less half a log of the effective
samples for each parameter (Schwarz 1978), plus log-likelihood on recordings that no fit has seen.
Then backward: a term that no longer pays is dropped. Then sideways: each term is held against the
rivals that could stand in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.diagnosis.evidence import effective_samples, log_likelihood
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.screen import Response, candidates, responses, screen
from pytest_twin.effects.base import FloatArray

_SHORTLIST = 10
_MAX_TERMS = 10
_QUICK, _LONG = 3, 8
_ROUGH_ROUNDS = 2
# Gains of evidence below this are chance: about 1 in e^5 for a rival drawn from many.
_EARNS = 5.0
# A name must take away this share of what still stands above the floor at some joint, and this
# share of what the nominal model left there: less is the simulator's own imperfection.
_SHARE_OF_REST = 0.1
_SHARE_OF_ALL = 0.003
# Within this factor of the floor's square, nothing is left to explain.
_AT_FLOOR = 1.2


@dataclass(slots=True)
class Rival:
    """A fitted hypothesis and what speaks for it.

    Attributes:
        fitted: on the fit segments.
        held_residual: (samples, signals) on the held-out segments.
        evidence: higher is better; comparable within one round.
    """

    fitted: Fitted
    held_residual: FloatArray
    evidence: float = 0.0
    held_gain: float = 0.0

    @property
    def hypothesis(self) -> Hypothesis:
        """With its fitted parameters."""
        return self.fitted.hypothesis


@dataclass(slots=True)
class Selected:
    """What was chosen, and what stood against it.

    Attributes:
        best: the chosen rival.
        nominal: the model as it came.
        confidence: term -> share of the evidence against the rivals in its place.
        alternatives: term -> rivals in its place with their share, best first.
        answers: responses of all candidates, for a look at what is left.
    """

    best: Rival
    nominal: Rival
    confidence: dict[Term, float] = field(default_factory=dict)
    alternatives: dict[Term, list[tuple[Term, float]]] = field(default_factory=dict)
    answers: list[Response] = field(default_factory=list)


class Selection:
    """One search over structures."""

    def __init__(self, problem: Problem, say: Callable[[str], None] = lambda text: None) -> None:
        self.problem = problem
        self.say = say
        self.has_held = bool(len(problem.held_out))

    def run(self) -> Selected:
        """Search forward, backward and sideways."""
        problem = self.problem
        nominal = self._rivals([EMPTY], np.ones(len(problem.signal_floor)), 0)[0]
        terms = candidates(problem)
        answers = responses(problem, terms, problem.fit)
        best = nominal
        while len(best.hypothesis.terms) < _MAX_TERMS and not self._at_floor(best):
            better = self._forward(best, answers, nominal)
            if better is None:
                break
            best = self._backward(better)
        selected = Selected(best, nominal, answers=answers)
        for _ in range(2):
            if not self._sideways(selected):
                break
        return selected

    # -- evidence

    def _weights(self, rival: Rival) -> FloatArray:
        mean_square = np.mean(rival.fitted.residual**2, axis=0)
        weights: FloatArray = 1.0 / np.sqrt(mean_square + self.problem.signal_floor**2)
        return weights

    def _rivals(
        self, starts: Sequence[Hypothesis], weights: FloatArray, iterations: int
    ) -> list[Rival]:
        problem = self.problem
        fitted = fit(problem, starts, weights, problem.fit, iterations=iterations)
        if self.has_held:
            held = problem.residuals([f.hypothesis for f in fitted], problem.held_out)
        else:
            held = [np.zeros((0, len(problem.signal_floor)))] * len(fitted)
        return [Rival(f, h) for f, h in zip(fitted, held, strict=True)]

    def _judge(self, rivals: Sequence[Rival], against: Rival) -> None:
        """Evidence of ``rivals`` over ``against``, by the effective samples of ``against``."""
        problem, floor = self.problem, self.problem.signal_floor
        fit_n = effective_samples(against.fitted.residual, problem.lengths(problem.fit))
        base = log_likelihood(against.fitted.residual, floor, fit_n)
        price = 0.5 * np.log(max(float(fit_n.mean()), 2.0))
        if self.has_held:
            held_n = effective_samples(against.held_residual, problem.lengths(problem.held_out))
            held_base = log_likelihood(against.held_residual, floor, held_n)
        for r in rivals:
            more = r.hypothesis.theta.size - against.hypothesis.theta.size
            r.evidence = log_likelihood(r.fitted.residual, floor, fit_n) - base - price * more
            if self.has_held:
                r.held_gain = log_likelihood(r.held_residual, floor, held_n) - held_base
                r.evidence += r.held_gain

    # -- moves

    def _unseen(self, rival: Rival) -> FloatArray:
        """(signals,) mean square on what no fit has seen, where there is such a thing."""
        residual = rival.held_residual if self.has_held else rival.fitted.residual
        mean_square: FloatArray = np.mean(residual**2, axis=0)
        return mean_square

    def _at_floor(self, rival: Rival) -> bool:
        floor = self.problem.signal_floor**2
        fit = np.mean(rival.fitted.residual**2, axis=0)
        return bool((np.maximum(self._unseen(rival), fit) <= _AT_FLOOR * floor).all())

    def _worth_a_name(self, rival: Rival, best: Rival, nominal: Rival) -> bool:
        floor = self.problem.signal_floor**2
        before = self._unseen(best)
        gone = before - self._unseen(rival)
        rest = np.maximum(before - floor, 0.2 * floor)
        whole = np.maximum(self._unseen(nominal) - floor, 0.2 * floor)
        return bool(((gone >= _SHARE_OF_REST * rest) & (gone >= _SHARE_OF_ALL * whole)).any())

    def _forward(self, best: Rival, answers: Sequence[Response], nominal: Rival) -> Rival | None:
        problem, floor = self.problem, self.problem.signal_floor
        effective = effective_samples(best.fitted.residual, problem.lengths(problem.fit))
        price = 0.5 * np.log(max(float(effective.mean()), 2.0))
        named = set(best.hypothesis.terms)
        found = [
            s
            for s in screen(best.fitted.residual, best.fitted.jacobian, answers, floor, effective)
            if s.term not in named and s.gain > price
        ][:_SHORTLIST]
        if not found:
            return None
        starts = [best.hypothesis.with_term(s.term, s.start) for s in found]
        rivals = self._rivals(starts, self._weights(best), _QUICK)
        self._judge(rivals, best)
        rivals.sort(key=lambda r: -r.evidence)
        for r in rivals[:5]:
            t = r.hypothesis.terms[-1]
            self.say(f"  {t.effect} {t.joint} evidence {r.evidence:.1f} held {r.held_gain:.1f}")
        earning = [
            r for r in rivals if r.evidence >= _EARNS and (r.held_gain > 0.0 or not self.has_held)
        ]
        if not earning:
            return None
        top = self._settled(earning[0])
        self.say(f"+ {top.hypothesis.terms[-1]} evidence {earning[0].evidence:.1f}")
        return top

    def _settled(self, rival: Rival) -> Rival:
        """The rival fitted to the end, with the simulator's step corrected where it now stands."""
        # Where impacts fall between steps depends on the parameters themselves.
        for _ in range(_ROUGH_ROUNDS if rival.hypothesis.rough else 1):
            self.problem.refine_at(rival.hypothesis)
            rival = self._rivals([rival.hypothesis], self._weights(rival), _LONG)[0]
        return rival

    def _backward(self, best: Rival) -> Rival:
        while len(best.hypothesis.terms) > 1:
            starts = [best.hypothesis.without(t) for t in best.hypothesis.terms]
            rivals = self._rivals(starts, self._weights(best), _QUICK)
            self._judge(rivals, best)
            top = max(rivals, key=lambda r: r.evidence)
            if top.evidence < -_EARNS / 2:
                break
            gone = set(best.hypothesis.terms) - set(top.hypothesis.terms)
            self.say(f"- {gone} evidence {top.evidence:.1f}")
            best = top
        return best

    def _sideways(self, selected: Selected) -> bool:
        """Hold every term against the rivals in its place; True if one was better."""
        best, problem = selected.best, self.problem
        floor = problem.signal_floor
        selected.confidence.clear()
        selected.alternatives.clear()
        if not best.hypothesis.terms:
            return False
        starts: list[Hypothesis] = []
        replaced: list[tuple[Term, Term]] = []
        named = set(best.hypothesis.terms)
        without = [best.hypothesis.without(t) for t in best.hypothesis.terms]
        bare = self._rivals(without, self._weights(best), _QUICK)
        for term, rest in zip(best.hypothesis.terms, bare, strict=True):
            effective = effective_samples(rest.fitted.residual, problem.lengths(problem.fit))
            ranked = screen(rest.fitted.residual, rest.fitted.jacobian, selected.answers, floor,
                            effective)  # fmt: skip
            for s in [s for s in ranked if s.term not in named][:4]:
                starts.append(rest.hypothesis.with_term(s.term, s.start))
                replaced.append((term, s.term))
        rivals = self._rivals(starts, self._weights(best), _QUICK + 1)
        self._judge(rivals, best)
        self._judge(bare, best)
        for term, rest in zip(best.hypothesis.terms, bare, strict=True):
            mine = [(new, r) for (old, new), r in zip(replaced, rivals, strict=True) if old == term]
            evidence = np.array([0.0, rest.evidence, *(r.evidence for _, r in mine)])
            share = np.exp(np.clip(evidence - evidence.max(), -700.0, 0.0))
            share /= share.sum()
            selected.confidence[term] = float(share[0])
            others = sorted(zip((n for n, _ in mine), share[2:], strict=True), key=lambda x: -x[1])
            selected.alternatives[term] = [(n, float(s)) for n, s in others]
        if rivals:
            top = max(rivals, key=lambda r: r.evidence)
            if top.evidence > 1.0:
                self.say(f"~ {top.hypothesis.terms} evidence {top.evidence:.1f}")
                selected.best = self._backward(self._settled(top))
                return True
        return False
