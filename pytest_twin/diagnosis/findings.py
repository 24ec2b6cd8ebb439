"""From a chosen structure to findings: parameters with intervals, what each buys, and what next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.intervals import Spread, spread
from pytest_twin.diagnosis.locate import Where, blame_windows, motions, place_of
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.rivals import Selected
from pytest_twin.diagnosis.verdict import STANDS_OUT, JointError
from pytest_twin.effects.base import FloatArray, Parameter
from pytest_twin.trial import Trial

_REFIT = 4
# Without recordings to predict, no name is surer than this.
_UNTESTED = 0.8
_CORRELATED = 0.9
# A finding takes some signal down by this factor at least.
_WORSE = 1.05
# With more than this share of its joint's squared mismatch left a name is not given.
_SURE = 0.9
_LEFT_SURE, _LEFT_UNSURE = 0.35, 0.25
# A name that rivals could replace has to take this share of the mismatch.
_UNSURE, _SLIGHT = 0.7, 0.01
# What could be absent, by its own interval, has to take off this many times as much as others.
_ABSENT_BAR = 2.0
# A name whose parameter stands at its physical bound is no surer than this.
_BOUNDED = 0.5
# A reciprocal whose interval reaches zero: its inverse is open; this many times the value is said.
_OPEN = 1e3


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter: SI value in ``unit`` and the 95 % interval."""

    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Alternative:
    """A rival in a finding's place."""

    effect: str
    joint: str | None
    confidence: float


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that the data support.

    Attributes:
        effect, joint: what and where; joint None for the whole robot's.
        confidence: share of the evidence against the rivals in its place.
        parameters: name -> estimate.
        where: when and in which regime it shows.
        held_out_gain: fraction of the squared held-out error, in units of each signal's floor,
            that goes when this finding joins the others, those refitted without it.
        stands: floors by which some joint's predicted position (or effort, where no position
            feels it) moves when the finding is taken away from the others as they are; findings
            are ordered by it.
        alternatives: rivals, best first.
        next_test: the recording that would separate it from the best rival.
        correlated: parameters of which only a combination is known, one line each.
        term: in the problem's own numbering.
    """

    effect: str
    joint: str | None
    confidence: float
    parameters: Mapping[str, Estimate]
    where: Where
    held_out_gain: float
    stands: float
    alternatives: tuple[Alternative, ...]
    next_test: str
    correlated: tuple[str, ...]
    term: Term


@dataclass(slots=True)
class Explained:
    """Findings and the predictions behind them.

    Attributes:
        findings: ordered by how much of the mismatch each explains.
        hypothesis: of all of them.
        spread: of its parameters.
    """

    findings: tuple[Finding, ...]
    hypothesis: Hypothesis
    spread: Spread | None = None
    notes: list[str] = field(default_factory=list)


def explain(
    prepared: Prepared,
    selected: Selected,
    trials: Sequence[Trial],
) -> Explained:
    """Turn the selected structure into findings.

    Args:
        prepared: the problem.
        selected: its best structure.
        trials: fit, then held-out, as ``prepared`` numbers them.
    """
    problem = prepared.problem
    pruned = _prune(problem, selected)
    hypothesis = pruned.fitted.hypothesis
    if not hypothesis.terms:
        return Explained((), hypothesis, notes=pruned.notes)
    width = spread(problem, pruned.fitted)
    everywhere = np.arange(len(problem.simulator.segments))
    problem.refine_at(hypothesis)
    gone = [hypothesis.without(t) for t in hypothesis.terms]
    residuals = problem.residuals([hypothesis, *pruned.rests], everywhere)
    stands = _heights(problem, [hypothesis, *gone])
    in_test = _tested(problem)

    def error(residual: FloatArray) -> float:
        return float((_in_floors(residual[in_test], problem.signal_floor) ** 2).sum())

    with_all = error(residuals[0])
    paths = motions(prepared, trials)
    found = []
    for term, without, height in zip(hypothesis.terms, residuals[1:], stands, strict=True):
        gain = _gain(error(without), with_all)
        blame = _blame(problem, term, residuals[0], without)
        at = max(term.joint, 0)
        where = place_of(paths, blame, at, joint_unit(problem, at))
        others = selected.alternatives.get(term, [])
        confidence = selected.confidence.get(term, 1.0)
        if not np.isfinite(confidence):
            # Nothing speaks for it where even what was chosen could not be compared.
            confidence = 0.0
        if not len(problem.held_out):
            confidence = min(confidence, _UNTESTED)
        if at_bound(hypothesis, term):
            confidence = min(confidence, _BOUNDED)
            pruned.notes.append(
                f"{_label(problem, term)}: a parameter stands at its physical bound; something "
                "else may be at work"
            )
        found.append(
            Finding(
                effect=term.effect,
                joint=_joint(problem, term),
                confidence=confidence,
                parameters=_estimates(problem, hypothesis, term, width),
                where=where,
                held_out_gain=gain,
                stands=height,
                alternatives=tuple(
                    Alternative(t.effect, _joint(problem, t), c) for t, c in others if c > 1e-4
                )[:4],
                next_test=_next_test(term, [t for t, _ in others]),
                correlated=_correlations(problem, hypothesis, term, width),
                term=term,
            )
        )
    found.sort(key=lambda f: -f.stands)
    return Explained(tuple(found), hypothesis, width, pruned.notes)


def _heights(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[float]:
    """Floors by which the predictions of all but the first differ from it, at the joint where most.

    Of positions; of efforts where no position differs.
    """
    tested = problem.held_out if len(problem.held_out) else problem.fit
    first, *others = problem.predict(hypotheses, tested)
    out = []
    for other in others:
        pairs = list(zip(first, other, strict=True))
        position = np.concatenate([a.position - b.position for a, b in pairs])
        height = float(_in_floors(position, problem.floor).max())
        if height == 0.0 and problem.effort_floor is not None:
            effort = np.concatenate([a.effort - b.effort for a, b in pairs])
            height = float(_in_floors(effort, problem.effort_floor).max())
        out.append(height)
    return out


@dataclass(slots=True)
class _Pruned:
    """A fit, and for each of its terms the rest refitted without it."""

    fitted: Fitted
    rests: list[Hypothesis]
    notes: list[str]


def _prune(problem: Problem, selected: Selected) -> _Pruned:
    """Take back what explains nothing above the floor, and what explains too little to be right.

    A term stays where some signal of the tested recordings, refitted without it, stands above
    the floor: what lies under it may be noise and the simulator's own error, and has no name. A
    term goes as well where most of its joint's mismatch is left with it: something else is at work
    there, and the nearest name in the catalogue would be a wrong one. What diverges on a recording
    predicts nothing: terms go until nothing diverges.
    """
    notes: list[str] = []
    # Once, with every term at work: afterwards each removal leaves more for the others.
    judged = False
    fitted = selected.best.fitted
    tested = problem.held_out if len(problem.held_out) else problem.fit
    problem.refine_at(EMPTY)
    before = _in_floors(problem.residuals([EMPTY], tested)[0], problem.signal_floor)
    while fitted.hypothesis.terms:
        terms = fitted.hypothesis.terms
        problem.refine_at(fitted.hypothesis)
        weights = 1.0 / (problem.signal_floor * np.hypot(_finite_floors(fitted, problem), 1.0))
        starts = [fitted.hypothesis.without(t) for t in terms]
        refitted = fit(problem, starts, weights, problem.fit, iterations=_REFIT)
        rests = [f.hypothesis for f in refitted]
        with_it, *without = problem.residuals([fitted.hypothesis, *rests], tested)
        base = _in_floors(with_it, problem.signal_floor)
        levels = [_in_floors(residual, problem.signal_floor) for residual in without]
        if not np.isfinite([base, _in_floors(fitted.residual, problem.signal_floor)]).all():
            least = int(np.argmin([np.linalg.norm(v) for v in levels]))
            notes.append(
                f"with {_label(problem, terms[least])} the prediction diverges; it is not claimed"
            )
            fitted = refitted[least]
            continue
        half = spread(problem, fitted).half_width
        bars = [
            STANDS_OUT * (_ABSENT_BAR if _perhaps_absent(fitted.hypothesis, t, half) else 1.0)
            for t in terms
        ]
        height = [
            float(v[v > _WORSE * base].max(initial=0.0)) / bar
            for v, bar in zip(levels, bars, strict=True)
        ]
        least = int(np.argmin(height))
        if height[least] <= 1.0:
            notes.append(
                f"{_label(problem, terms[least])} takes nothing off that stands more than "
                f"{bars[least]:g} floors high; it is not claimed"
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
                f"{_label(problem, terms[slight[0]])} would take less than {100 * _SLIGHT:g} % of "
                "the squared mismatch, and others could in its place; it is not claimed"
            )
            fitted = refitted[slight[0]]
            continue
        if judged:
            return _Pruned(fitted, rests, notes)
        stretched = _stretched(problem, fitted, half, before, base)
        if stretched:
            rest = fitted.hypothesis
            for t in stretched:
                rest = rest.without(t)
                notes.append(
                    f"near in the catalogue is {_label(problem, t)}, but it would have to stand at "
                    "a physical bound, or could be absent, and does not explain all; it is not "
                    "claimed"
                )
            fitted = fit(problem, [rest], weights, problem.fit, iterations=_REFIT)[0]
            continue
        judged = True
        gone = []
        for t in terms:
            share = _too_little(
                problem, t, before, base,
                sure=selected.confidence.get(t, 1.0) >= _SURE
                and not at_bound(fitted.hypothesis, t),
            )  # fmt: skip
            if share > 0.0:
                gone.append(t)
                notes.append(
                    f"near in the catalogue is {_label(problem, t)}, but with all of them "
                    f"{100 * share:.0f} % of the squared mismatch is left there; it is not claimed"
                )
        if not gone:
            return _Pruned(fitted, rests, notes)
        rest = fitted.hypothesis
        for t in gone:
            rest = rest.without(t)
        fitted = fit(problem, [rest], weights, problem.fit, iterations=_REFIT)[0]
    return _Pruned(fitted, [], notes)


def _stretched(
    problem: Problem, fitted: Fitted, half: FloatArray, before: FloatArray, after: FloatArray
) -> list[Term]:
    """Terms at a physical bound, or perhaps absent, at joints that stay unexplained with them."""
    hypothesis, joints = fitted.hypothesis, len(problem.joints)
    explained = np.array([
        JointError(float(b), float(a), 1.0, "").explained
        for b, a in zip(before[:joints], after[:joints], strict=True)
    ])  # fmt: skip
    return [
        t for t in hypothesis.terms
        if not (explained.all() if t.joint < 0 else explained[t.joint])
        and (_perhaps_absent(hypothesis, t, half) or at_bound(hypothesis, t))
    ]  # fmt: skip


def _perhaps_absent(hypothesis: Hypothesis, term: Term, half: FloatArray) -> bool:
    """Whether the 95 % intervals (parameters,) of all that switches a term on hold its absence."""
    place = hypothesis.slice_of(term)
    return all(
        p.neutral is None or abs(value - p.neutral) <= width
        for p, value, width in zip(
            term.parameters, hypothesis.theta[place], half[place], strict=True
        )
    )


def _too_little(
    problem: Problem, term: Term, before: FloatArray, after: FloatArray, *, sure: bool
) -> float:
    """Share of the squared mismatch that is left where a term acts, if it is too much, else 0.

    An unsure name has to explain more.
    """
    joints = len(problem.joints)
    columns = slice(None) if term.joint < 0 else slice(term.joint, None, joints)
    mismatch = float(np.maximum(before[columns] ** 2 - 1.0, 0.0).sum())
    left = float(np.maximum(after[columns] ** 2 - 1.0, 0.0).sum())
    share = left / mismatch if mismatch > 0.0 else 0.0
    top = float(after[columns].max())
    bound = _LEFT_SURE if sure else _LEFT_UNSURE
    return share if share > bound and top > STANDS_OUT else 0.0


def at_bound(hypothesis: Hypothesis, term: Term) -> bool:
    """Whether a parameter that switches the effect on stands at its physical bound."""
    theta = hypothesis.theta[hypothesis.slice_of(term)]
    return any(
        p.neutral is not None and value != p.neutral and not p.lower < value < p.upper
        for p, value in zip(term.parameters, theta, strict=True)
    )


def _label(problem: Problem, term: Term) -> str:
    joint = _joint(problem, term)
    return term.effect if joint is None else f"{term.effect} at {joint}"


def _in_floors(residual: FloatArray, floor: FloatArray) -> FloatArray:
    """(signals,) root mean squares; infinite where a simulation diverged."""
    with np.errstate(over="ignore"):
        level: FloatArray = np.sqrt(np.mean(residual**2, axis=0)) / floor
    return np.where(np.isfinite(level), level, np.inf)


def _finite_floors(fitted: Fitted, problem: Problem) -> FloatArray:
    level = _in_floors(fitted.residual, problem.signal_floor)
    return np.where(np.isfinite(level), level, 0.0)


def _gain(without: float, with_it: float) -> float:
    """Share of a squared error that a finding removes; all of it where it ends a divergence."""
    if not np.isfinite(without):
        return 1.0
    return float(np.clip((without - with_it) / without, -1.0, 1.0)) if without > 0.0 else 0.0


def _tested(problem: Problem) -> NDArray[np.bool_]:
    """(samples,) over all segments: held out, or all that was fitted where nothing is."""
    tested = problem.held_out if len(problem.held_out) else problem.fit
    everywhere = np.arange(len(problem.simulator.segments))
    inside: NDArray[np.bool_] = np.repeat(np.isin(everywhere, tested), problem.lengths(everywhere))
    return inside


def _blame(problem: Problem, term: Term, best: FloatArray, without: FloatArray) -> FloatArray:
    """(samples,) rise of the squared error, in floors, where the term is taken away."""
    rise = (without**2 - best**2) / problem.signal_floor**2
    diverged = ~np.isfinite(rise)
    # All of a stretch that diverges is to blame alike, and no less than any other.
    rise[diverged] = max(float(rise[~diverged].max(initial=0.0)), 1.0)
    joints = len(problem.joints)
    columns = range(rise.shape[1]) if term.joint < 0 else range(term.joint, rise.shape[1], joints)
    total: FloatArray = rise[:, list(columns)].sum(axis=1)
    return np.maximum(total, 0.0)


def _joint(problem: Problem, term: Term) -> str | None:
    return None if term.joint < 0 else problem.joints[term.joint]


def joint_type(problem: Problem, joint: int) -> str:
    """``hinge`` or ``slide``; of the whole robot, the first joint's."""
    model = problem.simulator.segments[0].model
    kind = int(model.jnt_type[problem.simulator.joint_ids[max(joint, 0)]])
    return "slide" if kind == int(mujoco.mjtJoint.mjJNT_SLIDE) else "hinge"


