"""What deserves a simulation: candidates to first order, the best along the motion, single terms.

What a candidate would do is read off along the measured motion (:mod:`responses`), structures of
several are searched to first order (:mod:`screen`), and the best are fitted along the motion with
their laws exact (:mod:`polish`). Where deviations are far from small, single terms are simulated at
all their starting sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.contest import FRONT, Contest
from pytest_twin.diagnosis.deepen import deepened
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.polish import Polished, polish
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.responses import (
    Linear,
    answered,
    bins,
    grid,
    linearized,
    simulated,
)
from pytest_twin.diagnosis.rivals import EARNS, Rival, described
from pytest_twin.diagnosis.screen import Answers, Lens, Search, View, candidates
from pytest_twin.diagnosis.sharpen import sharpened
from pytest_twin.diagnosis.tryout import Tryout
from pytest_twin.diagnosis.verdict import STANDS_OUT
from pytest_twin.effects.base import FloatArray

Say = Callable[[str], None]
# Structures kept at each size, terms added at once, structures of each size and of one term that
# are fitted along the motion, and iterations of that.
_WIDTH, _AT_ONCE, _OFFERED, _SINGLE, _POLISH = 10, 4, 2, 8, 3
# The same of those that are grown from fitted single terms.
_NARROW = 4
# Single terms are scanned by simulation where the mismatch is more floors than this and the best
# along the motion is no single term that leaves few; and how many of them are kept.
_FIRST_ORDER, _NEARLY, _SCANNED = 10.0, 3.0, 3
# With so many floors (an arm that falls, a command that is never followed) a size that is a tenth
# off may leave as much as none: laws of one parameter are scanned to their bounds where they have
# so many starting sizes. They and limits of drives are honed by so many sizes within these
# factors, one after the other.
_NEEDLES, _MANY, _NEIGHBOURS, _HONED = 1000.0, 6, 9, (1.25, 1.05)
# Joints whose drives are scanned for limits, and laws of them that are honed.
_LIMITED = 2


@dataclass(slots=True)
class Look:
    """A fit seen to first order.

    Attributes:
        linear: laws along the measured motion; None where candidates were simulated.
        view: what is left of the fit, and what may give way.
        answers: responses of the candidates.
        failed: candidates that were simulated and came to nothing.
    """

    linear: Linear | None
    view: View
    answers: Answers
    failed: frozenset[Term] = frozenset()

    def without(self, failed: set[Term]) -> Look:
        """What is left of it once some candidates have failed."""
        answers = Answers([r for r in self.answers.responses if r.term not in failed])
        return Look(self.linear, self.view, answers, self.failed | failed)


def look_ahead(problem: Problem, best: Rival) -> Look:
    """As :func:`look_around`, for what may be added.

    Behind a gear that was named the motor moves apart from the link, as a law that would be added
    moves it: where such a joint still stands above the floor, its candidates are simulated.
    """
    look = look_around(problem, best)
    joints = _behind_gears(best, look)
    if not joints or look.linear is None:
        return look
    near = [t for t in candidates(problem) if t.joint in joints and t not in best.hypothesis.terms]
    left = bins(problem, problem.fit).mean(best.fitted.residual)
    found = [r for r in look.answers.responses if r.term.joint not in joints]
    found += simulated(problem, near, problem.fit, best.hypothesis, left)
    return Look(None, view_of(problem, best, left), Answers(found))


def _behind_gears(best: Rival, look: Look) -> set[int]:
    """Joints whose gear was named and that still stand above the floor."""
    stands = np.mean(look.view.residual**2, axis=0) > (STANDS_OUT * look.view.floor) ** 2
    gears = {t.joint for t in best.hypothesis.terms if t.law.overrides("separates")}
    return {j for j in gears if stands[j]}


def look_around(problem: Problem, best: Rival) -> Look:
    """What is left around a fit, and what every candidate would do to it."""
    named = set(best.hypothesis.terms)
    terms = [t for t in candidates(problem) if t not in named]
    linear = linearized(problem, problem.fit, best.hypothesis)
    found, left = answered(
        linear, problem, terms, problem.fit, best.hypothesis, best.fitted.residual
    )
    view, answers = view_of(problem, best, left), Answers(found)
    if linear is not None and found:
        sharp = sharpened(linear, view, answers, best.hypothesis)
        answers = Answers([*found, *sharp]) if sharp else answers
    return Look(linear, view, answers)


def view_of(problem: Problem, best: Rival, left: FloatArray) -> View:
    """A fit whose (bins, signals) residual is ``left``."""
    binned = bins(problem, problem.fit)
    slope = binned.mean(best.fitted.jacobian)
    return View(left, slope, problem.signal_floor, binned.lengths)


@dataclass(slots=True)
class Foremost:
    """What is best along the motion.

    Attributes:
        starts: the few structures that are worth a simulation, best first.
        left: (signals,) mean square that the best leaves.
        singles: all those that add least.
    """

    starts: list[Hypothesis]
    left: FloatArray
    singles: list[Hypothesis]


def foremost(contest: Contest, best: Rival, look: Look, say: Say) -> Foremost | None:
    """The best structures along the motion, None without candidates.

    Args:
        contest: of the search.
        best: the fit at hand.
        look: at it.
        say: told what is considered.
    """
    if not look.answers.responses:
        return None
    whole = np.mean(contest.nominal.fitted.residual**2, axis=0)

    def search(width: int = _WIDTH, most: int = _AT_ONCE) -> Search:
        return Search(
            width, most, EARNS, lambda before, after: contest.worth_a_name(before, after, whole)
        )

    levels = search().levels(Lens(look.view, look.answers))
    if not levels:
        # No slope leads anywhere: what is simulated may all the same.
        return Foremost([], np.mean(look.view.residual**2, axis=0), [])
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
    if look.linear is None:
        fewest = min(len(h.terms) for h in starts)
        singles = [h for h in starts if len(h.terms) == fewest]
        return Foremost(starts, np.mean(chosen[0].residual ** 2, axis=0), singles)
    polished = polish(look.linear, look.view, starts, _POLISH)
    polished = _by_evidence(look.view, polished, contest.name_price)
    if _stands(look.view, polished[0]):
        more = deepened(
            look.view, look.answers, polished, best.hypothesis.terms,
            lambda: search(_NARROW, _AT_ONCE - 1),
        )  # fmt: skip
        polished += polish(look.linear, look.view, more, _POLISH)
    return _foremost(look.view, polished, best, contest.name_price, say)


def front(problem: Problem, best: Rival, look: Look, found: Foremost) -> list[Hypothesis]:
    """Structures that are worth a simulation: where small deviations say little, others too."""
    starts, left = found.starts, found.left
    if _bent(look, left, clear=bool(starts) and starts[0] in found.singles):
        scanned = _scanned(problem, best, look, found.singles, left)
    else:
        scanned = _yielding(problem, best, look, starts, left)
    alike = {h.terms for h in scanned}
    starts = [*(h for h in starts if h.terms not in alike), *scanned]
    tryout = Tryout(problem, best, left)
    if best.hypothesis.terms and starts:
        starts = _anchored(tryout, best, starts)
    if look.linear is None and starts:
        starts = _promising(tryout, starts)
    return starts


def _anchored(tryout: Tryout, best: Rival, starts: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Each as it came from along the motion, or what was named as it was fitted by simulation: the
    one that leaves less.
    """
    own = len(best.hypothesis.theta)
    kept = [h.with_theta(np.concatenate([best.hypothesis.theta, h.theta[own:]])) for h in starts]
    costs = tryout.costs([*starts, *kept])
    pairs = zip(starts, kept, costs[: len(starts)], costs[len(starts) :], strict=True)
    return [new if there > here else old for old, new, there, here in pairs]


