"""Choose the structure: which effects earn their place.

Forward: structures of one and more effects are searched to first order around the best fit so far
(:mod:`screen`); the best of each size are fitted by simulation, side by side, and judged by
evidence: log-likelihood on the fit recordings less half a log of the effective samples for each
parameter (Schwarz 1978), plus log-likelihood on recordings that no fit has seen. Then backward: a
term that no longer pays is dropped. Then sideways: each term is held against the rivals that could
stand in its place.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.diagnosis.evidence import effective_samples, log_likelihood
from pytest_twin.diagnosis.fit import Fitted, fit, weighted_cost
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.polish import Polished, polish
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.responses import Linear, answered, bins, grid, linearized
from pytest_twin.diagnosis.screen import Answers, Lens, Search, View, candidates, name_price, price
from pytest_twin.diagnosis.sharpen import sharpened
from pytest_twin.diagnosis.verdict import STANDS_OUT
from pytest_twin.effects.base import FloatArray

_MAX_TERMS = 10
_ROUNDS = 6
# Structures kept at each size, terms added at once, structures of each size and of one term that
# are fitted along the motion, rivals looked at in a term's place.
_WIDTH, _AT_ONCE, _OFFERED, _SINGLE, _RIVALS = 10, 4, 2, 8, 6
# Evidence to first order beyond which no simulation would change the verdict.
_CLEAR = 30.0
_FAR = 100.0
_POLISH, _MOST_CLOSE, _ATTEMPTS = 3, 2, 3
_QUICK, _FAIR, _LONG = 2, 4, 8
# Single terms are scanned by simulation where the mismatch is more floors than this and the best
# along the motion is no single term that leaves few; and how many of them are kept.
_FIRST_ORDER, _NEARLY, _SCANNED = 10.0, 3.0, 3
# Replays of all recordings that a search may take, more for every term that was found, and at most:
# what needs more has no law in the catalogue.
_MOST_REPLAYS, _MORE_REPLAYS, _ALL_REPLAYS = 300, 50, 450
# Floors that taking a term away leaves, beyond which the nearest rivals are simulated anyhow.
_FAR_APART = 30.0
# Rivals that stay in the race after one iteration: evidence behind the first, and how many; share
# of the first one's evidence within which they are judged once more.
_IN_FRONT, _FRONT = 150.0, 4
_NECK = 0.05
_ROUGH_ROUNDS = 2
# Terms that act on one joint and may be a crowd in the place of fewer.
_CROWD = 3
# Gains of evidence below this are chance: about 1 in e^5 for a rival drawn from many.
_EARNS = 5.0
# Structures this share of the evidence behind the first are as good; with fewer names they have
# to have this share of it.
_AS_GOOD, _NAME_BUYS = 0.01, 0.8
# A name must take away this share of what still stands above the floor at some joint, and this
# share of what the nominal model left there: less is the simulator's own imperfection.
_SHARE_OF_REST = 0.1
_SHARE_OF_ALL = 0.003


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


@dataclass(slots=True)
class Look:
    """A fit seen to first order.

    Attributes:
        linear: laws along the measured motion; None where the robot meets something.
        view: what is left of the fit, and what may give way.
        answers: responses of the candidates.
    """

    linear: Linear | None
    view: View
    answers: Answers


class Selection:
    """One search over structures."""

    def __init__(self, problem: Problem, say: Callable[[str], None] = lambda text: None) -> None:
        self.problem = problem
        self.say = say
        self.has_held = bool(len(problem.held_out))
        self.name_price = 0.0
        self.regrown = 0
        self.first: tuple[Term, ...] | None = None

    def run(self) -> Selected:
        """Search forward, backward and sideways."""
        problem = self.problem
        nominal = self._rivals([EMPTY], np.ones(len(problem.signal_floor)), 0)[0]
        self.nominal = nominal
        tried = len(candidates(problem))
        self.name_price = name_price(tried)
        selected = Selected(nominal, nominal, tried=tried)
        self._grow(selected)
        return self._regrown(selected)

    def _grow(self, selected: Selected) -> None:
        """Add, drop and exchange terms until nothing is better."""
        for _ in range(_ROUNDS):
            best = selected.best
            better = None
            if (
                len(best.hypothesis.terms) < _MAX_TERMS
                and self._worth_a_search(best)
                and not self._spent(best)
            ):
                better = self._forward(best)
            if better is not None:
                selected.best = self._backward(better)
            elif not self._sideways(selected):
                break

    def _regrown(self, selected: Selected) -> Selected:
        """What is found once more from its strongest term, if that comes to something better.

        Several terms at one joint may hold each other up, and no exchange of one of them leads to
        the fewer that are right.
        """
        terms = selected.best.hypothesis.terms
        joints = [sum(t.joint in (j, -1) for t in terms) for j in range(len(self.problem.joints))]
        if max(joints) < _CROWD or self._spent(selected.best):
            return selected
        theta, place = selected.best.hypothesis.theta, selected.best.hypothesis.slice_of
        alone = [Hypothesis((t,), theta[place(t)]) for t in terms]
        rivals = self._rivals(alone, self._weights(selected.best), _FAIR)
        self._judge(rivals, selected.nominal)
        root = max(rivals, key=lambda r: r.evidence)
        if root.hypothesis.terms == self.first:
            return selected
        self.regrown = len(terms)
        self.say(f"again from {_text(root.hypothesis)}")
        other = Selected(self._settled(root), selected.nominal, tried=selected.tried)
        self._grow(other)
        self._judge([other.best], selected.best)
        self.say(f"= {_text(other.best.hypothesis)} evidence {other.best.evidence:.1f}")
        return other if other.best.evidence > 0.0 else selected

    def _spent(self, best: Rival) -> bool:
        """Whether as much was simulated as a search that found this may take."""
        once = int(self.problem.simulator.steps.sum())
        most = _MOST_REPLAYS + _MORE_REPLAYS * (len(best.hypothesis.terms) + self.regrown)
        return self.problem.stepped > min(most, _ALL_REPLAYS) * once

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
            more = r.hypothesis.free - against.hypothesis.free
            names = len(r.hypothesis.terms) - len(against.hypothesis.terms)
            r.evidence = log_likelihood(r.fitted.residual, floor, fit_n) - base
            r.evidence -= cost * more + self.name_price * names
            if self.has_held:
                r.held_gain = log_likelihood(r.held_residual, floor, held_n) - held_base
                r.evidence += r.held_gain

    # -- moves

    def _unseen(self, rival: Rival) -> FloatArray:
        """(signals,) mean square on what no fit has seen, where there is such a thing."""
        residual = rival.held_residual if self.has_held else rival.fitted.residual
        mean_square: FloatArray = np.mean(residual**2, axis=0)
        return mean_square

    def _worth_a_search(self, rival: Rival) -> bool:
        """Whether any joint has left what would be worth a name if all of it went."""
        floor = self.problem.signal_floor**2
        fit = np.mean(rival.fitted.residual**2, axis=0)
        left = np.maximum(self._unseen(rival), fit)
        least = np.where(left > STANDS_OUT**2 * floor, floor, left)
        whole = np.maximum(
            self._unseen(self.nominal), np.mean(self.nominal.fitted.residual**2, axis=0)
        )
        return self._worth_a_name(left, least, whole)

    def _worth_a_name(self, before: FloatArray, after: FloatArray, whole: FloatArray) -> bool:
        """Whether mean squares (signals,) fall by enough; ``whole`` of the model as it came."""
        floor = self.problem.signal_floor**2
        gone = before - after
        rest = np.maximum(before - floor, 0.2 * floor)
        all_of_it = np.maximum(whole - floor, 0.2 * floor)
        return bool(((gone >= _SHARE_OF_REST * rest) & (gone >= _SHARE_OF_ALL * all_of_it)).any())

    def _look(self, best: Rival) -> Look:
        """What is left around a fit, and what every candidate would do to it."""
        problem = self.problem
        named = set(best.hypothesis.terms)
        terms = [t for t in candidates(problem) if t not in named]
        linear = linearized(problem, problem.fit, best.hypothesis)
        found, left = answered(
            linear, problem, terms, problem.fit, best.hypothesis, best.fitted.residual
        )
        view, answers = self._view(best, left), Answers(found)
        if linear is not None and found:
            sharp = sharpened(linear, view, answers, best.hypothesis)
            answers = Answers([*found, *sharp]) if sharp else answers
        return Look(linear, view, answers)

    def _view(self, best: Rival, left: FloatArray) -> View:
        """A fit whose (bins, signals) residual is ``left``."""
        binned = bins(self.problem, self.problem.fit)
        slope = binned.mean(best.fitted.jacobian)
        return View(left, slope, self.problem.signal_floor, binned.lengths)

    def _forward(self, best: Rival) -> Rival | None:
        """A better fit with more terms, if there is one.

        A law that reads the measured motion back (a softer drive, a gear that gives) may explain
        along it what it does not when it is simulated: such terms leave, and the search goes on.
        """
        look = self._look(best)
        for _ in range(_ATTEMPTS):
            rivals = [] if self._spent(best) else self._tried(best, look)
            if not rivals:
                break
            before, unseen = self._unseen(best), self._unseen(self.nominal)
            for r in rivals:
                self.say(f"  {_text(r.hypothesis)} evidence {r.evidence:.1f}")
            earning = [
                r for r in rivals
                if r.evidence >= _EARNS
                and (r.held_gain > 0.0 or not self.has_held)
                and self._worth_a_name(before, self._unseen(r), unseen)
            ]  # fmt: skip
            if earning:
                top = _simplest(earning)
                self.first = self.first or top.hypothesis.terms
                self.say(f"+ {_text(top.hypothesis)} evidence {top.evidence:.1f}")
                return self._settled(top)
            failed = {t for r in rivals for t in r.hypothesis.terms}
            answers = [a for a in look.answers.responses if a.term not in failed]
            look = Look(look.linear, look.view, Answers(answers))
        self.problem.refine_at(best.hypothesis)
        return None

    def _tried(self, best: Rival, look: Look) -> list[Rival]:
        """The structures in front, simulated and fitted; by evidence over ``best``."""
        if not look.answers.responses:
            return []
        whole = np.mean(self.nominal.fitted.residual**2, axis=0)
        levels = Search(
            _WIDTH, _AT_ONCE, _EARNS,
            lambda before, after: self._worth_a_name(before, after, whole),
        ).levels(Lens(look.view, look.answers))  # fmt: skip
        if not levels:
            return []
        # Shapes of single terms are known as well as their grids are: more of them get a chance.
        chosen = [
            structure
            for level in reversed(levels)
            for structure in level[: _OFFERED if level is not levels[0] else _SINGLE]
        ]
        starts = []
        for structure in chosen:
            h = best.hypothesis
            for term, start in structure.starts.items():
                h = h.with_term(term, start)
            starts.append(h)
        starts, left, singles = self._front(look, starts, chosen[0].residual)
        if self._bent(look, left, clear=starts[0] in singles):
            scanned = self._scanned(best, singles, left)
            alike = {h.terms for h in scanned}
            starts = [*(h for h in starts if h.terms not in alike), *scanned]
        # What the step costs differs between the model as it came and what explains the rest; of
        # that, the simplest is the least to be wrong.
        self.problem.refine_at(min(starts, key=lambda h: len(h.terms)))
        return self._heats(starts, 1.0 / np.sqrt(left + look.view.floor**2), best)

    @staticmethod
    def _bent(look: Look, left: FloatArray, *, clear: bool) -> bool:
        """Whether deviations are so far from small that slopes may lead nowhere.

        Args:
            left: (signals,) mean square that the best along the motion leaves.
            clear: whether that is a single term.
        """
        floor = look.view.floor
        if look.linear is None:
            return bool((left > (_FIRST_ORDER * floor) ** 2).any())
        whole = np.mean(look.view.residual**2, axis=0)
        far = bool((whole > (_FIRST_ORDER * floor) ** 2).any())
        return far and not (clear and bool((left < (_NEARLY * floor) ** 2).all()))

    def _scanned(
        self, best: Rival, singles: Sequence[Hypothesis], left: FloatArray
    ) -> list[Hypothesis]:
        """The best of what single terms do as they are and at all starting sizes, by simulation."""
        terms = [h.terms[-1] for h in singles]
        terms += [t for t in self._gears(left) if t not in {*terms, *best.hypothesis.terms}]
        rows = [best.hypothesis.with_term(t, start) for t in terms for start, _ in grid(t)]
        rows += singles
        weight = 1.0 / np.sqrt(left + self.problem.signal_floor**2)
        costs = [weighted_cost(r, weight) for r in self.problem.residuals(rows, self.problem.fit)]
        order = [i for i in np.argsort(costs) if np.isfinite(costs[i])]
        found: dict[Term, Hypothesis] = {}
        for i in order:
            found.setdefault(rows[i].terms[-1], rows[i])
        return list(found.values())[:_SCANNED]

    def _gears(self, left: FloatArray) -> list[Term]:
        """Transmissions that may give where much is left: they read the measured motion back, and
        say along it little of what they do.
        """
        joints = len(self.problem.joints)
        far = left[:joints] > (_FIRST_ORDER * self.problem.floor) ** 2
        return [
            t for t in candidates(self.problem)
            if t.law.overrides("separates") and far[t.joint]
        ]  # fmt: skip

    def _front(
        self, look: Look, starts: list[Hypothesis], residual: FloatArray
    ) -> tuple[list[Hypothesis], FloatArray, list[Hypothesis]]:
        """The few that are worth a simulation, the (signals,) mean square that is left, and all
        that add least.
        """
        view = look.view
        fewest = min(len(h.terms) for h in starts)
        if look.linear is None:
            singles = [h for h in starts if len(h.terms) == fewest]
            return starts, np.mean(residual**2, axis=0), singles
        polished = polish(look.linear, view, starts, _POLISH)
        evidence = self._surrogate_evidence(view, polished)
        order = np.argsort(-evidence)
        for i in order:
            self.say(f"  along {_text(polished[i].hypothesis)} evidence {evidence[i]:.1f}")
        front: list[int] = []
        for i in order:
            terms = set(polished[i].hypothesis.terms)
            # What only adds to another in front, and not enough, says nothing new.
            covered = any(
                terms > set(polished[k].hypothesis.terms) and evidence[i] < evidence[k] + _EARNS
                for k in order
            )
            if np.isfinite(evidence[i]) and not covered:
                front.append(int(i))
        # What acts strongly is only roughly of first order: the best single terms are simulated.
        single = [i for i in front if len(polished[i].hypothesis.terms) == fewest]
        front = [*front[:_FRONT], *(i for i in single[:2] if i not in front[:_FRONT])]
        left: FloatArray = np.mean(polished[front[0]].residual ** 2, axis=0)
        hypotheses = [p.hypothesis for p in polished]
        singles = [h for h in hypotheses if len(h.terms) == fewest]
        return [hypotheses[i] for i in front], left, singles

    def _surrogate_evidence(self, view: View, polished: Sequence[Polished]) -> FloatArray:
        """Log-likelihood less price of hypotheses along the measured motion, comparable."""
        effective = view.effective_of_best([p.residual for p in polished])
        return np.array(
            [
                view.worth(p.residual, effective, p.hypothesis.free)
                - self.name_price * len(p.hypothesis.terms)
                for p in polished
            ]
        )

    def _heats(self, starts: Sequence[Hypothesis], weights: FloatArray, best: Rival) -> list[Rival]:
        """Rivals by evidence over ``best``: all after one iteration, those in front after more."""
        rivals = self._rivals(starts, weights, 1)
        self._judge(rivals, best, min(rivals, key=lambda r: r.fitted.cost))
        rivals.sort(key=lambda r: -r.evidence)
        front = [r for r in rivals if r.evidence > rivals[0].evidence - _IN_FRONT][:_FRONT]
        again = self._rivals([r.hypothesis for r in front], weights, _QUICK)
        rivals[: len(front)] = again
        self._judge(rivals, best, min(rivals, key=lambda r: r.fitted.cost))
        rivals.sort(key=lambda r: -r.evidence)
        contenders = [r for r in rivals if r.evidence > (1.0 - _NECK) * rivals[0].evidence > 0.0]
        if len(contenders) > 1:
            # Neck and neck they are judged where the simulator's step is corrected for them.
            self.problem.refine_at(rivals[0].hypothesis)
            again = self._rivals([r.hypothesis for r in contenders], weights, _QUICK)
            rivals[: len(contenders)] = again
            self._judge(again, best, min(again, key=lambda r: r.fitted.cost))
        return sorted(rivals, key=lambda r: -r.evidence)

    def _settled(self, rival: Rival) -> Rival:
        """The rival fitted to the end, with the simulator's step corrected where it now stands."""
        # Where impacts fall between steps depends on the parameters themselves.
        for _ in range(_ROUGH_ROUNDS if rival.hypothesis.rough else 1):
            self.problem.refine_at(rival.hypothesis)
            settled = self._rivals([rival.hypothesis], self._weights(rival), _LONG, slopes=True)[0]
            if not np.isfinite(settled.held_residual).all():
                # A fit that diverges on what it has not seen is none: stay where it did not.
                return self._rivals([rival.hypothesis], self._weights(rival), 0, slopes=True)[0]
            rival = settled
        return rival

    def _lenses(self, best: Rival, look: Look) -> list[Lens]:
        """For every term: what stands, to first order, with it taken away and the rest free."""
        problem, terms = self.problem, best.hypothesis.terms
        binned = bins(problem, problem.fit)
        residuals = problem.residuals([best.hypothesis.without(t) for t in terms], problem.fit)
        out = []
        for term, residual in zip(terms, residuals, strict=True):
            keep = np.ones(look.view.jacobian.shape[2], dtype=bool)
            keep[best.hypothesis.slice_of(term)] = False
            left = binned.mean(np.nan_to_num(residual))
            slope = look.view.jacobian[:, :, keep]
            out.append(Lens(View(left, slope, look.view.floor, look.view.lengths), look.answers))
        return out

    def _against(
        self, linear: Linear, view: View, best: Rival, others: Sequence[Hypothesis]
    ) -> tuple[list[Hypothesis], FloatArray]:
        """Hypotheses fitted along the measured motion of ``best``, and their evidence over it."""
        polished = polish(linear, view, others, _POLISH)
        values = self._surrogate_evidence(
            view, [Polished(best.hypothesis, view.residual), *polished]
        )
        return [p.hypothesis for p in polished], values[1:] - values[0]

    def _backward(self, best: Rival) -> Rival:
        """Drop terms that do not pay, and laws that fewer or a simpler one equal.

        What clearly pays along the motion is not simulated.
        """
        while best.hypothesis.terms:
            terms = best.hypothesis.terms
            doubtful = [best.hypothesis.without(t) for t in terms] if len(terms) > 1 else []
            doubtful += self._merged(best.hypothesis)
            linear = linearized(self.problem, self.problem.fit, best.hypothesis)
            if linear is not None and doubtful:
                view = self._view(best, linear.residual(best.fitted.residual))
                fitted, evidence = self._against(linear, view, best, doubtful)
                doubtful = [h for h, e in zip(fitted, evidence, strict=True) if e > -_CLEAR]
            doubtful += self._simpler(best.hypothesis)
            if not doubtful:
                break
            rivals = self._rivals(doubtful, self._weights(best), _FAIR)
            self._judge(rivals, best)
            top = max(rivals, key=lambda r: r.evidence)
            if top.evidence < -_EARNS / 2:
                break
            gone = set(best.hypothesis.terms) - set(top.hypothesis.terms)
            self.say(f"- {gone} evidence {top.evidence:.1f}")
            best = self._settled(top)
        return best

    def _merged(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """The hypothesis with two terms of a joint as one of them that has the other in it, or as
        the one law that is confused with both.
        """
        out = []
        terms = [t for t in hypothesis.terms if t.joint >= 0]
        for a, b in itertools.combinations(terms, 2):
            if a.joint != b.joint:
                continue
            out += [h for h in (hypothesis.absorbed(a, b), hypothesis.absorbed(b, a)) if h]
            for new in candidates(self.problem):
                both = {a.effect, b.effect} <= set(new.law.confused_with)
                if both and new.joint == a.joint and new not in hypothesis.terms:
                    (start, _), *_ = grid(new)
                    out.append(hypothesis.without(a).without(b).with_term(new, start))
        return out

    def _simpler(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """The hypothesis with one of its laws as the special case that it comes to."""
        scales, out = self.problem.scales, []
        for term in hypothesis.terms:
            theta = hypothesis.theta[hypothesis.slice_of(term)]
            values = {
                p.name: float(t) * scales.value(p, term.joint)
                for p, t in zip(term.parameters, theta, strict=True)
            }
            for effect, special in term.law.special_cases(values).items():
                new = Term(effect, term.joint)
                start = [
                    np.clip(special[p.name] / scales.value(p, term.joint), p.lower, p.upper)
                    for p in new.parameters
                ]
                if new not in hypothesis.terms:
                    out.append(hypothesis.without(term).with_term(new, np.array(start)))
        return out

    def _sideways(self, selected: Selected) -> bool:
        """Hold every term against the rivals in its place; True if one was better.

        Rivals that are far behind along the measured motion keep that evidence, where it can be
        trusted; the others are simulated.
        """
        best = selected.best
        selected.confidence.clear()
        selected.alternatives.clear()
        terms = best.hypothesis.terms
        if not terms:
            return False
        look = self._look(best)
        places: list[tuple[Term, Term | None]] = []
        others: list[Hypothesis] = []
        linear: list[float] = []
        far: list[Term] = []
        for term, lens in zip(terms, self._lenses(best, look), strict=True):
            apart = np.sqrt(np.mean(lens.view.residual**2, axis=0))
            if (apart > _FAR_APART * look.view.floor).any():
                # What first order leaves of so much is more than rivals differ by.
                far.append(term)
            rest = best.hypothesis.without(term)
            places.append((term, None))
            others.append(rest)
            structures = [lens.bare]
            for chosen in lens.children(lens.bare, _RIVALS):
                structure = lens.structure(chosen)
                ((new, start),) = structure.starts.items()
                structures.append(structure)
                places.append((term, new))
                others.append(rest.with_term(new, start))
            hypotheses = [best.hypothesis, *others[-len(structures) :]]
            seen = [Polished(h, r) for h, r in zip(
                hypotheses, [look.view.residual, *(x.residual for x in structures)], strict=True
            )]  # fmt: skip
            values = self._surrogate_evidence(look.view, seen)
            linear += list(values[1:] - values[0])
        found = np.nan_to_num(np.array(linear), nan=-np.inf)
        if look.linear is not None:
            near = [i for i in range(len(others)) if found[i] > -_FAR]
            fitted, values = self._against(look.linear, look.view, best, [others[i] for i in near])
            found[near] = np.nan_to_num(values, nan=-np.inf)
            for i, h in zip(near, fitted, strict=True):
                others[i] = h
        order = np.argsort(-found)
        close = [i for i in order if found[i] > -_CLEAR and places[i][1] is not None]
        close = close[: _MOST_CLOSE * len(terms)]
        for term in far:
            nearest = [i for i in order if places[i][0] == term and places[i][1] is not None]
            close += [i for i in nearest[:_MOST_CLOSE] if i not in close]
        close = [] if self._spent(best) else close
        rivals = self._rivals([others[i] for i in close], self._weights(best), _FAIR)
        self._judge(rivals, best)
        evidence = {place: float(value) for place, value in zip(places, found, strict=True)}
        for i, r in zip(close, rivals, strict=True):
            evidence[places[i]] = r.evidence
        for term in terms:
            mine = {new: e for (old, new), e in evidence.items() if old == term}
            values = np.array([0.0, *mine.values()])
            share = np.exp(np.clip(values - values.max(), -700.0, 0.0))
            share /= share.sum()
            selected.confidence[term] = float(share[0])
            ranked = [(n, float(s)) for n, s in zip(mine, share[1:], strict=True) if n is not None]
            selected.alternatives[term] = sorted(ranked, key=lambda x: -x[1])
        if rivals:
            top = max(rivals, key=lambda r: r.evidence)
            if top.evidence > 1.0:
                self.say(f"~ {_text(top.hypothesis)} evidence {top.evidence:.1f}")
                selected.best = self._backward(self._settled(top))
                return True
        return False


def _simplest(earning: Sequence[Rival]) -> Rival:
    """The rival to go on from; ``earning`` by evidence, best first.

    What is left is never white: a name more, or a parameter more, follows anything a little better.
    A name that was needed after all is found in the next round.
    """
    first = earning[0].evidence
    fewest = min(len(r.hypothesis.terms) for r in earning if r.evidence >= _NAME_BUYS * first)
    alike = [r for r in earning if len(r.hypothesis.terms) == fewest]
    enough = min((1.0 - _AS_GOOD) * alike[0].evidence, alike[0].evidence - _EARNS)
    return min(
        (r for r in alike if r.evidence >= enough), key=lambda r: (r.hypothesis.free, -r.evidence)
    )


def _text(h: Hypothesis) -> str:
    return " + ".join(f"{t.effect}@{t.joint}{np.round(h.theta[h.slice_of(t)], 3)}" for t in h.terms)
