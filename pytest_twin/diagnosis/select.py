"""Choose the structure: which effects earn their place.

Forward: structures of one and more effects are searched to first order around the best fit so far
(:mod:`foremost`), and those in front (:mod:`front`) are fitted by simulation (:mod:`contest`). Then
backward: a term that no longer pays is dropped. Then sideways: each term is held against the rivals
that could stand in its place. A crowd at one joint is grown once more from its strongest term.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pytest_twin.diagnosis.contest import FAIR, QUICK, Contest
from pytest_twin.diagnosis.fewer import merged, of_the_robot, simpler
from pytest_twin.diagnosis.foremost import Foremost, against, evidence_along, foremost
from pytest_twin.diagnosis.front import front
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.look import Look, look_ahead, look_around, view_of
from pytest_twin.diagnosis.polish import Polished
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.responses import bins, linearized
from pytest_twin.diagnosis.restraint import in_floors
from pytest_twin.diagnosis.rivals import EARNS, Rival, Selected, described, simplest
from pytest_twin.diagnosis.screen import Lens, View
from pytest_twin.diagnosis.verdict import LEFT_FLOORS

_MAX_TERMS = 10
_ROUNDS, _ATTEMPTS = 6, 3
# Evidence to first order beyond which no simulation would change the verdict.
_CLEAR = 30.0
_FAR = 100.0
# Rivals looked at in a term's place, and those of each term that are simulated.
_RIVALS, _MOST_CLOSE = 6, 2
# Floors that taking a term away leaves, beyond which the nearest rivals are simulated anyhow.
_FAR_APART = 30.0
# Terms that act on one joint and may be a crowd in the place of fewer.
_CROWD = 3


class Selection:
    """One search over structures."""

    def __init__(
        self,
        problem: Problem,
        say: Callable[[str], None] = lambda text: None,
        share_left: float = 1.0,
    ) -> None:
        """A search over all structures.

        Args:
            problem: what to explain.
            say: told what is considered.
            share_left: of the squared mismatch. Below 1 the search is a second look: given up where
                along the motion no structure leaves less, or where those in front fail.
        """
        self.problem = problem
        self.say = say
        self.share_left = share_left
        self.attempts = _ATTEMPTS if share_left >= 1.0 else 1
        self.contest = Contest(problem)
        self.regrown = 0
        self.first: tuple[Term, ...] | None = None
        self.last_look: Look | None = None

    def run(self) -> Selected:
        """Search forward, backward and sideways."""
        nominal = self.contest.nominal
        selected = Selected(nominal, nominal, tried=self.contest.tried)
        self._grow(selected)
        return self._regrown(selected)

    def _grow(self, selected: Selected) -> None:
        """Add, drop and exchange terms until nothing is better."""
        for _ in range(_ROUNDS):
            best = selected.best
            better = None
            if (
                len(best.hypothesis.terms) < _MAX_TERMS
                and self.contest.worth_a_search(best)
                and not self._spent(best)
            ):
                better = self._forward(best)
            if better is not None:
                selected.best = self._backward(better)
                if self._strained(selected.best):
                    break
            elif not self._sideways(selected):
                break

    def _regrown(self, selected: Selected) -> Selected:
        """What is found once more from its strongest term, if that comes to something better.

        Several terms at one joint may hold each other up, and no exchange of one of them leads to
        the fewer that are right. Such a crowd leaves something above the floor.
        """
        best = selected.best
        terms = best.hypothesis.terms
        joints = [sum(t.joint in (j, -1) for t in terms) for j in range(len(self.problem.joints))]
        crowded = max(joints) >= _CROWD and self.contest.worth_a_search(best)
        if not crowded or self._spent(best) or self._strained(best):
            return selected
        theta, place = best.hypothesis.theta, best.hypothesis.slice_of
        alone = [Hypothesis((t,), theta[place(t)]) for t in terms]
        rivals = self.contest.rivals(alone, self.contest.weights(best), FAIR)
        self.contest.judge(rivals, selected.nominal)
        root = max(rivals, key=lambda r: r.evidence)
        if root.hypothesis.terms == self.first:
            return selected
        self.regrown = len(terms)
        self.say(f"again from {described(root.hypothesis)}")
        other = Selected(self.contest.settled(root), selected.nominal, tried=selected.tried)
        self._grow(other)
        self.contest.judge([other.best], best)
        self.say(f"= {described(other.best.hypothesis)} evidence {other.best.evidence:.1f}")
        return other if other.best.evidence > 0.0 else selected

    def _strained(self, rival: Rival) -> list[Term]:
        """Laws that stand at a physical bound and leave their joint far from explained: something
        else is at work there.
        """
        problem, hypothesis = self.problem, rival.hypothesis
        left = in_floors(rival.fitted.residual, problem.signal_floor)[: len(problem.joints)]
        return [
            t for t in hypothesis.terms
            if hypothesis.at_bound(t)
            and (left.max() if t.joint < 0 else left[t.joint]) > LEFT_FLOORS
        ]  # fmt: skip

    def _spent(self, best: Rival) -> bool:
        return self.contest.spent(len(best.hypothesis.terms) + self.regrown)

    def _forward(self, best: Rival) -> Rival | None:
        """A better fit with more terms, if there is one.

        A law that reads the measured motion back (a softer drive, a gear that gives) may explain
        along it what it does not when it is simulated, and one may help most that is stretched to
        its bound: such terms leave, and the search goes on.
        """
        look = self.last_look = look_ahead(self.problem, best)
        for _ in range(self.attempts):
            rivals = [] if self._spent(best) else self._tried(best, look)
            if not rivals:
                break
            before, unseen = self.contest.unseen(best), self.contest.unseen(self.contest.nominal)
            for r in rivals:
                self.say(f"  {described(r.hypothesis)} evidence {r.evidence:.1f}")
            earning = [
                r for r in rivals
                if r.evidence >= EARNS
                and (r.held_gain > 0.0 or not self.contest.has_held)
                and self.contest.worth_a_name(before, self.contest.unseen(r), unseen)
            ]  # fmt: skip
            strained = {t for r in earning for t in self._strained(r)}
            sound = [r for r in earning if not strained & set(r.hypothesis.terms)]
            if sound:
                top = simplest(sound)
                self.first = self.first or top.hypothesis.terms
                self.say(f"+ {described(top.hypothesis)} evidence {top.evidence:.1f}")
                return self.contest.settled(top)
            tried = {t for r in rivals for t in r.hypothesis.terms}
            look = look.without(strained or tried - set(best.hypothesis.terms))
        self.problem.refine_at(best.hypothesis)
        return None

    def _tried(self, best: Rival, look: Look) -> list[Rival]:
        """The structures in front, simulated and fitted; by evidence over ``best``."""
        found = foremost(self.contest, best, look, self.say)
        if found is None or self._hopeless(found):
            return []
        starts, left = front(self.problem, best, look, found), found.left
        if not starts:
            return []
        # What the step costs differs between the model as it came and what explains the rest; of
        # that, the simplest is the least to be wrong.
        self.problem.refine_at(min(starts, key=lambda h: len(h.terms)))
        return self.contest.heats(starts, self.problem.weights(left), best)

    def _hopeless(self, found: Foremost) -> bool:
        """Whether this is a second look, and even what is best along the motion leaves too much."""
        if self.share_left >= 1.0:
            return False
        floor = self.problem.signal_floor
        whole = np.mean(self.contest.nominal.fitted.residual**2, axis=0)
        share = float(np.sum(found.left / floor**2) / np.sum(whole / floor**2))
        return share > self.share_left

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

    def _backward(self, best: Rival) -> Rival:
        """Drop terms that do not pay, and laws that fewer or a simpler one equal.

        What clearly pays along the motion is not simulated, gears apart: along it they say little.
        """
        while best.hypothesis.terms:
            terms = best.hypothesis.terms
            doubtful = [best.hypothesis.without(t) for t in terms] if len(terms) > 1 else []
            doubtful += merged(self.problem, best.hypothesis)
            linear = linearized(self.problem, self.problem.fit, best.hypothesis)
            gears = {t for t in terms if t.law.overrides("separates")}
            told = [h for h in doubtful if gears <= set(h.terms)]
            if linear is not None and told:
                view = view_of(self.problem, best, linear.residual(best.fitted.residual))
                fitted, evidence = against(linear, view, best, told, self.contest.name_price)
                doubtful = [h for h in doubtful if not gears <= set(h.terms)]
                doubtful += [h for h, e in zip(fitted, evidence, strict=True) if e > -_CLEAR]
            doubtful += simpler(self.problem, best.hypothesis)
            rivals = self._of_the_robot(best)
            if not doubtful and not rivals:
                break
            # Where small deviations say nothing every doubt costs fits of its own: shorter ones.
            iterations = QUICK if linear is None else FAIR
            self.contest.judge(rivals, best)
            rivals += self.contest.against(doubtful, best, iterations)
            top = max(rivals, key=lambda r: r.evidence)
            if top.evidence < -EARNS / 2:
                break
            gone = set(best.hypothesis.terms) - set(top.hypothesis.terms)
            self.say(f"- {gone} evidence {top.evidence:.1f}")
            best = self.contest.settled(top)
        return best

    def _of_the_robot(self, best: Rival) -> list[Rival]:
        """What is the whole robot's in the place of the same at several joints, fitted; each with
        the error of the step as it is there, for their motions lie apart in time.
        """
        found = []
        for other in of_the_robot(self.problem, best.hypothesis):
            self.problem.refine_at(other)
            found += self.contest.rivals([other], self.contest.weights(best), FAIR)
        if found:
            self.problem.refine_at(best.hypothesis)
        return found

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
        look = look_around(self.problem, best, self.last_look)
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
            values = evidence_along(look.view, seen, self.contest.name_price)
            linear += list(values[1:] - values[0])
        found = np.nan_to_num(np.array(linear), nan=-np.inf)
        if look.linear is not None:
            near = [i for i in range(len(others)) if found[i] > -_FAR]
            fitted, values = against(
                look.linear, look.view, best, [others[i] for i in near], self.contest.name_price
            )
            found[near] = np.nan_to_num(values, nan=-np.inf)
            for i, h in zip(near, fitted, strict=True):
                others[i] = h
        order = np.argsort(-found)
        close = [i for i in order if found[i] > -_CLEAR and places[i][1] is not None]
        close = close[: _MOST_CLOSE * len(terms)]
        for term in far:
            nearest = [i for i in order if places[i][0] == term and places[i][1] is not None]
            close += [i for i in nearest[:_MOST_CLOSE] if i not in close]
        if self._spent(best):
            # What seems better has to be seen, or no name would be sure.
            close = [i for i in close if found[i] > 0.0]
        rivals = self.contest.against([others[i] for i in close], best, FAIR)
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
                self.say(f"~ {described(top.hypothesis)} evidence {top.evidence:.1f}")
                selected.best = self._backward(self.contest.settled(top))
                return True
        return False
