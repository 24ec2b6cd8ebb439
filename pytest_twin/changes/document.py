"""``diagnosis.json`` of a comparison with earlier recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.comparison import Comparison
from pytest_twin.changes.find_changes import Changes
from pytest_twin.changes.naming import LEAST_PROBABILITY, Change
from pytest_twin.changes.tool_load import is_tool_load, mass_and_place
from pytest_twin.diagnosis.not_separated import NEEDED_SHARE
from pytest_twin.effects.base import Effect, si_unit
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.formats.record_fields import Z95

_FRICTION = "friction"
"""Family of the laws that are shown over velocity; others are shown over position."""
_ACTS = 0.5
"""Fraction of a law's largest effort above which it counts as acting."""
_MOST_CANDIDATES = 6
"""Largest number of laws that are listed where none is named."""
_MOST_WINDOWS = 8
"""Largest number of time intervals that are listed for one recording."""
_MOST_SAMPLES = 400
"""Largest number of samples of the difference that is shown."""


def changes_document(found: Changes, *, level: float, release: int | None = None) -> dict[str, Any]:
    """Content of ``diagnosis.json`` with ``--before`` by measured effort, schema 1.

    Args:
        level: level of the alarm.
        release: number of the release whose recordings are the earlier ones.
    """
    comparison = found.comparison
    slides = found.laws.dynamics.slides
    units = [si_unit("effort", bool(slide)) for slide in slides]
    return {
        "schema": 1,
        "verdict": verdict_of(comparison.is_changed, bool(comparison.changes)),
        "by": "measured effort",
        "before": {"recordings": _names(found, found.before), "release": release},
        "new": _names(found, found.new),
        "findings": [_finding(found, change) for change in comparison.changes],
        **undecided_json(comparison, found.laws.joints),
        "alarm": alarm_json(comparison, level, found.sessions),
        "effort": residuals_json(comparison, found.laws.joints, units, comparison.after),
        "model_changes": [],
        "notes": list(found.notes),
    }


def verdict_of(is_changed: bool, is_named: bool) -> str:
    """Verdict of a comparison."""
    if not is_changed:
        return "no_change"
    return "changed" if is_named else "changed_unnamed"


def undecided_json(comparison: Comparison, joints: Sequence[str]) -> dict[str, Any]:
    """``places`` and ``candidates``: where something changed, and the likeliest laws.

    What the first law does not explain of its joints is no evidence against the joints.
    """
    place_probability: dict[tuple[str | None, str | None], float] = {}
    likeliest: list[dict[str, Any]] = []
    share = 0.0
    for one in comparison.candidates:
        first, *others = ({"effect": t.effect, "joint": _joint(joints, t)} for t in one.terms)
        joint_and_motor = (first["joint"], one.motor)
        place_probability.setdefault(joint_and_motor, 0.0)
        place_probability[joint_and_motor] += one.probability
        confidence = one.probability * comparison.explained
        if share < NEEDED_SHARE and confidence >= LEAST_PROBABILITY:
            likeliest.append(
                first
                | {"motor": one.motor, "confidence": round(confidence, 4)}
                | ({"together_with": others} if others else {})
            )
        share += one.probability
    return {
        "places": [
            {"joint": joint, "motor": motor, "confidence": round(p, 4)}
            for (joint, motor), p in sorted(place_probability.items(), key=lambda each: -each[1])
            if p >= LEAST_PROBABILITY
        ],
        "candidates": likeliest[:_MOST_CANDIDATES],
        "explained": round(comparison.explained, 4) if comparison.candidates else None,
    }


def alarm_json(comparison: Comparison, level: float, sessions: str) -> dict[str, Any]:
    """Score, threshold, and what the threshold is from."""
    null = comparison.null
    return {
        "score": number(comparison.score),
        "threshold": number(comparison.threshold),
        "level": level,
        "sessions": sessions,
        "degrees_of_freedom": null.freedom if null.is_t_law(level) else None,
        "scores_before": [number(s) for s in null.scores],
    }


