"""``diagnosis.json`` of a comparison with earlier recordings by simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.by_simulation import SimulatedChanges
from pytest_twin.changes.comparison import Comparison
from pytest_twin.changes.document import (
    alarm_json,
    difference_series,
    number,
    undecided_json,
    verdict_of,
)
from pytest_twin.changes.naming import Candidate, Change
from pytest_twin.changes.repeated import RepeatedMotion
from pytest_twin.changes.undone import REALIZATION, Counterfactual
from pytest_twin.diagnosis.findings import Estimate, Finding, finding_json
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Parameter, si_unit
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis
from pytest_twin.formats.record_fields import Z95
from pytest_twin.trial import Trial

_MOST_UNFINISHED = 0.5
"""Largest confidence of a change that no simulation has tested, or that may be older, and of all
where a limit ended the search over the earlier recordings: what it has not found there may pass for
a change along other motions."""


def simulated_document(
    found: SimulatedChanges,
    *,
    level: float,
    release: int | None = None,
    counterfactual: Counterfactual | None = None,
) -> dict[str, Any]:
    """Content of ``diagnosis.json`` with ``--before`` by simulation, schema 1.

    Args:
        level: level of the alarm.
        release: number of the release whose recordings are the earlier ones.
        counterfactual: of the written model; None if none was written.
    """
    comparison, joints = found.comparison, found.laws.joints
    findings = _findings(found)
    units = [si_unit("position", slide) for slide in found.laws.slides]
    document = {
        "schema": 1,
        "verdict": verdict_of(found.is_changed, bool(findings)),
        "by": "simulation",
        "before": {"recordings": _names(found.before), "release": release},
        "new": _names(found.new),
        "findings": findings,
        **undecided_json(undecided_by_simulation(comparison, is_named=bool(findings)), joints),
        "alarm": alarm_json(comparison, level, found.sessions) | {"repeated": _alarm(found)},
        "position": _residuals(found, units),
        "repeated": [_repeated(motion, dict(zip(joints, units, strict=True)))
                     for motion in found.repeated],
        "model_changes": [],
        "notes": [*found.notes, *_doubts(found)],
    }  # fmt: skip
    if counterfactual is not None:
        document |= {
            "realization": f"{REALIZATION}/",
            "counterfactual": {
                "holds": counterfactual.holds,
                "joints": {
                    joint: {
                        "rms_known": number(counterfactual.known[joint]),
                        "rms_undone": number(counterfactual.undone[joint]),
                        "rms_changed": number(counterfactual.changed[joint]),
                        "unit": unit,
                    }
                    for joint, unit in zip(joints, units, strict=True)
                },
            },
        }
    return document


def _alarm(found: SimulatedChanges) -> dict[str, Any] | None:
    """The repeated motion whose difference is least likely; null without one."""
    least = found.least_likely
    if least is None:
        return None
    return {
        "recording": least.new.path.name, "joint": least.joint,
        "probability": number(least.probability),
    }  # fmt: skip


def _residuals(found: SimulatedChanges, units: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Joint -> RMS error of the model of the earlier recordings: in them, in the new ones, and with
    the changes.
    """
    joints = found.laws.joints
    if found.found is None:
        usual, now = _rms_of_rows(found)
        after = now
    else:
        known, tested = found.known.found, found.found.tested
        earlier, later = known.prepared.problem, tested.prepared.problem
        usual = _rms_errors(joints, earlier, known.explanation.hypothesis, earlier.fit)
        now, after = (
            _rms_errors(joints, later, hypothesis, later.tested_segments)
            for hypothesis in (EMPTY, tested.explanation.hypothesis)
        )
    return {
        joint: {
            "rms_usual": number(usual[j]), "rms_before": number(now[j]),
            "rms_after": number(after[j]), "unit": units[j],
        }
        for j, joint in enumerate(joints)
    }  # fmt: skip


def _rms_of_rows(found: SimulatedChanges) -> tuple[FloatArray, FloatArray]:
    """(joints,) RMS error in the earlier and in the new rows, rad or m.

    The rows are means over short times, which average the noise.
    """
    new = {trial.path for trial in found.new}
    earlier, later = (
        np.concatenate(
            [part.effort for part in found.laws.parts if (part.recording.path in new) is is_new]
        )
        for is_new in (False, True)
    )
    return _rms(earlier), _rms(later)


