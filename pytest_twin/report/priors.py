"""What became of the priors of servos, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pytest_twin.report.text import number
from pytest_twin.words import list_names


def prior_sentences(document: Mapping[str, Any]) -> list[str]:
    """Sentences on the priors in ``diagnosis.json`` or ``identification.json``.

    Joints at which the same became of the same prior share one.
    """
    joints: dict[tuple[str, str, str], list[str]] = {}
    for use in document.get("priors", ()):
        known = f"as of servo {use['servo']}, {_estimate(use['value'], use['ci95'])} {use['unit']}"
        joints.setdefault((use["parameter"], known, _outcome(use)), []).append(use["joint"])
    return [
        f"Prior: {parameter} of {list_names(names)} {known}; {outcome}."
        for (parameter, known, outcome), names in joints.items()
    ]


def _outcome(use: Mapping[str, Any]) -> str:
    if use["state"] == "not_comparable":
        return f"not used: {use['why']}"
    if use["state"] == "not_estimated":
        return _of_model(use)
    both: Mapping[str, Any] = use.get("combined", {})
    if "data" not in use:
        ends = _estimate(both["value"], both["ci95"])
        return f"the recordings alone do not determine it; together {ends}"
    data = use["data"]
    said = f"the recordings alone say {_estimate(data['value'], data['ci95'])}"
    away = f"{number(use['distance'])} standard deviations away"
    if use["state"] == "contradicted":
        return f"{said}, {away}; {use['why']}"
    return f"{said}, {away}; together {_estimate(both['value'], both['ci95'])}"


def _of_model(use: Mapping[str, Any]) -> str:
    if use["model"] is None:
        return "the recordings show no error of it, and the model has no limit"
    low, high = use["ci95"]
    inside = "" if low <= use["model"] <= high else ", outside this interval"
    return f"no effect found changes it, and the model has {number(use['model'])}{inside}"


def _estimate(value: float, ends: Sequence[float]) -> str:
    return f"{number(value)} (95 % interval {number(ends[0])} to {number(ends[1])})"