def residuals_json(
    comparison: Comparison, joints: Sequence[str], units: Sequence[str], after: FloatArray
) -> dict[str, dict[str, Any]]:
    """Joint -> RMS residual: usual, of the later recordings, and with the changes.

    Args:
        units: unit of each joint's residual.
        after: (joints,) RMS residual with the changes.
    """
    return {
        joint: {
            "rms_usual": number(comparison.usual[j]),
            "rms_before": number(comparison.before[j]),
            "rms_after": number(after[j]),
            "unit": units[j],
        }
        for j, joint in enumerate(joints)
    }


def _names(found: Changes, which: tuple[int, ...]) -> list[str]:
    return list(dict.fromkeys(found.rows.parts[i].recording.path.name for i in which))


def _finding(found: Changes, change: Change) -> dict[str, Any]:
    parameters, moved, known = _estimates(found, change)
    return {
        "effect": change.shape.term.effect,
        "joint": _joint(found.laws.joints, change.shape.term),
        "scope": _scope(change),
        "motor": change.motor,
        "confidence": round(change.confidence, 4),
        "parameters": parameters,
        "change": moved,
        "known_before": known,
        "where": _where(found, change),
        "difference": _difference(found, change),
        "held_out_gain": None if found.removed is None else round(found.removed, 5),
        "residual_gain": round(change.gain, 5),
        "alternatives": [
            {
                "effect": term.effect,
                "joint": _joint(found.laws.joints, term),
                "confidence": round(p, 4),
            }
            for term, p in change.rivals.items()
        ],
        "next_test": _next_test(change),
    }


