"""Findings of a search: parameters with intervals, gain, alternatives, next test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.finding_settings import FINDINGS
from pytest_twin.diagnosis.intervals import ParameterUncertainty, parameter_uncertainty
from pytest_twin.diagnosis.locate import TimeAndRegime, locate_error, smooth_motions
from pytest_twin.diagnosis.noise_levels import in_noise_floors, joint_name, label
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.common_effects import idle_parameters
from pytest_twin.diagnosis.search.posterior import AlternativeEffects, NamedModel
from pytest_twin.diagnosis.servo_priors import PriorUse, combine
from pytest_twin.diagnosis.small_corrections import small_corrections
from pytest_twin.diagnosis.verdict import UNSEEN, JointError
from pytest_twin.effects.base import Parameter
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.trial import Trial


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimate of one parameter: value, and 95 % interval from ``low`` to ``high``, in ``unit``."""

    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Alternative:
    """An effect, or a set of effects, that may explain the data instead of findings.

    Attributes:
        effect, joint: of the effect, the first one of a set.
        confidence: posterior share of the set.
        together_with: (effect, joint) of the other effects of the set.
        instead_of: (effect, joint) of the findings that it replaces, where it is more than one.
        prediction_difference: largest RMS difference between the two predictions, in noise floors;
            None if unknown.
    """

    effect: str
    joint: str | None
    confidence: float
    together_with: tuple[tuple[str, str | None], ...] = ()
    instead_of: tuple[tuple[str, str | None], ...] = ()
    prediction_difference: float | None = None


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that the data support.

    Attributes:
        effect, joint: id and joint name; joint None for an effect of the whole robot.
        confidence: posterior share against its alternatives.
        parameters: name -> estimate.
        where: times and regime of motion in which its influence is largest.
        held_out_gain: share of the squared held-out error that the finding removes when it is added
            to the other findings, which were refitted without it.
        influence: largest change of a predicted position without the finding, in noise floors. If
            no position changes, it is that of a measured effort. Findings are ordered by it.
        alternatives: other effects, most likely first.
        next_test: the experiment that separates it from the most likely alternative.
        correlated: parameters of which only a combination is identifiable, one line each.
        term: effect and column of the joint in the problem.
        small: reason why it is a correction of the model instead of missing physics; empty for a
            finding.
    """

    effect: str
    joint: str | None
    confidence: float
    parameters: Mapping[str, Estimate]
    where: TimeAndRegime
    held_out_gain: float
    influence: float
    alternatives: tuple[Alternative, ...]
    next_test: str
    correlated: tuple[str, ...]
    term: Term
    small: str = ""


@dataclass(slots=True)
class Explanation:
    """Findings, with their hypothesis and the covariance of its parameters.

    Attributes:
        findings: the one with the largest influence first.
        hypothesis: all terms with their parameters.
        notes: one line each, for the reader.
        reduced_models: term -> hypothesis of the other terms, refitted without it.
        uncertainty: of the parameters of the fit; None without parameters.
        priors: what became of the priors of the servos.
        of_recordings: the uncertainty without them.
    """

    findings: tuple[Finding, ...]
    hypothesis: Hypothesis
    notes: list[str] = field(default_factory=list)
    reduced_models: Mapping[Term, Hypothesis] = field(default_factory=dict)
    uncertainty: ParameterUncertainty | None = None
    priors: tuple[PriorUse, ...] = ()
    of_recordings: ParameterUncertainty | None = None


def build_explanation(
    prepared: PreparedProblem, named: NamedModel, trials: Sequence[Trial]
) -> Explanation:
    """Findings of the effects that carry a name, with intervals, gains and alternatives.

    Args:
        trials: fitted trials, then held-out trials, in the numbering of ``prepared``.

    Raises:
        OutOfTime: the time of the search is over.
    """
    hypothesis, posterior, notes = named.fitted.hypothesis, named.posterior, list(named.notes)
    if not hypothesis.terms:
        none = parameter_uncertainty(prepared.problem, named.fitted)
        unused = combine(prepared.problem, named.fitted, none).uses
        return Explanation((), hypothesis, notes=notes, priors=unused)
    problem = prepared.problem.at(hypothesis)
    of_recordings = parameter_uncertainty(problem, named.fitted, posterior.nearby)
    combined = combine(problem, named.fitted, of_recordings)
    hypothesis, uncertainty = combined.hypothesis, combined.uncertainty
    without_each = [hypothesis.without(t) for t in hypothesis.terms]
    residuals = problem.residuals([hypothesis, *named.reduced_models], problem.all_segments)
    changes = _prediction_changes(problem, [hypothesis, *without_each])
    influence = [c.largest for c in changes]
    small = named.unresolved | small_corrections(
        problem, hypothesis, np.array([c.positions for c in changes]), _nominal_error(problem)
    )
    gains = _gains(problem, residuals)
    paths = smooth_motions(prepared, trials)
    found = []
    for term, without, gain, largest in zip(
        hypothesis.terms, residuals[1:], gains, influence, strict=True
    ):
        error_increase = _error_increase(problem, term, residuals[0], without)
        at = max(term.joint, 0)
        where = locate_error(paths, error_increase, at, joint_unit(problem, at))
        others = posterior.alternatives.get(term, [])
        confidence = posterior.confidence[term]
        if term.joint >= 0 and problem.floor[term.joint] >= UNSEEN:
            confidence = min(confidence, FINDINGS.most_in_doubt)
            notes.append(
                f"{label(problem, term)}: the encoder of this joint gives no information. The "
                "effect was identified from the other joints only; confidence is at most 50 %"
            )
        if hypothesis.is_at_bound(term) or problem.has_shape_at_bound(hypothesis, term):
            confidence = min(confidence, FINDINGS.most_in_doubt)
            notes.append(
                f"{label(problem, term)}: a parameter is at its physical bound. Another effect may "
                "be the cause; confidence is at most 50 %"
            )
        found.append(
            Finding(
                effect=term.effect,
                joint=joint_name(problem, term),
                confidence=confidence,
                parameters=_build_estimates(problem, hypothesis, term, uncertainty),
                where=where,
                held_out_gain=gain,
                influence=largest,
                alternatives=tuple(
                    _alternative(problem, a) for a in others if _is_worth_listing(a)
                )[: FINDINGS.most_alternatives],
                next_test=_next_test(term, [t for a in others for t in a.new]),
                correlated=describe_correlations(problem, hypothesis, term, uncertainty),
                term=term,
                small=small.get(term, ""),
            )
        )
    found.sort(key=lambda f: -f.influence)
    reduced_models = dict(zip(hypothesis.terms, named.reduced_models, strict=True))
    return Explanation(
        tuple(found), hypothesis, notes, reduced_models, uncertainty, combined.uses,
        of_recordings,
    )  # fmt: skip


def _is_worth_listing(alternative: AlternativeEffects) -> bool:
    """Whether an alternative is reported: it is likely enough, or its prediction is the same.

    The second kind is reported even if its number of effects makes it unlikely.
    """
    same = (
        alternative.prediction_difference is not None
        and alternative.prediction_difference <= FINDINGS.same_prediction
    )
    return alternative.confidence > FINDINGS.least_listed or same


def _alternative(problem: Problem, other: AlternativeEffects) -> Alternative:
    places = [(t.effect, joint_name(problem, t)) for t in other.new]
    replaced = tuple((t.effect, joint_name(problem, t)) for t in other.removed)
    (effect, joint), *more = places
    instead_of = replaced if len(replaced) > 1 else ()
    return Alternative(
        effect, joint, other.confidence, tuple(more), instead_of, other.prediction_difference
    )


def with_gains(explanation: Explanation, gains: Mapping[Term, float]) -> Explanation:
    """The same findings with other held-out gains.

    Args:
        gains: term -> share of the squared held-out error that it removes.
    """
    findings = tuple(replace(f, held_out_gain=gains[f.term]) for f in explanation.findings)
    return replace(explanation, findings=findings)


def limit_contradicted_confidence(explanation: Explanation, notes: list[str]) -> Explanation:
    """The same findings, with at most 50 % confidence if one increases the held-out error.

    Args:
        explanation: findings with their gains on held-out recordings.
        notes: receives a line for each such finding.
    """
    findings = []
    for f in explanation.findings:
        if f.held_out_gain < -FINDINGS.chance:
            name = f.effect if f.joint is None else f"{f.effect} at {f.joint}"
            notes.append(
                f"{name}: it improves the fitted recordings and makes the held-out error larger; "
                "confidence is at most 50 %"
            )
            f = replace(f, confidence=min(f.confidence, FINDINGS.most_in_doubt))
        findings.append(f)
    return replace(explanation, findings=tuple(findings))


def with_unexplained_share(
    explanation: Explanation, errors: Mapping[str, JointError]
) -> Explanation:
    """The same findings, with confidences times the explained share of the error at their joints.

    A confidence compares effects of the catalogue with one another. A residual shows that something
    outside of it acts at the joint, of which a finding may be an imitation. That something counts
    by its share of the log-likelihood: the logarithm of the error that remains, in noise floors,
    over that of the nominal model. An imitation may remove 99.9 % of the squared error.

    Args:
        errors: joint -> errors on the held-out recordings; for a finding of the whole robot the
            joint with the largest unexplained share counts.
    """
    findings = []
    for f in explanation.findings:
        shares = [
            e.unexplained_log_share for joint, e in errors.items() if f.joint in (None, joint)
        ]
        explained = 1.0 - max(shares, default=0.0)
        findings.append(replace(f, confidence=explained * f.confidence))
    return replace(explanation, findings=tuple(findings))


def limit_untested_confidence(explanation: Explanation) -> Explanation:
    """The same findings with at most 90 % confidence, because no recording was held out."""
    findings = tuple(
        replace(f, confidence=min(f.confidence, FINDINGS.most_without_held_out))
        for f in explanation.findings
    )
    return replace(explanation, findings=findings)


def held_out_gains(problem: Problem, explanation: Explanation) -> dict[Term, float]:
    """Term -> share of the squared error on the held-out recordings that it removes.

    Args:
        problem: a problem with the same joints and scales.
        explanation: findings, with the hypotheses that were refitted without each.
    """
    terms = explanation.hypothesis.terms
    each = [explanation.hypothesis, *(explanation.reduced_models[t] for t in terms)]
    problem = problem.at(explanation.hypothesis)
    return dict(
        zip(terms, _gains(problem, problem.residuals(each, problem.all_segments)), strict=True)
    )


def _gains(problem: Problem, residuals: Sequence[FloatArray]) -> list[float]:
    """Share of the squared held-out error that each term removes.

    Args:
        residuals: (samples, signals) over all segments, with all terms, then without each.
    """
    inside = problem.is_in_test
    with_all, *without = (
        float((in_noise_floors(r[inside], problem.signal_floor) ** 2).sum()) for r in residuals
    )
    return [_gain(error, with_all) for error in without]


def order_by_whole_motions(explanation: Explanation, problem: Problem) -> Explanation:
    """Findings of short windows, reordered by their influence on whole motions of ``problem``.

    An integrated velocity or an oscillating servo changes whole motions more than any window. If a
    prediction diverges, the order is kept. Findings that change whole motions by less than
    ``FINDINGS.moves_motions`` times the residual keep their order behind the others: such motions
    have diverged, and their differences carry no information.
    """
    hypothesis = explanation.hypothesis
    problem = problem.at(hypothesis)
    without_each = [hypothesis.without(f.term) for f in explanation.findings]
    influence = differences_in_floors(problem, [hypothesis, *without_each])
    (errors,) = problem.errors([hypothesis], problem.tested_segments)
    residual = float(in_noise_floors(errors[:, : len(problem.joints)], problem.floor).max())
    if not np.isfinite([*influence, residual]).all():
        return explanation
    reordered = [
        replace(f, influence=s) for f, s in zip(explanation.findings, influence, strict=True)
    ]
    least = FINDINGS.moves_motions * residual
    order = sorted(reordered, key=lambda f: -f.influence if f.influence > least else 0.0)
    return replace(explanation, findings=tuple(order))


@dataclass(frozen=True, slots=True)
class _PredictionChange:
    """Difference between two predictions.

    Attributes:
        positions: (joints,) RMS difference of positions, rad or m.
        largest: largest RMS difference of a joint, in noise floors. It is that of efforts if no
            position differs.
    """

    positions: FloatArray
    largest: float


def _prediction_changes(
    problem: Problem, hypotheses: Sequence[Hypothesis]
) -> list[_PredictionChange]:
    """Difference of each prediction to the first.

    In windows under effort commands only the beginning counts: later the open-loop motion diverges
    after any change.
    """
    first, *others = problem.predict(hypotheses, problem.tested_segments)
    segments = [problem.simulator.segments[s] for s in problem.tested_segments]
    beginnings = [
        slice(
            int(np.searchsorted(s.time, s.start + FINDINGS.soon))
            if s.mode == "effort" and s.starts_in_motion
            else None
        )
        for s in segments
    ]
    out = []
    for other in others:
        pairs = list(zip(first, other, strict=True))
        position = np.concatenate(
            [a.position[n] - b.position[n] for (a, b), n in zip(pairs, beginnings, strict=True)]
        )
        levels = in_noise_floors(position, problem.floor)
        largest = float(levels.max())
        if largest == 0.0 and problem.effort_floor is not None:
            effort = np.concatenate([a.effort - b.effort for a, b in pairs])
            largest = float(in_noise_floors(effort, problem.effort_floor).max())
        out.append(_PredictionChange(levels * problem.floor, largest))
    return out


def differences_in_floors(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[float]:
    """Largest difference of each prediction to the first, in noise floors."""
    return [change.largest for change in _prediction_changes(problem, hypotheses)]


def _nominal_error(problem: Problem) -> FloatArray:
    """(joints,) RMS error of the nominal model, rad or m."""
    (errors,) = problem.errors([EMPTY], problem.tested_segments)
    levels = in_noise_floors(errors[:, : len(problem.joints)], problem.floor)
    return np.asarray(levels * problem.floor)


def _gain(without: float, with_it: float) -> float:
    """Share of a squared error that a finding removes; 1 if the simulation diverges without it."""
    if not np.isfinite(without):
        return 1.0
    return float(np.clip((without - with_it) / without, -1.0, 1.0)) if without > 0.0 else 0.0


def _error_increase(
    problem: Problem, term: Term, best: FloatArray, without: FloatArray
) -> FloatArray:
    """(samples,) increase of the squared error without the term, in squared floors."""
    rise = (without**2 - best**2) / problem.signal_floor**2
    diverged = ~np.isfinite(rise)
    # All diverged samples count equally, and at least as much as any other.
    rise[diverged] = max(float(rise[~diverged].max(initial=0.0)), 1.0)
    joints = len(problem.joints)
    columns = range(rise.shape[1]) if term.joint < 0 else range(term.joint, rise.shape[1], joints)
    total: FloatArray = rise[:, list(columns)].sum(axis=1)
    return np.maximum(total, 0.0)


def joint_type(problem: Problem, joint: int) -> str:
    """Type of a joint, ``hinge`` or ``slide``; for the whole robot (-1) that of the first joint."""
    model = problem.simulator.segments[0].model
    kind = int(model.jnt_type[problem.simulator.layout.joint_ids[max(joint, 0)]])
    return "slide" if kind == int(mujoco.mjtJoint.mjJNT_SLIDE) else "hinge"


def joint_unit(problem: Problem, joint: int) -> str:
    """Unit of a joint's position, ``rad`` or ``m``."""
    return "m" if joint_type(problem, joint) == "slide" else "rad"


