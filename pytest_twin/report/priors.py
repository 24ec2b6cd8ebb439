"""What became of the priors of servos, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pytest_twin.report.text import number


def prior_sentences(document: Mapping[str, Any]) -> list[str]:
    """One sentence for each prior in ``diagnosis.json`` or ``identification.json``."""
    return [_sentence(use) for use in document.get("priors", ())]


def _sentence(use: Mapping[str, Any]) -> str:
    known = (
        f"Prior: {use['parameter']} of {use['joint']} as of servo {use['servo']}, "
        f"{_estimate(use['value'], use['ci95'])} {use['unit']}"
    )
    if use["state"] == "not_comparable":
        return f"{known}; not used: {use['why']}."
    if use["state"] == "not_estimated":
        return f"{known}; {_of_model(use)}."
    both: Mapping[str, Any] = use.get("combined", {})
    if "data" not in use:
        ends = _estimate(both["value"], both["ci95"])
        return f"{known}; the recordings alone do not determine it; together {ends}."
    data = use["data"]
    said = f"{known}; the recordings alone say {_estimate(data['value'], data['ci95'])}"
    away = f"{number(use['distance'])} standard deviations away"
    if use["state"] == "contradicted":
        return f"{said}, {away}; {use['why']}."
    return f"{said}, {away}; together {_estimate(both['value'], both['ci95'])}."


def _of_model(use: Mapping[str, Any]) -> str:
    if use["model"] is None:
        return "the recordings show no error of it, and the model has no limit"
    low, high = use["ci95"]
    inside = "" if low <= use["model"] <= high else ", outside this interval"
    return f"no effect found changes it, and the model has {number(use['model'])}{inside}"


def _estimate(value: float, ends: Sequence[float]) -> str:
    return f"{number(value)} (95 % interval {number(ends[0])} to {number(ends[1])})"
