"""What every ``identification.json`` has: the verdict, the fields, the entry of a parameter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from pytest_twin import __version__
from pytest_twin.identification.stages import Stage

Verdict = Literal["accepted", "improved", "rejected"]


def verdict_of(stages: Sequence[Stage], better: bool, held_out: bool, consistent: bool) -> Verdict:
    """Return the verdict on an identification.

    Args:
        better: whether the test error is below the nominal model's.
        held_out: whether it was tested on held-out recordings.
        consistent: whether the parameters are physically consistent.
    """
    states = {stage.state for stage in stages}
    if not better or not consistent or not states & {"accepted", "reopened"}:
        return "rejected"
    return "accepted" if held_out and "rejected" not in states else "improved"


def nominal_document(way: str) -> dict[str, Any]:
    """Return the content of ``identification.json`` of the nominal model, before any stage.

    Args:
        way: what is identified from.
    """
    return {
        "schema": 1,
        "verdict": "rejected",
        "way": way,
        "stages": [],
        "parameters": {},
        "covariance": {"names": [], "matrix": []},
        "correlated": [],
        "base_parameters": [],
        "held_out": {},
        "tested_on": "no recordings",
        "physical": {"consistent": True, "violations": []},
        "suspected": [],
        "without_effort": [],
        "unobservable": [],
        "fit": {},
        "trials": {"fit": [], "held_out": []},
        "notes": [],
        "software": {"pytest-twin": __version__},
    }


def parameter_entry(
    value: float, half_width: float, unit: str, *, prior: float | None, stage: str, **more: Any
) -> dict[str, Any]:
    """Return the entry of an estimated parameter.

    Args:
        half_width: of its 95 % interval.
        prior: value of the model.
        stage: stage that estimated it.
        more: further fields, such as ``used`` and ``estimator``.
    """
    return {
        "value": float(value),
        "unit": unit,
        "ci95": [float(value - half_width), float(value + half_width)],
        "prior": prior,
        "stage": stage,
        **more,
    }