def _build_estimates(
    problem: Problem, hypothesis: Hypothesis, term: Term, uncertainty: ParameterUncertainty
) -> dict[str, Estimate]:
    place = hypothesis.slice_of(term)
    kind = joint_type(problem, term.joint)
    servo = str(problem.simulator.layout.servo[max(term.joint, 0)])
    found = {}
    has = term.law.has(hypothesis.theta[place])
    has &= ~idle_parameters(problem, [term]).get(term, np.zeros(len(has), dtype=bool))
    for i, p in enumerate(term.parameters, start=place.start):
        if not has[i - place.start]:
            continue
        scale = problem.scales.value(p, term.joint)
        found[p.reported_name] = build_estimate(
            p,
            float(hypothesis.theta[i]),
            float(uncertainty.half_width[i]),
            scale,
            p.unit(kind, servo),
        )
    return found


def build_estimate(p: Parameter, theta: float, half: float, scale: float, unit: str) -> Estimate:
    """The reported value and 95 % interval of a parameter, finite and within its bounds.

    Args:
        theta, half: value and half width of the interval, in multiples of ``scale``. If the width
            is not finite, the interval is the whole range of the bounds.
        scale: reference scale in SI units.
        unit: unit of the reported value.
    """
    half = half if np.isfinite(half) else np.inf
    low, high = (float(x) * scale for x in np.clip([theta - half, theta + half], p.lower, p.upper))
    value = theta * scale
    if p.reciprocal_of is None:
        return Estimate(value, unit, low, high)
    # The reciprocal of zero is infinite: report a finite end far beyond the other one.
    far = max(high, p.upper * scale / FINDINGS.unbounded) / FINDINGS.unbounded
    value = value if value > far / FINDINGS.unbounded else far
    high = max(high, value)
    return Estimate(
        p.reported(value), unit, p.reported(high), p.reported(max(low, value / FINDINGS.unbounded))
    )