def joint_unit(problem: Problem, joint: int) -> str:
    """``rad`` or ``m``."""
    return "m" if joint_type(problem, joint) == "slide" else "rad"


def _estimates(
    problem: Problem, hypothesis: Hypothesis, term: Term, width: Spread
) -> dict[str, Estimate]:
    place = hypothesis.slice_of(term)
    kind, servo = joint_type(problem, term.joint), str(problem.simulator.servo[max(term.joint, 0)])
    found = {}
    for i, p in enumerate(term.parameters, start=place.start):
        scale = problem.scales.value(p, term.joint)
        found[p.reported_name] = estimate(
            p, float(hypothesis.theta[i]), float(width.half_width[i]), scale, p.unit(kind, servo)
        )
    return found


def estimate(p: Parameter, theta: float, half: float, scale: float, unit: str) -> Estimate:
    """A parameter as it is reported: finite numbers, within its physical bounds.

    Args:
        p: the parameter.
        theta, half: value and half of the interval's width, in multiples of ``scale``; where
            the width is unknown the interval is all that the bounds allow.
        scale: SI units.
        unit: of the reported value.
    """
    half = half if np.isfinite(half) else np.inf
    low, high = (float(x) * scale for x in np.clip([theta - half, theta + half], p.lower, p.upper))
    value = theta * scale
    if p.reciprocal_of is None:
        return Estimate(value, unit, low, high)
    # No reciprocal of zero can be said: an open end is far beyond what the interval does know.
    far = max(high, p.upper * scale / _OPEN) / _OPEN
    value = value if value > far / _OPEN else far
    high = max(high, value)
    return Estimate(p.reported(value), unit, p.reported(high), p.reported(max(low, value / _OPEN)))


