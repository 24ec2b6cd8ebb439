"""The rules of pruning: which effects of a fitted model are rejected, and why."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import ParameterUncertainty, parameter_uncertainty
from pytest_twin.diagnosis.locate import compute_missing_force
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors, label, levels_on
from pytest_twin.diagnosis.search.pruning_settings import SETTINGS
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.diagnosis.verdict import JointError, own_mismatch, reduces_error_enough
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit

Rejections = Mapping[int, str]
"""Rejected effects by their number in the model, with the line that the reader gets of each."""


@dataclass(frozen=True)
class RefitComparison:
    """A fitted model, and its refits without each of its effects, on the tested recordings.

    Attributes:
        fitted: the model with all effects.
        confidence: of each effect against its alternatives.
        before: (signals,) residual of the nominal model, in noise floors.
        base: (signals,) residual of the fitted model, in noise floors.
        refitted: the model without each effect.
        levels: (signals,) residual of each of these, in noise floors.
        weights: (signals,) of the refits.
        likeliest_alternative: term -> confidence of its likeliest alternative. All
            alternatives to a term that is not listed count as one.
        not_simulated: effects whose alternatives were not simulated. A comparison in the linearized
            motion ranks alternatives; it is no ground to reject an effect that was simulated.
    """

    problem: Problem
    fitted: FittedModel
    confidence: Mapping[Term, float]
    before: FloatArray
    base: FloatArray
    refitted: list[FittedModel]
    levels: list[FloatArray]
    weights: FloatArray
    likeliest_alternative: Mapping[Term, float] = field(default_factory=dict)
    not_simulated: frozenset[Term] = frozenset()

    @cached_property
    def uncertainty(self) -> ParameterUncertainty:
        """Covariance of the parameters."""
        return parameter_uncertainty(self.problem, self.fitted, in_parts=False)

    @cached_property
    def errors(self) -> list[JointError]:
        """Errors of each joint in noise floors, of the nominal and of the fitted model."""
        pairs = zip(self.before, self.base, strict=True)
        each = [JointError(float(before), float(after), 1.0, "") for before, after in pairs]
        return each[: len(self.problem.joints)]

    @property
    def terms(self) -> tuple[Term, ...]:
        """Effects of the fitted model."""
        return self.fitted.hypothesis.terms

    def confidence_of(self, term: Term) -> float:
        """Confidence of an effect; 1 where it was compared with no alternative."""
        return self.confidence.get(term, 1.0)

    def is_likely(self, term: Term) -> bool:
        """Whether an effect is likelier than all else together, or as likely as the likeliest.

        Two effects that the recordings cannot distinguish have a confidence of about 0.5 each. That
        is no evidence for a third effect.
        """
        if term in self.not_simulated:
            return True
        confidence_of = self.confidence_of(term)
        likeliest = self.likeliest_alternative.get(term, 1.0 - confidence_of)
        return confidence_of >= SETTINGS.even or confidence_of >= SETTINGS.as_likely * likeliest

    def is_explained_without(self, k: int) -> bool:
        """Whether the signals that an effect can change are explained without it."""
        columns = _signals_of(self.problem, self.terms[k])
        pairs = zip(self.before[columns], self.levels[k][columns], strict=True)
        return all(JointError(float(b), float(a), 1.0, "").is_explained for b, a in pairs)

    def label(self, k: int) -> str:
        """Effect and joint in words."""
        return label(self.problem, self.terms[k])

    def without(self, removed: Sequence[int]) -> FittedModel:
        """The model refitted without the effects of these numbers."""
        if len(removed) == 1:
            return self.refitted[removed[0]]
        rest = self.fitted.hypothesis.without(*(self.terms[k] for k in removed))
        return fit(
            self.problem,
            [rest],
            self.weights,
            self.problem.fit,
            iterations=SETTINGS.refit_iterations,
        )[0]


def removes_too_little(tested: RefitComparison) -> Rejections:
    """Reject the least of the effects that remove no worthwhile part of the residual.

    An effect in doubt must remove more above the noise floor. If the simulation diverges, the least
    effect is rejected.
    """
    one, levels = np.ones(len(tested.base)), tested.levels
    norms = [float(np.linalg.norm(v)) for v in levels]
    left = in_noise_floors(tested.fitted.residual, tested.problem.signal_floor)
    if not np.isfinite([tested.base, left]).all():
        k = int(np.argmin(norms))
        return {k: f"rejected: {tested.label(k)}: the simulation diverges with it"}
    idle = dict[int, str]()
    for k, (term, level) in enumerate(zip(tested.terms, levels, strict=True)):
        acting = tested.problem.is_acted_on_by(tested.fitted.hypothesis.without(term).terms)
        whole = own_mismatch(one, tested.before**2, level**2, acting)
        doubt = _reason_for_doubt(tested, term)
        floors = VERDICT.identifiable * (SETTINGS.doubtful_factor if doubt else 1.0)
        if not reduces_error_enough(one, level**2, tested.base**2, whole, floors):
            idle[k] = f"; {doubt}" if doubt else ""
    if not idle:
        return {}
    k = min(idle, key=lambda k: norms[k])
    why = f"it removes too little of the remaining error{idle[k]}"
    return {k: f"rejected: {tested.label(k)}: {why}"}


def _reason_for_doubt(tested: RefitComparison, term: Term) -> str:
    """Why an effect needs clearer evidence; empty if it does not."""
    problem, fitted = tested.problem, tested.fitted
    # Dry friction that turns to bristles of the least length is dry friction in another form.
    if problem.has_shape_at_bound(fitted.hypothesis, term):
        return "a shape parameter is at its bound"
    if may_be_absent(fitted, term, tested.uncertainty):
        return "its 95 % interval includes its absence"
    if not len(problem.held_out) and _recordings_that_need(tested, term) < 2:
        return "only one recording shows it"
    return ""


def _recordings_that_need(tested: RefitComparison, term: Term) -> int:
    """Number of fitted recordings with a signal that is predicted worse without an effect."""
    problem = tested.problem
    without = tested.refitted[tested.terms.index(term)].residual
    segments = problem.simulator.segments
    owner = np.repeat([segments[s].trial for s in problem.fit], problem.lengths(problem.fit))
    one = np.ones(len(problem.signal_floor))
    shown = 0
    for trial in np.unique(owner):
        worse, base = (
            in_noise_floors(r[owner == trial], problem.signal_floor) ** 2
            for r in (without, tested.fitted.residual)
        )
        shown += reduces_error_enough(one, worse, base, one, VERDICT.identifiable)
    return shown


def alternatives_more_likely(tested: RefitComparison) -> Rejections:
    """Reject the least likely effect if its alternatives are likely enough.

    Of several effects one needs a least confidence. One that explains a small share of the error
    needs more, unless its joint would be unexplained without it.
    """
    whole = float(np.sum(tested.before**2))
    doubtful = dict[int, float]()
    for k, t in enumerate(tested.terms):
        if t in tested.not_simulated:
            continue
        taken = float(np.sum(tested.levels[k] ** 2 - tested.base**2))
        is_small = taken < SETTINGS.small_share * whole and tested.is_explained_without(k)
        least = SETTINGS.least_confidence if len(tested.terms) > 1 else 0.0
        if tested.confidence_of(t) < (SETTINGS.sure_of_small if is_small else least):
            doubtful[k] = tested.confidence_of(t)
    if not doubtful:
        return {}
    k = min(doubtful, key=lambda k: doubtful[k])
    return {
        k: f"rejected: {tested.label(k)}: other effects can explain its part, and the recordings "
        "do not separate them"
    }


def at_bound_or_in_doubt(tested: RefitComparison) -> Rejections:
    """Reject effects at unexplained joints that are at a bound, in doubt, or less likely."""
    problem, hypothesis = tested.problem, tested.fitted.hypothesis
    explained = [error.is_explained for error in tested.errors]
    removed = {}
    for k, t in enumerate(tested.terms):
        if all(explained) if t.joint < 0 else explained[t.joint]:
            continue
        likely = tested.is_likely(t)
        at_an_end = hypothesis.is_at_bound(t) or problem.has_shape_at_bound(hypothesis, t)
        if likely and not at_an_end and not is_in_doubt(tested, k):
            continue
        why = (
            "a parameter is at its physical bound, or its 95 % interval includes zero"
            if likely
            else "other effects are more likely"
        )
        removed[k] = (
            f"rejected: {tested.label(k)}, the closest known effect: {why}, and a residual remains"
        )
    return removed


def wrong_position_dependence(tested: RefitComparison) -> Rejections:
    """Reject a law of position if the force that it leaves missing depends on position as well.

    Something else acts there: a cable that becomes slack is no spring.
    """
    for k, t in enumerate(tested.terms):
        if t.joint < 0 or not t.law.depends_only_on_position:
            continue
        error = tested.errors[t.joint]
        if error.is_explained or error.fraction <= VERDICT.left:
            continue
        share, of_velocity = _explained_by_position_and_velocity(
            tested.problem, tested.fitted.hypothesis, t.joint
        )
        if share > max(SETTINGS.same_dependence, of_velocity):
            return {
                k: f"rejected: {tested.label(k)}, the closest known effect: {100 * share:.0f} % of "
                "the force that is still missing depends on the joint's position, so the true "
                "dependence on position is another"
            }
    return {}


def _explained_by_position_and_velocity(
    problem: Problem, hypothesis: Hypothesis, joint: int
) -> tuple[float, float]:
    """Shares of the variance of a joint's missing force that position and velocity explain."""
    segments = problem.simulator.segments
    (residual,) = problem.residuals([hypothesis], problem.all_segments)
    force = compute_missing_force(problem, residual, problem.floor).force[:, joint]
    whole = float(np.var(force)) * len(force)
    if not np.isfinite(whole) or whole <= 0.0:
        return 0.0, 0.0

    def share(values: FloatArray) -> float:
        stretches = np.array_split(force[np.argsort(values, kind="stable")], SETTINGS.position_bins)
        return 1.0 - sum(float(np.var(part)) * len(part) for part in stretches) / whole

    motion = [derivatives(s.time, s.position[:, joint : joint + 1]) for s in segments]
    position, velocity = (np.concatenate([m[order][:, 0] for m in motion]) for order in (0, 1))
    return share(position), share(velocity)


