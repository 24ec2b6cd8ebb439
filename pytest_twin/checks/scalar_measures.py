"""Compare single numbers with their record, when either may be missing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.base import Measure
from pytest_twin.golden import Golden


def scalar_measures(
    golden: Golden,
    names: Iterable[str],
    measured: Mapping[str, Any],
    subject: str,
    *,
    undefined: Mapping[str, str] | None = None,
) -> list[Measure]:
    """Compare numbers with the golden's expected ones, for every name with a tolerance.

    A metric that both lack is not reported. A metric that only one has fails with a reason.

    Args:
        names: metrics, which are keys of tolerances and of expected values.
        measured: metric -> number, or None if undefined.
        undefined: metric -> reason why it can be undefined, such as ``it never settles``.
    """
    measures = []
    expected = golden.expected or {}
    for name in names:
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
        measures.append(Measure.of_difference(name, subject + words, (now, then), bound))
    return measures


def declared_measure(
    golden: Golden, name: str, measured: float, subject: str, declared: float = 0.0
) -> list[Measure]:
    """Compare a number with a declared one instead of a recorded one; empty without tolerance."""
    bound = golden.tolerance.get(name)
    if bound is None:
        return []
    return [Measure.of_difference(name, subject, (measured, declared), bound, "declared")]


def sample_grid(duration: float, samples: int) -> FloatArray:
    """Return (samples,) times from 0 to ``duration``, s, independent of the timestep."""
    return np.linspace(0.0, duration, samples)
