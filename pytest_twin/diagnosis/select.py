"""Choose the structure: which effects earn their place.

Forward: structures of one and more effects are searched to first order around the best fit so far
(:mod:`screen`); the best of each size are fitted by simulation, side by side, and judged by
evidence: log-likelihood on the fit recordings less half a log of the effective samples for each
parameter (Schwarz 1978), plus log-likelihood on recordings that no fit has seen. Then backward: a
term that no longer pays is dropped. Then sideways: each term is held against the rivals that could
stand in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.diagnosis.evidence import effective_samples, log_likelihood
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.responses import Response, bins, responses
from pytest_twin.diagnosis.screen import Answers, Lens, Search, Structure, View, candidates, price
from pytest_twin.effects.base import FloatArray

_MAX_TERMS = 10
_ROUNDS = 6
# Structures kept at each size, terms added at once, structures of the largest size that are fitted,
# rivals looked at in a term's place.
_WIDTH, _AT_ONCE, _FITTED, _RIVALS = 10, 4, 4, 6
# Evidence to first order beyond which no simulation would change the verdict.
_CLEAR = 30.0
_QUICK, _LONG = 2, 8
# Rivals that stay in the race after one iteration: evidence behind the first, and how many.
_IN_FRONT, _FRONT = 150.0, 3
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
        tried: effects at joints that competed.
    """

    best: Rival
    nominal: Rival
    confidence: dict[Term, float] = field(default_factory=dict)
    alternatives: dict[Term, list[tuple[Term, float]]] = field(default_factory=dict)
    tried: int = 0


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
        self.nominal = nominal
        best = nominal
        for _ in range(_ROUNDS):
            if len(best.hypothesis.terms) >= _MAX_TERMS or self._at_floor(best):
                break
            better = self._forward(best)
            if better is None:
                break
            best = self._backward(better)
        selected = Selected(best, nominal, tried=len(candidates(problem)))
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
        self,
        starts: Sequence[Hypothesis],
        weights: FloatArray,
        iterations: int,
        *,
        slopes: bool = False,
    ) -> list[Rival]:
        problem = self.problem
        fitted = fit(problem, starts, weights, problem.fit, iterations=iterations, slopes=slopes)
        if self.has_held:
            held = problem.residuals([f.hypothesis for f in fitted], problem.held_out)
        else:
            held = [np.zeros((0, len(problem.signal_floor)))] * len(fitted)
        return [Rival(f, h) for f, h in zip(fitted, held, strict=True)]

    def _judge(self, rivals: Sequence[Rival], against: Rival, under: Rival | None = None) -> None:
        """Evidence of ``rivals`` over ``against``, by the effective samples of ``under``."""
        problem, floor = self.problem, self.problem.signal_floor
        under = against if under is None else under
        fit_n = effective_samples(under.fitted.residual, problem.lengths(problem.fit))
        base = log_likelihood(against.fitted.residual, floor, fit_n)
        cost = price(fit_n)
        if self.has_held:
            held_n = effective_samples(under.held_residual, problem.lengths(problem.held_out))
            held_base = log_likelihood(against.held_residual, floor, held_n)
        for r in rivals:
            more = r.hypothesis.theta.size - against.hypothesis.theta.size
            r.evidence = log_likelihood(r.fitted.residual, floor, fit_n) - base - cost * more
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

    def _worth_a_name(self, before: FloatArray, after: FloatArray, whole: FloatArray) -> bool:
        """Whether mean squares (signals,) fall by enough; ``whole`` of the model as it came."""
        floor = self.problem.signal_floor**2
        gone = before - after
        rest = np.maximum(before - floor, 0.2 * floor)
        all_of_it = np.maximum(whole - floor, 0.2 * floor)
        return bool(((gone >= _SHARE_OF_REST * rest) & (gone >= _SHARE_OF_ALL * all_of_it)).any())

    def _look(self, best: Rival) -> tuple[View, list[Response]]:
        """What is left to first order around a fit, and what every candidate would do to it."""
        problem = self.problem
        named = set(best.hypothesis.terms)
        terms = [t for t in candidates(problem) if t not in named]
        residual = best.fitted.residual
        answers, left = responses(problem, terms, problem.fit, best.hypothesis, residual)
        binned = bins(problem, problem.fit)
        view = View(
            left, binned.mean(best.fitted.jacobian), problem.signal_floor,
            binned.lengths,
        )  # fmt: skip
        return view, answers

    def _forward(self, best: Rival) -> Rival | None:
        view, answers = self._look(best)
        whole = np.mean(self.nominal.fitted.residual**2, axis=0)
        lens = Lens(view, Answers(answers))
        levels = Search(
            _WIDTH, _AT_ONCE, _EARNS,
            lambda before, after: self._worth_a_name(before, after, whole),
        ).levels(lens)  # fmt: skip
        if not levels:
            return None
        chosen = levels[-1][:_FITTED]
        for level in levels[:-1]:
            chosen += level[:2]
        for structure in chosen:
            self.say(f"  linear {_text(structure.starts)} evidence {structure.evidence:.1f}")
        starts = []
        for structure in chosen:
            h = best.hypothesis
            for term, start in structure.starts.items():
                h = h.with_term(term, start)
            starts.append(h)
        # What the step costs differs between the model as it came and what explains the rest.
        self.problem.refine_at(starts[0])
        left = np.mean(levels[-1][0].residual ** 2, axis=0)
        rivals = self._heats(starts, 1.0 / np.sqrt(left + view.floor**2), best)
        before, unseen = self._unseen(best), self._unseen(self.nominal)
        for r in rivals:
            self.say(f"  {r.hypothesis.terms} evidence {r.evidence:.1f} held {r.held_gain:.1f}")
        for r in rivals:
            if r.evidence < _EARNS or (self.has_held and r.held_gain <= 0.0):
                continue
            if self._worth_a_name(before, self._unseen(r), unseen):
                self.say(f"+ {r.hypothesis.terms} evidence {r.evidence:.1f}")
                return self._settled(r)
        self.problem.refine_at(best.hypothesis)
        return None

    def _heats(self, starts: Sequence[Hypothesis], weights: FloatArray, best: Rival) -> list[Rival]:
        """Rivals by evidence over ``best``: all after one iteration, those in front after more."""
        rivals = self._rivals(starts, weights, 1)
        self._judge(rivals, best, min(rivals, key=lambda r: r.fitted.cost))
        rivals.sort(key=lambda r: -r.evidence)
        front = [r for r in rivals if r.evidence > rivals[0].evidence - _IN_FRONT][:_FRONT]
        again = self._rivals([r.hypothesis for r in front], weights, _QUICK)
        rivals[: len(front)] = again
        self._judge(rivals, best, min(rivals, key=lambda r: r.fitted.cost))
        return sorted(rivals, key=lambda r: -r.evidence)

    def _settled(self, rival: Rival) -> Rival:
        """The rival fitted to the end, with the simulator's step corrected where it now stands."""
        # Where impacts fall between steps depends on the parameters themselves.
        for _ in range(_ROUGH_ROUNDS if rival.hypothesis.rough else 1):
            self.problem.refine_at(rival.hypothesis)
            rival = self._rivals([rival.hypothesis], self._weights(rival), _LONG, slopes=True)[0]
        return rival

    def _bare(self, best: Rival) -> list[View]:
        """For every term: what stands, to first order, with it taken away and the rest free."""
        problem = self.problem
        binned = bins(problem, problem.fit)
        terms = best.hypothesis.terms
        residuals = problem.residuals([best.hypothesis.without(t) for t in terms], problem.fit)
        slope = binned.mean(best.fitted.jacobian)
        out = []
        for term, residual in zip(terms, residuals, strict=True):
            keep = np.ones(slope.shape[2], dtype=bool)
            keep[best.hypothesis.slice_of(term)] = False
            out.append(
                View(binned.mean(np.nan_to_num(residual)), slope[:, :, keep],
                     problem.signal_floor, binned.lengths)
            )  # fmt: skip
        return out

    def _linear_evidence(self, best: Rival, view: View, structure: Structure, more: int) -> float:
        """Evidence of what a structure leaves over a fit, ``more`` parameters than it has."""
        binned = bins(self.problem, self.problem.fit).mean(best.fitted.residual)
        effective = effective_samples(binned, view.lengths)
        base = log_likelihood(binned, view.floor, effective)
        left = log_likelihood(structure.residual, view.floor, effective)
        return left - base - price(effective) * more

    def _backward(self, best: Rival) -> Rival:
        """Drop terms that do not pay; what clearly pays to first order is not simulated."""
        while len(best.hypothesis.terms) > 1:
            terms = best.hypothesis.terms
            doubtful = []
            for term, view in zip(terms, self._bare(best), strict=True):
                fewer = -len(term.parameters)
                if self._linear_evidence(best, view, bare(view), fewer) > -_CLEAR:
                    doubtful.append(term)
            if not doubtful:
                break
            starts = [best.hypothesis.without(t) for t in doubtful]
            rivals = self._rivals(starts, self._weights(best), _QUICK)
            self._judge(rivals, best)
            top = max(rivals, key=lambda r: r.evidence)
            if top.evidence < -_EARNS / 2:
                break
            gone = set(best.hypothesis.terms) - set(top.hypothesis.terms)
            self.say(f"- {gone} evidence {top.evidence:.1f}")
            best = self._settled(top)
        return best

    def _sideways(self, selected: Selected) -> bool:
        """Hold every term against the rivals in its place; True if one was better.

        Rivals that are far behind to first order keep that evidence; the others are fitted.
        """
        best = selected.best
        selected.confidence.clear()
        selected.alternatives.clear()
        terms = best.hypothesis.terms
        if not terms:
            return False
        answers = Answers(self._look(best)[1])
        evidence: dict[tuple[Term, Term | None], float] = {}
        close: list[tuple[Term, Term]] = []
        starts: list[Hypothesis] = []
        for term, view in zip(terms, self._bare(best), strict=True):
            count = len(term.parameters)
            lens = Lens(view, answers)
            evidence[term, None] = self._linear_evidence(best, view, lens.bare, -count)
            for chosen in lens.children(lens.bare, _RIVALS):
                structure = lens.structure(chosen)
                ((new, start),) = structure.starts.items()
                found = self._linear_evidence(best, view, structure, len(start) - count)
                evidence[term, new] = found
                if found > -_CLEAR:
                    close.append((term, new))
                    starts.append(best.hypothesis.without(term).with_term(new, start))
        rivals = self._rivals(starts, self._weights(best), _QUICK + 1) if starts else []
        self._judge(rivals, best)
        for (term, new), r in zip(close, rivals, strict=True):
            evidence[term, new] = r.evidence
        for term in terms:
            mine = {new: e for (old, new), e in evidence.items() if old == term}
            values = np.array([0.0, *mine.values()])
            share = np.exp(np.clip(values - values.max(), -700.0, 0.0))
            share /= share.sum()
            selected.confidence[term] = float(share[0])
            others = [(n, float(s)) for n, s in zip(mine, share[1:], strict=True) if n is not None]
            selected.alternatives[term] = sorted(others, key=lambda x: -x[1])
        if rivals:
            top = max(rivals, key=lambda r: r.evidence)
            if top.evidence > 1.0:
                self.say(f"~ {top.hypothesis.terms} evidence {top.evidence:.1f}")
                selected.best = self._backward(self._settled(top))
                return True
        return False


def _text(starts: Mapping[Term, FloatArray]) -> str:
    return " + ".join(f"{t.effect}@{t.joint}{np.round(s, 3)}" for t, s in starts.items())


def bare(view: View) -> Structure:
    """What stands when only what is named gives way."""
    weight = 1.0 / np.sqrt(np.mean(view.residual**2, axis=0) + view.floor**2)
    a = (view.jacobian * weight[:, None]).reshape(view.residual.size, -1)
    if not a.shape[1]:
        return Structure({}, view.residual)
    amplitude = np.linalg.lstsq(a, (view.residual * weight).ravel(), rcond=1e-9)[0]
    return Structure({}, view.residual - view.jacobian @ amplitude)