def _correlations(
    problem: Problem, hypothesis: Hypothesis, term: Term, width: Spread
) -> tuple[str, ...]:
    """What is known where two parameters trade off against each other."""
    owner = [(t, p) for t in hypothesis.terms for p in t.parameters]
    place = hypothesis.slice_of(term)
    lines = []
    for i in range(place.start, place.stop):
        for k, (other, q) in enumerate(owner):
            rho = float(width.correlation[i, k])
            if k == i or not abs(rho) >= _CORRELATED or (other == term and k < i):
                continue
            p = owner[i][1]
            mine, its = (problem.scales.value(x, t.joint) for x, t in ((p, term), (q, other)))
            sd = np.sqrt(np.diag(width.covariance).clip(1e-300))
            # The direction in which the two move together leaves this sum alone.
            slope = -rho * sd[i] * mine / (sd[k] * its)
            value = hypothesis.theta[i] * mine + slope * hypothesis.theta[k] * its
            narrow = width.quantile * sd[i] * mine * np.sqrt(max(1.0 - rho * rho, 0.0))
            name = _parameter_name(problem, other, q, term)
            lines.append(
                f"{p.name} trades off against {name} (correlation {rho:+.2f}); known well is "
                f"{p.name} {'+' if slope >= 0 else '-'} {abs(slope):.3g} x {name} = "
                f"{value:.4g} +- {narrow:.2g} (SI)"
            )
    return tuple(lines)


