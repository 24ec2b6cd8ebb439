"""Corrections that are statistically significant but of no practical consequence.

Examples: 0.4 ms of delay in recordings with 4 ms between samples, or 1 % of a gain. Such a
correction belongs into the patched model, but it is not missing physics.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.correction_settings import CORRECTIONS
from pytest_twin.diagnosis.physical_totals import totals
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import Hypothesis, Term

_USUAL = "it is within the accuracy to which such parameters are usually known"


def small_corrections(
    problem: Problem, hypothesis: Hypothesis, changes: FloatArray, before: FloatArray
) -> dict[Term, str]:
    """Terms that are corrections of no consequence, and the reason of each.

    There are two reasons. The parameters of the term are within their usual accuracy. Or the term
    changes every prediction by less than a tenth of the nominal model's error, and other terms
    explain that error.

    Args:
        hypothesis: all effects.
        changes: (terms, joints) RMS change of predicted positions without each term, rad or m.
        before: (joints,) RMS error of the nominal model, rad or m.
    """
    floor = problem.floor
    mismatch = np.sqrt(np.maximum(before**2 - floor**2, 0.0))
    limit = np.maximum(
        CORRECTIONS.of_mismatch * mismatch,
        np.where(mismatch > VERDICT.at_floor * floor, 0.0, floor),
    )
    out: dict[Term, str] = {}
    for term in hypothesis.terms:
        why = _within_usual_accuracy(problem, hypothesis, term)
        if why:
            out[term] = why
    others = [t for t in hypothesis.terms if t not in out]
    slight = [
        t for t in others
        if np.isfinite(row := changes[hypothesis.terms.index(t)]).all()
        and row.any() and (row <= limit).all()
    ]  # fmt: skip
    if len(slight) < len(others):
        why = (
            f"it changes predictions by less than {CORRECTIONS.of_mismatch:g} of the model's error"
        )
        out.update(dict.fromkeys(slight, why))
    return out


def _within_usual_accuracy(problem: Problem, hypothesis: Hypothesis, term: Term) -> str:
    """Reason why a correction is within the usual accuracy of a model; empty if it is not."""
    shift = _longest_shift(problem, hypothesis, term)
    if shift > 0.0:
        intervals = [np.median(np.diff(s.time)) for s in problem.simulator.segments]
        interval = float(np.median(intervals))
        if shift < CORRECTIONS.of_sample * interval:
            return f"it is less than {CORRECTIONS.of_sample:g} of the time between samples"
        return ""
    theta = hypothesis.theta[hypothesis.slice_of(term)]
    has = term.law.has(theta)
    amplitude_indices = [k for k in term.amplitude_indices(theta) if has[k]]
    own = {
        at: total.own
        for total in totals(problem, hypothesis)
        for t, at, _ in total.parts
        if t == term
    }
    start = hypothesis.slice_of(term).start
    for k in amplitude_indices:
        p = term.parameters[k]
        value = abs(float(theta[k]) * problem.scales.value(p, term.joint))
        if start + k in own:
            within = value <= CORRECTIONS.of_own * own[start + k]
        elif p.relation == "relative" and term.law.family == "rigid_body":
            within = value <= CORRECTIONS.of_body
        elif p.relation == "relative" and term.law.family == "actuation":
            within = value <= CORRECTIONS.of_gain
        else:
            within = False
        if not within:
            return ""
    return _USUAL if amplitude_indices else ""


def _longest_shift(problem: Problem, hypothesis: Hypothesis, term: Term) -> float:
    """Greatest shift, s, of a command or a reading by a timing effect; 0 for other effects."""
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
