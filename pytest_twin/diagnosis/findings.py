"""From a chosen structure to findings: parameters with intervals, what each buys, and what next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.intervals import Spread, spread
from pytest_twin.diagnosis.locate import Where, motions, place_of
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.restraint import Pruned, in_floors, joint_name, label
from pytest_twin.diagnosis.search.rivals import Selected
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.effects.base import Parameter
from pytest_twin.trial import Trial

# Without recordings to predict, no name is surer than this.
_UNTESTED = 0.8
_CORRELATED = 0.9
# A name whose parameter stands at its physical bound, or that is told by other joints alone, is no
# surer than this.
_DOUBTED = 0.5
# s from the start of a window of an effort drive, in which what a name does is measured.
_SOON = 0.25
# A finding moves whole motions if it moves them this many times as far as they are off with it: two
# motions that have parted are as far from one another as from a third.
_TOLD = 2.0
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
    pruned: Pruned,
    trials: Sequence[Trial],
) -> Explained:
    """Turn the selected structure into findings.

    Args:
        prepared: the problem.
        selected: its best structure.
        pruned: what of it stands.
        trials: fit, then held-out, as ``prepared`` numbers them.
    """
    problem = prepared.problem
    hypothesis = pruned.fitted.hypothesis
    if not hypothesis.terms:
        return Explained((), hypothesis, notes=pruned.notes)
    width = spread(problem, pruned.fitted)
    problem.refine_at(hypothesis)
    gone = [hypothesis.without(t) for t in hypothesis.terms]
    residuals = problem.residuals([hypothesis, *pruned.rests], problem.everywhere)
    stands = _heights(problem, [hypothesis, *gone])
    in_test = problem.in_test

    def error(residual: FloatArray) -> float:
        return float((in_floors(residual[in_test], problem.signal_floor) ** 2).sum())

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
        if term.joint >= 0 and problem.floor[term.joint] >= UNSEEN:
            confidence = min(confidence, _DOUBTED)
            pruned.notes.append(
                f"{label(problem, term)}: its own encoder says nothing; what it is, and where it "
                "starts, is told by what other joints feel of it alone"
            )
        if hypothesis.at_bound(term) or problem.out_of_shape(hypothesis, term):
            confidence = min(confidence, _DOUBTED)
            pruned.notes.append(
                f"{label(problem, term)}: a parameter stands at its physical bound; something "
                "else may be at work"
            )
        found.append(
            Finding(
                effect=term.effect,
                joint=joint_name(problem, term),
                confidence=confidence,
                parameters=_estimates(problem, hypothesis, term, width),
                where=where,
                held_out_gain=gain,
                stands=height,
                alternatives=tuple(
                    Alternative(t.effect, joint_name(problem, t), c) for t, c in others if c > 1e-4
                )[:4],
                next_test=_next_test(term, [t for t, _ in others]),
                correlated=trade_offs(problem, hypothesis, term, width),
                term=term,
            )
        )
    found.sort(key=lambda f: -f.stands)
    return Explained(tuple(found), hypothesis, width, pruned.notes)


def by_whole_motions(explained: Explained, problem: Problem) -> Explained:
    """Findings of windows, ordered by how far whole motions of ``problem`` move without each.

    A speed that adds up, or a servo that swings, moves them further than any window. Where one of
    them runs away nothing is told, and they stay. So do, behind the others, those that move them no
    further than all that was found is off there: an arm that flails is somewhere else in the end
    whatever changes.
    """
    hypothesis = explained.hypothesis
    gone = [hypothesis.without(f.term) for f in explained.findings]
    stands = _heights(problem, [hypothesis, *gone])
    (errors,) = problem.errors([hypothesis], problem.tested)
    off = float(in_floors(errors[:, : len(problem.joints)], problem.floor).max())
    if not np.isfinite([*stands, off]).all():
        return explained
    moved = [replace(f, stands=s) for f, s in zip(explained.findings, stands, strict=True)]
    order = sorted(moved, key=lambda f: -f.stands if f.stands > _TOLD * off else 0.0)
    return replace(explained, findings=tuple(order))


def _heights(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[float]:
    """Floors by which the predictions of all but the first differ from it, at the joint where most.

    Of positions; of efforts where no position differs. Windows of effort drives count by what
    stands soon after each start: an arm that nothing holds runs away from any change, and what acts
    first has grown most in the end.
    """
    first, *others = problem.predict(hypotheses, problem.tested)
    segments = [problem.simulator.segments[s] for s in problem.tested]
    soon = [
        slice(
            int(np.searchsorted(s.time, s.start + _SOON)) if s.mode == "effort" and s.amid else None
        )
        for s in segments
    ]
    out = []
    for other in others:
        pairs = list(zip(first, other, strict=True))
        position = np.concatenate(
            [a.position[n] - b.position[n] for (a, b), n in zip(pairs, soon, strict=True)]
        )
        height = float(in_floors(position, problem.floor).max())
        if height == 0.0 and problem.effort_floor is not None:
            effort = np.concatenate([a.effort - b.effort for a, b in pairs])
            height = float(in_floors(effort, problem.effort_floor).max())
        out.append(height)
    return out


def _gain(without: float, with_it: float) -> float:
    """Share of a squared error that a finding removes; all of it where it ends a divergence."""
    if not np.isfinite(without):
        return 1.0
    return float(np.clip((without - with_it) / without, -1.0, 1.0)) if without > 0.0 else 0.0


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


def joint_type(problem: Problem, joint: int) -> str:
    """``hinge`` or ``slide``; of the whole robot, the first joint's."""
    model = problem.simulator.segments[0].model
    kind = int(model.jnt_type[problem.simulator.layout.joint_ids[max(joint, 0)]])
    return "slide" if kind == int(mujoco.mjtJoint.mjJNT_SLIDE) else "hinge"


def joint_unit(problem: Problem, joint: int) -> str:
    """``rad`` or ``m``."""
    return "m" if joint_type(problem, joint) == "slide" else "rad"


def _estimates(
    problem: Problem, hypothesis: Hypothesis, term: Term, width: Spread
) -> dict[str, Estimate]:
    place = hypothesis.slice_of(term)
    kind = joint_type(problem, term.joint)
    servo = str(problem.simulator.layout.servo[max(term.joint, 0)])
    found = {}
    has = term.law.has(hypothesis.theta[place])
    for i, p in enumerate(term.parameters, start=place.start):
        if not has[i - place.start]:
            continue
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


def trade_offs(
    problem: Problem, hypothesis: Hypothesis, term: Term, width: Spread
) -> tuple[str, ...]:
    """What is known where two parameters of a fit trade off against each other, a line each."""
    owner = [(t, p) for t in hypothesis.terms for p in t.parameters]
    place = hypothesis.slice_of(term)
    lines = []
    moved = np.flatnonzero(hypothesis.movable)
    for i in moved[(place.start <= moved) & (moved < place.stop)]:
        for k in moved:
            other, q = owner[k]
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
    joint = joint_name(problem, term)
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
        "path": finding.term.law.path,
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
    "Alternative", "Estimate", "Explained", "Finding", "explain", "finding_json",
    "joint_type", "joint_unit",
]  # fmt: skip
