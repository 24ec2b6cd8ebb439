"""What is best along the measured motion, nothing of it simulated.

Structures of several candidates are searched to first order (:mod:`screen`), the best are fitted
along the motion with their laws exact (:mod:`polish`), and grown once more from the best single
terms as they were fitted (:mod:`deepen`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.deepen import deepened
from pytest_twin.diagnosis.first_order.polish import FAR_OFF, NEARBY, Polished, polish
from pytest_twin.diagnosis.first_order.responses import Linear
from pytest_twin.diagnosis.first_order.screen import Lens, Search, View
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.search.contest import FRONT, Contest
from pytest_twin.diagnosis.search.look import Look
from pytest_twin.diagnosis.search.rivals import EARNS, Rival
from pytest_twin.diagnosis.verdict import STANDS_OUT

# Structures kept at each size, terms added at once, structures of each size and of one term that
# are fitted along the motion.
_WIDTH, _AT_ONCE, _OFFERED, _SINGLE = 10, 4, 2, 8
# Structures kept at each size of those that are grown from fitted single terms.
_NARROW = 4


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


def foremost(contest: Contest, best: Rival, look: Look) -> Foremost | None:
    """The best structures along the motion, None without candidates.

    Args:
        contest: of the search.
        best: the fit at hand.
        look: at it.
    """
    if not look.answers.responses:
        return None
    whole = _whole(contest, best)
    cores = contest.problem.simulator.threads

    def search(width: int = _WIDTH, most: int = _AT_ONCE) -> Search:
        return Search(
            width,
            most,
            EARNS,
            lambda before, after: contest.worth_a_name(before, after, whole),
            cores,
        )

    levels = search().levels(Lens(look.view, look.answers))
    if not levels:
        # No slope leads anywhere: what is simulated may all the same.
        return Foremost([], look.view.mean_square, [])
    # Shapes of single terms are known as well as their grids are: more of them get a chance.
    chosen = [
        structure
        for level in reversed(levels)
        for structure in level[: _OFFERED if level is not levels[0] else _SINGLE]
    ]
    starts = [best.hypothesis.with_terms(structure.starts) for structure in chosen]
    if look.linear is None:
        singles = [h for h in starts if h.more_terms(best.hypothesis) == 1]
        return Foremost(starts, np.mean(chosen[0].residual ** 2, axis=0), singles)
    polished = polish(look.linear, look.view, starts, NEARBY)
    polished = _by_evidence(look.view, polished, contest.name_price)
    left = np.mean(polished[0].residual ** 2, axis=0)
    if look.view.above(left, STANDS_OUT).any():
        more = deepened(
            look.view, look.answers, polished, best.hypothesis,
            lambda: search(_NARROW, _AT_ONCE - 1), cores,
        )  # fmt: skip
        polished += polish(look.linear, look.view, more, NEARBY)
    return _foremost(look.view, polished, best, contest.name_price)


def _whole(contest: Contest, best: Rival) -> FloatArray:
    """(signals,) mean square that the model as it came left of what is fitted; less where what no
    fit has seen keeps a greater share of its own: there a name counts for more.
    """
    floor = contest.problem.signal_floor**2
    whole = contest.nominal.fitted.mean_square
    kept = (best.fitted.mean_square + floor) / (whole + floor)
    unseen = (contest.unseen(best) + floor) / (contest.unseen(contest.nominal) + floor)
    whole = contest.mismatch(best, whole, best.fitted.mean_square)
    less: FloatArray = whole * np.minimum(kept / unseen, 1.0)
    return less


def _by_evidence(view: View, polished: Sequence[Polished], name_price: float) -> list[Polished]:
    order = np.argsort(-np.nan_to_num(evidence_along(view, polished, name_price), nan=-np.inf))
    return [polished[i] for i in order]


def _foremost(view: View, polished: Sequence[Polished], best: Rival, name_price: float) -> Foremost:
    evidence = evidence_along(view, polished, name_price)
    order = np.argsort(-evidence)
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
    hypotheses = [p.hypothesis for p in polished]
    singles = [h for h in hypotheses if h.more_terms(best.hypothesis) == 1]
    alone = [i for i in front if hypotheses[i].more_terms(best.hypothesis) == 1]
    front = [*front[:FRONT], *(i for i in alone[:2] if i not in front[:FRONT])]
    left: FloatArray = np.mean(polished[front[0]].residual ** 2, axis=0)
    return Foremost([hypotheses[i] for i in front], left, singles)


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
    linear: Linear,
    view: View,
    best: Rival,
    others: Sequence[Hypothesis],
    name_price: float,
) -> tuple[list[Hypothesis], FloatArray]:
    """Hypotheses fitted along the measured motion of ``best``, and their evidence over it."""
    polished = polish(linear, view, others, FAR_OFF)
    values = evidence_along(view, [Polished(best.hypothesis, view.residual), *polished], name_price)
    return [p.hypothesis for p in polished], values[1:] - values[0]
