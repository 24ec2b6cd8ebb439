"""A wrong name is worse than none: which terms of what was chosen are taken back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import laplace_log_likelihood
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.intervals import Spread, parameter_spread
from pytest_twin.diagnosis.locate import missing_force
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.diagnosis.verdict import (
    AT_FLOOR,
    LEFT,
    STANDS_OUT,
    JointError,
    own_mismatch,
    worth_a_name,
)

_REFIT = 4
# A finding takes some signal down by this factor at least.
_WORSE = 1.05
# With more than this share of its joint's squared mismatch left a name is not given.
_SURE = 0.9
_LEFT_SURE, _LEFT_UNSURE = 0.25, 0.2
# Nor, however sure, with this share and so many floors: a law that is right comes nearer.
_LEFT_FAR, _FAR_FLOORS = 0.125, 20.0
# Nor, with several at one joint, with this share and so many floors: they hold each other up.
_LEFT_SEVERAL, _SEVERAL_FLOORS = 0.05, 50.0
# A name that rivals could replace has to take this share of the mismatch; one that they would
# replace, had there been time to simulate them, is none beside others, and one that is less likely
# than they are together is none where its joint stays unexplained.
_UNSURE, _SLIGHT = 0.7, 0.01
_UNLIKELY, _EVEN = 0.02, 0.5
# What could be absent, by its own interval, or stands for something else, its shape at a physical
# bound, or shows in one recording alone where none validates, has to take off this many times as
# much as others; half widths of that interval within which a name is in doubt where its joint stays
# unexplained: the right law is known well there, for so much stands out of the noise.
_DOUBTFUL_BAR, _DOUBTED = 2.0, 2.0
# Share of the squared mismatch that without a name is left in addition, where it is no doubt.
_NEEDED = 0.25
# Of the simulator's step: shifts in time under it have no name.
_PART_OF_A_STEP = 0.15
# Share of the force that is missing with a law of position which goes with position once more, and
# more than with velocity, where the law has not the shape of what acts; and stretches of either
# that this is told by.
_SAME, _STRETCHES = 0.25, 24


@dataclass(slots=True)
class PrunedModel:
    """A fit, and for each of its terms the rest refitted without it.

    Attributes:
        fitted: what stands.
        rests: without each of its terms.
        notes: of what was taken back.
        absent: evidence of each rest over the fit, where names are judged by that alone.
    """

    fitted: Fitted
    rests: list[Hypothesis]
    notes: list[str]
    absent: Mapping[Term, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Tested:
    """A fit on the tested recordings, and the rest of it, refitted, without each of its terms.

    Attributes:
        problem: what is explained.
        fitted: with all terms.
        confidence: of each term in its place.
        before: (signals,) floors that the nominal model leaves.
        base: (signals,) floors that the fit leaves.
        refitted: without each term.
        levels: (signals,) floors that each of those leaves.
        weights: (signals,) of their fits.
    """

    problem: Problem
    fitted: Fitted
    confidence: Mapping[Term, float]
    before: FloatArray
    base: FloatArray
    refitted: list[Fitted]
    levels: list[FloatArray]
    weights: FloatArray

    @cached_property
    def known(self) -> Spread:
        """How well its parameters are known."""
        return parameter_spread(self.problem, self.fitted, in_parts=False)

    @cached_property
    def errors(self) -> list[JointError]:
        """Of each joint, in noise floors: as the model came, and with the fit."""
        pairs = zip(self.before, self.base, strict=True)
        each = [JointError(float(before), float(after), 1.0, "") for before, after in pairs]
        return each[: len(self.problem.joints)]

    @property
    def terms(self) -> tuple[Term, ...]:
        """Of the fit."""
        return self.fitted.hypothesis.terms

    def chance(self, term: Term) -> float:
        """That it stands in its place."""
        return self.confidence.get(term, 1.0)

    def label(self, k: int) -> str:
        """A term in words."""
        return label(self.problem, self.terms[k])

    def without(self, gone: Sequence[int]) -> Fitted:
        """The rest refitted."""
        if len(gone) == 1:
            return self.refitted[gone[0]]
        rest = self.fitted.hypothesis.without(*(self.terms[k] for k in gone))
        return fit(self.problem, [rest], self.weights, self.problem.fit, iterations=_REFIT)[0]


_Gone = Mapping[int, str]
"""Terms that are taken back, by their place in the fit, and what a reader is told of each."""


def prune(problem: Problem, selected: SelectedModel, *, hurried: bool = False) -> PrunedModel:
    """Take back what explains nothing above the floor, and what explains too little to be right.

    A term stays where some signal of the tested recordings, refitted without it, stands above
    the floor: what lies under it may be noise and the simulator's own error, and has no name. A
    term goes as well where most of its joint's mismatch is left with it: something else is at work
    there, and the nearest name in the catalogue would be a wrong one. What diverges on a recording
    predicts nothing: terms go until nothing diverges.
    """
    notes: list[str] = []
    # What is left too much is asked once, with every term at work: afterwards each removal leaves
    # more for the others.
    judged = False
    fitted = selected.best.fitted
    problem.refine_at(EMPTY)
    (before,) = _levels(problem, [EMPTY], problem.tested)
    while fitted.hypothesis.terms:
        refitted, weights, base, levels = refit_without_each(problem, fitted, hurried)
        tested = _Tested(
            problem, fitted, selected.confidence, before, base, refitted, levels, weights
        )
        gone = next(filter(None, (rule(tested) for rule in _RULES)), {})
        if not gone and not judged:
            judged = True
            gone = _far_from_explained(tested)
        if not gone:
            return PrunedModel(fitted, [f.hypothesis for f in refitted], notes)
        notes += gone.values()
        fitted = _with_slopes(problem, tested.without(list(gone)), weights)
    return PrunedModel(fitted, [], notes)


def _with_slopes(problem: Problem, fitted: Fitted, weights: FloatArray) -> Fitted:
    """The same with its Jacobian."""
    if fitted.jacobian.shape[2] == fitted.hypothesis.theta.size:
        return fitted
    return fit(problem, [fitted.hypothesis], weights, problem.fit, iterations=0)[0]


def _diverging(tested: _Tested) -> _Gone:
    """The least term of a fit that diverges."""
    left = in_floors(tested.fitted.residual, tested.problem.signal_floor)
    if np.isfinite([tested.base, left]).all():
        return {}
    k = int(np.argmin([np.linalg.norm(v) for v in tested.levels]))
    return {k: f"rejected: {tested.label(k)}: the simulation diverges with it"}


def _less_than_none(tested: _Tested) -> _Gone:
    """Friction over the turn that would be less than none on average, and what is dry beside it: a
    brake in one place, which is in no catalogue, passes for such a law where that is cut off at
    zero.
    """
    problem, hypothesis = tested.problem, tested.fitted.hypothesis
    joints = {t.joint for t in tested.terms if problem.less_than_none(hypothesis, t)}
    return {
        k: f"rejected: {tested.label(k)}, the closest known effect: the mean dry friction of the "
        "joint would be negative. The friction probably acts at one position only"
        for k, t in enumerate(tested.terms)
        if t.joint in joints and t.dry_level is not None
    }


def _under_the_floor(tested: _Tested) -> _Gone:
    """The term that takes least off, where that is too little to stand out."""
    problem, fitted = tested.problem, tested.fitted

    def doubtful(t: Term) -> bool:
        # Dry friction that turns to bristles of the least length is dry friction in another form.
        changed = problem.out_of_shape(fitted.hypothesis, t)
        seen_once = not len(problem.held_out) and _recordings_that_show(tested, t) < 2
        return seen_once or changed or _perhaps_absent(fitted, t, tested.known)

    bars = [STANDS_OUT * (_DOUBTFUL_BAR if doubtful(t) else 1.0) for t in tested.terms]
    # What stands with all of them at work is no term's merit.
    others = np.maximum(tested.base**2 - 1.0, 0.0)
    height = [
        float(np.sqrt(np.maximum(v**2 - others, 0.0))[v > _WORSE * tested.base].max(initial=0.0))
        / bar
        for v, bar in zip(tested.levels, bars, strict=True)
    ]
    k = int(np.argmin(height))
    if height[k] > 1.0:
        return {}
    return {
        k: f"rejected: {tested.label(k)}: it reduces the residual by less than {bars[k]:g} times "
        "the noise floor"
    }


def _recordings_that_show(tested: _Tested, term: Term) -> int:
    """How many of the fitted recordings have a signal that is predicted worse without a term."""
    problem = tested.problem
    without = tested.refitted[tested.terms.index(term)].residual
    segments = problem.simulator.segments
    owner = np.repeat([segments[s].trial for s in problem.fit], problem.lengths(problem.fit))
    shown = 0
    for trial in np.unique(owner):
        mine = owner == trial
        levels = (
            in_floors(r[mine], problem.signal_floor) for r in (without, tested.fitted.residual)
        )
        worse, base = levels
        shown += bool((worse > np.maximum(_WORSE * base, STANDS_OUT)).any())
    return shown


def _as_good_as_rigid(tested: _Tested) -> _Gone:
    """A gear that gives as little as none, by its own interval: a motor apart from its link is
    stepped in another way than one with it, and what that takes off is no gear's merit.
    """
    for k, t in enumerate(tested.terms):
        apart = t.law.is_elastic_transmission
        if apart and _perhaps_absent(tested.fitted, t, tested.known):
            return {
                k: f"rejected: {tested.label(k)}: its 95 % interval includes a rigid transmission"
            }
    return {}


def _within_a_step(tested: _Tested) -> _Gone:
    """A delay or a drift that shifts nothing by more than a small part of the simulator's step: how
    far into a step a drive answers is no property of the robot.
    """
    problem = tested.problem
    for k, t in enumerate(tested.terms):
        shift = longest_shift(problem, tested.fitted.hypothesis, t)
        if 0.0 < shift < _PART_OF_A_STEP * problem.simulator.timestep:
            return {
                k: f"rejected: {tested.label(k)}: it shifts signals by at most {1e3 * shift:.2g} "
                f"ms, a small part of the time step ({1e3 * problem.simulator.timestep:.2g} ms)"
            }
    return {}


def longest_shift(problem: Problem, hypothesis: Hypothesis, term: Term) -> float:
    """s by which a law of timing shifts a command or a reading at most, 0 where it is none."""
    if term.law.family != "timing":
        return 0.0
    theta = hypothesis.theta[hypothesis.slice_of(term)]
    values = {
        p.name: np.full((1, 1), x * problem.scales.value(p, term.joint))
        for p, x in zip(term.parameters, theta, strict=True)
    }
    stamps = [s.time[[0, -1]] for s in problem.simulator.segments]
    ends = np.array([min(t[0] for t in stamps), max(t[1] for t in stamps)])[None, :, None]
    late = term.law.command_latency(values)
    of_reading = term.law.sample_time(ends, values) - ends
    return float(max(np.abs(of_reading).max(), 0.0 if late is None else np.abs(late).max()))


def _idle(tested: _Tested) -> _Gone:
    """The term without which least more is left, of those that take no worthwhile share off."""
    one, levels = np.ones(len(tested.base)), tested.levels
    idle = []
    for k, (term, level) in enumerate(zip(tested.terms, levels, strict=True)):
        acting = tested.problem.acted_on(tested.fitted.hypothesis.without(term).terms)
        whole = own_mismatch(one, tested.before**2, level**2, acting)
        if not worth_a_name(one, level**2, tested.base**2, whole):
            idle.append(k)
    if not idle:
        return {}
    k = min(idle, key=lambda k: float(np.linalg.norm(levels[k])))
    return {k: f"rejected: {tested.label(k)}: it removes too little of the remaining error"}


def _slight(tested: _Tested) -> _Gone:
    """A term that hardly matters and that others could replace; not where its own joint would stay
    unexplained without it, beside one that is far more at another.
    """
    whole = float(np.sum(tested.before**2))
    for k, t in enumerate(tested.terms):
        taken = float(np.sum(tested.levels[k] ** 2 - tested.base**2))
        left = float(tested.levels[k][_columns(tested.problem, t)].max())
        slight = taken < _SLIGHT * whole and not (_needed(tested, k) and left > AT_FLOOR)
        if slight and tested.chance(t) < _UNSURE:
            return {
                k: f"rejected: {tested.label(k)}: it removes less than {100 * _SLIGHT:g} % of the "
                "squared error, and other effects can explain that part"
            }
    return {}


def _unlikely(tested: _Tested) -> _Gone:
    """The least likely of several terms, where others are likelier in its place."""
    chances = [tested.chance(t) for t in tested.terms]
    k = int(np.argmin(chances))
    if len(chances) == 1 or chances[k] >= _UNLIKELY:
        return {}
    return {
        k: f"rejected: {tested.label(k)}: other effects are more likely, and the recordings do not "
        "separate them"
    }


def _stretched(tested: _Tested) -> _Gone:
    """Terms at a physical bound, perhaps absent and not needed, or not likely, at joints that stay
    unexplained with them.
    """
    problem, hypothesis = tested.problem, tested.fitted.hypothesis
    explained = [error.explained for error in tested.errors]
    gone = {}
    for k, t in enumerate(tested.terms):
        if all(explained) if t.joint < 0 else explained[t.joint]:
            continue
        likely = tested.chance(t) >= _EVEN
        at_an_end = hypothesis.at_bound(t) or problem.out_of_shape(hypothesis, t)
        if likely and not at_an_end and not _in_doubt(tested, k):
            continue
        why = (
            "a parameter is at its physical bound, or its 95 % interval includes zero"
            if likely
            else "other effects are more likely"
        )
        gone[k] = (
            f"rejected: {tested.label(k)}, the closest known effect: {why}, and a residual remains"
        )
    return gone


def _misshapen(tested: _Tested) -> _Gone:
    """A law of position at a joint that stays unexplained, where the force that is missing with it
    goes with position as well: something else acts there (a cable that goes slack is no spring).
    """
    for k, t in enumerate(tested.terms):
        if t.joint < 0 or not t.law.depends_only_on_position:
            continue
        error = tested.errors[t.joint]
        if error.explained or error.fraction <= LEFT:
            continue
        share, of_velocity = _shares(tested.problem, tested.fitted.hypothesis, t.joint)
        if share > max(_SAME, of_velocity):
            return {
                k: f"rejected: {tested.label(k)}, the closest known effect: {100 * share:.0f} % of "
                "the force that is still missing depends on the joint's position, so the true "
                "dependence on position is another"
            }
    return {}


def _shares(problem: Problem, hypothesis: Hypothesis, joint: int) -> tuple[float, float]:
    """Shares of the variance of a joint's missing force that its position and velocity explain."""
    segments = problem.simulator.segments
    (residual,) = problem.residuals([hypothesis], problem.everywhere)
    force = missing_force(problem, residual, problem.floor).force[:, joint]
    whole = float(np.var(force)) * len(force)
    if not np.isfinite(whole) or whole <= 0.0:
        return 0.0, 0.0

    def share(values: FloatArray) -> float:
        stretches = np.array_split(force[np.argsort(values, kind="stable")], _STRETCHES)
        return 1.0 - sum(float(np.var(part)) * len(part) for part in stretches) / whole

    motion = [derivatives(s.time, s.position[:, joint : joint + 1]) for s in segments]
    position, velocity = (np.concatenate([m[order][:, 0] for m in motion]) for order in (0, 1))
    return share(position), share(velocity)