def residual_remains(tested: RefitComparison) -> Rejections:
    """Reject effects with which most of the mismatch of their joint remains.

    It is no ground where the time of the search was over: the rest may be an effect that it did not
    come to.
    """
    removed = {}
    for k, t in enumerate(tested.terms):
        if t in tested.not_simulated:
            continue
        share = share_too_large(
            tested.problem, t, *_levels_that_count(tested, t),
            several=sum(other.joint == t.joint >= 0 for other in tested.terms) > 1,
            sure=tested.confidence_of(t) >= SETTINGS.sure
            and not tested.fitted.hypothesis.is_at_bound(t),
        )  # fmt: skip
        if share > 0.0:
            removed[k] = (
                f"rejected: {tested.label(k)}, the closest known effect: {100 * share:.0f} % of "
                "the squared error remains there with all effects fitted"
            )
    return removed


def _levels_that_count(tested: RefitComparison, term: Term) -> tuple[FloatArray, FloatArray]:
    """(signals,) residuals of the nominal and the fitted model, to judge what remains.

    They are those of the tested recordings. Where these hardly show the mismatch at the joint of an
    effect, they are those of all recordings.
    """
    problem = tested.problem
    hardly = tested.before[_signals_of(problem, term)].max() <= VERDICT.at_floor
    if not hardly or not len(problem.held_out):
        return tested.before, tested.base
    (before,) = levels_on(problem.at(EMPTY), [EMPTY], problem.all_segments)
    (base,) = levels_on(problem, [tested.fitted.hypothesis], problem.all_segments)
    return before, base


