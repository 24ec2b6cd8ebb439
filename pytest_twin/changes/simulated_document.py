"""``diagnosis.json`` of a comparison with earlier recordings by simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pytest_twin.changes.by_simulation import SimulatedChanges
from pytest_twin.changes.comparison import Change
from pytest_twin.changes.document import alarm_json, number, residuals_json, verdict_of
from pytest_twin.diagnosis.findings import Estimate, Finding, finding_json
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Parameter, si_unit
from pytest_twin.formats.record_fields import Z95
from pytest_twin.trial import Trial

_MOST_UNFINISHED = 0.5
"""Largest confidence of a change that no simulation has tested."""


def simulated_document(
    found: SimulatedChanges, *, level: float, release: int | None = None
) -> dict[str, Any]:
    """Content of ``diagnosis.json`` with ``--before`` by simulation, schema 1.

    Args:
        level: level of the alarm.
        release: number of the release whose recordings are the earlier ones.
    """
    comparison, joints = found.comparison, found.laws.joints
    findings = _findings(found)
    after = comparison.after
    tested = found.found
    if tested is not None:
        errors = tested.tested.errors
        after = np.array([errors[j].after if j in errors else 0.0 for j in joints])
    units = [si_unit("position", slide) for slide in found.laws.slides]
    return {
        "schema": 1,
        "verdict": verdict_of(comparison.is_changed, bool(findings)),
        "by": "simulation",
        "before": {"recordings": _names(found.before), "release": release},
        "new": _names(found.new),
        "findings": findings,
        "alarm": alarm_json(comparison, level, found.sessions),
        "position": residuals_json(comparison, joints, units, after),
        "model_changes": [],
        "notes": list(found.notes),
    }


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


def _simulated(found: SimulatedChanges, finding: Finding) -> dict[str, Any]:
    document = finding_json(finding)
    known, change, now = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    earlier = _known_before(found, finding.effect, finding.joint)
    law = catalogue()[finding.effect]
    by_name = {p.reported_name: p for p in law.parameters}
    for name, estimate in finding.parameters.items():
        p = by_name[name]
        before = earlier.get(name) or _absent(p, estimate)
        if p.neutral is None or p.reciprocal_of is not None:
            # A shape has no difference; a reciprocal is absent at infinity.
            now[name] = _json(estimate)
            if name in earlier:
                known[name] = _json(before)
            continue
        half = [np.hypot(_half(before), _half(estimate))] * 2
        total = before.value + estimate.value - p.neutral
        now[name] = _json(Estimate(total, estimate.unit, total - half[0], total + half[1]))
        known[name] = _json(before)
        change[name] = _json(estimate)
    document |= {"parameters": now, "change": change, "known_before": known}
    if not found.held_out:
        document["held_out_gain"] = None
        document["residual_gain"] = round(finding.held_out_gain, 5)
    return document


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
        total = before.value + estimate.value
        moved[p.name], known[p.name] = _json(estimate), _json(before)
        now[p.name] = _json(Estimate(total, unit, total - float(half), total + float(half)))
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