_RULES: tuple[Callable[[_Tested], _Gone], ...] = (
    _diverging, _less_than_none, _under_the_floor, _as_good_as_rigid, _within_a_step, _idle,
    _slight, _unlikely, _stretched, _misshapen,
)  # fmt: skip


def _far_from_explained(tested: _Tested) -> _Gone:
    """Terms with all of which most is left where they act."""
    gone = {}
    for k, t in enumerate(tested.terms):
        share = _too_little(
            tested.problem, t, *_shown(tested, t),
            several=sum(other.joint == t.joint >= 0 for other in tested.terms) > 1,
            sure=tested.chance(t) >= _SURE and not tested.fitted.hypothesis.at_bound(t),
        )  # fmt: skip
        if share > 0.0:
            gone[k] = (
                f"rejected: {tested.label(k)}, the closest known effect: {100 * share:.0f} % of "
                "the squared error remains there with all effects fitted"
            )
    return gone


def _shown(tested: _Tested, term: Term) -> tuple[FloatArray, FloatArray]:
    """(signals,) floors that the nominal model leaves and that the fit does, of recordings that
    show the mismatch where a term acts: of all, where those that no fit has seen are at the floor
    with the nominal model. What they leave of so little is no share to judge by.
    """
    problem = tested.problem
    hardly = tested.before[_columns(problem, term)].max() <= AT_FLOOR
    if not hardly or not len(problem.held_out):
        return tested.before, tested.base
    problem.refine_at(EMPTY)
    (before,) = _levels(problem, [EMPTY], problem.everywhere)
    problem.refine_at(tested.fitted.hypothesis)
    (base,) = _levels(problem, [tested.fitted.hypothesis], problem.everywhere)
    return before, base