def _rms_errors(
    joints: Sequence[str], problem: Problem, hypothesis: Hypothesis, segments: NDArray[np.int64]
) -> FloatArray:
    """(joints,) RMS error of the positions, rad or m; NaN at a joint that the problem lacks."""
    (errors,) = problem.at(hypothesis).errors([hypothesis], segments)
    of_problem = dict(zip(problem.joints, _rms(errors), strict=False))
    return np.array([of_problem.get(joint, np.nan) for joint in joints])


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _repeated(motion: RepeatedMotion, units: Mapping[str, str]) -> dict[str, Any]:
    return {
        "new": motion.new.path.name,
        "before": _names(motion.before),
        "difference": {
            joint: {
                "rms": number(rms),
                "rms_after": number(motion.remains[joint]) if joint in motion.remains else None,
                "unit": units[joint],
            }
            for joint, rms in motion.difference.items()
            if joint in units
        },
    }


def _doubts(found: SimulatedChanges) -> list[str]:
    """Why changes may be none: a line for each that the earlier recordings do not exclude."""
    if found.found is None:
        return []
    unfinished = [] if found.is_known_complete else [
        "what the search over the earlier recordings has not found may pass for a change; "
        "confidence is at most 50 %"
    ]  # fmt: skip
    return unfinished + [
        f"{f.effect}{'' if f.joint is None else f' at {f.joint}'}: the earlier recordings are "
        "predicted as well with it, so it may have been there before; confidence is at most 50 %"
        for f in found.found.explanation.findings
        if f.term in found.uncertain_before
    ]


def _findings(found: SimulatedChanges) -> list[dict[str, Any]]:
    """Changes by simulation; where the search could not end, also those of the linear comparison.

    A change that no simulation has tested has a confidence of at most one half.
    """
    if found.found is None:
        return []
    by_simulation = [f for f in found.found.explanation.findings if not f.small]
    if by_simulation or found.is_complete:
        return [_simulated(found, finding) for finding in by_simulation]
    return [_linear(found, change) for change in found.comparison.changes]


def undecided_by_simulation(comparison: Comparison, *, is_named: bool) -> Comparison:
    """The comparison with the candidates that no simulation has confirmed.

    They count half, as a change that no simulation has tested does. Where the search
    does not confirm the law that the linear comparison names, that law and its rivals are the
    candidates.

    Args:
        is_named: whether there are findings: their alternatives say what else is possible.
    """
    if is_named:
        return replace(comparison, candidates=())
    candidates = comparison.candidates
    if comparison.changes:
        first = comparison.changes[0]
        laws = {first.shape.term: first.confidence, **first.rivals}
        candidates = tuple(Candidate((term,), None, p) for term, p in laws.items())
    return replace(
        comparison,
        candidates=tuple(
            replace(one, probability=_MOST_UNFINISHED * one.probability) for one in candidates
        ),
    )


def _simulated(found: SimulatedChanges, finding: Finding) -> dict[str, Any]:
    document = finding_json(finding)
    known, change, now = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    earlier = _known_before(found, finding.effect, finding.joint)
    law = catalogue()[finding.effect]
    by_name = {p.reported_name: p for p in law.parameters}
    carried = found.carried.get(finding.term, {})
    for name, estimate in finding.parameters.items():
        p = by_name[name]
        if p.reciprocal_of is None:
            estimate = _widened(estimate, carried.get(p.name, 0.0))
        before = earlier.get(name) or _absent(p, estimate)
        if p.neutral is None or (p.reciprocal_of is not None and name not in earlier):
            # A shape has no difference; a limit that was absent was infinite.
            now[name] = _json(estimate)
            if name in earlier:
                known[name] = _json(before)
            continue
        known[name] = _json(before)
        change[name] = _json(_difference(p, before, estimate))
        now[name] = _json(_total(p, before, estimate))
    document |= {"parameters": now, "change": change, "known_before": known}
    document |= _new_in_positions(found, finding)
    if finding.term in found.uncertain_before or not found.is_known_complete:
        document["confidence"] = min(document["confidence"], _MOST_UNFINISHED)
    if not found.held_out:
        document["held_out_gain"] = None
        document["residual_gain"] = round(finding.held_out_gain, 5)
    return document


def _new_in_positions(found: SimulatedChanges, finding: Finding) -> dict[str, Any]:
    """New minus earlier positions where a change acts most, measured and as the change predicts.

    The earlier positions are those that the model with the other changes predicts.
    """
    assert found.found is not None
    tested = found.found.tested
    problem, best = tested.prepared.problem, tested.explanation.hypothesis
    term = next(
        (
            t for t in best.terms
            if t.effect == finding.effect
            and (None if t.joint < 0 else problem.joints[t.joint]) == finding.joint
        ),
        None,
    )  # fmt: skip
    if term is None:
        # The test recordings lack its joint.
        return {}
    segments, joints = problem.tested_segments, len(problem.joints)
    without, changed = (
        problem.at(h).errors([h], segments)[0][:, :joints] for h in (best.without(term), best)
    )
    predicted = np.nan_to_num(without - changed)
    row, j = np.unravel_index(np.abs(predicted).argmax(), predicted.shape)
    ends = np.cumsum(problem.lengths(segments))
    k = int(np.searchsorted(ends, row, side="right"))
    segment, rows = problem.simulator.segments[segments[k]], slice(ends[k - 1] if k else 0, ends[k])
    recordings = (*tested.trials.fit, *tested.trials.held_out)
    recording = recordings[tested.prepared.segment_trial[segments[k]]]
    unit = si_unit("position", bool(problem.simulator.layout.slides[j]))
    return {
        "difference": {
            "recording": recording.path.name, "joint": problem.joints[j], "unit": unit,
            "position_unit": unit,
        }
        | difference_series(
            catalogue()[finding.effect], segment.time, segment.position[:, j],
            without[rows, j], predicted[rows, j],
        )
    }  # fmt: skip