def describe_correlations(
    problem: Problem, hypothesis: Hypothesis, term: Term, uncertainty: ParameterUncertainty
) -> tuple[str, ...]:
    """One line for each pair of strongly correlated parameters: the combination that is known.

    Args:
        hypothesis: all terms with their parameters.
        term: the term whose parameters are described.
        uncertainty: covariance and correlation of the parameters.
    """
    owner = [(t, p) for t in hypothesis.terms for p in t.parameters]
    place = hypothesis.slice_of(term)
    lines = []
    moved = np.flatnonzero(hypothesis.is_estimated)
    for i in moved[(place.start <= moved) & (moved < place.stop)]:
        for k in moved:
            other, q = owner[k]
            rho = float(uncertainty.correlation[i, k])
            if k == i or not abs(rho) >= FINDINGS.correlated or (other == term and k < i):
                continue
            p = owner[i][1]
            p_scale = problem.scales.value(p, term.joint)
            q_scale = problem.scales.value(q, other.joint)
            sd = np.sqrt(np.diag(uncertainty.covariance).clip(1e-300))
            # This combination is constant along the correlated direction.
            slope = -rho * sd[i] * p_scale / (sd[k] * q_scale)
            value = hypothesis.theta[i] * p_scale + slope * hypothesis.theta[k] * q_scale
            half_width = uncertainty.quantile * sd[i] * p_scale * np.sqrt(max(1.0 - rho * rho, 0.0))
            name = _parameter_name(problem, other, q, term)
            lines.append(
                f"{p.name} and {name} are strongly correlated ({rho:+.2f}); better known is "
                f"{p.name} {'+' if slope >= 0 else '-'} {abs(slope):.3g} x {name} = "
                f"{value:.4g} +- {half_width:.2g} (SI units, 95 %)"
            )
    return tuple(lines)