def keep_named(comparison: ModelComparison, best: ScoredModel) -> PrunedModel:
    """Names that were judged elsewhere: all of them stay that pay for themselves here, by absolute
    deviations, as whole motions of a joint that sticks and slips are fitted.
    """
    notes: list[str] = []
    while best.hypothesis.terms:
        terms = best.hypothesis.terms
        comparison.problem.refine_at(best.hypothesis)
        starts = [best.hypothesis.without(t) for t in terms]
        rests = comparison.rivals(starts, comparison.weights(best), _REFIT)
        comparison.judge(rests, best, likelihood=laplace_log_likelihood)
        least = max(range(len(terms)), key=lambda k: rests[k].evidence)
        if rests[least].evidence < 0.0:
            absent = {t: r.evidence for t, r in zip(terms, rests, strict=True)}
            return PrunedModel(best.fitted, [r.hypothesis for r in rests], notes, absent)
        notes.append(
            f"rejected: {label(comparison.problem, terms[least])}: it reduces the error over whole "
            "recordings too little"
        )
        (best,) = comparison.rivals(
            [rests[least].hypothesis], comparison.weights(best), 0, slopes=True
        )
    return PrunedModel(best.fitted, [], notes)


def _levels(
    problem: Problem, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
) -> list[FloatArray]:
    """What each leaves of some recordings, (signals,) in noise floors."""
    residuals = problem.residuals(hypotheses, segments)
    return [in_floors(residual, problem.signal_floor) for residual in residuals]


