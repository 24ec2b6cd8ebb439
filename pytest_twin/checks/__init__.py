"""Kinds of goldens, one module each, found through the entry points ``pytest_twin.checks``."""

from __future__ import annotations

import functools

from pytest_twin.checks.attribute_validation import validate_check
from pytest_twin.checks.base import Check, Measure, Observation, Progress, Trace
from pytest_twin.errors import SpecError
from pytest_twin.installed import (
    entry_points_by_name,
    load_plugin,
    package_of,
    refuse_stale_installation,
    single_entry_point,
)

__all__ = ["Check", "Measure", "Observation", "Progress", "Trace", "check_of", "kinds"]

_GROUP = "pytest_twin.checks"


def kinds() -> tuple[str, ...]:
    """Return the names of all installed kinds, sorted."""
    return tuple(sorted(entry_points_by_name(_GROUP)))


@functools.cache
def check_of(kind: str) -> Check:
    """Return the check that runs goldens of ``kind``.

    Raises:
        SpecError: no such kind is installed, two packages define it, or its package cannot be
            loaded or has no usable check.
    """
    points = entry_points_by_name(_GROUP).get(kind, ())
    if not points:
        refuse_stale_installation(
            (point for own in entry_points_by_name(_GROUP).values() for point in own), _GROUP
        )
        raise SpecError("unknown kind", where="kind", value=kind, expected=", ".join(kinds()))
    point = single_entry_point(points, "kind")
    return validate_check(load_plugin(point, "kind"), kind, package_of(point))