def _estimates(
    found: Changes, change: Change
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Parameters now, their change, and their values before, with intervals."""
    shape, columns = change.shape, change.shape.indices
    if is_tool_load(shape):
        # A payload is counted from the tool of the earlier recordings.
        si = found.rows.scale[columns]
        places = mass_and_place(shape, change.value * si, change.covariance * np.outer(si, si))
        load = {name: _estimate(value, deviation, unit) for name, unit, value, deviation in places}
        return load, load, {name: _estimate(0.0, 0.0, one["unit"]) for name, one in load.items()}
    slide = bool(found.laws.dynamics.slides[max(shape.term.joint, 0)])
    scale = found.rows.scale[columns]
    before = found.comparison.background.mean[columns]
    covariance = np.linalg.inv(found.comparison.background.precision)[np.ix_(columns, columns)]
    spread_before, spread = (
        np.sqrt(np.diag(c).clip(0.0)) * scale for c in (covariance, change.covariance)
    )
    units = [p.unit("slide" if slide else "hinge") for p in shape.amplitudes]
    names = [p.name for p in shape.amplitudes]
    rows = list(zip(names, units, before * scale, spread_before, change.value * scale, spread,
                    strict=True))  # fmt: skip
    parameters = {
        name: _estimate(old + new, np.hypot(d_old, d_new), unit)
        for name, unit, old, d_old, new, d_new in rows
    }
    for k, p in enumerate(shape.term.parameters):
        if k not in shape.columns and shape.term.law.has(shape.values)[k]:
            value = p.reported(float(shape.values[k]))
            unit = p.unit("slide" if slide else "hinge")
            parameters[p.reported_name] = {"value": number(value), "unit": unit, "ci95": None}
    return (
        parameters,
        {name: _estimate(new, d, unit) for name, unit, _, _, new, d in rows},
        {name: _estimate(old, d, unit) for name, unit, old, d, _, _ in rows},
    )


def _scope(change: Change) -> str:
    """Whether the law changed at one joint, at all joints of a motor type, or of the robot."""
    if change.motor is not None:
        return "motor"
    return "robot" if change.shape.term.joint < 0 else "joint"


def _joint(joints: Sequence[str], term: Term) -> str | None:
    return None if term.joint < 0 else joints[term.joint]


def _next_test(change: Change) -> str:
    tests = change.shape.term.law.confused_with
    rival = next((tests[t.effect] for t in change.rivals if t.effect in tests), None)
    return rival or next(iter(tests.values()), "repeat the recording")


def _where(found: Changes, change: Change) -> dict[str, Any]:
    amplitudes = np.zeros(len(found.rows.scale))
    amplitudes[change.shape.indices] = change.value
    windows, largest, joint = {}, 0.0, 0
    efforts = {i: np.abs(found.rows.effort_of(i, amplitudes)) for i in found.new}
    for effort in efforts.values():
        if effort.max() > largest:
            largest, joint = float(effort.max()), int(effort.max(axis=0).argmax())
    for i, effort in efforts.items():
        part = found.rows.parts[i]
        spans = _spans(part.recording.start + part.time, effort[:, joint] > _ACTS * largest)
        windows[part.recording.path.name] = spans
    unit = si_unit("effort", bool(found.laws.dynamics.slides[joint]))
    summary = (
        f"effort of {found.laws.joints[joint]}; it changes by up to {largest:.3g} {unit}, and by "
        "more than half of that in the listed intervals"
    )
    return {"summary": summary, "windows": windows}


def _difference(found: Changes, change: Change) -> dict[str, Any]:
    """New minus earlier efforts where a change acts most, measured and as the change predicts.

    The earlier efforts are those of the laws of the earlier recordings along the new motion, with
    the other changes.
    """
    amplitudes, others = np.zeros(len(found.rows.scale)), found.comparison.background.mean.copy()
    amplitudes[change.shape.indices] = change.value
    for other in found.comparison.changes:
        if other.shape is not change.shape:
            others[other.shape.indices] += other.value
    efforts = {i: found.rows.effort_of(i, amplitudes) for i in found.new}
    i = max(efforts, key=lambda k: float(np.abs(efforts[k]).max()))
    j = int(np.abs(efforts[i]).max(axis=0).argmax())
    part = found.rows.parts[i]
    recording = part.recording
    position = np.interp(part.time, recording.time, recording.position[:, j])
    slide = bool(found.laws.dynamics.slides[j])
    return {
        "recording": recording.path.name,
        "joint": found.laws.joints[j],
        "unit": si_unit("effort", slide),
        "position_unit": si_unit("position", slide),
    } | difference_series(
        change.shape.term.law, recording.start + part.time, position,
        found.rows.residuals([i], others)[0][:, j], efforts[i][:, j],
    )  # fmt: skip


def difference_series(
    law: Effect,
    time: FloatArray,
    position: FloatArray,
    measured: FloatArray,
    change: FloatArray,
) -> dict[str, Any]:
    """What is new in a signal, over time and over what a law depends on.

    Args:
        time, position: (n,) s, and rad or m.
        measured: (n,) new minus earlier signal.
        change: (n,) the same as a change predicts it.
    """
    step = -(-len(time) // _MOST_SAMPLES)
    series = {
        "time": time, "position": position,
        "velocity": np.gradient(position, time + 1e-9 * np.arange(len(time))),
        "measured": measured, "change": change,
    }  # fmt: skip
    return {
        "over": "velocity" if law.family == _FRICTION else "position",
        **{name: [number(x) for x in values[::step].tolist()] for name, values in series.items()},
    }


def _spans(time: FloatArray, acts: NDArray[np.bool_]) -> list[list[float]]:
    """Longest intervals in which a law acts, s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], acts, [False]]).astype(int)))
    spans = [
        [round(float(time[a]), 3), round(float(time[b - 1]), 3)] for a, b in edges.reshape(-1, 2)
    ]
    return sorted(sorted(spans, key=lambda s: s[0] - s[1])[:_MOST_WINDOWS])


def _estimate(value: float, deviation: float, unit: str) -> dict[str, Any]:
    half = Z95 * deviation
    interval = [number(value - half), number(value + half)]
    return {"value": number(value), "unit": unit, "ci95": interval}


def number(value: float) -> float:
    """A value with six significant digits."""
    return float(f"{value:.6g}")