def refit_without_each(
    problem: Problem, fitted: Fitted, hurried: bool = False
) -> tuple[list[Fitted], FloatArray, FloatArray, list[FloatArray]]:
    """The rest refitted without each of the terms, the weights of that, what the fit leaves, and
    what each rest does; with the simulator's step corrected for the fit.

    The first step of each takes the slopes of the fit; in a hurry it is the only one.
    """
    problem.refine_at(fitted.hypothesis)
    weights = 1.0 / (problem.signal_floor * np.hypot(_finite_floors(fitted, problem), 1.0))
    starts = [fitted.hypothesis.without(t) for t in fitted.hypothesis.terms]
    shared = [
        fitted.jacobian[:, :, fitted.hypothesis.parameters_without(t)]
        for t in fitted.hypothesis.terms
    ]
    refitted = fit(
        problem, starts, weights, problem.fit,
        iterations=1 if hurried else _REFIT, slopes=False, jacobians=shared,
    )  # fmt: skip
    each = [fitted.hypothesis, *(f.hypothesis for f in refitted)]
    base, *levels = _levels(problem, each, problem.tested)
    return refitted, weights, base, levels


def _in_doubt(tested: _Tested, k: int) -> bool:
    """Whether a term is perhaps absent.

    Not where it is needed there, however wide its interval: that is what small deviations say.
    """
    if _needed(tested, k):
        return False
    return _perhaps_absent(tested.fitted, tested.terms[k], tested.known, _DOUBTED)


