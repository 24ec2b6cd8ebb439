"""A wrong name is worse than none: which terms of what was chosen are taken back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.intervals import Spread, spread
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.rivals import Selected
from pytest_twin.diagnosis.verdict import STANDS_OUT, JointError, worth_a_name
from pytest_twin.effects.base import FloatArray

_REFIT = 4
# A finding takes some signal down by this factor at least.
_WORSE = 1.05
# With more than this share of its joint's squared mismatch left a name is not given.
_SURE = 0.9
_LEFT_SURE, _LEFT_UNSURE = 0.25, 0.2
# Nor, with several at one joint, with this share and so many floors: they hold each other up.
_LEFT_SEVERAL, _SEVERAL_FLOORS = 0.05, 50.0
# A name that rivals could replace has to take this share of the mismatch; one that they would
# replace, had there been time to simulate them, is none beside others, and one that is less likely
# than they are together is none where its joint stays unexplained.
_UNSURE, _SLIGHT = 0.7, 0.01
_UNLIKELY, _EVEN = 0.02, 0.5
# What could be absent, by its own interval, or has predicted nothing that no fit has seen, has to
# take off this many times as much as others; half widths of that interval within which a name is in
# doubt where its joint stays unexplained: the right law is known well there, for so much stands out
# of the noise.
_ABSENT_BAR, _DOUBTED = 2.0, 2.0
# Share of the squared mismatch that without a name is left in addition, where it is no doubt.
_NEEDED = 0.25


@dataclass(slots=True)
class Pruned:
    """A fit, and for each of its terms the rest refitted without it."""

    fitted: Fitted
    rests: list[Hypothesis]
    notes: list[str]


def prune(problem: Problem, selected: Selected) -> Pruned:
    """Take back what explains nothing above the floor, and what explains too little to be right.

    A term stays where some signal of the tested recordings, refitted without it, stands above
    the floor: what lies under it may be noise and the simulator's own error, and has no name. A
    term goes as well where most of its joint's mismatch is left with it: something else is at work
    there, and the nearest name in the catalogue would be a wrong one. What diverges on a recording
    predicts nothing: terms go until nothing diverges.
    """
    notes: list[str] = []
    untested = not len(problem.held_out)
    # What is left too much is asked once, with every term at work: afterwards each removal leaves
    # more for the others.
    judged = False
    fitted = selected.best.fitted
    problem.refine_at(EMPTY)
    (before,) = _levels(problem, [EMPTY])
    while fitted.hypothesis.terms:
        terms = fitted.hypothesis.terms
        refitted, weights, base, levels = _without_each(problem, fitted)
        rests = [f.hypothesis for f in refitted]
        if not np.isfinite([base, in_floors(fitted.residual, problem.signal_floor)]).all():
            least = int(np.argmin([np.linalg.norm(v) for v in levels]))
            notes.append(
                f"with {label(problem, terms[least])} the prediction diverges; it is not claimed"
            )
            fitted = refitted[least]
            continue
        known = spread(problem, fitted)
        bars = [
            STANDS_OUT * (_ABSENT_BAR if untested or _perhaps_absent(fitted, t, known) else 1.0)
            for t in terms
        ]
        # What stands with all of them at work is no term's merit.
        others = np.maximum(base**2 - 1.0, 0.0)
        height = [
            float(np.sqrt(np.maximum(v**2 - others, 0.0))[v > _WORSE * base].max(initial=0.0)) / bar
            for v, bar in zip(levels, bars, strict=True)
        ]
        least = int(np.argmin(height))
        if height[least] <= 1.0:
            notes.append(
                f"{label(problem, terms[least])} takes nothing off that stands more than "
                f"{bars[least]:g} floors high; it is not claimed"
            )
            fitted = refitted[least]
            continue
        one = np.ones(len(base))
        idle = [
            k for k, level in enumerate(levels)
            if not worth_a_name(one, level**2, base**2, before**2)
        ]  # fmt: skip
        if idle:
            least = min(idle, key=lambda k: float(np.linalg.norm(levels[k])))
            notes.append(
                f"{label(problem, terms[least])} takes too little of what is left without it; it "
                "is not claimed"
            )
            fitted = refitted[least]
            continue
        whole = float(np.sum(before**2))
        slight = [
            k for k, t in enumerate(terms)
            if selected.confidence.get(t, 1.0) < _UNSURE
            and float(np.sum(levels[k] ** 2 - base**2)) < _SLIGHT * whole
        ]  # fmt: skip
        if slight:
            notes.append(
                f"{label(problem, terms[slight[0]])} would take less than {100 * _SLIGHT:g} % of "
                "the squared mismatch, and others could in its place; it is not claimed"
            )
            fitted = refitted[slight[0]]
            continue
        chances = [selected.confidence.get(t, 1.0) for t in terms]
        if len(terms) > 1 and min(chances) < _UNLIKELY:
            least = int(np.argmin(chances))
            notes.append(
                f"{label(problem, terms[least])} stands where others are more likely, and they "
                "were not told apart; it is not claimed"
            )
            fitted = refitted[least]
            continue
        likely = {t: c >= _EVEN for t, c in zip(terms, chances, strict=True)}
        needed = {
            t: _much_left(problem, t, before, base, v) for t, v in zip(terms, levels, strict=True)
        }
        stretched = _stretched(problem, fitted, known, before, base, likely, needed)
        if stretched:
            rest = fitted.hypothesis.without(*stretched)
            for t in stretched:
                why = (
                    "stand at a physical bound, or could be absent" if likely[t] else "be likelier"
                )
                notes.append(
                    f"near in the catalogue is {label(problem, t)}, but it would have to {why}, "
                    "and does not explain all; it is not claimed"
                )
            fitted = fit(problem, [rest], weights, problem.fit, iterations=_REFIT)[0]
            continue
        if judged:
            return Pruned(fitted, rests, notes)
        judged = True
        gone = []
        for t in terms:
            share = _too_little(
                problem, t, before, base,
                several=sum(other.joint == t.joint >= 0 for other in terms) > 1,
                sure=selected.confidence.get(t, 1.0) >= _SURE
                and not fitted.hypothesis.at_bound(t),
            )  # fmt: skip
            if share > 0.0:
                gone.append(t)
                notes.append(
                    f"near in the catalogue is {label(problem, t)}, but with all of them "
                    f"{100 * share:.0f} % of the squared mismatch is left there; it is not claimed"
                )
        if not gone:
            return Pruned(fitted, rests, notes)
        rest = fitted.hypothesis.without(*gone)
        fitted = fit(problem, [rest], weights, problem.fit, iterations=_REFIT)[0]
    return Pruned(fitted, [], notes)


def as_named(problem: Problem, fitted: Fitted) -> Pruned:
    """Names that were judged elsewhere: all of them stay that take something off here."""
    notes: list[str] = []
    while True:
        refitted, _, base, levels = _without_each(problem, fitted)
        needed = [((v > _WORSE * base) & (v > STANDS_OUT)).any() for v in levels]
        idle = [k for k, some in enumerate(needed) if not some]
        if not idle:
            return Pruned(fitted, [f.hypothesis for f in refitted], notes)
        least = min(idle, key=lambda k: float(np.linalg.norm(levels[k])))
        notes.append(
            f"{label(problem, fitted.hypothesis.terms[least])} takes nothing off over whole "
            "recordings; it is not claimed"
        )
        fitted = refitted[least]


def _levels(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[FloatArray]:
    """What each leaves of the tested recordings, (signals,) in floors."""
    residuals = problem.residuals(hypotheses, problem.tested)
    return [in_floors(residual, problem.signal_floor) for residual in residuals]


def _without_each(
    problem: Problem, fitted: Fitted
) -> tuple[list[Fitted], FloatArray, FloatArray, list[FloatArray]]:
    """The rest refitted without each of the terms, the weights of that, what the fit leaves, and
    what each rest does; with the simulator's step corrected for the fit.
    """
    problem.refine_at(fitted.hypothesis)
    weights = 1.0 / (problem.signal_floor * np.hypot(_finite_floors(fitted, problem), 1.0))
    starts = [fitted.hypothesis.without(t) for t in fitted.hypothesis.terms]
    refitted = fit(problem, starts, weights, problem.fit, iterations=_REFIT)
    base, *levels = _levels(problem, [fitted.hypothesis, *(f.hypothesis for f in refitted)])
    return refitted, weights, base, levels


def _stretched(
    problem: Problem,
    fitted: Fitted,
    known: Spread,
    before: FloatArray,
    after: FloatArray,
    likely: Mapping[Term, bool],
    needed: Mapping[Term, bool],
) -> list[Term]:
    """Terms at a physical bound, perhaps absent and not needed, or not likely, at joints that stay
    unexplained with them.
    """
    hypothesis, joints = fitted.hypothesis, len(problem.joints)
    explained = np.array([
        JointError(float(b), float(a), 1.0, "").explained
        for b, a in zip(before[:joints], after[:joints], strict=True)
    ])  # fmt: skip
    return [
        t for t in hypothesis.terms
        if not (explained.all() if t.joint < 0 else explained[t.joint])
        and (not likely[t] or hypothesis.at_bound(t) or hypothesis.out_of_shape(t)
             or (not needed[t] and _perhaps_absent(fitted, t, known, _DOUBTED)))
    ]  # fmt: skip


def _much_left(
    problem: Problem, term: Term, before: FloatArray, base: FloatArray, without: FloatArray
) -> bool:
    """Whether without a term so much more is left where it acts, refitted, that something like it
    is there, however wide its interval: that is what small deviations say.
    """
    columns = _columns(problem, term)
    more = without[columns] ** 2 - base[columns] ** 2
    return bool((more > _NEEDED * before[columns] ** 2).any())


def _columns(problem: Problem, term: Term) -> slice:
    """Signals of the joint where a term acts, or all."""
    return slice(None) if term.joint < 0 else slice(term.joint, None, len(problem.joints))


def _perhaps_absent(fitted: Fitted, term: Term, known: Spread, within: float = 1.0) -> bool:
    """Whether the 95 % region of all that switches a term on, so many times as wide, holds its
    absence.

    What the motion follows in leaps alone (when a drive lets go) has no interval, and is there.
    """
    place = fitted.hypothesis.slice_of(term)
    switches = [k for k, p in enumerate(term.parameters, place.start) if p.neutral is not None]
    if not np.any(fitted.jacobian[:, :, switches] != 0.0, axis=(0, 1)).all():
        return False
    neutral = [p.neutral for p in term.parameters if p.neutral is not None]
    offset = np.array(neutral) - fitted.hypothesis.theta[switches]
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

    An unsure name has to explain more, and so has one of several at a joint.
    """
    columns = _columns(problem, term)
    mismatch = float(np.maximum(before[columns] ** 2 - 1.0, 0.0).sum())
    left = float(np.maximum(after[columns] ** 2 - 1.0, 0.0).sum())
    share = left / mismatch if mismatch > 0.0 else 0.0
    top = float(after[columns].max())
    bound = _LEFT_SURE if sure else _LEFT_UNSURE
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