def _promising(tryout: Tryout, starts: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Of those that add least and of the others, the few that leave least as they are.

    In contact every fit is one by simulation: ranked along the motion are the others.
    """
    fewest = min(len(h.terms) for h in starts)
    order = [starts[i] for i in np.argsort(tryout.costs(starts))]
    single = [h for h in order if len(h.terms) == fewest]
    several = [h for h in order if len(h.terms) > fewest]
    return single[:_SCANNED] + several[:_SCANNED]


def _by_evidence(view: View, polished: Sequence[Polished], name_price: float) -> list[Polished]:
    order = np.argsort(-np.nan_to_num(evidence_along(view, polished, name_price), nan=-np.inf))
    return [polished[i] for i in order]


def _stands(view: View, polished: Polished) -> bool:
    """Whether it leaves anything above the floor."""
    left = np.mean(polished.residual**2, axis=0)
    return bool((left > (STANDS_OUT * view.floor) ** 2).any())


def _foremost(
    view: View, polished: Sequence[Polished], best: Rival, name_price: float, say: Say
) -> Foremost:
    fewest = min(len(p.hypothesis.terms) for p in polished)
    evidence = evidence_along(view, polished, name_price)
    order = np.argsort(-evidence)
    for i in order:
        say(f"  along {described(polished[i].hypothesis)} evidence {evidence[i]:.1f}")
    front: list[int] = []
    for i in order:
        terms = set(polished[i].hypothesis.terms)
        # What only adds to another in front, and not enough, says nothing new.
        covered = any(
            terms > set(polished[k].hypothesis.terms) and evidence[i] < evidence[k] + EARNS
            for k in order
        )
        # Nor does another with one term in the place of one.
        new = terms - set(best.hypothesis.terms)
        alike = any(_alike(new, set(polished[k].hypothesis.terms)) for k in front)
        if np.isfinite(evidence[i]) and not covered and not alike:
            front.append(int(i))
    # What acts strongly is only roughly of first order: the best single terms are simulated.
    single = [i for i in front if len(polished[i].hypothesis.terms) == fewest]
    front = [*front[:FRONT], *(i for i in single[:2] if i not in front[:FRONT])]
    left: FloatArray = np.mean(polished[front[0]].residual ** 2, axis=0)
    hypotheses = [p.hypothesis for p in polished]
    singles = [h for h in hypotheses if len(h.terms) == fewest]
    return Foremost([hypotheses[i] for i in front], left, singles)


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
    problem: Problem, best: Rival, look: Look, singles: Sequence[Hypothesis], left: FloatArray
) -> list[Hypothesis]:
    """The best of what single terms do as they are and at all starting sizes, by simulation."""
    terms = [h.terms[-1] for h in singles]
    seen = {*terms, *best.hypothesis.terms}
    terms += [t for t in _gears(problem, look, left, _FIRST_ORDER) if t not in seen]
    rows = [best.hypothesis.with_term(t, start) for t in terms for start, _ in grid(t)]
    whole = np.mean(look.view.residual**2, axis=0)
    # Once, around the model as it came: they are many replays, and what is left later is less far.
    limits = [] if best.hypothesis.terms else _limits(problem, whole)
    limits = [t for t in limits if t not in seen and t not in look.failed]
    rows += [best.hypothesis.with_term(t, start) for t in limits for start, _ in grid(t)[::2]]
    rows += singles
    needles = bool((whole > (_NEEDLES * look.view.floor) ** 2).any())
    if needles:
        rows += [
            best.hypothesis.with_term(t, size) for t in [*terms, *limits] for size in _beyond(t)
        ]
    tryout = Tryout(problem, best, left)
    found = tryout.cheapest(rows)
    few = found[:_SCANNED]
    honed = [h for h in found if h.terms[-1] in limits][:_LIMITED]
    if needles:
        honed += [h for h in few if h.terms[-1] not in limits]
    for reach in _HONED:
        honed = tryout.cheapest([h for f in honed for h in _about(f, reach)])
    return tryout.cheapest([*few, *honed])[:_SCANNED]


def _beyond(term: Term) -> list[FloatArray]:
    """Sizes of a law with one parameter and many starting sizes, on from these to its bound."""
    (first, *more) = term.parameters
    if more or len(first.starts) < _MANY:
        return []
    ratio = first.starts[-1] / first.starts[-2]
    count = int(np.log(first.upper / first.starts[-1]) / np.log(ratio))
    return [np.array([first.starts[-1] * ratio ** (k + 1)]) for k in range(count)]


def _about(hypothesis: Hypothesis, reach: float) -> list[Hypothesis]:
    """A hypothesis, and where its last term has one parameter, its neighbours within a factor."""
    term = hypothesis.terms[-1]
    if len(term.parameters) > 1:
        return [hypothesis]
    (p,) = term.parameters
    out = []
    for factor in np.geomspace(1.0 / reach, reach, _NEIGHBOURS):
        theta = hypothesis.theta.copy()
        theta[-1] = np.clip(theta[-1] * factor, p.lower, p.upper)
        out.append(hypothesis.with_theta(theta))
    return out


def _limits(problem: Problem, whole: FloatArray) -> list[Term]:
    """Limits of the drives where most is to be explained: along the motion they are needles, and
    simulated they are not.
    """
    joints = len(problem.joints)
    floors = np.sqrt(whole[:joints]) / problem.floor
    most = [j for j in np.argsort(-floors)[:_LIMITED] if floors[j] > _FIRST_ORDER]
    return [
        t for t in candidates(problem)
        if t.joint in most and len(t.parameters) == 1 and len(t.parameters[0].starts) >= _MANY
    ]  # fmt: skip


def _gears(problem: Problem, look: Look, left: FloatArray, floors: float) -> list[Term]:
    """Transmissions that may give where more than so many floors are left: they read the measured
    motion back, and say along it little of what they do.
    """
    joints = len(problem.joints)
    far = left[:joints] > (floors * problem.floor) ** 2
    return [
        t for t in candidates(problem)
        if t.law.overrides("separates") and far[t.joint] and t not in look.failed
    ]  # fmt: skip


def _yielding(
    problem: Problem, best: Rival, look: Look, starts: Sequence[Hypothesis], left: FloatArray
) -> list[Hypothesis]:
    """The transmission that takes most off what stands above the floor by simulation, if any."""
    own = best.hypothesis.terms
    seen = {*own, *(h.terms[-1] for h in starts if len(h.terms) == len(own) + 1)}
    gears = [t for t in _gears(problem, look, left, STANDS_OUT) if t not in seen]
    rows = [best.hypothesis.with_term(t, start) for t in gears for start, _ in grid(t)]
    if not rows:
        return []
    bare, *costs = Tryout(problem, best, left).costs([best.hypothesis, *rows])
    least = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
    return [rows[least]] if costs[least] < bare else []


def _alike(new: set[Term], other: set[Term]) -> bool:
    """Whether one of several new terms is all that another structure lacks."""
    return len(new & other) > 1 and len(new - other) == 1


def evidence_along(view: View, polished: Sequence[Polished], name_price: float) -> FloatArray:
    """Log-likelihood less price of hypotheses along the measured motion, comparable."""
    effective = view.effective_of_best([p.residual for p in polished])
    return np.array(
        [
            view.worth(p.residual, effective, p.hypothesis.free)
            - name_price * len(p.hypothesis.terms)
            for p in polished
        ]
    )


def against(
    linear: Linear, view: View, best: Rival, others: Sequence[Hypothesis], name_price: float
) -> tuple[list[Hypothesis], FloatArray]:
    """Hypotheses fitted along the measured motion of ``best``, and their evidence over it."""
    polished = polish(linear, view, others, _POLISH)
    values = evidence_along(view, [Polished(best.hypothesis, view.residual), *polished], name_price)
    return [p.hypothesis for p in polished], values[1:] - values[0]
