"""Single numbers against their record, where either may not exist."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.base import Measure
from pytest_twin.golden import Golden


def scalar_measures(
    golden: Golden,
    names: Mapping[str, str],
    measured: Mapping[str, Any],
    subject: str,
    *,
    undefined: Mapping[str, str] | None = None,
) -> list[Measure]:
    """Numbers against the golden's expected ones, for every name that has a tolerance.

    A metric that neither carries is not reported. One that only one carries fails, in words.

    Args:
        names: metric, a key of tolerance and of the expected values -> SI unit.
        measured: metric -> number, or None where the response has none.
        undefined: metric -> why it can be None, such as ``it never settles``.
    """
    measures = []
    expected = golden.expected or {}
    for name, unit in names.items():
        bound = golden.tolerance.get(name)
        if bound is None or name not in expected:
            continue
        now, then = measured.get(name), expected[name]
        if now is None and then is None:
            continue
        words = ""
        if now is None or then is None:
            why = (undefined or {}).get(name, "the response has none")
            words = f": undefined {'now' if now is None else 'in the golden'} ({why})"
        now = math.nan if now is None else float(now)
        then = math.nan if then is None else float(then)
        measures.append(
            Measure(
                name=name,
                subject=subject + words,
                measured=now,
                golden=then,
                error=abs(now - then),
                tolerance=bound.value,
                unit=unit,
            )
        )
    return measures


def declared_measure(
    golden: Golden, name: str, unit: str, measured: float, subject: str, declared: float = 0.0
) -> list[Measure]:
    """One number against what is declared, not recorded; empty without a tolerance."""
    bound = golden.tolerance.get(name)
    if bound is None:
        return []
    return [
        Measure(
            name=name,
            subject=subject,
            measured=measured,
            golden=declared,
            error=abs(measured - declared),
            tolerance=bound.value,
            unit=unit,
            against="declared",
        )
    ]


def sample_grid(duration: float, samples: int) -> FloatArray:
    """Times (samples,) in s from 0 to ``duration``: the same for every timestep of a simulator."""
    return np.linspace(0.0, duration, samples)