def _parameter_name(problem: Problem, term: Term, p: Parameter, described: Term) -> str:
    """Name of a parameter, with its effect and joint unless it belongs to the described term."""
    if term == described:
        return p.name
    joint = joint_name(problem, term)
    return f"{p.name} of {term.effect}" + ("" if joint is None else f" at {joint}")


def _next_test(term: Term, alternatives: Sequence[Term]) -> str:
    """The experiment that separates a term from its most likely alternative."""
    for alternative in alternatives:
        for one, other in ((term, alternative), (alternative, term)):
            text = one.law.confused_with.get(other.effect)
            if text is not None:
                return str(text)
        if alternative.effect == term.effect and alternative.joint != term.joint:
            return "move one joint at a time: only the faulty joint shows the error"
    texts = term.law.confused_with
    return next(iter(texts.values()), "make another recording of the same kind and hold it out")


def finding_json(finding: Finding) -> dict[str, Any]:
    """The finding as an object of ``diagnosis.json``."""
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
        "alternatives": [_alternative_json(a) for a in finding.alternatives],
        "next_test": finding.next_test,
    }
    if finding.correlated:
        out["correlated"] = list(finding.correlated)
    if finding.small:
        out["why_small"] = finding.small
    return out


def _alternative_json(alternative: Alternative) -> dict[str, Any]:
    out: dict[str, Any] = {
        "effect": alternative.effect,
        "joint": alternative.joint,
        "confidence": round(alternative.confidence, 4),
    }
    for key in ("together_with", "instead_of"):
        places = getattr(alternative, key)
        if places:
            out[key] = [{"effect": effect, "joint": joint} for effect, joint in places]
    if alternative.prediction_difference is not None:
        out["difference_in_floors"] = round(alternative.prediction_difference, 3)
    return out


__all__ = [
    "Alternative", "Estimate", "Explanation", "Finding", "build_explanation", "finding_json",
    "joint_type", "joint_unit",
]  # fmt: skip