def is_in_doubt(tested: RefitComparison, k: int) -> bool:
    """Whether an effect may be absent and explains no large share where it acts."""
    if is_needed(tested, k):
        return False
    return may_be_absent(tested.fitted, tested.terms[k], tested.uncertainty, SETTINGS.doubt_width)


def is_needed(tested: RefitComparison, k: int) -> bool:
    """Whether the residual grows by a large share of the mismatch without an effect."""
    columns = _signals_of(tested.problem, tested.terms[k])
    more = tested.levels[k][columns] ** 2 - tested.base[columns] ** 2
    return bool((more > SETTINGS.needed_share * tested.before[columns] ** 2).any())


def may_be_absent(
    fitted: FittedModel, term: Term, uncertainty: ParameterUncertainty, within: float = 1.0
) -> bool:
    """Whether the 95 % region of the parameters that switch an effect on contains its absence.

    Parameters without a slope (the release of a drive) have no region; such an effect is present.

    Args:
        within: factor on the width of the region.
    """
    place = fitted.hypothesis.slice_of(term)
    own = term.amplitude_indices(fitted.hypothesis.theta[place])
    amplitude_indices = [place.start + k for k in own]
    if not np.any(fitted.jacobian[:, :, amplitude_indices] != 0.0, axis=(0, 1)).all():
        return False
    neutral = [term.parameters[k].neutral for k in own]
    offset = np.array(neutral, dtype=float) - fitted.hypothesis.theta[amplitude_indices]
    return uncertainty.normalized_distance(np.array(amplitude_indices), offset) <= within


