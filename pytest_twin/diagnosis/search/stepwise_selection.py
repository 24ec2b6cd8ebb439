"""Stepwise selection of effects: forward, backward and by exchange.

Forward: sets of effects are searched in the linearized motion around the best fit so far
(:mod:`linearized_shortlist`); the most likely (:mod:`simulation_shortlist`) are fitted by
simulation (:mod:`model_comparison`). Backward: terms that do not pay their penalty are removed.
Exchange: each term is compared with its alternatives (:mod:`term_exchange`). If several terms at
one joint leave a residual, the search is repeated from the strongest of them.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.deadline import OutOfTime
from pytest_twin.diagnosis.evidence import supported_by_windows
from pytest_twin.diagnosis.first_order.sensitivities import Linear, Sensitivity, linearize
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused
from pytest_twin.diagnosis.run import Run, Scored
from pytest_twin.diagnosis.search.drive_limits import doubtful_limits, limits_instead
from pytest_twin.diagnosis.search.linearized_shortlist import (
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
    """One search over sets of effects.

    Attributes:
        comparison: fits and scores the models.
        has_left_off: whether the search ended because ``leave`` was true.
        has_nothing_to_add: whether a finished search found no effect to add to the start.
        shortlist: models to be fitted next, best first; empty while none is.
        first: terms of the first accepted model.
        restarted_from: terms from which the search was restarted.
        last_linearization: of the last step forward.
        known_sensitivities: term -> sensitivities of the last step forward.
        tested_limits: limits of drives that were compared with others.
        simulated_losses: terms of a model -> its evidence relative to the best fit.
    """

    def __init__(
        self,
        problem: Problem,
        run: Run | None = None,
        share_left: float = 1.0,
        leave: Callable[[ScoredModel], bool] = lambda rival: False,
    ) -> None:
        """Set up a search over all sets of effects.

        Args:
            problem: the problem.
            run: the running diagnosis.
            share_left: largest share of the nominal squared error that may remain. Below 1, the
                nominal model is kept if no set leaves less in the linearized motion.
            leave: whether the search ends at a model; called after each addition until a restart.
        """
        self.problem = problem
        self.diagnosis_run = Run() if run is None else run
        self.share_left = share_left
        self.leave = leave
        self.has_left_off = False
        self.comparison = ModelComparison(problem, self.diagnosis_run)
        self.restarted_from: tuple[Term, ...] = ()
        self.has_nothing_to_add = False
        self._scored = self.comparison.nominal, 0.0
        self.shortlist: list[Hypothesis] = []
        self.first: tuple[Term, ...] | None = None
        self.last_linearization: LinearizedView | None = None
        self.known_sensitivities: dict[Term, list[Sensitivity]] = {}
        self.tested_limits: set[Term] = set()
        self.simulated_losses: dict[tuple[Term, ...], float] = {}

    @cached_property
    def recorded(self) -> RecordedRange:
        """Ranges of the recordings."""
        return RecordedRange.of(self.problem)

    def run(self, start: ScoredModel | None = None) -> SelectedModel:
        """Search from a fit, or from the nominal model; if time runs out, the best so far."""
        nominal = self.comparison.nominal
        selected = SelectedModel(nominal, nominal, tried=self.comparison.tried)
        try:
            if start is not None:
                selected.best = start
                selected.best = self.eliminate(start)
            self._grow(selected)
            return selected if self.has_left_off else self._restarted(selected)
        except OutOfTime:
            with self.diagnosis_run.budget.reserved():
                selected.best = self._best_of_shortlist(selected.best)
            self._weigh_linearized(selected)
            self._record_end(selected.best)
            return selected

    def another_search(self) -> StepwiseSelection:
        """A new search of the same problem, whose noise floor may have changed."""
        return StepwiseSelection(self.problem, self.diagnosis_run, self.share_left)

    def _best_of_shortlist(self, best: ScoredModel) -> ScoredModel:
        """The best model of the shortlist, without a fit by simulation, if its evidence is enough.

        Else the best model so far. It is used when time runs out.
        """
        more = [h for h in self.shortlist if set(best.hypothesis.terms) < set(h.terms)]
        if not more:
            return best
        self.problem.refine_at(best.hypothesis)
        rivals = self.comparison.rivals(more[: SELECTION.hurried], self.comparison.weights(best), 0)
        self.comparison.judge(rivals, best)
        earning = [r for r in rivals if self._earns(r, best) and not self._implausible_terms(r)]
        if not earning:
            return best
        top = simplest_good_model(sorted(earning, key=lambda r: -r.evidence))
        self._step("addition", "accepted", "fitted to the linearized motion alone", top, best)
        return top

    def _weigh_linearized(self, selected: SelectedModel) -> None:
        """Set confidences from the linearized comparison alone, in the reserved time.

        They are limited at both ends, because no alternative was simulated.
        """
        best, terms = selected.best, selected.best.hypothesis.terms
        contact = self.problem.simulator.models.contact.world.size
        if contact or all(t in selected.confidence for t in terms):
            return
        try:
            with self.diagnosis_run.budget.fitting():
                if best.fitted.jacobian.shape[2] != best.hypothesis.theta.size:
                    best = selected.best = self.comparison.score_without_fit(
                        best.hypothesis, slopes=True
                    )
                self.problem.refine_at(best.hypothesis)
                linearized = linearize_around(self.problem, best)
                price = self.comparison.penalty_per_effect
                found = [
                    x
                    for x in find_exchanges(
                        self.problem, best, linearized, self.known_sensitivities, price
                    )
                    # Only a simulation can compare an elastic transmission with other effects.
                    if x.new is None or not x.new.law.is_elastic_transmission
                ]
                selected.weigh(self.evidence_of_exchanges(best, found, []))
        except OutOfTime:
            return
        selected.not_simulated = frozenset(terms)
        for t in terms:
            linearized_share = selected.confidence[t]
            selected.confidence[t] = kept = float(
                np.clip(linearized_share, SELECTION.linearized_least, SELECTION.linearized_most)
            )
            if kept > linearized_share:
                rest = (1.0 - kept) / (1.0 - linearized_share)
                selected.alternatives[t] = [(a, rest * c) for a, c in selected.alternatives[t]]

    def _record_end(self, best: ScoredModel) -> None:
        """Record that the search ended because time ran out."""
        stage = self.diagnosis_run.trace.stage
        self.diagnosis_run.skip(f"the search over {stage} (begun, not finished)")
        self._step("search", "ended", "the time is over", None, best)

    def _score(self, rival: ScoredModel) -> float:
        """Evidence of a model relative to the nominal model."""
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
        """Record a step; the evidence of ``proposed`` is relative to ``best``."""
        score = self._score(best)
        self.diagnosis_run.step(
            self.problem, move, decision, reason,
            Scored()
            if proposed is None
            else Scored(proposed.hypothesis, score + proposed.evidence),
            Scored(best.hypothesis, score),
        )  # fmt: skip

    def _grow(self, selected: SelectedModel) -> None:
        """Add, remove and exchange terms until no change is better."""
        for _ in range(SELECTION.rounds):
            best = selected.best
            better = self.exchange_limits(best)
            if (
                better is None
                and len(best.hypothesis.terms) < SELECTION.most_terms
                and self.comparison.has_residual_to_explain(best)
                and not self._is_spent(best)
                and not self.has_nothing_to_add
            ):
                better = self.add_terms(best)
                if better is not None and not self.restarted_from and self.leave(better):
                    selected.best, self.has_left_off = better, True
                    break
            if better is not None:
                selected.best = better
                selected.best = self.eliminate(better)
                if self._implausible_terms(selected.best):
                    break
            elif self.exchange_terms(selected):
                self.has_nothing_to_add = False
            else:
                break

    def exchange_limits(self, best: ScoredModel) -> ScoredModel | None:
        """Another limit of a drive instead of the chosen one, if it is clearly better.

        Each limit is tested once.
        """
        limits = doubtful_limits(self.problem, best)
        new = [t for t in limits if t not in self.tested_limits]
        self.tested_limits.update(new)
        others = limits_instead(self.problem, best, new) if new else []
        if not others:
            return None
        top = max(self.comparison.score_against(others, best, FAIR), key=lambda r: r.evidence)
        if top.evidence <= SELECTION.clear:
            return None
        self._step("other limit", "accepted", f"it gains {top.evidence:.1f}", top, best)
        return self.comparison.fit_to_convergence(top)

    def _restarted(self, selected: SelectedModel) -> SelectedModel:
        """The result of a second search from the strongest term, if that is better.

        Several wrong terms at one joint may compensate for each other's errors, so that no exchange
        of a single one is better. They leave a residual above the noise floor.
        """
        best = selected.best
        terms = best.hypothesis.terms
        joints = [sum(t.joint in (j, -1) for t in terms) for j in range(len(self.problem.joints))]
        crowded = max(joints) >= SELECTION.crowd and self.comparison.has_residual_to_explain(best)
        if not crowded or self._is_spent(best) or self._implausible_terms(best):
            return selected
        theta, place = best.hypothesis.theta, best.hypothesis.slice_of
        alone = [Hypothesis((t,), theta[place(t)]) for t in terms]
        rivals = self.comparison.rivals(alone, self.comparison.weights(best), FAIR)
        self.comparison.judge(rivals, selected.nominal)
        root = max(rivals, key=lambda r: r.evidence)
        if root.hypothesis.terms == self.first:
            return selected
        self.restarted_from = terms
        self._step(
            "restart", "started",
            "several effects at one joint leave a residual: the search starts again from the one "
            "that explains most alone", None, root,
        )  # fmt: skip
        other = SelectedModel(
            self.comparison.fit_to_convergence(root), selected.nominal, tried=selected.tried
        )
        self._grow(other)
        self.comparison.judge([other.best], best)
        better = other.best.evidence > 0.0
        self._step(
            "restart", "accepted" if better else "rejected",
            f"the restarted search scores {other.best.evidence:+.1f} against the first",
            other.best, best,
        )  # fmt: skip
        return other if better else selected

    def _implausible_terms(self, rival: ScoredModel) -> list[Term]:
        """Terms that compensate for another effect.

        They are at a physical bound while their joint stays unexplained, or their values are
        impossible or outside the range of the recordings.
        """
        problem, hypothesis = self.problem, rival.hypothesis
        excluded = refused(problem, hypothesis, self.recorded)
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

    def _is_spent(self, best: ScoredModel) -> bool:
        """Whether the search has used its simulations."""
        return self.comparison.is_spent((*best.hypothesis.terms, *self.restarted_from))

    def add_terms(self, best: ScoredModel) -> ScoredModel | None:
        """A better fit with more terms; None if there is none.

        A law that changes the motion strongly (a softer drive, an elastic transmission) may explain
        the residual in the linearized motion only. Another may gain most at its bound. Such terms
        are left out of the next shortlist.
        """
        linearized = self.last_linearization = linearize_for_additions(self.problem, best)
        for term in linearized.evaluated:
            self.known_sensitivities[term] = [
                r for r in linearized.candidate_sensitivities.responses if r.term == term
            ]
        for _ in range(SELECTION.attempts):
            rivals = [] if self._is_spent(best) else self.simulated_shortlist(best, linearized)
            if not rivals:
                break
            earning = [r for r in rivals if self._earns(r, best)]
            implausible = {t for r in earning for t in self._implausible_terms(r)}
            sound = [r for r in earning if not implausible & set(r.hypothesis.terms)]
            chosen = simplest_good_model(sound) if sound else None
            for r in rivals:
                if r is chosen:
                    why = f"it gains {r.evidence:.1f}, with the fewest effects of comparable sets"
                    self._step("addition", "accepted", why, r, best)
                else:
                    self._step(
                        "addition",
                        "rejected",
                        self._reason_of_rejection(r, best, implausible),
                        r,
                        best,
                    )
            if chosen is not None:
                self.first = self.first or chosen.hypothesis.terms
                return self.comparison.fit_to_convergence(chosen)
            tried = {t for r in rivals for t in r.hypothesis.terms}
            linearized = linearized.without(implausible or tried - set(best.hypothesis.terms))
        self.problem.refine_at(best.hypothesis)
        return None

    def _reason_of_rejection(
        self, rival: ScoredModel, best: ScoredModel, implausible: set[Term]
    ) -> str:
        """The reason why a model is rejected."""
        if rival.evidence < SELECTION.earns:
            return f"it gains {rival.evidence:.1f}; at least {SELECTION.earns:g} are needed"
        if self.comparison.has_validation and rival.held_gain <= 0.0:
            return "it does not improve the prediction of the validation recordings"
        if not self._earns(rival, best):
            return "it removes too little of the remaining error"
        if implausible & set(rival.hypothesis.terms):
            return "a parameter is at its physical bound, and the joint stays unexplained"
        return "another set gains as much with fewer effects or parameters, or more"

    def simulated_shortlist(
        self, best: ScoredModel, linearized: LinearizedView
    ) -> list[ScoredModel]:
        """Models of the shortlist, fitted by simulation; the largest evidence is first."""
        found = linearized_shortlist(self.comparison, best, linearized)
        if found is None:
            return []
        starts, left = simulation_shortlist(self.problem, best, linearized, found), found.left
        if not starts:
            return []
        for h in starts:
            self.diagnosis_run.step(
                self.problem, "addition", "shortlisted",
                "among the best of the linearized comparison: simulated next", Scored(h),
                Scored(best.hypothesis),
            )  # fmt: skip
        # The discretization error is that of the best of the simplest models: it differs from that
        # of the nominal model, and the simplest ones are the least likely to be wrong.
        fewest = min(len(h.terms) for h in starts)
        simple = [h for h in starts if len(h.terms) == fewest]
        weights = self.problem.weights(left)
        self.shortlist = starts
        self.problem.refine_at(self.comparison.least_residual(simple, weights))
        rivals = self.comparison.race(starts, weights, best)
        self.shortlist = []
        return rivals

    def can_explain_enough(self) -> bool:
        """Whether some set leaves at most ``share_left`` of the error in the linearized motion."""
        if self.share_left >= 1.0:
            return True
        nominal = self.comparison.nominal
        try:
            linearized = linearize_for_additions(self.problem, nominal)
            found = linearized_shortlist(self.comparison, nominal, linearized)
        except OutOfTime:
            return False
        if found is None:
            return False
        floor = self.problem.signal_floor
        whole = nominal.fitted.mean_square
        return float(np.sum(found.left / floor**2)) <= self.share_left * float(
            np.sum(whole / floor**2)
        )

    def eliminate(self, best: ScoredModel) -> ScoredModel:
        """The best fit after backward elimination.

        Terms that do not pay their penalty are removed. Laws are merged, or replaced by special
        cases and simpler forms that explain as much. A simplification that clearly loses in the
        linearized motion is not simulated, except that of an elastic transmission.
        """
        while best.hypothesis.terms:
            self.simulated_losses = {}
            terms = best.hypothesis.terms
            fewer = [best.hypothesis.without(t) for t in terms] if len(terms) > 1 else []
            linear = linearize(self.problem, self.problem.fit, best.hypothesis)
            fewer += merge_terms(self.problem, best.hypothesis)
            fewer += simpler_forms(self.problem, best.hypothesis)
            if linear is not None:
                fewer += equal_sized_forms(best.hypothesis)
            tolerance = self.tolerances(best, linear)
            doubtful = self.undecided(best, linear, fewer, tolerance)
            doubtful += special_cases(self.problem, best.hypothesis)
            doubtful += split_terms(self.problem, best.hypothesis)
            rivals = self._merged_over_joints(best)
            if not doubtful and not rivals:
                break
            # In contact each simplification is fitted by simulation, so the fits are shorter.
            iterations = QUICK if linear is None else FAIR
            self.comparison.judge(rivals, best)
            rivals += self.comparison.score_against(doubtful, best, iterations)
            self.simulated_losses = {r.hypothesis.terms: r.evidence for r in rivals}
            top = max(rivals, key=lambda r: r.evidence + tolerance(r.hypothesis))
            if top.evidence + tolerance(top.hypothesis) < -SELECTION.earns / 2:
                why = f"without what it leaves out the score falls by {-top.evidence:.1f}"
                self._step("elimination", "rejected", why, top, best)
                break
            self._step(
                "elimination", "accepted",
                f"fewer effects or parameters cost only {max(-top.evidence, 0.0):.1f}", top, best,
            )  # fmt: skip
            best = self.comparison.fit_to_convergence(top)
        return best

    def tolerances(self, best: ScoredModel, linear: Linear | None) -> Callable[[Hypothesis], float]:
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
            removed = [own.without(t) for t in several]
            _, evidence = fit_and_score_linearized(
                linear, view, best, removed, self.comparison.penalty_per_effect
            )
            lost = np.maximum(-np.nan_to_num(evidence), 0.0) * self.comparison.sample_ratio
            lost_of = dict(zip(several, lost.tolist(), strict=True))

        def tolerance(other: Hypothesis) -> float:
            if other.terms == own.terms and other.free == own.free:
                return -SELECTION.other_form
            if len(other.terms) > len(own.terms):
                return self.comparison.penalty_per_effect + SELECTION.even
            if len(other.terms) < len(own.terms) or other.free >= own.free:
                return 0.0
            changed = [lost for t, lost in lost_of.items() if not _has_same_form(t, own, other)]
            return EXCHANGE.general_ahead * max(changed, default=0.0)

        return tolerance

    def undecided(
        self,
        best: ScoredModel,
        linear: Linear | None,
        others: Sequence[Hypothesis],
        tolerance: Callable[[Hypothesis], float],
    ) -> list[Hypothesis]:
        """Simplifications that the linearized motion does not clearly reject, with its parameters.

        Those that remove an elastic transmission are always among them.
        """
        gears = {t for t in best.hypothesis.terms if t.law.is_elastic_transmission}
        told = [h for h in others if gears <= set(h.terms)]
        if linear is None or not told:
            return list(others)
        view = residual_view(self.problem, best, linear.residual(best.fitted.residual))
        fitted, evidence = fit_and_score_linearized(
            linear, view, best, told, self.comparison.penalty_per_effect
        )
        untold = [h for h in others if not gears <= set(h.terms)]
        told = [
            h for h, e in zip(fitted, evidence, strict=True) if e + tolerance(h) > -SELECTION.clear
        ]
        return untold + told

    def _merged_over_joints(self, best: ScoredModel) -> list[ScoredModel]:
        """Models with one effect of the robot instead of effects at several joints, fitted.

        Each has its own discretization error, because a shift in time changes it.
        """
        return [
            self.fit_with_own_correction(h, best)
            for h in merge_joints(self.problem, best.hypothesis)
        ]

    def fit_with_own_correction(self, start: Hypothesis, best: ScoredModel) -> ScoredModel:
        """A hypothesis, fitted with the discretization error at its own parameters.

        The problem then has that of ``best`` again.
        """
        self.problem.refine_at(start)
        (rival,) = self.comparison.rivals([start], self.comparison.weights(best), FAIR)
        self.problem.refine_at(best.hypothesis)
        return rival

    def simulated_exchanges(
        self, best: ScoredModel, found: Sequence[TermExchange], additions: Container[Term | None]
    ) -> list[tuple[TermExchange, ScoredModel]]:
        """Exchanges that are fitted by simulation, with models scored against ``best``.

        For each removed set these are the exchanges with the largest evidence, and those that the
        linearized motion does not judge. When the simulations are used up, only exchanges that seem
        better, and the best candidate instead of several terms, are fitted.

        Args:
            best: the present fit.
            found: exchanges with their linearized evidence.
            additions: candidates that are better as an addition; they are not exchanged.
        """
        spent = self._is_spent(best)
        near, doubtful, behind = [], [], []
        for place in dict.fromkeys(x.removed for x in found):
            mine = [
                x for x in found
                if x.removed == place and x.new is not None
                and not (x.new in additions and x.evidence < 0.0)
            ]  # fmt: skip
            # Removing several terms loses at least as much as removing the strongest of them.
            bare = [x for x in found if x.new is None and set(x.removed) <= set(place)]
            lost = min((x.evidence for x in bare), default=0.0)
            least = min(-SELECTION.clear, SELECTION.hardly * lost)
            for x in sorted(mine, key=lambda x: -x.evidence)[: SELECTION.close]:
                if x.evidence > (0.0 if spent else least):
                    near.append(x)
                elif x.is_doubtful and (len(place) > 1 or not spent):
                    doubtful.append(x)
                elif len(place) > 1 and x.evidence > least:
                    behind.append(x)
        near += sorted(behind, key=lambda x: -x.evidence)[:1]
        rivals = self.comparison.rivals(
            [x.hypothesis for x in near], self.comparison.weights(best), FAIR
        )
        self.comparison.judge(rivals, best)
        rivals += self.comparison.score_against([x.hypothesis for x in doubtful], best, FAIR, QUICK)
        rivals = [self.judge_with_own_correction(r, best) for r in rivals]
        return list(zip([*near, *doubtful], rivals, strict=True))

    def _possible(
        self, found: Sequence[TermExchange], simulated: Sequence[tuple[TermExchange, ScoredModel]]
    ) -> tuple[list[TermExchange], list[tuple[TermExchange, ScoredModel]]]:
        """Exchanges whose effects can exist, all and the simulated ones.

        An effect with an impossible total is no alternative: it compensates for another effect.
        """
        fitted = {(x.removed, x.new): r.hypothesis for x, r in simulated}
        impossible = {
            (x.removed, x.new)
            for x in found
            if x.new is not None
            and (not x.is_doubtful or (x.removed, x.new) in fitted)
            and refused(self.problem, fitted.get((x.removed, x.new), x.hypothesis), self.recorded)
        }
        return (
            [x for x in found if (x.removed, x.new) not in impossible],
            [(x, r) for x, r in simulated if (x.removed, x.new) not in impossible],
        )

    def kept_in_addition(self, best: ScoredModel, top: ScoredModel) -> ScoredModel:
        """An exchange of one term, or the model with both terms if that is better."""
        own, terms = best.hypothesis, top.hypothesis.terms
        removed = [t for t in own.terms if t not in terms]
        if len(removed) != 1 or len(terms) != len(own.terms):
            return top
        both = top.hypothesis.with_term_of(own, removed[0])
        additions = self._fit_and_judge(both, self.comparison.weights(best), best)
        return additions if additions.evidence > top.evidence + SELECTION.earns else top

    def best_addition(
        self,
        best: ScoredModel,
        simulated: Sequence[tuple[TermExchange, ScoredModel]],
        additions: Iterable[tuple[Hypothesis, float]],
    ) -> ScoredModel | None:
        """The fit with the clearest candidate in addition, if its evidence is enough; else None.

        Candidates were clearly better in the linearized motion, either in exchange for a term, but
        not in a simulation of that exchange, or as an addition. When the simulations are used up,
        no step forward would add them.

        Args:
            best: the present fit.
            simulated: simulated exchanges.
            additions: hypotheses with a candidate in addition, and their linearized evidence.
        """
        claims = [
            (x.hypothesis.with_term_of(best.hypothesis, x.removed[0]), x.evidence)
            for x, _ in simulated
            if len(x.removed) == 1 and x.evidence > SELECTION.clear
        ]
        claims += [(h, evidence) for h, evidence in additions if evidence > SELECTION.clear]
        if not claims:
            return None
        claim, _ = max(claims, key=lambda each: each[1])
        # The weights are those of a residual at the noise floor: with those of the present residual
        # the fit would ignore the signals that the candidate explains.
        weights = self.problem.weights(np.zeros_like(self.problem.signal_floor))
        rival = self._fit_and_judge(claim, weights, best)
        return rival if self._earns(rival, best) else None

    def _fit_and_judge(
        self, start: Hypothesis, weights: FloatArray, best: ScoredModel
    ) -> ScoredModel:
        """A hypothesis, fitted and scored against ``best``."""
        (rival,) = self.comparison.rivals([start], weights, FAIR)
        self.comparison.judge([rival], best)
        return rival

    def _earns(self, rival: ScoredModel, best: ScoredModel) -> bool:
        """Whether a model gains enough over ``best`` to be accepted."""
        comparison = self.comparison
        left = comparison.validation_mean_square(best)
        whole = comparison.mismatch(
            best, comparison.validation_mean_square(comparison.nominal), left
        )
        return (
            rival.evidence >= SELECTION.earns
            and (rival.held_gain > 0.0 or not comparison.has_validation)
            and comparison.reduces_error_enough(
                left, comparison.validation_mean_square(rival), whole
            )
        )

    def judge_with_own_correction(self, rival: ScoredModel, best: ScoredModel) -> ScoredModel:
        """A model that is behind ``best``, scored again with its own discretization error.

        The discretization error of ``best`` may be the only reason why it is behind.
        """
        least = 0.0 if rival.hypothesis.free < best.hypothesis.free else -SELECTION.clear
        if not -SELECTION.disputed < rival.evidence < least:
            return rival
        own = self.fit_with_own_correction(rival.hypothesis, best)
        self.comparison.judge([own], best)
        return max(rival, own, key=lambda r: r.evidence)

    def exchange_terms(self, selected: SelectedModel) -> bool:
        """Compare every term with its alternatives; whether one of them was better.

        Alternatives that are far behind in the linearized motion are not simulated. The best model
        and the confidences of ``selected`` are set.
        """
        best = selected.best
        if not best.hypothesis.terms:
            selected.weigh({})
            return False
        linearized = linearize_around(self.problem, best, self._known_around(best))
        price = self.comparison.penalty_per_effect
        found = find_exchanges(self.problem, best, linearized, self.known_sensitivities, price)
        additions = better_as_addition(best, linearized, found, SELECTION.clear, price)
        found = [
            replace(x, evidence=x.evidence - additions[x.new][1]) if x.new in additions else x
            for x in found
        ]
        found = better_than_several(best, linearized, found, additions, price)
        simulated = self.simulated_exchanges(best, found, additions)
        found, simulated = self._possible(found, simulated)
        evidence = self.evidence_of_exchanges(best, found, simulated)
        selected.weigh(evidence)
        better = [(x, r) for x, r in simulated if evidence[x.removed, x.new] > 1.0]
        top: ScoredModel | None = None
        if better:
            _, first = max(better, key=lambda each: evidence[each[0].removed, each[0].new])
            top = self.kept_in_addition(best, first)
        elif additions or self._is_spent(best):
            top = self.best_addition(best, simulated, additions.values())
        if top is not None and refused(self.problem, top.hypothesis, self.recorded):
            top = None
        for x, r in simulated:
            if r is not top:
                e = evidence[x.removed, x.new]
                self._step("exchange", "rejected", f"it scores {e:+.1f} against the best", r, best)
        if top is None:
            return False
        self._step("exchange", "accepted", f"it gains {top.evidence:.1f}", top, best)
        back = self.eliminate(self.comparison.fit_to_convergence(top))
        if have_same_forms(back.hypothesis, best.hypothesis):
            # Exchange and elimination undo each other: both sets explain the recordings equally.
            stood = set(best.hypothesis.terms) - set(top.hypothesis.terms)
            came = set(top.hypothesis.terms) - set(best.hypothesis.terms)
            selected.weigh({
                (removed, new): min(e, 0.0) if new in came and set(removed) <= stood else e
                for (removed, new), e in evidence.items()
            })  # fmt: skip
            return False
        selected.best = back
        return True

    def _known_around(self, best: ScoredModel) -> LinearizedView | None:
        """The last linearization, if it holds around this fit.

        It does not if it was made at another fit and the residual is small: non-linear laws then
        need a linearization at this fit.
        """
        linearized = self.last_linearization
        most = float(np.sqrt(np.max(best.left / self.problem.signal_floor**2)))
        elsewhere = linearized is not None and linearized.around is not best
        return None if elsewhere and VERDICT.at_floor < most <= VERDICT.left_floors else linearized

    def evidence_of_exchanges(
        self,
        best: ScoredModel,
        found: Sequence[TermExchange],
        simulated: Sequence[tuple[TermExchange, ScoredModel]],
    ) -> dict[Place, float]:
        """Exchange -> its evidence relative to ``best``, corrected for gains by chance.

        Removals that were simulated have that evidence. If two models explain the same, the one
        with the clearly smaller residual below the noise floor is preferred.
        """
        lost = self._lost_evidence(best, found, [x for x, _ in simulated])
        chance = chance_gain(best.hypothesis, found, self.comparison.sample_ratio, lost)
        borne = [(x, self._supported_evidence(r, best)) for x, r in simulated]
        evidence = simulated_evidence(found, borne)
        evidence = {place: e - chance[place] for place, e in evidence.items()}
        lone = best.hypothesis.terms if len(best.hypothesis.terms) == 1 else None
        for x in found:
            without = best.hypothesis.without(*x.removed).terms
            if x.new is None and without in self.simulated_losses:
                evidence[x.removed, None] = self.simulated_losses[without]
            elif x.new is None and x.removed == lone:
                bare = replace(self.comparison.nominal)
                self.comparison.judge([bare], best)
                evidence[x.removed, None] = bare.evidence
        for (x, r), (_, e) in zip(simulated, borne, strict=True):
            alike = len(x.removed) == 1 and not x.is_generalization and not x.is_special_case
            if not alike or abs(e) >= SELECTION.even:
                continue
            less = compare_below_floor(r, best, self.problem.signal_floor)
            if less:
                evidence[x.removed, x.new] = e + SELECTION.even * less
        return evidence

    def _supported_evidence(self, rival: ScoredModel, best: ScoredModel) -> float:
        """Evidence of a model relative to ``best``, limited to what most windows support.

        The limit applies where positions are weighted because of stiction.
        """
        problem = self.problem
        if not problem.position_weights:
            return rival.evidence
        mine, others = (np.concatenate([r.fitted.residual, r.held_residual]) for r in (rival, best))
        lengths = [*problem.lengths(problem.fit), *problem.lengths(problem.held_out)]
        most = supported_by_windows(mine, others, lengths, problem.signal_floor)
        return float(np.clip(rival.evidence, -most, most))

    def _lost_evidence(
        self, best: ScoredModel, found: Sequence[TermExchange], near: Sequence[TermExchange]
    ) -> dict[tuple[Term, ...], float]:
        """Removed term -> evidence that its removal loses in a simulation.

        Only terms with a close alternative that has another number of parameters are removed.
        """
        own = best.hypothesis
        places = {x.removed for x in near if len(x.removed) == 1 and x.hypothesis.free != own.free}
        bare = [x for x in found if x.new is None and x.removed in places]
        if not bare:
            return {}
        rivals = self.comparison.rivals(
            [x.hypothesis for x in bare], self.comparison.weights(best), 0
        )
        self.comparison.judge(rivals, best)
        return {x.removed: max(-r.evidence, 0.0) for x, r in zip(bare, rivals, strict=True)}


def have_same_forms(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two hypotheses have the same terms in the same forms."""
    same = set(one.terms) == set(other.terms)
    return same and all(_has_same_form(t, one, other) for t in one.terms)


def _has_same_form(term: Term, own: Hypothesis, other: Hypothesis) -> bool:
    """Whether ``other`` has a term in the same form as ``own``."""
    if term not in other.terms:
        return False
    here, there = own.theta[own.slice_of(term)], other.theta[other.slice_of(term)]
    return bool(np.array_equal(term.movable(here), term.movable(there)))