def _parameter_name(problem: Problem, term: Term, p: Parameter, beside: Term) -> str:
    if term == beside:
        return p.name
    joint = _joint(problem, term)
    return f"{p.name} of {term.effect}" + ("" if joint is None else f" at {joint}")


def _next_test(term: Term, rivals: Sequence[Term]) -> str:
    """The experiment that separates a term from its best rival."""
    for rival in rivals:
        for one, other in ((term, rival), (rival, term)):
            text = one.law.confused_with.get(other.effect)
            if text is not None:
                return str(text)
        if rival.effect == term.effect and rival.joint != term.joint:
            return "move one joint at a time: the cause stays with its joint"
    texts = term.law.confused_with
    return next(iter(texts.values()), "another recording of the same kind, held out")


def finding_json(finding: Finding) -> dict[str, Any]:
    """As ``diagnosis.json`` has it."""
    out: dict[str, Any] = {
        "effect": finding.effect,
        "joint": finding.joint,
        "confidence": round(finding.confidence, 4),
        "parameters": {
            name: {"value": e.value, "unit": e.unit, "ci95": [e.low, e.high]}
            for name, e in finding.parameters.items()
        },
        "where": {"summary": finding.where.summary, "windows": dict(finding.where.windows)},
        "held_out_gain": round(finding.held_out_gain, 5),
        "alternatives": [
            {"effect": a.effect, "joint": a.joint, "confidence": round(a.confidence, 4)}
            for a in finding.alternatives
        ],
        "next_test": finding.next_test,
    }
    if finding.correlated:
        out["correlated"] = list(finding.correlated)
    return out


__all__ = [
    "Alternative", "Estimate", "Explained", "Finding", "blame_windows", "explain", "finding_json",
    "joint_type", "joint_unit",
]  # fmt: skip
