"""The search: linearize around the incumbent, propose, simulate, fit, accept at most one model.

The state is an incumbent and a pool of all simulated models. The sequence of incumbents depends on
the data alone and starts with the nominal model. The score of the incumbents always increases. A
limit of time or simulations ends the sequence earlier and changes nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.integrator_settings import INTEGRATOR
from pytest_twin.diagnosis.noise_levels import excess
from pytest_twin.diagnosis.search.accept import accepts
from pytest_twin.diagnosis.search.fit import fit_along_motion, with_linearized_jacobians
from pytest_twin.diagnosis.search.linearized_view import View
from pytest_twin.diagnosis.search.model import Acceptance, Model, Pool, PooledModel, is_rival_of
from pytest_twin.diagnosis.search.neighbours import (
    Neighbour,
    Quota,
    confused,
    has_given,
    neighbours,
    proposed_starts,
    simpler_or_confused,
)
from pytest_twin.diagnosis.search.physics import Physics
from pytest_twin.diagnosis.search.settings import SETTINGS, SearchSettings
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.comparison import Comparison, Size
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

_SETTING = "setting of the simulation"
"""Origin of a model with another one."""
_CLEAR_ERRORS = 3.0
"""Standard errors of a paired gain by which one friction constraint predicts clearly better."""
_SETTINGS_TOGETHER = 2
"""Largest number of settings that are changed together: friction constraint and time step."""
_FITTED_SETTINGS = 2
"""Settings of the simulation with which the incumbent is fitted."""
_DISTANT = 1
"""Effects to which no slope leads that are fitted in place of those of an incumbent."""
_STARTS = 4
"""Starts that effects propose, of which a round simulates the nearest."""

Listener = Callable[[Model, Model, Acceptance], None]
"""Called with each model of a round, the incumbent, and the decision between them."""


@dataclass(frozen=True, slots=True)
class SearchOutcome:
    """The last incumbent and the pool.

    Attributes:
        physics: the robot with the settings of the simulation of the incumbent.
        nominal: the model without effects.
        incumbents: scores of all incumbents, in order.
        pool: all simulated models.
        comparison: by which models were compared.
        is_complete: whether no further proposal passes the acceptance test.
        is_compared: whether only noise remains, and every rival of the last incumbent was fitted
            along its motion, or by simulation where no slope leads to it.
    """

    incumbent: Model
    physics: Physics
    nominal: Model
    incumbents: tuple[float, ...]
    pool: Pool
    comparison: Comparison
    is_complete: bool
    is_compared: bool

    def is_better(self, model: Model, simpler: Model) -> bool:
        """Whether a fitted model passes the test of the search against a simpler one."""
        return accepts(model, simpler, self.nominal, self.comparison).is_accepted


class Search:
    """One search for the effects that a model lacks.

    Args:
        physics: the robot and its recordings.
        listener: called with each decision.
        check: called with the incumbent before each round; raises :class:`OutOfTime` where the
            search must end.
    """

    def __init__(
        self,
        physics: Physics,
        settings: SearchSettings = SETTINGS,
        listener: Listener = lambda model, incumbent, decision: None,
        check: Callable[[Model], None] = lambda incumbent: None,
    ) -> None:
        self.physics = physics
        self.settings = settings
        self.listener = listener
        self.check = check
        (residual,) = physics.simulate([EMPTY], EMPTY)
        self.comparison = Comparison.of(
            residual, physics.floor, physics.lengths, physics.recordings, len(physics.candidates)
        )
        self.pool = Pool(self.comparison)
        self._passed: Model | None = None
        self._has_compared_constraints = False
        self._fits = dict[frozenset[Term], tuple[Physics, Model]]()
        self._compared: Model | None = None
        self._without_setting = list[frozenset[Term]]()
        nominal = self._model(EMPTY, residual, "nominal model", EMPTY)
        self.nominal = nominal.with_jacobian(self.comparison, np.zeros((*residual.shape, 0)))
        self._simplest = self.nominal
        self.pool.add(self.nominal)

    def run(
        self,
        starts: Sequence[Model] = (),
        rounds: int | None = None,
        *,
        tentative: Sequence[Model] = (),
    ) -> SearchOutcome:
        """Search until no proposal is accepted, or until a limit ends it.

        Args:
            starts: models of :meth:`simulated` that are compared first. The best one is the result
                where a limit ends the search before its fit.
            tentative: such models of a part of the recordings, or of one kind of effects. These may
                only imitate the right ones and lead away from these, so they are compared with the
                neighbours of the nominal model, unless they leave noise alone.
            rounds: largest number of rounds; that of the settings by default.
        """
        incumbent, scores, is_complete = self.nominal, [self.nominal.score], False
        try:
            best = incumbent
            for start in (*starts, *tentative):
                best = start if self._decide(start, best).is_accepted else best
            if best is not incumbent:
                is_of_part = any(best is each for each in tentative)
                incumbent = self._accept_fitted(best, incumbent) or incumbent
                if is_of_part and self._exceeds(incumbent, VERDICT.at_floor):
                    incumbent = self._round(self.nominal, [incumbent]) or incumbent
                scores.append(incumbent.score)
            if self.physics.given:
                self._simplest = self._with_given(starts)
                incumbent = max(
                    (m for m in (incumbent, self._simplest) if self._is_allowed(m.hypothesis)),
                    key=lambda m: m.score, default=incumbent,
                )  # fmt: skip
                scores.append(incumbent.score)
            for _ in range(self.settings.rounds if rounds is None else rounds):
                self.check(incumbent)
                better = self._friction_constraint(incumbent) or self._round(incumbent)
                if better is None:
                    is_complete = True
                    break
                incumbent = better
                scores.append(incumbent.score)
        except OutOfTime:
            # A model that passed the test is the result, although its last fit is missing.
            incumbent = self._passed or incumbent
        leaves_noise = not self._exceeds(incumbent, VERDICT.identifiable)
        return SearchOutcome(
            incumbent, self.physics, self.nominal, tuple(scores), self.pool, self.comparison,
            is_complete, leaves_noise and self._compared is incumbent,
        )  # fmt: skip

    def _may_win(self, size: Size, incumbent: Model) -> bool:
        """Whether a model of a size that left noise alone would replace the incumbent.

        No score is above the penalty of the model: residuals below the noise floor count as equal.
        Where the incumbent leaves only noise, a richer model would fit noise.
        """
        needed = 0.0
        if size.is_richer_than(incumbent.size):
            if not self._exceeds(incumbent, VERDICT.identifiable):
                return False
            needed = self.settings.earns
        return -self.comparison.penalty(size) > incumbent.score + needed

    def _is_allowed(self, hypothesis: Hypothesis) -> bool:
        return has_given(hypothesis, self.physics.given)

    def _with_given(self, starts: Sequence[Model]) -> Model:
        """The model of the given effects alone: the best fit from absence and from the starts."""
        absent = EMPTY.with_terms(
            {t: np.array([p.absent_value for p in t.parameters]) for t in self.physics.given}
        )
        known = [
            absent.with_theta(np.concatenate([
                (h if t in h.terms else absent).theta[(h if t in h.terms else absent).slice_of(t)]
                for t in absent.terms
            ]))
            for h in (start.hypothesis for start in starts)
        ]  # fmt: skip
        models = self._simulate([absent, *known], absent, "given effects")
        fitted = [self._fitted(m) for m in models if m.is_finite]
        return max(fitted, key=lambda m: m.score, default=self.nominal)

    def _round(self, incumbent: Model, others: Sequence[Model] = ()) -> Model | None:
        """The model that replaces the incumbent; None if no proposal passes the test.

        Args:
            others: earlier answers that are compared with the proposals.
        """
        if not self._exceeds(incumbent, VERDICT.identifiable):
            better = self._setting_at_noise(incumbent)
            if better is not None or incumbent is self._simplest:
                return better
        if not self.physics.is_linearizable and not self._exceeds(incumbent, VERDICT.identifiable):
            # Simulations of all candidates would explain noise only.
            simple = simpler_or_confused(self.physics, incumbent.hypothesis)
            models = self._simulate(simple, incumbent.corrected_at, "rival")
            return self._accept_one(None, models, incumbent)
        view = self._linearize(incumbent)
        proposals = self._propose(incumbent, view)
        self.pool.set_linearized(
            incumbent,
            (
                PooledModel(
                    n.hypothesis, self.physics.size(n.hypothesis), n.gain, False, n.difference
                )
                for n in proposals
            ),
        )
        chosen = self._select(proposals, incumbent)
        models = self._simulate([n.hypothesis for n in chosen], incumbent.corrected_at, "neighbour")
        models += self._simulate(
            self._other_words(incumbent), incumbent.corrected_at, "other words"
        )
        models = self._fit_best(view, models, incumbent, self.settings.finalists)
        models += self._from_starts(view, models, incumbent, attempted=True)
        better = self._accept_one(view, [*models, *others], incumbent)
        if better is not None or others:
            return better
        # Before other settings of the simulation: they fit errors of a wrong effect too.
        distant = self._distant_rivals(incumbent)
        self._compared = incumbent
        return (
            self._accept_one(view, distant, incumbent)
            or self._other_settings(incumbent)
            or self._accept_one(view, self._fitted_starts(view, models, incumbent), incumbent)
            or self._from_another_model(incumbent)
            or self._accept_one(view, self._rivals(view, proposals, incumbent), incumbent)
        )

    def _from_another_model(self, incumbent: Model) -> Model | None:
        """A better model around the best simpler one with other effects, where much remains.

        Two effects that imitate a third may keep the search from the one that is right.
        """
        other = self.pool.best_simpler(incumbent)
        if (
            other is None
            or not self._is_allowed(other)
            or not self._exceeds(incumbent, VERDICT.at_floor)
        ):
            return None
        simpler = self._fitted(self.simulated(other))
        view = self._linearize(simpler)
        chosen = self._select(self._propose(simpler, view), simpler)
        models = self._simulate([n.hypothesis for n in chosen], simpler.corrected_at, "neighbour")
        models = self._fit_best(view, models, simpler, self.settings.finalists)
        return self._accept_one(view, models, incumbent)

    def _friction_constraint(self, incumbent: Model) -> Model | None:
        """The first incumbent with dry friction, with the other friction constraint.

        Whether dry friction creeps is a choice of the simulation that made the recordings. Further
        effects would explain the errors of a wrong one.
        """
        own = incumbent.hypothesis
        is_dry = any(t.dry_level is not None for t in own.terms)
        if self._has_compared_constraints or not is_dry:
            return None
        self._has_compared_constraints = True
        if not self._exceeds(incumbent, VERDICT.identifiable):
            return None
        return self._with_setting(self.physics.other_friction_constraint(own), [own], incumbent)

    def _setting_at_noise(self, incumbent: Model) -> Model | None:
        """An incumbent at the noise floor, with the settings that leave noise alone, if some do.

        The floor contains the integration error of the model without effects, which may hide a
        wrong setting. Further parameters would explain the errors of it. Two settings may be wrong.
        """
        effects = frozenset(incumbent.hypothesis.terms)
        # What more effects do not explain with another setting, fewer do not either.
        if not effects or any(effects <= tried for tried in self._without_setting):
            return None
        self._without_setting.append(effects)
        if self._is_noise(incumbent):
            return self._clearly_better_constraint(incumbent)
        # A fit ends at the floor. The other settings are fitted from there, and so is this one.
        best, present, is_right = self._fit(incumbent), self.physics, False
        if self._is_noise(best):
            return best if best.score >= incumbent.score else None
        try:
            for _ in range(_SETTINGS_TOGETHER):
                best = self._in_nearest_setting(best)
                if self._is_noise(best):
                    break
            is_right = self._is_noise(best)
        finally:
            if not is_right:
                self.physics = present
        return best if is_right else None

    def _clearly_better_constraint(self, incumbent: Model) -> Model | None:
        """A model that leaves noise alone, with the other friction constraint if that is better.

        A model that lacked an effect may have decided for the wrong one, whose small error dry
        friction and gains then take up.
        """
        present, chosen = self.physics, None
        try:
            for self.physics in present.other_friction_constraint(incumbent.hypothesis):
                other = self._fitted(self.simulated(incumbent.hypothesis, _SETTING))
                mean, error = self.comparison.gain(other.residual, incumbent.residual)
                if mean > _CLEAR_ERRORS * error:
                    chosen = other
        finally:
            if chosen is None:
                self.physics = present
        return chosen

    def _in_nearest_setting(self, model: Model) -> Model:
        """The effects of a model in the other setting that leaves least; without one, the model."""
        own, fitted = self.physics, list[tuple[Model, Physics]]()
        for physics in own.other_settings(model.hypothesis, is_explained=False):
            self.physics = physics
            fitted.append((self._fitted(self.simulated(model.hypothesis, _SETTING)), physics))
        # It may leave more than the own one, if two settings are wrong.
        best, self.physics = min(fitted, key=self._noise_ratio, default=(model, own))
        return best

    @staticmethod
    def _noise_ratio(of: tuple[Model, Physics]) -> float:
        model, physics = of
        return float((model.mean_square / physics.noise**2).sum())

    def _is_noise(self, model: Model) -> bool:
        limit = (INTEGRATOR.noise_alone * self.physics.noise) ** 2
        return bool((model.mean_square <= limit).all())

    def _other_settings(self, incumbent: Model) -> Model | None:
        """The incumbent, or less, with another setting of the simulation, if it explains more."""
        own = incumbent.hypothesis
        reduced = (own.without(t) for t in own.terms if len(own.terms) > 1)
        is_explained = not self._exceeds(incumbent, VERDICT.identifiable)
        others = self.physics.other_settings(own, is_explained=is_explained)
        return self._with_setting(
            others, [own, *filter(self._is_allowed, reduced)], incumbent, INTEGRATOR.left
        )

    def _with_setting(
        self,
        others: Iterable[Physics],
        hypotheses: Sequence[Hypothesis],
        incumbent: Model,
        most_left: float = np.inf,
    ) -> Model | None:
        """The best of some hypotheses with another setting, if it explains more.

        The setting is then that of all further models.

        Args:
            most_left: largest share of the squared residual above the floor that may remain, if
                more than noise does: a wrong setting too fits a little of a large residual.
        """
        own, tried = incumbent.hypothesis, list[tuple[Physics, Model]]()
        for physics in others:
            residuals = physics.simulate(hypotheses, own)
            tried += [
                (physics, self._model(h, r, _SETTING, own))
                for h, r in zip(hypotheses, residuals, strict=True)
            ]
        for physics, model in sorted(tried, key=lambda pair: -pair[1].score)[:_FITTED_SETTINGS]:
            present, self.physics = self.physics, physics
            try:
                accepted = self._accept_fitted(model, incumbent)
            except OutOfTime:
                # The result is the incumbent, with its own setting.
                if self._passed is None:
                    self.physics = present
                raise
            least = self.settings.earns if model.hypothesis is own else 0.0
            if (
                accepted is not None
                and accepted.score > incumbent.score + least
                and (
                    not self._exceeds(accepted, VERDICT.at_floor)
                    or self._above_floor(accepted) <= most_left * self._above_floor(incumbent)
                )
            ):
                return accepted
            self.physics = present
        return None

    def _linearize(self, incumbent: Model) -> View:
        return self.physics.linearize(
            incumbent.hypothesis, incumbent.residual, _jacobian_of(incumbent)
        )

    def _propose(self, incumbent: Model, view: View) -> list[Neighbour]:
        """Neighbours; with simulated candidates where the linearization explains nothing."""
        physics, settings = self.physics, self.settings

        def is_possible(size: Size) -> bool:
            return self._may_win(size, incumbent) or is_rival_of(incumbent, self.comparison, size)

        proposals = neighbours(physics, self.comparison, incumbent, view, settings, is_possible)
        gains = [n.gain for n in proposals if not n.has_elastic]
        if (
            view.linear is not None
            and incumbent is self._simplest
            and max(gains, default=0.0) < settings.earns
        ):
            simulated_view = physics.view_by_simulation(
                incumbent.hypothesis, incumbent.residual, _jacobian_of(incumbent), 4
            )
            proposals += neighbours(
                physics, self.comparison, incumbent, simulated_view, settings, is_possible
            )
        return proposals

    def _select(self, proposals: Sequence[Neighbour], incumbent: Model) -> list[Neighbour]:
        """The proposals that are simulated: the best of each number of effects, then the others.

        Large models can fit errors of the linearization, so they do not displace a single effect. A
        removed effect had to earn its place, and its removal gets the same amount.
        """
        settings, count = self.settings, len(incumbent.hypothesis.terms)
        proposals = [
            n for n in proposals if self._may_win(self.physics.size(n.hypothesis), incumbent)
        ]

        def rank(neighbour: Neighbour) -> float:
            fewer = max(count - len(neighbour.hypothesis.terms), 0)
            return neighbour.gain + settings.earns * fewer

        ranked = sorted(proposals, key=rank, reverse=True)
        first, others = Quota.of(settings).divide(ranked)
        return first + others[: max(settings.proposals - len(first), 0)]

    def _other_words(self, incumbent: Model) -> list[Hypothesis]:
        """The physics of the incumbent with no more parameters, at the values that follow from it.

        The linearization misjudges limits of a drive and wavenumbers, so the same law in other
        words can seem far worse, and be fitted to other values.
        """
        other = [
            h for h in self.physics.rewrites(incumbent.hypothesis)
            if not self.physics.size(h).is_richer_than(incumbent.size) and self._is_allowed(h)
            and self._may_win(self.physics.size(h), incumbent)
        ]  # fmt: skip
        other.sort(key=lambda h: self.physics.size(h).parameters)
        return other[: self.settings.rivals]

    def _fit_best(
        self, view: View, models: Sequence[Model], incumbent: Model, count: int
    ) -> list[Model]:
        """Models by score; the first ``count`` are fitted along the motion."""
        ranked = sorted(models, key=lambda m: -m.score)
        fitted = fit_along_motion(
            view,
            ranked[:count],
            lambda hypotheses: self._simulate(hypotheses, incumbent.corrected_at, "fit"),
            self.comparison.floor,
            self.settings.corrections,
        )
        return [*fitted, *ranked[count:]]

    def _from_starts(
        self, view: View, models: Sequence[Model], incumbent: Model, *, attempted: bool = False
    ) -> list[Model]:
        """Models from starts that effects propose, where the best proposal leaves much.

        Args:
            attempted: only joints at which the best proposal acts. That it leaves much there shows
                that no slope leads to the right effect; at other joints a later round may. Where it
                leaves little, but more than noise, only its own effects start elsewhere.
        """
        best = max([incumbent, *models], key=lambda m: m.score)
        before = np.nan_to_num(incumbent.mean_square, posinf=0.0)
        joints = len(self.physics.joints)
        above = best.mean_square > (2.0 * VERDICT.identifiable * self.comparison.floor) ** 2
        large = above & (best.mean_square > self.settings.scan_above * before)
        unexplained = np.asarray(large.reshape(-1, joints).any(axis=0))
        of = None
        if attempted:
            changed = set(best.hypothesis.terms) ^ set(incumbent.hypothesis.terms)
            if all(t.joint >= 0 for t in changed):
                unexplained &= np.isin(np.arange(joints), [t.joint for t in changed])
            if not unexplained.any():
                unexplained, of = np.asarray(above.reshape(-1, joints).any(axis=0)), changed
        if not unexplained.any():
            return []
        hypotheses = proposed_starts(self.physics, incumbent, best, unexplained, _STARTS, of)
        started = self._simulate(hypotheses, incumbent.corrected_at, "start of an effect")
        return self._fit_best(view, started, incumbent, 3)

    def _fitted_starts(self, view: View, models: Sequence[Model], incumbent: Model) -> list[Model]:
        """The best models with effects to which no slope leads, fitted by simulation.

        A fit along the incumbent's motion does not converge to such effects.
        """
        if not self._exceeds(incumbent, VERDICT.at_floor):
            return []
        started = [
            *self._from_starts(view, models, incumbent),
            *(
                m for m in models
                if any(
                    t not in incumbent.hypothesis.terms and not t.law.nearly_linear
                    for t in m.hypothesis.terms
                )
            ),
        ]  # fmt: skip
        ranked = sorted((m for m in started if m.is_finite), key=lambda m: -m.score)
        return [self._fitted(m) for m in ranked[: self.settings.fitted_rivals]]

    def _rivals(self, view: View, proposals: Sequence[Neighbour], incumbent: Model) -> list[Model]:
        """Alternatives to the effects of the incumbent, simulated and fitted."""
        settings = self.settings
        simpler = self._simulate(
            self._without_given(incumbent.hypothesis), incumbent.corrected_at, "rival"
        )
        self._fit_best(view, simpler, incumbent, settings.finalists)
        for model in simpler[:1]:
            # Without all given effects the others may be far from their values beside them.
            if model.hypothesis.terms and model.is_finite:
                self._fitted(model)
        own = set(incumbent.hypothesis.terms) - set(self.physics.given)
        if not own:
            return []
        others = [n for n in proposals if not own <= set(n.hypothesis.terms)]
        seen, chosen = set[frozenset[object]](), list[Neighbour]()
        for n in sorted(others, key=lambda n: (n.difference > 1.0, -n.gain)):
            key = frozenset(n.hypothesis.terms)
            if (
                key not in seen
                and n.gain > -settings.rival_within
                and is_rival_of(incumbent, self.comparison, self.physics.size(n.hypothesis))
            ):
                seen.add(key)
                chosen.append(n)
        carried = list(
            filter(self._is_allowed, confused(self.physics, incumbent.hypothesis, carried=True))
        )
        models = self._simulate(
            [*carried[: settings.rivals], *(n.hypothesis for n in chosen[: settings.rivals])],
            incumbent.corrected_at,
            "rival",
        )
        models = self._fit_best(view, models, incumbent, settings.finalists)
        ranked = sorted(models, key=lambda m: -m.score)
        return [
            self._fitted(m)
            if i < settings.fitted_rivals
            and m.is_finite
            and m.score > incumbent.score - settings.rival_within
            else m
            for i, m in enumerate(ranked)
        ]

    def _without_given(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """The hypothesis without all given effects, without those of each joint, and without each.

        The search keeps them, but they carry a name only if no simpler set predicts as well.
        """
        given = [t for t in hypothesis.terms if t in self.physics.given]
        of_joints = [[t for t in given if t.joint == joint] for joint in {t.joint for t in given}]
        sets = dict.fromkeys([tuple(given), *map(tuple, of_joints), *((t,) for t in given)])
        return [hypothesis.without(*removed) for removed in sets if removed]

    def _distant_rivals(self, incumbent: Model) -> list[Model]:
        """Effects to which no slope leads, fitted in place of those that are confused with them.

        Backlash that gravity keeps on one side of the teeth is a constant offset. A small gap is
        not yet one, so the linearization shows nothing of it. Such effects are fitted with the
        corrections of their own starts: stiff teeth have other ones than a rigid joint.
        """
        own = set(incumbent.hypothesis.terms)
        distant = {
            t
            for h in confused(self.physics, incumbent.hypothesis)
            if self._may_win(self.physics.size(h), incumbent)
            for t in h.terms
            if not t.law.nearly_linear and frozenset(h.terms) not in self._fits
        }
        at_own = np.isin(np.arange(len(self.physics.joints)), [t.joint for t in own])
        if not distant - own:
            return []
        starts = proposed_starts(
            self.physics, incumbent, incumbent, at_own, _DISTANT, distant - own, beside=False
        )
        return [self._fitted(self.simulated(h, "start of a rival")) for h in starts]

    def _accept_one(
        self, view: View | None, models: Sequence[Model], incumbent: Model
    ) -> Model | None:
        """The simplest model that passes the test against all others.

        Each model that passes is fitted by simulation before a richer one is compared with it: a
        fit along the motion may end before it converges, and a richer law then seems better.
        """
        ranked = sorted(models, key=lambda m: -m.score)[: self.settings.contenders]
        contenders = with_linearized_jacobians(view, ranked, self.comparison)
        best = incumbent
        for model in sorted(
            contenders, key=lambda m: (m.size.effects, m.size.parameters, -m.score)
        ):
            if self._decide(model, best).is_accepted:
                best = self._accept_fitted(model, best) or best
        if best is incumbent:
            return self._fit_before_rejection(contenders, incumbent)
        return best

    def _fit_before_rejection(self, models: Sequence[Model], incumbent: Model) -> Model | None:
        """The best model that scores better than the incumbent, if it passes once it is fitted.

        A fit along the motion does not converge where the linearization is no good, and its
        cross-validation is then pessimistic.
        """
        better = [
            m for m in models
            if m.score > incumbent.score + self.settings.earns
            and not self.physics.refusals(m.hypothesis)
        ]  # fmt: skip
        if not better:
            return None
        return self._accept_fitted(max(better, key=lambda m: m.score), incumbent)

    def _decide(self, model: Model, incumbent: Model) -> Acceptance:
        refused = self.physics.refusals(model.hypothesis)
        if refused:
            decision = Acceptance(False, next(iter(refused.values())))
        else:
            decision = accepts(model, incumbent, self._simplest, self.comparison, self.settings)
        self.listener(model, incumbent, decision)
        return decision

    def _accept_fitted(self, model: Model, incumbent: Model) -> Model | None:
        """A model fitted by simulation, if it then replaces the incumbent.

        Special cases of its new laws are fitted first: a law with more parameters replaces them
        only if it passes the test against them.
        """
        self._passed = model if self._decide(model, incumbent).is_accepted else None
        best = None
        for each in [*self._special_cases(model, incumbent), model]:
            if best is None or self._decide(each, best).is_accepted:
                fitted = self._fitted(each)
                if self._decide(fitted, best or incumbent).is_accepted:
                    best = self._passed = fitted
        self._passed = None
        return best

    def _special_cases(self, model: Model, incumbent: Model) -> list[Model]:
        """Simulated models with special cases of laws that the incumbent lacks, simplest first."""
        shared = set(model.hypothesis.terms) & set(incumbent.hypothesis.terms)
        known = {*self._fits, frozenset(incumbent.hypothesis.terms)}
        found, rest = dict[frozenset[Term], Hypothesis](), [model.hypothesis]
        while rest:
            for special in self.physics.special_cases(rest.pop()):
                terms = frozenset(special.terms)
                if terms in found or not shared <= terms or not self._is_allowed(special):
                    continue
                found[terms] = special
                rest.append(special)
        models = self._simulate(
            [h for terms, h in found.items() if terms not in known], model.corrected_at,
            "special case",
        )  # fmt: skip
        return sorted(
            (m for m in models if m.is_finite),
            key=lambda m: (m.size.effects, m.size.parameters, -m.score),
        )

    def _fitted(self, model: Model) -> Model:
        """A model fitted by simulation, then with the corrections of its own parameters."""
        if model.is_fitted:
            return model
        terms = frozenset(model.hypothesis.terms)
        known = self._fits.get(terms)
        # A start that is no better than a fit of the same effects leads to that fit again.
        if known is not None and known[0] is self.physics and known[1].score >= model.score:
            return known[1]
        fitted = self._fit(model)
        if known is None or known[0] is not self.physics or fitted.score > known[1].score:
            self._fits[terms] = self.physics, fitted
        return fitted

    def _fit(self, model: Model) -> Model:
        hypothesis, residual, jacobian = self.physics.fit(
            model.hypothesis, model.residual, self.settings.refinements, model.corrected_at
        )
        fitted = self._model(hypothesis, residual, model.origin, hypothesis)
        fitted = replace(fitted.with_jacobian(self.comparison, jacobian), is_fitted=True)
        self.pool.add(fitted)
        return fitted

    def simulated(self, hypothesis: Hypothesis, origin: str = "earlier answer") -> Model:
        """A hypothesis simulated with the corrections of its own parameters."""
        (residual,) = self.physics.simulate([hypothesis], hypothesis)
        return self._model(hypothesis, residual, origin, hypothesis)

    def _simulate(
        self, hypotheses: Sequence[Hypothesis], corrected_at: Hypothesis, origin: str
    ) -> list[Model]:
        """Simulated models, which enter the pool."""
        hypotheses = [self.physics.within_totals(h) for h in hypotheses]
        residuals = self.physics.simulate(hypotheses, corrected_at) if hypotheses else []
        models = [
            self._model(h, r, origin, corrected_at)
            for h, r in zip(hypotheses, residuals, strict=True)
        ]
        for model in models:
            self.pool.add(model)
        return models

    def _model(
        self, hypothesis: Hypothesis, residual: FloatArray, origin: str, corrected_at: Hypothesis
    ) -> Model:
        size = self.physics.size(hypothesis)
        return Model.of(self.comparison, hypothesis, residual, size, origin, corrected_at)

    def _above_floor(self, model: Model) -> float:
        return excess(model.mean_square / self.comparison.floor**2)

    def _exceeds(self, model: Model, floors: float) -> bool:
        return bool((model.mean_square > (floors * self.comparison.floor) ** 2).any())


def _jacobian_of(model: Model) -> FloatArray:
    assert model.jacobian is not None
    return model.jacobian