def _widened(estimate: Estimate, half: float) -> Estimate:
    """An estimate with a second, independent half width of its interval."""
    low, high = estimate.value - estimate.low, estimate.high - estimate.value
    return Estimate(
        estimate.value, estimate.unit, estimate.value - float(np.hypot(low, half)),
        estimate.value + float(np.hypot(high, half)),
    )  # fmt: skip


def _together(p: Parameter, before: float, added: float) -> float:
    """Reported value of a parameter that had a value before and was changed."""
    if p.reciprocal_of is not None:
        return p.reported(float(p.combined(p.reported(before), p.reported(added))))
    return float(p.combined(before, added))


def _difference(p: Parameter, before: Estimate, added: Estimate) -> Estimate:
    """New minus old value: the interval is that of the change alone."""
    value, *bounds = (
        _together(p, before.value, x) - before.value for x in (added.value, added.low, added.high)
    )
    return Estimate(value, added.unit, min(bounds), max(bounds))


def _total(p: Parameter, before: Estimate, added: Estimate) -> Estimate:
    """The new value, with the intervals of both."""
    value = _together(p, before.value, added.value)
    half = float(np.hypot(_half(before), _half(_difference(p, before, added))))
    return Estimate(value, added.unit, value - half, value + half)


def _half(estimate: Estimate) -> float:
    return 0.5 * (estimate.high - estimate.low)


def _known_before(found: SimulatedChanges, effect: str, joint: str | None) -> dict[str, Estimate]:
    """Parameters of an effect as the earlier recordings show them."""
    for finding in found.known.found.explanation.findings:
        if (finding.effect, finding.joint) == (effect, joint):
            return dict(finding.parameters)
    return {}


def _absent(p: Parameter, like: Estimate) -> Estimate:
    """The value without the effect, which the model has."""
    value = p.neutral or 0.0
    return Estimate(value, like.unit, value, value)


def _json(estimate: Estimate) -> dict[str, Any]:
    return {
        "value": number(estimate.value), "unit": estimate.unit,
        "ci95": [number(estimate.low), number(estimate.high)],
    }  # fmt: skip


def _linear(found: SimulatedChanges, change: Change) -> dict[str, Any]:
    """A change of the linear comparison, which no simulation has tested."""
    term, columns = change.shape.term, change.shape.indices
    joint = None if term.joint < 0 else found.laws.joints[term.joint]
    kind = "slide" if found.laws.slides[max(term.joint, 0)] else "hinge"
    # A column is the change by one amplitude at its SI value; rows scale it to the travel.
    scale = found.rows.scale[columns] * found.laws.scales[columns]
    spread = Z95 * np.sqrt(np.diag(change.covariance)) * np.abs(scale)
    earlier = _known_before(found, term.effect, joint)
    now, moved, known = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    for p, value, half in zip(change.shape.amplitudes, change.value * scale, spread, strict=True):
        if p.reciprocal_of is not None:
            continue
        unit = p.unit(kind)
        estimate = Estimate(float(value), unit, float(value - half), float(value + half))
        before = earlier.get(p.name) or _absent(p, estimate)
        moved[p.name], known[p.name] = _json(_difference(p, before, estimate)), _json(before)
        now[p.name] = _json(_total(p, before, estimate))
    return {
        "effect": term.effect,
        "joint": joint,
        "confidence": round(min(change.confidence, _MOST_UNFINISHED), 4),
        "parameters": now,
        "change": moved,
        "known_before": known,
        "where": {"summary": "not located: the search ended early", "windows": {}},
        "held_out_gain": None,
        "residual_gain": round(change.gain, 5),
        "alternatives": [
            {
                "effect": rival.effect,
                "joint": None if rival.joint < 0 else found.laws.joints[rival.joint],
                "confidence": round(p, 4),
            }
            for rival, p in change.rivals.items()
        ],
        "next_test": next(iter(term.law.confused_with.values()), "repeat the recording"),
    }


def _names(trials: Sequence[Trial]) -> list[str]:
    return list(dict.fromkeys(t.path.name for t in trials))