def _needed(tested: _Tested, k: int) -> bool:
    """Whether without a term so much more is left where it acts, refitted, that something like it
    is there.
    """
    columns = _columns(tested.problem, tested.terms[k])
    more = tested.levels[k][columns] ** 2 - tested.base[columns] ** 2
    return bool((more > _NEEDED * tested.before[columns] ** 2).any())


def _columns(problem: Problem, term: Term) -> slice:
    """Signals of the joint where a term acts, or all; of an error of effort readings those alone,
    since it changes no motion.
    """
    joints = len(problem.joints)
    first = joints if term.law.needs_effort_sensor and problem.effort_floor is not None else 0
    return slice(first, None) if term.joint < 0 else slice(first + term.joint, None, joints)


def _perhaps_absent(fitted: Fitted, term: Term, known: Spread, within: float = 1.0) -> bool:
    """Whether the 95 % region of all that switches a term on, so many times as wide, holds its
    absence.

    What the motion follows in leaps alone (when a drive lets go) has no interval, and is there.
    """
    place = fitted.hypothesis.slice_of(term)
    own = term.switches(fitted.hypothesis.theta[place])
    switches = [place.start + k for k in own]
    if not np.any(fitted.jacobian[:, :, switches] != 0.0, axis=(0, 1)).all():
        return False
    neutral = [term.parameters[k].neutral for k in own]
    offset = np.array(neutral, dtype=float) - fitted.hypothesis.theta[switches]
    return known.apart(np.array(switches), offset) <= within


