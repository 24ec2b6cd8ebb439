"""Kinds of goldens, one file each, found through the entry points ``pytest_twin.checks``."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points

from pytest_twin.checks.base import Check, Measure, Observation, Progress, Trace
from pytest_twin.errors import SpecError
from pytest_twin.installed import brought

__all__ = ["Check", "Measure", "Observation", "Progress", "Trace", "check_of", "kinds"]


@functools.cache
def _entry_points() -> Mapping[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="pytest_twin.checks")}


def kinds() -> tuple[str, ...]:
    """Names of all installed kinds, sorted."""
    return tuple(sorted(_entry_points()))


@functools.cache
def check_of(kind: str) -> Check:
    """The check that runs goldens of ``kind``.

    Raises:
        SpecError: no such kind is installed, or what brings it cannot be loaded.
    """
    point = _entry_points().get(kind)
    if point is None:
        raise SpecError("unknown kind", where="kind", value=kind, expected=", ".join(kinds()))
    check: Check = brought(point, "kind")
    return check
