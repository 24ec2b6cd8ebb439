"""``trend.json``: sessions, parameters with bands, changes and alarms."""

from __future__ import annotations

from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.record_fields import Z95
from pytest_twin.trend.trend import UNEXPLAINED, Change, Trend


def trend_document(found: Trend, level: float) -> dict[str, Any]:
    """Content of ``trend.json``, schema 1.

    Args:
        level: level of the alarm.
    """
    estimates = found.estimates
    return {
        "schema": 1,
        "verdict": "alarm" if found.is_alarm else "no_alarm",
        "by": "measured effort",
        "level": level,
        "sessions": [
            {
                "date": one.date.isoformat(),
                "recordings": one.names,
                "temperature": one.temperature,
                "declared": dict(one.declared),
            }
            for one in found.sessions
        ],
        "changes": [_change(found, change) for change in found.changes],
        "mixed": [
            {"parameter": name, "switches": switches} for name, switches in found.mixed.items()
        ],
        "parameters": {
            one.name: {
                "joint": one.joint,
                "effect": one.kind,
                "meaning": one.words,
                "unit": one.unit,
                "values": [
                    _value(float(v), float(s))
                    for v, s in zip(estimates.value[:, k], estimates.std[:, k], strict=True)
                ],
                "detectable": _number(float(found.detectable[k])),
                "warm_up": _number(float(found.warm_up[k])),
            }
            for k, one in enumerate(estimates.followed)
        },
        "held_out": {
            joint: {
                "effort_relative": _numbers(estimates.held_out[:, j]),
                "unexplained": _numbers(estimates.unexplained[:, j]),
            }
            for j, joint in enumerate(estimates.joints)
        },
        "events": [{"date": event.date.isoformat(), "what": event.what} for event in found.events],
        "declared": list(found.declared),
        "notes": list(dict.fromkeys(found.notes)),
    }


def _change(found: Trend, change: Change) -> dict[str, Any]:
    point, sessions = change.point, found.sessions
    if point.kind == "step":
        between = [sessions[int(change.which[point.after - 1])].date,
                   sessions[int(change.which[point.after])].date]  # fmt: skip
    else:
        between = [sessions[int(change.which[0])].date, sessions[int(change.which[-1])].date]
    of_error = change.followed.kind == UNEXPLAINED
    half = Z95 * point.std
    low, size, high = point.size - half, point.size, point.size + half
    if of_error:
        # The error is followed by its logarithm: a change is a factor.
        low, size, high = (float(np.expm1(np.clip(x, -50.0, 50.0))) for x in (low, size, high))
    return {
        "parameter": change.followed.name,
        "joint": change.followed.joint,
        "effect": None if of_error else change.followed.kind,
        "meaning": change.followed.words,
        "kind": point.kind,
        "between": [one.isoformat() for one in between],
        "change": {
            "value": _number(size),
            "unit": change.followed.unit,
            "ci95": [_number(low), _number(high)],
        },
        "relative": of_error,
        "probability_by_chance": float(f"{point.probability:.3g}"),
    }


def _value(value: float, std: float) -> dict[str, Any] | None:
    if not np.isfinite(value):
        return None
    return {
        "value": _number(value),
        "ci95": [_number(value - Z95 * std), _number(value + Z95 * std)],
    }


def _numbers(values: FloatArray) -> list[float | None]:
    return [_number(float(value)) for value in values]


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if np.isfinite(value) else None