def _too_little(
    problem: Problem,
    term: Term,
    before: FloatArray,
    after: FloatArray,
    *,
    several: bool,
    sure: bool,
) -> float:
    """Share of the squared mismatch that is left where a term acts, if it is too much, else 0.

    An unsure name has to explain more, and so has one that leaves many floors, or is one of several
    at a joint.
    """
    columns = _columns(problem, term)
    mismatch = float(np.maximum(before[columns] ** 2 - 1.0, 0.0).sum())
    left = float(np.maximum(after[columns] ** 2 - 1.0, 0.0).sum())
    share = left / mismatch if mismatch > 0.0 else 0.0
    top = float(after[columns].max())
    bound = _LEFT_SURE if sure else _LEFT_UNSURE
    if top > _FAR_FLOORS:
        bound = _LEFT_FAR
    if several and top > _SEVERAL_FLOORS:
        bound = _LEFT_SEVERAL
    return share if share > bound and top > STANDS_OUT else 0.0


def label(problem: Problem, term: Term) -> str:
    """Effect and joint in words."""
    joint = joint_name(problem, term)
    return term.effect if joint is None else f"{term.effect} at {joint}"


def in_floors(residual: FloatArray, floor: FloatArray) -> FloatArray:
    """(signals,) root mean squares; infinite where a simulation diverged."""
    with np.errstate(over="ignore"):
        level: FloatArray = np.sqrt(np.mean(residual**2, axis=0)) / floor
    return np.where(np.isfinite(level), level, np.inf)


def _finite_floors(fitted: Fitted, problem: Problem) -> FloatArray:
    level = in_floors(fitted.residual, problem.signal_floor)
    return np.where(np.isfinite(level), level, 0.0)


def joint_name(problem: Problem, term: Term) -> str | None:
    """None where it is the whole robot's."""
    return None if term.joint < 0 else problem.joints[term.joint]
