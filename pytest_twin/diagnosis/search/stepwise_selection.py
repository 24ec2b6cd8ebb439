"""Stepwise selection of effects: forward, backward and by exchange.

Forward: structures of one and more effects are searched to first order around the best fit so far
(:mod:`linearized_shortlist`), and the most likely (:mod:`simulation_shortlist`) are fitted by
simulation (:mod:`model_comparison`). Backward: a term that no longer pays is dropped. Sideways:
each term is compared with its alternatives. Several terms at one joint are searched once more from
the strongest of them.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.deadline import OutOfTime
from pytest_twin.diagnosis.evidence import supported_by_windows
from pytest_twin.diagnosis.first_order.sensitivities import Linear, Sensitivity, linearize
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.refusal import refused
from pytest_twin.diagnosis.run import Run, Scored
from pytest_twin.diagnosis.search.drive_limits import doubtful_limits, limits_instead
from pytest_twin.diagnosis.search.linearized_shortlist import (
    LinearizedShortlist,
    fit_and_score_linearized,
    linearized_shortlist,
)
from pytest_twin.diagnosis.search.linearized_view import (
    LinearizedView,
    linearize_around,
    linearize_for_additions,
    residual_view,
)
from pytest_twin.diagnosis.search.model_comparison import FAIR, QUICK, ModelComparison
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors
from pytest_twin.diagnosis.search.scored_model import (
    Place,
    ScoredModel,
    SelectedModel,
    compare_below_floor,
    simplest_good_model,
)
from pytest_twin.diagnosis.search.settings import EXCHANGE, SELECTION
from pytest_twin.diagnosis.search.simplification import (
    equal_sized_forms,
    merge_joints,
    merge_terms,
    simpler_forms,
    special_cases,
    split_terms,
)
from pytest_twin.diagnosis.search.simulation_shortlist import simulation_shortlist
from pytest_twin.diagnosis.search.term_exchange import (
    TermExchange,
    better_as_addition,
    better_than_several,
    chance_gain,
    find_exchanges,
    simulated_evidence,
)
from pytest_twin.diagnosis.trace import Decision
from pytest_twin.diagnosis.verdict_settings import VERDICT


class StepwiseSelection:
    """One search over structures."""

    def __init__(
        self,
        problem: Problem,
        run: Run | None = None,
        share_left: float = 1.0,
        leave: Callable[[ScoredModel], bool] = lambda rival: False,
    ) -> None:
        """A search over all structures.

        Args:
            problem: what to explain.
            run: the diagnosis that the search belongs to.
            share_left: of the squared mismatch. Below 1 the search is a second look: given up where
                along the motion no structure leaves less, or where those in front fail.
            leave: asked of each fit with more terms, before a crowd is grown once more; whether the
                search ends there.
        """
        self.problem = problem
        self.diagnosis_run = Run() if run is None else run
        self.share_left = share_left
        self.leave = leave
        self.left_off = False
        self.attempts = SELECTION.attempts if share_left >= 1.0 else 1
        self.comparison = ModelComparison(problem, self.diagnosis_run)
        self.regrown: tuple[Term, ...] = ()
        self.nothing_to_add = False
        """Whether a finished search has found no effect to add to the starting model."""
        self._scored = self.comparison.nominal, 0.0
        self.shortlist: list[Hypothesis] = []
        """What is best along the motion at the fit at hand, while it is simulated."""
        self.first: tuple[Term, ...] | None = None
        self.last_look: LinearizedView | None = None
        self.known: dict[Term, list[Sensitivity]] = {}
        self.limits_known: set[Term] = set()
        self.lost: dict[tuple[Term, ...], float] = {}
        """Evidence of what the best fit was simulated without: its terms, over it."""

    def run(self, start: ScoredModel | None = None) -> SelectedModel:
        """Search forward, backward and sideways, from the nominal model or from a fit of it.

        Where time runs out, the best so far is the result.
        """
        nominal = self.comparison.nominal
        selected = SelectedModel(nominal, nominal, tried=self.comparison.tried)
        try:
            if start is not None:
                selected.best = start
                selected.best = self._backward(start)
            self._grow(selected)
            return selected if self.left_off else self._regrown(selected)
        except OutOfTime:
            with self.diagnosis_run.budget.reserved():
                selected.best = self._best_of_shortlist(selected.best)
            self._weigh_along(selected)
            self._end(selected.best)
            return selected

    def anew(self) -> StepwiseSelection:
        """Another search of the same problem, which may have changed."""
        return StepwiseSelection(self.problem, self.diagnosis_run, self.share_left)

    def _best_of_shortlist(self, best: ScoredModel) -> ScoredModel:
        """What was about to be simulated, as it was fitted along the motion, where that earns its
        name; else the best so far.
        """
        more = [h for h in self.shortlist if set(best.hypothesis.terms) < set(h.terms)]
        if not more:
            return best
        self.problem.refine_at(best.hypothesis)
        rivals = self.comparison.rivals(more[: SELECTION.hurried], self.comparison.weights(best), 0)
        self.comparison.judge(rivals, best)
        earning = [r for r in rivals if self._earns(r, best) and not self._strained(r)]
        if not earning:
            return best
        top = simplest_good_model(sorted(earning, key=lambda r: -r.evidence))
        self._step("addition", "accepted", "fitted to the linearized motion alone", top, best)
        return top

    def _weigh_along(self, selected: SelectedModel) -> None:
        """Compare effects with their alternatives along the motion alone, in the reserved time.

        None is sure then, and none is out: what was chosen by simulation keeps a share.
        """
        best, terms = selected.best, selected.best.hypothesis.terms
        contact = self.problem.simulator.models.contact.world.size
        if contact or all(t in selected.confidence for t in terms):
            return
        try:
            with self.diagnosis_run.budget.fitting():
                if best.fitted.jacobian.shape[2] != best.hypothesis.theta.size:
                    best = selected.best = self.comparison.scored_without_fit(
                        best.hypothesis, slopes=True
                    )
                self.problem.refine_at(best.hypothesis)
                look = linearize_around(self.problem, best)
                price = self.comparison.name_price
                found = find_exchanges(self.problem, best, look, self.known, price)
                selected.weigh(self._weighed(best, found, []))
        except OutOfTime:
            return
        for t in terms:
            along = selected.confidence[t]
            selected.confidence[t] = kept = float(
                np.clip(
                    along, 1.0 - SELECTION.linearized_confidence, SELECTION.linearized_confidence
                )
            )
            if kept > along:
                rest = (1.0 - kept) / (1.0 - along)
                selected.alternatives[t] = [(a, rest * c) for a, c in selected.alternatives[t]]

    def _end(self, best: ScoredModel) -> None:
        """Say that the search ended because time ran out."""
        stage = self.diagnosis_run.trace.stage
        self.diagnosis_run.skip(f"the search over {stage} (begun, not finished)")
        self._step("search", "ended", "the time is over", None, best)

    def _score(self, rival: ScoredModel) -> float:
        """Evidence over the nominal model."""
        known, score = self._scored
        if known is not rival:
            copy = replace(rival)
            self.comparison.judge([copy], self.comparison.nominal)
            score = copy.evidence
            self._scored = rival, score
        return score

    def _step(
        self,
        move: str,
        decision: Decision,
        reason: str,
        proposed: ScoredModel | None,
        best: ScoredModel,
    ) -> None:
        """Record a step; the evidence of a proposal is over ``best``."""
        score = self._score(best)
        self.diagnosis_run.step(
            self.problem, move, decision, reason,
            Scored()
            if proposed is None
            else Scored(proposed.hypothesis, score + proposed.evidence),
            Scored(best.hypothesis, score),
        )  # fmt: skip

    def _grow(self, selected: SelectedModel) -> None:
        """Add, drop and exchange terms until nothing is better."""
        for _ in range(SELECTION.rounds):
            best = selected.best
            better = self._limited_otherwise(best)
            if (
                better is None
                and len(best.hypothesis.terms) < SELECTION.most_terms
                and self.comparison.worth_a_search(best)
                and not self._spent(best)
                and not self.nothing_to_add
            ):
                better = self._forward(best)
                if better is not None and not self.regrown and self.leave(better):
                    selected.best, self.left_off = better, True
                    break
            if better is not None:
                selected.best = better
                selected.best = self._backward(better)
                if self._strained(selected.best):
                    break
            elif self._sideways(selected):
                self.nothing_to_add = False
            else:
                break

    def _limited_otherwise(self, best: ScoredModel) -> ScoredModel | None:
        """Another limit of a drive instead of the chosen one, if it is clearly better.

        Each limit is tested once.
        """
        limits = doubtful_limits(self.problem, best)
        new = [t for t in limits if t not in self.limits_known]
        self.limits_known.update(new)
        others = limits_instead(self.problem, best, new) if new else []
        if not others:
            return None
        top = max(self.comparison.against(others, best, FAIR), key=lambda r: r.evidence)
        if top.evidence <= SELECTION.clear:
            return None
        self._step("other limit", "accepted", f"it gains {top.evidence:.1f}", top, best)
        return self.comparison.settled(top)

    def _regrown(self, selected: SelectedModel) -> SelectedModel:
        """The result of a second search from the strongest term, if that is better.

        Several wrong terms at one joint may compensate for each other's errors, so that no exchange
        of a single one is better. They leave a residual above the noise floor.
        """
        best = selected.best
        terms = best.hypothesis.terms
        joints = [sum(t.joint in (j, -1) for t in terms) for j in range(len(self.problem.joints))]
        crowded = max(joints) >= SELECTION.crowd and self.comparison.worth_a_search(best)
        if not crowded or self._spent(best) or self._strained(best):
            return selected
        theta, place = best.hypothesis.theta, best.hypothesis.slice_of
        alone = [Hypothesis((t,), theta[place(t)]) for t in terms]
        rivals = self.comparison.rivals(alone, self.comparison.weights(best), FAIR)
        self.comparison.judge(rivals, selected.nominal)
        root = max(rivals, key=lambda r: r.evidence)
        if root.hypothesis.terms == self.first:
            return selected
        self.regrown = terms
        self._step(
            "restart", "started",
            "several effects at one joint leave a residual: the search starts again from the one "
            "that explains most alone", None, root,
        )  # fmt: skip
        other = SelectedModel(self.comparison.settled(root), selected.nominal, tried=selected.tried)
        self._grow(other)
        self.comparison.judge([other.best], best)
        better = other.best.evidence > 0.0
        self._step(
            "restart", "accepted" if better else "rejected",
            f"the restarted search scores {other.best.evidence:+.1f} against the first",
            other.best, best,
        )  # fmt: skip
        return other if better else selected

    def _strained(self, rival: ScoredModel) -> list[Term]:
        """Terms at a physical bound whose joint stays unexplained, and terms with values that are
        impossible or outside the range of the recordings: they compensate for another effect.
        """
        problem, hypothesis = self.problem, rival.hypothesis
        excluded = refused(problem, hypothesis)
        left = in_noise_floors(rival.fitted.residual, problem.signal_floor)[: len(problem.joints)]
        return [
            t for t in hypothesis.terms
            if t in excluded
            or problem.has_negative_mean_friction(hypothesis, t)
            or (
                hypothesis.at_bound(t)
                and (left.max() if t.joint < 0 else left[t.joint]) > VERDICT.left_floors
            )
        ]  # fmt: skip

    def _spent(self, best: ScoredModel) -> bool:
        return self.comparison.is_spent((*best.hypothesis.terms, *self.regrown))

    def _forward(self, best: ScoredModel) -> ScoredModel | None:
        """A better fit with more terms, if there is one.

        A law that depends on the motion (a softer drive, an elastic transmission) may explain the
        residual in the linearized motion and not in a simulation. Another may help most at its
        bound. Such terms are left out, and the search goes on.
        """
        look = self.last_look = linearize_for_additions(self.problem, best)
        for term in look.asked:
            self.known[term] = [r for r in look.answers.responses if r.term == term]
        for _ in range(self.attempts):
            rivals = [] if self._spent(best) else self._tried(best, look)
            if not rivals:
                break
            earning = [r for r in rivals if self._earns(r, best)]
            strained = {t for r in earning for t in self._strained(r)}
            sound = [r for r in earning if not strained & set(r.hypothesis.terms)]
            chosen = simplest_good_model(sound) if sound else None
            for r in rivals:
                if r is chosen:
                    why = f"it gains {r.evidence:.1f}, with the fewest effects of comparable sets"
                    self._step("addition", "accepted", why, r, best)
                else:
                    self._step("addition", "rejected", self._why_not(r, best, strained), r, best)
            if chosen is not None:
                self.first = self.first or chosen.hypothesis.terms
                return self.comparison.settled(chosen)
            tried = {t for r in rivals for t in r.hypothesis.terms}
            look = look.without(strained or tried - set(best.hypothesis.terms))
        self.problem.refine_at(best.hypothesis)
        return None

    def _why_not(self, rival: ScoredModel, best: ScoredModel, strained: set[Term]) -> str:
        """Why a set of effects is not chosen."""
        if rival.evidence < SELECTION.earns:
            return f"it gains {rival.evidence:.1f}; at least {SELECTION.earns:g} are needed"
        if self.comparison.has_held and rival.held_gain <= 0.0:
            return "it does not improve the prediction of the validation recordings"
        if not self._earns(rival, best):
            return "it removes too little of the remaining error"
        if strained & set(rival.hypothesis.terms):
            return "a parameter is at its physical bound, and the joint stays unexplained"
        return "another set gains as much with fewer effects or parameters, or more"

    def _tried(self, best: ScoredModel, look: LinearizedView) -> list[ScoredModel]:
        """The structures in front, simulated and fitted; by evidence over ``best``."""
        found = linearized_shortlist(self.comparison, best, look)
        if found is None or self._hopeless(found):
            return []
        starts, left = simulation_shortlist(self.problem, best, look, found), found.left
        if not starts:
            return []
        for h in starts:
            self.diagnosis_run.step(
                self.problem, "addition", "shortlisted",
                "among the best of the linearized comparison: simulated next", Scored(h),
                Scored(best.hypothesis),
            )  # fmt: skip
        # What the step costs differs between the nominal model and what explains the rest; of
        # that, the simplest is the least to be wrong.
        fewest = min(len(h.terms) for h in starts)
        simple = [h for h in starts if len(h.terms) == fewest]
        weights = self.problem.weights(left)
        self.shortlist = starts
        self.problem.refine_at(self.comparison.nearest(simple, weights))
        rivals = self.comparison.race(starts, weights, best)
        self.shortlist = []
        return rivals

    def _hopeless(self, found: LinearizedShortlist) -> bool:
        """Whether this is a second look, and even what is best along the motion leaves too much."""
        if self.share_left >= 1.0:
            return False
        floor = self.problem.signal_floor
        whole = self.comparison.nominal.fitted.mean_square
        share = float(np.sum(found.left / floor**2) / np.sum(whole / floor**2))
        return share > self.share_left

    def _backward(self, best: ScoredModel) -> ScoredModel:
        """Drop terms that do not pay, and laws that fewer or a simpler one equal; take a form that
        is better.

        What clearly pays along the motion is not simulated, gears apart: along it they say little.
        """
        while best.hypothesis.terms:
            self.lost = {}
            terms = best.hypothesis.terms
            fewer = [best.hypothesis.without(t) for t in terms] if len(terms) > 1 else []
            linear = linearize(self.problem, self.problem.fit, best.hypothesis)
            fewer += merge_terms(self.problem, best.hypothesis)
            fewer += simpler_forms(self.problem, best.hypothesis)
            if linear is not None:
                fewer += equal_sized_forms(best.hypothesis)
            grace = self._grace(best, linear)
            doubtful = self._unclear(best, linear, fewer, grace)
            doubtful += special_cases(self.problem, best.hypothesis)
            doubtful += split_terms(self.problem, best.hypothesis)
            rivals = self._of_the_robot(best)
            if not doubtful and not rivals:
                break
            # Where small deviations say nothing every doubt costs fits of its own: shorter ones.
            iterations = QUICK if linear is None else FAIR
            self.comparison.judge(rivals, best)
            rivals += self.comparison.against(doubtful, best, iterations)
            self.lost = {r.hypothesis.terms: r.evidence for r in rivals}
            top = max(rivals, key=lambda r: r.evidence + grace(r.hypothesis))
            if top.evidence + grace(top.hypothesis) < -SELECTION.earns / 2:
                why = f"without what it leaves out the score falls by {-top.evidence:.1f}"
                self._step("elimination", "rejected", why, top, best)
                break
            self._step(
                "elimination", "accepted",
                f"fewer effects or parameters cost only {max(-top.evidence, 0.0):.1f}", top, best,
            )  # fmt: skip
            best = self.comparison.settled(top)
        return best

    def _grace(self, best: ScoredModel, linear: Linear | None) -> Callable[[Hypothesis], float]:
        """Evidence by which a hypothesis may be behind that has one of the laws at hand in a form
        with fewer parameters, or a load in its place: what a simulator does not do quite as reality
        does, a form with more to it follows a little, and that grows with what the law does. One
        with as many has to be ahead. A law that ends at its bound is no cheaper name than its
        parts.
        """
        own, lost_of = best.hypothesis, dict[Term, float]()
        several = [t for t in own.terms if t.law.has_forms]
        if linear is not None and several:
            view = residual_view(self.problem, best, linear.residual(best.fitted.residual))
            gone = [own.without(t) for t in several]
            _, evidence = fit_and_score_linearized(
                linear, view, best, gone, self.comparison.name_price
            )
            lost = np.maximum(-np.nan_to_num(evidence), 0.0) * self.comparison.of_all
            lost_of = dict(zip(several, lost.tolist(), strict=True))

        def grace(other: Hypothesis) -> float:
            if other.terms == own.terms and other.free == own.free:
                return -SELECTION.other_form
            if len(other.terms) > len(own.terms):
                return self.comparison.name_price + SELECTION.even
            if len(other.terms) < len(own.terms) or other.free >= own.free:
                return 0.0
            changed = [lost for t, lost in lost_of.items() if not _as_it_is(t, own, other)]
            return EXCHANGE.general_ahead * max(changed, default=0.0)

        return grace

    def _unclear(
        self,
        best: ScoredModel,
        linear: Linear | None,
        others: Sequence[Hypothesis],
        grace: Callable[[Hypothesis], float],
    ) -> list[Hypothesis]:
        """Those that are not clearly worse along the motion, fitted there, and those without a gear
        of the fit at hand, of which that says little.
        """
        gears = {t for t in best.hypothesis.terms if t.law.is_elastic_transmission}
        told = [h for h in others if gears <= set(h.terms)]
        if linear is None or not told:
            return list(others)
        view = residual_view(self.problem, best, linear.residual(best.fitted.residual))
        fitted, evidence = fit_and_score_linearized(
            linear, view, best, told, self.comparison.name_price
        )
        untold = [h for h in others if not gears <= set(h.terms)]
        told = [h for h, e in zip(fitted, evidence, strict=True) if e + grace(h) > -SELECTION.clear]
        return untold + told

    def _of_the_robot(self, best: ScoredModel) -> list[ScoredModel]:
        """What is the whole robot's instead of the same at several joints, fitted; each with
        the error of the step as it is there, for their motions lie apart in time.
        """
        return [self._at_its_own(h, best) for h in merge_joints(self.problem, best.hypothesis)]

    def _at_its_own(self, start: Hypothesis, best: ScoredModel) -> ScoredModel:
        """A hypothesis fitted with the simulator's step corrected for itself, which then is for
        ``best`` again.
        """
        self.problem.refine_at(start)
        (rival,) = self.comparison.rivals([start], self.comparison.weights(best), FAIR)
        self.problem.refine_at(best.hypothesis)
        return rival

    def _simulated(
        self, best: ScoredModel, found: Sequence[TermExchange], beside: Container[Term | None]
    ) -> list[tuple[TermExchange, ScoredModel]]:
        """Exchanges that are fitted by simulation, with their evidence over ``best``: in each place
        the two with the most evidence, and those that the linearized motion does not judge.

        Once the simulations are spent, only those that seem better, and the best candidates instead
        of several effects, are fitted. Candidates that are better as an addition are not exchanged.
        """
        spent = self._spent(best)
        near, doubtful, behind = [], [], []
        for place in dict.fromkeys(x.gone for x in found):
            mine = [
                x for x in found
                if x.gone == place and x.new is not None
                and not (x.new in beside and x.evidence < 0.0)
            ]  # fmt: skip
            # Without several at least as much is lost as without the one that does most of it.
            bare = [x for x in found if x.new is None and set(x.gone) <= set(place)]
            lost = min((x.evidence for x in bare), default=0.0)
            least = min(-SELECTION.clear, SELECTION.hardly * lost)
            for x in sorted(mine, key=lambda x: -x.evidence)[: SELECTION.close]:
                if x.evidence > (0.0 if spent else least):
                    near.append(x)
                elif x.doubtful and (len(place) > 1 or not spent):
                    doubtful.append(x)
                elif len(place) > 1 and x.evidence > least:
                    behind.append(x)
        near += sorted(behind, key=lambda x: -x.evidence)[:1]
        rivals = self.comparison.rivals(
            [x.hypothesis for x in near], self.comparison.weights(best), FAIR
        )
        self.comparison.judge(rivals, best)
        rivals += self.comparison.against([x.hypothesis for x in doubtful], best, FAIR, QUICK)
        rivals = [self._on_its_own(r, best) for r in rivals]
        return list(zip([*near, *doubtful], rivals, strict=True))

    def _beside(self, best: ScoredModel, top: ScoredModel) -> ScoredModel:
        """What is better instead of one term, or better still beside it."""
        own, terms = best.hypothesis, top.hypothesis.terms
        gone = [t for t in own.terms if t not in terms]
        if len(gone) != 1 or len(terms) != len(own.terms):
            return top
        both = top.hypothesis.with_term_of(own, gone[0])
        beside = self._judged(both, self.comparison.weights(best), best)
        return beside if beside.evidence > top.evidence + SELECTION.earns else top

    def _added(
        self,
        best: ScoredModel,
        simulated: Sequence[tuple[TermExchange, ScoredModel]],
        beside: Iterable[tuple[Hypothesis, float]],
    ) -> ScoredModel | None:
        """What was clearly better along the motion, in a place and not once it was simulated, or
        beside everything, in addition to all that stands, if that earns its name: where the replays
        are spent, nobody else would add it.
        """
        claims = [
            (x.hypothesis.with_term_of(best.hypothesis, x.gone[0]), x.evidence)
            for x, _ in simulated
            if len(x.gone) == 1 and x.evidence > SELECTION.clear
        ]
        claims += [(h, evidence) for h, evidence in beside if evidence > SELECTION.clear]
        if not claims:
            return None
        claim, _ = max(claims, key=lambda each: each[1])
        # Weights as if it explained everything: those of the present residual would bind it to
        # other signals.
        weights = self.problem.weights(np.zeros_like(self.problem.signal_floor))
        rival = self._judged(claim, weights, best)
        return rival if self._earns(rival, best) else None

    def _judged(self, start: Hypothesis, weights: FloatArray, best: ScoredModel) -> ScoredModel:
        """A hypothesis fitted, and its evidence over ``best``."""
        (rival,) = self.comparison.rivals([start], weights, FAIR)
        self.comparison.judge([rival], best)
        return rival

    def _earns(self, rival: ScoredModel, best: ScoredModel) -> bool:
        """Whether what a rival has more than ``best`` earns its name."""
        comparison = self.comparison
        left = comparison.unseen(best)
        whole = comparison.mismatch(best, comparison.unseen(comparison.nominal), left)
        return (
            rival.evidence >= SELECTION.earns
            and (rival.held_gain > 0.0 or not comparison.has_held)
            and comparison.worth_a_name(left, comparison.unseen(rival), whole)
        )

    def _on_its_own(self, rival: ScoredModel, best: ScoredModel) -> ScoredModel:
        """A rival whose motion is not quite that of ``best``, with the simulator's step corrected
        for itself: what sets it back may be that error alone. Where it has fewer parameters, all of
        what sets it back.
        """
        least = 0.0 if rival.hypothesis.free < best.hypothesis.free else -SELECTION.clear
        if not -SELECTION.disputed < rival.evidence < least:
            return rival
        own = self._at_its_own(rival.hypothesis, best)
        self.comparison.judge([own], best)
        return max(rival, own, key=lambda r: r.evidence)

    def _sideways(self, selected: SelectedModel) -> bool:
        """Hold every term against the rivals in its place; True if one was better.

        Rivals that are far behind along the measured motion keep that evidence, where it can be
        trusted; the others are simulated.
        """
        best = selected.best
        if not best.hypothesis.terms:
            selected.weigh({})
            return False
        look = linearize_around(self.problem, best, self._known_around(best))
        price = self.comparison.name_price
        found = find_exchanges(self.problem, best, look, self.known, price)
        beside = better_as_addition(best, look, found, SELECTION.clear, price)
        found = [
            replace(x, evidence=x.evidence - beside[x.new][1]) if x.new in beside else x
            for x in found
        ]
        found = better_than_several(best, look, found, beside, price)
        simulated = self._simulated(best, found, beside)
        evidence = self._weighed(best, found, simulated)
        selected.weigh(evidence)
        better = [(x, r) for x, r in simulated if evidence[x.gone, x.new] > 1.0]
        top: ScoredModel | None = None
        if better:
            _, first = max(better, key=lambda each: evidence[each[0].gone, each[0].new])
            top = self._beside(best, first)
        elif beside or self._spent(best):
            top = self._added(best, simulated, beside.values())
        for x, r in simulated:
            if r is not top:
                e = evidence[x.gone, x.new]
                self._step("exchange", "rejected", f"it scores {e:+.1f} against the best", r, best)
        if top is None:
            return False
        self._step("exchange", "accepted", f"it gains {top.evidence:.1f}", top, best)
        back = self._backward(self.comparison.settled(top))
        if _alike(back.hypothesis, best.hypothesis):
            # Each is taken for the other: nobody knows which it is.
            stood = set(best.hypothesis.terms) - set(top.hypothesis.terms)
            came = set(top.hypothesis.terms) - set(best.hypothesis.terms)
            selected.weigh({
                (gone, new): min(e, 0.0) if new in came and set(gone) <= stood else e
                for (gone, new), e in evidence.items()
            })  # fmt: skip
            return False
        selected.best = back
        return True

    def _known_around(self, best: ScoredModel) -> LinearizedView | None:
        """The last linearization, if it holds around this fit.

        It does not if it was made at another fit and the residual is small: non-linear laws then
        need a linearization at this fit.
        """
        look = self.last_look
        most = float(np.sqrt(np.max(best.left / self.problem.signal_floor**2)))
        elsewhere = look is not None and look.around is not best
        return None if elsewhere and VERDICT.at_floor < most <= VERDICT.left_floors else look

    def _weighed(
        self,
        best: ScoredModel,
        found: Sequence[TermExchange],
        simulated: Sequence[tuple[TermExchange, ScoredModel]],
    ) -> dict[Place, float]:
        """Evidence of each in its place over ``best``, less what chance gives it; of what was
        simulated without something else in its place, that; of two that explain as much, more for
        the one that leaves less under the floor.
        """
        lost = self._lost(best, found, [x for x, _ in simulated])
        chance = chance_gain(best.hypothesis, found, self.comparison.of_all, lost)
        borne = [(x, self._borne_out(r, best)) for x, r in simulated]
        evidence = simulated_evidence(found, borne)
        evidence = {place: e - chance[place] for place, e in evidence.items()}
        lone = best.hypothesis.terms if len(best.hypothesis.terms) == 1 else None
        for x in found:
            without = best.hypothesis.without(*x.gone).terms
            if x.new is None and without in self.lost:
                evidence[x.gone, None] = self.lost[without]
            elif x.new is None and x.gone == lone:
                bare = replace(self.comparison.nominal)
                self.comparison.judge([bare], best)
                evidence[x.gone, None] = bare.evidence
        for (x, r), (_, e) in zip(simulated, borne, strict=True):
            alike = len(x.gone) == 1 and not x.is_generalization and not x.is_special_case
            if not alike or abs(e) >= SELECTION.even:
                continue
            less = compare_below_floor(r, best, self.problem.signal_floor)
            if less:
                evidence[x.gone, x.new] = e + SELECTION.even * less
        return evidence

    def _borne_out(self, rival: ScoredModel, best: ScoredModel) -> float:
        """Evidence of a rival over ``best``, no more of it than most windows bear out where dry
        friction decides in each how a joint leaves a turn.
        """
        problem = self.problem
        if not problem.position_weights:
            return rival.evidence
        mine, others = (np.concatenate([r.fitted.residual, r.held_residual]) for r in (rival, best))
        lengths = [*problem.lengths(problem.fit), *problem.lengths(problem.held_out)]
        most = supported_by_windows(mine, others, lengths, problem.signal_floor)
        return float(np.clip(rival.evidence, -most, most))

    def _lost(
        self, best: ScoredModel, found: Sequence[TermExchange], near: Sequence[TermExchange]
    ) -> dict[tuple[Term, ...], float]:
        """Evidence that is lost, simulated, without each single term that has a near rival of more
        or fewer parameters.
        """
        own = best.hypothesis
        places = {x.gone for x in near if len(x.gone) == 1 and x.hypothesis.free != own.free}
        bare = [x for x in found if x.new is None and x.gone in places]
        if not bare:
            return {}
        rivals = self.comparison.rivals(
            [x.hypothesis for x in bare], self.comparison.weights(best), 0
        )
        self.comparison.judge(rivals, best)
        return {x.gone: max(-r.evidence, 0.0) for x, r in zip(bare, rivals, strict=True)}


def _alike(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two have the same terms in the same forms."""
    same = set(one.terms) == set(other.terms)
    return same and all(_as_it_is(t, one, other) for t in one.terms)


def _as_it_is(term: Term, own: Hypothesis, other: Hypothesis) -> bool:
    """Whether another hypothesis has a term in the form that it has here."""
    if term not in other.terms:
        return False
    here, there = own.theta[own.slice_of(term)], other.theta[other.slice_of(term)]
    return bool(np.array_equal(term.movable(here), term.movable(there)))
