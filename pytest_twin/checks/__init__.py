"""Kinds of goldens, one file each, found through the entry points ``pytest_twin.checks``."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points

from pytest_twin.checks.base import Check, Measure, Observation, Progress, Trace
from pytest_twin.checks.checked import checked
from pytest_twin.errors import SpecError
from pytest_twin.installed import brought, package_of, refuse_stale

__all__ = ["Check", "Measure", "Observation", "Progress", "Trace", "check_of", "kinds"]

_GROUP = "pytest_twin.checks"


@functools.cache
def _entry_points() -> Mapping[str, tuple[EntryPoint, ...]]:
    """Kind -> who brings it: one, or several that contradict one another."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for point in entry_points(group=_GROUP):
        found[point.name] = (*found.get(point.name, ()), point)
    return found


def kinds() -> tuple[str, ...]:
    """Names of all installed kinds, sorted."""
    return tuple(sorted(_entry_points()))


@functools.cache
def check_of(kind: str) -> Check:
    """The check that runs goldens of ``kind``.

    Raises:
        SpecError: no such kind is installed, two packages bring it, or the package that brings it
            cannot be loaded or has no usable check.
    """
    points = _entry_points().get(kind, ())
    if not points:
        refuse_stale((point for own in _entry_points().values() for point in own), _GROUP)
        raise SpecError("unknown kind", where="kind", value=kind, expected=", ".join(kinds()))
    if len(points) > 1:
        packages = " and ".join(package_of(point) for point in points)
        raise SpecError(
            f"{packages} both bring this kind",
            where="kind",
            value=kind,
            expected="one of them; uninstall the other",
        )
    (point,) = points
    return checked(brought(point, "kind"), kind, package_of(point))