def share_too_large(
    problem: Problem,
    term: Term,
    before: FloatArray,
    after: FloatArray,
    *,
    several: bool,
    sure: bool,
) -> float:
    """Share of the squared mismatch that remains where an effect acts, if it is too large; else 0.

    The bound is lower for an unsure effect, far above the noise floor, and for several effects at
    one joint.
    """
    columns = _signals_of(problem, term)
    mismatch = float(np.maximum(before[columns] ** 2 - 1.0, 0.0).sum())
    left = float(np.maximum(after[columns] ** 2 - 1.0, 0.0).sum())
    share = left / mismatch if mismatch > 0.0 else 0.0
    top = float(after[columns].max())
    bound = SETTINGS.left_if_sure if sure else SETTINGS.left_if_unsure
    if top > SETTINGS.far:
        bound = SETTINGS.left_if_far
    if several and top > SETTINGS.far_if_several:
        bound = SETTINGS.left_if_several
    return share if share > bound and top > VERDICT.identifiable else 0.0


def _signals_of(problem: Problem, term: Term) -> slice:
    """Signals that an effect can change: positions and efforts of its joint, or of all joints.

    Of an error of effort readings these are efforts alone, since it changes no motion.
    """
    joints = len(problem.joints)
    first = joints if term.law.needs_effort_sensor and problem.effort_floor is not None else 0
    return slice(first, None) if term.joint < 0 else slice(first + term.joint, None, joints)


RULES: tuple[Callable[[RefitComparison], Rejections], ...] = (
    removes_too_little,
    alternatives_more_likely,
    at_bound_or_in_doubt,
    wrong_position_dependence,
)
"""Rules in the order in which they are asked; the first that rejects something decides a round."""

CLOSEST_KNOWN = (at_bound_or_in_doubt, wrong_position_dependence, residual_remains)
"""Rules that reject an effect as the closest known one: something acts there, but not that."""
